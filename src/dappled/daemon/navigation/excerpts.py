"""Parts of a history of samples: by packet number, by arrival, and around an instant."""

from __future__ import annotations

from bisect import bisect_left
from collections.abc import Sequence

from dappled.daemon.navigation.samples import NEAREST_NS, N, Numbered, S


def between(history: Sequence[N], first: int, limit: int) -> Sequence[N]:
    """Those of the packets first <= number < limit."""
    return history[place_of(history, first) : place_of(history, limit)]


def place_of(history: Sequence[Numbered], number: int) -> int:
    """Where packet `number` would stand."""
    return bisect_left(history, number, key=lambda sample: sample.number)


def latest(history: Sequence[N], window_ns: int) -> Sequence[N]:
    """Those that arrived in the last `window_ns` before the last one."""
    if not history:
        return history
    since = history[-1].stamp_ns - window_ns
    return history[bisect_left(history, since, key=lambda sample: sample.stamp_ns) :]


def beside(history: Sequence[N], stamp_ns: int, within_ns: int) -> Sequence[N]:
    """The last that arrived up to a time, and the first after it, each within so much of it."""
    at = bisect_left(history, stamp_ns, key=lambda sample: sample.stamp_ns)
    return [one for one in history[max(0, at - 1) : at + 1] if abs(one.stamp_ns - stamp_ns) <= within_ns]


def around_instant(history: Sequence[S], boot_ns: int, *, gap_ns: int) -> tuple[S, ...]:
    """The two samples around an instant, not more than `gap_ns` apart; or the nearest one, if it is near enough; or
    none. `boot_ns` of the history must rise."""
    at = bisect_left(history, boot_ns, key=lambda sample: sample.boot_ns)
    sides = tuple(history[max(0, at - 1) : at + 1])
    if len(sides) == 2 and sides[1].boot_ns - sides[0].boot_ns <= gap_ns:
        return sides
    nearest = min(sides, key=lambda sample: abs(sample.boot_ns - boot_ns), default=None)
    return () if nearest is None or abs(nearest.boot_ns - boot_ns) > NEAREST_NS else (nearest,)
