"""Depth of clean views: photo-consistency, neighbours, and what gloss adds to the views taken from them.

A view differs from the middle one by noise, and by what interpolation gets wrong where the picture is finely textured.
Differences are counted in the variance that both together have at a pixel. A highlight stands still while its surface
moves; where views differ by more than that variance at every disparity, they are also compared without what is coarse
in them, and the better of both counts.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray
from scipy import ndimage

from dappled.decode.depth.depth_map import DepthMap, Map, Search, Volume, confidence, judged, peaked
from dappled.decode.depth.edges import sharpened
from dappled.decode.depth.matching import smoothed
from dappled.decode.depth.photo_consistency import STRIP, WINDOW, Lines, compared, differences, strips
from dappled.decode.depth.scatter import scattered
from dappled.decode.lightfield import ViewStack

# All measured on 9 × 9 views of benchmarks/depth.py, seeds 1 and 2.
_OUTLIER = 20.0  # variances: a view that differs by more sees something else
_SMALL, _LARGE = 3.6, 11.0  # P1 and P2, in units of the log-likelihood
_SPREAD = 0.055  # variance over information
_DRAWN, _ASTRAY = 0.25, 0.5  # of a step: how far selected peaks are off; a peak of another surface
_PULL = 0.3  # of how far neighbours moved the peak
# px: what is too faint for a window to tell, so many together may. Of three scenes by another renderer 1 to 19 % fewer
# pixels are wrong or unknown; with 7 px more are, and of bare boards 6 to 33 % are known, not 5 to 17.
_TOGETHER = 5
# The variance is so much of what the peak tells, and of that by which neighbours scatter about a plane, a jump counting
# as so much of a step, over so many px. On seeds 1 to 6 each scene has 65 to 76 % within σ, 93 to 97 % within 2 σ.
_TOLD, _SCATTER, _MOST_SCATTER, _SCATTER_REACH = 0.3, 1.05, 0.5, 1.5
_SAMPLE = 12_000  # px, in strips over the whole height: as many tell how well views agree
_CLASSES, _DETAIL_PX = 8, 1.5  # of pixels, by how finely they are textured; how far around a pixel that is looked at
_LEAST_SHARE = 0.1  # of the typical variance, where there is no texture
_UNLIKE, _UNLIKE_PX = 6.0, 2.0  # what the best disparity of even pixels leaves, as a mean over so many px: gloss
_SHADE = 1.5  # px: the Gaussian without which no highlight is left
_GROUP_PX, _LEAST_GROUP = 9, 64  # glossy pixels within so many px belong together; fewer are left as they are
LEAST_VARIANCE = 1e-8  # of a view with values around 1: below it float32 decides


@dataclass(frozen=True, slots=True, eq=False)
class Agreement:
    """The variance of a view about the scene at its best disparity: `typical`, and at each pixel (h, w)."""

    typical: float
    local: Map


def agreement(stack: ViewStack, lines: Lines, disparities: NDArray[np.float64], *, workers: int = 1) -> Agreement:
    """Noise, interpolation, gloss: the median over pixels, and a line in how strongly the middle view bends."""
    height, width = lines.middle.shape
    every = max(1, math.ceil(height / STRIP) // max(2, math.ceil(_SAMPLE / (STRIP * width))))
    least = differences(lines, disparities, limit=np.inf, every=every, workers=workers).min(axis=0)
    least *= np.float32(1 / (2 * max(1, compared(stack))))
    typical = max(float(np.median(least)), LEAST_VARIANCE)
    bend = bends(lines.middle)
    at = np.concatenate([bend[top : top + STRIP] for top in strips(height, every)])
    classes = np.array_split(np.argsort(at, axis=None), min(_CLASSES, at.size))
    x, y = (np.array([np.median(a.ravel()[part]) for part in classes]) for a in (at, least))
    slope = max(0.0, float(np.polyfit(x, y, 1, w=1 / np.maximum(y, LEAST_VARIANCE))[0])) if np.ptp(x) > 0 else 0.0
    base = max(float(np.median(y - slope * x)), _LEAST_SHARE * typical)
    return Agreement(typical, (base + slope * bend).astype(np.float32))


def bends(middle: Map) -> Map:
    """(h, w): the mean square of second differences near a pixel, by which interpolation errs."""
    down, across = (ndimage.correlate1d(middle, [1, -2, 1], axis=axis, mode="nearest") for axis in (0, 1))
    made: Map = ndimage.gaussian_filter(down**2 + across**2, _DETAIL_PX)
    return made


def unlikely(
    lines: Lines, search: Search, variance: Map | float, within: tuple[slice, slice] = (slice(None), slice(None))
) -> Volume:
    """float32 (D, h, w): minus the log-likelihood of each disparity, views having this variance about the scene."""
    local = np.broadcast_to(np.asarray(variance, dtype=np.float32), lines.middle.shape)
    cost = differences(
        lines,
        search.disparities(),
        limit=np.float32(_OUTLIER) * local,
        window=search.window or WINDOW,
        within=within,
        workers=search.workers,
    )
    cost *= np.float32(0.25) / local[within]  # a difference has twice the variance
    return cost


def shades_apart(cost: Volume, stack: ViewStack, search: Search, variance: Map) -> None:
    """Lower the costs (D, h, w) where views differ at every disparity, to those of views without what is coarse."""
    unlike = ndimage.gaussian_filter(cost.min(axis=0), _UNLIKE_PX) > _UNLIKE
    groups, _ = ndimage.label(ndimage.maximum_filter(unlike, _GROUP_PX))
    groups[~unlike] = 0
    parts = [(k + 1, part) for k, part in enumerate(ndimage.find_objects(groups)) if part is not None]
    parts = [(k, part) for k, part in parts if np.count_nonzero(groups[part] == k) >= _LEAST_GROUP]
    if not parts:
        return
    lines = Lines.of(stack, search.disparities(), window=search.window or WINDOW, shade=_SHADE)
    for k, part in parts:
        chosen = (slice(None), *part)
        made = unlikely(lines, search, variance, part)
        np.minimum(cost[chosen], made, out=cost[chosen], where=groups[part] == k)


def depth(stack: ViewStack, lines: Lines, search: Search, told: Agreement) -> DepthMap:
    """The peak that neighbours select, and jumps of disparity at the picture's edges."""
    disparities, window = search.disparities(), search.window or WINDOW
    cost = unlikely(lines, search, told.local)
    shades_apart(cost, stack, search, told.local)
    smooth = smoothed(cost, small=_SMALL, large=_LARGE, workers=search.workers)
    start = smooth.argmin(axis=0)
    np.negative(smooth, out=smooth)
    np.negative(cost, out=cost)
    selected, _ = peaked(smooth, disparities, start)
    own, curvature = peaked(cost, disparities, start)
    best = np.take_along_axis(cost, start[None], axis=0)[0]
    samples = compared(stack) / window**2
    sure = confidence(cost, best, samples)
    side = max(window, _TOGETHER)
    wide = ndimage.uniform_filter(cost, (0, side, side), output=cost)
    best_wide = np.take_along_axis(wide, start[None], axis=0)[0]
    sure = np.maximum(sure, confidence(wide, best_wide, samples * (window / side) ** 2))
    # Where even the best disparity leaves more than noise (gloss, edges), its error is as much larger.
    curvature /= np.maximum(best / (-0.5 * compared(stack)), 1)
    # The selected peak is drawn towards the disparities that were tried, a pixel's own one has more noise.
    drawn = (_DRAWN * search.step) ** 2
    astray = own - selected
    mixed = drawn * curvature / (drawn * curvature + np.float32(_SPREAD))
    disparity = selected + np.where(np.abs(astray) < _ASTRAY * search.step, mixed, 0) * astray
    found = judged(disparity.astype(np.float32), curvature, sure, spread=_SPREAD, window=window, method="combined")
    sigma = np.hypot(found.sigma, _PULL * np.abs(astray))
    sharp, error = sharpened(found.disparity, sigma.astype(np.float32), stack.middle())
    rough = scattered(sharp, apart=window, most=_MOST_SCATTER * search.step, reach=_SCATTER_REACH)
    error = np.sqrt(_TOLD * error**2 + _SCATTER * np.where(np.isfinite(rough), rough**2, error**2))
    return replace(found, disparity=sharp, sigma=error)
