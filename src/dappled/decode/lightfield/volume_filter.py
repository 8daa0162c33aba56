"""Focus on a volume: a linear filter of the 4D spectrum that passes what lies between two disparities.

Points of one disparity lie on a plane of the spectrum, those of a range in a fan of planes; what lies elsewhere (rain,
snow and haze before the scene, a view's noise) is off it. Dansereau, Pizarro and Williams (2015) cut the fan out by its
product with the hypercone (LFToolbox: LFBuild4DFreqHyperfan). With a few views the fan's edges are as wide as itself,
so the same passband is met here as a least-squares estimate for each frequency: of the picture through the aperture's
middle, given views that are of any disparity in the range with equal probability, and noise.
"""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray
from scipy import fft

from dappled.decode.errors import DecodeError
from dappled.decode.lightfield.light_field import Image, ViewStack, needs_parallax
from dappled.workers import each

_NOISE = 0.05  # power of a view's noise over the scene's, at each frequency: how narrow the fan is cut


def within(stack: ViewStack, nearest: float, farthest: float, *, workers: int = 1) -> Image:
    """The picture through the aperture's middle of what lies between two disparities, float32 (h, w) or (h, w, 3).

    With both equal it is the refocused picture. Beyond the views' edges they are continued by reflection. Raises
    DecodeError without parallax, or where the range is not finite.
    """
    needs_parallax(stack, "a volume in focus")
    if not (math.isfinite(nearest) and math.isfinite(farthest)):
        raise DecodeError(f"a volume from {nearest:g} to {farthest:g} px/view has no end")
    middle, width = (nearest + farthest) / 2, abs(farthest - nearest)
    channels = np.moveaxis(stack.views, 4, 0) if stack.colour else stack.views[None]
    tall, wide = channels.shape[3:]
    pad = min(math.ceil(max(abs(nearest), abs(farthest)) * stack.reach) + 8, tall - 1, wide - 1)
    padded = fft.next_fast_len(tall + 2 * pad), fft.next_fast_len(wide + 2 * pad, real=True)
    margins = ((0, 0), (pad, padded[0] - tall - pad), (pad, padded[1] - wide - pad))
    fy, fx = fft.fftfreq(padded[0]), fft.rfftfreq(padded[1])
    rows, columns = (one.ravel() for one in np.meshgrid(stack.row_steps, stack.column_steps, indexing="ij"))
    weights = np.empty((len(rows), len(fy), len(fx)), dtype=np.complex64)

    def one(at: int) -> None:
        moved = fy[at] * rows + fx[:, None] * columns  # (frequencies, views), cycles for a disparity of 1
        passed = _passed(moved, width)
        weights[:, at] = (passed * np.exp(2j * np.pi * middle * moved)).T

    each(one, range(len(fy)), workers)
    made = []
    for views in channels:
        spectra = fft.rfft2(np.pad(views.reshape(-1, tall, wide), margins, mode="symmetric"), workers=workers)
        picture = fft.irfft2((spectra * weights).sum(axis=0), s=padded, workers=workers)
        made.append(picture[pad : pad + tall, pad : pad + wide].astype(np.float32))
    return np.stack(made, axis=-1) if stack.colour else made[0]


def _passed(moved: NDArray[np.float64], width: float) -> NDArray[np.float64]:
    """Weights (frequencies, views) of views that were moved to the middle of the range: the solution of the normal
    equations, with a mean gain of 1 over the range."""
    alike = np.sinc(width * (moved[:, :, None] - moved[:, None, :]))  # the mean of exp(2πi D q) over the range
    alike += _NOISE * np.eye(moved.shape[1])
    wanted = np.sinc(width * moved)
    found = np.linalg.solve(alike, wanted[..., None])[..., 0]
    return np.asarray(found / (found * wanted).sum(axis=1, keepdims=True), np.float64)
