"""What became of everybody's wishes: a flight's books by source, for `dappled flight report`."""

from __future__ import annotations

import re
from collections import Counter
from collections.abc import Iterable
from dataclasses import dataclass
from pathlib import Path

from dappled.flight import layout
from dappled.flight.entries import Event
from dappled.flight.ledger import LedgerReader

_REFUSED = re.compile(r"\S+ from (?P<source>\S+): ")  # as the daemon notes it: kind, source, reason


@dataclass(frozen=True, slots=True)
class Account:
    """One source's wishes ("mavlink:1/1", "console" …). wishes = refused + shots; shots = safe + failed + open."""

    source: str
    wishes: int
    refused: int
    shots: int
    safe: int
    failed: int
    open: int
    tagged: int
    decoded: int


def accounts(path: Path) -> tuple[Account, ...]:
    """The books of a flight, a line for each source in the order of their names. Raises FlightError."""
    with LedgerReader.open(layout.open_folder(path).ledger) as ledger:
        rows, tags, results = ledger.shots(), ledger.tags(), ledger.results()
        refused = _refused(ledger.events())
    counts: dict[str, Counter[str]] = {source: Counter(refused=count) for source, count in refused.items()}
    for row in rows:
        mine = counts.setdefault(row.shot.cause.source, Counter())
        mine["shots"] += 1
        mine[row.state if row.state in ("safe", "failed") else "open"] += 1
        mine["tagged"] += row.shot.index in tags
        mine["decoded"] += row.shot.index in results
    names = ("refused", "shots", "safe", "failed", "open", "tagged", "decoded")
    return tuple(
        Account(source, mine["refused"] + mine["shots"], *(mine[name] for name in names))
        for source, mine in sorted(counts.items())
    )


def _refused(events: Iterable[Event]) -> Counter[str]:
    """Refused wishes by source; one whose note says no source stands under "unknown"."""
    found: Counter[str] = Counter()
    for event in events:
        if event.kind == "refused":
            match = _REFUSED.match(event.text)
            found[match["source"] if match else "unknown"] += 1
    return found
