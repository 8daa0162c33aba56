"""The values that a flight is made of. All are facts, written once; what is not known is None.

One number, the image index, names a shot, the frame that it became, its file, and its CAMERA_IMAGE_CAPTURED. It goes
on over restarts. A shot that failed keeps its index.
"""

from __future__ import annotations

import hashlib
import json
from collections.abc import Mapping
from dataclasses import asdict, dataclass
from typing import Any, Literal

Vector3 = tuple[float, float, float]
Quaternion = tuple[float, float, float, float]
Symmetric = tuple[float, float, float, float, float, float]  # a 3 × 3 matrix's upper triangle: xx, xy, xz, yy, yz, zz
ShotState = Literal["wished", "fired", "safe", "failed"]


@dataclass(frozen=True, slots=True)
class Cause:
    """Who wanted the shot. `source` is "mavlink:255/190", "console", "replay" …; `kind` the message or act."""

    source: str
    kind: str
    sequence: int | None = None


@dataclass(frozen=True, slots=True)
class Shot:
    """One wish to expose, with its cause. Times are the daemon's own clocks at the wish."""

    index: int
    cause: Cause
    wished_utc_ns: int
    wished_monotonic_ns: int


@dataclass(frozen=True, slots=True)
class Frame:
    """What the camera delivered for a shot, safe on disk: `name` is relative to the flight folder."""

    index: int
    name: str
    camera_name: str
    size: int
    sha256: str
    arrived_utc_ns: int


@dataclass(frozen=True, slots=True)
class Gnss:
    """What the receiver last said of itself before the exposure (GPS_RAW_INT). Accuracies are one sigma as it tells.

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
class Pose:
    """Position and attitude of the vehicle at mid-exposure, and how well each is known.

    `attitude` is the unit quaternion (w, x, y, z) from body (forward, right, down) to north-east-down. Sigmas are one
    standard deviation; `position_sigma_m` is horizontal, as a distance. `source` says how the pose was had:
    "interpolated", "nearest" (no sample on one side: marked, not hidden) or "none". `age_ms` is the time from
    mid-exposure to the nearest position sample. `telemetry_packets` is how many packets of telemetry.tlog were taken
    into account: a replay stops there too. `gimbal_attitude` is that of a gimbal's head (forward, right, down) to
    north-east-down, where one reports it; `gimbal_source` names its message. Covariances: the position's in
    north-east-down, the attitude's in body axes (forward, right, down); what an unknown time adds lies along the way.
    """

    source: Literal["interpolated", "nearest", "none"]
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


@dataclass(frozen=True, slots=True)
class Tag:
    """What is known of a frame apart from its pixels. Times are mid-exposure, UTC; sigma one standard deviation."""

    index: int
    utc_ns: int
    utc_sigma_ns: int
    time_source: str
    focal_length_mm: float | None
    f_number: float | None
    exposure_s: float | None
    iso: float | None
    camera: str
    mask: str
    frame_sha256: str
    pose: Pose


def canonical(value: Any) -> bytes:
    """One byte string for equal values: JSON with sorted keys, no spaces, shortest round-trip floats, no NaN."""
    return json.dumps(value, sort_keys=True, separators=(",", ":"), allow_nan=False).encode()


def digest(record: Pose | Tag | Mapping[str, Any]) -> str:
    """SHA-256 (hex) of a record's canonical form."""
    value = record if isinstance(record, Mapping) else asdict(record)
    return hashlib.sha256(canonical(value)).hexdigest()
