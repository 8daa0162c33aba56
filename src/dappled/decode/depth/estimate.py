"""Estimate depth from views by one of several methods, each pixel with its uncertainty, or unknown.

`combined` combines photo-consistency, contrast, slices and neighbouring pixels; `contrast` asks which refocused picture
explains the measurements best (bears noise); `stereo` matches pairs of views with OpenCV (clean views, to compare).
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from dataclasses import replace

import numpy as np
from scipy import ndimage

from dappled.decode.array_types import Floats, Singles
from dappled.decode.depth import combined, contrast, halves, stereo
from dappled.decode.depth.depth_map import DepthMap, Map, Search, peaked, windowed
from dappled.decode.depth.evidence import Evidence, of_made, thinned
from dappled.decode.depth.photo_consistency import Lines, differences
from dappled.decode.errors import DecodeError
from dappled.decode.lightfield import ViewStack

# Chosen by hand where no figure stands beside a number; benchmarks/depth.py measures what all of them together make.

METHODS: Mapping[str, Callable[[Evidence, Search], DepthMap]] = {
    "combined": combined.depth,
    "contrast": contrast.depth,
    "stereo": stereo.depth,
}
_FINEST, _FINEST_OF_VIEWS = 0.15, 0.15  # px: a step moves the outermost view by so much, of slices and of plain views
_MOST_LEVELS = 64  # no more disparities than these
# Of plain views: steps up to the second one (px of the outermost view) where there would be more disparities than the
# first. 64 in place of 48 find no more pixels of benchmarks/depth.py, seeds 1 and 2, to 0.07 px/view.
_MANY_LEVELS, _COARSEST_OF_VIEWS = 48, 0.3
_COARSE_SIDE = 160  # px: pictures are made smaller than this to look for the range
_WIDEST = 4.0  # px/view
# px/view beyond the range that was found, with half a step, of slices a whole one.
_MARGIN, _MARGIN_OF_CLEAN, _MARGIN_OF_SLICES = 0.1, 0.15, 0.2
# Of the mean over disparities: what the best one may leave of clean views. With noise of 0.04 of white the range then
# leaves out at most 0.2 % of a scene (benchmarks/depth.py, seeds 1 and 2), where contrast, asked from 0.15 on, left out
# 8 % of a fence at 512 px. With noise of 0.08 more is left.
_CLEAR = 0.3
_SURE = 0.6  # the share of pixels, those with most texture, that the range is read off


def estimate(
    evidence: Evidence, method: str = "combined", *, between: tuple[float, float] | None = None,
    window: int | None = None, workers: int = 1,
) -> DepthMap:  # fmt: skip
    """The depth map by one of `METHODS`, at disparities `between` two (None: where a coarse search finds the scene).

    Raises DecodeError for an unknown method or an empty range.
    """
    known_method(method)
    if method == "combined" and evidence.made is not None:  # without noise views tell more than slices
        evidence = of_made(evidence.made)
    points = replace(evidence, filled=None)
    low, high = between or disparity_range(points, workers=workers)
    searched = search(points, low, high, window=window, workers=workers)
    if method == "combined" and evidence.filled is not None:
        points = replace(points, filled=_filled(evidence, searched))
    return METHODS[method](points, searched)


def _filled(evidence: Evidence, searched: Search) -> Floats | None:
    """The evidence's `filled`, if that explains pictures made smaller better than points of the aperture do."""
    coarse, factor = _coarse(evidence)
    looked = replace(searched, step=max(searched.step, _looked(coarse.stack, factor, 9, searched.workers).step))
    return halves.likelier(coarse, looked.disparities(), workers=searched.workers).filled


def known_method(name: str) -> str:
    """The name of a method of `METHODS`. Raises DecodeError for another one, and for one that was removed."""
    if name == "gradient":
        raise DecodeError("the depth method gradient was removed: choose combined, which is faster and more exact")
    if name not in METHODS:
        raise DecodeError(f"unknown depth method {name!r}; known are {', '.join(METHODS)}")
    return name


def search(evidence: Evidence, low: float, high: float, *, window: int | None = None, workers: int = 1) -> Search:
    """Disparities fine enough for the outermost views, unless they become too many."""
    reach = max(evidence.stack.reach, 1e-9)
    if evidence.white:
        finest = _FINEST / reach
    else:
        finest = max(_FINEST_OF_VIEWS / reach, min((high - low) / _MANY_LEVELS, _COARSEST_OF_VIEWS / reach))
    step = max(finest, (high - low) / _MOST_LEVELS)
    return Search(low, high, step, window, workers)


def disparity_range(evidence: Evidence, *, workers: int = 1) -> tuple[float, float]:
    """The disparities between which the scene lies, with a margin: at pictures made smaller, by photo-consistency where
    views are clean, which doesn't enlarge near things, else by what disparities explain."""
    between = None if evidence.white else _range_of_clean(evidence, workers)
    return between or _range_of_noisy(evidence, workers)


def _range_of_clean(evidence: Evidence, workers: int) -> tuple[float, float] | None:
    """None where noise hides which disparity is the best."""
    stack = evidence.stack
    factor = 2 if max(stack.views.shape[2:]) > _COARSE_SIDE else 1
    smaller = _smaller(stack.views, factor)
    coarse = ViewStack(smaller, stack.row_steps / factor, stack.column_steps / factor)
    looked = _looked(coarse, factor, 5, workers)
    disparities = looked.disparities()
    cost = differences(
        Lines.of(coarse, disparities, window=looked.contrast_window),
        disparities,
        limit=np.inf,
        window=looked.contrast_window,
        workers=workers,
    )
    least, mean = cost.min(axis=0), cost.mean(axis=0)
    margin = mean - least
    textured = margin >= np.quantile(margin, 1 - _SURE)
    if not float(np.median(least[textured])) < _CLEAR * float(np.median(mean[textured])):
        return None
    start = cost.argmin(axis=0)
    peaks, _ = peaked(np.negative(cost, out=cost), disparities, start)
    return _between(
        peaks, margin, looked, min(margin.shape) // 20, 0.5 * looked.step + _MARGIN_OF_CLEAN, left_out=0.001
    )


def _range_of_noisy(evidence: Evidence, workers: int) -> tuple[float, float]:
    coarse, factor = _coarse(evidence if evidence.white else thinned(evidence))
    looked = _looked(coarse.stack, factor, 9, workers)
    disparities = looked.disparities()
    if evidence.white:
        volume = -halves.unexplained(halves.whole(coarse), disparities, workers=workers)
    else:
        volume = contrast.explained(coarse, disparities, workers=workers)
    likelihood, _ = windowed(volume, looked.contrast_window)
    margin = likelihood.max(axis=0) - likelihood.mean(axis=0)
    peaks, _ = peaked(likelihood, disparities, likelihood.argmax(axis=0))
    if evidence.white:
        return _between(peaks, margin, looked, min(margin.shape) // 20, looked.step + _MARGIN_OF_SLICES)
    return _between(peaks, margin, looked, min(margin.shape) // 10, 0.5 * looked.step + _MARGIN)


def _coarse(evidence: Evidence) -> tuple[Evidence, int]:
    """The evidence of pictures made smaller by the factor."""
    stack = evidence.stack
    factor = max(1, math.ceil(max(stack.views.shape[2:]) / _COARSE_SIDE))
    images = _smaller(evidence.images, factor)
    # Of plain views the images are the views but for a factor.
    views = _smaller(stack.views, factor) if evidence.white else images * np.float32(1 / evidence.weights[0, 0])
    smaller = ViewStack(views, stack.row_steps / factor, stack.column_steps / factor)
    return replace(evidence, stack=smaller, images=images), factor


def _looked(coarse: ViewStack, factor: int, window: int, workers: int) -> Search:
    """What to look at in pictures made smaller by a factor; disparities are those of the large ones."""
    reach = factor * coarse.reach
    widest = min(_WIDEST, 0.25 * factor * coarse.views.shape[3] / max(reach, 1e-9))
    return Search(-widest, widest, max(0.35 * factor / reach, widest / 40), window, workers)


def _between(
    peaks: Map, margin: Map, looked: Search, edge: int, beyond: float, *, left_out: float = 0.002
) -> tuple[float, float]:
    """The range of the peaks (h, w) of those pixels with the largest margin, `edge` px from the edge, without the
    lowest and the highest share `left_out`, and `beyond` px/view more."""
    textured = margin >= np.quantile(margin, 1 - _SURE)
    edge = max(3, edge)
    textured[:edge] = textured[-edge:] = False
    best = ndimage.median_filter(peaks, 3)
    found = best[textured] if textured.any() else best.ravel()
    low, high = (float(x) for x in np.quantile(found, [left_out, 1 - left_out]))
    return max(low - beyond, 1.2 * looked.low), min(high + beyond, 1.2 * looked.high)


def _smaller(views: Singles, factor: int) -> Singles:
    """(V, U, h, w): each pixel the mean of `factor` × `factor`; what is left over at the end goes."""
    rows, columns = (side // factor * factor for side in views.shape[2:])
    lines = views[:, :, :rows:factor, :columns].copy()
    for k in range(1, factor):
        lines += views[:, :, k:rows:factor, :columns]
    made: Singles = lines[..., ::factor].copy()
    for k in range(1, factor):
        made += lines[..., k::factor]
    made *= np.float32(1 / factor**2)
    return made
