"""Masked frames in focus by wave optics: what diffraction at the film does, which no rays show. Nothing of `dappled` is
used here, nor of the rays.

The wave that a lens with a square stop focuses on the sensor point x₀ passes the film at d. The film's amplitude
Σ t_k e^{2πi k·f x} makes of it Σ t_k e^{2πi k·f x₀} A(x − x₀ − λ d f k) on the sensor, A the stop's own diffraction
(Fresnel, exact for a wave that converges). Points of the scene don't interfere; a frame is the mean of three colours.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from functools import cached_property
from typing import Literal

import numpy as np
from numpy.typing import NDArray
from scipy import fft

Grid = NDArray[np.float64]
COLOURS_UM = (0.45, 0.55, 0.65)


@dataclass(frozen=True)
class WaveCamera:
    """A film of transmittance (1 + Σ cos)(1 + Σ cos) ("diagonal": Σ cos·cos), black where that is lowest, of the `p`
    harmonics of its frequency that it can draw, before a sensor of this pitch (rows, columns)."""

    per_um: float
    p: int
    pattern: Literal["full", "diagonal"]
    pitch_um: tuple[float, float]
    distance_um: float
    px_per_um: float = math.inf  # of the film

    @property
    def orders(self) -> int:
        """Of the film's amplitude, which has more than its transmittance."""
        return 2 * self.drawn + 2

    @property
    def drawn(self) -> int:
        """The highest harmonic."""
        return self.p if math.isinf(self.px_per_um) else min(self.p, int(self.px_per_um / 2 / self.per_um + 1e-9))

    @cached_property
    def amplitudes(self) -> NDArray[np.complex128]:
        """t_k for −orders … orders on both axes: the film's phase is flat, its transmittance of mean 1."""
        n = 16 * self.orders
        turns = 2 * np.pi * np.arange(n) / n
        waves = np.array([np.cos(m * turns) for m in range(1, self.drawn + 1)])
        if self.pattern == "full":
            line = 1 + waves.sum(axis=0)
            light = np.outer(line, line)
        else:
            light = waves.T @ waves
        light = light - light.min()
        if not math.isinf(self.px_per_um):  # a film's pixels are squares
            blur = np.sinc(fft.fftfreq(n, 1 / n) * self.per_um / self.px_per_um)
            light = np.maximum(fft.ifft2(fft.fft2(light) * np.outer(blur, blur)).real, 0)
        found = fft.fft2(np.sqrt(light / light.mean())) / n**2
        orders = np.arange(-self.orders, self.orders + 1)
        return np.asarray(found[np.ix_(orders, orders)])

    @cached_property
    def pairs(self) -> list[tuple[int, int, NDArray[np.complex128]]]:
        """(my, mx, t_k t*_{k − m}) of the orders m of the transmittance that are worth a wave."""
        reach, made = self.drawn + 2, []
        for m in np.ndindex(2 * reach + 1, 2 * reach + 1):
            my, mx = (one - reach for one in m)
            pairs = self.amplitudes * shifted(self.amplitudes, my, mx).conj()
            if np.abs(pairs).max() >= 1e-4:
                made.append((my, mx, pairs))
        return made

    @property
    def clear(self) -> NDArray[np.complex128]:
        """The same of a film that takes nothing."""
        made = np.zeros_like(self.amplitudes)
        made[self.orders, self.orders] = 1
        return made


def canon(period_px: int, p: int) -> WaveCamera:
    """A 450D with one of the thesis' masks on 4k film."""
    return WaveCamera(113.8e-3 / period_px, p, "diagonal", (14.8e3 / 2848, 22.2e3 / 4272), 1010.0, 113.8e-3)


REFERENCE = WaveCamera(15.5e-3, 2, "full", (10.0, 10.0), 480.0)
CAMERAS = {
    "reference": REFERENCE,
    **{f"mask-{number}": canon(*one) for number, one in enumerate(((5, 2), (10, 2), (10, 4), (20, 10), (20, 5)), 1)},
}


@dataclass(frozen=True)
class WaveShot:
    """One exposure of a scene of amplitude f^-exponent up to the sensor's limit."""

    f_number: float
    exponent: float = 1.1
    snr: float = 100.0
    shape: tuple[int, int] = (192, 192)
    contrast: float = 0.12
    masked: bool = True
    camera: WaveCamera = REFERENCE
    seed: int = 5
    finer: int = 4  # samples a pixel

    def shadow(self) -> Grid:
        """What the film makes of a white page, 1 in the mean."""
        camera, total = self.camera, np.zeros(self.shape, dtype=complex)
        y, x = (np.arange(side) - (side - 1) / 2 for side in self.shape)
        for my, mx, pairs in camera.pairs:
            lines = [
                [kernels(camera, np.array([camera.per_um * m]), m, colour, self.f_number) for m in (my, mx)]
                for colour in COLOURS_UM
            ]
            through = sum(complex((down.T @ pairs @ across)[0, 0]) for down, across in lines) / len(lines)
            sides = zip((my, mx), (y, x), camera.pitch_um, strict=True)
            total += through * np.outer(
                *(
                    np.exp(2j * np.pi * camera.per_um * m * at * pitch) * np.sinc(m * camera.per_um * pitch)
                    for m, at, pitch in sides
                )
            )
        return np.asarray(total.real)

    def band(self, frame: Grid) -> Grid:
        """What a slice around the mean holds: half of the carriers' distance to each side."""
        half = 0.5 * self.camera.per_um
        keep = [
            np.abs(fft.fftfreq(side, one)) < half for side, one in zip(self.shape, self.camera.pitch_um, strict=True)
        ]
        return np.asarray(fft.ifft2(fft.fft2(frame) * np.outer(*keep)).real)

    def scene(self) -> Grid:
        """On the fine grid, without detail that pixels can't sample."""
        fy, fx = fft.fftfreq(self.shape[0])[:, None], fft.fftfreq(self.shape[1])[None, :]
        f = np.hypot(fy, fx)
        f[0, 0] = 1
        waves = fft.fft2(np.random.default_rng(self.seed).normal(size=self.shape)) * f**-self.exponent
        waves[0, 0] = 0
        waves[self.shape[0] // 2] = waves[:, self.shape[1] // 2] = 0
        wide = np.zeros([self.finer * side for side in self.shape], dtype=complex)
        down, across = (np.round(fft.fftfreq(side, 1 / side)).astype(int) for side in self.shape)
        wide[np.ix_(down, across)] = waves
        made = fft.ifft2(wide).real
        return np.asarray(np.clip(0.4 + self.contrast * made / made.std(), 0.05, 0.75))

    def light(self) -> Grid:
        """The frame, free of noise, of mean transmittance 1."""
        scene, camera = self.scene(), self.camera
        y, x = (
            (np.arange(side) / self.finer - (side / self.finer - 1) / 2) * pitch
            for side, pitch in zip(scene.shape, camera.pitch_um, strict=True)
        )
        fy, fx = (
            fft.fftfreq(side, pitch / self.finer) for side, pitch in zip(scene.shape, camera.pitch_um, strict=True)
        )
        pixel = np.outer(*(np.sinc(f * pitch) for f, pitch in zip((fy, fx), camera.pitch_um, strict=True)))
        seen = np.zeros(scene.shape, dtype=complex)
        for my, mx, pairs in camera.pairs if self.masked else [(0, 0, camera.clear)]:
            turn = np.outer(*(np.exp(2j * np.pi * camera.per_um * k * at) for k, at in ((my, y), (mx, x))))
            waves = fft.fft2(scene * turn)
            for colour in COLOURS_UM:
                down, across = (kernels(camera, f, k, colour, self.f_number) for f, k in ((fy, my), (fx, mx)))
                seen += waves * (down.T @ pairs @ across)
        return np.asarray(fft.ifft2(seen * pixel).real[:: self.finer, :: self.finer] / len(COLOURS_UM))

    def noise(self) -> Grid:
        return np.random.default_rng(77).normal(size=self.shape) * 0.4 / self.snr


def shifted(amplitudes: NDArray[np.complex128], my: int, mx: int) -> NDArray[np.complex128]:
    """t_{k − m} at k; 0 beyond the last order."""
    made = np.zeros_like(amplitudes)
    size = len(amplitudes)
    to = [slice(max(0, m), size + min(0, m)) for m in (my, mx)]
    of = [slice(max(0, -m), size + min(0, -m)) for m in (my, mx)]
    made[to[0], to[1]] = amplitudes[of[0], of[1]]
    return made


def kernels(camera: WaveCamera, frequencies: Grid, m: int, colour_um: float, f_number: float) -> NDArray[np.complex128]:
    """(orders k, frequencies): the transform of A(x − s k) A*(x − s (k − m)) along one axis, s = λ d f; 1 at 0 for
    m = 0."""
    edge = 1 / (2 * colour_um * f_number)
    step = colour_um * camera.distance_um * camera.per_um
    low, high = np.maximum(-edge, frequencies - edge), np.minimum(edge, frequencies + edge)
    width, middle = np.maximum(high - low, 0), (high + low) / 2
    both = width * np.sinc(step * m * width) * np.exp(-2j * np.pi * step * m * middle) / (2 * edge)
    k = np.arange(-camera.orders, camera.orders + 1)[:, None]
    return np.asarray(both * np.exp(-2j * np.pi * step * (k - m) * frequencies))


def contrast_left(found: NDArray[np.floating], truth: Grid, band: tuple[float, float], border: int = 16) -> float:
    """The share of the truth's detail in a band (cycles/px) that a picture holds, by their common waves."""
    cut = (slice(border, -border),) * 2
    window = np.outer(*(np.hanning(side - 2 * border) for side in truth.shape))
    one, other = (fft.fft2((np.asarray(a, np.float64)[cut] - a[cut].mean()) * window) for a in (found, truth))
    f = np.hypot(fft.fftfreq(one.shape[0])[:, None], fft.fftfreq(one.shape[1])[None, :])
    inside = (f >= band[0]) & (f < band[1])
    return float((one * other.conj()).real[inside].sum() / (np.abs(other) ** 2)[inside].sum())


def draw(count: int = 24, seed: int = 44) -> list[tuple[str, WaveShot]]:
    """Exposures in focus by Latin hypercube, each camera equally often."""
    from scipy.stats import qmc  # noqa: PLC0415  half a second, which each collection of tests would take

    made = []
    for number, row in enumerate(qmc.LatinHypercube(4, rng=np.random.default_rng(seed)).random(count)):
        name = list(CAMERAS)[math.floor(row[0] * len(CAMERAS))]
        f_number, snr = (
            float(low * (high / low) ** at) for at, low, high in zip(row[1:3], (5.6, 20), (22, 300), strict=True)
        )
        wide = {"mask-4": 2, "mask-5": 2}.get(name, 1)  # periods twice as long
        shot = WaveShot(
            f_number,
            1.1 + 0.9 * row[3],
            snr,
            (192 * wide, 192 * wide),
            camera=CAMERAS[name],
            seed=number,
            finer=4 // wide,
        )
        made.append((name, shot))
    return made
