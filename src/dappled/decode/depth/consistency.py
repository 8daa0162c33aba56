"""Depth from photo-consistency: at the right disparity the views of a point look like the middle one.

Only the views beside, above and below the middle are asked. Behind an edge one side of them sees something else, the
other side doesn't: of each pair of opposite arms the better one counts, so near edges stay where they are.
"""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray
from scipy import ndimage

from dappled.decode.lightfield.view_stack import Image, ViewStack
from dappled.decode.threads import each

_SMOOTH_PX = 0.6  # sigma: what linear interpolation does to a picture depends less on the fraction then
_WINDOW = 3  # px


def differences(stack: ViewStack, disparities: NDArray[np.float64], *, limit: float, workers: int = 1) -> Image:
    """float32 (D, h, w): squared difference of the views from the middle one, summed over the better arms.

    Grey views; each squared difference counts up to `limit` at most. Arms that don't exist count nothing.
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
            found.append(ndimage.uniform_filter(total, _WINDOW))
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
