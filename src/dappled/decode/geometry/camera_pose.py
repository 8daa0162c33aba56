"""Derive the camera's pose from the vehicle's recorded one: lever arm, mount, and angles as other programs use them.

A mount is the 3 × 3 matrix from camera axes (right, down, forward through the lens) to body axes (forward, right,
down); its columns say where each camera axis points on the vehicle.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from functools import cache
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from dappled.decode.geometry.pose import Pose, Quaternion, Vector3
from dappled.errors import DappledError

if TYPE_CHECKING:
    import pyproj

Matrix = NDArray[np.float64]

NADIR: Matrix = np.array([[0.0, -1.0, 0.0], [1.0, 0.0, 0.0], [0.0, 0.0, 1.0]])  # looks down, image top forward
FORWARD: Matrix = np.array([[0.0, 0.0, 1.0], [1.0, 0.0, 0.0], [0.0, 1.0, 0.0]])  # looks forward, image top up
_GEODETIC, _GEOCENTRIC = "EPSG:4979", "EPSG:4978"  # both on WGS 84, heights above the ellipsoid


@dataclass(frozen=True, slots=True)
class Angles:
    """Yaw, pitch and roll in degrees, applied in this order; yaw from 0 to 360."""

    yaw_deg: float
    pitch_deg: float
    roll_deg: float


@dataclass(frozen=True, slots=True)
class CameraPose:
    """The perspective centre at mid-exposure and where the camera looks; None is unknown.

    `pix4d`: all zero looks down with the image's top to the north, pitch 90 looks to the horizon. `dji`: pitch 0 looks
    to the horizon, −90 down. `vehicle`: the aircraft's own. `lever_applied` False: the position is the antenna's.
    `height_ellipsoid_m` is known where the geoid is.
    """

    latitude_deg: float
    longitude_deg: float
    altitude_msl_m: float
    height_above_home_m: float | None
    pix4d: Angles | None
    dji: Angles | None
    vehicle: Angles | None
    lever_applied: bool
    height_ellipsoid_m: float | None = None


def mount(values: tuple[float, ...]) -> Matrix:
    """A mount from nine numbers, row by row. Raises DappledError where they are not a rotation (to 1e-3)."""
    matrix = np.array(values, dtype=np.float64).reshape(-1)
    if matrix.shape == (9,):
        square: Matrix = matrix.reshape(3, 3)
        if np.allclose(square @ square.T, np.eye(3), atol=1e-3) and np.linalg.det(square) > 0:
            left, _, right = np.linalg.svd(square)
            nearest: Matrix = left @ right
            return nearest
    raise DappledError(
        f"the mount {list(values)} is not a rotation: give nine numbers, row by row, camera axes to body"
    )


def of(
    pose: Pose,
    lever_m: Vector3 = (0.0, 0.0, 0.0),
    camera_mount: Matrix = NADIR,
    *,
    on_gimbal: bool = False,
    undulation_m: float | None = None,
) -> CameraPose | None:
    """The camera's pose; None where the vehicle's position is not known.

    `lever_m` goes from the antenna (the autopilot's position) to the perspective centre, in body axes, metres.
    `on_gimbal`: the camera hangs on the gimbal, whose recorded attitude is used, and the mount turns camera axes into
    those of its head. `undulation_m` is the height of mean sea level above the ellipsoid there.
    """
    if pose.latitude_rad is None or pose.longitude_rad is None or pose.altitude_msl_m is None:
        return None
    latitude, longitude, altitude = pose.latitude_rad, pose.longitude_rad, pose.altitude_msl_m
    height, applied = pose.height_above_home_m, not any(lever_m)
    if pose.attitude is not None and any(lever_m):
        # Eq 1, corrected: X_camera = X_antenna + R(ned → ecef) · R(body → ned) · lever. Only the lever is turned.
        # (Without the geoid, sea level is used for the ellipsoid: at 50 m between them the error is 1e-5 of the lever.)
        ned = matrix_of(pose.attitude) @ np.array(lever_m)
        base = undulation_m or 0.0
        place = to_ecef(latitude, longitude, altitude + base) + ned_to_ecef(latitude, longitude) @ ned
        latitude, longitude, above = from_ecef(place)
        altitude, applied = above - base, True
        height = None if height is None else height - float(ned[2])
    head = pose.gimbal_attitude if on_gimbal else pose.attitude
    camera = None if head is None else matrix_of(head) @ camera_mount
    return CameraPose(
        math.degrees(latitude),
        math.degrees(longitude),
        altitude,
        height,
        None if camera is None else angles(camera @ NADIR.T),
        None if camera is None else angles(camera @ FORWARD.T),
        None if pose.attitude is None else angles(matrix_of(pose.attitude)),
        applied,
        None if undulation_m is None else altitude + undulation_m,
    )


def matrix_of(q: Quaternion) -> Matrix:
    """The rotation matrix of a unit quaternion (w, x, y, z)."""
    w, x, y, z = q
    return np.array(
        [
            [1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)],
            [2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)],
            [2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)],
        ]
    )


def angles(rotation: Matrix) -> Angles:
    """Yaw, pitch, roll of R = Rz(yaw) Ry(pitch) Rx(roll). Straight up or down, where only yaw ± roll is defined, roll
    is 0."""
    pitch = math.asin(max(-1.0, min(1.0, -float(rotation[2, 0]))))
    if abs(rotation[2, 0]) > 1 - 1e-9:
        yaw, roll = math.atan2(-float(rotation[0, 1]), float(rotation[1, 1])), 0.0
    else:
        yaw = math.atan2(float(rotation[1, 0]), float(rotation[0, 0]))
        roll = math.atan2(float(rotation[2, 1]), float(rotation[2, 2]))
    return Angles(math.degrees(yaw) % 360, math.degrees(pitch), math.degrees(roll))


def to_ecef(latitude_rad: float, longitude_rad: float, height_m: float) -> Matrix:
    """Earth-centred, Earth-fixed metres, from WGS 84 with the height above the ellipsoid."""
    return np.array(_earth().transform(longitude_rad, latitude_rad, height_m, radians=True), dtype=np.float64)


def from_ecef(place: Matrix) -> tuple[float, float, float]:
    """(latitude, longitude in radians, height above the ellipsoid in metres) on WGS 84."""
    x, y, z = (float(part) for part in place)
    longitude, latitude, height = _earth().transform(x, y, z, radians=True, direction="INVERSE")
    return latitude, longitude, height


@cache
def _earth() -> pyproj.Transformer:
    import pyproj  # noqa: PLC0415  # a flight needs none, and it is a twentieth of a start

    return pyproj.Transformer.from_crs(_GEODETIC, _GEOCENTRIC, always_xy=True, allow_ballpark=False)


def ned_to_ecef(latitude_rad: float, longitude_rad: float) -> Matrix:
    """The rotation from north, east, down at a place to Earth-centred axes."""
    sin_lat, cos_lat = math.sin(latitude_rad), math.cos(latitude_rad)
    sin_lon, cos_lon = math.sin(longitude_rad), math.cos(longitude_rad)
    return np.array(
        [
            [-sin_lat * cos_lon, -sin_lon, -cos_lat * cos_lon],
            [-sin_lat * sin_lon, cos_lon, -cos_lat * sin_lon],
            [cos_lat, 0.0, -sin_lat],
        ]
    )
