"""A few numbers that tell how much two arrays differ: 64 fixed random projections.

A hash says whether an array is the same; on another processor the last bits of a sum differ. Each projection is the sum
of a 64th of the values, each with a fixed random sign, so a change of one value changes one projection by as much, and
rounding of n values by √n as much as that of one.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from functools import cache
from typing import Any

import numpy as np
from numpy.typing import NDArray

PROJECTIONS = 64
_BLOCK = 4096  # values of each projection that are summed at once


def fingerprint(values: NDArray[np.complex64] | NDArray[np.float32]) -> dict[str, Any] | None:
    """`count` (real and imaginary parts counted singly), `largest` amount and `sums` of an array; None where a value is
    not finite."""
    flat = np.ascontiguousarray(values).reshape(-1).view(np.float32)
    largest = float(np.abs(flat).max(initial=0.0))
    if not math.isfinite(largest):
        return None
    sums = np.zeros(PROJECTIONS)
    side = _BLOCK * PROJECTIONS
    signs = _signs(0)
    for number, start in enumerate(range(0, len(flat), side)):
        block = flat[start : start + side]
        if len(block) < side:
            block = np.concatenate([block, np.zeros(side - len(block), np.float32)])
        summed = np.einsum("rc,rc->c", signs, block.reshape(_BLOCK, PROJECTIONS))
        sums += _signs(1)[number % _BLOCK] * summed
    return {"count": len(flat), "largest": float(f"{largest:.9g}"), "sums": [float(f"{one:.9g}") for one in sums]}


def difference(recorded: Mapping[str, Any], found: Mapping[str, Any]) -> float:
    """By how much two arrays differ, as a share of the recorded one's largest value: for independent errors of their
    values about one of them; a change of one value alone counts less by the root of a projection's length.

    inf for arrays of different sizes, or where a fingerprint is damaged.
    """
    try:
        if recorded["count"] != found["count"] or not recorded["count"]:
            return math.inf
        apart = np.abs(np.array(recorded["sums"], dtype=np.float64) - np.array(found["sums"], dtype=np.float64))
        if apart.shape != (PROJECTIONS,):
            return math.inf
        length = math.sqrt(max(1.0, recorded["count"] / PROJECTIONS))
        share = float(apart.max()) / length / float(recorded["largest"]) if apart.any() else 0.0
    except (KeyError, TypeError, ValueError, ZeroDivisionError):
        return math.inf
    return share if math.isfinite(share) else math.inf


@cache
def _signs(seed: int) -> NDArray[np.float32]:
    """(_BLOCK, PROJECTIONS) of ±1, the same on every machine (splitmix64)."""
    z = np.arange(1, _BLOCK * PROJECTIONS + 1, dtype=np.uint64) + np.uint64(seed << 32)
    with np.errstate(over="ignore"):
        z *= np.uint64(0x9E3779B97F4A7C15)
        z = (z ^ (z >> np.uint64(30))) * np.uint64(0xBF58476D1CE4E5B9)
        z = (z ^ (z >> np.uint64(27))) * np.uint64(0x94D049BB133111EB)
    z ^= z >> np.uint64(31)
    return (1.0 - 2.0 * (z >> np.uint64(63))).astype(np.float32).reshape(_BLOCK, PROJECTIONS)
