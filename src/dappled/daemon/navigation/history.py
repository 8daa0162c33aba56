"""Samples in the order of their packets, and those around an instant. Pure functions on sequences."""

from __future__ import annotations

from bisect import bisect_left
from collections.abc import Sequence
from typing import Protocol, TypeVar

MOST = 2**16  # of one kind: three minutes at 360 Hz, more than any autopilot sends


class Numbered(Protocol):
    """Something from one packet of the telemetry log: its running number, and when it came."""

    @property
    def number(self) -> int: ...

    @property
    def stamp_ns(self) -> int: ...


class Sample(Numbered, Protocol):
    """One with the vehicle's own time."""

    @property
    def boot_ns(self) -> int: ...


N = TypeVar("N", bound=Numbered)
S = TypeVar("S", bound=Sample)


def between(history: Sequence[N], first: int, limit: int) -> Sequence[N]:
    """Those of the packets first <= number < limit."""
    return history[place(history, first) : place(history, limit)]


def place(history: Sequence[Numbered], number: int) -> int:
    """Where packet `number` would stand."""
    return bisect_left(history, number, key=lambda sample: sample.number)


def last(history: Sequence[N], window_ns: int) -> Sequence[N]:
    """Those that came in the last `window_ns` before the last one."""
    if not history:
        return history
    since = history[-1].stamp_ns - window_ns
    return history[bisect_left(history, since, key=lambda sample: sample.stamp_ns) :]


def around(history: Sequence[S], boot_ns: int, *, gap_ns: int, nearest_ns: int) -> tuple[S, ...]:
    """The two samples around an instant, not more than `gap_ns` apart; or the nearest one, if it is near enough; or
    none. `boot_ns` of the history must rise."""
    at = bisect_left(history, boot_ns, key=lambda sample: sample.boot_ns)
    sides = tuple(history[max(0, at - 1) : at + 1])
    if len(sides) == 2 and sides[1].boot_ns - sides[0].boot_ns <= gap_ns:
        return sides
    nearest = min(sides, key=lambda sample: abs(sample.boot_ns - boot_ns), default=None)
    if nearest is None or abs(nearest.boot_ns - boot_ns) > nearest_ns:
        return ()
    return (nearest,)


def keep(history: list[N], sample: N) -> None:
    """Append. `prune` bounds a history by time; of a flood only the newest are kept as well."""
    history.append(sample)
    if len(history) > MOST:
        del history[: MOST // 4]


def prune(history: list[N], before_ns: int) -> None:
    """Forget what came before."""
    del history[: bisect_left(history, before_ns, key=lambda sample: sample.stamp_ns)]
