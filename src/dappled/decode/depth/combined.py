"""Estimate depth from contrast, photo-consistency of clean views, and neighbouring pixels together.

Each is a log-likelihood, so they can be added. Refocus contrast tolerates noise, and enlarges near objects by half a
window. Photo-consistency keeps edges where they are, and needs clean views. Semi-global matching decides where both
are weak. Disparity and error then come from the measurements alone: neighbours select the peak and do not move it.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray
from scipy import ndimage

from dappled.decode.depth import contrast as depth_contrast
from dappled.decode.depth.depth_map import DepthMap, Search, Volume, box, confidence, judged, peaked, windowed
from dappled.decode.depth.evidence import Evidence
from dappled.decode.lightfield import ViewStack
from dappled.decode.lightfield.light_field import Image
from dappled.workers import each

_CLEAN, _NOISY = 2.0, 200.0  # contrast's share beside photo-consistency, by noise over texture and its square
_MOST_CLEAN = 0.3  # with a larger share views are noisy, and contrast needs its whole window
_SMALL, _LARGE = 4.0, 30.0  # P1 and P2, in units of the log-likelihood
_NEGLIGIBLE = 0.005  # a smaller share of contrast would not change the result
_OUTLIER = 30.0  # variances: a view that differs by more sees something else
_SAMPLE = 160  # px a side: as much of the middle tells how well views agree
_NARROW = 5  # px: the window of contrast beside photo-consistency
_LEAST_VARIANCE = 1e-8
_SMOOTH_PX = 0.6  # sigma: what linear interpolation does to a picture depends less on the fraction then
_ARM_WINDOW = 3  # px


def depth(evidence: Evidence, search: Search) -> DepthMap:
    """The depth map by all methods that the evidence allows: photo-consistency only of plain views."""
    disparities = search.disparities()
    seen = _by_contrast(evidence, search) if evidence.white else _by_both(evidence, search)
    likelihood, samples = seen.likelihood, seen.samples
    window = search.window if evidence.white else _NARROW
    smooth = smoothed(-likelihood, small=_SMALL, large=_LARGE, workers=search.workers)
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
    """A log-likelihood (D, h, w), of the given number of samples per pixel; `spread` as in `windowed`."""

    likelihood: Volume
    spread: float
    samples: float


def _by_contrast(evidence: Evidence, search: Search) -> _Seen:
    raw = depth_contrast.explained(evidence, search.disparities(), workers=search.workers)
    likelihood, spread = windowed(raw, search.window)
    return _Seen(likelihood, spread, float(box(search.window) ** 2))


def _by_both(evidence: Evidence, search: Search) -> _Seen:
    """Photo-consistency, and contrast with a share that depends on the noise of the views."""
    disparities, stack = search.disparities(), evidence.stack
    variance = _disagreement(stack, disparities, search.workers)
    # Where noise is as strong as texture, one view can't be compared with another: contrast takes over.
    noise = variance / max(_texture(stack), _LEAST_VARIANCE)
    share = min(1.0, _CLEAN * noise + _NOISY * noise**2)
    cost = differences(stack, disparities, limit=_OUTLIER * variance, workers=search.workers)
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
    least = differences(sample, disparities, limit=np.inf, workers=workers).min(axis=0)
    return max(float(np.median(least)) / (2 * max(1, compared(stack))), _LEAST_VARIANCE)


def differences(stack: ViewStack, disparities: NDArray[np.float64], *, limit: float, workers: int = 1) -> Image:
    """float32 (D, h, w): squared difference of the views from the middle one, summed over the better arms.

    At the right disparity the views of a point look like the middle one. Only the views beside, above and below it are
    used. Behind an edge one side of them sees something else and the other side doesn't: of each pair of opposite arms
    the better one counts, so near edges stay where they are.

    Grey views; each squared difference counts up to `limit` at most. Missing arms do not count.
    """
    views = ndimage.gaussian_filter(stack.views, (0, 0, _SMOOTH_PX, _SMOOTH_PX))
    v0, u0 = (int(np.argmin(np.abs(steps))) for steps in (stack.row_steps, stack.column_steps))
    middle = views[v0, u0]
    most = float(np.abs(disparities).max()) * stack.reach
    pad = math.ceil(most) + 2
    beside = np.pad(views[v0], ((0, 0), (0, 0), (pad, pad)), mode="edge")
    above = np.ascontiguousarray(np.pad(views[:, u0], ((0, 0), (pad, pad), (0, 0)), mode="edge"))
    arms = [
        [(lines, axis, k, steps[k] - steps[at]) for k in range(len(steps)) if sign * (k - at) > 0]
        for lines, axis, steps, at in ((beside, 1, stack.column_steps, u0), (above, 0, stack.row_steps, v0))
        for sign in (-1, 1)
    ]
    out = np.zeros((len(disparities), *middle.shape), dtype=np.float32)

    def one(number: int) -> None:
        found = []
        for arm in arms:
            if not arm:
                continue
            total = np.zeros_like(middle)
            for lines, axis, k, step in arm:
                difference = _shifted(lines[k], disparities[number] * step + pad, axis, middle.shape[axis])
                difference -= middle
                difference *= difference
                np.minimum(difference, np.float32(limit), out=difference)
                total += difference
            found.append(ndimage.uniform_filter(total, _ARM_WINDOW))
        for a in range(0, len(found) - 1, 2):
            out[number] += np.minimum(found[a], found[a + 1])
        if len(found) % 2:
            out[number] += found[-1]

    each(one, range(len(disparities)), workers)
    return out


def compared(stack: ViewStack) -> int:
    """How many views the better arms of each pair count together."""
    return sum(len(steps) // 2 for steps in (stack.row_steps, stack.column_steps))


def _shifted(image: Image, shift: float, axis: int, side: int) -> Image:
    """`side` samples along an axis from `shift` on, linear between samples."""
    whole = math.floor(shift)
    share = np.float32(shift - whole)
    here, there = slice(whole, whole + side), slice(whole + 1, whole + 1 + side)
    a, b = (image[here], image[there]) if axis == 0 else (image[:, here], image[:, there])
    made: Image = b - a
    made *= share
    made += a
    return made


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
