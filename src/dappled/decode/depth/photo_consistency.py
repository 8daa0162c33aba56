"""Compare views with the middle one at each disparity, in those directions that see the same thing."""

from __future__ import annotations

import math
from collections.abc import Sequence
from itertools import accumulate

import numpy as np
from numpy.typing import NDArray
from scipy import ndimage

from dappled.decode.lightfield import ViewStack
from dappled.decode.lightfield.light_field import Image
from dappled.workers import each

_SMOOTH_PX = 0.6  # sigma: what linear interpolation does to a picture depends less on the fraction then
STRIP = 32  # rows at a time: what is worked on stays in the processor's cache
WINDOW = 3  # px


def differences(
    stack: ViewStack,
    disparities: NDArray[np.float64],
    *,
    limit: float,
    window: int = WINDOW,
    every: int = 1,
    workers: int = 1,
) -> Image:
    """float32 (D, h, w): squared difference of the views from the middle one, summed over the better half of the arms.

    At the right disparity the views of a point look like the middle one. The arms are the views to the left, to the
    right, above and below it, of each the nearest and the outermost (the others tell hardly more). Behind an edge some
    arms see something else and the others don't: those with the smaller sums count, so near edges stay where they are.

    Grey views; each squared difference counts up to `limit` at most, as the mean over `window` px a side. `every`: of
    so many strips of `STRIP` rows one is looked at, and the others are left out of the result.
    """
    v0, u0 = (int(np.argmin(np.abs(steps))) for steps in (stack.row_steps, stack.column_steps))
    middle = _smooth(stack.views[v0, u0])
    height, width = middle.shape
    most = float(np.abs(disparities).max()) * stack.reach
    half = window // 2
    pad = math.ceil(most) + 2 + half
    beside = {k: np.pad(_smooth(stack.views[v0, k]), pad, mode="edge") for _, k, _ in _arms(stack.column_steps, u0)}
    above = {k: np.pad(_smooth(stack.views[k, u0]), pad, mode="edge") for _, k, _ in _arms(stack.row_steps, v0)}
    sides = [
        (axis, [(lines[k], step) for sign, k, step in _arms(steps, at) if sign == side])
        for axis, lines, steps, at in ((1, beside, stack.column_steps, u0), (0, above, stack.row_steps, v0))
        for side in (-1, 1)
    ]
    arms = [(axis, chosen) for axis, chosen in sides if chosen]
    wide = np.pad(middle, half, mode="edge")
    tops = range(0, height, STRIP)[(len(range(0, height, STRIP)) - 1) % every // 2 :: every]
    most_counted = np.float32(limit)
    counts = [min(STRIP, height - top) for top in tops]
    begins = dict(zip(tops, accumulate(counts, initial=0), strict=False))
    out = np.empty((len(disparities), sum(counts), width), dtype=np.float32)

    def one(top: int) -> None:
        rows = min(STRIP, height - top) + 2 * half
        target = wide[top : top + rows]
        for number, disparity in enumerate(disparities):
            found = []
            for axis, chosen in arms:
                total = np.zeros_like(target)
                for image, step in chosen:
                    shift = disparity * step
                    shifts = (shift, 0.0) if axis == 0 else (0.0, shift)
                    made = _shifted(image, shifts, (top + pad - half, pad - half), target.shape)
                    made -= target
                    made *= made
                    np.minimum(made, most_counted, out=made)
                    total += made
                found.append(_mean(total, window))
            out[number, begins[top] : begins[top] + rows - 2 * half] = _better(found)

    each(one, tops, workers)
    return out


def compared(stack: ViewStack) -> int:
    """How many views the better half of the arms counts."""
    counts = [
        sum(sign == side for sign, _, _ in _arms(steps, int(np.argmin(np.abs(steps)))))
        for steps in (stack.row_steps, stack.column_steps)
        for side in (-1, 1)
    ]
    counts = sorted(count for count in counts if count)
    return sum(counts[: (len(counts) + 1) // 2])


def _arms(steps: NDArray[np.float64], at: int) -> list[tuple[int, int, float]]:
    """(-1 or 1, number of the view, step from the middle one): the nearest and the outermost view on either side."""
    before, after = ([k for k in range(len(steps)) if sign * (k - at) > 0] for sign in (-1, 1))
    chosen = [(-1, k) for k in sorted({before[0], before[-1]} if before else ())]
    chosen += [(1, k) for k in sorted({after[0], after[-1]} if after else ())]
    return [(sign, k, float(steps[k] - steps[at])) for sign, k in chosen]


def _smooth(view: Image) -> Image:
    made: Image = ndimage.gaussian_filter(view, _SMOOTH_PX)
    return made


def _shifted(image: Image, shifts: tuple[float, float], corner: tuple[int, int], shape: tuple[int, ...]) -> Image:
    """The part of an image from a corner on, moved along one axis, linear between samples."""
    whole = [math.floor(shift) for shift in shifts]
    share = max(np.float32(shift - k) for shift, k in zip(shifts, whole, strict=True))
    axis = 0 if shifts[0] else 1
    y, x = corner[0] + whole[0], corner[1] + whole[1]
    a = image[y : y + shape[0], x : x + shape[1]]
    b = image[y + (axis == 0) :, x + (axis == 1) :][: shape[0], : shape[1]]
    made: Image = b - a
    made *= share
    made += a
    return made


def _mean(image: Image, window: int) -> Image:
    """Over windows that lie within the image: it becomes smaller by window − 1."""
    for axis in (0, 1):
        count = image.shape[axis] - window + 1
        parts = [image[k : k + count] if axis == 0 else image[:, k : k + count] for k in range(window)]
        total = parts[0].copy() if window == 1 else parts[0] + parts[1]
        for part in parts[2:]:
            total += part
        image = total
    image *= np.float32(1 / window**2)
    return image


def _better(arms: Sequence[Image]) -> Image:
    """The sum of the smaller half of them at each pixel."""
    if len(arms) == 4:  # without a sort
        a, b, c, d = arms
        low, high = np.minimum(a, b), np.maximum(a, b)
        least, most = np.minimum(c, d), np.maximum(c, d)
        second = np.minimum(np.maximum(low, least), np.minimum(high, most))
        second += np.minimum(low, least)
        made: Image = second
        return made
    ordered = np.sort(np.stack(arms), axis=0)
    total: Image = ordered[: (len(arms) + 1) // 2].sum(axis=0)
    return total
