"""Turn telemetry messages into samples of position, attitude, receiver and gimbal, and keep histories of them.

A message without a value gives None. A history is a list of samples in the order of their packets.
"""

from __future__ import annotations

import math
from bisect import bisect_left
from collections import deque
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, replace
from typing import Protocol, TypeVar

from dappled.decode.geometry import Gnss, Quaternion, Vector3, from_euler, normalised
from dappled.drivers.mavlink import MavlinkMessage, mavlink
from dappled.drivers.mavlink.sample_judge import FASTEST_M_S, HIGHEST_M

HALF_MS_NS = 500_000  # time_boot_ms is cut to whole milliseconds: the middle is used
GIMBAL_COMPONENTS = frozenset({1, 154, 171, 172, 173, 174, 175})  # an autopilot reports for a gimbal without MAVLink
_EARTH = mavlink.GIMBAL_DEVICE_FLAGS_YAW_IN_EARTH_FRAME
_VEHICLE = mavlink.GIMBAL_DEVICE_FLAGS_YAW_IN_VEHICLE_FRAME
_LOCK = mavlink.GIMBAL_DEVICE_FLAGS_YAW_LOCK
EPOCH_US = 10**15  # 2001: a time above is UTC, one below counts since boot
WRAP_US = 2**32  # ArduPilot counts the microseconds of its feedback pin in 32 bits
NEAREST_NS = 10 * 10**9
_HIGHEST_MM = HIGHEST_M * 1000
_ONE_JUMP_NS = 10**9
_ARRIVED_NS, _ARRIVED_FEW, _ARRIVED_MOST = 5 * 10**9, 10, 1024
_SOONER_NS, _SOONER_SHARE = 60_000_000, 5.0
_UTC_STEP_NS = 50_000_000
NO_VEHICLES = frozenset(
    getattr(mavlink, f"MAV_TYPE_{name}")
    for name in ("ANTENNA_TRACKER", "GCS", "ONBOARD_CONTROLLER", "GIMBAL", "ADSB", "CAMERA", "CHARGING_STATION",
                 "FLARM", "SERVO", "ODID", "BATTERY", "PARACHUTE", "LOG", "OSD", "IMU", "GPS", "WINCH")
)  # fmt: skip
"""What may name an autopilot in its heartbeat, and is none of a vehicle: MAV_TYPE."""
MOST_SAMPLES = 2**16  # of one kind: three minutes at 360 Hz, more than any autopilot sends


class Numbered(Protocol):
    """Something from one packet of the telemetry log: its running number, and when it arrived."""

    @property
    def number(self) -> int: ...

    @property
    def stamp_ns(self) -> int: ...


class Sample(Numbered, Protocol):
    """Something that also has the vehicle's own time."""

    @property
    def boot_ns(self) -> int: ...


N = TypeVar("N", bound=Numbered)
S = TypeVar("S", bound=Sample)


@dataclass(frozen=True, slots=True)
class PositionSample:
    """One GLOBAL_POSITION_INT."""

    number: int
    stamp_ns: int
    boot_ns: int
    latitude_rad: float
    longitude_rad: float
    altitude_msl_m: float
    height_above_home_m: float
    velocity_ned_m_s: Vector3


@dataclass(frozen=True, slots=True)
class Jump:
    """What the position moved (north, east, down) up to a sample beyond what its velocity explains.

    `standing_m` is how far it is in doubt from then on: all jumps since the doubt began, or nothing where it is over.
    """

    number: int
    stamp_ns: int
    boot_ns: int
    by_m: Vector3
    standing_m: Vector3


@dataclass(frozen=True, slots=True)
class PositionDoubt:
    """How far (north, east, down) the position of a vehicle is in doubt by jumps that are not over."""

    system_id: int
    standing_m: Vector3


@dataclass(frozen=True, slots=True)
class AttitudeSample:
    """One ATTITUDE_QUATERNION, ATTITUDE or ATTITUDE_QUATERNION_COV. Rates are of the body, None where the autopilot
    gave none; `sigma_rad` is of the whole rotation, None where it isn't given."""

    number: int
    stamp_ns: int
    boot_ns: int
    attitude: Quaternion
    rates_rad_s: Vector3 | None
    sigma_rad: float | None = None


@dataclass(frozen=True, slots=True)
class GnssSample:
    """One GPS_RAW_INT, of age 0; what the receiver doesn't report is None. `place`: latitude and longitude
    (rad), height above the sea (m)."""

    number: int
    stamp_ns: int
    reported: Gnss
    place: Vector3


@dataclass(frozen=True, slots=True)
class GroundSample:
    """One DISTANCE_SENSOR (along the beam) or TERRAIN_REPORT; the height is None where the sensor doesn't know it."""

    number: int
    stamp_ns: int
    source: str
    height_m: float | None
    sigma_m: float | None


@dataclass(frozen=True, slots=True)
class GimbalSample:
    """One GIMBAL_DEVICE_ATTITUDE_STATUS or MOUNT_ORIENTATION: the head against the horizon.

    `boot_ns` is on the clock of `component`: 1 is the autopilot's, others have their own, which restarted `epoch`
    times. `follows_vehicle`: yaw counts from the vehicle's nose, not from north.
    """

    number: int
    stamp_ns: int
    boot_ns: int
    component: int
    epoch: int
    attitude: Quaternion
    follows_vehicle: bool
    kind: str


CAPTURED = "CAMERA_IMAGE_CAPTURED"
MARK = "TIM-TM2"  # a time mark of a GNSS receiver of our own (see `drivers.gnss`)
CONTACT_SIGMA_NS = 1_000_000  # interrupt and contact bounce; the best bodies were measured at 0.56 ms
MARK_SIGMA_NS = 5_000_000  # SYSTEM_TIME relates the receiver's UTC to boot; how late an autopilot has it isn't measured


@dataclass(frozen=True, slots=True)
class Feedback:
    """One CAMERA_FEEDBACK, CAMERA_TRIGGER or CAMERA_IMAGE_CAPTURED of the autopilot's: its time since boot. `number` is
    its packet's in the log, `image` the autopilot's number of it. `kind` is the message's type, or MARK.

    `contact`: it is the time of a contact in the hot shoe. False: it may be that of the command to fire.
    """

    number: int
    stamp_ns: int
    boot_ns: int
    kind: str
    image: int = 0
    contact: bool = True
    time_us: int = 0  # as it was sent

    @property
    def sigma_ns(self) -> int:
        """1 σ of a contact on the autopilot's clock."""
        return MARK_SIGMA_NS if self.kind == MARK else CONTACT_SIGMA_NS

    def repeats(self, other: Feedback) -> bool:
        """Whether a contact that bounces may have made both: it keeps the autopilot's number, and is one mark more."""
        return self.kind == other.kind and (self.kind == MARK or self.image == other.image)

    def is_contact_of(self, other: Feedback) -> bool:
        """Whether it is the same contact: at one time, or timed by the autopilot and by a receiver of our own."""
        both = (self.kind == MARK) != (other.kind == MARK)
        return abs(self.boot_ns - other.boot_ns) <= (3 * MARK_SIGMA_NS if both else 0)


def with_commands(events: Sequence[Feedback]) -> Sequence[Feedback]:
    """PX4's CAMERA_IMAGE_CAPTURED have the times of contacts where a hot shoe is wired (CAM_CAP_FBACK), else those of
    the commands to fire, which CAMERA_TRIGGER have too."""
    captured = {one.boot_ns // 10**6 for one in events if one.kind == CAPTURED}
    if not any(one.kind == "CAMERA_TRIGGER" and one.boot_ns // 10**6 in captured for one in events if captured):
        return events
    return [replace(one, contact=False) if one.kind == CAPTURED else one for one in events]


def is_mark(message: MavlinkMessage, system_id: int | None) -> bool:
    """Whether it is a time mark that our own receiver has set, of this system."""
    sender = message.get_srcSystem(), message.get_srcComponent()
    return sender == (system_id, mavlink.MAV_COMP_ID_GPS) and message.get_type() == "CAMERA_TRIGGER"


@dataclass(slots=True)
class TelemetryCounts:
    """How much of all vehicles was fed and used so far, and how much came out of order. `impossible` were not used:
    they can't be true. `jumps` contradicted their velocity."""

    packets: int = 0
    reboots: int = 0
    gimbals: int = 0
    positions: int = 0
    feedbacks: int = 0
    marks: int = 0  # among the feedbacks
    out_of_order: int = 0
    impossible: int = 0
    impossible_ns: int = 0  # the last one's stamp
    jumps: int = 0
    jump_ns: int = 0  # the last one's stamp
    jump_m: float = 0.0  # and its size

    def refuse(self, stamp_ns: int) -> None:
        """Count one that can't be true."""
        self.impossible += 1
        self.impossible_ns = stamp_ns

    def jumped(self, stamp_ns: int, by_m: float) -> None:
        """Count a position that contradicts its velocity, once for all that follow within a second."""
        self.jumps += not self.jumps or stamp_ns - self.jump_ns > _ONE_JUMP_NS
        self.jump_ns, self.jump_m = stamp_ns, by_m


@dataclass(frozen=True, slots=True)
class Epoch:
    """A stretch of packets, from packet `number` on, in which the autopilot's clock ran steadily.

    It holds for certain since `since_ns`, and the clock before it did until `before_ns`. `step_ns` is by how much
    UTC − boot time changed; None where the autopilot (re)booted.
    """

    number: int
    before_ns: int
    since_ns: int
    step_ns: int | None = None


@dataclass(frozen=True, slots=True)
class Around:
    """The samples around an instant: of position, attitude and gimbal two, the nearest one, or none; of the receiver
    the nearest one; of the height above ground all.

    `boot_ns` is the instant on the autopilot's clock, known to `sigma_ns` (1 σ); `gimbal_boot_ns` on the gimbal's.
    `placed`: False where the clock stepped so near to it that the samples may be from before or after it. `jumps`: all
    that are known of, near to it or not, as if all were of one epoch.
    """

    utc_ns: int
    boot_ns: int
    sigma_ns: float
    positions: Sequence[PositionSample] = ()
    attitudes: Sequence[AttitudeSample] = ()
    gnss: GnssSample | None = None
    gimbals: Sequence[GimbalSample] = ()
    gimbal_boot_ns: int = 0
    placed: bool = True
    jumps: Sequence[Jump] = ()
    ground: Sequence[GroundSample] = ()


def boot_ns(message: MavlinkMessage) -> int:
    """A message's time since boot, from time_boot_ms or time_usec."""
    if message.get_type() == "ATTITUDE_QUATERNION_COV":
        return int(message.time_usec) * 1000
    return int(message.time_boot_ms) * 10**6 + HALF_MS_NS


def is_impossible(message: MavlinkMessage) -> bool:
    """Whether a position or an attitude can't be true: off the globe (as MAVLink's 2147483647 for unknown), higher or
    lower than 100 km, faster than 300 m/s, or not finite."""
    kind = message.get_type()
    if kind == "GLOBAL_POSITION_INT":
        heights = abs(message.alt), abs(message.relative_alt)
        if max(abs(message.vx), abs(message.vy), abs(message.vz)) > 100 * FASTEST_M_S:
            return True
        return bool(abs(message.lat) > 90 * 10**7 or abs(message.lon) > 180 * 10**7 or max(heights) > _HIGHEST_MM)
    if kind == "ATTITUDE":
        values: Iterable[float] = (message.roll, message.pitch, message.yaw)
    elif kind == "ATTITUDE_QUATERNION":
        values = (message.q1, message.q2, message.q3, message.q4)
    else:
        values = message.q
    return not all(map(math.isfinite, values))


def position(number: int, stamp_ns: int, message: MavlinkMessage) -> PositionSample | None:
    """A GLOBAL_POSITION_INT; None while the autopilot has no position."""
    if message.lat == 0 and message.lon == 0:
        return None
    return PositionSample(
        number,
        stamp_ns,
        boot_ns(message),
        math.radians(message.lat / 1e7),
        math.radians(message.lon / 1e7),
        message.alt / 1e3,
        message.relative_alt / 1e3,
        (message.vx / 100, message.vy / 100, message.vz / 100),
    )


def first_position_utc_ns(packets: Iterable[tuple[int, int, MavlinkMessage]]) -> int | None:
    """When the first known position of a log arrived (its stamp), from (number, stamp_us, message), or None."""
    for _, stamp_us, message in packets:
        if message.get_type() == "GLOBAL_POSITION_INT" and (message.lat or message.lon) and not is_impossible(message):
            return stamp_us * 1000
    return None


def attitude(number: int, stamp_ns: int, message: MavlinkMessage) -> AttitudeSample | None:
    """An attitude message; None while the autopilot has no attitude (NaN or zeros)."""
    kind, sigma_rad = message.get_type(), None
    if kind == "ATTITUDE":
        turned = from_euler(message.roll, message.pitch, message.yaw)
    elif kind == "ATTITUDE_QUATERNION":
        turned = (message.q1, message.q2, message.q3, message.q4)
    else:
        turned = tuple(message.q)
        sigma_rad = _whole_sigma([message.covariance[place] for place in (0, 4, 8)])
    try:
        turned = normalised(*turned)
    except ValueError:
        return None
    rates = (message.rollspeed, message.pitchspeed, message.yawspeed)
    known = all(math.isfinite(rate) for rate in rates)
    return AttitudeSample(number, stamp_ns, boot_ns(message), turned, rates if known else None, sigma_rad)


def attitude_sigma_rad(message: MavlinkMessage) -> float | None:
    """How well the autopilot knows its attitude, from the variances of an ODOMETRY (PX4's estimator); None where they
    are not given."""
    return _whole_sigma([message.pose_covariance[place] for place in (15, 18, 20)])  # of a 6 × 6 triangle


def _whole_sigma(variances: Sequence[float]) -> float | None:
    """1 σ of the whole rotation from the variances of its three axes; None where any of them is not given."""
    known = all(math.isfinite(one) and one > 0 for one in variances)
    return math.sqrt(sum(variances)) if known else None


def gnss(number: int, stamp_ns: int, message: MavlinkMessage) -> GnssSample:
    """A GPS_RAW_INT."""
    reported = Gnss(
        int(message.fix_type),
        None if message.satellites_visible == 255 else int(message.satellites_visible),
        _scaled(message.eph, 2**16 - 1, 100),
        _scaled(message.epv, 2**16 - 1, 100),
        _scaled(message.h_acc, 2**32 - 1, 1000),
        _scaled(message.v_acc, 2**32 - 1, 1000),
        _scaled(message.vel_acc, 2**32 - 1, 1000),
        age_ms=0.0,
    )
    place = (math.radians(message.lat / 1e7), math.radians(message.lon / 1e7), message.alt / 1e3)
    return GnssSample(number, stamp_ns, reported, place)


def gimbal(number: int, stamp_ns: int, message: MavlinkMessage, epoch: int = 0) -> GimbalSample | None:
    """A gimbal's attitude; None where it isn't valid. Roll and pitch are against the horizon in both messages."""
    kind = message.get_type()
    if kind == "MOUNT_ORIENTATION":
        angles = (math.radians(angle) for angle in (message.roll, message.pitch, message.yaw))
        turned, follows = from_euler(*angles), True
    else:
        turned, flags = tuple(message.q), int(message.flags)
        follows = not flags & (_EARTH if flags & (_EARTH | _VEHICLE) else _LOCK)
    try:
        turned = normalised(*turned)
    except ValueError:
        return None
    return GimbalSample(number, stamp_ns, boot_ns(message), message.get_srcComponent(), epoch, turned, follows, kind)


def next_gimbal(
    before: GimbalSample | None, number: int, stamp_ns: int, message: MavlinkMessage
) -> GimbalSample | None:
    """A gimbal's attitude that follows `before`; None for one that isn't valid, isn't a gimbal's, another's or a late
    copy.

    MOUNT_ORIENTATION counts until the gimbal sends the modern message; an older time is that of one that restarted.
    """
    if message.get_srcComponent() not in GIMBAL_COMPONENTS:
        return None
    sample = gimbal(number, stamp_ns, message, before.epoch if before else 0)
    if sample is None or before is None:
        return sample
    if sample.kind != "MOUNT_ORIENTATION" and before.kind == "MOUNT_ORIENTATION":
        return replace(sample, epoch=before.epoch + 1)
    if (before.component, before.kind) != (sample.component, sample.kind):
        return None
    if sample.boot_ns < before.boot_ns - NEAREST_NS:
        return replace(sample, epoch=before.epoch + 1)
    return sample if sample.boot_ns > before.boot_ns else None


def _scaled(value: int, unknown: int, parts: int) -> float | None:
    """A field in parts of its unit; 0 and the highest value stand for unknown."""
    return value / parts if 0 < value < unknown else None


def image_number(message: MavlinkMessage) -> int:
    """The autopilot's number of what a message about the shutter reports."""
    places = {"CAMERA_FEEDBACK": "img_idx", "CAMERA_TRIGGER": "seq", CAPTURED: "image_index"}
    return int(getattr(message, places[message.get_type()]))


def sent_us(message: MavlinkMessage) -> int:
    """The time that a message about the shutter has; CAMERA_IMAGE_CAPTURED has whole milliseconds, cut off."""
    if message.get_type() != CAPTURED:
        return int(message.time_usec)
    return boot_ns(message) // 1000 if message.time_boot_ms else 0


def feedback_boot_ns(message: MavlinkMessage, unix_minus_boot_ns: int | None, now_boot_ns: int) -> int | None:
    """The message's time since boot. None for 0, which is no time, and for a GPS time before SYSTEM_TIME has given the
    offset.

    ArduPilot counts the microseconds of its feedback pin in 32 bits, which wrap every 71.6 minutes: the time next to
    `now_boot_ns` is meant.
    """
    time_us = sent_us(message)
    if time_us <= 0:
        return None
    if time_us >= EPOCH_US:
        return None if unix_minus_boot_ns is None else time_us * 1000 - unix_minus_boot_ns
    if message.get_type() == "CAMERA_FEEDBACK" and time_us < WRAP_US:
        time_us += max(0, round((now_boot_ns // 1000 - time_us) / WRAP_US)) * WRAP_US
    return time_us * 1000


def feedback(
    number: int,
    stamp_ns: int,
    message: MavlinkMessage,
    now_boot_ns: int | None,
    unix_minus_boot_ns: int | None,
    *,
    mark: bool,
) -> Feedback | None:
    """The message as a Feedback; None where its time is unknown or further from now than `NEAREST_NS`. `mark`: see
    `is_mark`."""
    if now_boot_ns is None:
        return None
    boot_ns = feedback_boot_ns(message, unix_minus_boot_ns, now_boot_ns)
    if boot_ns is None or abs(boot_ns - now_boot_ns) > NEAREST_NS:
        return None
    kind, time_us = message.get_type(), sent_us(message)
    contact = mark or kind == CAPTURED or (kind == "CAMERA_FEEDBACK" and time_us < EPOCH_US)
    return Feedback(number, stamp_ns, boot_ns, MARK if mark else kind, image_number(message), contact, time_us)


def keep(history: list[N], sample: N) -> None:
    """Append. `prune` bounds a history by time; this bounds it by number, in a flood of messages."""
    history.append(sample)
    if len(history) > MOST_SAMPLES:
        del history[: MOST_SAMPLES // 4]


def prune(history: list[N], before_ns: int) -> None:
    """Forget what came before."""
    del history[: bisect_left(history, before_ns, key=lambda sample: sample.stamp_ns)]


def between(history: Sequence[N], first: int, limit: int) -> Sequence[N]:
    """Those of the packets first <= number < limit."""
    start, end = (bisect_left(history, number, key=lambda sample: sample.number) for number in (first, limit))
    return history[start:end]


def latest(history: Sequence[N], window_ns: int) -> Sequence[N]:
    """Those that arrived in the last `window_ns` before the last one."""
    if not history:
        return history
    since = history[-1].stamp_ns - window_ns
    return history[bisect_left(history, since, key=lambda sample: sample.stamp_ns) :]


def beside(history: Sequence[N], stamp_ns: int, within_ns: int) -> Sequence[N]:
    """The last that arrived up to a time, and the first after it, each within so much of it."""
    at = bisect_left(history, stamp_ns, key=lambda sample: sample.stamp_ns)
    return [one for one in history[max(0, at - 1) : at + 1] if abs(one.stamp_ns - stamp_ns) <= within_ns]


def around_instant(history: Sequence[S], boot_ns: int, *, gap_ns: int) -> tuple[S, ...]:
    """The two samples around an instant, not more than `gap_ns` apart; or the nearest one, if it is near enough; or
    none. `boot_ns` of the history must rise."""
    at = bisect_left(history, boot_ns, key=lambda sample: sample.boot_ns)
    sides = tuple(history[max(0, at - 1) : at + 1])
    if len(sides) == 2 and sides[1].boot_ns - sides[0].boot_ns <= gap_ns:
        return sides
    nearest = min(sides, key=lambda sample: abs(sample.boot_ns - boot_ns), default=None)
    return () if nearest is None or abs(nearest.boot_ns - boot_ns) > NEAREST_NS else (nearest,)


class ArrivalSteps:
    """How long after its own time each message arrived in the last five seconds: for autopilots without TIMESYNC."""

    def __init__(self) -> None:
        self._known: deque[tuple[int, int]] = deque(maxlen=_ARRIVED_MOST)  # stamp, stamp - boot time
        self._least_ns = 0  # of all of them, or less

    def sooner_ns(self, stamp_ns: int, boot_ns: int) -> int | None:
        """Take a message. By how much sooner it came than any other, where only a step of the autopilot's clock
        explains it: by 60 ms + five times what half of the others were apart."""
        while self._known and self._known[0][0] < stamp_ns - _ARRIVED_NS:
            self._known.popleft()
        offset_ns, by_ns = stamp_ns - boot_ns, None
        if len(self._known) >= _ARRIVED_FEW and offset_ns < self._least_ns - _SOONER_NS:
            others = sorted(one for _, one in self._known)
            early_ns = others[0] - offset_ns
            if early_ns > _SOONER_NS + _SOONER_SHARE * (others[len(others) // 2] - others[0]):
                by_ns = early_ns
                self._known.clear()
        if not self._known or offset_ns < self._least_ns:
            self._least_ns = offset_ns
        self._known.append((stamp_ns, offset_ns))
        return by_ns

    @property
    def last_ns(self) -> int:
        """When the last one arrived; 0: none did."""
        return self._known[-1][0] if self._known else 0

    def forget(self) -> None:
        """The autopilot has started again."""
        self._known.clear()


@dataclass(frozen=True, slots=True)
class UtcCorrection:
    """What to add to this machine's UTC to get the autopilot's, ± 1 σ. `by_fix`: its receiver had a fix."""

    correction_ns: int
    sigma_ns: int
    source: str
    by_fix: bool = False

    def replaces(self, older: UtcCorrection) -> bool:
        """Whether it is twice as precise, or contradicts one that was not better founded."""
        if abs(self.correction_ns - older.correction_ns) > 3 * math.hypot(self.sigma_ns, older.sigma_ns) + _UTC_STEP_NS:
            return self.by_fix or not older.by_fix
        return self.sigma_ns * 2 <= older.sigma_ns
