"""Errors that a likelihood's peak does not show: how neighbours scatter about a plane, and what else is likely."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray
from scipy import ndimage

from dappled.decode.depth.depth_map import Map, Volume

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


def undecided(likelihood: Volume, disparities: NDArray[np.float64], found: Map, *, unit: float) -> Map:
    """(h, w) px/view: the rms distance of all disparities from the one `found` (NaN: unknown), each by its odds, beyond
    one step between them.

    A disparity of log-likelihood L (D, h, w) has odds exp(L/unit). A peak that is narrower than a step tells nothing of
    its width here, and counts as none. What remains are the other side of a jump, and the range of disparities that
    faint texture leaves open.
    """
    most = likelihood.max(axis=0)
    total, square = np.zeros_like(most), np.zeros_like(most)
    for level, disparity in zip(likelihood, disparities, strict=True):
        odds = np.exp((level - most) * np.float32(1 / unit))
        total += odds
        square += odds * (found - np.float32(disparity)) ** 2
    made: Map = np.sqrt(np.maximum(square / total - np.float32(disparities[1] - disparities[0]) ** 2, 0))
    return made
