"""Frames of random cameras and scenes, with their mask or without, by a simulator that shares no code with `rays`.

Beams of power-law textures are moved by phase ramps, exactly, and the mask's shadow by its own phase.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy import fft

SHAPE = (694, 922)
FOCAL_MM, IDEAL_F = 50.0, 7.44
FREQUENCY_PER_MM, DISTANCE_MM, PITCH_MM = 15.5, 0.48, 0.01
_MARGIN = 32
_DARKEST = -0.375  # of 1 + cos + cos of twice: the print has no negative light
_BARE = 0.65  # what a sensor without a mask gets of the light that is to look alike


@dataclass(frozen=True)
class Mixture:
    """One frame. `boards` are shifts in pixels from view to view at the ideal aperture, `exponent` and `finest`
    (cycles/pixel) of their texture, `rms` its contrast.

    What changed since the calibration: `moved_um` (y, x), `turned_deg` and `scale` of the mask (0.003: a print larger
    by 0.3 %), the `contrast` of its shadow, `falloff` of the light at the corners; `told_f` and `told_mm` are the
    f-number and focal length that the decoder is told."""

    seed: int
    present: bool = True
    f_number: float = IDEAL_F
    stop: str = "square"
    snr: float = 100.0
    boards: tuple[float, ...] = (-0.6, 1.4)
    exponent: float = 1.3
    finest: float = 1.0
    rms: float = 0.2
    moved_um: tuple[float, float] = (0.0, 0.0)
    turned_deg: float = 0.0
    scale: float = 0.0
    contrast: float = 1.0
    falloff: float = 0.0
    told_f: float | None = None
    told_mm: float = FOCAL_MM

    @property
    def changed(self) -> str:
        """What changed since the calibration."""
        right = Mixture(self.seed)
        names = ("moved_um", "turned_deg", "scale", "contrast", "falloff", "told_f", "told_mm")
        return " ".join(name for name in names if getattr(self, name) != getattr(right, name))

    def unchanged(self) -> Mixture:
        """The same scene and stop as at the calibration."""
        return replace(
            self,
            moved_um=(0.0, 0.0),
            turned_deg=0.0,
            scale=0.0,
            contrast=1.0,
            falloff=0.0,
            told_f=None,
            told_mm=FOCAL_MM,
        )

    @classmethod
    def drawn(cls, seed: int) -> Mixture:
        """Presence, aperture, stop, noise and scene by chance."""
        rng = np.random.default_rng([seed, 45])
        return cls(
            seed,
            present=bool(rng.random() < 0.6),
            f_number=float(rng.choice([7.44, 7.44, 7.6, 8.5, 9.9, 12.0])),
            stop=str(rng.choice(["square", "round", "hexagon"], p=[0.3, 0.5, 0.2])),
            snr=float(np.exp(rng.uniform(np.log(20), np.log(3000)))),
            boards=tuple(rng.uniform(-2.5, 2.5, rng.integers(1, 4)).tolist()),
            exponent=float(rng.uniform(1.1, 2)),
            finest=float(rng.choice([0.07, 0.15, 1.0])),
            rms=float(rng.uniform(0.05, 0.3)),
        )

    @classmethod
    def disturbed(cls, seed: int) -> Mixture:
        """`drawn` with its mask, and one or two things changed, or none in three of ten."""
        one = replace(cls.drawn(seed), present=True)
        rng = np.random.default_rng([seed, 46])
        way = rng.uniform(0, 2 * np.pi)
        far = float(rng.choice([2.0, 6.5, 16.0, 32.0, 50.0]))
        sign = float(rng.choice([-1.0, 1.0]))
        changes: list[dict[str, Any]] = [
            {"moved_um": (far * math.sin(way), far * math.cos(way))},
            {"turned_deg": sign * float(rng.choice([0.1, 0.3, 0.5, 0.7, 1.0, 2.0]))},
            {"scale": sign * float(rng.choice([0.00024, 0.0005, 0.001, 0.003]))},
            {"told_f": one.f_number * float(rng.choice([0.5, 0.7, 0.9, 1.1, 1.4, 2.0]))},
            {"contrast": float(rng.uniform(0.4, 0.9))},
            {"falloff": float(rng.uniform(0.1, 0.5))},
            {"told_mm": float(rng.choice([45.0, 55.0]))},
        ]
        count = rng.choice([0, 1, 2], p=[0.3, 0.55, 0.15])
        for which in rng.choice(len(changes), count, replace=False, p=[0.22, 0.22, 0.22, 0.12, 0.09, 0.08, 0.05]):
            one = replace(one, **changes[which])
        return one

    def plane(self) -> NDArray[np.float32]:
        """What the sensor sees, 1.0 = white."""
        return self.exposed()[0]

    def exposed(self, *, views: bool = False) -> tuple[NDArray[np.float32], TrueViews]:
        """What the sensor sees, 1.0 = white, and with `views` what each cell of the stop does."""
        rng = np.random.default_rng([self.seed, 5])
        high, wide = (fft.next_fast_len(side + 2 * _MARGIN, real=True) for side in SHAPE)
        layers = self._layers(rng, high, wide)
        inside = (slice(_MARGIN, _MARGIN + SHAPE[0]), slice(_MARGIN, _MARGIN + SHAPE[1]))
        fy, fx = np.fft.fftfreq(high)[:, None], np.fft.rfftfreq(wide)[None]
        aperture_mm = FOCAL_MM / self.f_number
        step = 5 * aperture_mm / (FOCAL_MM / IDEAL_F)  # of a board of one pixel, over the stop
        through = DISTANCE_MM / FOCAL_MM
        sides = [(np.arange(side) - (side - 1) / 2) * PITCH_MM * (1 - through) for side in SHAPE]
        true = TrueViews({}, (high, wide), self.falloff)
        plane = np.zeros(SHAPE, np.float32)
        beams = self._beams()
        for v, u in beams:
            moved = np.zeros((high, wide // 2 + 1), np.complex64)
            for shift, spectrum in layers:
                down, across = (np.exp(-2j * np.pi * shift * step * f * at) for f, at in ((fy, v), (fx, u)))
                moved += spectrum * down.astype(np.complex64) * across.astype(np.complex64)
            image = fft.irfft2(moved, s=(high, wide))[inside]
            if views:
                true.add((v, u), moved)
            if self.present:
                y, x = (np.asarray(side + through * aperture_mm * at) for side, at in zip(sides, (v, u), strict=True))
                plane += image * self._shadow(y, x)
            else:
                plane += image * np.float32(_BARE)
        plane /= len(beams)
        if self.falloff:
            plane *= _light(self.falloff, *(np.arange(side, dtype=np.float64) for side in SHAPE)).astype(np.float32)
        noise = rng.normal(size=SHAPE) * np.sqrt(np.maximum(plane, 0) * plane.mean()) / self.snr
        return np.asarray(plane + noise, dtype=np.float32), true

    def _shadow(self, y: NDArray[np.floating], x: NDArray[np.floating]) -> NDArray[np.float32]:
        """The mask's transmittance where rays that meet the sensor's rows and columns cross it, in mm."""
        turn, wave = math.radians(self.turned_deg), 2 * np.pi * FREQUENCY_PER_MM / (1 + self.scale)
        (down, across), c, s = (1e-3 * one for one in self.moved_um), math.cos(turn), math.sin(turn)
        sums = []
        for a, b, by in ((c, s, down), (-s, c, across)):
            along = np.outer(np.exp(1j * wave * (a * y + by)), np.exp(1j * wave * b * x)).real if a and b else None
            if along is None:
                along = np.cos(wave * (y + by))[:, None] if a else np.cos(wave * (x + by))[None]
            sums.append(along + 2 * along**2)  # 1 + cos + cos of twice
        whole = 1 + self.contrast * (sums[0] * sums[1] - 1)
        return np.asarray((whole - 9 * _DARKEST) / (9 * (1 - _DARKEST)), dtype=np.float32)

    def _layers(self, rng: np.random.Generator, high: int, wide: int) -> list[tuple[float, NDArray[Any]]]:
        """The boards' shifts and spectra; they blend into each other from left to right."""
        radius = np.hypot(np.fft.fftfreq(high)[:, None], np.fft.rfftfreq(wide)[None])
        size = np.maximum(radius, 1 / 500) ** -self.exponent * (radius <= self.finest)
        size[0, 0] = 0
        count = len(self.boards)
        layers = []
        for number, shift in enumerate(self.boards):
            texture = fft.irfft2(fft.rfft2(rng.normal(size=(high, wide))) * size, s=(high, wide))
            texture *= self.rms / texture.std()
            share = 0.5 - 0.5 * np.cos(2 * np.pi * (np.arange(wide) / wide - number / count)) if count > 1 else 1.0
            light = 0.35 * np.clip(1 + texture, 0.05, None) * share / max(1.0, count / 2)
            layers.append((shift, fft.rfft2(light.astype(np.float32))))
        return layers

    def _beams(self) -> list[tuple[float, float]]:
        """Where they pass the stop, over its width; a square one needs a beam for each view."""
        count = 5 if self.stop == "square" else 10
        along = (np.arange(count) + 0.5) / count - 0.5
        beams = [(float(v), float(u)) for v in along for u in along]
        if self.stop == "round":
            return [(v, u) for v, u in beams if np.hypot(v, u) <= 0.5]
        if self.stop == "hexagon":
            turns = np.arange(6) * np.pi / 3 + 0.2
            reach = 0.5 * np.cos(np.pi / 6) + 0.02
            return [(v, u) for v, u in beams if (v * np.sin(turns) + u * np.cos(turns)).max() <= reach]
        return beams


def _light(falloff: float, rows: NDArray[np.float64], columns: NDArray[np.float64]) -> NDArray[np.float64]:
    """What a lens with this loss at the frame's corners leaves at its rows and columns."""
    y, x = (2 * (one - (side - 1) / 2) for one, side in zip((rows, columns), SHAPE, strict=True))
    return np.asarray(1 - falloff * (y[:, None] ** 2 + x**2) / (SHAPE[0] ** 2 + SHAPE[1] ** 2))


@dataclass(frozen=True)
class TrueViews:
    """The spectra of the light through each of 5 × 5 cells (v, u) of the stop, with their beams' number, of a cyclic
    scene of this shape, through a lens with this loss at the corners."""

    cells: dict[tuple[int, int], tuple[int, NDArray[np.complex64]]]
    shape: tuple[int, int]
    falloff: float = 0.0

    def add(self, at: tuple[float, float], spectrum: NDArray[np.complex64]) -> None:
        """The light of one beam."""
        cell = int((at[0] + 0.5) * 5), int((at[1] + 0.5) * 5)
        count, light = self.cells.get(cell, (0, np.zeros_like(spectrum)))
        self.cells[cell] = count + 1, light + spectrum

    def psnr(self, views: NDArray[np.floating], grid: NDArray[np.float64]) -> tuple[float, float]:
        """PSNR in dB, range 1, of views (5, 5, h, w) at a light field's grid, and of the true views' mean; a border of
        5 samples and cells without light are left out."""
        high, wide = self.shape
        fy, fx = np.fft.fftfreq(high), np.fft.rfftfreq(wide)
        steps = grid[0, 0], grid[1, 1]
        low, left = np.abs(fy) < 0.5 / steps[0], fx < 0.5 / steps[1]
        rows, columns = (
            np.exp(2j * np.pi * np.outer(np.arange(n) * step + grid[i, 2] + _MARGIN, f[keep]))
            for i, (n, step, f, keep) in enumerate(zip(views.shape[2:], steps, (fy, fx), (low, left), strict=True))
        )
        twice = np.where(fx[left] == 0, 1.0, 2.0)
        inner, through = (slice(5, -5), slice(5, -5)), (1 - 9 * _DARKEST) / (9 * (1 - _DARKEST))
        lit = _light(self.falloff, *(np.arange(n) * grid[i, i] + grid[i, 2] for i, n in enumerate(views.shape[2:])))
        truth = {
            cell: (lit * (rows @ light[np.ix_(low, left)] @ (columns * twice / (count * high * wide)).T).real)[inner]
            for cell, (count, light) in self.cells.items()
        }
        mean = np.mean(list(truth.values()), axis=0)
        errors = [np.mean((views[cell][inner] / through - one) ** 2) for cell, one in truth.items()]
        alike = [np.mean((mean - one) ** 2) for one in truth.values()]
        return float(-10 * np.log10(np.mean(errors))), float(-10 * np.log10(np.mean(alike)))
