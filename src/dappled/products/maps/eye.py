"""The geometry of a view on a map: which pixel shows a ground point, and where a pixel's ray goes.

World coordinates are grid east and north of the projection, and height in metres above mean sea level. Within a frame's
footprint the map counts as flat and uniform: its grid is turned from true north by the convergence, and a metre on the
ground is `scale` map metres, both taken at the camera. (The error is a few centimetres at a kilometre, and under a
millimetre at a hundred metres.)

Camera axes are right, down, forward. A pixel is (x, y) = (column, row) of the view, its centre at whole numbers.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from dappled.config.profiles import Lens
from dappled.decode.array_types import Floats
from dappled.decode.geometry import camera_pose
from dappled.decode.optics import Sensor
from dappled.errors import DappledError

_LOWEST = math.sin(math.radians(3))  # a ray that dips less counts as above the horizon


class EyeError(DappledError):
    """A view can't be put on a map."""


@dataclass(frozen=True, slots=True, eq=False)
class Eye:
    """A pinhole camera with distortion, above the map.

    `matrix` (3, 3) maps (x, y, 1) on the plane at distance 1 to the pixel (x, y, 1); `rotation` (3, 3) turns camera
    axes to grid east, north, up; `centre` (3,) is the perspective centre on the map; `shape` is (rows, columns).
    """

    matrix: Floats
    distortion: tuple[float, float, float, float, float]
    rotation: Floats
    centre: Floats
    scale: float
    shape: tuple[int, int]

    def project(self, points: Floats) -> Floats:
        """(n, 2) pixels of map points (n, 3); NaN behind the camera."""
        return self.pixels((points - self.centre) / (self.scale, self.scale, 1.0) @ self.rotation)

    def shown_at(self, points: Floats) -> Floats:
        """(n, 2) pixels of map points (n, 3); NaN outside of the picture."""
        at = self.project(points)
        rows, columns = self.shape
        return np.where(((at >= 0) & (at <= [columns - 1, rows - 1])).all(axis=1, keepdims=True), at, np.nan)

    def shows(self, points: Floats) -> NDArray[np.bool_]:
        """(n,): which map points (n, 3) are in the picture."""
        return np.isfinite(self.shown_at(points)[:, 0])

    def pixels(self, seen: Floats) -> Floats:
        """(n, 2) pixels of points (n, 3) in camera axes; NaN behind the camera."""
        ahead = np.where(seen[:, 2] > 1e-9, seen[:, 2], np.nan)
        return self.imaged(seen[:, :2] / ahead[:, None])

    def imaged(self, plane: Floats) -> Floats:
        """(n, 2) pixels of points (n, 2) on the plane at distance 1."""
        bent = distorted(plane, self.distortion)
        x, y = bent[:, 0], bent[:, 1]
        # Not as a matrix product: BLAS starts threads for it, which wait for each other on a busy machine.
        return np.stack([row[0] * x + row[1] * y + row[2] for row in self.matrix[:2]], axis=1)

    def rays(self, pixels: Floats) -> Floats:
        """(n, 3) directions on the map of pixels (n, 2); a forward component of 1 in camera axes."""
        flat = (pixels - self.matrix[:2, 2]) @ np.linalg.inv(self.matrix[:2, :2]).T
        straight = undistorted(flat, self.distortion)
        ahead = np.concatenate([straight, np.ones((len(straight), 1))], axis=1)
        return np.asarray(ahead @ self.rotation.T * (self.scale, self.scale, 1.0))

    def homography(self, height_m: float) -> Floats:
        """(3, 3) from (east − centre, north − centre, 1) on the plane at a height to the pixel (x, y, 1).

        Exact where the lens does not distort. East and north count from the centre, which keeps the numbers small.
        """
        down = self.rotation.T
        columns = [down[:, 0] / self.scale, down[:, 1] / self.scale, down[:, 2] * (height_m - self.centre[2])]
        return np.asarray(self.matrix @ np.stack(columns, axis=1))

    def corners(self) -> Floats:
        """(4, 2): the outer corners of the corner pixels, top left first, clockwise."""
        rows, columns = self.shape
        return np.array([[0, 0], [columns, 0], [columns, rows], [0, rows]], dtype=np.float64) - 0.5

    @property
    def middle(self) -> Floats:
        """(1, 2): the middle pixel."""
        rows, columns = self.shape
        return np.array([[(columns - 1) / 2, (rows - 1) / 2]])

    def border(self, steps: int = 16) -> Floats:
        """(4·steps, 2): points along the border, in the corners' order."""
        corners = self.corners()
        share = np.arange(steps)[:, None] / steps
        sides = [a + share * (b - a) for a, b in zip(corners, np.roll(corners, -1, axis=0), strict=True)]
        return np.concatenate(sides)

    def check_horizon(self, name: str) -> None:
        """Raises EyeError where a corner looks at or above the horizon."""
        rays = self.rays(self.corners())
        dip = -rays[:, 2] / np.linalg.norm(rays / (self.scale, self.scale, 1.0), axis=1)
        if not (dip > _LOWEST).all():
            raise EyeError(
                f"{name}: the camera looks above the horizon ({math.degrees(math.asin(float(dip.min()))):.0f}° down at "
                "the highest corner): it can't be put on a map"
            )

    def gsd_m(self, ground_m: float) -> float:
        """Ground metres that a pixel in the middle of the view covers, along its shorter side."""
        places = [self.on_plane(self.middle + step, ground_m)[0] for step in ((0, 0), (1, 0), (0, 1))]
        return float(min(np.linalg.norm(place - places[0]) for place in places[1:]) / self.scale)

    def on_plane(self, pixels: Floats, height_m: float | Floats) -> Floats:
        """(n, 2) east and north where rays reach a height; NaN where they never do."""
        rays = self.rays(pixels)
        drop = height_m - self.centre[2]
        depth = drop / np.where(rays[:, 2] < -1e-9, rays[:, 2], np.nan)
        return np.asarray(self.centre[:2] + rays[:, :2] * np.where(depth > 0, depth, np.nan)[:, None])

    def moved(self, change: Floats) -> Eye:
        """Shifted by `change`[:3] (east, north in ground metres, up) and then turned by the small rotation vector
        `change`[3:] (radians, about east, north, up)."""
        shift = np.asarray(change[:3]) * (self.scale, self.scale, 1.0)
        return replace(self, centre=self.centre + shift, rotation=turn(np.asarray(change[3:])) @ self.rotation)


def intrinsics(sensor: Sensor, lens: Lens, grid: Floats) -> Floats:
    """(3, 3) from (x, y, 1) at distance 1 to a view's pixel, by lens, chip, and the view's `grid` (2, 3)."""
    to_mm, offset = _to_chip(sensor, grid)
    back = np.linalg.inv(to_mm)
    principal = np.array([lens.principal_point_mm[1], lens.principal_point_mm[0]])
    matrix = np.eye(3)
    matrix[:2, :2] = back * lens.v_mm
    matrix[:2, 2] = back @ (principal - offset)
    return matrix


def on_chip_mm(pixels: Floats, sensor: Sensor, grid: Floats) -> Floats:
    """(n, 2) millimetres (x, y) from the chip's middle, of a view's pixels (n, 2)."""
    to_mm, offset = _to_chip(sensor, grid)
    return np.asarray(pixels @ to_mm.T + offset)


def _to_chip(sensor: Sensor, grid: Floats) -> tuple[Floats, Floats]:
    """(2, 2) and (2,): from a view's (x, y) to mm (x, y) from the chip's middle."""
    rows, columns = sensor.shape
    chip = np.array([[sensor.column_mm[1], sensor.row_mm[1]], [sensor.column_mm[0], sensor.row_mm[0]]])  # (c, r) → mm
    flip = grid[::-1, [1, 0, 2]]  # (x, y, 1) of the view → (column, row)
    return chip @ flip[:, :2], chip @ (flip[:, 2] - [(columns - 1) / 2, (rows - 1) / 2])


def through(eye: Eye, aperture_m: tuple[float, float], focus_m: float = math.inf) -> Eye:
    """The eye of one view: light from aperture point θ (y, x, metres) leaves the scene at x·Z/v − θ·(1 − Z/F).

    So the perspective centre is at −θ, and pixels look aside by θ/F: the principal point moves by −θ·v/F.
    """
    theta = np.array([aperture_m[1], aperture_m[0]])
    centre = eye.centre + eye.rotation @ np.array([-theta[0], -theta[1], 0.0]) * (eye.scale, eye.scale, 1.0)
    matrix = eye.matrix.copy()
    matrix[:2, 2] -= matrix[:2, :2] @ (theta / focus_m)
    return replace(eye, centre=centre, matrix=matrix)


def distorted(plane: Floats, numbers: tuple[float, float, float, float, float]) -> Floats:
    """Distort points (n, 2) on the plane at distance 1 by OpenCV's model."""
    if not any(numbers):
        return plane
    k1, k2, p1, p2, k3 = numbers
    x, y = plane[:, 0], plane[:, 1]
    r2 = x * x + y * y
    radial = 1 + r2 * (k1 + r2 * (k2 + r2 * k3))
    bent_x = x * radial + 2 * p1 * x * y + p2 * (r2 + 2 * x * x)
    bent_y = y * radial + p1 * (r2 + 2 * y * y) + 2 * p2 * x * y
    return np.stack([bent_x, bent_y], axis=1)


def undistorted(bent: Floats, numbers: tuple[float, float, float, float, float]) -> Floats:
    """The inverse of `distorted`, by Newton's method with a numeric derivative, to 1e-12."""
    if not any(numbers):
        return bent
    plane = bent.copy()
    step = 1e-6
    right, down = np.array([step, 0.0]), np.array([0.0, step])
    for _ in range(20):
        here = distorted(plane, numbers)
        along_x = (distorted(plane + right, numbers) - here) / step
        along_y = (distorted(plane + down, numbers) - here) / step
        miss = bent - here
        determinant = along_x[:, 0] * along_y[:, 1] - along_y[:, 0] * along_x[:, 1]
        change = np.stack(
            [
                along_y[:, 1] * miss[:, 0] - along_y[:, 0] * miss[:, 1],
                along_x[:, 0] * miss[:, 1] - along_x[:, 1] * miss[:, 0],
            ],
            axis=1,
        ) / determinant[:, None]  # fmt: skip
        plane = plane + change
        if not np.abs(change).max(initial=0.0) > 1e-12:
            break
    return plane


def turn(vector: Floats) -> Floats:
    """The rotation by a vector of radians."""
    half = math.hypot(*vector) / 2
    x, y, z = (float(np.sinc(half / math.pi)) / 2 * float(part) for part in vector)
    return camera_pose.matrix_of((math.cos(half), x, y, z))
