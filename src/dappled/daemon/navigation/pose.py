"""From the samples around an instant to the pose at it, with what is known of its errors. Pure functions."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import asdict, dataclass, replace

from dappled.daemon.navigation.samples import HALF_MS_NS, AttitudeSample, GimbalSample, GnssSample, PositionSample
from dappled.decode.geometry.interpolation import (
    hermite,
    hermite_doubt,
    metres_per_radian,
    norm,
    slerp,
    slerp_doubt,
    turn_rad,
    turned_by_heading,
)
from dappled.decode.geometry.pose import Gnss, Pose, Quaternion, Symmetric, Vector3

NEAREST_NS = 10 * 10**9
# A single-frequency receiver under open sky, where it reports a dilution only; GPS_FIX_TYPE → metres for each unit.
METRES_PER_DOP = {2: 2.5, 3: 2.5, 4: 1.0, 5: 0.3, 6: 0.02, 7: 0.02, 8: 0.05}


@dataclass(frozen=True, slots=True)
class Around:
    """What is there of an instant: of position, attitude and gimbal two samples around it, the nearest one, or none;
    of the receiver the nearest word.

    `boot_ns` is the instant on the autopilot's clock, known to `sigma_ns` (1 σ); `gimbal_boot_ns` on the gimbal's.
    """

    utc_ns: int
    boot_ns: int
    sigma_ns: float
    positions: Sequence[PositionSample] = ()
    attitudes: Sequence[AttitudeSample] = ()
    gnss: GnssSample | None = None
    gimbals: Sequence[GimbalSample] = ()
    gimbal_boot_ns: int = 0


def pose(at: Around, *, packets: int, attitude_sigma_rad: float = 0.0) -> Pose:
    """The pose at an instant, from `packets` packets.

    Position: cubic Hermite with the reported velocities. Attitude and gimbal: slerp. With one sample only, that one,
    marked "nearest". Sigmas: time (exposure and clocks) × speed and × turn rate, with the age of a single sample; what
    interpolation leaves in doubt; the receiver's accuracy (without one the position's sigmas are None); the attitude's
    own, as the autopilot tells it, else `attitude_sigma_rad`.
    """
    sigma_s = math.hypot(at.sigma_ns, HALF_MS_NS / math.sqrt(3)) / 1e9
    attitude, attitude_sigma, attitude_covariance = _attitude(at, sigma_s, attitude_sigma_rad)
    gimbal, gimbal_source = _gimbal(at, attitude)
    made = replace(
        nothing(at.utc_ns, packets),
        boot_us=at.boot_ns // 1000,
        attitude=attitude,
        attitude_sigma_rad=attitude_sigma,
        gnss=_gnss(at),
        gimbal_attitude=gimbal,
        gimbal_source=gimbal_source,
        attitude_covariance_rad2=attitude_covariance,
    )
    if not at.positions:
        return made
    found, across_doubt_m, upright_doubt_m = position(at.positions, at.boot_ns)
    age_s = min(abs(sample.boot_ns - at.boot_ns) for sample in at.positions) / 1e9
    blur_s = sigma_s if len(at.positions) == 2 else math.hypot(sigma_s, age_s)
    north, east, down = found.velocity_ned_m_s
    across_m = _receiver_sigma_m(at.gnss, at.gnss.horizontal_accuracy_m, at.gnss.hdop) if at.gnss else None
    upright_m = _receiver_sigma_m(at.gnss, at.gnss.vertical_accuracy_m, at.gnss.vdop) if at.gnss else None
    covariance = None
    if across_m is not None and upright_m is not None:
        across = (across_m**2 + across_doubt_m**2) / 2  # of each axis
        covariance = _symmetric(found.velocity_ned_m_s, blur_s, (across, across, upright_m**2 + upright_doubt_m**2))
    return replace(
        made,
        source="interpolated" if len(at.positions) == 2 and len(at.attitudes) != 1 else "nearest",
        latitude_rad=found.latitude_rad,
        longitude_rad=found.longitude_rad,
        altitude_msl_m=found.altitude_msl_m,
        height_above_home_m=found.height_above_home_m,
        velocity_ned_m_s=found.velocity_ned_m_s,
        position_sigma_m=None
        if across_m is None
        else math.hypot(across_m, math.hypot(north, east) * blur_s, across_doubt_m),
        vertical_sigma_m=None if upright_m is None else math.hypot(upright_m, down * blur_s, upright_doubt_m),
        position_covariance_m2=covariance,
        age_ms=age_s * 1e3,
    )


def nothing(utc_ns: int, packets: int) -> Pose:
    """A pose of which nothing is known."""
    return Pose("none", utc_ns, None, None, None, None, None, None, None, None, None, None, packets)


def position(samples: Sequence[PositionSample], boot_ns: int) -> tuple[PositionSample, float, float]:
    """The sample that would stand at `boot_ns`, from one or two; and how many metres (1 σ) two leave it in doubt,
    horizontally and vertically."""
    a = samples[0]
    if len(samples) == 1:
        return a, 0.0, 0.0
    b = samples[1]
    span_s = (b.boot_ns - a.boot_ns) / 1e9
    share = (boot_ns - a.boot_ns) / (b.boot_ns - a.boot_ns)
    north_m, east_m = metres_per_radian(a.latitude_rad, a.altitude_msl_m)
    va, vb = a.velocity_ned_m_s, b.velocity_ned_m_s
    to_b = (
        (b.latitude_rad - a.latitude_rad) * north_m,
        math.remainder(b.longitude_rad - a.longitude_rad, 2 * math.pi) * east_m,
        a.altitude_msl_m - b.altitude_msl_m,
    )
    north, east, down = (hermite((0.0, to_b[i]), (va[i], vb[i]), span_s, share) for i in range(3))
    height = b.height_above_home_m - a.height_above_home_m
    vn, ve, vd = ((1 - share) * va[i] + share * vb[i] for i in range(3))
    found = PositionSample(
        b.number,
        b.stamp_ns,
        boot_ns,
        a.latitude_rad + north / north_m,
        math.remainder(a.longitude_rad + east / east_m, 2 * math.pi),
        a.altitude_msl_m - down,
        a.height_above_home_m + hermite((0.0, height), (-va[2], -vb[2]), span_s, share),
        (vn, ve, vd),
    )
    doubts = [hermite_doubt(to_b[i], (va[i], vb[i]), span_s, share) for i in range(3)]
    return found, math.hypot(doubts[0], doubts[1]), doubts[2]


def attitude(samples: Sequence[AttitudeSample], boot_ns: int) -> tuple[Quaternion, float]:
    """The attitude at `boot_ns`, from one or two samples; and how far (1 σ, radians) two leave it in doubt."""
    a = samples[0]
    if len(samples) == 1:
        return a.attitude, 0.0
    b = samples[1]
    share = (boot_ns - a.boot_ns) / (b.boot_ns - a.boot_ns)
    span_s = (b.boot_ns - a.boot_ns) / 1e9
    doubt = (
        0.0
        if a.rates_rad_s is None or b.rates_rad_s is None
        else slerp_doubt((a.attitude, b.attitude), (a.rates_rad_s, b.rates_rad_s), span_s, share)
    )
    return slerp(a.attitude, b.attitude, share), doubt


def _attitude(at: Around, sigma_s: float, own_rad: float) -> tuple[Quaternion | None, float | None, Symmetric | None]:
    """Attitude, σ of the whole turn, and the covariance where the body's rates are known."""
    samples = at.attitudes
    if not samples:
        return None, None, None
    found, doubt = attitude(samples, at.boot_ns)
    told = max((sample.sigma_rad for sample in samples if sample.sigma_rad is not None), default=own_rad)
    rates = max((s.rates_rad_s for s in samples if s.rates_rad_s is not None), key=norm, default=None)
    if len(samples) == 1:
        sigma_s = math.hypot(sigma_s, abs(samples[0].boot_ns - at.boot_ns) / 1e9)
    if rates is not None:
        each = (doubt**2 + told**2) / 3  # of each axis
        covariance = _symmetric(rates, sigma_s, (each, each, each))
        return found, math.hypot(norm(rates) * sigma_s, doubt, told), covariance
    if len(samples) == 1:
        return found, None, None
    span_s = (samples[1].boot_ns - samples[0].boot_ns) / 1e9
    rate = turn_rad(samples[0].attitude, samples[1].attitude) / span_s
    return found, math.hypot(rate * sigma_s, doubt, told), None


def _symmetric(way: Vector3, sigma_s: float, own: Vector3) -> Symmetric:
    """The covariance of what moves along `way` (per second) for a time known to `sigma_s`, with its own variances."""
    x, y, z = (part * sigma_s for part in way)
    return x * x + own[0], x * y, x * z, y * y + own[1], y * z, z * z + own[2]


def _gimbal(at: Around, vehicle: Quaternion | None) -> tuple[Quaternion | None, str | None]:
    """The head's attitude to north-east-down; None where it follows the vehicle, whose heading is not known."""
    if not at.gimbals:
        return None, None
    a, b = at.gimbals[0], at.gimbals[-1]
    share = 0.0 if a is b else (at.gimbal_boot_ns - a.boot_ns) / (b.boot_ns - a.boot_ns)
    head = slerp(a.attitude, b.attitude, share)
    if not a.follows_vehicle:
        return head, a.kind
    return (None, None) if vehicle is None else (turned_by_heading(head, vehicle), a.kind)


def _gnss(at: Around) -> Gnss | None:
    if at.gnss is None:
        return None
    told = {name: value for name, value in asdict(at.gnss).items() if name not in ("number", "stamp_ns")}
    return Gnss(**told, age_ms=abs(at.utc_ns - at.gnss.stamp_ns) / 1e6)


def _receiver_sigma_m(receiver: GnssSample, accuracy_m: float | None, dilution: float | None) -> float | None:
    """The receiver's own accuracy, else what its dilution of precision suggests."""
    each_m = METRES_PER_DOP.get(receiver.fix_type)
    return accuracy_m or (None if dilution is None or each_m is None else dilution * each_m)
