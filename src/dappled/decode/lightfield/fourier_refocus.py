"""Refocusing in the spectrum (Ng 2005): a refocused picture is a slice through the light field's 4D spectrum.

The 4D transform is made once; then each picture costs one resampled slice and one inverse 2D FFT. The picture at
disparity D is at frequency f the angular spectrum at ν = −D·step·f. It is resampled with a Kaiser–Bessel kernel on a
grid twice as fine as the views ask for, and what the kernel does to the views is divided out beforehand.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy import fft, special

from dappled.decode.errors import DecodeError
from dappled.decode.lightfield.light_field import Image, ViewStack, centred, needs_parallax

_OVERSAMPLED = 2  # as `_BETA` supposes
_TAPS = 4  # of the gridding kernel: true views refocused reach 74.2 to 75.0 dB (as `refocus._TAPS`)
_BETA = 2.34 * _TAPS  # Fessler and Sutton 2003, for twice oversampled grids
_LARGEST = 3_000_000_000  # bytes of the 4D spectrum


@dataclass(frozen=True, slots=True, eq=False)
class Spectrum4D:
    """The spectrum complex64 (A, B, H, W//2+1) of padded grey views: angular frequencies a/A, b/B from view to view,
    views counted from the aperture's middle. `spacing` (rows, columns) is the step from view to view."""

    values: NDArray[np.complex64]
    shape: tuple[int, int]
    pad: int
    padded: tuple[int, int]
    views: tuple[int, int]
    spacing: tuple[float, float]

    @classmethod
    def of(cls, stack: ViewStack, *, most_disparity: float, workers: int = 1) -> Spectrum4D:
        """The spectrum of a stack for disparities up to ±`most_disparity`: so far are the views' edges continued.

        Raises DecodeError where the views' places are uneven, or the spectrum would not fit into memory.
        """
        needs_parallax(stack, "refocusing")
        views = stack.grey().views
        count_v, count_u, height, width = views.shape
        spacing = _even(stack.row_steps), _even(stack.column_steps)
        pad = min(math.ceil(abs(most_disparity) * stack.reach) + 4, height - 1, width - 1)
        padded = fft.next_fast_len(height + 2 * pad), fft.next_fast_len(width + 2 * pad, real=True)
        angular = count_v * _OVERSAMPLED + _TAPS, count_u * _OVERSAMPLED + _TAPS
        size = 8 * angular[0] * angular[1] * padded[0] * (padded[1] // 2 + 1)
        if size > _LARGEST:
            raise DecodeError(f"the 4D spectrum would take {size / 1e9:.1f} GB: refocus by shift and add instead")
        margins = ((0, 0), (0, 0), (pad, padded[0] - height - pad), (pad, padded[1] - width - pad))
        spectra = fft.rfft2(np.pad(views, margins, mode="symmetric"), workers=workers, overwrite_x=True)
        made = np.zeros((*angular, *spectra.shape[2:]), dtype=np.complex64)
        made[:count_v, :count_u] = spectra
        for axis, count in enumerate((count_v, count_u)):
            weights = 1 / _kernel_transform(centred(count) / angular[axis])
            along = [1, 1, 1, 1]
            along[axis] = count
            made[:count_v, :count_u] *= weights.reshape(along).astype(np.float32)
        made = fft.fftn(made, axes=(0, 1), workers=workers, overwrite_x=True)
        for axis, count in enumerate((count_v, count_u)):
            along = [1, 1, 1, 1]
            along[axis] = angular[axis]
            turn = np.exp(2j * np.pi * np.arange(angular[axis]) / angular[axis] * (count - 1) / 2)
            made *= turn.reshape(along).astype(np.complex64)
        return cls(made, (height, width), pad, padded, (count_v, count_u), spacing)

    def refocused(self, disparity: float, *, workers: int = 1) -> Image:
        """The picture focused on a disparity, float32 (h, w): the mean of the views. Beyond the views' edges they are
        continued by reflection."""
        fy, fx = fft.fftfreq(self.padded[0]), fft.rfftfreq(self.padded[1])
        rows = _taps(-disparity * self.spacing[0] * fy, self.values.shape[0], self.views[0])
        columns = _taps(-disparity * self.spacing[1] * fx, self.values.shape[1], self.views[1])
        i, j = np.arange(len(fy))[:, None], np.arange(len(fx))[None, :]
        total = np.zeros((len(fy), len(fx)), dtype=np.complex64)
        for at_v, weight_v in zip(*rows, strict=True):
            for at_u, weight_u in zip(*columns, strict=True):
                total += self.values[at_v[:, None], at_u[None, :], i, j] * (weight_v[:, None] * weight_u[None, :])
        picture = fft.irfft2(total, s=self.padded, workers=workers)
        height, width = self.shape
        cut = picture[self.pad : self.pad + height, self.pad : self.pad + width]
        made: Image = (cut / np.float32(self.views[0] * self.views[1])).astype(np.float32)
        return made


@dataclass(frozen=True, slots=True)
class ViewDifference:
    """How far two pictures are apart, the edges left out: PSNR in dB over the first one's range, and the largest."""

    psnr_db: float
    largest: float


def difference(one: Image, other: Image, border: int) -> ViewDifference:
    """The difference of two pictures (h, w) or (h, w, 3), `border` px left out; PSNR inf where there is none."""
    cut = (slice(border, -border or None),) * 2
    gap = (one - other)[cut].astype(np.float64)
    if gap.size == 0:
        raise DecodeError(f"a border of {border} px leaves nothing of pictures of {one.shape} px")
    span = float(np.ptp(one[cut]))
    rms = math.sqrt(float(np.mean(gap**2)))
    return ViewDifference(math.inf if rms == 0 else 20 * math.log10(max(span, 1e-12) / rms), float(np.abs(gap).max()))


def _taps(frequencies: NDArray[np.float64], size: int, count: int) -> tuple[NDArray[np.intp], NDArray[np.float32]]:
    """(taps, n) indices into the angular grid and weights. A half-integer middle turns the sign at the grid's end."""
    at = frequencies * size
    first = np.floor(at).astype(np.intp) - _TAPS // 2 + 1
    indices = first[None, :] + np.arange(_TAPS)[:, None]
    weights = _kernel(at[None, :] - indices)
    turns = indices // size
    if count % 2 == 0:
        weights = np.where(turns % 2 == 0, weights, -weights)
    return indices - turns * size, weights.astype(np.float32)


def _kernel(x: NDArray[np.float64]) -> NDArray[np.float64]:
    """Kaiser–Bessel, _TAPS wide."""
    inside = np.clip(1 - (2 * x / _TAPS) ** 2, 0, None)
    made: NDArray[np.float64] = np.where(np.abs(x) <= _TAPS / 2, special.i0(_BETA * np.sqrt(inside)), 0) / _TAPS
    return made


def _kernel_transform(t: NDArray[np.float64]) -> NDArray[np.float64]:
    """∫ kernel(x)·e^{2πi x t} dx."""
    root = np.sqrt((_BETA**2 - (np.pi * _TAPS * t) ** 2).astype(np.complex128))
    made: NDArray[np.float64] = (np.sinh(root) / root).real
    return made


def _even(steps: NDArray[np.float64]) -> float:
    """The step from view to view. Raises DecodeError where it changes."""
    if len(steps) < 2:
        return 0.0
    gaps = np.diff(steps)
    if np.ptp(gaps) > 1e-6 * max(float(np.abs(gaps).max()), 1e-9):
        raise DecodeError("the views are not evenly spaced: refocus by shift and add instead")
    return float(gaps.mean())
