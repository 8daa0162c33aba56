"""Compare views with the middle one at each disparity, in those directions that see the same thing."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from itertools import accumulate

import numpy as np
from numpy.typing import NDArray
from scipy import ndimage

from dappled.decode.lightfield import ViewStack
from dappled.decode.lightfield.light_field import Image
from dappled.workers import each

# Chosen by hand where no figure stands beside a number; benchmarks/depth.py measures what all of them together make.

_SMOOTH_PX = 0.6  # sigma: what linear interpolation does to a picture depends less on the fraction then
STRIP = 32  # rows at a time: what is worked on stays in the processor's cache
WINDOW = 3  # px


@dataclass(frozen=True, slots=True, eq=False)
class _Line:
    """A padded view, its differences to the next pixel along an axis, and its step from the middle one."""

    image: Image
    ahead: Image
    axis: int
    step: float

    @classmethod
    def of(cls, view: Image, pad: int, axis: int, step: float) -> _Line:
        image = np.pad(view, pad, mode="edge")
        ahead = np.diff(image, axis=axis, append=image[-1:] if axis == 0 else image[:, -1:])
        return cls(image, ahead, axis, step)


class _Beside:
    """A view beside a part of the middle one. What doesn't depend on the fraction of a shift is kept for the next."""

    def __init__(self, line: _Line, target: Image, corner: tuple[int, int]) -> None:
        self._line, self._target, self._corner = line, target, corner
        self._whole: int | None = None
        self._base = self._ahead = target

    def squared(self, disparity: float, out: Image) -> None:
        """The squared difference at a disparity, linear between the view's pixels."""
        shift = disparity * self._line.step
        whole = math.floor(shift)
        if whole != self._whole:
            y, x = (at + whole * (axis == self._line.axis) for axis, at in enumerate(self._corner))
            part = slice(y, y + self._target.shape[0]), slice(x, x + self._target.shape[1])
            self._base, self._ahead, self._whole = self._line.image[part] - self._target, self._line.ahead[part], whole
        np.multiply(self._ahead, np.float32(shift - whole), out=out)
        out += self._base
        out *= out


@dataclass(frozen=True, slots=True, eq=False)
class Lines:
    """The middle view (h, w), and the views to compare it with: those of each arm, with `pad` px around them.

    The arms are the views to the left, to the right, above and below the middle one, of each the nearest and the
    outermost (the others tell hardly more).
    """

    middle: Image
    arms: tuple[tuple[_Line, ...], ...]
    pad: int

    @classmethod
    def of(
        cls, stack: ViewStack, disparities: NDArray[np.float64], *, window: int = WINDOW, shade: float = 0.0
    ) -> Lines:
        """Of grey views, for these disparities and windows up to `window` px a side.

        `shade`: what is as coarse as a Gaussian of so many pixels is taken from the views (0: nothing).
        """
        v0, u0 = (int(np.argmin(np.abs(steps))) for steps in (stack.row_steps, stack.column_steps))
        told = (
            (1, stack.views[v0], _arms(stack.column_steps, u0)),
            (0, stack.views[:, u0], _arms(stack.row_steps, v0)),
        )
        # Of an even number of views none is in the middle: steps from the one that is taken for it are larger.
        farthest = max((abs(step) for *_, some in told for *_, step in some), default=0.0)
        pad = math.ceil(float(np.abs(disparities).max()) * farthest) + 2 + window // 2
        arms = []
        for axis, views, some in told:
            for side in (-1, 1):
                chosen = [(k, step) for sign, k, step in some if sign == side]
                arms.append(tuple(_Line.of(_smooth(views[k], shade), pad, axis, step) for k, step in chosen))
        return cls(_smooth(stack.views[v0, u0], shade), tuple(arm for arm in arms if arm), pad)


def differences(
    lines: Lines,
    disparities: NDArray[np.float64],
    *,
    limit: Image | float,
    window: int = WINDOW,
    every: int = 1,
    within: tuple[slice, slice] = (slice(None), slice(None)),
    workers: int = 1,
) -> Image:
    """float32 (D, h, w): squared difference of the views from the middle one, summed over the better half of the arms.

    At the right disparity the views of a point look like the middle one. Behind an edge some arms see something else
    and the others don't: those with the smaller sums count, so near edges stay where they are.

    Each squared difference counts up to `limit` (one, or (h, w)) at most, as the mean over `window` px a side.
    `within`: the rows and columns to look at. `every`: of so many strips of `STRIP` rows one is looked at (`strips`).
    What is not looked at is left out of the result.
    """
    half = window // 2
    wide, most = (
        np.pad(np.broadcast_to(np.asarray(a, dtype=np.float32), lines.middle.shape), half, mode="edge")
        for a in (lines.middle, limit)
    )
    (first, last, _), (left, right, _) = (w.indices(n) for w, n in zip(within, lines.middle.shape, strict=True))
    height, width = last - first, right - left
    tops = strips(height, every)
    counts = [min(STRIP, height - top) for top in tops]
    begins = dict(zip(tops, accumulate(counts, initial=0), strict=False))
    out = np.empty((len(disparities), sum(counts), width), dtype=np.float32)

    def one(top: int) -> None:
        rows = min(STRIP, height - top)
        part = slice(first + top, first + top + rows + 2 * half), slice(left, right + 2 * half)
        target, at_most = np.ascontiguousarray(wide[part]), np.ascontiguousarray(most[part])
        corner = first + top + lines.pad - half, left + lines.pad - half
        arms = [[_Beside(line, target, corner) for line in arm] for arm in lines.arms]
        total, made = np.empty_like(target), np.empty_like(target)
        for number, disparity in enumerate(disparities):
            found = []
            for nearest, *others in arms:
                nearest.squared(disparity, total)
                np.minimum(total, at_most, out=total)
                for other in others:
                    other.squared(disparity, made)
                    np.minimum(made, at_most, out=made)
                    total += made
                found.append(_summed(total, window))
            _better(found, out[number, begins[top] : begins[top] + rows])

    each(one, tops, workers)
    out *= np.float32(1 / window**2)
    return out


def strips(height: int, every: int) -> range:
    """The first rows of every `every`th strip of `STRIP` rows, from the middle of the first `every` on."""
    tops = range(0, height, STRIP)
    return tops[(len(tops) - 1) % every // 2 :: every]


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


def _smooth(view: Image, shade: float) -> Image:
    made: Image = ndimage.gaussian_filter(view, _SMOOTH_PX)
    if shade:
        made -= ndimage.gaussian_filter(view, shade)
    return made


def _summed(image: Image, window: int) -> Image:
    """Over windows that lie within the image: it becomes smaller by window − 1."""
    for axis in (0, 1):
        count = image.shape[axis] - window + 1
        parts = [image[k : k + count] if axis == 0 else image[:, k : k + count] for k in range(window)]
        total = parts[0].copy() if window == 1 else parts[0] + parts[1]
        for part in parts[2:]:
            total += part
        image = total
    return image


def _better(arms: Sequence[Image], out: Image) -> None:
    """The sum of the smaller half of them at each pixel."""
    if len(arms) == 4:  # without a sort
        a, b, c, d = arms
        low, high = np.minimum(a, b), np.maximum(a, b)
        least, most = np.minimum(c, d, out=a), np.maximum(c, d, out=b)
        np.minimum(np.maximum(low, least, out=c), np.minimum(high, most, out=d), out=out)
        out += np.minimum(low, least, out=low)
        return
    ordered = np.sort(np.stack(arms), axis=0)
    ordered[: (len(arms) + 1) // 2].sum(axis=0, out=out)
