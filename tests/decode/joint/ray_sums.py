"""Frames and true views of a small masked camera, summed ray by ray; shares no code with `dappled.mocks`.

Boards are cyclic textures under smooth covers, each at one disparity. Light from each point of the stop is moved by a
phase ramp on a grid twice as fine as the sensor, multiplied by the mask where the ray meets it, and sampled.
"""

from __future__ import annotations

import itertools
import math
from dataclasses import dataclass
from functools import cached_property
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from dappled.decode.calibration.calibration import Calibration, LatticeFit
from dappled.decode.decoder import MaskDecoder
from dappled.decode.optics import MaskedOptics
from dappled.decode.optics.carriers import Lattice, Mask, Sensor

Floats = NDArray[np.float64]
FOCAL_MM, DISTANCE_MM, PITCH_MM = 50.0, 0.48, 0.01
MASK = Mask(15.5, 2)
FINER = 2
DARKEST = -0.375  # of (1 + cos + cos)(1 + cos + cos)


@dataclass(frozen=True)
class RaySum:
    """A stop of `views` × `views` cells with `points`² points in each (round: those in the circle), of a diameter of
    `kappa` of the ideal. `boards` are disparities in pixels over the ideal aperture; textures fall as f^-`exponent` up
    to `finest` cycles/pixel, with an rms of `contrast`. `snr` is the raw signal's at the mean of 0.35, None without
    noise. Boards may have places of their own, blend into each other, or be everywhere and shine through each other."""

    boards: tuple[float, ...] = (-6.0, 12.0)
    exponent: float = 1.3
    finest: float = 1.0
    contrast: float = 0.2
    points: int = 1
    round: bool = False
    kappa: float = 1.0
    snr: float | None = None
    shape: tuple[int, int] = (300, 360)
    seed: int = 0
    views: int = 5
    covers: Literal["blending", "apart", "everywhere"] = "blending"

    @property
    def f_number(self) -> float:
        return MASK.frequency_per_mm * DISTANCE_MM / self.kappa

    @property
    def lattice(self) -> Lattice:
        step = MASK.frequency_per_mm * (1 - DISTANCE_MM / FOCAL_MM) * PITCH_MM
        return Lattice((step, 0.0), (0.0, step))

    @cached_property
    def stop(self) -> tuple[Floats, NDArray[np.intp]]:
        """(points (J, 2) in shares of the aperture, the view of each)."""
        n = self.views * self.points
        axis = (np.arange(n) + 0.5) / n - 0.5
        both = np.array(list(itertools.product(range(n), repeat=2)))
        places = axis[both]
        inside = np.hypot(*places.T) <= 0.5 if self.round else np.ones(len(places), dtype=bool)
        cell = both // self.points
        return places[inside], (cell[:, 0] * self.views + cell[:, 1])[inside]

    def _textures(self) -> list[tuple[float, NDArray[np.complex128]]]:
        """(disparity, spectrum on the fine grid) of each board; their sum has the mean 0.35."""
        rng = np.random.default_rng([self.seed, 71])
        high, wide = (side * FINER for side in self.shape)
        fy, fx = np.fft.fftfreq(high)[:, None] * FINER, np.fft.rfftfreq(wide)[None] * FINER  # cycles/pixel
        f = np.hypot(fy, fx)
        size = np.maximum(f, 1 / max(self.shape)) ** -self.exponent * (f <= self.finest) * (f > 0)
        waves = [np.cos(2 * np.pi * (np.arange(wide) / wide - n / len(self.boards))) for n in range(len(self.boards))]
        covers = {
            "blending": [(0.5 - 0.5 * wave) ** (len(self.boards) - 1) for wave in waves],
            "apart": [np.exp(8 * wave) / sum(np.exp(8 * other) for other in waves) for wave in waves],
            "everywhere": [np.full_like(waves[0], 1 / len(waves)) for _ in waves],
        }[self.covers]
        made: list[tuple[float, NDArray[np.complex128]]] = []
        for disparity, cover in zip(self.boards, covers, strict=True):
            texture = np.fft.irfft2(np.fft.rfft2(rng.normal(size=(high, wide))) * size, s=(high, wide))
            light = (1 + self.contrast * texture / texture.std()) * cover
            made.append((disparity, np.asarray(np.fft.rfft2(light), dtype=np.complex128)))
        total = sum(float(spectrum[0, 0].real) for _, spectrum in made) / (high * wide)
        return [(disparity, spectrum * (0.35 / total)) for disparity, spectrum in made]

    def expose(self) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
        """(plane (H, W), true views (n, n, H, W), NaN where the stop's cell is closed)."""
        high, wide = (side * FINER for side in self.shape)
        fy, fx = np.fft.fftfreq(high) * FINER, np.fft.rfftfreq(wide) * FINER
        places, view = self.stop
        textures = self._textures()
        alpha = DISTANCE_MM / FOCAL_MM
        at = [(np.arange(n) / FINER - (n / FINER - 1) / 2) * PITCH_MM for n in (high, wide)]
        plane = np.zeros(self.shape)
        views = np.zeros((self.views**2, *self.shape))
        for (v, u), cell in zip(places, view, strict=True):
            moved = np.zeros((high, len(fx)), dtype=np.complex128)
            for disparity, spectrum in textures:
                turn = -2j * np.pi * disparity * self.kappa
                moved += spectrum * np.exp(turn * v * fy)[:, None] * np.exp(turn * u * fx)
            light = np.fft.irfft2(moved, s=(high, wide))[::FINER, ::FINER]
            stop_mm = FOCAL_MM / self.f_number
            axes = [
                1 + sum(np.cos(2 * np.pi * m * MASK.frequency_per_mm * place[::FINER]) for m in (1, 2))
                for place in ((1 - alpha) * at[0] + alpha * v * stop_mm, (1 - alpha) * at[1] + alpha * u * stop_mm)
            ]
            plane += light * (np.outer(*axes) - DARKEST) / (1 - DARKEST)
            views[cell] += light
        counts = np.bincount(view, minlength=self.views**2).astype(np.float64)
        with np.errstate(invalid="ignore", divide="ignore"):
            truth = views / counts[:, None, None]
        plane /= len(places)
        if self.snr is not None:
            rng = np.random.default_rng([self.seed, 72])
            plane = plane + rng.normal(size=plane.shape) * np.sqrt(np.maximum(plane, 0) * 0.35) / self.snr
        return plane.astype(np.float32), truth.reshape(self.views, self.views, *self.shape).astype(np.float32)

    def decoder(self, *, joint_views: bool) -> MaskDecoder:
        """A decoder that knows the mask."""
        amplitudes = [1.0] + [
            0.5 ** ((ky != 0) + (kx != 0)) / (1 - DARKEST) for ky, kx in MASK.half_orders() if (ky, kx) != (0, 0)
        ]
        fit = LatticeFit(
            FOCAL_MM, 59.2, self.lattice, 0.0, DISTANCE_MM, True, (0.0, 0.0), tuple(amplitudes), 0.0, 0.0, 24
        )
        sensor = Sensor(self.shape, (PITCH_MM, 0.0), (0.0, PITCH_MM))
        known = Calibration(self.shape, "geometric", MASK, sensor, (fit,))
        return MaskDecoder(MaskedOptics(sensor, MASK, "geometric", DISTANCE_MM), known, joint_views=joint_views)


def on_slices(views: NDArray[np.float32], grid: Floats, shape: tuple[int, int]) -> Floats:
    """Cyclic views (..., H, W), band-limited, at the samples (h, w) of a light field's grid."""
    steps = grid[0, 0], grid[1, 1]
    spectrum = np.fft.fft2(views.astype(np.float64))
    for axis, (side, step) in enumerate(zip(views.shape[-2:], steps, strict=True), -2):
        f = np.fft.fftfreq(side)
        keep = np.abs(f) < 0.5 / step
        n = shape[axis]
        wave = np.exp(2j * np.pi * np.outer(np.arange(n) * step, f[keep])) / side
        spectrum = np.moveaxis(np.moveaxis(spectrum, axis, -1)[..., keep] @ wave.T, -1, axis)
    return np.asarray(spectrum.real)


def psnr(found: NDArray[np.floating], truth: NDArray[np.floating], border: int = 5) -> float:
    """PSNR in dB with range 1 over what has a truth, `border` samples left out at each edge."""
    cut = (..., slice(border, -border), slice(border, -border))
    return -10 * math.log10(float(np.nanmean((found[cut] - truth[cut]) ** 2)))
