"""Match picked-up files with shots by order, count and the time that the camera wrote into each file.

The camera's clock is off by an unknown constant, and has whole seconds. Shots and files are matched in order, so that
one offset explains as many pairs as possible. A pair is certain when every best matching has it; the others are listed
as doubtful, never guessed.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from datetime import UTC, datetime
from statistics import median

import numpy as np
from numpy.typing import NDArray

from dappled import picture_order
from dappled.findings import Code, Finding, Subject, finding
from dappled.picture_order import PicturesInOrder

WINDOW_S = 1.6
"""How much offsets of true pairs differ: by the whole second of the camera's time, and the spread of its latency."""
_GRID_S = 0.1
_HAIR_S = 1e-5
PLAUSIBLE_S = 26 * 3600.0
"""A camera's clock is off by a time zone, daylight saving time or some minutes; by more where it was never set."""


@dataclass(frozen=True, slots=True)
class FiredShot:
    """A shot that waits for its file. `fired_s`: when the shutter was released, seconds of any clock."""

    index: int
    fired_s: float


@dataclass(frozen=True, slots=True)
class DatedFile:
    """A file that waits for its shot. `taken_s`: the camera's time as if it were UTC; None where the file has none."""

    name: str
    taken_s: float | None


@dataclass(frozen=True, slots=True)
class Matching:
    """`pairs` are certain. `shots` and `files` are left over; each doubtful file has a finding in `doubts`.

    `offset_s` is the camera's clock minus that of the shots, None where no pair is certain.
    """

    pairs: tuple[tuple[int, str], ...]
    shots: tuple[int, ...]
    files: tuple[str, ...]
    doubts: tuple[Finding, ...]
    offset_s: float | None = None


def match(
    shots: Sequence[FiredShot],
    files: Sequence[DatedFile],
    *,
    offset_s: float | None = None,
    plausible_s: float = PLAUSIBLE_S,
) -> Matching:
    """Match shots and files. Files without a time stay doubtful.

    `offset_s` is the camera's clock minus the shots' where it is known; else every offset up to `plausible_s` is tried.
    """
    shots = sorted(shots, key=lambda shot: (shot.fired_s, shot.index))
    dated = by_time([f for f in files if f.taken_s is not None]).items
    doubts = [finding(Code.PICTURE_UNDATED, Subject("picture", f.name)) for f in files if f.taken_s is None]
    fired = np.array([shot.fired_s for shot in shots], dtype=np.float64)
    taken = np.array([f.taken_s for f in dated], dtype=np.float64)
    if not len(fired) or not len(taken):
        return _left(shots, files, (), doubts, None)
    offsets = taken[None, :] - fired[:, None]
    starts = _starts(offsets, offset_s, plausible_s)
    if not len(starts):
        days = abs(float(np.median(offsets))) / 86400
        doubts.append(finding(Code.CAMERA_CLOCK_FAR, Subject("camera"), days=days))
        return _left(shots, files, (), doubts, None)
    sure, possible = _best(offsets, starts)
    doubts += _rivals(shots, dated, sure, possible)
    pairs = tuple((shots[i].index, dated[j].name) for i, j in sure)
    middle = float(np.median([offsets[i, j] for i, j in sure])) if sure else None
    return _left(shots, files, pairs, doubts, middle)


def in_order(shots: Sequence[FiredShot], files: Sequence[DatedFile]) -> tuple[tuple[int, str], ...] | None:
    """Pair by order alone where there are as many shots as files; else return None."""
    if len(shots) != len(files):
        return None
    fired = sorted(shots, key=lambda shot: (shot.fired_s, shot.index))
    return tuple((shot.index, f.name) for shot, f in zip(fired, by_time(files).items, strict=True))


def by_time(files: Sequence[DatedFile]) -> PicturesInOrder[DatedFile]:
    """The files in the order in which they were taken."""
    return picture_order.by_time(files, lambda f: f.name, lambda f: f.taken_s)


def disagreeing(
    pairs: Iterable[tuple[int, str]], shots: Sequence[FiredShot], files: Sequence[DatedFile], offset_s: float | None
) -> list[Finding]:
    """The pairs that the camera's clock doesn't confirm: they differ from `offset_s` (None: from their median)."""
    fired, taken = {shot.index: shot.fired_s for shot in shots}, {f.name: f.taken_s for f in files}
    times = [(index, fired[index], taken[name]) for index, name in pairs if index in fired]
    offsets = {index: taken_s - fired_s for index, fired_s, taken_s in times if taken_s is not None}
    middle_s = offset_s if offset_s is not None else median(offsets.values()) if offsets else 0.0
    return [
        finding(Code.FRAME_CLOCK_DISAGREES, Subject("frame", index), off_s=one_s - middle_s)
        for index, one_s in offsets.items()
        if abs(one_s - middle_s) > WINDOW_S
    ]


def seconds(taken: str | None) -> float | None:
    """Return EXIF's time, ISO 8601 without a zone, as seconds as if it were UTC; None where there is none."""
    try:
        return None if taken is None else datetime.fromisoformat(taken[:26]).replace(tzinfo=UTC).timestamp()
    except ValueError:
        return None


def _starts(offsets: NDArray[np.float64], known_s: float | None, plausible_s: float) -> NDArray[np.float64]:
    """Return where a window of offsets may begin, on a grid, ascending."""
    flat = np.sort(offsets.ravel())
    near = flat[np.abs(flat - known_s) <= WINDOW_S] if known_s is not None else flat[np.abs(flat) <= plausible_s]
    return np.unique(np.floor(near / _GRID_S) * _GRID_S)


def _bounds(offsets: NDArray[np.float64], starts: NDArray[np.float64]) -> NDArray[np.int64]:
    """Return the most pairs that each window can hold: the fewer of the shots and the files with an offset in it."""
    return np.minimum(_touched(offsets, starts), _touched(offsets.T, starts))


def _touched(offsets: NDArray[np.float64], starts: NDArray[np.float64]) -> NDArray[np.int64]:
    """Count the rows that have an offset in each window; slightly too many where one lies on its edge."""
    ordered = np.sort(offsets, axis=1)
    first = np.searchsorted(starts, ordered - WINDOW_S - _HAIR_S, "left")
    last = np.searchsorted(starts, ordered + _HAIR_S, "right")
    first[:, 1:] = np.maximum(first[:, 1:], last[:, :-1])  # each window once for a row
    some = first < last
    size = len(starts) + 1
    return np.cumsum(np.bincount(first[some], minlength=size) - np.bincount(last[some], minlength=size))[:-1]


def _best(offsets: NDArray[np.float64], starts: NDArray[np.float64]) -> tuple[list[tuple[int, int]], NDArray[np.bool_]]:
    """Return (pairs that all best matchings share, pairs that any has)."""
    best = 0
    bounds = _bounds(offsets, starts)
    seen: set[bytes] = set()
    found: list[tuple[set[tuple[int, int]], NDArray[np.bool_]]] = []
    for which in np.argsort(-bounds, kind="stable"):
        if bounds[which] < max(best, 1):
            break  # this window can't hold as many pairs, nor can any after it
        fits = (offsets >= starts[which]) & (offsets <= starts[which] + WINDOW_S)
        key = np.flatnonzero(fits).tobytes()
        if not key or key in seen:
            continue
        seen.add(key)
        length, forced, possible = _chains(fits)
        if length > best:
            best, found = length, []
        if length == best:
            found.append((forced, possible))
    shared = set.intersection(*(forced for forced, _ in found)) if found else set()
    anywhere = np.logical_or.reduce([possible for _, possible in found]) if found else np.zeros(offsets.shape, bool)
    return sorted(shared), anywhere


def _chains(fits: NDArray[np.bool_]) -> tuple[int, set[tuple[int, int]], NDArray[np.bool_]]:
    """Return the length of the longest matchings in order, the pairs that all of them have, and those that any has.

    A pair with `before` pairs at most before it and `after` at most after it is in a longest one when before + 1 +
    after is the whole length. Each longest one has exactly one pair with each number of pairs before it, so a pair that
    is alone with its number is in all of them.
    """
    before, after = _longest(fits), _longest(fits[::-1, ::-1])[::-1, ::-1]
    length = int(before[-1, -1])
    rank = before[:-1, :-1]
    possible = fits & (rank + 1 + after[1:, 1:] == length)
    ranks = rank[possible]
    alone = np.bincount(ranks, minlength=length) == 1 if len(ranks) else np.zeros(0, bool)
    forced = {(int(i), int(j)) for i, j in zip(*np.nonzero(possible), strict=True) if alone[rank[i, j]]}
    return length, forced, possible


def _longest(fits: NDArray[np.bool_]) -> NDArray[np.int64]:
    """Return (n + 1, m + 1): the most pairs in order among the first i shots and the first j files."""
    n, m = fits.shape
    table = np.zeros((n + 1, m + 1), dtype=np.int64)
    for i in range(n):
        step = np.maximum(table[i, 1:], table[i, :-1] + fits[i])
        table[i + 1, 1:] = np.maximum.accumulate(step)
    return table


def _rivals(
    shots: Sequence[FiredShot], files: Sequence[DatedFile], sure: list[tuple[int, int]], possible: NDArray[np.bool_]
) -> list[Finding]:
    settled = {j for _, j in sure}
    found = []
    for j, one in enumerate(files):
        if j in settled:
            continue
        candidates = [str(shots[int(i)].index) for i in np.nonzero(possible[:, j])[0]]
        if candidates:
            which = " or ".join(candidates[:4]) + (" …" if len(candidates) > 4 else "")
            found.append(finding(Code.PICTURE_RIVAL_SHOTS, Subject("picture", one.name), shots=which))
    return found


def _left(
    shots: Sequence[FiredShot],
    files: Sequence[DatedFile],
    pairs: tuple[tuple[int, str], ...],
    doubts: Sequence[Finding],
    offset_s: float | None,
) -> Matching:
    indices, names = {index for index, _ in pairs}, {name for _, name in pairs}
    return Matching(
        pairs,
        tuple(shot.index for shot in shots if shot.index not in indices),
        tuple(f.name for f in files if f.name not in names),
        tuple(doubts),
        offset_s,
    )
