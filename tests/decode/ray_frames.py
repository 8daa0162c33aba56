"""Frames of the thesis' masks, ray by ray, with arithmetic of their own: nothing of `dappled` is used here.

A ray from aperture point θ (at v before the sensor) to sensor point x passes the film (at d) at (1 − α)x + αθ,
α = d/v. A film that is a sum of cosines gives, for an object in focus, a factor that is a sum of plane waves on the
sensor, each with an average over the stop (`Stop`). `by_rays` sums the rays one by one instead; a test compares both.
Scenes are sampled finer than the sensor by `Shot.finer` and have detail beyond its Nyquist frequency.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, field
from functools import cached_property
from typing import Literal

import numpy as np
from numpy.typing import NDArray

FILM_PX_PER_MM = 113.8  # 4k film, as every table of the thesis has it
WAVELENGTH_MM = 550e-6

Order = tuple[int, int]
Scene = Literal["white", "texture", "boards"]
Grid = NDArray[np.float64]


@dataclass(frozen=True)
class Body:
    """A sensor: pixels, pitch (rows, columns) in mm, and the share of the real one's sides or pixels that this is."""

    shape: tuple[int, int]
    pitch_mm: tuple[float, float]
    scale: str


CANON = Body((714, 1072), (14.8 / 2848, 22.2 / 4272), "450D, a quarter of its sides")
CANON_HALF = Body((1428, 2144), (14.8 / 2848, 22.2 / 4272), "450D, half of its sides")
FUJI = Body((694, 922), (4 * 4.29 / 2776, 4 * 5.76 / 3688), "S5200, whole field, 4 × 4 pixels in one")
FUJI_FINE = Body((1388, 1844), (2 * 4.29 / 2776, 2 * 5.76 / 3688), "S5200, whole field, 2 × 2 pixels in one")


@dataclass(frozen=True)
class Film:
    """A mask as it came from the printer, 0 to 1 in transmittance. Harmonics finer than two film pixels are missing.

    `frequency_per_mm` is the design's; the print is `scale` times as fine, rows `anisotropy` finer than columns.
    """

    frequency_per_mm: float
    p: int
    pattern: Literal["diagonal", "full"] = "diagonal"
    harmonics: Literal["linear", "octave"] = "linear"
    scale: float = 1.0
    anisotropy: float = 0.0
    px_per_mm: float = FILM_PX_PER_MM

    @property
    def multiples(self) -> list[int]:
        drawn: list[int] = [2**q if self.harmonics == "octave" else q + 1 for q in range(self.p)]
        return [m for m in drawn if m * self.frequency_per_mm <= self.px_per_mm / 2]

    @cached_property
    def amplitudes(self) -> dict[Order, float]:
        """Transmittance of each order as a share of the mean, from the picture's own Fourier series."""
        n = 32 * max(self.multiples)
        t = 2 * np.pi * np.arange(n) / n
        cosines = np.array([np.cos(m * t) for m in self.multiples])
        if self.pattern == "diagonal":
            picture = cosines.T @ cosines
        else:
            picture = np.outer(1 + cosines.sum(axis=0), 1 + cosines.sum(axis=0))
        picture = (picture - picture.min()) / (picture.max() - picture.min())
        series = np.fft.fft2(picture) / picture.size
        axis = sorted({0, *self.multiples, *(-m for m in self.multiples)})
        orders = [(a, b) for a in axis for b in axis if abs(series[a, b]) > 1e-9]
        return {order: float((series[order] / series[0, 0]).real) for order in orders}


def _thesis(period_px: float, p: int, harmonics: Literal["linear", "octave"] = "linear", **more: str) -> Film:
    return Film(FILM_PX_PER_MM / period_px, p, harmonics=harmonics, **more)  # type: ignore[arg-type]  # only "pattern"


MASKS: dict[str, Film] = {
    "mask-1": _thesis(5, 2),
    "mask-2": _thesis(10, 2),
    "mask-2-full": _thesis(10, 2, pattern="full"),
    "mask-3-linear": _thesis(10, 4),
    "mask-3-octave": _thesis(10, 4, "octave"),
    "mask-4-linear": _thesis(20, 10),
    "mask-4-octave": _thesis(20, 10, "octave"),
    "mask-5-linear": _thesis(20, 5),
    "mask-5-octave": _thesis(20, 5, "octave"),
}


@dataclass(frozen=True)
class Stop:
    """The aperture: a shape within a square of side 1, as n × n points; those at the rim weigh as they are covered."""

    shape: Literal["round", "square", "polygon"] = "round"
    blades: int = 5
    n: int = 40

    @cached_property
    def points(self) -> tuple[Grid, Grid]:
        """(m, 2) points in shares of the diameter, and their weights, which sum to 1."""
        part = 8
        axis = (np.arange(self.n * part) + 0.5) / (self.n * part) - 0.5
        y, x = np.meshgrid(axis, axis, indexing="ij")
        if self.shape == "round":
            inside = np.hypot(y, x) <= 0.5
        elif self.shape == "square":
            inside = np.ones_like(y, dtype=bool)
        else:
            edges = 2 * np.pi * (np.arange(self.blades) + 0.25) / self.blades
            reach = 0.5 * math.cos(math.pi / self.blades)
            inside = np.all([y * math.sin(e) + x * math.cos(e) <= reach for e in edges], axis=0)
        weights = inside.reshape(self.n, part, self.n, part).mean(axis=(1, 3)).ravel()
        middles = axis.reshape(self.n, part).mean(axis=1)
        y, x = np.meshgrid(middles, middles, indexing="ij")
        keep = weights > 0
        return np.column_stack([y.ravel(), x.ravel()])[keep], weights[keep] / weights.sum()

    def average(self, cycles: Grid) -> NDArray[np.complex128]:
        """(k,) mean of exp(2πi ω·θ) over the stop for (k, 2) frequencies in cycles a diameter."""
        points, weights = self.points
        return np.asarray(np.exp(2j * np.pi * cycles @ points.T) @ weights)


@dataclass(frozen=True)
class Shot:
    """One exposure. `turn_deg` is from the row axis to the column axis, `shift` the film's place in periods.

    `v_mm` is the exit pupil's distance (None: the focal length), `law` where the carriers are put: "rays", or "fd" as
    the thesis' tables have it. `disparity_px` is how far the object moves on the sensor over the whole stop.
    """

    film: Film
    body: Body = CANON
    focal_length_mm: float = 50.0
    f_number: float = 22.0
    distance_mm: float = 1.01
    v_mm: float | None = None
    turn_deg: float = 0.0
    shift: tuple[float, float] = (0.13, 0.31)
    stop: Stop = field(default_factory=Stop)
    scene: Scene = "white"
    exponent: float = 1.3
    contrast: float = 0.3
    snr: float = 100.0
    law: Literal["rays", "fd"] = "rays"
    diffraction: bool = True
    finer: int = 3
    seed: int = 0

    @property
    def v(self) -> float:
        return self.focal_length_mm if self.v_mm is None else self.v_mm

    @property
    def orders(self) -> list[Order]:
        """All orders but (0, 0)."""
        return [order for order in self.film.amplitudes if order != (0, 0)]

    def film_per_mm(self, orders: list[Order]) -> Grid:
        """(k, 2) cycles/mm of orders on the film, axes of the sensor."""
        f = self.film.frequency_per_mm * self.film.scale
        k = np.array(orders, dtype=np.float64) * [
            f * (1 + self.film.anisotropy / 2),
            f * (1 - self.film.anisotropy / 2),
        ]
        c, s = math.cos(math.radians(self.turn_deg)), math.sin(math.radians(self.turn_deg))
        return np.asarray(k @ np.array([[c, s], [-s, c]]))

    def sensor_per_mm(self, orders: list[Order]) -> Grid:
        """(k, 2) cycles/mm of orders on the sensor."""
        on_film = self.film_per_mm(orders)
        if self.law == "rays":
            return on_film * (1 - self.distance_mm / self.v)
        bins = on_film * self.distance_mm / self.focal_length_mm  # of a frame one pixel a mm: see physics.md
        sides = np.array(self.body.shape) * self.body.pitch_mm
        return np.asarray(bins / sides / self.body.pitch_mm)

    @property
    def lattice(self) -> Grid:
        """(2, 2) rows: one step of ky and one of kx in cycles/pixel."""
        return self.sensor_per_mm([(1, 0), (0, 1)]) * self.body.pitch_mm

    def strengths(self, orders: list[Order]) -> NDArray[np.complex128]:
        """(k,) complex amplitude of each order on the sensor before its pixels, as a share of the mean."""
        on_film = self.film_per_mm(orders)
        own = np.array([self.film.amplitudes[order] for order in orders])
        pixel = np.sinc(on_film / self.film.px_per_mm).prod(axis=1)
        turns = WAVELENGTH_MM * self.distance_mm * (on_film**2).sum(axis=1)  # a diagonal order's frequency is √2·k·f_m
        light = np.cos(np.pi * turns) if self.diffraction else np.ones(len(orders))
        swept = on_film * self.distance_mm / self.v * (self.v / self.f_number)
        place = np.exp(2j * np.pi * np.array(orders) @ self.shift)
        return np.asarray(own * pixel * light * self.stop.average(swept) * place)

    def seen(self) -> dict[Order, float]:
        """Strength of each order below Nyquist on the frame, pixels included."""
        at = self.sensor_per_mm(self.orders) * self.body.pitch_mm
        size = np.abs(self.strengths(self.orders)) * np.abs(np.sinc(at).prod(axis=1))
        return {o: float(s) for o, s, f in zip(self.orders, size, at, strict=True) if np.abs(f).max() < 0.49}

    def _scene(self) -> Grid:
        """(h, w) mean 1, on the fine grid."""
        rng = np.random.default_rng(1000 + self.seed)
        high, wide = (side * self.finer for side in self.body.shape)
        y, x = np.linspace(-1, 1, high)[:, None], np.linspace(-1, 1, wide)[None, :]
        shading = 1 - 0.1 * (y**2 + x**2) + 0.03 * x
        if self.scene == "white":
            return np.asarray(shading / shading.mean())
        fy, fx = np.fft.fftfreq(high)[:, None] * high, np.fft.rfftfreq(wide)[None, :] * wide
        size = np.maximum(np.hypot(fy, fx), 1.0) ** -self.exponent
        picture = np.fft.irfft2(np.fft.rfft2(rng.normal(size=(high, wide))) * size, s=(high, wide))
        picture = 1 + self.contrast * picture / picture.std()
        if self.scene == "boards":
            for _ in range(12):
                top, left = rng.integers(0, high * 3 // 4), rng.integers(0, wide * 3 // 4)
                down, across = rng.integers(high // 20, high // 4), rng.integers(wide // 20, wide // 4)
                picture[top : top + down, left : left + across] *= rng.uniform(0.3, 1.8)
        picture = np.clip(picture, 0.05, None) * shading
        return np.asarray(picture / picture.mean())

    def _film_on_sensor(self) -> Grid:
        """(h, w) on the fine grid: what share of the light passes, mean 1."""
        orders = [order for order in self.orders if order > (0, 0)]
        at = self.sensor_per_mm(orders) * self.body.pitch_mm / self.finer
        values = self.strengths(orders)
        rows, columns = (np.arange(side * self.finer) for side in self.body.shape)
        middle = [(side * self.finer - 1) / 2 for side in self.body.shape]
        down = np.exp(2j * np.pi * np.outer(rows - middle[0], at[:, 0])) * (2 * values)
        across = np.exp(2j * np.pi * np.outer(at[:, 1], columns - middle[1]))
        return np.asarray(1 + down.real @ across.real - down.imag @ across.imag)

    def _on_pixels(self, fine: Grid) -> Grid:
        high, wide = self.body.shape
        return np.asarray(fine.reshape(high, self.finer, wide, self.finer).mean(axis=(1, 3)))

    def _noisy(self, plane: Grid, mean: float) -> NDArray[np.float32]:
        rng = np.random.default_rng(self.seed)
        plane = plane * (mean / plane.mean())
        noise = rng.normal(size=plane.shape) * np.sqrt(np.maximum(plane, 0) * mean) / self.snr
        return np.clip(plane + noise, 0, 1).astype(np.float32)

    def frame(self, mean: float = 0.35) -> NDArray[np.float32]:
        """The plane float32 (H, W), 1.0 = sensor white."""
        return self._noisy(self._on_pixels(self._scene() * self._film_on_sensor()), mean)

    def without_film(self, mean: float = 0.35) -> NDArray[np.float32]:
        """The same scene and noise with no film before the sensor."""
        return self._noisy(self._on_pixels(self._scene()), mean)

    def by_rays(self) -> Grid:
        """(H, W) on pixels, white scene, no noise: the film's picture summed over rays, one stop point after another.

        Each harmonic's own loss on film and on its way (`strengths`) is left out: geometry alone.
        """
        alpha = self.distance_mm / self.v
        pitch = np.array(self.body.pitch_mm)
        points, weights = self.stop.points
        rows, columns = (np.arange(side * self.finer) for side in self.body.shape)
        y = (rows - (rows.size - 1) / 2) * pitch[0] / self.finer
        x = (columns - (columns.size - 1) / 2) * pitch[1] / self.finer
        axes = self.film_per_mm([(1, 0), (0, 1)])
        total = np.zeros((y.size, x.size))
        for theta, weight in zip(points * self.v / self.f_number, weights, strict=True):
            at_y, at_x = (1 - alpha) * y[:, None] + alpha * theta[0], (1 - alpha) * x[None, :] + alpha * theta[1]
            turns = [axes[i, 0] * at_y + axes[i, 1] * at_x + self.shift[i] for i in (0, 1)]
            cosines = [[np.cos(2 * np.pi * m * t) for m in self.film.multiples] for t in turns]
            if self.film.pattern == "diagonal":
                picture = sum(a * b for a, b in zip(*cosines, strict=True))
                share = 4 * self.film.amplitudes[self.film.multiples[0], self.film.multiples[0]]
            else:
                picture = (1 + sum(cosines[0])) * (1 + sum(cosines[1])) - 1
                share = 2 * self.film.amplitudes[0, self.film.multiples[0]]
            total += weight * (1 + share * picture)
        return self._on_pixels(total)


def line_strength(plane: NDArray[np.floating], fy: float, fx: float) -> complex:
    """Amplitude of a plane wave of (fy, fx) cycles/pixel about the frame's centre, as a share of the mean; Hann."""
    rows, columns = np.arange(plane.shape[0]), np.arange(plane.shape[1])
    down = np.hanning(plane.shape[0]) * np.exp(-2j * np.pi * fy * (rows - (rows.size - 1) / 2))
    across = np.hanning(plane.shape[1]) * np.exp(-2j * np.pi * fx * (columns - (columns.size - 1) / 2))
    whole = np.hanning(plane.shape[0]) @ plane @ np.hanning(plane.shape[1])
    return complex(down @ plane @ across / whole)


def floors(plane: Grid, places: Grid, bins: int = 5) -> Grid:
    """(k,) median strength of the 11 × 11 bins around (k, 2) frequencies: what a line there must exceed."""
    window = np.outer(np.hanning(plane.shape[0]), np.hanning(plane.shape[1]))
    spectrum = np.abs(np.fft.fft2(plane * window)) / float((plane * window).sum())
    around = np.arange(-bins, bins + 1)
    found = []
    for place in places:
        row, column = np.rint(np.array(place) * plane.shape).astype(int)
        found.append(np.median(spectrum[np.ix_((row + around) % plane.shape[0], (column + around) % plane.shape[1])]))
    return np.array(found)


def orders_above_noise(shot: Shot, times: float = 8.0) -> list[Order]:
    """The orders of half of the plane that are that many times stronger than the same frame without the film there.

    The level is the median over 11 × 11 bins, 1.2 standard deviations of a line's amplitude: 8 of it place a line to
    about 0.06 bins at best.
    """
    seen = shot.seen()
    orders = [order for order in seen if order > (0, 0)]
    level = (
        floors(np.asarray(shot.without_film(), dtype=np.float64), np.array(orders) @ shot.lattice)
        if orders
        else np.zeros(0)
    )
    return [order for order, at in zip(orders, level, strict=True) if seen[order] > times * float(at)]
