"""Bench scenes: textured planes at known distances, a white card, and real views from a folder."""

from __future__ import annotations

import math
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from PIL import Image
from scipy import ndimage

from dappled.decode import srgb
from dappled.decode.array_types import Singles
from dappled.mocks.autopilot.path import TruePose
from dappled.mocks.scene.landscape import noise
from dappled.mocks.scene.lens import Optics, Rays, Rendering

TEXTURE_SIDE = 2048
THREADS = 2


@dataclass(frozen=True, slots=True)
class TexturedPlane:
    """A textured board. Its depth is `distance_m` on the axis plus `tilt` (y, x), metres for each metre sideways.

    `extent_mm` (top, bottom, left, right) is what it covers on the sensor as seen from the aperture's centre, None for
    a backdrop without end. `colour` is its mean radiance.
    """

    distance_m: float
    colour: tuple[float, float, float] = (0.42, 0.40, 0.37)
    tilt: tuple[float, float] = (0.0, 0.0)
    extent_mm: tuple[float, float, float, float] | None = None
    contrast: float = 0.22


@dataclass(frozen=True, slots=True)
class Bench:
    """Boards in front of the camera; a later one hides those before it.

    `texture` is a cyclic map of unit variance; one of its texels is `texel_mm` on the sensor, so every board carries
    detail as fine as the slices do, whatever its distance.
    """

    planes: tuple[TexturedPlane, ...]
    texture: Singles
    texel_mm: float

    @classmethod
    def of(cls, seed: int, planes: tuple[TexturedPlane, ...], finest_period_mm: float) -> Bench:
        """Boards with a texture from a seed, nothing in it finer than `finest_period_mm` on the sensor."""
        texel = finest_period_mm / 5
        rng = np.random.default_rng([seed, 20])
        return cls(planes, noise(rng, TEXTURE_SIDE, texel, slope=0.9, finest_m=finest_period_mm), texel)

    @property
    def mean_radiance(self) -> float:
        """Mean over the boards."""
        return float(np.mean([plane.colour for plane in self.planes]))

    @property
    def headroom(self) -> float:
        """Brightest point over the mean."""
        brightest = max(max(plane.colour) * (1 + 2.2 * plane.contrast) for plane in self.planes)
        return brightest / self.mean_radiance

    def render(self, rays: Rays, pose: TruePose | None) -> Rendering:
        """The boards along the rays; the pose does not matter."""
        h, w = len(rays.y_mm), len(rays.x_mm)
        radiance = np.zeros((len(rays.aperture_mm), 3, h, w), dtype=np.float32)

        def one(view: Singles, theta: NDArray[np.float64]) -> None:
            for number, plane in enumerate(self.planes):
                self._lay(view, plane, number, rays, theta)

        with ThreadPoolExecutor(THREADS) as pool:
            list(pool.map(one, radiance, rays.aperture_mm))
        depth = np.full((h, w), np.inf)
        centre = np.zeros(2)
        for plane in self.planes:
            z, side = _meet(plane, rays, centre)
            depth = np.where(_cover(plane, rays, z, side) > 0.5, z, depth)
        return Rendering(radiance, depth.astype(np.float32))

    def _lay(self, view: Singles, plane: TexturedPlane, number: int, rays: Rays, theta: NDArray[np.float64]) -> None:
        rays, where = _window(plane, rays, theta)
        view = view[:, *where]
        z, side = _meet(plane, rays, theta)
        cover = _cover(plane, rays, z, side)
        scale = rays.v_mm / plane.distance_m / self.texel_mm  # texels for each metre on the board
        at = np.empty((2, *view.shape[1:]), dtype=np.float32)
        for out, metres in zip(at, side, strict=True):
            out[:] = metres * scale + 500.0 * number
        texture = np.empty(view.shape[1:], dtype=np.float32)
        ndimage.map_coordinates(self.texture, at, output=texture, order=1, mode="grid-wrap", prefilter=False)
        texture *= np.float32(plane.contrast)
        texture += 1
        for channel, colour in enumerate(plane.colour):
            if plane.extent_mm is None:
                np.multiply(texture, np.float32(colour), out=view[channel])
            else:
                view[channel] += cover * (np.float32(colour) * texture - view[channel])


def _meet(
    plane: TexturedPlane, rays: Rays, theta: NDArray[np.float64]
) -> tuple[NDArray[np.float64], tuple[NDArray[np.float64], NDArray[np.float64]]]:
    """Depth (m) where each ray meets the board, and its place there (y, x) in metres.

    A ray runs at θ's negative plus depth times a slope: Y(Z) = −θ + Z·(x/v + θ/F).
    """
    metres = theta * 1e-3
    slope_y = (rays.y_mm / rays.v_mm + metres[0] / rays.focus_m)[:, None]
    slope_x = (rays.x_mm / rays.v_mm + metres[1] / rays.focus_m)[None, :]
    towards = 1 - plane.tilt[0] * slope_y - plane.tilt[1] * slope_x
    if float(towards.min()) <= 0.05:
        raise ValueError(f"the board at {plane.distance_m:g} m is tilted along the view")
    z = (plane.distance_m - plane.tilt[0] * metres[0] - plane.tilt[1] * metres[1]) / towards
    return z, (slope_y * z - metres[0], slope_x * z - metres[1])


def _window(plane: TexturedPlane, rays: Rays, theta: NDArray[np.float64]) -> tuple[Rays, tuple[slice, slice]]:
    """The samples that may see a board: its extent, wider by the aperture's own offset seen at half the distance."""
    if plane.extent_mm is None:
        return rays, (slice(None), slice(None))
    top, bottom, left, right = plane.extent_mm
    reach = np.abs(theta) * rays.v_mm * abs(2e-3 / plane.distance_m - 1e-3 / rays.focus_m) + 0.2
    y = slice(*np.searchsorted(rays.y_mm, (top - reach[0], bottom + reach[0])))
    x = slice(*np.searchsorted(rays.x_mm, (left - reach[1], right + reach[1])))
    return replace(rays, y_mm=rays.y_mm[y], x_mm=rays.x_mm[x]), (y, x)


def _cover(
    plane: TexturedPlane, rays: Rays, z: NDArray[np.float64], side: tuple[NDArray[np.float64], NDArray[np.float64]]
) -> Singles | float:
    """How far each sample is covered, 0 to 1, with an edge one sample wide."""
    if plane.extent_mm is None:
        return 1.0
    pitch = abs(float(rays.y_mm[1] - rays.y_mm[0]))
    y, x = (s / z * rays.v_mm for s in side)  # the board's place as the aperture's centre sees it
    top, bottom, left, right = plane.extent_mm
    inside = np.minimum(np.minimum(y - top, bottom - y), np.minimum(x - left, right - x))
    return np.clip(inside / pitch + 0.5, 0, 1).astype(np.float32)


def boards(seed: int, optics: Optics, size_mm: tuple[float, float], pitch_mm: float, finest_period_mm: float) -> Bench:
    """The reference bench: a backdrop where neighbouring views differ by 3 px, a board at 4 px, and one that leans
    from 4.2 to 3.2 px (with the focus at infinity)."""
    n = optics.mask.views_per_axis
    height, width = size_mm

    def at(shift_px: float) -> float:
        return optics.depth_m(shift_px * pitch_mm, n)

    lean = (1 - 3.2 / 4.4) * optics.focal_length_mm / (0.40 * width)  # 1/Z, and so the shift, falls evenly along it
    return Bench.of(
        seed,
        (
            TexturedPlane(at(3.0)),
            TexturedPlane(
                at(4.0), (0.47, 0.42, 0.36), extent_mm=(-0.30 * height, 0.34 * height, -0.40 * width, -0.08 * width)
            ),
            TexturedPlane(
                at(4.4),
                (0.36, 0.39, 0.41),
                tilt=(0.0, lean),
                extent_mm=(-0.36 * height, 0.22 * height, 0.06 * width, 0.40 * width),
            ),
        ),
        finest_period_mm,
    )


@dataclass(frozen=True, slots=True)
class WhiteCard:
    """A white card so near and so evenly lit that every ray sees the same."""

    distance_m: float = 0.5

    @property
    def mean_radiance(self) -> float:
        """One."""
        return 1.0

    @property
    def headroom(self) -> float:
        """One: nothing is brighter."""
        return 1.0

    def render(self, rays: Rays, pose: TruePose | None) -> Rendering:
        """One everywhere."""
        h, w = len(rays.y_mm), len(rays.x_mm)
        depth = np.full((h, w), self.distance_m, dtype=np.float32)
        return Rendering(np.ones((len(rays.aperture_mm), 3, h, w), dtype=np.float32), depth)


@dataclass(frozen=True, slots=True)
class RealViews:
    """Views (n, n, rows, columns, 3) that another camera took, shown to the sensor as they are: view (i, j) is what
    the aperture point of row i and column j sees. They are stretched over the frame."""

    views: Singles
    size_mm: tuple[float, float]

    @classmethod
    def read(cls, folder: Path, size_mm: tuple[float, float]) -> RealViews:
        """All PNG files of a folder in the order of their names, row by row. sRGB is made linear.

        Raises ValueError where their number is not a square or their sizes differ.
        """
        files = sorted(folder.glob("*.png"))
        n = math.isqrt(len(files))
        if n == 0 or n * n != len(files):
            raise ValueError(f"{folder} holds {len(files)} PNG files; a light field needs n × n")
        pictures = []
        for file in files:
            with Image.open(file) as picture:
                pictures.append(np.asarray(picture.convert("RGB"), dtype=np.float32) / 255)
        if len({picture.shape for picture in pictures}) > 1:
            raise ValueError(f"the PNG files in {folder} differ in size")
        encoded = np.stack(pictures).reshape(n, n, *pictures[0].shape)
        linear = srgb.decoded(encoded)
        return cls(linear.astype(np.float32), size_mm)

    @property
    def mean_radiance(self) -> float:
        """Mean over all views."""
        return float(self.views.mean())

    @property
    def headroom(self) -> float:
        """The brightest percent over the mean."""
        return float(np.quantile(self.views[0, 0], 0.995)) / self.mean_radiance

    def render(self, rays: Rays, pose: TruePose | None) -> Rendering:
        """The views on the sensor's samples, reflected at the edges. Raises ValueError for another number of views."""
        n, _, rows, columns, _ = self.views.shape
        if len(rays.aperture_mm) != n * n:
            raise ValueError(f"{n}×{n} real views need as many aperture samples, not {len(rays.aperture_mm)}")
        y = (rays.y_mm / self.size_mm[0] + 0.5) * rows - 0.5
        x = (rays.x_mm / self.size_mm[1] + 0.5) * columns - 0.5
        at = np.stack(np.meshgrid(y, x, indexing="ij")).astype(np.float32)
        radiance = np.empty((n * n, 3, len(y), len(x)), dtype=np.float32)
        for out, view in zip(radiance, self.views.reshape(n * n, rows, columns, 3), strict=True):
            for channel in range(3):
                ndimage.map_coordinates(view[..., channel], at, output=out[channel], order=1, mode="reflect")
        return Rendering(radiance, None)
