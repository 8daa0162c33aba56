"""Match the marks of a camera's contact with shots by count, interval and time, or say that this is not certain.

One offset between the two clocks explains all pairs. Each offset has a cost: the squared error of each shot's time in
its own sigmas, so much for each shot without a mark and each mark without a shot, and, where UTC is known, the offset's
own size. The cheapest one counts if every other way to pair is worse by a clear margin.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from dappled.decode.array_types import Floats

_FLOOR_S = 0.008  # contact bounce, and clocks that drift in a flight
_REACH = 4.0  # sigmas
_LOST, _EXTRA = _REACH**2, 8.0  # cost of a shot without a mark, and of a mark without a shot
_MARGIN = 12.0
_GAP_SHARE = 0.4  # of the interval to the next shot: a mark further away is nearer to that one
_OFFSET_SIGMA_S, _MOST_OFFSET_COST = 0.05, 25.0
_BIN_S, _BINS, _NEAR_BINS = 0.02, 32, 8
_ROUNDS = 4


@dataclass(frozen=True, slots=True)
class TimedShot:
    """A shot's image index and when its exposure began, seconds UTC, with one sigma."""

    index: int
    begins_s: float
    sigma_s: float


@dataclass(frozen=True, slots=True)
class MarkPairs:
    """`pairs` (place among the shots, place among the marks), and the shots' clock less the marks' (median).

    `certain` is False where another way to pair is nearly as good.
    """

    pairs: tuple[tuple[int, int], ...]
    offset_s: float
    certain: bool


@dataclass(frozen=True, slots=True, eq=False)
class _Way:
    pairs: tuple[tuple[int, int], ...]
    offset_s: float
    cost: float


def pair(shots: Sequence[TimedShot], marks_s: Sequence[float], *, utc_known: bool, most_s: float) -> MarkPairs:
    """Pair shots and marks, both in the order of time. Offsets up to `most_s` are tried."""
    base = shots[0].begins_s  # small numbers keep their digits
    begins = np.array([shot.begins_s - base for shot in shots])
    marks = np.array(marks_s, dtype=np.float64) - base
    sigmas = np.hypot([shot.sigma_s for shot in shots], _FLOOR_S)
    gaps = np.diff(begins, prepend=-np.inf, append=np.inf)
    reach = np.minimum(_REACH * sigmas, _GAP_SHARE * np.minimum(gaps[:-1], gaps[1:]))
    prior_s = max(_OFFSET_SIGMA_S, 2 * float(np.median(sigmas))) if utc_known else None
    ways: dict[tuple[tuple[int, int], ...], _Way] = {}
    for start in _starts(begins, marks, sigmas, most_s):
        way = _way(begins, marks, (sigmas, reach), prior_s, start)
        if way.pairs not in ways or way.cost < ways[way.pairs].cost:
            ways[way.pairs] = way
    best, *others = sorted(ways.values(), key=lambda way: way.cost) or [_Way((), 0.0, 0.0)]
    certain = all(other.cost - best.cost >= _MARGIN for other in others if _contradicts(other.pairs, best.pairs))
    return MarkPairs(best.pairs, best.offset_s, certain)


def _contradicts(some: Sequence[tuple[int, int]], others: Sequence[tuple[int, int]]) -> bool:
    """Whether two ways give a shot, or a mark, different partners."""
    by_shot, by_mark = dict(others), {mark: shot for shot, mark in others}
    return any(by_shot.get(shot, mark) != mark or by_mark.get(mark, shot) != shot for shot, mark in some)


def _starts(begins: Floats, marks: Floats, sigmas: Floats, most_s: float) -> list[float]:
    """Offsets that many pairs of well-timed shots and marks have, and none."""
    timed = begins[sigmas <= 2 * np.median(sigmas)]
    offsets = (timed[:, None] - marks[None, :]).ravel()
    offsets = offsets[np.abs(offsets) <= most_s]
    values, counts = np.unique(np.round(offsets / _BIN_S), return_counts=True)
    often = values[np.argsort(-counts, kind="stable")[:_BINS]]
    near = values[np.argsort(np.abs(values), kind="stable")[:_NEAR_BINS]]
    return sorted({*(float(one) * _BIN_S for one in (*often, *near)), 0.0})


def _way(begins: Floats, marks: Floats, limits: tuple[Floats, Floats], prior_s: float | None, offset_s: float) -> _Way:
    sigmas, reach = limits
    pairs: tuple[tuple[int, int], ...] = ()
    left = np.zeros(0)
    wide = reach + _BIN_S  # the first offset is a bin's middle
    for number in range(_ROUNDS):
        shot, mark, left = _nearest(begins - offset_s, marks, wide if number == 0 else reach)
        pairs = tuple(zip(shot.tolist(), mark.tolist(), strict=True))
        if not pairs:
            break
        sharp = sigmas[shot] <= 2 * np.median(sigmas[shot])
        offset_s += float(np.median(left[sharp]))
        left = left - float(np.median(left[sharp]))
    cost = _LOST * (len(begins) - len(pairs)) + _EXTRA * (len(marks) - len(pairs))
    if pairs:
        cost += float(np.sum((left / sigmas[shot]) ** 2))
    if prior_s is not None:
        cost += min((offset_s / prior_s) ** 2, _MOST_OFFSET_COST)
    return _Way(pairs, offset_s, cost)


def _nearest(begins: Floats, marks: Floats, reach: Floats) -> tuple[NDArray[np.intp], NDArray[np.intp], Floats]:
    """(shots, marks, errors) of the shots whose nearest mark is in reach; of two with one mark the nearer."""
    right = np.clip(np.searchsorted(marks, begins), 1, max(1, len(marks) - 1))
    right = np.minimum(right, len(marks) - 1)
    before = np.maximum(right - 1, 0)
    mark = np.where(np.abs(begins - marks[before]) <= np.abs(begins - marks[right]), before, right)
    error = begins - marks[mark]
    shot = np.flatnonzero(np.abs(error) <= reach)
    shot = shot[np.argsort(np.abs(error[shot]), kind="stable")]
    _, first = np.unique(mark[shot], return_index=True)
    kept = np.sort(shot[first])
    return kept, mark[kept], error[kept]
