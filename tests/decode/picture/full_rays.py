"""Masked frames of scenes with all the detail that the sensor holds, ray by ray; nothing of `dappled` is used here.

A ray from aperture point θ (shares of the diameter A, at v before the sensor) to sensor point x passes the film (at d)
at (1 − α)x + αAθ, α = d/v. The stop is 3 × 3 points for each of 5 × 5 views. The truth is the same camera without film.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Literal

import numpy as np
from numpy.typing import NDArray
from scipy import fft

Grid = NDArray[np.float64]
PITCH_MM, V_MM, DISTANCE_MM, PER_MM, VIEWS, POINTS = 0.01, 50.0, 0.48, 15.5, 5, 3


@dataclass(frozen=True)
class Shot:
    """One exposure. `disparity_px` is from view to view of a stop of f/7.4; `falloff` is lost in the corners."""

    shape: tuple[int, int] = (288, 352)
    f_number: float = V_MM / 6.7
    stop: Literal["round", "square"] = "round"
    disparity_px: float = 0.1
    exponent: float = 1.1
    snr: float = 100.0
    scale: float = 1.0
    turn_deg: float = 0.0
    shift_mm: tuple[float, float] = (0.013, 0.021)
    falloff: float = 0.0
    contrast: float = 0.12
    white: bool = False
    seed: int = 0

    @cached_property
    def scene(self) -> Grid:
        """Amplitude f^-exponent, mean 0.4, within 0.05 and 0.75."""
        rng = np.random.default_rng(self.seed)
        fy, fx = fft.fftfreq(self.shape[0])[:, None], fft.rfftfreq(self.shape[1])[None, :]
        f = np.hypot(fy, fx)
        f[0, 0] = 1
        waves = fft.rfft2(rng.normal(size=self.shape)) * f**-self.exponent
        waves[0, 0] = 0
        made = fft.irfft2(waves, s=self.shape)
        return (
            np.clip(0.4 + self.contrast * made / made.std(), 0.05, 0.75) if not self.white else np.full(self.shape, 0.4)
        )

    @cached_property
    def both(self) -> tuple[Grid, Grid]:
        """The frame's light behind the film (of mean transmittance 1) and without it, free of noise."""
        n = VIEWS * POINTS
        axis = (np.arange(n) - (n - 1) / 2) / n
        points = [(v, u) for v in axis for u in axis if self.stop == "square" or math.hypot(v, u) <= 0.5]
        waves = fft.rfft2(self.scene)
        fy, fx = fft.fftfreq(self.shape[0]), fft.rfftfreq(self.shape[1])
        y, x = ((np.arange(side) - (side - 1) / 2) * PITCH_MM for side in self.shape)
        alpha, aperture = DISTANCE_MM / V_MM, V_MM / self.f_number
        moved = self.disparity_px * VIEWS * aperture / 6.7
        masked, plain = np.zeros(self.shape), np.zeros(self.shape)
        for v, u in points:
            seen = self.scene
            if moved and not self.white:
                down, across = (np.exp(-2j * np.pi * moved * f * at) for f, at in ((fy, v), (fx, u)))
                seen = fft.irfft2(waves * down[:, None] * across, s=self.shape)
            film = self.film((1 - alpha) * y + alpha * aperture * v, (1 - alpha) * x + alpha * aperture * u)
            masked += seen * film
            plain += seen
        corner = self.falloff * (y[:, None] ** 2 + x[None, :] ** 2) / (y[0] ** 2 + x[0] ** 2)
        return masked / len(points) * (1 - corner), plain / len(points) * (1 - corner)

    def film(self, y: Grid, x: Grid) -> Grid:
        cos, sin = math.cos(math.radians(self.turn_deg)), math.sin(math.radians(self.turn_deg))
        cycles = 2 * np.pi * PER_MM * self.scale
        down, across = cycles * (y + self.shift_mm[0]), cycles * (x + self.shift_mm[1])
        sums = []
        for a, b in ((cos * down, sin * across), (-sin * down, cos * across)):  # 1 + Σ cos q(a + b), as a product
            rows = [np.ones_like(a), *(of(q * a) for q in (1, 2) for of in (np.cos, np.sin))]
            columns = [np.ones_like(b), *(sign * of(q * b) for q in (1, 2) for sign, of in ((1, np.cos), (-1, np.sin)))]
            sums.append(np.array(rows).T @ np.array(columns))
        return np.asarray((sums[0] * sums[1] + 0.375) / 1.375)

    def noise(self) -> Grid:
        return np.random.default_rng(self.seed + 1000).normal(size=self.shape) * 0.4 / self.snr

    @property
    def frame(self) -> NDArray[np.float32]:
        return np.asarray(self.both[0] + self.noise(), dtype=np.float32)

    @property
    def truth(self) -> Grid:
        return self.both[1]

    @property
    def shadow(self) -> Grid:
        """The film's true shadow in focus."""
        return replace(self, white=True, falloff=0.0).both[0] / 0.4


def psnr(found: NDArray[np.floating], truth: NDArray[np.floating], border: int = 16) -> float:
    """PSNR in dB with range 1, a border left out."""
    cut = (slice(border, -border),) * 2
    return float(-10 * np.log10(np.mean((np.asarray(found)[cut] - truth[cut]) ** 2)))
