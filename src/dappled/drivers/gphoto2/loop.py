"""The loop of the camera's process: commands in, events out, a camera between.

Commands: {"do": "fire", "shot": n}, {"do": "delete", "folder", "name"}, {"do": "change", "name", "value"}, {"do":
"ping"}, {"do": "stop"}. Answers are the camera's events (`drivers.camera_channel`) and {"is": "pong"}. One shot is at
the camera at a time; further ones wait here in order.
"""

from __future__ import annotations

import time
from collections import deque
from collections.abc import Callable, Mapping
from typing import Any, cast

from dappled.drivers.attribution import BodyClock
from dappled.drivers.camera import Fired, SettingName, SettingsChanged
from dappled.drivers.gphoto2.fetching import Fetching
from dappled.drivers.gphoto2.finding import open_session
from dappled.drivers.gphoto2.messages import LATE, Before
from dappled.drivers.gphoto2.protocol import (
    AbsentError,
    BusyError,
    CameraFile,
    LostError,
    RefusedError,
    Session,
    SessionError,
)
from dappled.drivers.gphoto2.settings import GPhoto2Settings
from dappled.drivers.gphoto2.state import AtCamera, Books
from dappled.drivers.gphoto2.telling import SEND_S, Telling
from dappled.drivers.process_channel import ChannelError, ProcessChannel

_WAITING = 64
_POLL_BUSY_S = 0.005
_POLL_IDLE_S = 0.3
_BUSY_RETRY_S = 0.05
_REOPEN_S = 0.25


class CameraLoop:
    """Commands in, events out, a camera between. `step` does what is due and waits for the next command."""

    def __init__(
        self,
        channel: ProcessChannel,
        settings: GPhoto2Settings,
        open_camera: Callable[[GPhoto2Settings, str | None], Session] = open_session,
        clock_ns: Callable[[], int] = time.monotonic_ns,
        before: Before | None = None,
    ) -> None:
        self._channel = channel
        self._settings = settings
        self._timeouts = settings.timeouts
        self._open_camera = open_camera
        self._clock_ns = clock_ns
        before = before or Before()
        self._books = Books(serial=before.serial, late=deque(before.late, LATE), clock=BodyClock(before.offsets_s))
        self._telling = Telling(channel, self._books, clock_ns)
        self._files = Fetching(self._books, self._telling, settings.timeouts, frozenset(before.seen), clock_ns)

    def run(self) -> None:
        """Step until told to stop, or until the parent is gone (ChannelError)."""
        try:
            while self.step():
                pass
        finally:
            if self._books.session is not None:
                self._books.session.close()

    def step(self) -> bool:
        """One turn. False once told to stop. Raises ChannelError when the parent is gone."""
        timeout_s = self._patience_s()
        while (message := self._channel.receive(timeout_s)) is not None:
            if not self._obey(message.body):
                return False
            timeout_s = 0.0
        try:
            self._work()
        except LostError as error:
            self._lose(str(error))
        self._bound_flight()
        self._refuse_waiting()
        return True

    # --- commands

    def _obey(self, command: Mapping[str, Any]) -> bool:
        match command:
            case {"do": "fire", "shot": int(shot)}:
                self._take(shot)
            case {"do": "delete", "folder": str(folder), "name": str(name)}:
                self._delete(CameraFile(folder, name))
            case {"do": "change", "name": str(name), "value": str(value)}:
                self._change(cast(SettingName, name), value)
            case {"do": "ping"}:
                self._channel.send({"is": "pong"}, timeout_s=SEND_S)
            case {"do": "stop"}:
                return False
            case _:
                raise ChannelError(f"no command is called {command!r}")
        return True

    def _take(self, shot: int) -> None:
        books = self._books
        if books.session is None and books.flight is None:
            reason = books.state[1] if books.state else ""
            self._telling.failed(shot, f"there is no camera to fire: {reason or 'it is still being opened'}")
        elif len(books.waiting) >= _WAITING:
            self._telling.failed(shot, f"{_WAITING} shots already wait for the camera")
        else:
            books.waiting.append(shot)

    def _delete(self, file: CameraFile) -> None:
        if self._books.session is None:
            return  # it stays on the card; nothing is lost by that
        try:
            self._books.session.delete(file)
            if self._books.known is not None:
                self._books.known -= {file}
        except RefusedError:
            return  # as above
        except LostError as error:
            self._lose(str(error))

    # --- the camera

    def _work(self) -> None:
        books = self._books
        if books.session is None:
            if self._clock_ns() >= books.open_at_ns:
                self._open()
            if books.session is None:
                return
        self._next_shot(books.session)
        self._files.listen(books.session)
        self._files.fetch(books.session)
        if self._look_due() and not self._look():
            return
        self._read_settings(books.session)
        self._telling.state("busy" if books.flight or books.waiting else "ready")

    def _open(self) -> None:
        books = self._books
        if books.state is None:
            self._telling.state("starting")
        try:
            session = self._open_camera(self._settings, books.serial)
        except SessionError as error:
            books.open_at_ns = self._clock_ns() + _ns(self._timeouts.retry_s)
            self._telling.state("absent" if isinstance(error, AbsentError) else "faulted", str(error))
            return
        books.session = session
        if books.serial != session.identity.serial:
            books.serial, books.known = session.identity.serial, None
        books.settings_due_ns = self._clock_ns()
        self._files.find_new(session)

    def _next_shot(self, session: Session) -> None:
        books = self._books
        if books.flight is None:
            if not books.waiting:
                return
            books.flight = AtCamera(books.waiting.popleft(), self._clock_ns())
            self._telling.state("busy")
        flight = books.flight
        if flight.fired_ns is None and self._clock_ns() >= flight.retry_ns:
            self._trigger(session, flight)

    def _trigger(self, session: Session, flight: AtCamera) -> None:
        called_ns = self._clock_ns()
        try:
            session.trigger()
        except BusyError as error:
            now_ns = self._clock_ns()
            if now_ns - flight.since_ns < _ns(self._timeouts.busy_s):
                flight.retry_ns = now_ns + _ns(_BUSY_RETRY_S)
            else:
                self._telling.flight_failed(f"{error}, for {self._timeouts.busy_s:g} s: wait, or switch it off and on")
        except RefusedError as error:
            self._telling.flight_failed(f"{error}; look at focus, card and mode dial")
        except LostError as error:
            flight.fired_ns = called_ns  # as far as we know
            self._telling.flight_failed(f"{error}; the shutter may have opened all the same", may_come=True)
            raise
        else:
            flight.fired_ns = self._clock_ns()
            self._telling.tell(Fired(flight.shot, called_ns, flight.fired_ns))

    # --- settings

    def _read_settings(self, session: Session) -> None:
        """Read them when that is due and no shot is at the camera; tell them where they are others than before."""
        books = self._books
        if books.settings_due_ns is None or self._clock_ns() < books.settings_due_ns or books.flight is not None:
            return
        books.settings_due_ns = None
        found = session.settings()
        if found != books.settings:
            books.settings = found
            self._telling.tell(SettingsChanged(found, self._clock_ns()))

    def _change(self, name: SettingName, value: str) -> None:
        books = self._books
        reason = "there is no camera to set"
        try:
            if books.session is not None:
                books.session.change(name, value)
                self._files.listen(books.session)  # the camera tells what it made of it
                books.settings = books.session.settings()
                self._telling.tell(SettingsChanged(books.settings, self._clock_ns()))
                return
        except (BusyError, RefusedError) as error:
            reason = str(error)
        except LostError as error:
            reason = str(error)
            self._lose(reason)
        self._telling.tell(
            SettingsChanged(books.settings, self._clock_ns(), f"{name} was not set to {value}: {reason}")
        )

    # --- when the file doesn't come

    def _look_due(self) -> bool:
        books, flight = self._books, self._books.flight
        if flight is None or flight.fired_ns is None or flight.looked_ns is not None or books.to_fetch:
            return False
        if books.session is None or not books.session.keeps_files:
            return False
        now_ns = self._clock_ns()
        if flight.complete_ns is not None and now_ns - flight.complete_ns > _ns(self._timeouts.complete_s):
            return True
        return now_ns - flight.fired_ns > _ns(self._timeouts.look_s)

    def _look(self) -> bool:
        """Search the card. libgphoto2 remembers its listings, so only a new session sees what is new. False where there
        is none to be had."""
        books = self._books
        if books.session is None or books.flight is None:
            return False
        books.session.close()
        books.session = None
        self._open()
        books.flight.looked_ns = self._clock_ns()
        return books.session is not None

    def _bound_flight(self) -> None:
        flight = self._books.flight
        if flight is None:
            return
        now_ns, limit_s = self._clock_ns(), self._timeouts.file_s
        if now_ns - (flight.fired_ns or flight.since_ns) > _ns(limit_s):
            self._telling.flight_failed(
                f"no file came from the camera within {limit_s:g} s of the release", may_come=True
            )
        elif flight.complete_ns is not None and flight.looked_ns is not None:
            searched = self._books.session is not None and not self._books.to_fetch
            if searched and now_ns - flight.looked_ns > _ns(self._timeouts.complete_s):
                self._telling.flight_failed(
                    "the camera finished without a file: perhaps it found no focus; look at it and its card"
                )

    def _refuse_waiting(self) -> None:
        """Without a camera, and without a shot that is still hoped for, nobody waits."""
        books = self._books
        if books.session is None and books.flight is None:
            reason = books.state[1] if books.state else ""
            while books.waiting:
                self._telling.failed(books.waiting.popleft(), reason)

    def _lose(self, reason: str) -> None:
        """The session is gone. A fired shot whose file is on the card is waited for; others have failed."""
        books = self._books
        keeps = books.session is not None and books.session.keeps_files
        if books.session is not None:
            books.session.close()
            books.session = None
        books.to_fetch.clear()
        books.tries.clear()
        books.open_at_ns = self._clock_ns() + _ns(_REOPEN_S)
        if books.flight is not None and not (keeps and books.flight.fired_ns is not None):
            self._telling.flight_failed(reason)
        self._telling.state("faulted", reason)

    def _patience_s(self) -> float:
        """How long to wait for a command before the camera is asked again."""
        books = self._books
        if books.session is None:
            left_s = max((books.open_at_ns - self._clock_ns()) / 1e9, 0.0)
            return min(left_s, _POLL_IDLE_S)
        if books.to_fetch or (books.waiting and books.flight is None):
            return 0.0
        return _POLL_BUSY_S if books.flight is not None else _POLL_IDLE_S


def _ns(seconds: float) -> int:
    return round(seconds * 1e9)
