"""One order of pictures: by the time in each where that is known, else by name.

Names are compared as people count: frame_2 stands before frame_10. Counters of cameras roll over: files from 9999 to
0001 and folders from 999 to 100 (DCF, JEITA CP-3461). A counter that has both ends, and a wide hole between them, has
rolled over.
"""

from __future__ import annotations

import re
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass
from itertools import pairwise
from typing import Generic, TypeVar

T = TypeVar("T")
_NUMBER = re.compile("([0-9]+)")
_FILE = re.compile(r"((?=[0-9]{0,3}[A-Z_])[A-Z0-9_]{4}|.*[^0-9]|)([0-9]{4})(\.[^.]*)?", re.DOTALL | re.IGNORECASE)
_SHORTER = {"dji_": 999}  # the last number of those that don't count to 9999
_FOLDER = re.compile(r"()([1-9][0-9]{2})(?=[^0-9]|$)(.*)", re.DOTALL)
_STEP_S = 1.0  # times have whole seconds
_JOIN = 0.05  # of the counter: at most so much is lost where it rolls over
_HOLE = 0.5  # of the counter: at least so much was not used

_Key = tuple[tuple[str | int, ...], str, str]
"""Text and numbers of a name by turns, its suffix, and the name itself."""


@dataclass(frozen=True, slots=True)
class PicturesInOrder(Generic[T]):
    """Pictures in order. `against`: (name, name after it, seconds that it is earlier) where a name's place contradicts
    the time in the picture most."""

    items: tuple[T, ...]
    against: tuple[str, str, float] | None = None


def by_name(items: Iterable[T], name: Callable[[T], str] = str) -> list[T]:
    """In the order of their names, paths with /."""
    parts = [(name(one).split("/"), one) for one in items]
    return [one for _, one in _sorted(parts, 0)]


def by_time(items: Iterable[T], name: Callable[[T], str], taken_s: Callable[[T], float | None]) -> PicturesInOrder[T]:
    """By time, those of one time by name. Pictures without a time keep the place that their names give them."""
    named = by_name(items, name)
    times = [taken_s(one) for one in named]
    dated = [(time_s, place) for place, time_s in enumerate(times) if time_s is not None]
    places = iter(sorted(dated))
    ordered = tuple(one if time_s is None else named[next(places)[1]] for one, time_s in zip(named, times, strict=True))
    steps = [(before_s - time_s, was, place) for (before_s, was), (time_s, place) in pairwise(dated)]
    back_s, was, place = max(steps, default=(0.0, 0, 0))
    return PicturesInOrder(ordered, (name(named[was]), name(named[place]), back_s) if back_s >= _STEP_S else None)


def _sorted(items: Sequence[tuple[list[str], T]], depth: int) -> list[tuple[list[str], T]]:
    """Sort by the part of the path at this depth, then by those below it."""
    at: dict[tuple[str, bool], list[tuple[list[str], T]]] = {}
    for one in items:
        at.setdefault((one[0][depth], len(one[0]) == depth + 1), []).append(one)
    keys = {(name, True): key for name, key in _keys({name for name, file in at if file}, _FILE, 1, 9999).items()}
    keys |= {(name, False): key for name, key in _keys({name for name, f in at if not f}, _FOLDER, 100, 999).items()}
    found: list[tuple[list[str], T]] = []
    for place in sorted(at, key=keys.__getitem__):
        found += at[place] if place[1] else _sorted(at[place], depth + 1)
    return found


def _keys(names: Iterable[str], counter: re.Pattern[str], first: int, last: int) -> Mapping[str, _Key]:
    """What to sort each name by."""
    names = list(names)
    counted: dict[str, list[int]] = {}
    longer: set[str] = set()
    for name in names:
        if found := counter.fullmatch(name):
            counted.setdefault(found[1].casefold(), []).append(int(found[2]))
        elif more := re.match(r"(.*[^0-9]|)[0-9]{5,}(\.[^.]*)?$", name, re.DOTALL):
            longer.add(more[1].casefold())  # frame_9999 goes on as frame_10000
    ends = {text: _SHORTER.get(text, last) for text in counted}
    ends = {text: end if max(counted[text]) <= end else last for text, end in ends.items()}
    after = {text: _rolled_over(numbers, first, ends[text]) for text, numbers in counted.items() if text not in longer}
    return {name: _key(name, counter.fullmatch(name), after, last - first + 1) for name in names}


def _key(name: str, found: re.Match[str] | None, after: Mapping[str, int], size: int) -> _Key:
    counted = name
    if found and int(found[2]) < after.get(found[1].casefold(), 0):
        counted = f"{found[1]}{int(found[2]) + size}{found[3] or ''}"
    stem, dot, suffix = counted.casefold().rpartition(".")
    parts = _NUMBER.split(stem if dot else suffix)
    return tuple(int(part) if at % 2 else part for at, part in enumerate(parts)), suffix if dot else "", name


def _rolled_over(numbers: Sequence[int], first: int, last: int) -> int:
    """Numbers below this one come after the counter's end; 0 where it has not rolled over."""
    size = last - first + 1
    there = sorted(set(numbers))
    join = there[0] - first + last - there[-1]
    hole, begin = max(((b - a, b) for a, b in pairwise(there)), default=(0, 0))
    return begin if hole >= _HOLE * size and join <= _JOIN * size else 0
