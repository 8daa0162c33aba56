"""Epipolar-plane images: one line of the picture, as each view of a row (or column) of the aperture sees it (Fig 54).

A point is a straight line in it, whose slope is its disparity: upright in focus, leaning where it is nearer or farther.
"""

from __future__ import annotations

import numpy as np

from dappled.decode import DecodeError
from dappled.decode.lightfield import ViewStack
from dappled.decode.lightfield.light_field import Image
from dappled.products.exports import prints

_VIEW_PX = 8  # of the drawing, for each view
_GAP = 6
_LINE = (220, 40, 40)


def along_row(stack: ViewStack, row: int) -> Image:
    """(U, w) or (U, w, 3): a row of the picture in the aperture's middle row of views, u downwards."""
    return _line(stack, row, 0)


def along_column(stack: ViewStack, column: int) -> Image:
    """(V, h) or (V, h, 3): a column of the picture in the aperture's middle column of views, v downwards."""
    return _line(stack, column, 1)


def drawn(stack: ViewStack, row: int | None = None, column: int | None = None) -> prints.Bytes:
    """The middle view with a line through a row and a column (None: the middle one), the row's epipolar-plane image
    below it and the column's beside it. Raises DecodeError for a line outside of the picture."""
    height, width = stack.views.shape[2:4]
    row, column = height // 2 if row is None else row, width // 2 if column is None else column
    white = prints.white_of([stack.views])
    middle = _rgb(stack.middle(), white)
    below = np.repeat(_rgb(along_row(stack, row), white), _VIEW_PX, axis=0)
    beside = np.repeat(_rgb(along_column(stack, column), white), _VIEW_PX, axis=0).swapaxes(0, 1)
    middle[row], middle[:, column] = _LINE, _LINE
    sheet = np.full((height + _GAP + below.shape[0], width + _GAP + beside.shape[1], 3), 255, dtype=np.uint8)
    sheet[:height, :width], sheet[height + _GAP :, :width], sheet[:height, width + _GAP :] = middle, below, beside
    return sheet


def _line(stack: ViewStack, at: int, axis: int) -> Image:
    side = stack.views.shape[2 + axis]
    if not 0 <= at < side:
        name = "row" if axis == 0 else "column"
        raise DecodeError(f"there is no {name} {at}: the views have {side}, from 0 to {side - 1}")
    views = stack.views[stack.views.shape[0] // 2] if axis == 0 else stack.views[:, stack.views.shape[1] // 2]
    made: Image = views[:, at] if axis == 0 else views[:, :, at]
    return made


def _rgb(picture: Image, white: float) -> prints.Bytes:
    eight = prints.toned(picture, white)
    return np.ascontiguousarray(eight if eight.ndim == 3 else np.repeat(eight[..., None], 3, axis=2))
