"""Depth from all that is known: contrast, photo-consistency of clean views, and what the neighbours say.

All of it is counted as a log-likelihood, so it can be added. Refocus contrast bears noise, and fattens near things by
half a window; photo-consistency keeps edges where they are, and needs clean views. Semi-global matching decides where
both are weak. The disparity and its error are then read off the measurements alone: neighbours choose the peak, they
don't move it.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray
from scipy import ndimage

from dappled.decode.depth import consistency, semi_global
from dappled.decode.depth import contrast as depth_contrast
from dappled.decode.depth.depth_map import DepthMap, Search, Volume, box, confidence, judged, peaked, windowed
from dappled.decode.depth.evidence import Evidence
from dappled.decode.lightfield.view_stack import ViewStack

_CLEAN, _NOISY = 2.0, 200.0  # contrast's share beside photo-consistency, by noise over texture and its square
_MOST_CLEAN = 0.3  # a larger share means noisy views: contrast needs its whole window then
_SMALL, _LARGE = 4.0, 30.0  # P1 and P2, in units of the log-likelihood
_NEGLIGIBLE = 0.005  # a share that changes nothing is not worth its transforms
_OUTLIER = 30.0  # variances: a view that differs by more sees something else
_SAMPLE = 160  # px a side: as much of the middle tells how well views agree
_NARROW = 5  # px: the window of contrast beside photo-consistency
_LEAST_VARIANCE = 1e-8


def depth(evidence: Evidence, search: Search) -> DepthMap:
    """The depth map by all methods that the evidence allows: photo-consistency only of plain views."""
    disparities = search.disparities()
    seen = _by_contrast(evidence, search) if evidence.white else _by_both(evidence, search)
    likelihood, samples = seen.likelihood, seen.samples
    window = search.window if evidence.white else _NARROW
    smooth = semi_global.smoothed(-likelihood, small=_SMALL, large=_LARGE, workers=search.workers)
    start = smooth.argmin(axis=0)
    if not evidence.white:
        likelihood, _ = windowed(likelihood, window)
        samples *= box(window) ** 2
    disparity, curvature = peaked(likelihood, disparities, start)
    best = np.take_along_axis(likelihood, start[None], axis=0)[0]
    sure = confidence(likelihood, best, samples)
    return judged(disparity, curvature, sure, spread=seen.spread, window=window, method="combined")


@dataclass(frozen=True, slots=True, eq=False)
class _Seen:
    """A log-likelihood (D, h, w), of so many samples a pixel; `spread` as in `windowed`."""

    likelihood: Volume
    spread: float
    samples: float


def _by_contrast(evidence: Evidence, search: Search) -> _Seen:
    raw = depth_contrast.explained(evidence, search.disparities(), workers=search.workers)
    likelihood, spread = windowed(raw, search.window)
    return _Seen(likelihood, spread, float(box(search.window) ** 2))


def _by_both(evidence: Evidence, search: Search) -> _Seen:
    """Photo-consistency, and contrast with the share that the views' noise leaves it."""
    disparities, stack = search.disparities(), evidence.stack
    variance = _disagreement(stack, disparities, search.workers)
    # Where noise is as strong as texture, one view can't be compared with another: contrast takes over.
    noise = variance / max(_texture(stack), _LEAST_VARIANCE)
    share = min(1.0, _CLEAN * noise + _NOISY * noise**2)
    cost = consistency.differences(stack, disparities, limit=_OUTLIER * variance, workers=search.workers)
    cost *= np.float32(-1 / (4 * variance))  # a difference has twice the variance
    window = min(search.window, _NARROW) if share < _MOST_CLEAN else search.window
    if share < _NEGLIGIBLE:
        return _Seen(cost, windowed(np.ones((1, 1, 1), dtype=np.float32), window)[1], float(box(window) ** 2))
    contrast = _by_contrast(evidence, replace(search, window=window))
    # The evidence counted in variances of a guessed noise; now it is known how well views agree.
    weight = np.float32(share / contrast.samples * _guessed(evidence) / variance)
    cost += np.multiply(contrast.likelihood, weight, out=contrast.likelihood)
    return _Seen(cost, contrast.spread, contrast.samples)


def _guessed(evidence: Evidence) -> float:
    """The variance that plain views' evidence was counted in."""
    return float(1 / evidence.weights[0, 0])


def _texture(stack: ViewStack) -> float:
    """The variance of the middle view's fine detail."""
    middle = stack.middle()
    return float(np.var(middle - ndimage.gaussian_filter(middle, 3.0)))


def _disagreement(stack: ViewStack, disparities: NDArray[np.float64], workers: int) -> float:
    """The variance of a view about the scene at its best disparity: noise, interpolation, gloss; median over pixels."""
    height, width = stack.views.shape[2:]
    most = _SAMPLE + 2 * int(np.abs(disparities).max() * stack.reach)
    top, left = max(0, (height - most) // 2), max(0, (width - most) // 2)
    part = np.ascontiguousarray(stack.views[:, :, top : top + most, left : left + most])
    sample = ViewStack(part, stack.row_steps, stack.column_steps)
    least = consistency.differences(sample, disparities, limit=np.inf, workers=workers).min(axis=0)
    return max(float(np.median(least)) / (2 * max(1, consistency.compared(stack))), _LEAST_VARIANCE)
