"""Brute-force truth for the decoder: I(x) = Σ_θ L_θ(x) · M((1−α)x + αθ), summed ray by ray on a small sensor."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from dappled.decode.optics.carriers import Lattice, Mask, Sensor, geometric

Plane = NDArray[np.float32]
Grid = NDArray[np.float64]
FULL_APERTURE_MM = 6.7
FOCAL_MM = 50.0
FULL_F = FOCAL_MM / FULL_APERTURE_MM
STOPPED_F = 8 * FULL_F
MASK = Mask(frequency_per_mm=15.5, p=2)
STATED_DISTANCE_MM = 0.48
SHAPE = (300, 360)
SENSOR = Sensor(SHAPE, (0.01, 0.0), (0.0, 0.01))
BAND = 0.065  # cycles/pixel: 0.85 of half the carriers' distance


@dataclass(frozen=True, eq=False)
class Texture:
    """A random band-limited image that can be looked at anywhere: a sum of plane waves."""

    fy: NDArray[np.float64]
    fx: NDArray[np.float64]
    amplitude: NDArray[np.complex128]
    mean: float

    @classmethod
    def random(cls, rng: np.random.Generator, *, mean: float = 0.4, rms: float = 0.12, waves: int = 200) -> Texture:
        fy, fx = rng.uniform(-BAND, BAND, (2, waves))
        size = rng.normal(size=waves) / (0.15 * BAND + np.hypot(fy, fx))
        size *= rms / np.sqrt((size**2).sum() / 2)
        return cls(fy, fx, size * np.exp(2j * np.pi * rng.uniform(size=waves)), mean)

    def on(self, rows: NDArray[np.float64], columns: NDArray[np.float64]) -> Callable[[float, float], Grid]:
        """What gives the texture at these places, moved down and across by so much."""
        left = np.exp(2j * np.pi * np.outer(rows, self.fy))
        left = np.hstack([left.real, -left.imag])
        right = np.exp(2j * np.pi * np.outer(self.fx, columns)) * self.amplitude[:, None]

        def at(down: float, across: float) -> Grid:
            turned = right * np.exp(-2j * np.pi * (down * self.fy + across * self.fx))[:, None]
            return np.asarray(self.mean + left @ np.vstack([turned.real, turned.imag]), dtype=np.float64)

        return at


@dataclass(frozen=True)
class Camera:
    """What the decoder never sees: the true distance, rotation and shift of the mask. Aperture of n × n beams."""

    distance_mm: float
    rotation_rad: float
    shift_mm: tuple[float, float]
    mask: Mask = MASK
    sensor: Sensor = SENSOR
    beams: int = 5

    @classmethod
    def hidden(cls, seed: int) -> Camera:
        rng = np.random.default_rng(seed)
        return cls(
            STATED_DISTANCE_MM * rng.uniform(0.9, 1.1),
            float(np.radians(rng.uniform(-2, 2))),
            (float(rng.uniform(-0.03, 0.03)), float(rng.uniform(-0.03, 0.03))),
        )

    @property
    def lattice(self) -> Lattice:
        return geometric(self.mask, self.sensor, self.distance_mm, FOCAL_MM).rotated(self.rotation_rad)

    def expose(self, layers: Sequence[tuple[Texture, float]], f_number: float = FULL_F) -> Plane:
        """`layers`: textures and their shift in pixels from view to view at full aperture (a fifth of it apart)."""
        height, width = self.sensor.shape
        pitch = self.sensor.row_mm[0]
        y, x = (np.arange(height) - (height - 1) / 2) * pitch, (np.arange(width) - (width - 1) / 2) * pitch
        alpha = self.distance_mm / FOCAL_MM
        aperture = FOCAL_MM / f_number
        angles = (np.arange(self.beams) - (self.beams - 1) / 2) / self.beams * aperture
        total = np.zeros((height, width))
        seen = _seen(layers, np.arange(float(height)), np.arange(float(width)))
        for v in angles:
            for u in angles:
                total += seen(v, u) * self._transmission((1 - alpha) * y + alpha * v, (1 - alpha) * x + alpha * u)
        return np.asarray(total / self.beams**2, dtype=np.float32)

    def truth(
        self,
        layers: Sequence[tuple[Texture, float]],
        grid: NDArray[np.float64],
        shape: tuple[int, int],
        f_number: float = FULL_F,
    ) -> NDArray[np.float64]:
        """(5, 5, h, w) the views on a decoder's grid: each the mean of its own beams, where there are 5 n × 5 n."""
        rows, columns = np.arange(shape[0]) * grid[0, 0], np.arange(shape[1]) * grid[1, 1]
        cells = (np.arange(self.beams) - (self.beams - 1) / 2).reshape(5, -1) / self.beams * FOCAL_MM / f_number
        seen = _seen(layers, rows, columns)
        return np.array(
            [[np.mean([seen(v, u) for v in down for u in across], axis=0) for across in cells] for down in cells]
        )

    def _transmission(self, y: NDArray[np.float64], x: NDArray[np.float64]) -> Grid:
        c, s = np.cos(self.rotation_rad), np.sin(self.rotation_rad)
        turned = (c * y + self.shift_mm[0], s * x), (-s * y + self.shift_mm[1], c * x)
        f, multiples = self.mask.frequency_per_mm, self.mask.multiples
        if self.mask.pattern == "diagonal":
            products = [np.prod([_cosines(a, b, [q * f]) for a, b in turned], axis=0) for q in multiples]
            return np.asarray(1 + sum(products), dtype=np.float64)
        sums = [1 + _cosines(a, b, [q * f for q in multiples]) for a, b in turned]
        return np.asarray(sums[0] * sums[1], dtype=np.float64)


def _seen(
    layers: Sequence[tuple[Texture, float]], rows: NDArray[np.float64], columns: NDArray[np.float64]
) -> Callable[[float, float], Grid]:
    """What gives the light at these pixels from a point (v, u) of the aperture, in mm."""
    textures = [(texture.on(rows, columns), shift * 5 / FULL_APERTURE_MM) for texture, shift in layers]
    return lambda v, u: np.asarray(sum(at(step * v, step * u) for at, step in textures), dtype=np.float64)


def _cosines(a: NDArray[np.float64], b: NDArray[np.float64], frequencies: Sequence[float]) -> Grid:
    """(len(a), len(b)) Σ cos 2πf(a + b), as a product of matrices."""
    turns = [2 * np.pi * f for f in frequencies]
    rows = np.array([of(turn * a) for turn in turns for of in (np.cos, np.sin)])
    columns = np.array([sign * of(turn * b) for turn in turns for sign, of in ((1, np.cos), (-1, np.sin))])
    return np.asarray(rows.T @ columns, dtype=np.float64)


def psnr(found: NDArray[np.floating], truth: NDArray[np.floating], border: int = 4) -> float:
    """PSNR in dB with range 1, `border` samples left out at each edge."""
    cut = (..., slice(border, -border), slice(border, -border))
    return float(-10 * np.log10(np.mean((found[cut] - truth[cut]) ** 2)))
