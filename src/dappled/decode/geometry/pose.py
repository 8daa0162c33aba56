"""Pose of the vehicle at an instant, with what is known of its errors."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

Vector3 = tuple[float, float, float]
Quaternion = tuple[float, float, float, float]
Symmetric = tuple[float, float, float, float, float, float]  # a 3 × 3 matrix's upper triangle: xx, xy, xz, yy, yz, zz


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
