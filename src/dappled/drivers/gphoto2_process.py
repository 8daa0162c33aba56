"""The camera's own process: it owns libgphoto2 for one long session and obeys messages.

libgphoto2 blocks for seconds, with the GIL held, when a camera goes silent; here that stalls nobody, and the parent
can always kill it. Commands: {"do": "fire", "shot": n}, {"do": "delete", "folder", "name"}, {"do": "change", "name",
"value"}, {"do": "ping"}, {"do": "stop"}. Answers are the camera's events (`drivers.camera_channel`) and {"is": "pong"}.

One shot is at the camera at a time; further ones wait here in order.
"""

from __future__ import annotations

import json
import os
import signal
import socket
import sys
import time
from collections import deque
from collections.abc import Callable, Mapping
from typing import Any, cast

from dappled.drivers.attribution import BodyClock, Claim, attribute
from dappled.drivers.camera import (
    Arrival,
    Companion,
    Event,
    Fired,
    SettingName,
    SettingsChanged,
    ShotFailed,
    State,
    StateChanged,
)
from dappled.drivers.camera_channel import Channel, ChannelError, event_message
from dappled.drivers.child import die_with_parent, raise_priority
from dappled.drivers.file_names import (
    true_name,
)
from dappled.drivers.gphoto2_before import LATE, Before
from dappled.drivers.gphoto2_books import AtCamera, Books
from dappled.drivers.gphoto2_finding import (
    open_session,
)
from dappled.drivers.gphoto2_pairs import makes_pairs
from dappled.drivers.gphoto2_protocol import (
    AbsentError,
    BusyError,
    CameraFile,
    CaptureComplete,
    FileAdded,
    LostError,
    RefusedError,
    Session,
    SessionError,
)
from dappled.drivers.gphoto2_settings import GPhoto2Settings, parse_settings

_WAITING = 64
_SEND_S = 5.0
_POLL_BUSY_S = 0.005
_POLL_IDLE_S = 0.3
_BUSY_RETRY_S = 0.05
_REOPEN_S = 0.25
_TRIES = 3
_SETTINGS_S = 1.0


class CameraLoop:
    """Commands in, events out, a camera between. `step` does what is due and waits for the next command."""

    def __init__(
        self,
        channel: Channel,
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
        self._seen = frozenset(before.seen)
        self._books = Books(serial=before.serial, late=deque(before.late, LATE), clock=BodyClock(before.offsets_s))

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
                self._channel.send({"is": "pong"}, timeout_s=_SEND_S)
            case {"do": "stop"}:
                return False
            case _:
                raise ChannelError(f"no command is called {command!r}")
        return True

    def _take(self, shot: int) -> None:
        books = self._books
        if books.session is None and books.flight is None:
            reason = books.state[1] if books.state else ""
            self._fail(shot, f"there is no camera to fire: {reason or 'it is still being opened'}")
        elif len(books.waiting) >= _WAITING:
            self._fail(shot, f"{_WAITING} shots already wait for the camera")
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
        self._drain(books.session)
        self._fetch(books.session)
        for alone in books.pairs.overdue(self._clock_ns() - _ns(self._timeouts.complete_s)):
            self._deliver(*alone)
        if self._look_due():
            self._look()
        self._read_settings(books.session)
        self._show("busy" if books.flight or books.waiting else "ready")

    def _open(self) -> None:
        books = self._books
        if books.state is None:
            self._show("starting")
        try:
            session = self._open_camera(self._settings, books.serial)
        except SessionError as error:
            books.open_at_ns = self._clock_ns() + _ns(self._timeouts.retry_s)
            self._show("absent" if isinstance(error, AbsentError) else "faulted", str(error))
            return
        books.session = session
        if books.serial != session.identity.serial:
            books.serial, books.known = session.identity.serial, None
        books.settings_due_ns = self._clock_ns()
        self._find_new(session)

    def _find_new(self, session: Session) -> None:
        """Compare the card with what was on it: what came without a word is fetched now."""
        books = self._books
        if not session.keeps_files:
            return
        found = session.files()
        if books.known is None:
            books.known = found - self._of_late_shots(session, found)
        queued = set(books.to_fetch)
        books.to_fetch.extend(sorted(found - books.known - queued, key=lambda file: (file.folder, file.name)))

    def _of_late_shots(self, session: Session, found: frozenset[CameraFile]) -> frozenset[CameraFile]:
        """Of a card that was never seen before: the files of shots that an earlier process fired, by the body's clock.

        They are among the last."""
        books = self._books
        if not books.late or not books.clock.offsets_s:
            return frozenset()
        unseen = (file for file in found if (file.folder, file.name) not in self._seen)
        last = sorted(unseen, key=lambda file: (file.folder, file.name))[-LATE:]
        times = {file: session.taken_s(file) for file in last}
        return frozenset(
            file
            for file, taken_s in times.items()
            if taken_s is not None and any(books.clock.fits(claim, taken_s) for claim in books.late)
        )

    def _next_shot(self, session: Session) -> None:
        books = self._books
        if books.flight is None:
            if not books.waiting:
                return
            books.flight = AtCamera(books.waiting.popleft(), self._clock_ns())
            self._show("busy")
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
                self._end_flight(f"{error}, for {self._timeouts.busy_s:g} s: wait, or switch it off and on")
        except RefusedError as error:
            self._end_flight(f"{error}; look at focus, card and mode dial")
        except LostError as error:
            flight.fired_ns = called_ns  # as far as we know
            self._end_flight(f"{error}; the shutter may have opened all the same", may_come=True)
            raise
        else:
            flight.fired_ns = self._clock_ns()
            self._tell(Fired(flight.shot, called_ns, flight.fired_ns))

    def _drain(self, session: Session) -> None:
        books = self._books
        for news in session.news():
            match news:
                case FileAdded(file) if file not in books.to_fetch and file not in (books.known or ()):
                    books.to_fetch.append(file)
                case CaptureComplete() if books.flight and books.flight.fired_ns is not None:
                    books.flight.complete_ns = self._clock_ns()

    def _fetch(self, session: Session) -> None:
        books = self._books
        while books.to_fetch:
            file = books.to_fetch[0]
            began_ns = self._clock_ns()
            try:
                fetched = session.fetch(file)
            except (BusyError, RefusedError) as error:
                books.to_fetch.popleft()
                self._retry(file, str(error))
                return
            books.to_fetch.popleft()
            books.tries.pop(file, None)
            if books.known is not None and not file.in_memory:
                books.known |= {file}
            now_ns = self._clock_ns()
            facts = {"folder": file.folder, "name": file.name, "fetch_ms": (now_ns - began_ns) / 1e6}
            arrival = Arrival(
                None, true_name(file.name, os.pread(fetched.blob.fd, 65536, 0)), fetched.blob, now_ns, facts
            )
            books.settings_due_ns = now_ns + _ns(_SETTINGS_S)
            if makes_pairs(books.settings) and books.pairs.holds_back(file, arrival, fetched.taken_s):
                continue
            self._deliver(file, arrival, fetched.taken_s)

    def _retry(self, file: CameraFile, reason: str) -> None:
        books = self._books
        books.tries[file] = books.tries.get(file, 0) + 1
        if books.tries[file] < _TRIES and not file.in_memory:
            books.to_fetch.append(file)
            return
        del books.tries[file]
        if books.known is not None:
            books.known |= {file}
        if books.flight and books.flight.fired_ns is not None:
            stays = "" if file.in_memory else f"; it stays on the card as {file.folder}/{file.name}"
            self._end_flight(f"{reason}{stays}")

    def _deliver(self, file: CameraFile, arrival: Arrival, taken_s: int | None) -> None:
        """Say whose file it is, and close it: a frame, or the companion of the frame before."""
        try:
            main = self._books.pairs.main_of(file)
            if main is not None:
                self._tell(Companion(main, arrival.name, arrival.blob, arrival.monotonic_ns, arrival.facts))
                return
            shot = self._deliver_frame(arrival, taken_s)
        finally:
            arrival.blob.close()
        for companion in self._books.pairs.delivered(file, shot):
            self._deliver(*companion)

    def _deliver_frame(self, arrival: Arrival, taken_s: int | None) -> int | None:
        books, flight = self._books, self._books.flight
        current = None if flight is None or flight.fired_ns is None else Claim(flight.shot, flight.fired_ns)
        verdict = attribute(books.late, current, taken_s, books.clock)
        if current is not None and verdict.shot == current.shot:
            books.flight = None
            if taken_s is not None and not books.late:
                books.clock = books.clock.learnt(current, taken_s)
        left = [] if verdict.doubt else [claim for claim in books.late if claim.shot != verdict.shot]
        books.late = deque(left, LATE)  # files come in order: after one in doubt none of the older is expected
        facts = {**arrival.facts, **({"doubt": verdict.doubt} if verdict.doubt else {})}
        facts["body_offsets_s"] = list(books.clock.offsets_s)
        self._tell(Arrival(verdict.shot, arrival.name, arrival.blob, arrival.monotonic_ns, facts))
        return verdict.shot

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
            self._tell(SettingsChanged(found, self._clock_ns()))

    def _change(self, name: SettingName, value: str) -> None:
        books = self._books
        reason = "there is no camera to set"
        try:
            if books.session is not None:
                books.session.change(name, value)
                self._drain(books.session)  # the camera tells what it made of it
                books.settings = books.session.settings()
                self._tell(SettingsChanged(books.settings, self._clock_ns()))
                return
        except (BusyError, RefusedError) as error:
            reason = str(error)
        except LostError as error:
            reason = str(error)
            self._lose(reason)
        self._tell(SettingsChanged(books.settings, self._clock_ns(), f"{name} was not set to {value}: {reason}"))

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

    def _look(self) -> None:
        """Search the card. libgphoto2 remembers its listings, so only a new session sees what is new."""
        books = self._books
        if books.session is None or books.flight is None:
            return
        books.session.close()
        books.session = None
        self._open()
        books.flight.looked_ns = self._clock_ns()

    def _bound_flight(self) -> None:
        flight = self._books.flight
        if flight is None:
            return
        now_ns, limit_s = self._clock_ns(), self._timeouts.file_s
        if now_ns - (flight.fired_ns or flight.since_ns) > _ns(limit_s):
            self._end_flight(f"no file came from the camera within {limit_s:g} s of the release", may_come=True)
        elif flight.complete_ns is not None and flight.looked_ns is not None:
            searched = self._books.session is not None and not self._books.to_fetch
            if searched and now_ns - flight.looked_ns > _ns(self._timeouts.complete_s):
                self._end_flight(
                    "the camera finished without a file: perhaps it found no focus; look at it and its card"
                )

    def _refuse_waiting(self) -> None:
        """Without a camera, and without a shot that is still hoped for, nobody waits."""
        books = self._books
        if books.session is None and books.flight is None:
            reason = books.state[1] if books.state else ""
            while books.waiting:
                self._fail(books.waiting.popleft(), reason)

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
            self._end_flight(reason)
        self._show("faulted", reason)

    # --- telling

    def _end_flight(self, reason: str, *, may_come: bool = False) -> None:
        """The shot at the camera has failed; `may_come`: its file may still come."""
        flight, self._books.flight = self._books.flight, None
        if flight is not None:
            if may_come and flight.fired_ns is not None:
                self._books.late.append(Claim(flight.shot, flight.fired_ns))
            self._fail(flight.shot, reason)

    def _fail(self, shot: int, reason: str) -> None:
        self._tell(ShotFailed(shot, reason, self._clock_ns()))

    def _show(self, state: State, reason: str = "") -> None:
        books = self._books
        if books.state == (state, reason):
            return
        books.state = (state, reason)
        identity = books.session.identity if books.session is not None else None
        self._tell(StateChanged(state, reason, self._clock_ns(), identity))

    def _tell(self, event: Event) -> None:
        message = event_message(event)
        self._channel.send(message.body, message.fds, timeout_s=_SEND_S)

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


def _quiet_library() -> None:
    """libgphoto2 writes to file descriptor 2 whenever a link breaks; our own errors keep the real one."""
    sys.stderr = os.fdopen(os.dup(2), "w", buffering=1)
    null = os.open(os.devnull, os.O_WRONLY)
    os.dup2(null, 2)
    os.close(null)


def main() -> None:
    """Arguments: the socket's descriptor, the parent's process id, settings and `Before` as JSON."""
    fd, parent, settings, before = sys.argv[1:]
    die_with_parent(int(parent))
    raise_priority()
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # ctrl-C reaches the whole group; the parent ends us
    _quiet_library()
    channel = Channel(socket.socket(fileno=int(fd)))
    try:
        CameraLoop(channel, parse_settings(json.loads(settings)), before=Before.of_json(json.loads(before))).run()
    except ChannelError:
        sys.exit(0)  # the parent is gone, or closed the channel


if __name__ == "__main__":
    main()
