"""From the vehicle's recorded pose to the camera's: lever arm, mount, and the angles that other programs read.

A mount is the 3 × 3 matrix from camera axes (right, down, forward through the lens) to body axes (forward, right,
down); its columns say where each camera axis points on the vehicle.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from dappled.errors import DappledError
from dappled.flight.records import Pose, Quaternion, Vector3

Matrix = NDArray[np.float64]

NADIR: Matrix = np.array([[0.0, -1.0, 0.0], [1.0, 0.0, 0.0], [0.0, 0.0, 1.0]])  # looks down, image top forward
FORWARD: Matrix = np.array([[0.0, 0.0, 1.0], [1.0, 0.0, 0.0], [0.0, 1.0, 0.0]])  # looks forward, image top up
_A_M, _F = 6378137.0, 1 / 298.257223563
_E2 = _F * (2 - _F)


@dataclass(frozen=True, slots=True)
class Angles:
    """Yaw, pitch and roll in degrees, turned in this order; yaw from 0 to 360."""

    yaw_deg: float
    pitch_deg: float
    roll_deg: float


@dataclass(frozen=True, slots=True)
class CameraPose:
    """The perspective centre at mid-exposure and where the camera looks; None is unknown.

    `pix4d`: all zero looks down with the image's top to the north, pitch 90 looks to the horizon. `dji`: pitch 0 looks
    to the horizon, −90 down. `vehicle`: the aircraft's own. `lever_applied` False: the position is the antenna's.
    """

    latitude_deg: float
    longitude_deg: float
    altitude_msl_m: float
    height_above_home_m: float | None
    pix4d: Angles | None
    dji: Angles | None
    vehicle: Angles | None
    lever_applied: bool


def mount(values: tuple[float, ...]) -> Matrix:
    """A mount from nine numbers, row by row. Raises DappledError for what is no rotation (to 1e-3)."""
    matrix = np.array(values, dtype=np.float64).reshape(-1)
    if matrix.shape == (9,):
        square: Matrix = matrix.reshape(3, 3)
        if np.allclose(square @ square.T, np.eye(3), atol=1e-3) and np.linalg.det(square) > 0:
            left, _, right = np.linalg.svd(square)
            nearest: Matrix = left @ right
            return nearest
    raise DappledError(f"the mount {list(values)} is no rotation: give nine numbers, row by row, camera axes to body")


def of(pose: Pose, lever_m: Vector3 = (0.0, 0.0, 0.0), camera_mount: Matrix = NADIR) -> CameraPose | None:
    """The camera's pose; None where the vehicle's position is not known.

    `lever_m` goes from the antenna (the autopilot's position) to the perspective centre, in body axes, metres.
    """
    if pose.latitude_rad is None or pose.longitude_rad is None or pose.altitude_msl_m is None:
        return None
    latitude, longitude, altitude = pose.latitude_rad, pose.longitude_rad, pose.altitude_msl_m
    height = pose.height_above_home_m
    if pose.attitude is None:
        return CameraPose(
            math.degrees(latitude), math.degrees(longitude), altitude, height, None, None, None, not any(lever_m)
        )
    body = matrix_of(pose.attitude)
    ned = body @ np.array(lever_m)
    if any(lever_m):
        # Eq 1, corrected: X_camera = X_antenna + R(ned → ecef) · R(body → ned) · lever. Only the lever is turned.
        # (Mean sea level stands for the ellipsoid here: at 50 m between them that is 1e-5 of the lever.)
        place = to_ecef(latitude, longitude, altitude) + ned_to_ecef(latitude, longitude) @ ned
        latitude, longitude, altitude = from_ecef(place)
        height = None if height is None else height - float(ned[2])
    camera = body @ camera_mount
    return CameraPose(
        math.degrees(latitude),
        math.degrees(longitude),
        altitude,
        height,
        angles(camera @ NADIR.T),
        angles(camera @ FORWARD.T),
        angles(body),
        True,
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
    """Earth-centred, Earth-fixed metres on WGS 84."""
    n = _A_M / math.sqrt(1 - _E2 * math.sin(latitude_rad) ** 2)
    across = (n + height_m) * math.cos(latitude_rad)
    return np.array(
        [
            across * math.cos(longitude_rad),
            across * math.sin(longitude_rad),
            (n * (1 - _E2) + height_m) * math.sin(latitude_rad),
        ]
    )


def from_ecef(place: Matrix) -> tuple[float, float, float]:
    """(latitude, longitude in radians, height in metres) on WGS 84, by iteration to below a nanometre near the
    ground."""
    x, y, z = (float(part) for part in place)
    across = math.hypot(x, y)
    latitude = math.atan2(z, across * (1 - _E2))
    for _ in range(6):
        n = _A_M / math.sqrt(1 - _E2 * math.sin(latitude) ** 2)
        latitude = math.atan2(z + _E2 * n * math.sin(latitude), across)
    n = _A_M / math.sqrt(1 - _E2 * math.sin(latitude) ** 2)
    height = across * math.cos(latitude) + z * math.sin(latitude) - _A_M**2 / n
    return latitude, math.atan2(y, x), height


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
