"""Project a frame on flat ground: its corners, and its picture turned north up."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from dappled.decode.geometry.pose import metres_per_radian

_AT_POLES_M = 6.4  # for a radian of longitude: what is on a pole has one too
_STEEPEST = 0.2  # the least share of a ray's length that points down: 78° from straight down


@dataclass(frozen=True, slots=True)
class OrientedFrame:
    """A frame's size on the chip, (height, width) in mm, its focal length, and the camera's rotation to NED.

    `height_m` is above the ground. The lens is a pinhole, and the camera has no offset from the antenna.
    """

    size_mm: tuple[float, float]
    focal_length_mm: float
    rotation: NDArray[np.float64]
    height_m: float
    latitude_deg: float
    longitude_deg: float


@dataclass(frozen=True, slots=True)
class RectifiedFrame:
    """A north-up picture uint8 RGBA (h, w, 4), transparent beyond the frame, and its bounds in degrees."""

    picture: NDArray[np.uint8]
    north: float
    south: float
    east: float
    west: float


def corners(frame: OrientedFrame) -> list[tuple[float, float]] | None:
    """(latitude, longitude) in degrees of the frame's corners: top left, top right, bottom right, bottom left.

    None where a corner's ray points to the horizon or near it.
    """
    ground = _corners_m(frame)
    return None if ground is None else [_degrees(frame, north, east) for north, east in ground.tolist()]


def rectify(frame: OrientedFrame, picture: NDArray[np.uint8], longest_side: int) -> RectifiedFrame | None:
    """The picture (h, w) of a whole frame projected on the ground, north up; None where `corners` is None."""
    ground = _corners_m(frame)
    if ground is None:
        return None
    low, high = ground.min(axis=0), ground.max(axis=0)
    metres = float((high - low).max()) / longest_side
    rows, columns = (max(1, math.ceil(side / metres)) for side in (high - low).tolist())
    north = high[0] - (np.arange(rows) + 0.5) * metres
    east = low[1] + (np.arange(columns) + 0.5) * metres
    plane = np.stack(
        [*np.meshgrid(north, east, indexing="ij"), np.full((rows, columns), frame.height_m)], axis=-1
    )  # NED of each pixel of the map
    camera = plane @ frame.rotation  # Rᵀ p, row by row
    height, width = picture.shape
    ahead = np.maximum(camera[..., 2], 1e-9)
    at_x = (camera[..., 0] / ahead * frame.focal_length_mm / frame.size_mm[1] + 0.5) * width - 0.5
    at_y = (camera[..., 1] / ahead * frame.focal_length_mm / frame.size_mm[0] + 0.5) * height - 0.5
    inside = (camera[..., 2] > 0) & (at_x > -0.5) & (at_x < width - 0.5) & (at_y > -0.5) & (at_y < height - 0.5)
    from scipy import ndimage  # noqa: PLC0415  # the daemon draws no pictures: loading it takes a small computer seconds

    grey = ndimage.map_coordinates(picture, [at_y, at_x], order=1, mode="nearest")
    rgba = np.repeat(grey[..., None], 4, axis=2)
    rgba[..., 3] = np.where(inside, 255, 0)
    top, right = _degrees(frame, float(high[0]), float(low[1]) + columns * metres)
    bottom, left = _degrees(frame, float(high[0]) - rows * metres, float(low[1]))
    return RectifiedFrame(rgba, top, bottom, right, left)


def _corners_m(frame: OrientedFrame) -> NDArray[np.float64] | None:
    """(4, 2) north and east of the antenna, metres."""
    half_h, half_w = frame.size_mm[0] / 2, frame.size_mm[1] / 2
    f = frame.focal_length_mm
    rays = np.array([[-half_w, -half_h, f], [half_w, -half_h, f], [half_w, half_h, f], [-half_w, half_h, f]])
    ned = rays @ frame.rotation.T
    if np.any(ned[:, 2] < _STEEPEST * np.linalg.norm(ned, axis=1)):
        return None
    on_ground: NDArray[np.float64] = ned[:, :2] / ned[:, 2:] * frame.height_m
    return on_ground


def _degrees(frame: OrientedFrame, north_m: float, east_m: float) -> tuple[float, float]:
    """Metres from the antenna as degrees, by the ellipsoid's radii at that place; longitude from −180 to 180."""
    along_m, across_m = metres_per_radian(math.radians(frame.latitude_deg), 0.0)
    lat = frame.latitude_deg + math.degrees(north_m / along_m)
    lon = frame.longitude_deg + math.degrees(east_m / max(across_m, _AT_POLES_M))
    return lat, (lon + 180) % 360 - 180
