"""The autopilot of the system that the camera belongs to: which one that is, requests and commands to it."""

from __future__ import annotations

import struct
import threading
from collections import deque
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Protocol

from dappled.clock import Clock
from dappled.daemon.camera_protocol.named_component import NamedComponent
from dappled.daemon.navigation.samples import CAPTURED, EPOCH_US, NO_VEHICLES, WRAP_US
from dappled.daemon.pipeline.repeats import AutopilotCommands
from dappled.daemon.vehicle_battery import BATTERY_STREAM, BatteryReports, VehicleBattery
from dappled.drivers.mavlink import MavlinkMessage, Packet, mavlink
from dappled.findings import Code, Finding, Subject, finding

TIMESYNC_NS = 200_000_000
STREAMS_NS = 5 * 10**9
STALE_US = 5_000_000  # a slow radio is seconds behind
CONFIRM_NS = 500_000_000  # as long as navigation asks for
STEADY_NS = 10 * 10**9
_BOOTED_US = 10_000_000  # an autopilot that was not heard since shows no more after its start; a fast simulator a bit
LATE_NS = 2_500_000_000
MOST_LOST = 256
_COVERS_NS = 60 * 10**9  # how long ago a shot without a number may be the one of a number that is missing
_TIMESYNC = struct.Struct("<qqBB")
STREAMS = (  # message, interval in microseconds
    (mavlink.MAVLINK_MSG_ID_GLOBAL_POSITION_INT, 20_000),
    (mavlink.MAVLINK_MSG_ID_ATTITUDE_QUATERNION, 20_000),
    (mavlink.MAVLINK_MSG_ID_GPS_RAW_INT, 200_000),
    (mavlink.MAVLINK_MSG_ID_SYSTEM_TIME, 1_000_000),
    BATTERY_STREAM,
    (mavlink.MAVLINK_MSG_ID_DISTANCE_SENSOR, 200_000),
    (mavlink.MAVLINK_MSG_ID_TERRAIN_REPORT, 1_000_000),
)
GIMBAL_STREAM = (mavlink.MAVLINK_MSG_ID_GIMBAL_DEVICE_ATTITUDE_STATUS, 50_000)
_ATTITUDE = mavlink.MAVLINK_MSG_ID_ATTITUDE_QUATERNION
_POSITION = mavlink.MAVLINK_MSG_ID_GLOBAL_POSITION_INT
_OF_POSES = {  # what poses are interpolated from: any of these messages will do
    _POSITION: (_POSITION,),
    _ATTITUDE: (_ATTITUDE, mavlink.MAVLINK_MSG_ID_ATTITUDE, mavlink.MAVLINK_MSG_ID_ATTITUDE_QUATERNION_COV),
}
# Between two messages a time T apart a position with velocities is off by a·T²/16 at most, an attitude by α·T²/8:
# 2.5 cm at 10 m/s² and 5 Hz, as good as the best receivers; 0.2° at 200°/s² and 12 Hz, less than an autopilot's own.
_NEEDED_HZ = {_POSITION: 4.5, _ATTITUDE: 12.0}  # a count over five seconds may lack some
_SLOW_TIMES = 2  # in a row: one stretch may hold a start, or a short silence
LISTEN_NS = 3 * 10**9
ALONE_NS = 1_200_000_000  # heartbeats come every second: a second autopilot would have shown by now


class Links(Protocol):
    """What the camera needs of `drivers.mavlink.PacketSender`."""

    system_id: int
    component_id: int

    def send(self, message: MavlinkMessage, link: int | None = None, *, without: int | None = None) -> bool: ...


class SystemIdentity:
    """Which system this camera belongs to.

    Decides three seconds after the start at the latest: the system id of the only autopilot of a vehicle that is heard,
    or the configured one where there are several or none. Decides sooner when one was heard alone for 1.2 s. Where none
    was heard (it boots more slowly than this machine), the first one heard alone for 1.2 s later is taken, for good.
    Of several the only one that fires this camera counts, from then on.
    """

    def __init__(self, configured_system_id: int, start_ns: int) -> None:
        self.settled = False
        self.autopilots: dict[int, int] = {}  # system id: link it was last heard on
        self._configured = self._decided = configured_system_id
        self._firing: set[int] = set()
        self._ardupilots: set[int] = set()
        self._none_yet = True
        self._start_ns = start_ns
        self._first_heard_ns: int | None = None

    @property
    def system_id(self) -> int:
        """The system, as far as it is decided."""
        return next(iter(self._firing)) if self.settled and len(self._firing) == 1 else self._decided

    def heard(self, message: MavlinkMessage, link: int, now_ns: int) -> None:
        """Take a HEARTBEAT. Times are monotonic."""
        of_vehicle = message.autopilot != mavlink.MAV_AUTOPILOT_INVALID and message.type not in NO_VEHICLES
        if not of_vehicle or message.get_srcComponent() != mavlink.MAV_COMP_ID_AUTOPILOT1:
            return
        if len(self.autopilots) < 32 or message.get_srcSystem() in self.autopilots:
            self.autopilots[message.get_srcSystem()] = link
            if message.autopilot == mavlink.MAV_AUTOPILOT_ARDUPILOTMEGA:
                self._ardupilots.add(message.get_srcSystem())
        if self._first_heard_ns is None:
            self._first_heard_ns = now_ns

    def fired_by(self, system_id: int) -> None:
        """The autopilot of this system has fired this very camera."""
        if system_id in self.autopilots:
            self._firing.add(system_id)

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
                self._decided = heard[0]
        return self.settled

    def doubt(self) -> Finding | None:
        """Autopilots are heard, but not the one of the system that the camera belongs to."""
        heard = sorted(self.autopilots)
        if not self.settled or self._none_yet or not heard or self.system_id in heard:
            return None
        ids = ", ".join(map(str, heard))
        return finding(Code.LINK_OTHER_SYSTEM, Subject("service"), heard=ids, system=self.system_id)

    def rivals(self) -> Finding | None:
        """Why the camera's own vehicle counts, of several that are heard."""
        others = sorted(self.autopilots.keys() - {self.system_id})
        if not self.settled or not others or self.system_id not in self.autopilots:
            return None
        by = "having been heard alone"
        if self._firing == {self.system_id}:
            by = "requests to this camera"
        elif self.system_id == self._configured:
            by = "id in mavlink.system_id"
        named = ", ".join(map(str, others))
        return finding(Code.LINK_VEHICLE, Subject("link"), vehicle=self.system_id, by=by, others=named)

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


class TargetedTimesync(mavlink.MAVLink_timesync_message):  # type: ignore[misc]  # pymavlink has no types
    """A TIMESYNC for one component: an autopilot would forward one for all to the ground station's radio.

    Dialects may lack the two fields, an extension of version 2: they are packed here. Receivers without them ignore
    them.
    """

    def __init__(self, ts1: int, system: int) -> None:
        super().__init__(0, ts1)
        self._target = system, 1

    def pack(self, mav: mavlink.MAVLink, force_mavlink1: bool = False) -> bytes:
        """Pack the message with its target, which pymavlink's own TIMESYNC lacks."""
        whole = _TIMESYNC.pack(self.tc1, self.ts1, *self._target)
        payload = whole[:16] if force_mavlink1 else whole
        return bytes(self._pack(mav, self.crc_extra, payload, force_mavlink1=force_mavlink1))


class AutopilotRequests:
    """Requests for the time at 5 Hz and, every five seconds, for streams that arrived at less than half their rate.

    `streams` are (message, interval in microseconds).
    """

    def __init__(self, streams: Sequence[tuple[int, int]] = STREAMS) -> None:
        self._streams = streams
        counted = *(message_id for message_id, _ in streams), *(one for each in _OF_POSES.values() for one in each)
        self._heard: dict[int, int] = dict.fromkeys(counted, 0)
        self._time_due_ns = self._streams_due_ns = 0
        self._asked_ns: int | None = None
        self._slow: dict[int, tuple[int, float]] = {}  # how often in a row, and what came a second

    def slow(self) -> list[Finding]:
        """What comes too seldom to interpolate poses. What doesn't come at all is another finding."""
        known = self._slow  # any thread may ask
        return [
            finding(
                Code.TELEMETRY_SLOW,
                Subject("stream", mavlink.mavlink_map[message_id].msgname),
                seen_hz=known[message_id][1],
                wanted_hz=1e6 / interval_us,
            )
            for message_id, interval_us in self._streams
            if message_id in known and known[message_id][0] >= _SLOW_TIMES
        ]

    def _judge(self, heard: Mapping[int, int], now_ns: int) -> None:
        """Take what has come since the last requests."""
        since_ns, self._asked_ns = self._asked_ns, now_ns
        if since_ns is None:
            return
        before, slow = self._slow, {}
        for message_id, needed_hz in _NEEDED_HZ.items():
            seen_hz = max(heard[one] for one in _OF_POSES[message_id]) * 1e9 / (now_ns - since_ns)
            if 0 < seen_hz < needed_hz:
                slow[message_id] = before.get(message_id, (0, 0.0))[0] + 1, seen_hz
        self._slow = slow

    def heard(self, message_id: int) -> None:
        """Count a message of our autopilot."""
        if message_id in self._heard:
            self._heard[message_id] += 1

    def due(self, system: int, now_ns: int, utc_ns: int) -> Iterator[MavlinkMessage]:
        """The requests that are due by now."""
        if now_ns >= self._time_due_ns:
            self._time_due_ns = now_ns + TIMESYNC_NS
            yield TargetedTimesync(utc_ns, system)
        if now_ns >= self._streams_due_ns:
            self._streams_due_ns = now_ns + STREAMS_NS
            heard, self._heard = self._heard, dict.fromkeys(self._heard, 0)
            self._judge(heard, now_ns)
            for message_id, interval_us in self._streams:
                if heard[message_id] < STREAMS_NS / (interval_us * 1e3) / 2:
                    yield mavlink.MAVLink_command_long_message(
                        system, 1, mavlink.MAV_CMD_SET_MESSAGE_INTERVAL, 0, message_id, interval_us, 0, 0, 0, 0, 0
                    )


class _ShownClock:
    """One clock of the autopilot, as its last messages showed it. Clock times are microseconds, ours nanoseconds.

    A time that is not where the clock should be by now counts when the messages have kept to it for `CONFIRM_NS`. One
    that is far behind, but later than an autopilot could show that has started again meanwhile, counts after
    `STEADY_NS`: so long a slow second link may bring old packets alone. That a clock still runs is shown by the first
    message with a time, and not by copies of it, which may come after those of its next start.
    """

    def __init__(self) -> None:
        self._shown: tuple[int, int] | None = None
        self._newest: tuple[int, int] = 0, 0  # its latest time, and when that came first
        self._doubted: tuple[int, int] | None = None
        self._first: tuple[int, int] = 0, 0  # of those in doubt

    def heard(self, time_us: int, now_ns: int) -> int | None:
        """Take a time. Where the clock has certainly gone back by now: when it began anew, as it says itself, but after
        the last time of before."""
        shown = self._shown
        if shown is None or shown[0] - STALE_US <= time_us <= _runs_to(shown, now_ns) + STALE_US:
            self._shown, self._doubted = (time_us, now_ns), None
            self._newest = max(self._newest, (time_us, now_ns), key=lambda one: one[0])
            return None
        if self._doubted is None or abs(time_us - _runs_to(self._doubted, now_ns)) > STALE_US:
            self._first = time_us, now_ns
        self._doubted = time_us, now_ns
        first_us, since_ns = self._first
        certain = time_us > shown[0] or first_us <= (since_ns - shown[1]) // 1000 + _BOOTED_US
        if now_ns - since_ns < (CONFIRM_NS if certain else STEADY_NS):
            return None
        newest_ns, self._newest = self._newest[1], self._doubted
        self._shown, self._doubted = self._doubted, None
        return max(newest_ns, since_ns - first_us * 1000) if time_us < shown[0] else None

    def is_about(self, time_us: int, now_ns: int) -> bool | None:
        """Whether a time is within `STALE_US` of now, perhaps one of 32 bits; None where the clock is not known."""
        if self._shown is None:
            return None
        for seen in (self._shown, self._doubted):
            if seen is not None:
                age_us = _runs_to(seen, now_ns) - time_us
                if time_us < WRAP_US:
                    age_us = (age_us + WRAP_US // 2) % WRAP_US - WRAP_US // 2
                if abs(age_us) <= STALE_US:
                    return True
        return False


def _runs_to(seen: tuple[int, int], now_ns: int) -> int:
    """What a clock shows now."""
    return seen[0] + (now_ns - seen[1]) // 1000


class AutopilotNow:
    """What the autopilot's clocks show now, to `STALE_US`: the last times it sent, plus what has passed since."""

    def __init__(self) -> None:
        self._boot, self._utc = _ShownClock(), _ShownClock()

    def heard(self, message: MavlinkMessage, now_ns: int) -> int | None:
        """Take a message of the autopilot; since when it has started again, where that is certain by now. Times are
        monotonic."""
        if message.get_type() == "SYSTEM_TIME" and message.time_unix_usec >= EPOCH_US:
            self._utc.heard(int(message.time_unix_usec), now_ns)
        boot_ms = getattr(message, "time_boot_ms", 0)
        return self._boot.heard(boot_ms * 1000, now_ns) if boot_ms > 0 else None

    def is_stale(self, time_us: int, now_ns: int) -> bool | None:
        """Whether a time of the autopilot's, since boot or in UTC, is not about now."""
        about_now = (self._utc if time_us >= EPOCH_US else self._boot).is_about(time_us, now_ns)
        return None if about_now is None else not about_now


@dataclass(frozen=True, slots=True)
class _Jump:
    """Numbers from `first` to `last` that were passed over at once."""

    first: int
    last: int
    due_ns: int
    where: str


class TriggerNumbers:
    """Which of the autopilot's triggers became no request here, by the numbers that it gives them.

    A number that is passed over is waited for `LATE_NS`: a second link may bring it, or a message without a number may
    have become its shot. Times are monotonic. A jump of more than `MOST_LOST` numbers is told as one: nobody can say
    whether they were lost or the counter was set. If the numbers go back into the jump, a wrong number was heard, and
    nothing is told. A number that is not above the highest one, at a later time of the autopilot's own, shows that its
    counter was set back (PX4: MAV_CMD_DO_TRIGGER_CONTROL with parameter 2 = 1). All methods may be called from any
    thread.
    """

    def __init__(self) -> None:
        self._lock = threading.Lock()
        self._heard: deque[int] = deque(maxlen=MOST_LOST)
        self._heard_ns = 0
        self._latest_us = self._set_back_us = 0  # by the autopilot's clock; 0: none since its start
        self._top: int | None = None
        self._missing: dict[int, tuple[int, str]] = {}  # when it counts as lost, and where that was noticed
        self._jumps: list[_Jump] = []
        self._over: list[Finding] = []  # of before a restart
        # when messages without a number became shots whose number is not known
        self._unnumbered: deque[int] = deque(maxlen=MOST_LOST)

    @property
    def begun(self) -> bool:
        """Whether numbers have come since the autopilot's last start."""
        return bool(self._heard)

    def heard(
        self, number: int, now_ns: int, where: Callable[[], str], *, known: bool = False, time_us: int = 0
    ) -> None:
        """A request, or a shot's own message, with this number has come. `known`: another message made its shot.
        `time_us`: when, by the autopilot's clock; 0: the kind has none."""
        with self._lock:
            if 0 < time_us < self._set_back_us <= time_us + STALE_US:
                return  # late, with a number of before the counter was set back
            if 0 < self._latest_us < time_us and self._goes_back(number):
                self._over += self._take(now_ns, at_once=True)
                self._heard.clear()
                self._top, self._set_back_us = 0, time_us
            self._latest_us = max(self._latest_us, time_us)
            if number not in self._heard:
                self._reach(number, now_ns, where)
                if not known and not self._missing:
                    self._unnumbered.clear()
                elif known and self._unnumbered:
                    self._unnumbered.pop()
            self._heard.append(number)
            self._heard_ns = now_ns
            self._missing.pop(number, None)

    def late(self, number: int, now_ns: int, where: Callable[[], str]) -> None:
        """A trigger is reported too late to be a shot: it is lost, unless its own message still comes."""
        with self._lock:
            self._miss(number, now_ns, where)

    def reported(self, number: int, now_ns: int, where: Callable[[], str]) -> None:
        """The autopilot reports a trigger that it has requested. Ignored where it requests none here."""
        with self._lock:
            if self._heard and number not in self._missing:
                self._miss(number, now_ns, where)

    def unnumbered(self, now_ns: int) -> None:
        """A message without a number became a shot: PX4 sends one to each camera after the one with the number."""
        with self._lock:
            self._unnumbered.append(now_ns)

    def lost(self, now_ns: int, *, at_once: bool = False) -> list[Finding]:
        """Those that have not come in time, each told once; `at_once`: those that are waited for too."""
        if not (at_once or self._missing or self._jumps or self._over or self._unnumbered):
            return []
        with self._lock:
            found, self._over = [*self._over, *self._take(now_ns, at_once=at_once)], []
        return found

    def restart(self, since_ns: int) -> None:
        """The autopilot has started again at about this time, and counts from 1 (PX4 from 0)."""
        with self._lock:
            self._over += self._take(since_ns, at_once=True)
            last = self._heard[-1] if self._heard and self._heard_ns > since_ns else None
            self._heard.clear()
            self._unnumbered.clear()
            self._latest_us = self._set_back_us = 0
            self._top = 0 if last is None else last
            if last is not None:
                self._heard.append(last)

    def _take(self, now_ns: int, *, at_once: bool) -> list[Finding]:
        """Those that are lost by now, which are waited for no longer."""
        over = sorted(number for number, (due_ns, _) in self._missing.items() if at_once or due_ns <= now_ns)
        first_ns = min((self._missing[number][0] for number in over), default=now_ns) - LATE_NS - _COVERS_NS
        while self._unnumbered and self._unnumbered[0] < first_ns:
            self._unnumbered.popleft()
        places = [(number, self._missing.pop(number)[1]) for number in over]
        self._heard.extend(over)  # ArduPilot repeats its last report with each one of another camera
        while places and self._unnumbered:
            self._unnumbered.popleft()
            places.pop(0)
        runs: list[tuple[int, int, str]] = []
        for number, where in places:
            if runs and runs[-1][1:] == (number - 1, where):
                runs[-1] = runs[-1][0], number, where
            else:
                runs.append((number, number, where))
        jumps = [jump for jump in self._jumps if at_once or jump.due_ns <= now_ns]
        self._jumps = [jump for jump in self._jumps if jump not in jumps]
        return [
            *(_lost(Code.TRIGGER_LOST, *run) for run in runs),
            *(_lost(Code.TRIGGER_JUMP, jump.first, jump.last, jump.where) for jump in jumps),
        ]

    def _goes_back(self, number: int) -> bool:
        """Whether it is not above the highest number, and none of a jump, whose end was a wrong number then."""
        jumped = any(jump.first <= number <= jump.last for jump in self._jumps)
        return self._top is not None and number <= self._top and not jumped

    def _miss(self, number: int, now_ns: int, where: Callable[[], str]) -> None:
        if number not in self._heard:
            self._reach(number, now_ns, where)
            self._missing[number] = now_ns + LATE_NS, where()

    def _reach(self, number: int, now_ns: int, where: Callable[[], str]) -> None:
        top = self._top
        if top is None:
            self._top = number
            return
        if number > top + MOST_LOST:
            self._jumps.append(_Jump(top + 1, number - 1, now_ns + LATE_NS, where()))
        elif number > top + 1:
            self._missing |= dict.fromkeys(range(top + 1, number), (now_ns + LATE_NS, where()))
        elif number < top - MOST_LOST:
            self._jumps = [jump for jump in self._jumps if not jump.first <= number <= jump.last]
        elif number < top:
            self._jumps = [part for jump in self._jumps for part in _without(jump, number)]
        if number > top or number < top - MOST_LOST:
            self._top = number


def _lost(code: Code, first: int, last: int, where: str) -> Finding:
    """Triggers of the autopilot that became no shot, by its own numbers, the last included."""
    which = f"{first}" if first == last else f"{first} to {last}"
    return finding(code, Subject("trigger", which), first=first, triggers=last - first + 1, where=where)


def _without(jump: _Jump, number: int) -> list[_Jump]:
    """What is left of a jump where one of its numbers has come late."""
    if not jump.first <= number <= jump.last:
        return [jump]
    parts = replace(jump, last=number - 1), replace(jump, first=number + 1)
    return [part for part in parts if part.first <= part.last]


class OwnAutopilot:
    """The autopilot of the system that the camera belongs to, on the link that it was last heard on.

    `on_gimbal`: the camera needs the gimbal's attitude, which ArduPilot sends to a companion's port only on request.
    `cam_idx`: its number at the autopilot, from 0.
    """

    def __init__(self, links: Links, clock: Clock, *, on_gimbal: bool = False, cam_idx: int = 0) -> None:
        self.links, self._clock = links, clock
        self.identity = SystemIdentity(links.system_id, clock.monotonic_ns())
        self._commands = AutopilotCommands()
        self._requests = AutopilotRequests((*STREAMS, GIMBAL_STREAM) if on_gimbal else STREAMS)
        self.cam_idx, self._named = cam_idx, NamedComponent(cam_idx, links.component_id)
        self._now, self._battery = AutopilotNow(), BatteryReports()
        self.numbers = {kind: TriggerNumbers() for kind in ("CAMERA_FEEDBACK", "CAMERA_TRIGGER", CAPTURED)}
        self.restarts = self.restarted_ns = 0  # of the autopilot, so far: its numbers began again then (monotonic)

    def fired_by(self, system_id: int) -> None:
        """The autopilot of this system has fired this very camera: of several, it may be the camera's own."""
        before = self.identity.system_id
        self.identity.fired_by(system_id)
        if self.identity.system_id != before:
            self._now, self._battery = AutopilotNow(), BatteryReports()
            self._named = NamedComponent(self.cam_idx, self.links.component_id)
            self.numbers = {kind: TriggerNumbers() for kind in self.numbers}

    def heard(self, message: MavlinkMessage) -> None:
        """Take a message of its system that can be trusted."""
        self._requests.heard(message.get_msgId())
        since_ns = self._now.heard(message, self._clock.monotonic_ns()) if message.get_srcComponent() == 1 else None
        if message.get_type() == "SYS_STATUS" and message.get_srcComponent() == 1:
            self._battery.heard(message, self._clock.monotonic_ns())
        if message.get_type() == "PARAM_VALUE" and message.get_srcComponent() == 1:
            self._named.heard(message)
        if since_ns is not None:
            self.restarts, self.restarted_ns = self.restarts + 1, since_ns
            for numbers in self.numbers.values():
                numbers.restart(since_ns)

    def lost_triggers(self, *, at_once: bool = False) -> list[Finding]:
        """Triggers of the autopilot that became no request here, each told once; `at_once`: without waiting for those
        that may be late."""
        now_ns = self._clock.monotonic_ns()
        return [one for numbers in self.numbers.values() for one in numbers.lost(now_ns, at_once=at_once)]

    def is_stale(self, time_us: int) -> bool | None:
        """Whether a time of the autopilot's, in microseconds since boot (perhaps of 32 bits) or of UTC, is not about
        now: more than `STALE_US` ago, or ahead. None where its clock is not known yet."""
        stale = self._now.is_stale(time_us, self._clock.monotonic_ns())
        if stale is None and abs(self._clock.utc_ns() // 1000 - time_us) <= STALE_US:
            return False  # this machine's clock says so
        return stale

    def findings(self) -> list[Finding]:
        """What of its telemetry comes too seldom to interpolate poses; that it fires another component than ours."""
        return [*self._requests.slow(), *self._named.findings()]

    def battery(self) -> VehicleBattery | None:
        """The vehicle's battery; None while the autopilot doesn't report it."""
        return self._battery.now(self._clock.monotonic_ns())

    def ask(self) -> None:
        """Send what is due by now: requests for the time, and for streams that arrive too slowly."""
        autopilot = self.identity.autopilot()
        if autopilot is not None:
            system, link = autopilot
            for message in self._requests.due(system, self._clock.monotonic_ns(), self._clock.utc_ns()):
                self.links.send(message, link)
            if self.identity.is_ardupilot():
                for message in self._named.due(system, self._clock.monotonic_ns()):
                    self.links.send(message, link)

    def command(self, number: int, parameters: Sequence[float]) -> str | None:
        """Send it a command (MAV_CMD, parameters from the first); a sentence where it can't be sent."""
        autopilot = self.identity.autopilot()
        if autopilot is None:
            return "no autopilot was heard on the MAVLink links"
        system, link = autopilot
        self._commands.sent(number, self._clock.monotonic_ns())
        seven = (*parameters, *(0.0,) * (7 - len(parameters)))
        sent = self.links.send(mavlink.MAVLink_command_long_message(system, 1, number, 0, *seven), link)
        return None if sent else "its link takes no more messages"

    def refusal(self, message: MavlinkMessage) -> str | None:
        """A sentence where a COMMAND_ACK refuses a command of ours."""
        ours = message.get_srcSystem() == self.identity.system_id and message.target_component in (
            0,
            self.links.component_id,
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
