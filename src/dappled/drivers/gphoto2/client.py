"""Drive a camera over USB or PTP/IP through libgphoto2, which runs in a process of its own.

This side never blocks: it passes commands to the process and events to the receiver, kills the process when it stops
answering, and starts it again, at most five times a minute, and once more where something changes on the USB bus.
"""

from __future__ import annotations

import contextlib
import logging
import os
import subprocess
import threading
from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

from dappled import codec, durable
from dappled.clock import Clock, SystemClock
from dappled.drivers.attribution import Claim
from dappled.drivers.camera import (
    Arrival,
    CameraError,
    CameraEvent,
    Companion,
    Fired,
    Identity,
    LivePicture,
    Noticed,
    QueuedCamera,
    Setting,
    SettingName,
    SettingsChanged,
    ShotFailed,
    StateChanged,
    check_change,
)
from dappled.drivers.child_process import (
    ChannelError,
    ChannelMessage,
    ProcessChannel,
    RestartBudget,
    end_child,
    how_ended,
    start_child,
)
from dappled.drivers.gphoto2.messages import CUT_OFF, Carryover, lost_file, message_event
from dappled.drivers.gphoto2.protocol import bus_nodes
from dappled.drivers.gphoto2.settings import NO_HOME, GPhoto2Settings, parse_settings
from dappled.findings import Code, Subject, finding
from dappled.workers import Loop

log = logging.getLogger(__name__)
_PING_S = 1.0
_STOP_S = 1.4
_KILL_S = 0.6
_SPAWN_S = 1.0
_LIVE_S = 2.0
_BUS_S = 0.5

Spawn = Callable[[GPhoto2Settings, Carryover], tuple["subprocess.Popen[bytes]", ProcessChannel]]


def open_camera(settings: Mapping[str, Any]) -> GPhoto2Camera:
    """Make the driver for these settings (see `GPhoto2Settings`). Raises CameraError for a wrong setting."""
    return GPhoto2Camera(parse_settings(settings))


def spawn_process(settings: GPhoto2Settings, carryover: Carryover) -> tuple[subprocess.Popen[bytes], ProcessChannel]:
    """Start the camera's process; it dies with the calling thread. Raises OSError."""
    return start_child(
        "dappled.drivers.gphoto2.process",
        codec.canonical(settings).decode(),
        codec.canonical(carryover).decode(),
        environment=NO_HOME,
    )


@dataclass(frozen=True, slots=True)
class _Live:
    """Live view: when a picture was asked for that has not come, when the last answer came, and what it was."""

    asked_ns: int | None = None
    heard_ns: int = 0
    picture: LivePicture | None = None
    refused: str = ""


class GPhoto2Camera(QueuedCamera):
    """The driver (`drivers.camera.Camera`). `fire`, `release`, `next_event` and `stop` from any thread."""

    def __init__(
        self,
        settings: GPhoto2Settings,
        *,
        spawn: Spawn = spawn_process,
        clock: Clock | None = None,
        budget: RestartBudget | None = None,
        bus: Callable[[], object] = bus_nodes,
    ) -> None:
        super().__init__()
        self._settings = settings
        self._spawn = spawn
        self._clock = clock or SystemClock()
        self._budget = budget or RestartBudget(limit=5, window_s=60.0)
        self._bus = bus
        self._loop = Loop("gphoto2", self._supervise)
        self._lock = threading.Lock()  # guards the next three
        self._channel: ProcessChannel | None = None
        self._process: subprocess.Popen[bytes] | None = None
        self._pending: dict[int, int | None] = {}  # shots that the process has, in order: when it fired each
        self._carryover = Carryover()  # used by the supervising thread alone
        self._live = _Live()  # guarded by the lock
        self.identity: Identity | None = None  # the body that was opened last
        self._known_settings: tuple[Setting, ...] = ()
        self._folder: Path | None = None  # files are written in it while they come; None: to memory
        self._looked_last = False  # the process ended by itself when it was asked to: it has named what stays

    def receive_into(self, folder: Path) -> None:
        """Have files written in this folder while they come, where its file system has files without a name."""
        try:
            os.close(durable.unnamed(folder))
        except OSError as error:
            log.info("the camera's files go to memory first: %s has none without a name (%s)", folder, error.strerror)
        else:
            self._folder = folder.absolute()

    def start(self) -> None:
        """Start the camera's process. Raises CameraError when called twice."""
        if self._loop.begun:
            raise CameraError("this camera was started before: open another one")
        self._loop.start()

    def fire(self, shot: int) -> None:
        """Send the shot to the process: one socket write in the caller's thread."""
        with self._lock:
            if shot in self._pending:
                raise CameraError(f"shot {shot} was fired before and has not ended")
            if self._channel is not None:
                try:
                    self._channel.send({"do": "fire", "shot": shot})
                except ChannelError as error:
                    reason = f"the camera's process did not take the shot: {error}"
                else:
                    self._pending[shot] = None  # not fired yet
                    return
            else:
                reason = "the camera's process is not running"
        self.report(ShotFailed(shot, reason, self._clock.monotonic_ns()))

    def settings(self) -> tuple[Setting, ...]:
        """The settings as last read, from memory; empty while none were read."""
        return self._known_settings

    def change(self, name: SettingName, value: str) -> None:
        """Send the request to the process."""
        check_change(self._known_settings, name, value)
        with self._lock:
            if self._channel is None:
                raise CameraError("the camera's process is not running: nothing can be set now")
            try:
                self._channel.send({"do": "change", "name": name, "value": value})
            except ChannelError as error:
                raise CameraError(f"{name} was not set: {error}") from None

    def look(self) -> LivePicture | None:
        """Return the newest picture of live view, and ask the process for another where no question is on its way."""
        with self._lock:
            if self._channel is None:
                raise CameraError("the camera's process is not running: there is no live view now")
            now_ns, live = self._clock.monotonic_ns(), self._live
            if live.asked_ns is None or now_ns - live.asked_ns > _LIVE_S * 1e9:
                try:
                    self._channel.send({"do": "look"})
                except ChannelError as error:
                    raise CameraError(f"there is no live view now: {error}") from None
                live = self._live = replace(live, asked_ns=now_ns)
            fresh = now_ns - live.heard_ns <= _LIVE_S * 1e9
            if live.refused and fresh:
                raise CameraError(live.refused)
            return live.picture if fresh else None

    def release(self, arrival: Arrival | Companion) -> None:
        """Delete the file from the card where the settings say so."""
        folder = arrival.facts.get("folder")
        if not self._settings.delete_after_download or folder in (None, "/"):
            return
        with self._lock, contextlib.suppress(ChannelError):  # the file then stays on the card
            if self._channel is not None:
                self._channel.send({"do": "delete", "folder": folder, "name": arrival.facts["name"]})

    def stop(self) -> None:
        """Ask the process to end, which lists the card once more, and kill it after 1.4 s. Shots that had not ended
        fail."""
        stopped_before = self._loop.stopping.is_set()
        self._loop.stopping.set()
        with self._lock, contextlib.suppress(ChannelError):  # it is killed below
            if self._channel is not None:
                self._channel.send({"do": "stop"})
        ended = self._loop.stop(_STOP_S)
        with self._lock:
            if not ended and self._process is not None:
                self._process.kill()
        listed = (ended and self._looked_last) or self.identity is None or self._settings.capture_target != "card"
        if not listed and not stopped_before:
            self.report(Noticed(finding(Code.CARD_NOT_LISTED, Subject("card")), self._clock.monotonic_ns()))
        self._loop.stop(_KILL_S)

    def dead_threads(self) -> list[str]:
        """The thread's name where it has ended without having been stopped: never, unless there is a bug."""
        return self._loop.dead_threads()

    # --- the supervising thread

    def _supervise(self) -> None:
        while not self._loop.stopping.is_set():
            try:
                process, channel = self._spawn(self._settings, self._carryover)
            except OSError as error:  # no memory, no descriptors: may pass
                reason = f"the camera's process can't be started: {error.strerror}"
                self.report(StateChanged("faulted", reason, self._clock.monotonic_ns()))
                self._loop.stopping.wait(_SPAWN_S)
                continue
            with self._lock:
                self._process, self._channel = process, channel
                if self._folder is not None:
                    _tell(channel, "receive", folder=str(self._folder))
            reason = self._serve(process, channel)
            with self._lock:
                self._process = self._channel = None
                pending, self._pending = self._pending, {}
            fired = [Claim(shot, fired_ns) for shot, fired_ns in pending.items() if fired_ns is not None]
            self._carryover = self._carryover.died(fired)
            channel.close()
            end_child(process)
            reason = (
                reason or f"the camera's process ended unexpectedly ({how_ended(process.returncode)}); it starts again"
            )
            stopped = self._loop.stopping.is_set()
            self._looked_last = stopped and process.returncode == 0
            for shot in pending:
                self.report(
                    ShotFailed(shot, "the camera was stopped" if stopped else reason, self._clock.monotonic_ns())
                )
            if not stopped:
                self.report(StateChanged("faulted", reason, self._clock.monotonic_ns()))
                self._await_budget()
        self.report(StateChanged("absent", "the camera was stopped", self._clock.monotonic_ns()))

    def _serve(self, process: subprocess.Popen[bytes], channel: ProcessChannel) -> str:
        """Pass events on until the process ends; return why it was ended, as a sentence; "" where it ended by
        itself."""
        heard_ns = asked_ns = self._clock.monotonic_ns()
        answer_s = self._settings.timeouts.answer_s
        try:
            while True:
                if self._loop.stopping.is_set():
                    _tell(channel, "stop")  # again: the process may have begun after `stop` sent it
                message = channel.receive(_PING_S)
                now_ns = self._clock.monotonic_ns()
                if message is not None:
                    heard_ns = now_ns
                    if message.lost:
                        self._lose_file(message)
                    elif message.body.get("is") == "live":
                        self._show(message)
                    elif message.body.get("is") == CUT_OFF:
                        self._carryover = self._carryover.cut(message.body)
                    elif message.body.get("is") != "pong":
                        self._pass_on(message_event(message))
                elif channel.starved:
                    heard_ns = now_ns  # the process has answered; this one can't receive it yet
                elif now_ns - heard_ns > answer_s * 1e9:
                    end_child(process, 0.0)
                    done = self._reset_port()
                    return (
                        f"the camera's process did not answer for {answer_s:g} s and was killed{done}; it starts again"
                    )
                if now_ns - asked_ns > _PING_S * 1e9:
                    asked_ns = now_ns
                    _tell(channel, "ping")
        except ChannelError:
            return ""

    def _reset_port(self) -> str:
        """Reset a silent body on USB, as if its cable had been pulled; return words on the result."""
        if self.identity is None or not self.identity.port.startswith("usb:"):
            return ""
        from dappled.drivers import usb_bus  # noqa: PLC0415  # see `daemon.after_ready`

        try:
            usb_bus.reset(self.identity.port)
        except CameraError as error:
            return f" ({error})"
        return ", the camera's USB port reset"

    def _show(self, message: ChannelMessage) -> None:
        """Take in a picture of the viewfinder, or why there is none."""
        now_ns, picture = self._clock.monotonic_ns(), None
        for fd in message.fds:
            picture = LivePicture(os.pread(fd, message.body["size"], 0), now_ns)
            os.close(fd)
        with self._lock:
            self._live = _Live(None, now_ns, picture, message.body.get("refused", ""))

    def _lose_file(self, message: ChannelMessage) -> None:
        """Fail the shot whose file could not be received, alone."""
        shot, reason = lost_file(message)
        if shot is None:
            log.warning("%s", reason)
        else:
            self._pass_on(ShotFailed(shot, reason, self._clock.monotonic_ns()))

    def _pass_on(self, event: CameraEvent) -> None:
        if isinstance(event, Fired):
            with self._lock:
                self._pending[event.shot] = event.called_monotonic_ns
        elif isinstance(event, ShotFailed) or (isinstance(event, Arrival) and event.shot is not None):
            with self._lock:
                self._pending.pop(event.shot, None)  # type: ignore[arg-type]  # an Arrival's None is excluded above
        elif isinstance(event, StateChanged):
            self.identity = event.identity or self.identity
        elif isinstance(event, SettingsChanged):
            self._known_settings = event.settings
        self._carryover = self._carryover.heard(event)
        self.report(event)

    def _await_budget(self) -> None:
        now_ns = self._clock.monotonic_ns()
        wait_ns = self._budget.wait_ns(now_ns)
        if wait_ns:
            reason = f"the camera's process ended too often; the next attempt is in {wait_ns / 1e9:.0f} s"
            bus, end_ns = self._bus(), now_ns + wait_ns
            self.report(StateChanged("faulted", reason, now_ns))
            while self._bus() == bus and self._clock.monotonic_ns() < end_ns:
                if self._loop.stopping.wait(_BUS_S):
                    break
        self._budget.spend(self._clock.monotonic_ns())


def _tell(channel: ProcessChannel, what: str, **more: str) -> None:
    """Send a command. Where the process is gone, `receive` says so, after all that it had said before."""
    with contextlib.suppress(ChannelError):
        channel.send({"do": what, **more})
