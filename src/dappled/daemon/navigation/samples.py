"""Turn telemetry messages into samples of position, attitude, receiver and gimbal, and keep histories of them.

A message without a value gives None. A history is a list of samples in the order of their packets.
"""

from __future__ import annotations

import math
from bisect import bisect_left
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Protocol, TypeVar

from dappled.daemon.navigation.clocks import EPOCH_US
from dappled.decode.geometry import Gnss, Quaternion, Vector3, from_euler, normalised
from dappled.drivers.mavlink import MavlinkMessage, mavlink

HALF_MS_NS = 500_000  # time_boot_ms is cut to whole milliseconds: the middle is used
GIMBAL_COMPONENTS = frozenset({1, 154, 171, 172, 173, 174, 175})  # an autopilot reports for a gimbal without MAVLink
_EARTH = mavlink.GIMBAL_DEVICE_FLAGS_YAW_IN_EARTH_FRAME
_VEHICLE = mavlink.GIMBAL_DEVICE_FLAGS_YAW_IN_VEHICLE_FRAME
_LOCK = mavlink.GIMBAL_DEVICE_FLAGS_YAW_LOCK
_WRAP_US = 2**32
NEAREST_NS = 10 * 10**9
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
    """One GPS_RAW_INT, of age 0; what the receiver doesn't report is None."""

    number: int
    stamp_ns: int
    reported: Gnss


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


@dataclass(slots=True)
class Counts:
    """How much of all vehicles was used so far, and how much came out of order."""

    positions: int = 0
    attitudes: int = 0
    feedbacks: int = 0
    out_of_order: int = 0


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
    the nearest one.

    `boot_ns` is the instant on the autopilot's clock, known to `sigma_ns` (1 σ); `gimbal_boot_ns` on the gimbal's.
    `placed`: False where the clock stepped so near to it that the samples may be from before or after it.
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


def boot_ns(message: MavlinkMessage) -> int:
    """A message's time since boot, from time_boot_ms or time_usec."""
    if message.get_type() == "ATTITUDE_QUATERNION_COV":
        return int(message.time_usec) * 1000
    return int(message.time_boot_ms) * 10**6 + HALF_MS_NS


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


def attitude(number: int, stamp_ns: int, message: MavlinkMessage) -> AttitudeSample | None:
    """An attitude message; None while the autopilot has no attitude (NaN or zeros)."""
    kind, sigma_rad = message.get_type(), None
    if kind == "ATTITUDE":
        turned = from_euler(message.roll, message.pitch, message.yaw)
    elif kind == "ATTITUDE_QUATERNION":
        turned = (message.q1, message.q2, message.q3, message.q4)
    else:
        turned = tuple(message.q)
        variance = message.covariance[0] + message.covariance[4] + message.covariance[8]
        sigma_rad = math.sqrt(variance) if variance > 0 else None  # NaN: not known
    try:
        turned = normalised(*turned)
    except ValueError:
        return None
    rates = (message.rollspeed, message.pitchspeed, message.yawspeed)
    known = all(math.isfinite(rate) for rate in rates)
    return AttitudeSample(number, stamp_ns, boot_ns(message), turned, rates if known else None, sigma_rad)


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
    return GnssSample(number, stamp_ns, reported)


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


def _scaled(value: int, unknown: int, parts: int) -> float | None:
    """A field in parts of its unit; 0 and the highest value stand for unknown."""
    return value / parts if 0 < value < unknown else None


def feedback_boot_ns(
    message: MavlinkMessage, unix_minus_boot_ns: int | None, now_boot_ns: int, *, unwrap: bool = True
) -> int | None:
    """The message's time since boot. None for 0, which is no time, and for a GPS time before SYSTEM_TIME has given the
    offset.

    ArduPilot counts the microseconds of its feedback pin in 32 bits, which wrap every 71.6 minutes: the time next to
    `now_boot_ns` is meant.
    """
    time_us = int(message.time_usec)
    if time_us <= 0:
        return None
    if time_us >= EPOCH_US:
        return None if unix_minus_boot_ns is None else time_us * 1000 - unix_minus_boot_ns
    if unwrap and message.get_type() == "CAMERA_FEEDBACK" and time_us < _WRAP_US:
        time_us += max(0, round((now_boot_ns // 1000 - time_us) / _WRAP_US)) * _WRAP_US
    return time_us * 1000


def keep(history: list[N], sample: N) -> None:
    """Append. `prune` bounds a history by time; this bounds it by number, in a flood of messages."""
    history.append(sample)
    if len(history) > MOST_SAMPLES:
        del history[: MOST_SAMPLES // 4]


def prune(history: list[N], before_ns: int) -> None:
    """Forget what came before."""
    del history[: bisect_left(history, before_ns, key=lambda sample: sample.stamp_ns)]
