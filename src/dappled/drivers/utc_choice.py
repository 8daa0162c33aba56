"""Judge whether a date that a receiver or an autopilot says can be true: one rule for live links and for logs.

GPS counts weeks modulo 1024: a receiver whose firmware has outlived its count says a date 19.6 years too early.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from datetime import UTC, datetime
from enum import Enum, auto
from typing import Self

from dappled.findings import Code, Finding, Level, Subject, finding

RELEASED_NS = 1_767_225_600 * 10**9  # 2026-01-01: nobody flies this release before. Maintained with the version
LOGS_FROM_NS = 1_262_304_000 * 10**9  # 2010: autopilots of these kinds wrote no logs before
ROLLOVER_NS = 1024 * 7 * 86400 * 10**9
_DAY_NS = 86400 * 10**9
_GPS_EPOCH_NS = 315_964_800 * 10**9
_AGREES_NS = 2 * _DAY_NS  # other clocks have no zone, or were set by hand


class Date(Enum):
    """What is to be thought of a date."""

    TRUE = auto()
    MENDED = auto()  # 1024 weeks, or twice as many, are to be added: another clock says so
    ROLLED_OVER = auto()  # it would be possible so much later, but no other clock says so
    IMPOSSIBLE = auto()


@dataclass(frozen=True, slots=True)
class UtcBounds:
    """From when to when (ns) a date can be true, and dates by clocks that don't depend on the one that is judged."""

    floor_ns: int
    ceiling_ns: int
    known_ns: Sequence[int] = ()

    @classmethod
    def live(cls, known_ns: Sequence[int] = ()) -> Self:
        """Of a flight that takes place now, by a machine that may not know the time."""
        return cls(RELEASED_NS, RELEASED_NS + ROLLOVER_NS, known_ns)

    @classmethod
    def of_log(cls, now_ns: int, known_ns: Sequence[int] = ()) -> Self:
        """Of a flight that a log tells of."""
        return cls(LOGS_FROM_NS, now_ns + _DAY_NS, known_ns)

    def judge(self, utc_ns: int) -> Date:
        """What is to be thought of a date."""
        later_ns = utc_ns + rollovers(utc_ns, self.floor_ns) * ROLLOVER_NS
        can_be_later = utc_ns >= _GPS_EPOCH_NS and self.floor_ns <= later_ns < self.ceiling_ns
        if can_be_later and self._known(later_ns) and not self._known(utc_ns):
            return Date.MENDED
        if self.floor_ns <= utc_ns < self.ceiling_ns:
            return Date.TRUE
        return Date.ROLLED_OVER if can_be_later else Date.IMPOSSIBLE

    def _known(self, utc_ns: int) -> bool:
        return any(abs(one - utc_ns) <= _AGREES_NS for one in self.known_ns)


def rollovers(utc_ns: int, floor_ns: int = LOGS_FROM_NS) -> int:
    """After how many roll-overs, at least one, a date would be late enough.

    >>> rollovers(1_183_000_000 * 10**9), rollovers(545_000_000 * 10**9)  # 2007, and 1987
    (1, 2)
    """
    return max(1, -((utc_ns - floor_ns) // ROLLOVER_NS))


def rolled_over(subject: Subject, utc_ns: int, later_ns: int, *, mended: bool = False) -> Finding:
    """The finding about a date that stands 1024 weeks too early, or twice as many."""
    said, later = (datetime.fromtimestamp(ns // 10**9, UTC).strftime("%Y-%m-%d %H:%M") for ns in (utc_ns, later_ns))
    weeks = 1024 * round((later_ns - utc_ns) / ROLLOVER_NS)
    if mended:
        return finding(Code.TIME_WEEK_MENDED, subject, Level.NOTE, utc=said, later=later, weeks=weeks)
    return finding(Code.TIME_WEEK_ROLLOVER, subject, utc=said, later=later, weeks=weeks)
