"""Estimate depth from gradients (after Dansereau and Bruton 2004): a linear least-squares problem at every pixel.

Around a shear D₀ a view is L_j(p) = I(p − D₀·s_j) − δ·s_j·∇I(p − D₀·s_j). With e_j what the measured view has beyond
the first term, W the views' weights and g_j = s_j·∇I_j, the least squares of a window are δ = −Σ gᵀWe / Σ gᵀWg. It
holds while δ·s_j is below a pixel or two; a few shears, each to its neighbourhood, cover a range.
"""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray
from scipy import ndimage

from dappled.decode.depth.depth_map import DepthMap, Search, box, judged, windowed
from dappled.decode.depth.evidence import Evidence
from dappled.decode.lightfield import ViewStack
from dappled.decode.lightfield.light_field import Image
from dappled.decode.lightfield.refocus import shift_and_add
from dappled.workers import each

_SMOOTH_PX = 0.8  # sigma: finer detail is not linear over the shifts
_VALID = 1.0  # px that the outermost view may be from the shear
_CLEAR = 4.0  # times the information of noise alone
_BIAS = 0.03  # px/view: what linear slopes are off by, measured on masked frames and painted boards
_TINY = 1e-20
_DERIVATIVE = np.array([3, -32, 168, -672, 0, 672, -168, 32, -3]) / 840  # to the 8th order


def depth(evidence: Evidence, search: Search) -> DepthMap:
    """The depth map of least squares around the shear, of several, that leaves the smallest residual."""
    stack = evidence.stack
    smooth = ndimage.gaussian_filter(stack.views, (0, 0, _SMOOTH_PX, _SMOOTH_PX))
    stack = ViewStack(smooth, stack.row_steps, stack.column_steps)
    spacing = 2 * _VALID / max(stack.reach, 1e-9)
    count = max(1, math.ceil((search.high - search.low) / spacing))
    shears = search.low + (np.arange(count) + 0.5) * (search.high - search.low) / count
    # What all views have in common belongs to the picture: an error of it must not look like parallax.
    common = evidence.weights.sum(axis=1)
    weights = evidence.weights - np.outer(common, common) / max(float(common.sum()), _TINY)
    best = np.empty(0, dtype=np.float32)
    spread = 1.0
    for number, shear in enumerate(shears):
        made, spread = windowed(
            np.stack(_normal_equations(stack, weights, float(shear), search.workers)), search.window
        )
        moment, information, residual = made
        delta = -moment / np.maximum(information, np.float32(_TINY))
        far = np.abs(delta) * stack.reach > 1.5 * _VALID
        residual += np.where(far, 0, delta * moment)
        found = np.stack([np.float32(shear) + delta, information, residual, far.astype(np.float32)])
        best = found if number == 0 else np.where(residual < best[2], found, best)
    disparity, information, far = best[0], best[1], best[3]
    # Noise has gradients too: the information that they alone would seem to carry.
    by_chance = _information_of_noise(evidence, stack) * float(box(search.window)) ** 2
    sure = 1 - np.exp(-((information / np.float32(_CLEAR * max(by_chance, _TINY))) ** 2))
    inside = (far == 0) & (np.abs(disparity - shears.mean()) <= (search.high - search.low) / 2 + spacing / 2)
    return judged(
        disparity,
        np.where(inside, information, 0),
        np.where(inside, sure, 0),
        spread=spread,
        window=search.window,
        method="gradient",
        bias=_BIAS,
    )


def _information_of_noise(evidence: Evidence, stack: ViewStack) -> float:
    """What gᵀWg of a pixel is expected to be where the scene has no texture, only the measurements' noise."""
    sy = np.repeat(stack.row_steps, len(stack.column_steps))
    sx = np.tile(stack.column_steps, len(stack.row_steps))
    steps = float(sy @ evidence.weights @ sy + sx @ evidence.weights @ sx)
    picture_variance = 1 / max(float(evidence.weights.sum()), _TINY)
    return steps * picture_variance / (8 * math.pi * _SMOOTH_PX**4)  # slopes of smoothed white noise


def _normal_equations(
    stack: ViewStack, weights: NDArray[np.float64], shear: float, workers: int
) -> tuple[Image, Image, Image]:
    """(gᵀWe, gᵀWg, eᵀWe) at every pixel, float32 (h, w)."""
    picture = shift_and_add(stack, shear, workers=workers)
    slopes = [ndimage.correlate1d(picture, _DERIVATIVE, axis=a, mode="nearest") for a in (0, 1)]
    count_v, count_u, height, width = stack.views.shape
    error = np.empty((count_v * count_u, height, width), dtype=np.float32)
    slope = np.empty_like(error)

    def one(j: int) -> None:
        sy, sx = stack.row_steps[j // count_u], stack.column_steps[j % count_u]
        by = (shear * sy, shear * sx)
        error[j] = stack.views[j // count_u, j % count_u] - _moved(picture, by)
        slope[j] = _moved(np.float32(sy) * slopes[0] + np.float32(sx) * slopes[1], by)

    each(one, range(len(error)), workers)
    sized, weighed = (np.tensordot(weights.astype(np.float32), e, axes=1) for e in (slope, error))
    return _dot(sized, error), _dot(sized, slope), _dot(weighed, error)


def _dot(a: Image, b: Image) -> Image:
    """Σ_j a_j·b_j at every pixel."""
    made: Image = np.einsum("jyx,jyx->yx", a, b)
    return made


def _moved(image: Image, by: tuple[float, float]) -> Image:
    """The image moved by (rows, columns): content at p moves to p + by."""
    if by == (0.0, 0.0):
        return image
    made: Image = ndimage.shift(image, by, order=1, mode="nearest", prefilter=False)
    return made
