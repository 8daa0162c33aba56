"""Run the camera's own process: commands in, events out, with libgphoto2 in one long session between them.

libgphoto2 blocks for seconds, with the GIL held, when a camera goes silent. In this process that stalls nothing else,
and the parent can always kill it.

Commands: {"do": "fire", "shot": n}, {"do": "delete", "folder", "name"}, {"do": "change", "name", "value"},
{"do": "look"} (through the viewfinder), {"do": "ping"}, {"do": "stop"}. Answers are the camera's events (`messages`),
{"is": "live"} with a JPEG or a reason, and {"is": "pong"}. One shot is at the camera at a time; further ones wait in
order.
"""

from __future__ import annotations

import json
import os
import signal
import socket
import sys
from collections.abc import Callable, Mapping
from typing import Any, cast

from dappled.clock import Clock, SystemClock
from dappled.drivers.attribution import true_name
from dappled.drivers.camera import Arrival, BodyState, SettingName, SettingsChanged, ShotFailed, StateChanged
from dappled.drivers.child_process import ChannelError, ProcessChannel, die_with_parent, raise_priority
from dappled.drivers.gphoto2.messages import Carryover, EventSender
from dappled.drivers.gphoto2.protocol import (
    AbsentError,
    BusyError,
    CameraFile,
    CaptureComplete,
    FileAdded,
    LostError,
    RefusedError,
    Session,
    SessionError,
    SettingTurned,
)
from dappled.drivers.gphoto2.session import open_session
from dappled.drivers.gphoto2.settings import GPhoto2Settings, parse_settings
from dappled.drivers.gphoto2.state import CameraState
from dappled.drivers.gphoto2.viewfinder import Viewfinder

_POLL_BUSY_S = 0.005
_POLL_IDLE_S = 0.3
_REOPEN_S = 0.25
_HEAD_BYTES = 65536


class CameraLoop:
    """Obey commands and report what the camera does. `step` does what is due and waits for the next command."""

    def __init__(
        self,
        channel: ProcessChannel,
        settings: GPhoto2Settings,
        open_camera: Callable[[GPhoto2Settings, str | None], Session] = open_session,
        clock: Clock | None = None,
        carryover: Carryover | None = None,
    ) -> None:
        self._channel = channel
        self._settings = settings
        self._open_camera = open_camera
        self._clock = clock or SystemClock()
        self._sender = EventSender(channel)
        self._state = CameraState(settings.timeouts, carryover or Carryover())
        self._viewfinder = Viewfinder(channel)
        self._session: Session | None = None
        self._open_at_ns = 0

    def run(self) -> None:
        """Step until a stop command comes, or until the parent is gone (ChannelError)."""
        try:
            while self.step():
                pass
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
        if self._session is None and self._state.current is None:
            self._sender.send(*self._state.fail_waiting(self._sender.reason, self._now_ns()))
        return True

    def _patience_s(self) -> float:
        """Return how long to wait for a command before the camera is polled again."""
        if self._session is None:
            return min(max((self._open_at_ns - self._now_ns()) / 1e9, 0.0), _POLL_IDLE_S)
        if self._state.has_work:
            return 0.0
        return _POLL_BUSY_S if self._state.current is not None else _POLL_IDLE_S

    def _now_ns(self) -> int:
        return self._clock.monotonic_ns()

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
            case {"do": "ping"}:
                self._sender.pong()
            case {"do": "stop"}:
                return False
            case _:
                raise ChannelError(f"unknown command {command!r}")
        return True

    def _take(self, shot: int) -> None:
        if self._session is None and self._state.current is None:
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
        self._fetch(session)
        if session.keeps_files and self._state.search_due(self._now_ns()):
            # libgphoto2 remembers its listings: only a new session sees new files.
            session.close()
            self._session = None
            self._open()
            self._state.searched(self._now_ns())
            session = self._session
            if session is None:
                return
        if self._state.settings_due(self._now_ns()):
            self._sender.send(*self._state.settings_read(session.settings(), self._now_ns()))
        self._send_state("busy" if self._state.is_busy else "ready")
        if not self._state.is_busy:
            self._viewfinder.turn(session, self._now_ns())

    def _open(self) -> None:
        if self._sender.state is None:
            self._send_state("starting")
        try:
            session = self._open_camera(self._settings, self._state.serial)
        except SessionError as error:
            self._open_at_ns = self._now_ns() + round(self._settings.timeouts.retry_s * 1e9)
            self._send_state("absent" if isinstance(error, AbsentError) else "faulted", str(error))
            return
        self._session = session
        self._state.opened(session.identity.serial, self._now_ns())
        if session.keeps_files:
            found = session.files()
            taken_s = {file: session.taken_s(file) for file in self._state.to_identify(found)}
            self._state.listed(found, taken_s)

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
                    self._state.announced(file)
                case CaptureComplete():
                    self._state.completed(self._now_ns())
                case SettingTurned():
                    self._state.setting_turned(self._now_ns())

    def _fetch(self, session: Session) -> None:
        """Fetch the files that wait, until one can't be had; then send what waited too long for its pair."""
        while (file := self._state.next_file()) is not None:
            began_ns = self._now_ns()
            try:
                fetched = session.fetch(file)
            except (BusyError, RefusedError) as error:
                self._sender.send(*self._state.not_fetched(file, str(error), self._now_ns()))
                break
            now_ns = self._now_ns()
            facts = {"folder": file.folder, "name": file.name, "fetch_ms": (now_ns - began_ns) / 1e6}
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
    channel = ProcessChannel(socket.socket(fileno=int(fd)))
    loop = CameraLoop(channel, parse_settings(json.loads(settings)), carryover=Carryover.of_json(json.loads(carryover)))
    try:
        loop.run()
    except ChannelError:
        sys.exit(0)  # the parent is gone, or closed the channel


if __name__ == "__main__":
    main()
