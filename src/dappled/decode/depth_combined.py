"""Depth from all that is known: contrast, photo-consistency of clean views, and what the neighbours say.

All of it is counted as a log-likelihood, so it can be added. Refocus contrast bears noise, and fattens near things by
half a window; photo-consistency keeps edges where they are, and needs clean views. Semi-global matching decides where
both are weak. The disparity and its error are then read off the measurements alone: neighbours choose the peak, they
don't move it.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray
from scipy import ndimage

from dappled.decode import depth_consistency, depth_contrast, semiglobal
from dappled.decode.depthmap import DepthMap, Search, box, confidence, judged, peaked, windowed
from dappled.decode.evidence import Evidence
from dappled.decode.viewstack import ViewStack

_CLEAN, _NOISY = 2.0, 200.0  # contrast's share beside photo-consistency, by noise over texture and its square
_MOST_CLEAN = 0.3  # a larger share means noisy views: contrast needs its whole window then
_SMALL, _LARGE = 4.0, 30.0  # P1 and P2, in units of the log-likelihood
_OUTLIER = 30.0  # variances: a view that differs by more sees something else
_SAMPLE = 160  # px a side: as much of the middle tells how well views agree
_NARROW = 5  # px: the window of contrast beside photo-consistency
_LEAST_VARIANCE = 1e-8


def depth(evidence: Evidence, search: Search) -> DepthMap:
    """The depth map by all methods that the evidence allows: photo-consistency only of plain views."""
    disparities = search.disparities()
    raw = depth_contrast.explained(evidence, disparities, workers=search.workers)
    if evidence.white:
        likelihood, spread = windowed(raw, search.window)
        samples = float(box(search.window) ** 2)
    else:
        variance = _disagreement(evidence.stack, disparities, search.workers)
        # Where noise is as strong as texture, one view can't be compared with another: contrast takes over.
        noise = variance / max(_texture(evidence.stack), _LEAST_VARIANCE)
        share = min(1.0, _CLEAN * noise + _NOISY * noise**2)
        window = min(search.window, _NARROW) if share < _MOST_CLEAN else search.window
        likelihood, spread = windowed(raw, window)
        samples = float(box(window) ** 2)
        # The evidence counted in variances of a guessed noise; now it is known how well views agree.
        likelihood *= np.float32(share / samples * _guessed(evidence) / variance)
        cost = depth_consistency.differences(
            evidence.stack, disparities, limit=_OUTLIER * variance, workers=search.workers
        )
        cost *= np.float32(-1 / (4 * variance))  # a difference has twice the variance
        likelihood += cost
    smooth = semiglobal.smoothed(-likelihood, small=_SMALL, large=_LARGE, workers=search.workers)
    start = smooth.argmin(axis=0)
    if not evidence.white:
        likelihood, _ = windowed(likelihood, _NARROW)
        samples *= box(_NARROW) ** 2
    disparity, curvature = peaked(likelihood, disparities, start)
    best = np.take_along_axis(likelihood, start[None], axis=0)[0]
    sure = confidence(likelihood, best, samples)
    return judged(disparity, curvature, sure, spread=spread, method="combined")


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
    least = depth_consistency.differences(sample, disparities, limit=np.inf, workers=workers).min(axis=0)
    return max(float(np.median(least)) / (2 * max(1, depth_consistency.compared(stack))), _LEAST_VARIANCE)
