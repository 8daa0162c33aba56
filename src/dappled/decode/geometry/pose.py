"""The pose of the vehicle at an instant with its errors, interpolation of poses, and how a frame moves at a pose."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Literal, Protocol

Vector3 = tuple[float, float, float]
Quaternion = tuple[float, float, float, float]
Symmetric = tuple[float, float, float, float, float, float]  # a 3 × 3 matrix's upper triangle: xx, xy, xz, yy, yz, zz
_WGS84_A_M = 6378137.0  # WGS 84: the semi-major axis
_WGS84_E2 = 6.69437999014e-3  # WGS 84: the first eccentricity squared
_SWAY_S = 0.06  # within less, a multicopter's turn rate is as good as a straight line
_SHALLOW = 0.05  # below 3° under the horizon the ground is too far for a flat one


@dataclass(frozen=True, slots=True)
class Gnss:
    """The receiver's last report before the exposure (GPS_RAW_INT). Accuracies are one sigma, as it reports them.

    `fix_type` is MAVLink's GPS_FIX_TYPE: 3 is 3D, 5 RTK float, 6 RTK fixed. `age_ms` counts up to the exposure.
    """

    fix_type: int
    satellites: int | None
    hdop: float | None
    vdop: float | None
    horizontal_accuracy_m: float | None
    vertical_accuracy_m: float | None
    velocity_accuracy_m_s: float | None
    age_ms: float


@dataclass(frozen=True, slots=True)
class GroundHeight:
    """The vehicle's height above the ground straight below it, as it was reported `age_ms` before or after the pose.

    `source`: "rangefinder" (its distance along the beam, by the cosine of the vehicle's tilt) or "terrain" (the
    autopilot's, above terrain that it knows). `sigma_m` is None where the sensor doesn't tell its accuracy.
    """

    metres: float
    sigma_m: float | None
    source: str
    age_ms: float


@dataclass(frozen=True, slots=True)
class Pose:
    """Position and attitude of the vehicle at mid-exposure, and how well each is known.

    `attitude` is the unit quaternion (w, x, y, z) from body (forward, right, down) to north-east-down. Sigmas are one
    standard deviation; `position_sigma_m` is horizontal, as a distance. `source` says where the pose comes
    from: "interpolated", "nearest" (no sample on one side), "none", or, on the ground only, "mark" (the position is
    that of a GNSS mark after PPK). `age_ms` is the time from mid-exposure to the nearest position sample.
    `telemetry_packets` is how many packets of telemetry.tlog were used: a replay stops there too. `gimbal_attitude` is
    that of a gimbal's head (forward, right, down) to north-east-down, where one reports it; `gimbal_source` names its
    message. `ground` is the height above the ground below, where something measures it. Covariances: the position's in
    north-east-down, the attitude's in body axes (forward, right, down); an uncertain time adds to them along the
    motion.
    """

    source: Literal["interpolated", "nearest", "none", "mark"]
    utc_ns: int
    boot_us: int | None
    latitude_rad: float | None
    longitude_rad: float | None
    altitude_msl_m: float | None
    height_above_home_m: float | None
    velocity_ned_m_s: Vector3 | None
    attitude: Quaternion | None
    position_sigma_m: float | None
    attitude_sigma_rad: float | None
    age_ms: float | None
    telemetry_packets: int
    vertical_sigma_m: float | None = None
    gnss: Gnss | None = None
    gimbal_attitude: Quaternion | None = None
    gimbal_source: str | None = None
    position_covariance_m2: Symmetric | None = None
    attitude_covariance_rad2: Symmetric | None = None
    ground: GroundHeight | None = None

    @classmethod
    def unknown(cls, utc_ns: int, packets: int) -> Pose:
        """A pose without any telemetry in so many packets."""
        return cls("none", utc_ns, None, None, None, None, None, None, None, None, None, None, packets)


class Located(Protocol):
    """Whatever has latitude, longitude and altitude."""

    @property
    def latitude_rad(self) -> float: ...

    @property
    def longitude_rad(self) -> float: ...

    @property
    def altitude_msl_m(self) -> float: ...


def hermite(ends: tuple[float, float], slopes: tuple[float, float], span_s: float, share: float) -> float:
    """The cubic with these values and slopes (per second) at the ends of `span_s`, at `share` in 0..1 of it."""
    (p0, p1), (v0, v1), u = ends, slopes, share
    return (
        (2 * u**3 - 3 * u**2 + 1) * p0
        + (u**3 - 2 * u**2 + u) * span_s * v0
        + (3 * u**2 - 2 * u**3) * p1
        + (u**3 - u**2) * span_s * v1
    )


def slerp(a: Quaternion, b: Quaternion, share: float) -> Quaternion:
    """The unit quaternion at `share` of the shorter rotation from `a` to `b` (both unit)."""
    dot = sum(x * y for x, y in zip(a, b, strict=True))
    if dot < 0:
        b, dot = (-b[0], -b[1], -b[2], -b[3]), -dot
    if dot > 0.9999:  # sin(angle) loses digits; the chord is as good as the arc here, once normalised
        return normalised((1 - share) * a[0] + share * b[0], (1 - share) * a[1] + share * b[1],
                          (1 - share) * a[2] + share * b[2], (1 - share) * a[3] + share * b[3])  # fmt: skip
    angle = math.acos(dot)
    wa, wb = math.sin((1 - share) * angle) / math.sin(angle), math.sin(share * angle) / math.sin(angle)
    return normalised(*(wa * x + wb * y for x, y in zip(a, b, strict=True)))


def normalised(*parts: float) -> Quaternion:
    """Four numbers as a unit quaternion. Raises ValueError for zero length or numbers that are not finite."""
    w, x, y, z = parts
    length = math.sqrt(w * w + x * x + y * y + z * z)
    if not (math.isfinite(length) and length > 1e-6):
        raise ValueError("not a quaternion")
    return w / length, x / length, y / length, z / length


def hermite_doubt(moved: float, slopes: tuple[float, float], span_s: float, share: float) -> float:
    """The error (1 σ) of `hermite` at `share` of a distance `moved`, with these slopes at its ends.

    Half of the difference between the distance and the mean of its slopes, in the middle.
    """
    return 0.5 * abs(moved - 0.5 * (slopes[0] + slopes[1]) * span_s) * (4 * share * (1 - share)) ** 2


def slerp_doubt(
    ends: tuple[Quaternion, Quaternion], rates: tuple[Vector3, Vector3], span_s: float, share: float
) -> float:
    """The error of `slerp` at `share` (1 σ, radians): the cubic that also has the body's rates (rad/s) at the ends,
    less the even rotation."""
    even = rotation_vector(multiply(conjugate(ends[0]), ends[1]))
    u = share
    begin, end = u**3 - 2 * u**2 + u, u**3 - u**2
    off = [begin * (rates[0][i] * span_s - even[i]) + end * (rates[1][i] * span_s - even[i]) for i in range(3)]
    return math.hypot(*off)


def multiply(a: Quaternion, b: Quaternion) -> Quaternion:
    """The rotation `b` followed by the rotation `a`."""
    aw, ax, ay, az = a
    bw, bx, by, bz = b
    return (
        aw * bw - ax * bx - ay * by - az * bz,
        aw * bx + ax * bw + ay * bz - az * by,
        aw * by - ax * bz + ay * bw + az * bx,
        aw * bz + ax * by - ay * bx + az * bw,
    )


def conjugate(q: Quaternion) -> Quaternion:
    """The inverse rotation of a unit quaternion."""
    return q[0], -q[1], -q[2], -q[3]


def rotation_vector(q: Quaternion) -> Vector3:
    """A unit quaternion as axis × angle, the shorter way."""
    sign = math.copysign(1.0, q[0])
    length = norm((q[1], q[2], q[3]))
    scale = 2.0 if length < 1e-12 else 2 * math.atan2(length, abs(q[0])) / length
    return sign * scale * q[1], sign * scale * q[2], sign * scale * q[3]


def turned_by_heading(q: Quaternion, vehicle: Quaternion) -> Quaternion:
    """`q`, whose yaw counts from the vehicle's nose, relative to north: rotated about the vertical by the heading."""
    w, x, y, z = vehicle
    half = 0.5 * math.atan2(2 * (w * z + x * y), 1 - 2 * (y * y + z * z))
    return multiply((math.cos(half), 0.0, 0.0, math.sin(half)), q)


def from_euler(roll_rad: float, pitch_rad: float, yaw_rad: float) -> Quaternion:
    """Aerospace angles (yaw, then pitch, then roll) as a quaternion, body to north-east-down."""
    cr, sr = math.cos(roll_rad / 2), math.sin(roll_rad / 2)
    cp, sp = math.cos(pitch_rad / 2), math.sin(pitch_rad / 2)
    cy, sy = math.cos(yaw_rad / 2), math.sin(yaw_rad / 2)
    return (
        cr * cp * cy + sr * sp * sy,
        sr * cp * cy - cr * sp * sy,
        cr * sp * cy + sr * cp * sy,
        cr * cp * sy - sr * sp * cy,
    )


def turn_rad(a: Quaternion, b: Quaternion) -> float:
    """The angle between two attitudes."""
    cross = (
        a[0] * b[1] - a[1] * b[0] - a[2] * b[3] + a[3] * b[2],
        a[0] * b[2] - a[2] * b[0] - a[3] * b[1] + a[1] * b[3],
        a[0] * b[3] - a[3] * b[0] - a[1] * b[2] + a[2] * b[1],
    )
    dot = sum(x * y for x, y in zip(a, b, strict=True))
    return 2 * math.atan2(math.hypot(*cross), abs(dot))


def turn_rates(
    ends: tuple[Quaternion, Quaternion], rates: tuple[Vector3 | None, Vector3 | None], span_s: float, share: float
) -> Vector3:
    """The body's turn rates (rad/s, about its own axes) at `share` of `span_s`: between those at its ends, where both
    are known; else by the turn from one end to the other.

    Where the ends are far apart, by the parabola through both that makes the turn between them: a sway may be slow at
    both ends and fast in between.
    """
    a, b = rates
    turn = rotation_vector(multiply(conjugate(ends[0]), ends[1]))
    if a is None or b is None:
        return turn[0] / span_s, turn[1] / span_s, turn[2] / span_s
    bow = 6 * share * (1 - share) if span_s > _SWAY_S else 0.0
    x, y, z = (
        (1 - share) * one + share * other + bow * (whole / span_s - (one + other) / 2)
        for one, other, whole in zip(a, b, turn, strict=True)
    )
    return x, y, z


def metres_per_radian(latitude_rad: float, altitude_m: float) -> tuple[float, float]:
    """North and east metres for one radian of latitude and of longitude, on WGS 84."""
    curvature = 1 - _WGS84_E2 * math.sin(latitude_rad) ** 2
    north = _WGS84_A_M * (1 - _WGS84_E2) / curvature**1.5 + altitude_m
    east = (_WGS84_A_M / math.sqrt(curvature) + altitude_m) * math.cos(latitude_rad)
    return north, east


def displacement(a: Located, b: Located) -> Vector3:
    """From `a` to `b`: north, east and down, metres."""
    north_m, east_m = metres_per_radian(a.latitude_rad, a.altitude_msl_m)
    return (
        (b.latitude_rad - a.latitude_rad) * north_m,
        math.remainder(b.longitude_rad - a.longitude_rad, 2 * math.pi) * east_m,
        a.altitude_msl_m - b.altitude_msl_m,
    )


def norm(vector: Vector3) -> float:
    """Length."""
    return math.hypot(*vector)


def turned(q: Quaternion, v: Vector3) -> Vector3:
    """v rotated by q (w, x, y, z)."""
    w, x, y, z = q
    vx, vy, vz = v
    tx, ty, tz = 2 * (y * vz - z * vy), 2 * (z * vx - x * vz), 2 * (x * vy - y * vx)
    return (
        vx + w * tx + y * tz - z * ty,
        vy + w * ty + z * tx - x * tz,
        vz + w * tz + x * ty - y * tx,
    )


@dataclass(frozen=True, slots=True)
class FrameGeometry:
    """A pinhole camera on a vehicle over flat ground.

    `mount` are nine numbers row by row, camera axes (right, down, forward) to body axes; `side_mm` is (height, width)
    of the sensor, `view_mm` the (row, column) pitch of a view; `height_m` is above the ground.
    """

    mount: Sequence[float]
    focal_length_mm: float
    side_mm: tuple[float, float]
    view_mm: tuple[float, float]
    height_m: float


def image_motion(
    camera: FrameGeometry, attitude: Quaternion, velocity_ned_m_s: Vector3, rates_rad_s: Vector3
) -> tuple[float, float] | None:
    """How fast still ground moves over the sensor, (down, right) in mm/s, of 3 × 3 places where it moves fastest in
    pixels of a view.

    `rates_rad_s` are the body's, about its own axes. Of a ground point at P in camera axes, with the camera's velocity
    v and turn ω: dP/dt = −v − ω × P, and on the sensor x = f · X / Z. Where a place sees no ground (above 3° under the
    horizon) only the turn moves it. None where no place sees ground.
    """
    body = [turned(conjugate(attitude), velocity_ned_m_s), rates_rad_s, turned(conjugate(attitude), (0.0, 0.0, 1.0))]
    v, w, down = (_in_camera(camera.mount, one) for one in body)
    f, fastest, most, seen = camera.focal_length_mm, (0.0, 0.0), -1.0, False
    for row in (-0.5, 0.0, 0.5):
        for column in (-0.5, 0.0, 0.5):
            x, y = column * camera.side_mm[1] / f, row * camera.side_mm[0] / f
            falls = x * down[0] + y * down[1] + down[2]  # of a ray with one unit ahead
            near = 0.0  # 1 / Z
            if falls > _SHALLOW * math.hypot(x, y, 1.0):
                near, seen = falls / camera.height_m, True
            ahead = -v[2] * near - (w[0] * y - w[1] * x)
            right = -v[0] * near - (w[1] - w[2] * y) - x * ahead
            below = -v[1] * near - (w[2] * x - w[0]) - y * ahead
            if (pixels := math.hypot(below / camera.view_mm[0], right / camera.view_mm[1])) > most:
                fastest, most = (below, right), pixels
    return (f * fastest[0], f * fastest[1]) if seen else None


def _in_camera(mount: Sequence[float], v: Vector3) -> Vector3:
    """A vector in body axes, in camera axes."""
    x, y, z = (sum(mount[3 * row + column] * v[row] for row in range(3)) for column in range(3))
    return x, y, z
