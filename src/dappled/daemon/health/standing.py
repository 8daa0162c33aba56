"""The one list of what is found in a service: since when each finding stands; and which ones are new."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

from dappled import codec
from dappled.findings import Code, Finding, Level, Subject, above_note, in_order, words
from dappled.flight.records import BEGAN, ENDED

ALL_IS_WELL = "all is well"
_MOST_TIMES, _MOST_KINDS = 20, 200  # that the ledger is told of: some come and go all the time
_AGE = "age_s"  # beside a finding in the record


@dataclass(frozen=True, slots=True)
class StandingFinding:
    """A finding as it was seen last, and when it began (monotonic)."""

    finding: Finding
    began_ns: int

    def to_json(self, now_ns: int) -> dict[str, Any]:
        """As the health record has it, with its age."""
        return {**codec.plain(self.finding), _AGE: round((now_ns - self.began_ns) / 1e9, 1)}


class StandingFindings:
    """What stands. A finding begins when a part reports it first, is refreshed while the part does, and ends when the
    part sees that it is over and reports it no more: nothing ends because it is old."""

    def __init__(self) -> None:
        self._standing: dict[tuple[Code, Subject], StandingFinding] = {}

    def refresh(self, found: Iterable[Finding], now_ns: int) -> list[StandingFinding]:
        """All that is found now, worst first, then newest. Of two of one kind the first counts."""
        before, self._standing = self._standing, {}
        for one in found:
            known = before.get(one.kind)
            now = StandingFinding(one, now_ns) if known is None else replace(known, finding=one)
            self._standing.setdefault(one.kind, now)
        by_age = sorted(self._standing.values(), key=lambda one: one.began_ns)
        place = {one.kind: number for number, one in enumerate(in_order([each.finding for each in by_age]))}
        return sorted(by_age, key=lambda one: place[one.finding.kind])


def in_record(health: Mapping[str, Any]) -> list[Finding]:
    """The findings of a health record, in their order."""
    rows = ({name: one for name, one in row.items() if name != _AGE} for row in health["findings"])
    return [codec.read(Finding, row) for row in rows]


def unasked(health: Mapping[str, Any]) -> list[Finding]:
    """Those of a health record that a person is told without asking: what usually ends by itself may settle first."""
    rows = zip(in_record(health), health["findings"], strict=True)
    return [one for one, row in rows if row[_AGE] >= words()[one.code].settles_s]


class NewFindings:
    """Which findings above a note the last call did not have, or had at a lower level.

    One whose numbers have changed is still the same.
    """

    def __init__(self) -> None:
        self._known: dict[tuple[Code, Subject], Level] = {}

    def __bool__(self) -> bool:
        """Whether there was any at the last call."""
        return bool(self._known)

    def among(self, found: Sequence[Finding], *, again: bool = False) -> list[Finding]:
        """The new ones; with `again` all. These are the known ones from now on."""
        known, now = self._known, above_note(found)
        self._known = {one.kind: one.level for one in now}
        return [one for one in now if again or one.level > known.get(one.kind, Level.NOTE)]


class StandingEvents:
    """What the ledger is told: when each finding above a note began to stand, or rose; and when it was over."""

    def __init__(self) -> None:
        self._open: dict[tuple[Code, Subject], Finding] = {}
        self._times: Counter[tuple[Code, Subject]] = Counter()

    def of(self, health: Mapping[str, Any]) -> list[tuple[str, Finding]]:
        """(kind of event, finding) for what has changed since the last health record."""
        standing = {one.kind for one in above_note(in_record(health))}
        events = [(ENDED, one) for kind, one in self._open.items() if kind not in standing]
        self._open = {kind: one for kind, one in self._open.items() if kind in standing}
        for one in above_note(unasked(health)):
            known = self._open.get(one.kind)
            if known is not None and known.level >= one.level:
                continue
            if self._times[one.kind] < _MOST_TIMES and (one.kind in self._times or len(self._times) < _MOST_KINDS):
                self._times[one.kind] += 1
                self._open[one.kind] = one
                events.append((BEGAN, one))
        return events
