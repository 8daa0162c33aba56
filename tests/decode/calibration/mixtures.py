"""Frames of random cameras and scenes, with their mask or without, by a simulator that shares no code with `rays`.

Beams of power-law textures are moved by phase ramps, exactly, and the mask's shadow by its own phase.
"""

from __future__ import annotations

from dataclasses import dataclass
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
    (cycles/pixel) of their texture, `rms` its contrast."""

    seed: int
    present: bool = True
    f_number: float = IDEAL_F
    stop: str = "square"
    snr: float = 100.0
    boards: tuple[float, ...] = (-0.6, 1.4)
    exponent: float = 1.3
    finest: float = 1.0
    rms: float = 0.2

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

    def plane(self) -> NDArray[np.float32]:
        """What the sensor sees, 1.0 = white."""
        rng = np.random.default_rng([self.seed, 5])
        high, wide = (fft.next_fast_len(side + 2 * _MARGIN, real=True) for side in SHAPE)
        layers = self._layers(rng, high, wide)
        inside = (slice(_MARGIN, _MARGIN + SHAPE[0]), slice(_MARGIN, _MARGIN + SHAPE[1]))
        fy, fx = np.fft.fftfreq(high)[:, None], np.fft.rfftfreq(wide)[None]
        aperture_mm = FOCAL_MM / self.f_number
        step = 5 * aperture_mm / (FOCAL_MM / IDEAL_F)  # of a board of one pixel, over the stop
        through = DISTANCE_MM / FOCAL_MM
        sides = [(np.arange(side) - (side - 1) / 2) * PITCH_MM * (1 - through) for side in SHAPE]
        plane = np.zeros(SHAPE, np.float32)
        beams = self._beams()
        for v, u in beams:
            moved = np.zeros((high, wide // 2 + 1), np.complex64)
            for shift, spectrum in layers:
                down, across = (np.exp(-2j * np.pi * shift * step * f * at) for f, at in ((fy, v), (fx, u)))
                moved += spectrum * down.astype(np.complex64) * across.astype(np.complex64)
            image = fft.irfft2(moved, s=(high, wide))[inside]
            if self.present:
                y, x = (
                    2 * np.pi * FREQUENCY_PER_MM * (side + through * aperture_mm * at)
                    for side, at in zip(sides, (v, u), strict=True)
                )
                rows, columns = (1 + np.cos(phase) + np.cos(2 * phase) for phase in (y, x))
                shadow = (np.outer(rows, columns) - 9 * _DARKEST) / (9 * (1 - _DARKEST))
                plane += image * shadow.astype(np.float32)
            else:
                plane += image * np.float32(_BARE)
        plane /= len(beams)
        noise = rng.normal(size=SHAPE) * np.sqrt(np.maximum(plane, 0) * plane.mean()) / self.snr
        return np.asarray(plane + noise, dtype=np.float32)

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
