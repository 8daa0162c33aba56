"""How far the disparities of neighbours scatter about a plane: an error that the likelihood's peak does not show."""

from __future__ import annotations

import numpy as np
from scipy import ndimage

from dappled.decode.depth.depth_map import Map

_LEAST_WEIGHT = 1e-3  # of one pixel's


def scattered(disparity: Map, *, apart: int, most: float, reach: float) -> Map:
    """The rms error (h, w) px/view that the second differences of a map (NaN: unknown) tell of; NaN where they tell
    nothing.

    Second differences of pixels `apart` px, along rows and columns: 0 on a plane, however it is tilted, and six times
    the variance of errors that pixels so far from each other do not share. An error counts up to `most`, so that jumps
    hardly count. `reach`: px of the Gaussian over which they are averaged.
    """
    second = np.zeros(2 * apart + 1)
    second[[0, apart, -1]] = 1, -2, 1
    known = np.isfinite(disparity)
    filled = np.where(known, disparity, 0)
    total, weight = np.zeros_like(disparity), np.zeros_like(disparity)
    for axis in (0, 1):
        bent = ndimage.correlate1d(filled, second, axis=axis, mode="nearest")
        told = ndimage.minimum_filter1d(known.astype(np.uint8), 2 * apart + 1, axis=axis, mode="constant")
        bent *= bent
        bent *= np.float32(1 / 6)
        total += np.minimum(bent, np.full_like(bent[:1], most**2)) * told
        weight += told
    total, weight = (ndimage.gaussian_filter(a, reach, mode="nearest", truncate=3.0) for a in (total, weight))
    made: Map = np.sqrt(total / np.where(weight > _LEAST_WEIGHT, weight, np.float32(np.nan)))
    return made
