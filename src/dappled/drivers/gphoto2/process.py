"""Run the camera's own process: commands in, events out, with libgphoto2 in one long session between them.

libgphoto2 blocks for seconds, with the GIL held, when a camera goes silent. In this process that stalls nothing else,
and the parent can always kill it.

Commands: {"do": "fire", "shot": n}, {"do": "delete", "folder", "name"}, {"do": "change", "name", "value"},
{"do": "look"} (through the viewfinder), {"do": "receive", "folder"} (on the disk of this folder, from now on),
{"do": "ping"}, {"do": "stop"}. Answers are the camera's events (`messages`),
{"is": "live"} with a JPEG or a reason, {"is": "cut off"} with the files that were announced and not brought when the
link broke, and {"is": "pong"}. One shot is at the camera at a time; further ones wait in order.
"""

from __future__ import annotations

import contextlib
import os
import signal
import socket
import sys
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any, cast

from dappled import codec
from dappled.clock import Clock, SystemClock
from dappled.drivers.attribution import true_name
from dappled.drivers.camera import Arrival, BodyState, SettingName, SettingsChanged, ShotFailed, StateChanged
from dappled.drivers.child_process import (
    ChannelError,
    ProcessChannel,
    die_with_parent,
    raise_priority,
    usual_priority,
)
from dappled.drivers.gphoto2.intake import Intake
from dappled.drivers.gphoto2.messages import Carryover, EventSender
from dappled.drivers.gphoto2.protocol import (
    AbsentError,
    BusyError,
    CameraFile,
    CaptureComplete,
    FileAdded,
    LostError,
    NotOnBusError,
    RefusedError,
    Session,
    SessionError,
    SettingTurned,
    bus_nodes,
)
from dappled.drivers.gphoto2.session import open_session
from dappled.drivers.gphoto2.settings import GPhoto2Settings
from dappled.drivers.gphoto2.state import CameraState
from dappled.drivers.gphoto2.viewfinder import Viewfinder
from dappled.shown import guard_output

_POLL_BUSY_S = 0.005
_POLL_IDLE_S = 0.3
_REOPEN_S = 0.25
_SURE_NS = 15 * 10**9
"""Looking for a camera loads all of libgphoto2's drivers: so often where the bus is as it was when there was none."""
_SETTLED_NS = 5 * 10**9
"""So long after a change of the bus something that is there may not be found yet."""
_LAST_TRIES = 3
_HEAD_BYTES = 65536
_QUIET_S = 5.0
"""A card is listed anew only when the camera had nothing to do for so long: that takes a new session."""


class CameraLoop:
    """Obey commands and report what the camera does. `step` does what is due and waits for the next command."""

    def __init__(
        self,
        channel: ProcessChannel,
        settings: GPhoto2Settings,
        open_camera: Callable[[GPhoto2Settings, str | None], Session] = open_session,
        clock: Clock | None = None,
        carryover: Carryover | None = None,
        *,
        bus: Callable[[], object] = bus_nodes,
        intake: Intake | None = None,
    ) -> None:
        """`bus` tells what is on USB: while that is the same, a camera that was not there is rarely looked for."""
        self._channel = channel
        self._settings = settings
        self._open_camera = open_camera
        self._clock = clock or SystemClock()
        self._sender = EventSender(channel)
        self._state = CameraState(settings.timeouts, carryover or Carryover())
        self._viewfinder = Viewfinder(channel)
        self._intake = intake or Intake(self._clock)
        self._session: Session | None = None
        self._keeps_files = settings.capture_target == "card"
        self._open_at_ns = self._sure_until_ns = self._settled_ns = 0
        self._bus = bus if "ptpip:" not in (settings.port or "") else object  # a network doesn't tell: never the same
        self._bus_then = self._bus()

    def run(self) -> None:
        """Step until a stop command comes, or until the parent is gone (ChannelError)."""
        try:
            while self.step():
                pass
            self._look_last()
        finally:
            if self._session is not None:
                self._session.close()

    def step(self) -> bool:
        """Take one turn. False after a stop command. Raises ChannelError when the parent is gone."""
        timeout_s = self._patience_s()
        while (message := self._channel.receive(timeout_s)) is not None:
            if not self._obey(message.body):
                return False
            timeout_s = 0.0
        try:
            self._work()
        except LostError as error:
            self._lose(str(error))
        self._sender.send(*self._state.fail_overdue(self._now_ns(), is_open=self._session is not None))
        if self._is_away and self._state.current is None:
            self._sender.send(*self._state.fail_waiting(self._sender.reason, self._now_ns()))
        return True

    def _look_last(self) -> None:
        """Name the pictures that stay on the card."""
        if not self._keeps_files:
            return
        for _ in range(0 if self._session is None else _LAST_TRIES):  # the body may still be closing
            if self._session is not None:
                self._session.close()
                self._session = None
            with contextlib.suppress(SessionError):
                with usual_priority():
                    self._session = self._open_camera(self._settings, self._state.serial)
                if self._session.identity.serial == self._state.serial:
                    self._sender.send(*self._state.left(self._session.contents(), self._now_ns()))
                    return
        self._sender.send(*self._state.not_listed(self._now_ns()))

    def _patience_s(self) -> float:
        """Return how long to wait for a command before the camera is polled again."""
        if self._session is None:
            return min(max((self._open_at_ns - self._now_ns()) / 1e9, 0.0), _POLL_IDLE_S)
        if self._state.has_work:
            return 0.0
        return _POLL_BUSY_S if self._state.current is not None else _POLL_IDLE_S

    def _now_ns(self) -> int:
        return self._clock.monotonic_ns()

    @property
    def _is_away(self) -> bool:
        """Whether there is no camera, and that was said."""
        return self._session is None and self._sender.state not in ("ready", "busy")

    def _send_state(self, state: BodyState, reason: str = "") -> None:
        identity = None if self._session is None else self._session.identity
        self._sender.send(StateChanged(state, reason, self._now_ns(), identity))

    # --- commands

    def _obey(self, command: Mapping[str, Any]) -> bool:
        match command:
            case {"do": "fire", "shot": int(shot)}:
                self._take(shot)
            case {"do": "delete", "folder": str(folder), "name": str(name)}:
                self._delete(CameraFile(folder, name))
            case {"do": "change", "name": str(name), "value": str(value)}:
                self._change(cast(SettingName, name), value)
            case {"do": "look"}:
                self._viewfinder.ask()
            case {"do": "receive", "folder": str(folder)}:
                self._intake.folder = Path(folder)
            case {"do": "ping"}:
                self._sender.pong()
            case {"do": "stop"}:
                return False
            case _:
                raise ChannelError(f"unknown command {command!r}")
        return True

    def _take(self, shot: int) -> None:
        if self._is_away and self._state.current is None:
            reason = f"there is no camera to fire: {self._sender.reason or 'it is still being opened'}"
            self._sender.send(ShotFailed(shot, reason, self._now_ns()))
        else:
            self._sender.send(*self._state.accept(shot, self._now_ns()))

    def _delete(self, file: CameraFile) -> None:
        if self._session is None:
            return  # the file stays on the card, and nothing is lost
        try:
            self._session.delete(file)
        except RefusedError:
            return  # as above
        except LostError as error:
            self._lose(str(error))
        else:
            self._state.deleted(file)

    def _change(self, name: SettingName, value: str) -> None:
        reason = "there is no camera to set"
        try:
            if self._session is not None:
                self._session.change(name, value)
                self._listen(self._session)  # libgphoto2 reads a changed setting only after the body's event
                self._sender.send(*self._state.settings_set(self._session.settings(), self._now_ns()))
                return
        except (BusyError, RefusedError) as error:
            reason = str(error)
        except LostError as error:
            reason = str(error)
            self._lose(reason)
        refused = f"{name} was not set to {value}: {reason}"
        self._sender.send(SettingsChanged(self._state.settings, self._now_ns(), refused))

    # --- the camera

    def _work(self) -> None:
        if self._session is None and self._now_ns() >= self._open_at_ns:
            self._open()
        session = self._session
        if session is None:
            self._viewfinder.refuse(self._sender.reason or "the camera is still being opened")
            return
        if self._state.is_busy:
            self._viewfinder.end(session)
        if self._state.begin_next(self._now_ns()):
            self._send_state("busy")
        if self._state.trigger_due(self._now_ns()):
            self._trigger(session)
        self._listen(session)
        if not self._state.is_stale:
            self._fetch(session)
        searches = self._state.search_due(self._now_ns())
        lists = self._state.is_stale or self._state.list_due(self._now_ns(), _QUIET_S)
        if session.keeps_files and (searches or lists):
            # libgphoto2 remembers its listings: only a new session sees new files.
            session.close()
            self._session = None
            self._open(quiet=not searches)
            if searches:
                self._state.searched(self._now_ns())
            session = self._session
            if session is None:
                return
        if self._state.settings_due(self._now_ns()):
            self._sender.send(*self._state.settings_read(session.settings(), self._now_ns()))
        self._send_state("busy" if self._state.is_busy else "ready")
        if not self._state.is_busy:
            self._viewfinder.turn(session, self._now_ns())

    def _open(self, *, quiet: bool = False) -> None:
        """Open the camera. `quiet`: it was there just now; if it can't be opened, that is said of the next attempt."""
        bus, now_ns = self._bus(), self._now_ns()
        if self._is_away and bus == self._bus_then and now_ns < self._sure_until_ns:
            self._open_at_ns = now_ns + round(self._settings.timeouts.retry_s * 1e9)
            return
        if bus != self._bus_then:
            self._settled_ns = now_ns + _SETTLED_NS
        self._bus_then, self._sure_until_ns = bus, 0
        if self._sender.state is None:
            self._send_state("starting")
        try:
            with usual_priority():  # libgphoto2 loads all of its drivers to look at the bus
                session = self._open_camera(self._settings, self._state.serial)
        except SessionError as error:
            if quiet:
                self._open_at_ns = self._now_ns() + round(_REOPEN_S * 1e9)
                return
            self._open_at_ns = self._now_ns() + round(self._settings.timeouts.retry_s * 1e9)
            if isinstance(error, NotOnBusError) and now_ns >= self._settled_ns:
                self._sure_until_ns = self._now_ns() + _SURE_NS
            self._send_state("absent" if isinstance(error, AbsentError) else "faulted", str(error))
            return
        self._session, self._keeps_files = session, session.keeps_files
        self._state.opened(session.identity.serial, self._now_ns())
        if session.keeps_files:
            cut_off = self._state.cut_off
            self._sender.send(*self._state.listed(session.contents(), self._now_ns()))
            if cut_off:
                self._sender.cut_off(())

    def _lose(self, reason: str) -> None:
        """Close a session that is of no use any more."""
        keeps_files = self._session is not None and self._session.keeps_files
        if self._session is not None:
            self._session.close()
            self._session = None
        self._viewfinder.lost(reason)
        self._open_at_ns = self._now_ns() + round(_REOPEN_S * 1e9)
        self._sender.send(*self._state.lost(reason, self._now_ns(), keeps_files=keeps_files))
        self._send_state("faulted", reason)
        if self._state.cut_off:
            self._sender.cut_off(self._state.cut_off)

    def _trigger(self, session: Session) -> None:
        state = self._state
        called_ns = self._now_ns()
        try:
            session.trigger()
        except BusyError as error:
            self._sender.send(*state.trigger_busy(str(error), self._now_ns()))
        except RefusedError as error:
            self._sender.send(*state.fail_current(f"{error}; check focus, card and mode dial", self._now_ns()))
        except LostError as error:
            self._sender.send(*state.trigger_lost(called_ns, str(error), self._now_ns()))
            raise
        else:
            self._sender.send(*state.fired(called_ns, self._now_ns()))

    def _listen(self, session: Session) -> None:
        """Take in what the camera reported since the last time."""
        for news in session.news():
            match news:
                case FileAdded(file):
                    self._state.announced(file, self._now_ns())
                case CaptureComplete():
                    self._state.completed(self._now_ns())
                case SettingTurned():
                    self._state.setting_turned(self._now_ns())
        for file in self._state.to_compare():
            facts = None
            with contextlib.suppress(BusyError, RefusedError):
                facts = session.about(file)
            self._state.compared(file, facts, self._now_ns())

    def _fetch(self, session: Session) -> None:
        """Fetch the files that wait, until one can't be had; then send what waited too long for its pair."""
        while (file := self._state.next_file()) is not None:
            began_ns = self._now_ns()
            try:
                fetched = session.fetch(file, self._intake, self._sender.pong)
            except (BusyError, RefusedError) as error:
                self._sender.send(*self._state.not_fetched(file, str(error), self._now_ns()))
                break
            now_ns = self._now_ns()
            facts: dict[str, str | float | None] = {"folder": file.folder, "name": file.name}
            facts |= {"fetch_ms": (now_ns - began_ns) / 1e6, "taken_s": fetched.taken_s}
            name = true_name(file.name, os.pread(fetched.blob.fd, _HEAD_BYTES, 0))
            arrival = Arrival(None, name, fetched.blob, now_ns, facts)
            self._sender.send(*self._state.fetched(file, arrival, fetched.taken_s))
        self._sender.send(*self._state.release_held(self._now_ns()))


def _silence_library() -> None:
    """Send file descriptor 2 to /dev/null: libgphoto2 writes there whenever a link breaks. `sys.stderr` still works."""
    sys.stderr = os.fdopen(os.dup(2), "w", buffering=1)
    null = os.open(os.devnull, os.O_WRONLY)
    os.dup2(null, 2)
    os.close(null)


def main() -> None:
    """Arguments: the socket's descriptor, the parent's process id, settings and `Carryover` as JSON."""
    fd, parent, settings, carryover = sys.argv[1:]
    die_with_parent(int(parent))
    raise_priority()
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # ctrl-C reaches the whole group; the parent ends this process
    _silence_library()
    guard_output()
    channel = ProcessChannel(socket.socket(fileno=int(fd)))
    loop = CameraLoop(
        channel,
        codec.read_json(GPhoto2Settings, settings),
        carryover=codec.read_json(Carryover, carryover),
        intake=Intake(begin_thread=raise_priority),
    )
    try:
        loop.run()
    except ChannelError:
        sys.exit(0)  # the parent is gone, or closed the channel


if __name__ == "__main__":
    main()
