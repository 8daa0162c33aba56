"""Pair triggers with shots whose requests have no number: by order and time alone, and say what could be otherwise.

All requests come later than their triggers by about the same time, which is not known well: it contains the error of
the log's place in the flight. Of all pairings in order the cheapest is taken: each pair costs its distance from the
common delay in σ, squared (up to `_MOST`, so that one late request shifts no others), each trigger or shot that is left
over costs `_LEFT_OVER`. What a pairing that costs nearly as much says differently is in doubt.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from dappled.decode.array_types import Floats

_LEFT_OVER, _MOST = 12.0, 16.0
_NEAR = 9.0  # pairings that cost so much more are 3 σ less likely
_SIGMA_US = 25_000.0  # of requests over a good link
_EARLY_US = 300_000.0  # before the common delay
_SHIFTS = range(-13, 14)  # 2.6 s at 5 Hz
_ROUNDS = 2
_SAME = 1e-6
_WIDE, _FAR = 4.0, 3.0

_Row = tuple[int, Floats]  # the first number of shots, and the least cost with that many, one more, …


@dataclass(frozen=True, slots=True)
class Pairing:
    """Places of triggers and shots. `pairs`: the shot of each trigger that has one, `delay_us` later on the whole.

    `triggers` of each trigger left over: others that may be left over in its place; `shots` the same of shots; `of`
    each pair's trigger: others that its shot may belong to.
    """

    pairs: dict[int, int]
    delay_us: float
    triggers: dict[int, tuple[int, ...]]
    shots: dict[int, tuple[int, ...]]
    of: dict[int, tuple[int, ...]]


def paired_in_order(triggers_us: Sequence[int], shots_us: Sequence[int], *, known_us: float, late_us: float) -> Pairing:
    """Pair triggers (n,) with shots (m,), both rising, on one clock. A common delay within `known_us` is taken for the
    true one against those `_FAR` times as long; one request may be `late_us` later than its trigger."""
    begins = triggers_us[0] if triggers_us else 0
    triggers = np.asarray([one - begins for one in triggers_us], dtype=np.float64)
    shots = np.asarray([one - begins for one in shots_us], dtype=np.float64)
    tried = [one for shift in _SHIFTS if (one := _shifted(triggers, shots, shift, late_us)) is not None]
    if not tried:
        none: tuple[int, ...] = ()
        return Pairing({}, 0.0, dict.fromkeys(range(len(triggers)), none), dict.fromkeys(range(len(shots)), none), {})
    sigma_us = min(one.sigma_us for one in tried)
    if len(triggers) > 1 and _WIDE * sigma_us > float(np.median(np.diff(triggers))):
        sigma_us *= _WIDE / 2  # the nearest are paired, and look nearer than they are
    searches = [_Search(triggers, shots, one.delay_us, sigma_us, late_us) for one in tried]
    searches.sort(key=lambda one: one.cost)
    likely = [one for one in searches if one.cost <= searches[0].cost + _NEAR]
    likely.sort(key=lambda one: abs(one.delay_us))
    first = likely[0]
    if abs(first.delay_us) <= known_us and 2 * sigma_us <= known_us:
        likely = [one for one in likely if abs(one.delay_us) <= _FAR * known_us]
    return _with_doubts(first, [one for one in likely[1:] if one.pairs() != first.pairs()])


@dataclass(frozen=True, slots=True)
class _Delay:
    delay_us: float
    sigma_us: float


def _shifted(triggers: Floats, shots: Floats, shift: int, late_us: float) -> _Delay | None:
    """The common delay where each shot belongs `shift` triggers before the nearest one, and its spread; None where
    that is no delay that a request can have."""
    if not len(triggers) or not len(shots):
        return None
    after = np.clip(np.searchsorted(triggers, shots), 1, max(1, len(triggers) - 1))
    to_next_us = np.abs(shots - triggers[np.minimum(after, len(triggers) - 1)])
    nearest = after - (np.abs(shots - triggers[after - 1]) <= to_next_us)
    of = nearest - shift
    within = (of >= 0) & (of < len(triggers))
    if not within.any():
        return None
    delay_us = float(np.median(shots[within] - triggers[of[within]]))
    sigma_us = _SIGMA_US
    for _ in range(_ROUNDS):
        if abs(delay_us) > late_us:
            return None
        pairs = _Search(triggers, shots, delay_us, sigma_us, late_us).pairs()
        if not pairs:
            return None
        delays = np.array([shots[shot] - triggers[trigger] for trigger, shot in pairs.items()])
        delay_us = float(np.median(delays))
        sigma_us = max(_SIGMA_US, 1.4826 * float(np.median(np.abs(delays - delay_us))))
    return _Delay(delay_us, sigma_us)


class _Search:
    """The least costs of pairings with one common delay: of all that comes before a place, and of all after it."""

    def __init__(self, triggers: Floats, shots: Floats, delay_us: float, sigma_us: float, late_us: float) -> None:
        self.delay_us = delay_us
        self._sigma_us, self._late_us = sigma_us, late_us
        self._triggers, self._shots = triggers + delay_us, shots
        self._before = self._rows(self._triggers, shots, 1)
        self.cost = _at(self._before[-1], len(shots))

    def _costs(self, away_us: Floats) -> Floats:
        """Of shots so long after where their trigger has them expected."""
        costs = np.minimum((away_us / self._sigma_us) ** 2, _MOST)
        return np.where((away_us < -_EARLY_US) | (away_us > self._late_us), np.inf, costs)

    def _rows(self, triggers: Floats, shots: Floats, sign: int) -> list[_Row]:
        """The least costs of the first 0, 1, … triggers with each number of shots; `sign` -1: time runs backwards."""
        reach_us = max(self._late_us, _EARLY_US)
        low = np.searchsorted(shots, triggers - reach_us).tolist()
        high = np.searchsorted(shots, triggers + reach_us, side="right").tolist()
        high[-1] = len(shots)
        rows: list[_Row] = [(0, _LEFT_OVER * np.arange(high[0] + 1))]
        for place, (least, most) in enumerate(zip(low, high, strict=True)):
            begins, before = rows[-1]
            row = np.full(max(most, begins + len(before) - 1) - begins + 1, np.inf)
            row[: len(before)] = before + _LEFT_OVER
            taken = shots[begins : begins + min(len(before), len(row) - 1)]
            paired = before[: len(taken)] + self._costs(sign * (taken - triggers[place]))
            row[1 : len(taken) + 1] = np.minimum(row[1 : len(taken) + 1], paired)
            rising = _LEFT_OVER * np.arange(len(row))
            row = np.minimum.accumulate(row - rising) + rising
            rows.append((least, row[least - begins : most - begins + 1]))
        return rows

    def pairs(self) -> dict[int, int]:
        """The shot of each trigger in the cheapest pairing."""
        found, shot = {}, len(self._shots)
        for trigger in range(len(self._triggers) - 1, -1, -1):
            while True:
                cost = _at(self._before[trigger + 1], shot)
                if shot and _same(cost, _at(self._before[trigger], shot - 1) + self._pair_cost(trigger, shot - 1)):
                    shot -= 1
                    found[trigger] = shot
                    break
                if _same(cost, _at(self._before[trigger], shot) + _LEFT_OVER):
                    break
                shot -= 1
        return dict(sorted(found.items()))

    def _pair_cost(self, trigger: int, shot: int) -> float:
        away_us = float(self._shots[shot] - self._triggers[trigger])
        within = -_EARLY_US <= away_us <= self._late_us
        return min((away_us / self._sigma_us) ** 2, _MOST) if within else math.inf

    def likely(self) -> tuple[set[int], set[int], set[tuple[int, int]]]:
        """Triggers left over, shots left over, and pairs, of any pairing that costs hardly more than the cheapest."""
        number, count, most = len(self._triggers), len(self._shots), self.cost + _NEAR
        after = self._rows(-self._triggers[::-1], -self._shots[::-1], -1)
        triggers: set[int] = set()
        shots: set[int] = set()
        pairs: set[tuple[int, int]] = set()
        for place in range(number + 1):
            begins, before = self._before[place]
            for shot, cost in enumerate(before.tolist(), begins):
                if cost > most:
                    continue
                if shot < count and cost + _LEFT_OVER + _at(after[number - place], count - shot - 1) <= most:
                    shots.add(shot)
                if place == number:
                    continue
                rest = after[number - place - 1]
                if cost + _LEFT_OVER + _at(rest, count - shot) <= most:
                    triggers.add(place)
                if shot < count and cost + self._pair_cost(place, shot) + _at(rest, count - shot - 1) <= most:
                    pairs.add((place, shot))
        return triggers, shots, pairs


def _same(a: float, b: float) -> bool:
    return b < math.inf and abs(a - b) < _SAME


def _at(row: _Row, shots: int) -> float:
    begins, costs = row
    return float(costs[shots - begins]) if 0 <= shots - begins < len(costs) else math.inf


def _with_doubts(search: _Search, others: Sequence[_Search]) -> Pairing:
    """The cheapest pairing, with what `likely` pairings of it and of other delays say instead."""
    pairs = search.pairs()
    triggers, shots, likely = search.likely()
    taken = set(pairs.values())
    left = set(range(len(search._triggers))) - set(pairs)
    unmade = set(range(len(search._shots))) - taken
    all_triggers = left | set(pairs)
    instead, beside = _by_nearest(left, triggers), _by_nearest(unmade, shots)
    of = {trigger: {place for place, shot in likely if shot == pairs[trigger]} for trigger in pairs}
    for by in (other.pairs() for other in others):
        lost, made = all_triggers - set(by), set(by.values())
        for one in left - lost:
            instead[one] |= lost - left
        for one in unmade & made:
            beside[one] |= taken - made
        for place, shot in by.items():
            for trigger in (trigger for trigger, mine in pairs.items() if mine == shot):
                of[trigger].add(place)
    return Pairing(
        pairs,
        search.delay_us,
        {one: tuple(sorted(found - left)) for one, found in instead.items()},
        {one: tuple(sorted(found - unmade)) for one, found in beside.items()},
        {one: tuple(sorted(found - {one})) for one, found in of.items()},
    )


def _by_nearest(left: set[int], likely: set[int]) -> dict[int, set[int]]:
    """The likely ones next to each that is left over."""
    found: dict[int, set[int]] = {one: set() for one in sorted(left)}
    for other in likely - left if left else ():
        found[min(found, key=lambda one: abs(one - other))].add(other)
    return found
