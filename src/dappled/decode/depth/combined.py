"""Estimate depth from contrast, photo-consistency of clean views, slices, and neighbouring pixels together.

Each is a log-likelihood, so they can be added. Refocus contrast tolerates noise, and enlarges near objects by half a
window. Photo-consistency keeps edges where they are, and needs clean views. Of noisy masked frames the slices are asked
instead, in halves of the aperture (see `halves`). Semi-global matching decides where all are weak. The middle view's
edges then decide to which side the pixels at a jump of disparity belong.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray
from scipy import ndimage

from dappled.decode.depth import contrast as depth_contrast
from dappled.decode.depth.depth_map import DepthMap, Map, Search, Volume, box, confidence, judged, peaked, windowed
from dappled.decode.depth.edges import levelled, sharpened
from dappled.decode.depth.evidence import Evidence
from dappled.decode.depth.halves import Part, best_half, unexplained, voted, whole
from dappled.decode.depth.photo_consistency import STRIP, WINDOW, compared, differences
from dappled.decode.lightfield import ViewStack
from dappled.workers import each

_CLEAN, _NOISY = 2.0, 200.0  # contrast's share beside photo-consistency, by noise over texture and its square
_NEGLIGIBLE = 0.3  # with a smaller share contrast only enlarges what is near
_SMALL, _LARGE = 4.0, 30.0  # P1 and P2, in units of the log-likelihood
_SMALL_CLEAN, _LARGE_CLEAN = 2.0, 8.0  # the same where views are clean: it has fewer samples
_OUTLIER = 20.0  # variances: a view that differs by more sees something else
_SAMPLE = 12_000  # px, in strips over the whole height: as many tell how well views agree
_NARROW = 5  # px: the window in which noisy views are compared
_LEAST_VARIANCE = 1e-8
_SPREAD_CLEAN = 0.055  # variance over information, measured on the seeds of benchmarks/depth.py
# Of noisy masked frames, measured on the masked frames of benchmarks/depth.py, seeds 1 and 2.
_VOTE_WINDOW = 11  # px
_SMALL_HALVES, _LARGE_HALVES = 8.0, 32.0
_SPREAD_HALVES, _SAMPLES_HALVES = 2.0, 40.0  # variance over information; of the votes, as in `confidence`
_AGREE = 0.1  # px/view: a peak of the whole aperture's likelihood so near is that of the same surface
_SCATTER_WHOLE = 1.15  # the variance of the whole aperture's peak, beyond what `judged` supposes
_ONE_SURFACE = 0.4  # px/view: with a larger range of disparities around there is a jump
_HALO = 6  # px: by so much near things are too large before the middle view's edges decide
_ASTRAY, _DRAWN = 0.5, 0.25  # of a step: a peak of another surface; how far selected peaks are off
_PULL = 0.3  # of how far neighbours moved the peak


def depth(evidence: Evidence, search: Search) -> DepthMap:
    """The depth map by the methods that suit the evidence."""
    if evidence.white:
        return _of_slices(evidence, search)
    disparities, stack = search.disparities(), evidence.stack
    variance = _disagreement(stack, disparities, search.workers)
    # Where noise is as strong as texture, one view can't be compared with another: contrast takes over.
    noise = variance / max(_texture(stack), _LEAST_VARIANCE)
    share = min(1.0, _CLEAN * noise + _NOISY * noise**2)
    window = search.window or WINDOW
    cost = differences(stack, disparities, limit=_OUTLIER * variance, window=window, workers=search.workers)
    cost *= np.float32(1 / (4 * variance))  # a difference has twice the variance
    if share < _NEGLIGIBLE:
        return _of_clean(cost, stack, search, window)
    contrast = _by_contrast(evidence, search)
    # The evidence counted in variances of a guessed noise; now it is known how well views agree.
    weight = np.float32(share / contrast.samples * _guessed(evidence) / variance)
    both = np.subtract(np.multiply(contrast.likelihood, weight, out=contrast.likelihood), cost, out=cost)
    samples = contrast.samples * box(_NARROW) ** 2
    return _decided(_Seen(both, contrast.spread, samples), search, _NARROW, widen=True)


def _of_clean(cost: Volume, stack: ViewStack, search: Search, window: int) -> DepthMap:
    """By photo-consistency alone: the peak that neighbours select, and jumps of disparity at the picture's edges."""
    disparities = search.disparities()
    smooth = smoothed(cost, small=_SMALL_CLEAN, large=_LARGE_CLEAN, workers=search.workers)
    start = smooth.argmin(axis=0)
    np.negative(smooth, out=smooth)
    np.negative(cost, out=cost)
    selected, _ = peaked(smooth, disparities, start)
    own, curvature = peaked(cost, disparities, start)
    best = np.take_along_axis(cost, start[None], axis=0)[0]
    sure = confidence(cost, best, compared(stack) / window**2)
    # Where even the best disparity leaves more than noise (gloss, edges), its error is as much larger.
    curvature /= np.maximum(best / (-0.5 * compared(stack)), 1)
    # The selected peak is drawn towards the disparities that were tried, a pixel's own one has more noise.
    drawn = (_DRAWN * search.step) ** 2
    astray = own - selected
    mixed = drawn * curvature / (drawn * curvature + np.float32(_SPREAD_CLEAN))
    disparity = selected + np.where(np.abs(astray) < _ASTRAY * search.step, mixed, 0) * astray
    found = judged(
        disparity.astype(np.float32), curvature, sure, spread=_SPREAD_CLEAN, window=window, method="combined"
    )
    sigma = np.hypot(found.sigma, _PULL * np.abs(astray))
    sharp, error = sharpened(found.disparity, sigma.astype(np.float32), stack.middle())
    return replace(found, disparity=sharp, sigma=error)


def _of_slices(evidence: Evidence, search: Search) -> DepthMap:
    """By what disparities leave unexplained of halves of the aperture, and on even surfaces of all of it."""
    part = whole(evidence)
    rough = _by_votes(part, evidence.shown(), search)
    disparities, window = search.disparities(), search.contrast_window
    likelihood = unexplained(part, disparities, workers=search.workers)
    likelihood, spread = windowed(np.negative(likelihood, out=likelihood), window)
    known = rough.known
    start = np.rint((np.where(known, rough.disparity, disparities[0]) - disparities[0]) / search.step).astype(np.intp)
    fine, curvature = peaked(likelihood, disparities, np.clip(start, 0, len(disparities) - 1))
    # What a jump spreads over reaches farther than the window.
    reach = 2 * window - 1
    far = np.where(known, rough.disparity, np.inf), np.where(known, rough.disparity, -np.inf)
    even = ndimage.maximum_filter(far[0], reach) - ndimage.minimum_filter(far[1], reach) < _ONE_SURFACE
    agree = even & (np.abs(fine - rough.disparity) < _AGREE)
    found = judged(
        np.where(agree, fine, rough.disparity),
        curvature,
        rough.confidence,
        spread=_SCATTER_WHOLE * spread,
        window=window,
        method="combined",
    )
    share = np.where(agree & found.known, rough.sigma**4 / (rough.sigma**4 + found.sigma**4), np.float32(0))
    both = share > 0
    disparity = np.where(both, rough.disparity + share * (fine - rough.disparity), rough.disparity)
    sigma = np.where(both, np.sqrt(share * found.sigma**2 + (1 - share) * rough.sigma**2), rough.sigma)
    return replace(rough, disparity=disparity, sigma=sigma)


def _by_votes(part: Part, middle: Map, search: Search) -> DepthMap:
    """The disparities that neighbours select among the votes around a pixel; jumps at the edges of the middle view."""
    disparities = search.disparities()
    window = search.window or _VOTE_WINDOW
    cost = voted(best_half(part, disparities, workers=search.workers), window)
    smooth = smoothed(cost, small=_SMALL_HALVES, large=_LARGE_HALVES, workers=search.workers)
    start = smooth.argmin(axis=0)
    disparity, curvature = peaked(np.negative(smooth, out=smooth), disparities, start)
    likelihood = np.negative(cost, out=cost)
    _, own = peaked(likelihood, disparities, start)
    curvature = np.where(own > 0, own, curvature)  # where neighbours overrule a pixel it has no peak there
    sure = confidence(likelihood, np.take_along_axis(likelihood, start[None], axis=0)[0], _SAMPLES_HALVES)
    found = judged(disparity, curvature, sure, spread=_SPREAD_HALVES, window=window, method="combined")
    sharp, sigma = sharpened(found.disparity, found.sigma, middle, near=_HALO - 1, reach=_HALO)
    return replace(found, disparity=levelled(sharp), sigma=sigma)


@dataclass(frozen=True, slots=True, eq=False)
class _Seen:
    """A log-likelihood (D, h, w), of the given number of samples per pixel; `spread` as in `windowed`."""

    likelihood: Volume
    spread: float
    samples: float


def _decided(seen: _Seen, search: Search, window: int, *, widen: bool = False) -> DepthMap:
    """The map of the peaks that neighbours select. `widen`: each peak is that of a window."""
    disparities = search.disparities()
    smooth = smoothed(-seen.likelihood, small=_SMALL, large=_LARGE, workers=search.workers)
    start = smooth.argmin(axis=0)
    likelihood = windowed(seen.likelihood, window)[0] if widen else seen.likelihood
    disparity, curvature = peaked(likelihood, disparities, start)
    best = np.take_along_axis(likelihood, start[None], axis=0)[0]
    sure = confidence(likelihood, best, seen.samples)
    return judged(disparity, curvature, sure, spread=seen.spread, window=window, method="combined")


def _by_contrast(evidence: Evidence, search: Search) -> _Seen:
    raw = depth_contrast.explained(evidence, search.disparities(), workers=search.workers)
    likelihood, spread = windowed(raw, search.contrast_window)
    return _Seen(likelihood, spread, float(box(search.contrast_window) ** 2))


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
    strips = max(2, math.ceil(_SAMPLE / (STRIP * width)))
    every = max(1, math.ceil(height / STRIP) // strips)
    least = differences(stack, disparities, limit=np.inf, every=every, workers=workers).min(axis=0)
    return max(float(np.median(least)) / (2 * max(1, compared(stack))), _LEAST_VARIANCE)


def smoothed(cost: Volume, *, small: float, large: float, workers: int = 1) -> Volume:
    """Semi-global matching (Hirschmüller 2008): float32 (D, h, w), the mean over four directions.

    Along each direction the best path's cost is L(p, d) = C(p, d) + min(L(q, d), L(q, d±1) + P1, min L(q) + P2)
    − min L(q), q being the pixel before p. `small` and `large` are P1 and P2 in the cost's unit.
    """
    total = np.empty_like(cost)
    for axis in (0, 1):
        lines = np.ascontiguousarray(np.moveaxis(cost, axis + 1, 0))  # (n, D, m)
        paths = [np.empty_like(lines), np.empty_like(lines)]

        def one(way: int, lines: Volume = lines, paths: list[Volume] = paths) -> None:
            _along(lines[::-1] if way else lines, paths[way][::-1] if way else paths[way], small, large)

        each(one, (0, 1), workers)
        paths[0] += paths[1]
        if axis == 0:
            total[...] = np.moveaxis(paths[0], 0, 1)
        else:
            total += np.moveaxis(paths[0], 0, 2)
    total *= np.float32(0.25)
    return total


def _along(lines: Volume, out: Volume, small: float, large: float) -> None:
    """The paths' costs (n, D, m) from the first line to the last."""
    out[0] = lines[0]
    for i in range(1, len(lines)):
        previous, best = out[i - 1], out[i]
        least = previous.min(axis=0)
        np.minimum(previous, least + np.float32(large), out=best)
        if len(best) > 1:
            np.minimum(best[1:], previous[:-1] + np.float32(small), out=best[1:])
            np.minimum(best[:-1], previous[1:] + np.float32(small), out=best[:-1])
        best -= least
        best += lines[i]
