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

from dappled.decode.array_types import Singles
from dappled.decode.depth import combined, contrast, halves, stereo
from dappled.decode.depth.depth_map import DepthMap, Search, peaked, windowed
from dappled.decode.depth.evidence import Evidence, of_made, thinned
from dappled.decode.errors import DecodeError
from dappled.decode.lightfield import ViewStack

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
_MARGIN, _MARGIN_OF_SLICES = 0.1, 0.2  # px/view beyond the range that was found, with half a step, or a whole one
_SURE = 0.6  # the share of pixels, those with most texture, that the range is read off


def estimate(
    evidence: Evidence, method: str = "combined", *, between: tuple[float, float] | None = None,
    window: int | None = None, workers: int = 1,
) -> DepthMap:  # fmt: skip
    """The depth map by one of `METHODS`, at disparities `between` two (None: where a coarse search finds the scene).

    Raises DecodeError for an unknown method or a empty range.
    """
    known_method(method)
    if method == "combined" and evidence.made is not None:  # without noise views tell more than slices
        evidence = of_made(evidence.made)
    low, high = between or disparity_range(evidence, workers=workers)
    return METHODS[method](evidence, search(evidence, low, high, window=window, workers=workers))


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
    """The disparities between which the scene lies, with a margin: what they explain of pictures made smaller."""
    evidence = evidence if evidence.white else thinned(evidence)
    stack = evidence.stack
    height, width = stack.views.shape[2:]
    factor = max(1, math.ceil(max(height, width) / _COARSE_SIDE))
    images = _smaller(evidence.images, factor)
    # Of plain views the images are the views but for a factor.
    views = _smaller(stack.views, factor) if evidence.white else images * np.float32(1 / evidence.weights[0, 0])
    coarse = replace(
        evidence,
        stack=ViewStack(views, stack.row_steps / factor, stack.column_steps / factor),
        images=images,
    )
    widest = min(_WIDEST, 0.25 * width / max(stack.reach, 1e-9))
    looked = Search(-widest, widest, max(0.35 * factor / stack.reach, widest / 40), 9, workers)
    disparities = looked.disparities()
    if evidence.white:
        volume = -halves.unexplained(halves.whole(coarse), disparities, workers=workers)
    else:
        volume = contrast.explained(coarse, disparities, workers=workers)
    likelihood, _ = windowed(volume, looked.contrast_window)
    margin = likelihood.max(axis=0) - likelihood.mean(axis=0)
    textured = margin >= np.quantile(margin, 1 - _SURE)
    edge = max(3, min(margin.shape) // (20 if evidence.white else 10))
    textured[:edge] = textured[-edge or None :] = False
    peaks, _ = peaked(likelihood, disparities, likelihood.argmax(axis=0))
    best = ndimage.median_filter(peaks, 3)
    found = best[textured] if textured.any() else best.ravel()
    low, high = (float(x) for x in np.quantile(found, [0.002, 0.998]))
    step = disparities[1] - disparities[0]
    margin_px = step + _MARGIN_OF_SLICES if evidence.white else 0.5 * step + _MARGIN
    return max(low - margin_px, -1.2 * widest), min(high + margin_px, 1.2 * widest)


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
