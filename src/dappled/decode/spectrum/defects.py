"""Defective pixels: found in a dark frame, where they glow, and filled in from their neighbours of the same colour."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

_STANDS_OUT = 12.0  # robust standard deviations of the dark frame's own noise
_LEAST_LEVELS = 8.0
_MOST = 0.02  # of all pixels: more are no defects

Places = tuple[NDArray[np.intp], NDArray[np.intp]]
Period = tuple[int, int]


def find_defects(dark: NDArray[Any], period: Period = (1, 1)) -> Places:
    """(rows, columns) of pixels that stand out of a dark frame (H, W), each place of the colour pattern by itself.

    None where more than a fiftieth do: that is a pattern, which goes when the dark frame is taken off.
    """
    found = np.zeros(dark.shape, dtype=bool)
    for row in range(period[0]):
        for column in range(period[1]):
            part = dark[row :: period[0], column :: period[1]].astype(np.float32)
            middle = np.median(part)
            spread = 1.4826 * float(np.median(np.abs(part - middle)))
            found[row :: period[0], column :: period[1]] = np.abs(part - middle) > max(
                _STANDS_OUT * spread, _LEAST_LEVELS
            )
    if float(found.mean()) > _MOST:
        found[:] = False
    rows, columns = np.nonzero(found)
    return rows, columns


def mended(mosaic: NDArray[Any], defects: Places, period: Period = (1, 1)) -> NDArray[Any]:
    """The mosaic with its defects as the mean of their sound neighbours of the same colour; others stay as they are.

    A defect without a sound neighbour keeps its value.
    """
    rows, columns = defects
    if not len(rows):
        return mosaic
    height, width = mosaic.shape
    bad = np.zeros(mosaic.shape, dtype=bool)
    bad[rows, columns] = True
    total, count = np.zeros(len(rows)), np.zeros(len(rows))
    for down, right in ((-1, 0), (1, 0), (0, -1), (0, 1)):
        y, x = rows + down * period[0], columns + right * period[1]
        inside = (y >= 0) & (y < height) & (x >= 0) & (x < width)
        y, x = np.where(inside, y, 0), np.where(inside, x, 0)
        sound = inside & ~bad[y, x]
        total += np.where(sound, mosaic[y, x], 0)
        count += sound
    out = mosaic.copy()
    known = count > 0
    values = total[known] / count[known]
    out[rows[known], columns[known]] = np.rint(values) if mosaic.dtype.kind in "ui" else values
    return out
