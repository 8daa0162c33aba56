"""The autopilot of the system that the camera belongs to: which one that is, requests and commands to it."""

from __future__ import annotations

import threading
from collections import deque
from collections.abc import Callable, Iterator, Sequence
from typing import Protocol

from dappled.clock import Clock
from dappled.daemon.pipeline.repeats import AutopilotCommands
from dappled.drivers.mavlink import MavlinkMessage, Packet, mavlink
from dappled.refusals import LostTriggers

TIMESYNC_NS = 200_000_000
STREAMS_NS = 5 * 10**9
STALE_US = 5_000_000  # a slow radio is seconds behind
EPOCH_US = 10**15  # 2001: a time above is UTC, one below counts since boot
LATE_NS = 2_500_000_000
MOST_LOST = 256
_WRAP_US = 2**32
STREAMS = (  # message, interval in microseconds
    (mavlink.MAVLINK_MSG_ID_GLOBAL_POSITION_INT, 20_000),
    (mavlink.MAVLINK_MSG_ID_ATTITUDE_QUATERNION, 20_000),
    (mavlink.MAVLINK_MSG_ID_GPS_RAW_INT, 200_000),
    (mavlink.MAVLINK_MSG_ID_SYSTEM_TIME, 1_000_000),
)
LISTEN_NS = 3 * 10**9
ALONE_NS = 1_200_000_000  # heartbeats come every second: a second autopilot would have shown by now
_WANTED = frozenset(message_id for message_id, _ in STREAMS)


class Links(Protocol):
    """What the camera needs of `drivers.mavlink.PacketSender`."""

    system_id: int
    component_id: int

    def send(self, message: MavlinkMessage, link: int | None = None) -> bool: ...


class SystemIdentity:
    """Which system this camera belongs to.

    Decides three seconds after the start at the latest: the system id of the only autopilot heard, or the configured
    one where there are several or none. Decides sooner when one autopilot was heard alone for 1.2 s. Where none was
    heard (it boots more slowly than this machine), the first one heard alone for 1.2 s later is taken, for good.
    """

    def __init__(self, configured_system_id: int, start_ns: int) -> None:
        self.system_id = configured_system_id
        self.settled = False
        self.autopilots: dict[int, int] = {}  # system id: link it was last heard on
        self._ardupilots: set[int] = set()
        self._none_yet = True
        self._start_ns = start_ns
        self._first_heard_ns: int | None = None

    def heard(self, message: MavlinkMessage, link: int, now_ns: int) -> None:
        """Take a HEARTBEAT. Times are monotonic."""
        if message.autopilot == mavlink.MAV_AUTOPILOT_INVALID or message.type == mavlink.MAV_TYPE_GCS:
            return
        if len(self.autopilots) < 32 or message.get_srcSystem() in self.autopilots:
            self.autopilots[message.get_srcSystem()] = link
            if message.autopilot == mavlink.MAV_AUTOPILOT_ARDUPILOTMEGA:
                self._ardupilots.add(message.get_srcSystem())
        if self._first_heard_ns is None:
            self._first_heard_ns = now_ns

    def decide(self, now_ns: int) -> bool:
        """Decide if possible by now. Whether it is decided."""
        waited = self._first_heard_ns is not None and now_ns - self._first_heard_ns >= ALONE_NS
        if not self.settled and now_ns - self._start_ns >= LISTEN_NS:
            self.settled = waited = True
        if self._none_yet and self.autopilots and waited:
            self._none_yet = False
            heard = tuple(self.autopilots)  # as of now: another may be heard meanwhile
            if len(heard) == 1:
                self.settled = True
                self.system_id = heard[0]
        return self.settled

    def doubt(self) -> str | None:
        """A sentence where autopilots are heard, but not the one of the system that the camera belongs to."""
        heard = sorted(self.autopilots)
        if not self.settled or self._none_yet or not heard or self.system_id in heard:
            return None
        ids = ", ".join(map(str, heard))
        who = f"autopilot {ids} is" if len(heard) == 1 else f"autopilots {ids} are"
        return f"{who} heard, the camera belongs to system {self.system_id}: set mavlink.system_id"

    def vehicle(self) -> int | None:
        """The system whose telemetry counts: our own, once that is decided.

        None while no autopilot was heard, or only one of another system, whose telemetry is better than none.
        """
        known = self.settled and (len(self.autopilots) > 1 or self.system_id in self.autopilots)
        return self.system_id if known else None

    def is_ardupilot(self) -> bool:
        """Whether our own autopilot is ArduPilot, whose requests carry the number of the trigger (parameter 4)."""
        return self.system_id in self._ardupilots

    def autopilot(self) -> tuple[int, int] | None:
        """(system id, link) of our own autopilot; None while it was not heard."""
        link = self.autopilots.get(self.system_id)
        return None if link is None else (self.system_id, link)


class AutopilotRequests:
    """Requests for the time at 5 Hz and, every five seconds, for streams that arrived at less than half their rate."""

    def __init__(self) -> None:
        self._heard: dict[int, int] = {}
        self._time_due_ns = self._streams_due_ns = 0

    def heard(self, message_id: int) -> None:
        """Count a message of our autopilot."""
        if message_id in _WANTED:
            self._heard[message_id] = self._heard.get(message_id, 0) + 1

    def due(self, system: int, now_ns: int, utc_ns: int) -> Iterator[MavlinkMessage]:
        """The requests that are due by now."""
        if now_ns >= self._time_due_ns:
            self._time_due_ns = now_ns + TIMESYNC_NS
            yield mavlink.MAVLink_timesync_message(0, utc_ns)
        if now_ns >= self._streams_due_ns:
            self._streams_due_ns = now_ns + STREAMS_NS
            heard, self._heard = self._heard, {}
            for message_id, interval_us in STREAMS:
                if heard.get(message_id, 0) < STREAMS_NS / (interval_us * 1e3) / 2:
                    yield mavlink.MAVLink_command_long_message(
                        system, 1, mavlink.MAV_CMD_SET_MESSAGE_INTERVAL, 0, message_id, interval_us, 0, 0, 0, 0, 0
                    )


class AutopilotNow:
    """What the autopilot's clocks show now, to `STALE_US`: the last times it sent, plus what has passed since."""

    def __init__(self) -> None:
        self._boot: tuple[int, int] | None = None  # its microseconds, our nanoseconds
        self._utc: tuple[int, int] | None = None

    def heard(self, message: MavlinkMessage, now_ns: int) -> bool:
        """Take a message of the autopilot; whether it has started again. Times are monotonic."""
        boot_ms = getattr(message, "time_boot_ms", 0)
        restarted = False
        if boot_ms > 0:
            restarted = self._boot is not None and boot_ms * 1000 < self._boot[0] - STALE_US
            self._boot = boot_ms * 1000, now_ns
        if message.get_type() == "SYSTEM_TIME" and message.time_unix_usec >= EPOCH_US:
            self._utc = int(message.time_unix_usec), now_ns
        return restarted

    def is_stale(self, time_us: int, now_ns: int) -> bool | None:
        """See `OwnAutopilot.is_stale`."""
        shown = self._utc if time_us >= EPOCH_US else self._boot
        if shown is None:
            return None
        age_us = shown[0] + (now_ns - shown[1]) // 1000 - time_us
        if time_us < _WRAP_US:
            age_us = (age_us + _WRAP_US // 2) % _WRAP_US - _WRAP_US // 2
        return abs(age_us) > STALE_US


class TriggerNumbers:
    """Which of the autopilot's triggers became no request here, by the numbers that it gives them.

    A number that is passed over is waited for `LATE_NS`: a second link may bring it. Times are monotonic. A jump of
    more than `MOST_LOST` numbers is a counter that was set, not a loss. All methods may be called from any thread.
    """

    def __init__(self) -> None:
        self._lock = threading.Lock()
        self._heard: deque[int] = deque(maxlen=MOST_LOST)
        self._top: int | None = None
        self._missing: dict[int, tuple[int, str]] = {}  # when it counts as lost, and where that was noticed
        self._unnumbered = 0  # requests without a number since the last one with one

    def heard(self, number: int, now_ns: int, where: Callable[[], str]) -> None:
        """A request, or a shot's own message, with this number has come."""
        with self._lock:
            self._reach(number, now_ns, where)
            self._heard.append(number)
            self._missing.pop(number, None)
            self._unnumbered = 0

    def late(self, number: int, now_ns: int, where: Callable[[], str]) -> None:
        """A trigger is reported too late to be a shot: it is lost, unless its own message still comes."""
        with self._lock:
            if number not in self._heard:
                self._reach(number, now_ns, where)
                self._missing[number] = now_ns + LATE_NS, where()

    def reported(self, number: int, now_ns: int, where: Callable[[], str]) -> None:
        """The autopilot reports a trigger that it has requested. Ignored where it requests none here."""
        with self._lock:
            if self._heard and number not in self._heard and number not in self._missing:
                self._reach(number, now_ns, where)
                self._missing[number] = now_ns + LATE_NS, where()

    def unnumbered(self) -> None:
        """One of the other messages of a trigger has come: PX4 sends one for each camera after the numbered one."""
        with self._lock:
            self._unnumbered += 1

    def lost(self, now_ns: int) -> list[LostTriggers]:
        """Those that have not come in time, each told once."""
        with self._lock:
            over = sorted(number for number, (due_ns, _) in self._missing.items() if due_ns <= now_ns)
            places = [(number, self._missing.pop(number)[1]) for number in over]
            self._heard.extend(over)  # ArduPilot repeats its last report with each one of another camera
        found: list[LostTriggers] = []
        for number, where in places:
            if found and found[-1].last == number - 1 and found[-1].where == where:
                found[-1] = LostTriggers(found[-1].first, number, where)
            else:
                found.append(LostTriggers(number, number, where))
        return found

    def restart(self) -> None:
        """The autopilot has started again, and counts from 1."""
        with self._lock:
            self._heard.clear()
            self._missing.clear()
            self._top, self._unnumbered = None, 0

    def _reach(self, number: int, now_ns: int, where: Callable[[], str]) -> None:
        top = self._top
        if top is not None and top + 1 < number <= top + MOST_LOST:
            here, requested = where(), max(0, self._unnumbered - 1)  # one of them belongs to the last number heard
            self._missing |= dict.fromkeys(range(top + 1 + requested, number), (now_ns + LATE_NS, here))
        if top is None or number > top or number < top - MOST_LOST:
            self._top = number


class OwnAutopilot:
    """The autopilot of the system that the camera belongs to, on the link that it was last heard on."""

    def __init__(self, links: Links, clock: Clock) -> None:
        self._links, self._clock = links, clock
        self.identity = SystemIdentity(links.system_id, clock.monotonic_ns())
        self._commands = AutopilotCommands()
        self._requests = AutopilotRequests()
        self._now = AutopilotNow()
        self.numbers = {"CAMERA_FEEDBACK": TriggerNumbers(), "CAMERA_TRIGGER": TriggerNumbers()}
        self.restarts = 0  # of the autopilot, so far: its numbers begin again

    def heard(self, message: MavlinkMessage) -> None:
        """Take a message of its system."""
        self._requests.heard(message.get_msgId())
        if message.get_srcComponent() == 1 and self._now.heard(message, self._clock.monotonic_ns()):
            self.restarts += 1
            for numbers in self.numbers.values():
                numbers.restart()

    def lost_triggers(self) -> list[LostTriggers]:
        """Triggers of the autopilot that became no request here, each told once."""
        now_ns = self._clock.monotonic_ns()
        return [one for numbers in self.numbers.values() for one in numbers.lost(now_ns)]

    def is_stale(self, time_us: int) -> bool | None:
        """Whether a time of the autopilot's, in microseconds since boot (perhaps of 32 bits) or of UTC, is not about
        now: more than `STALE_US` ago, or ahead. None where its clock is not known yet."""
        return self._now.is_stale(time_us, self._clock.monotonic_ns())

    def ask(self) -> None:
        """Send what is due by now: requests for the time, and for streams that arrive too slowly."""
        autopilot = self.identity.autopilot()
        if autopilot is not None:
            system, link = autopilot
            for message in self._requests.due(system, self._clock.monotonic_ns(), self._clock.utc_ns()):
                self._links.send(message, link)

    def command(self, number: int, parameters: Sequence[float]) -> str | None:
        """Send it a command (MAV_CMD, parameters from the first); a sentence where it can't be sent."""
        autopilot = self.identity.autopilot()
        if autopilot is None:
            return "no autopilot was heard on the MAVLink links"
        system, link = autopilot
        self._commands.sent(number, self._clock.monotonic_ns())
        seven = (*parameters, *(0.0,) * (7 - len(parameters)))
        sent = self._links.send(mavlink.MAVLink_command_long_message(system, 1, number, 0, *seven), link)
        return None if sent else "its link takes no more messages"

    def refusal(self, message: MavlinkMessage) -> str | None:
        """A sentence where a COMMAND_ACK refuses a command of ours."""
        ours = message.get_srcSystem() == self.identity.system_id and message.target_component in (
            0,
            self._links.component_id,
        )
        if not ours or message.command not in self._commands.numbers:
            return None
        if message.result in (mavlink.MAV_RESULT_ACCEPTED, mavlink.MAV_RESULT_IN_PROGRESS):
            return None
        result = mavlink.enums["MAV_RESULT"].get(message.result)
        word = result.name.removeprefix("MAV_RESULT_").lower() if result else message.result
        return f"the autopilot did not fire the camera: command {message.command} {word}"

    def is_echo(self, packet: Packet, kind: str) -> bool:
        """Whether it only reports that it does what we commanded."""
        message = packet.message
        if (message.get_srcSystem(), message.get_srcComponent()) != (self.identity.system_id, 1):
            return False
        return self._commands.is_echo(kind, packet.link, self._clock.monotonic_ns())
