"""Where a frame lies on flat ground: its corners, and its picture turned north up."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy import ndimage

_A_M, _E2 = 6378137.0, 0.00669437999014  # WGS 84
_STEEPEST = 0.2  # of a ray's length that must point down: 78° from straight down


@dataclass(frozen=True, slots=True)
class Geometry:
    """A frame's size on the chip, (height, width) in mm, its focal length, and the camera's rotation to NED.

    `height_m` is above the ground (the take-off point's height stands for it). The lens is taken as a pinhole, the
    camera's own offset from the antenna as none.
    """

    size_mm: tuple[float, float]
    focal_length_mm: float
    rotation: NDArray[np.float64]
    height_m: float
    latitude_deg: float
    longitude_deg: float


@dataclass(frozen=True, slots=True)
class Rectified:
    """A north-up picture uint8 RGBA (h, w, 4), transparent beyond the frame, and its bounds in degrees."""

    picture: NDArray[np.uint8]
    north: float
    south: float
    east: float
    west: float


def geometry(
    pose: Mapping[str, Any], size_mm: tuple[float, float] | None, focal_length_mm: float | None, mount: Sequence[float]
) -> Geometry | None:
    """From a header's `pose`; None where something that it takes is unknown."""
    needed = (pose["latitude_deg"], pose["longitude_deg"], pose.get("height_above_home_m"), pose["attitude"])
    if any(value is None for value in needed) or size_mm is None or not focal_length_mm:
        return None
    height = float(pose["height_above_home_m"])
    if height <= 0.5:
        return None
    rotation = _rotation(pose["attitude"]) @ np.asarray(mount, dtype=np.float64).reshape(3, 3)
    return Geometry(size_mm, focal_length_mm, rotation, height, pose["latitude_deg"], pose["longitude_deg"])


def corners(one: Geometry) -> list[tuple[float, float]] | None:
    """(latitude, longitude) in degrees of the frame's corners: top left, top right, bottom right, bottom left.

    None where a corner looks at, or near, the horizon.
    """
    ground = _corners_m(one)
    return None if ground is None else [_degrees(one, north, east) for north, east in ground.tolist()]


def rectify(one: Geometry, picture: NDArray[np.uint8], longest_side: int) -> Rectified | None:
    """The picture (h, w) of a whole frame on the ground, north up; None where it has no footprint."""
    ground = _corners_m(one)
    if ground is None:
        return None
    low, high = ground.min(axis=0), ground.max(axis=0)
    metres = float((high - low).max()) / longest_side
    rows, columns = (max(1, math.ceil(side / metres)) for side in (high - low).tolist())
    north = high[0] - (np.arange(rows) + 0.5) * metres
    east = low[1] + (np.arange(columns) + 0.5) * metres
    plane = np.stack(
        [*np.meshgrid(north, east, indexing="ij"), np.full((rows, columns), one.height_m)], axis=-1
    )  # NED of each pixel of the map
    camera = plane @ one.rotation  # Rᵀ p, row by row
    height, width = picture.shape
    ahead = np.maximum(camera[..., 2], 1e-9)
    at_x = (camera[..., 0] / ahead * one.focal_length_mm / one.size_mm[1] + 0.5) * width - 0.5
    at_y = (camera[..., 1] / ahead * one.focal_length_mm / one.size_mm[0] + 0.5) * height - 0.5
    inside = (camera[..., 2] > 0) & (at_x > -0.5) & (at_x < width - 0.5) & (at_y > -0.5) & (at_y < height - 0.5)
    grey = ndimage.map_coordinates(picture, [at_y, at_x], order=1, mode="nearest")
    rgba = np.repeat(grey[..., None], 4, axis=2)
    rgba[..., 3] = np.where(inside, 255, 0)
    top, right = _degrees(one, float(high[0]), float(low[1]) + columns * metres)
    bottom, left = _degrees(one, float(high[0]) - rows * metres, float(low[1]))
    return Rectified(rgba, top, bottom, right, left)


def _corners_m(one: Geometry) -> NDArray[np.float64] | None:
    """(4, 2) north and east of the antenna, metres."""
    half_h, half_w = one.size_mm[0] / 2, one.size_mm[1] / 2
    f = one.focal_length_mm
    rays = np.array([[-half_w, -half_h, f], [half_w, -half_h, f], [half_w, half_h, f], [-half_w, half_h, f]])
    ned = rays @ one.rotation.T
    if np.any(ned[:, 2] < _STEEPEST * np.linalg.norm(ned, axis=1)):
        return None
    on_ground: NDArray[np.float64] = ned[:, :2] / ned[:, 2:] * one.height_m
    return on_ground


def _degrees(one: Geometry, north_m: float, east_m: float) -> tuple[float, float]:
    """Metres from the antenna as degrees, on the ellipsoid's own radii there; longitude from −180 to 180."""
    latitude = math.radians(one.latitude_deg)
    w = math.sqrt(1 - _E2 * math.sin(latitude) ** 2)
    lat = one.latitude_deg + math.degrees(north_m / (_A_M * (1 - _E2) / w**3))
    lon = one.longitude_deg + math.degrees(east_m / (_A_M / w * max(math.cos(latitude), 1e-6)))
    return lat, (lon + 180) % 360 - 180


def _rotation(q: Sequence[float]) -> NDArray[np.float64]:
    """Body to NED of a unit quaternion (w, x, y, z)."""
    w, x, y, z = q
    return np.array(
        [
            [1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)],
            [2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)],
            [2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)],
        ]
    )
