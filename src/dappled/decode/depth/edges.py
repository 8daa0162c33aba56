"""Move jumps of disparity to the edges of the middle view: a median weighted by how alike two pixels look."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray
from scipy import ndimage

from dappled.decode.depth.depth_map import Map
from dappled.decode.lightfield.light_field import centred

# Chosen by hand where no figure stands beside a number; benchmarks/depth.py measures what all of them together make.

_NEAR, _REACH = 3, 3  # px: pixels beside a jump, or beside something unknown; how far the median's window reaches
_JUMP = 0.07  # px/view
_ALIKE = 0.08  # of the middle view's range: pixels that differ by more hardly count
_ROUNDS = 2  # of the median; chosen by hand, measured by benchmarks/depth.py
_LEVEL, _LEVEL_REACH = 0.15, 6  # px/view: neighbours that differ by more are another surface; px
_CHUNK = 65_536  # pixels whose windows are in memory at once


def sharpened(disparity: Map, sigma: Map, middle: Map, *, near: int = _NEAR, reach: int = _REACH) -> tuple[Map, Map]:
    """(disparity, σ), NaN where unknown: at jumps the weighted median of the known pixels nearby, its σ, and half
    of the range that the middle half of their weight takes.

    What is unknown beside something known takes part, and becomes known where most of what looks alike is known.
    Jumps are looked for in windows of `near` px a side, and the median's window reaches `reach` px to each side.
    """
    low, high = np.quantile(middle, [0.05, 0.95])
    alike = np.float32(max(_ALIKE * float(high - low), 1e-6))
    for _ in range(_ROUNDS):
        disparity, sigma = _once(disparity, sigma, middle, alike, (near, reach))
    return disparity, sigma


def _once(disparity: Map, sigma: Map, middle: Map, alike: np.float32, sides: tuple[int, int]) -> tuple[Map, Map]:
    near, reach = sides
    known = np.isfinite(disparity)
    highest = ndimage.maximum_filter(np.where(known, disparity, -np.inf), near)
    lowest = ndimage.minimum_filter(np.where(known, disparity, np.inf), near)
    rows, columns = np.nonzero(highest - lowest > np.where(known, _JUMP, -1.0))
    wide = [np.pad(a, reach, mode="edge") for a in (np.where(known, disparity, np.inf), sigma, middle)]
    side = np.arange(2 * reach + 1)
    made, errors = disparity.copy(), sigma.copy()
    for start in range(0, len(rows), _CHUNK):
        y, x = rows[start : start + _CHUNK], columns[start : start + _CHUNK]
        at = tuple(
            a.reshape(len(y), -1)
            for a in np.broadcast_arrays(y[:, None, None] + side[:, None], x[:, None, None] + side)
        )
        values, around, looks = (a[at] for a in wide)
        made[y, x], errors[y, x] = _median(values, around, looks, middle[y, x], alike)
    return made, errors


def _median(
    values: Map, errors: Map, looks: Map, own: NDArray[np.float32], alike: np.float32
) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
    """Of rows of windows (n, pixels); inf, which means unknown, goes last."""
    weights = np.exp(np.abs(looks - own[:, None]) / -alike)
    order = values.argsort(axis=1)
    sums = np.take_along_axis(weights, order, axis=1).cumsum(axis=1)
    whole = sums[:, -1:]
    sums_known = np.where(np.isfinite(values), weights, 0).sum(axis=1, keepdims=True)
    place = (sums < sums_known / 2).sum(axis=1)[:, None]
    chosen = np.take_along_axis(order, np.minimum(place, order.shape[1] - 1), axis=1)
    quarters = [
        np.take_along_axis(np.take_along_axis(values, order, axis=1), np.minimum(k, order.shape[1] - 1), axis=1)
        for k in ((sums < share * sums_known).sum(axis=1)[:, None] for share in (0.25, 0.75))
    ]
    enough = sums_known >= whole / 2
    with np.errstate(invalid="ignore"):
        spread = np.float32(0.5) * (quarters[1] - quarters[0])
        sigma = np.hypot(np.take_along_axis(errors, chosen, axis=1), spread)
    found = np.take_along_axis(values, chosen, axis=1)
    known = enough & np.isfinite(found) & np.isfinite(sigma)
    unknown = np.float32(np.nan)
    return np.where(known, found, unknown)[:, 0], np.where(known, sigma, unknown)[:, 0]


def levelled(disparity: Map) -> Map:
    """The mean of the known pixels nearby that differ by little: the steps between the disparities that were tried go,
    jumps and what is unknown stay."""
    around = np.pad(disparity, _LEVEL_REACH, mode="edge")
    height, width = disparity.shape
    total, weights = np.zeros_like(disparity), np.zeros_like(disparity)
    side = range(2 * _LEVEL_REACH + 1)
    shares: Map = np.exp(-(centred(len(side)) ** 2) / (0.5 * _LEVEL_REACH**2)).astype(np.float32)
    for dy in side:
        for dx in side:
            beside = around[dy : dy + height, dx : dx + width] - disparity
            alike = np.abs(beside) < _LEVEL  # false where either is unknown
            share = shares[dy] * shares[dx]
            total += np.where(alike, share * beside, 0)
            weights += share * alike
    total /= np.maximum(weights, np.float32(1e-6))
    total += disparity
    return total
