"""Masked frames of any mask, stop, layout and distance, drawn by Latin hypercube; nothing of `dappled` makes them.

Rays: for each of 15 × 15 points of the stop the scene is moved by its parallax and multiplied by the film's Fourier
series at the place where the rays pass it, summed wave by wave of the film (`ray_frames` has films, stops and what is
lost on film, by diffraction and on pixels). The truth is the same camera without film.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from functools import cached_property
from typing import Literal

import numpy as np
from numpy.typing import NDArray
from scipy import fft

from tests.decode.ray_frames import CANON, FUJI, MASKS, WAVELENGTH_MM, Film, Stop

Grid = NDArray[np.float64]
Layout = Literal["rows", "staggered"]
COUNT, SEED, SHAPE, V_MM, MEAN = 200, 44, (320, 432), 50.0, 0.4
FILMS = {
    "mask-1": MASKS["mask-1"],
    "mask-2": MASKS["mask-2"],
    "mask-3": MASKS["mask-3-linear"],
    "mask-4": MASKS["mask-4-linear"],
    "mask-5": MASKS["mask-5-linear"],
    "reference": Film(15.5, 2, "full", px_per_mm=1000.0),
}
PATTERNS: dict[tuple[Layout, bool], list[list[int]]] = {
    ("rows", False): [[0]],
    ("rows", True): [[0, 1], [1, 2]],
    ("staggered", False): [[0, -1], [-1, 0]],
    ("staggered", True): [[1, -1, 1, -1], [-1, 0, -1, 2]],
}


@dataclass(frozen=True)
class Drawn:
    """One exposure; `disparity_px` is from view to view of its own stop."""

    layout: Layout
    mask: str
    stop: Literal["square", "round", "polygon"]
    f_number: float
    snr: float
    disparity_px: float
    exponent: float
    coloured: bool
    seed: int

    @property
    def film(self) -> Film:
        return FILMS[self.mask]

    @property
    def pitch_mm(self) -> tuple[float, float]:
        if self.mask == "reference":
            return 0.01, 0.01
        return CANON.pitch_mm if self.layout == "rows" else FUJI.pitch_mm

    @property
    def distance_mm(self) -> float:
        return 0.48 if self.mask == "reference" else 1.01

    @property
    def pattern(self) -> NDArray[np.intp]:
        return np.array(PATTERNS[self.layout, self.coloured], dtype=np.intp)

    @cached_property
    def colour_at(self) -> NDArray[np.intp]:
        """(H, W) the colour of each pixel; -1 where none is."""
        pattern = self.pattern
        return np.tile(pattern, [-(-side // n) for side, n in zip(SHAPE, pattern.shape, strict=True)])[
            : SHAPE[0], : SHAPE[1]
        ]

    @cached_property
    def scenes(self) -> list[Grid]:
        """A texture for each colour, alike but for its brightness and a third of its detail."""
        rng = np.random.default_rng([self.seed, SEED])
        f = np.hypot(fft.fftfreq(SHAPE[0])[:, None], fft.rfftfreq(SHAPE[1])[None, :])
        f[0, 0] = np.inf
        waves = [fft.rfft2(rng.normal(size=SHAPE)) * f**-self.exponent for _ in range(4)]
        made = []
        for own, gain in zip(waves[1:], (0.6, 1.0, 0.8) if self.coloured else (1.0,), strict=False):
            detail = fft.irfft2(waves[0] + own / 3, s=SHAPE)
            made.append(gain * np.clip(MEAN + 0.12 * detail / detail.std(), 0.05, 0.75))
        return made

    @cached_property
    def lights(self) -> tuple[Grid, Grid, Grid]:
        """The frame behind the film, without it, and the film's shadow in focus; free of noise, mean transmittance
        1."""
        orders = [order for order in self.film.amplitudes if order > (0, 0)]
        per_mm = np.array(orders) * self.film.frequency_per_mm
        alpha = self.distance_mm / V_MM
        lost = np.sinc(per_mm / self.film.px_per_mm).prod(axis=1)
        lost *= np.sinc(per_mm * (1 - alpha) * self.pitch_mm).prod(axis=1)
        lost *= np.cos(np.pi * WAVELENGTH_MM * self.distance_mm * (per_mm**2).sum(axis=1))
        values = 2 * lost * np.array([self.film.amplitudes[order] for order in orders])
        y, x = ((np.arange(side) - (side - 1) / 2) * pitch for side, pitch in zip(SHAPE, self.pitch_mm, strict=True))
        down = np.exp(2j * np.pi * np.outer((1 - alpha) * y, per_mm[:, 0]))
        across = np.exp(2j * np.pi * np.outer(per_mm[:, 1], (1 - alpha) * x))
        fy, fx = fft.fftfreq(SHAPE[0]), fft.rfftfreq(SHAPE[1])
        moved = self.disparity_px * (2 * self.film.p + 1)
        waves = [fft.rfft2(scene) for scene in self.scenes]
        colour = np.maximum(self.colour_at, 0)
        points, weights = Stop(self.stop, blades=6, n=15).points
        parallax = [np.exp(-2j * np.pi * moved * np.outer(f, at)) for f, at in zip((fy, fx), points.T, strict=True)]

        def through(of_points: Grid) -> Grid:
            """The scene as the points of the stop see it, by weight."""
            together = (parallax[0] * of_points) @ parallax[1].T
            return np.choose(colour, [fft.irfft2(wave * together, s=SHAPE) for wave in waves])

        places = points * alpha * V_MM / self.f_number + (0.013, 0.021)
        turned = values[:, None] * np.exp(2j * np.pi * per_mm @ places.T)  # orders, points
        plain = through(weights)
        masked, shadow = plain.copy(), np.ones(SHAPE)
        for k, turns in enumerate(turned * weights):
            wave = np.outer(down[:, k], across[k])
            shadow += (turns.sum() * wave).real
            masked += through(turns.real) * wave.real - through(turns.imag) * wave.imag
        return masked, plain, shadow

    def frame(self) -> NDArray[np.float32]:
        light = self.lights[0]
        noise = np.random.default_rng(self.seed).normal(size=SHAPE)
        made = light + noise * np.sqrt(np.maximum(light, 0) * MEAN) / self.snr
        return np.where(self.colour_at >= 0, made, 0).astype(np.float32)

    def band(self, frame: NDArray[np.float32]) -> Grid:
        """What a slice around the mean holds: half of the carriers' distance to each side."""
        half = 0.5 * self.film.frequency_per_mm * (1 - self.distance_mm / V_MM)
        keep = [np.abs(fft.fftfreq(side, pitch)) < half for side, pitch in zip(SHAPE, self.pitch_mm, strict=True)]
        made = np.zeros(SHAPE)
        for colour in range(len(self.scenes)):
            own = self.colour_at == colour
            passed = [fft.ifft2(fft.fft2(image) * np.outer(*keep)).real for image in (np.where(own, frame, 0), own)]
            made[own] = (passed[0] / np.maximum(passed[1], 1e-6))[own]
        return made

    def psnr(self, found: NDArray[np.floating], border: int = 20) -> float:
        """Against the truth, in dB, range 1, where the chip has pixels."""
        cut = (slice(border, -border),) * 2
        off = (np.asarray(found) - self.lights[1])[cut][self.colour_at[cut] >= 0]
        return float(-10 * np.log10(np.mean(off**2)))


def draw() -> list[Drawn]:
    """Configurations by Latin hypercube: of each factor, each level equally often."""
    from scipy.stats import qmc  # noqa: PLC0415  half a second, which each collection of tests would take

    made = []
    for seed, row in enumerate(qmc.LatinHypercube(8, rng=np.random.default_rng(SEED)).random(COUNT)):

        def between(share: float, low: float, high: float) -> float:
            return float(low * (high / low) ** share)

        def level(share: float, names: tuple[str, ...]) -> str:
            return names[math.floor(share * len(names))]

        made.append(
            Drawn(
                level(row[0], ("rows", "staggered")),  # type: ignore[arg-type]  # one of these
                level(row[1], tuple(FILMS)),
                level(row[2], ("square", "round", "polygon")),  # type: ignore[arg-type]  # likewise
                between(row[3], 5.6, 22.0),
                between(row[4], 20.0, 300.0),
                between(row[5], 0.03, 3.3),
                1.1 + 0.9 * row[6],
                bool(row[7] < 0.5),
                seed,
            )
        )
    return made
