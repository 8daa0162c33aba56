"""Virtual stereo pairs: two eyes within the aperture, as a red-cyan anaglyph or side by side."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from dappled.decode.errors import DecodeError
from dappled.decode.lightfield.refocus import disc, shift_and_add
from dappled.decode.lightfield.view_stack import Image, ViewStack


@dataclass(frozen=True, slots=True, eq=False)
class StereoPair:
    """What the left and the right eye see, float32 (h, w) or (h, w, 3)."""

    left: Image
    right: Image


def eyes(
    stack: ViewStack, *, separation: float = 0.6, pupil: float = 0.35, disparity: float = 0.0, workers: int = 1
) -> StereoPair:
    """Two synthetic apertures `separation` apart, `pupil` wide (shares of the whole aperture), converging on a
    disparity. Raises DecodeError where there is only one column of views."""
    if not 0 < separation <= 1:
        raise DecodeError(f"eyes {separation:g} of the aperture apart don't fit into it: give more than 0, at most 1")
    if np.ptp(stack.column_steps) == 0:
        raise DecodeError("a stereo pair needs views from several columns of the aperture")
    # A point nearer than the focus is seen further to the right by the view with the larger step: that is the left eye.
    towards_left = float(np.sign(stack.column_steps[-1] - stack.column_steps[0]))
    left, right = (
        shift_and_add(
            stack, disparity, weights=disc(stack, pupil, (0.0, side * towards_left * separation / 2)), workers=workers
        )
        for side in (1, -1)
    )
    return StereoPair(left, right)


def anaglyph(pair: StereoPair) -> NDArray[np.float32]:
    """(h, w, 3) for red-cyan glasses: red is the left eye's, green and blue the right one's."""
    left, right = (p if p.ndim == 3 else np.repeat(p[..., None], 3, axis=2) for p in (pair.left, pair.right))
    made: NDArray[np.float32] = np.concatenate([left[..., :1], right[..., 1:]], axis=2).astype(np.float32)
    return made


def side_by_side(pair: StereoPair, *, crossed: bool = False) -> Image:
    """(h, 2w(, 3)): the left eye's picture left, or right for crossed eyes."""
    both = (pair.right, pair.left) if crossed else (pair.left, pair.right)
    made: Image = np.concatenate(both, axis=1)
    return made
