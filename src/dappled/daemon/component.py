"""The MAVLink camera (Camera Protocol v2): hears commands, answers at once, tells how shots ended.

`on_packet` runs in a link's receiving thread and only answers from memory; what may touch a disk (an old image looked
up by index) waits for `tick`, which the daemon's working loop calls: no working loop, no heartbeat.
"""

from __future__ import annotations

import math
import threading
from collections import deque
from collections.abc import Callable
from dataclasses import dataclass
from typing import Protocol

from dappled.daemon import camera_messages
from dappled.daemon.camera_messages import CameraFacts, Captured, Storage
from dappled.daemon.clock import Clock
from dappled.daemon.identity import Identity
from dappled.daemon.shutter import Shutter, Verdict, Wish
from dappled.drivers.mavlink import Message, Packet, mavlink

__all__ = ["CameraFacts", "Captured", "Component", "Storage"]

HEARTBEAT_NS = 10**9
TIMESYNC_NS = 200_000_000
STREAMS_NS = 5 * 10**9
COPY_NS = 500_000_000
STREAMS = (  # what poses need from the autopilot: message, interval in microseconds
    (mavlink.MAVLINK_MSG_ID_GLOBAL_POSITION_INT, 20_000),
    (mavlink.MAVLINK_MSG_ID_ATTITUDE_QUATERNION, 20_000),
    (mavlink.MAVLINK_MSG_ID_GPS_RAW_INT, 200_000),
    (mavlink.MAVLINK_MSG_ID_SYSTEM_TIME, 1_000_000),
)
_TICK_S = 0.02
_OLD_IMAGES = 256
_OLD_IMAGES_A_TICK = 2

ACCEPTED = mavlink.MAV_RESULT_ACCEPTED
DENIED = mavlink.MAV_RESULT_DENIED
UNSUPPORTED = mavlink.MAV_RESULT_UNSUPPORTED
REJECTED = mavlink.MAV_RESULT_TEMPORARILY_REJECTED


class Links(Protocol):
    """What the component needs of `drivers.mavlink.MavlinkLinks`."""

    system_id: int
    component_id: int

    def send(self, message: Message, link: int | None = None) -> bool: ...


@dataclass(frozen=True, slots=True)
class Command:
    """A COMMAND_LONG or COMMAND_INT to us. Parameters may be NaN."""

    name: int
    parameters: tuple[float, ...]
    confirmation: int
    system: int
    component: int
    link: int
    broadcast: bool

    def number(self, place: int, default: float = 0.0) -> float:
        """Parameter 1 to 7; the default for NaN and infinities."""
        value = self.parameters[place - 1]
        return value if math.isfinite(value) else default

    def whole(self, place: int, default: int = 0) -> int:
        """Parameter 1 to 7 as an integer; the default where it is not finite."""
        return round(self.number(place, float(default)))

    @property
    def source(self) -> str:
        """The sender, as causes name it."""
        return f"mavlink:{self.system}/{self.component}"


@dataclass(frozen=True, slots=True)
class _Answer:
    """The result of a command, and what is to be said after the acknowledgement."""

    result: int
    then: tuple[Message, ...] = ()
    words: str | None = None


class Component:
    """One camera on all links. Give the shutter `on_change=component.state_changed`, so that 262 follows each change.

    `facts()`, `storage()` and `healthy()` answer from memory; `lookup(index)` may read a disk and tells how an old
    shot ended, None for one that never was. `reset_log`, where given, makes the image count begin anew (recorded
    flights stay); without it formatting is denied. `healthy()` False: no heartbeat.
    """

    def __init__(
        self,
        links: Links,
        shutter: Shutter,
        clock: Clock,
        *,
        facts: Callable[[], CameraFacts],
        storage: Callable[[], Storage | None],
        lookup: Callable[[int], Captured | None],
        healthy: Callable[[], bool] = lambda: True,
        reset_log: Callable[[], None] | None = None,
    ) -> None:
        self._links = links
        self._shutter = shutter
        self._clock = clock
        self._facts = facts
        self._storage = storage
        self._lookup = lookup
        self._healthy = healthy
        self._reset_log = reset_log
        self._start_ns = clock.monotonic_ns()
        self._identity = Identity(links.system_id, self._start_ns)
        self._mode = mavlink.CAMERA_MODE_IMAGE
        self._lock = threading.Lock()
        self._due_ns = {"heartbeat": 0, "timesync": 0, "streams": 0}
        self._heard_streams: dict[int, int] = {}
        self._intervals: dict[int, tuple[int, int]] = {}  # message id: (interval_ns, due_ns)
        self._old_images: deque[tuple[int, int]] = deque(maxlen=_OLD_IMAGES)
        self._broadcasts: dict[bytes, int] = {}
        self._status_due = threading.Event()
        self._stop = threading.Event()
        self._thread = threading.Thread(target=self._run, name="mavlink camera", daemon=True)

    @property
    def system_id(self) -> int:
        """The system that the camera belongs to, as far as decided."""
        return self._identity.system_id

    def start(self) -> None:
        """Tick every 20 ms in a thread of its own, for a daemon that has no loop to call `tick` from."""
        self._thread.start()

    def stop(self) -> None:
        """End that thread."""
        self._stop.set()
        if self._thread.is_alive() and self._thread is not threading.current_thread():
            self._thread.join(2.0)

    def on_packet(self, packet: Packet) -> None:
        """A packet was received (sent ones are ignored). Quick; never raises for what a message says."""
        message = packet.message
        if packet.sent or message.get_srcSystem() == 0:
            return
        if (message.get_srcSystem(), message.get_srcComponent()) == (self._links.system_id, self._links.component_id):
            return  # our own packet, come back over another link
        name = message.get_type()
        if name in ("COMMAND_LONG", "COMMAND_INT"):
            command = self._command(message, packet.link)
            if command is not None and not (command.broadcast and self._is_copy(packet)):
                self._answer(command)
        elif name == "CAMERA_TRIGGER":
            self._trigger(message, packet.link)
        elif name == "HEARTBEAT":
            self._identity.heard(message, packet.link, self._clock.monotonic_ns())
        elif message.get_srcSystem() == self._identity.system_id:
            number = message.get_msgId()
            self._heard_streams[number] = self._heard_streams.get(number, 0) + 1

    def announce(self, captured: Captured) -> None:
        """A shot ended, its frame safe or lost: tell everybody, once."""
        self._links.send(camera_messages.image_captured(captured, self._boot_ms()))
        self.state_changed()

    def state_changed(self) -> None:
        """What CAMERA_CAPTURE_STATUS says may have changed: push it with the next tick."""
        self._status_due.set()

    def say(self, text: str, severity: int = mavlink.MAV_SEVERITY_WARNING) -> None:
        """A line for the pilot (STATUSTEXT, cut at 50 bytes)."""
        self._links.send(mavlink.MAVLink_statustext_message(severity, text.encode()[:50]))

    def tick(self) -> None:
        """What is due by now: heartbeat, time requests, stream requests, status, periodic messages, old images."""
        now_ns = self._clock.monotonic_ns()
        if not self._identity.decide(now_ns):
            return
        self._links.system_id = self._identity.system_id
        if self._due("heartbeat", HEARTBEAT_NS, now_ns) and self._healthy():
            self._links.send(
                mavlink.MAVLink_heartbeat_message(
                    mavlink.MAV_TYPE_CAMERA, mavlink.MAV_AUTOPILOT_INVALID, 0, 0, mavlink.MAV_STATE_ACTIVE, 3
                )
            )
        autopilot = self._identity.autopilot()
        if autopilot is not None:
            if self._due("timesync", TIMESYNC_NS, now_ns):
                self._links.send(mavlink.MAVLink_timesync_message(0, self._clock.utc_ns()), autopilot[1])
            if self._due("streams", STREAMS_NS, now_ns):
                self._ask_for_streams(*autopilot)
        if self._status_due.is_set():
            self._status_due.clear()
            self._links.send(self._status())
        self._send_periodic(now_ns)
        self._send_old_images()

    def _run(self) -> None:
        while not self._stop.is_set():
            self.tick()
            self._clock.wait(self._stop, _TICK_S)

    def _due(self, what: str, period_ns: int, now_ns: int) -> bool:
        if now_ns < self._due_ns[what]:
            return False
        on_time_ns = self._due_ns[what] + period_ns
        self._due_ns[what] = on_time_ns if on_time_ns > now_ns else now_ns + period_ns
        return True

    def _ask_for_streams(self, system: int, link: int) -> None:
        """Ask for each stream that came at less than half its rate since the last look."""
        heard, self._heard_streams = self._heard_streams, {}
        for message_id, interval_us in STREAMS:
            if heard.get(message_id, 0) < STREAMS_NS / (interval_us * 1e3) / 2:
                self._links.send(
                    mavlink.MAVLink_command_long_message(
                        system, 1, mavlink.MAV_CMD_SET_MESSAGE_INTERVAL, 0, message_id, interval_us, 0, 0, 0, 0, 0
                    ),
                    link,
                )

    def _send_periodic(self, now_ns: int) -> None:
        with self._lock:
            due = [number for number, (_, due_ns) in self._intervals.items() if now_ns >= due_ns]
            for number in due:
                interval_ns = self._intervals[number][0]
                self._intervals[number] = (interval_ns, now_ns + interval_ns)
        for number in due:
            self._links.send(_MESSAGES[number](self))

    def _send_old_images(self) -> None:
        for _ in range(min(_OLD_IMAGES_A_TICK, len(self._old_images))):  # each may open a ledger: heartbeats go on
            index, link = self._old_images.popleft()
            captured = self._lookup(index)
            if captured is not None:
                self._links.send(camera_messages.image_captured(captured, self._boot_ms()), link)

    def _is_copy(self, packet: Packet) -> bool:
        """Whether the network delivered a broadcast twice: same bytes, so same packet sequence, within 0.5 s."""
        now_ns = self._clock.monotonic_ns()
        self._broadcasts = {raw: at for raw, at in self._broadcasts.items() if now_ns - at <= COPY_NS}
        copy = packet.raw in self._broadcasts
        self._broadcasts[packet.raw] = now_ns
        return copy

    def _command(self, message: Message, link: int) -> Command | None:
        """The command if it is for us: our system or all, our component or all."""
        if message.target_system not in (0, self._links.system_id, self._identity.system_id):
            return None
        if message.target_component not in (0, self._links.component_id):
            return None
        is_long = message.get_type() == "COMMAND_LONG"
        last = (message.param5, message.param6, message.param7) if is_long else (message.x, message.y, message.z)
        return Command(
            message.command,
            (message.param1, message.param2, message.param3, message.param4, *map(float, last)),
            message.confirmation if is_long else 0,
            message.get_srcSystem(),
            message.get_srcComponent(),
            link,
            message.target_component == 0,
        )

    def _answer(self, command: Command) -> None:
        handler = _COMMANDS.get(command.name)
        answer = _Answer(UNSUPPORTED) if handler is None else handler(self, command)
        if answer.result == ACCEPTED or not command.broadcast:  # a broadcast is for whoever can: never refused
            self._links.send(
                mavlink.MAVLink_command_ack_message(
                    command.name, answer.result, 0, 0, command.system, command.component
                ),
                command.link,
            )
        for message in answer.then:
            self._links.send(message, command.link)
        if answer.words is not None:
            self.say(answer.words)
        if answer.result not in (ACCEPTED, UNSUPPORTED):
            self.state_changed()  # a ground station's button waits for it

    def _trigger(self, message: Message, link: int) -> None:
        """CAMERA_TRIGGER (112): the autopilot's own trigger, which nobody acknowledges."""
        if message.get_srcSystem() != self._identity.system_id:
            return
        source = f"mavlink:{message.get_srcSystem()}/{message.get_srcComponent()}"
        verdict = self._shutter.wish(Wish(source, "CAMERA_TRIGGER", message.seq, 0, link, acknowledged=False))
        if not verdict.accepted:
            self.say(f"no photo: {verdict.reason}")
            self.state_changed()

    def _start_capture(self, command: Command) -> _Answer:
        count = command.whole(3, 1)
        wish = Wish(command.source, "IMAGE_START_CAPTURE", command.whole(4), command.confirmation, command.link)
        if count == 1:
            return _judged(self._shutter.wish(wish))
        return _judged(self._shutter.start_interval(wish, command.number(2), count))

    def _stop_capture(self, command: Command) -> _Answer:
        self._shutter.stop_interval()
        return _Answer(ACCEPTED)

    def _digicam_control(self, command: Command) -> _Answer:
        if command.whole(5) != 1:
            return _Answer(ACCEPTED if command.broadcast else UNSUPPORTED)
        wish = Wish(
            command.source,
            "DO_DIGICAM_CONTROL",
            None,
            command.confirmation,
            command.link,
            acknowledged=not command.broadcast,
        )
        return _judged(self._shutter.wish(wish))

    def _request_message(self, command: Command) -> _Answer:
        number = command.whole(1, -1)
        if number == mavlink.MAVLINK_MSG_ID_CAMERA_IMAGE_CAPTURED:
            return self._old_image(command, 2)
        if number not in _MESSAGES:
            return _Answer(UNSUPPORTED)
        return _Answer(ACCEPTED, (_MESSAGES[number](self),))

    def _request_image(self, command: Command) -> _Answer:
        return self._old_image(command, 1)

    def _old_image(self, command: Command, place: int) -> _Answer:
        """How a past shot ended; without an index (NaN) the last one."""
        count = self._shutter.statistics().next_index
        index = command.whole(place, count - 1)
        if not 0 <= index < count:
            return _Answer(DENIED, words=f"no image {index}: there are {count}")
        self._old_images.append((index, command.link))
        return _Answer(ACCEPTED)

    def _set_interval(self, command: Command) -> _Answer:
        """511 for one of our messages: microseconds, -1 off, 0 default (off). At most 10 Hz."""
        number, interval_us = command.whole(1, -1), command.number(2, -1.0)
        if number not in _MESSAGES:
            return _Answer(UNSUPPORTED)
        with self._lock:
            self._intervals.pop(number, None)
            if interval_us > 0:
                interval_ns = max(100_000_000, round(min(interval_us, 3.6e9) * 1e3))
                self._intervals[number] = (interval_ns, self._clock.monotonic_ns() + interval_ns)
        return _Answer(ACCEPTED)

    def _set_mode(self, command: Command) -> _Answer:
        mode = command.whole(2, -1)
        if mode not in (mavlink.CAMERA_MODE_IMAGE, mavlink.CAMERA_MODE_IMAGE_SURVEY):
            return _Answer(DENIED, (self._settings(),), "this camera takes photographs only")
        self._mode = mode
        return _Answer(ACCEPTED, (self._settings(),))

    def _reset_settings(self, command: Command) -> _Answer:
        self._mode = mavlink.CAMERA_MODE_IMAGE
        return _Answer(ACCEPTED, (self._settings(),))

    def _format(self, command: Command) -> _Answer:
        if self._reset_log is None:
            return _Answer(DENIED, words="flights are not erased over MAVLink")
        self._reset_log()
        self.state_changed()
        return _Answer(ACCEPTED, (self._disk(),))

    def _boot_ms(self) -> int:
        return ((self._clock.monotonic_ns() - self._start_ns) // 10**6) % 2**32

    def _information(self) -> Message:
        return camera_messages.information(self._facts(), self._boot_ms())

    def _settings(self) -> Message:
        return camera_messages.settings(self._mode, self._boot_ms())

    def _disk(self) -> Message:
        return camera_messages.storage(self._storage(), self._boot_ms())

    def _status(self) -> Message:
        now = self._shutter.statistics()
        return camera_messages.capture_status(
            busy=now.pending > 0,
            interval_s=now.interval_s,
            image_count=now.next_index,
            disk=self._storage(),
            boot_ms=self._boot_ms(),
        )


def _judged(verdict: Verdict) -> _Answer:
    if verdict.accepted:
        return _Answer(ACCEPTED)
    return _Answer(REJECTED, words=f"no photo: {verdict.reason}")


def _requests(number: int) -> Callable[[Component, Command], _Answer]:
    """The old 52x commands: one message each, whatever parameter 1 says (Mission Planner sends 0)."""
    return lambda component, command: _Answer(ACCEPTED, (_MESSAGES[number](component),))


_MESSAGES: dict[int, Callable[[Component], Message]] = {
    mavlink.MAVLINK_MSG_ID_CAMERA_INFORMATION: Component._information,
    mavlink.MAVLINK_MSG_ID_CAMERA_SETTINGS: Component._settings,
    mavlink.MAVLINK_MSG_ID_STORAGE_INFORMATION: Component._disk,
    mavlink.MAVLINK_MSG_ID_CAMERA_CAPTURE_STATUS: Component._status,
}
_COMMANDS: dict[int, Callable[[Component, Command], _Answer]] = {
    mavlink.MAV_CMD_IMAGE_START_CAPTURE: Component._start_capture,
    mavlink.MAV_CMD_IMAGE_STOP_CAPTURE: Component._stop_capture,
    mavlink.MAV_CMD_DO_DIGICAM_CONTROL: Component._digicam_control,
    mavlink.MAV_CMD_REQUEST_MESSAGE: Component._request_message,
    mavlink.MAV_CMD_SET_MESSAGE_INTERVAL: Component._set_interval,
    mavlink.MAV_CMD_REQUEST_CAMERA_INFORMATION: _requests(mavlink.MAVLINK_MSG_ID_CAMERA_INFORMATION),
    mavlink.MAV_CMD_REQUEST_CAMERA_SETTINGS: _requests(mavlink.MAVLINK_MSG_ID_CAMERA_SETTINGS),
    mavlink.MAV_CMD_REQUEST_STORAGE_INFORMATION: _requests(mavlink.MAVLINK_MSG_ID_STORAGE_INFORMATION),
    mavlink.MAV_CMD_REQUEST_CAMERA_CAPTURE_STATUS: _requests(mavlink.MAVLINK_MSG_ID_CAMERA_CAPTURE_STATUS),
    mavlink.MAV_CMD_REQUEST_CAMERA_IMAGE_CAPTURE: Component._request_image,
    mavlink.MAV_CMD_SET_CAMERA_MODE: Component._set_mode,
    mavlink.MAV_CMD_RESET_CAMERA_SETTINGS: Component._reset_settings,
    mavlink.MAV_CMD_STORAGE_FORMAT: Component._format,
}
