"""The camera's field of view: angles from the lens, its attitude, and where the optical axis meets the ground."""

from __future__ import annotations

import math
from collections.abc import Sequence

from dappled.decode.geometry.pose import Pose, Quaternion, Vector3, turned

EARTH_RADIUS_M = 6_371_000.0  # mean radius (IUGG)
_SHALLOW = 0.05  # below 3° under the horizon the ground is too far for a flat one


def angle_rad(size_mm: float | None, focal_length_mm: float | None) -> float | None:
    """The angle of view along a side of the sensor, focused at infinity: 2 atan(size / 2f)."""
    if not size_mm or not focal_length_mm:
        return None
    return 2 * math.atan(size_mm / (2 * focal_length_mm))


def look(
    pose: Pose | None, mount: Sequence[float], *, on_gimbal: bool = False
) -> tuple[Quaternion | None, tuple[float, float, float] | None]:
    """Attitude of the camera and its ground point, from the vehicle's pose; None where unknown.

    `mount`: camera axes (right, down, forward) to body axes (forward, right, down), nine numbers row by row; with
    `on_gimbal` to those of the gimbal's head, whose attitude counts. The
    attitude (w, x, y, z) turns a frame that looks along x, with y to the image's right, to north-east-down. The ground
    point is (latitude, longitude, altitude above sea level in metres) of the image's centre on the plane of the
    take-off place.
    """
    head = None if pose is None else pose.gimbal_attitude if on_gimbal else pose.attitude
    if pose is None or head is None:
        return None, None
    right, down, forward = (turned(head, (mount[at], mount[3 + at], mount[6 + at])) for at in range(3))
    attitude = quaternion((forward, right, down))
    known = (pose.latitude_rad, pose.longitude_rad, pose.altitude_msl_m, pose.height_above_home_m)
    latitude, longitude, altitude, height = known
    if latitude is None or longitude is None or altitude is None or height is None:
        return attitude, None
    if forward[2] < _SHALLOW or height <= 0:
        return attitude, None
    reach = height / forward[2]
    north, east = forward[0] * reach, forward[1] * reach
    shrink = max(math.cos(latitude), 1e-6)
    return attitude, (
        latitude + north / EARTH_RADIUS_M,
        longitude + east / (EARTH_RADIUS_M * shrink),
        altitude - height,
    )


def quaternion(axes: Sequence[Vector3]) -> Quaternion:
    """The rotation whose matrix has these columns (Shepperd: the largest of four decides, so nothing cancels)."""
    (m00, m10, m20), (m01, m11, m21), (m02, m12, m22) = axes
    fours = (1 + m00 + m11 + m22, 1 + m00 - m11 - m22, 1 - m00 + m11 - m22, 1 - m00 - m11 + m22)
    largest = max(range(4), key=fours.__getitem__)
    half = math.sqrt(max(fours[largest], 1e-12)) / 2
    quarter = 0.25 / half
    rows = (
        (half, (m21 - m12) * quarter, (m02 - m20) * quarter, (m10 - m01) * quarter),
        ((m21 - m12) * quarter, half, (m01 + m10) * quarter, (m02 + m20) * quarter),
        ((m02 - m20) * quarter, (m01 + m10) * quarter, half, (m12 + m21) * quarter),
        ((m10 - m01) * quarter, (m02 + m20) * quarter, (m12 + m21) * quarter, half),
    )
    w, x, y, z = rows[largest]
    return (w, x, y, z) if w >= 0 else (-w, -x, -y, -z)
