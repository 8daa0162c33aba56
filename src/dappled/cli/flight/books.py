"""`dappled flight report --log`: the autopilot's own log beside the requests and the files of a flight."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterator, Sequence
from pathlib import Path

from dappled import codec
from dappled.cli.table import words_only
from dappled.cli.verb import Report
from dappled.errors import counted

if not words_only:
    from dappled.daemon.replay import three_books
    from dappled.daemon.replay.three_books import ThreeBooks


def compared(flight: Path, logs: Sequence[Path]) -> Report:
    """Compare a flight with logs of its autopilot. Raises DappledError."""
    found = three_books.reconcile(flight, logs)
    values = {"files_read": [str(path) for path in logs], **codec.plain(found), "balanced": found.balanced}
    values["imbalances"] = [{**codec.plain(one), "text": one.text()} for one in found.imbalances]
    return Report(values, tuple(_lines(found, logs)), found.findings, failed=not found.balanced)


def _lines(found: ThreeBooks, logs: Sequence[Path]) -> Iterator[str]:
    names = " and ".join(path.name for path in logs)
    pin = "" if found.contacts is None else f" ({counted(found.contacts, 'contact')} at its feedback pin)"
    triggers = counted(found.triggers, "trigger", 6)
    yield f"  {triggers} in {found.by}'s {names}{pin}: {counted(found.shots, 'shot')}, {counted(found.files, 'file')}"
    if found.elsewhere:
        yield f"  {counted(found.elsewhere, 'trigger', 6)} more in the log, before or after this flight was recorded"
    yield from (one.text() for one in found.imbalances)
    if found.uncovered:
        first, last = min(found.uncovered), max(found.uncovered)
        names = f"shot {first}" if first == last else f"shots {first} to {last}"
        yield f"not judged: {counted(len(found.uncovered), 'shot')} ({names}) at times that the log does not hold"
    if found.balanced:
        yield "the three books balance: the autopilot's triggers, the requests and the files"
        return
    if found.findings and not found.imbalances:
        yield "the three books can't be compared"
        return
    kinds = Counter(one.kind for one in found.imbalances)
    counts = [f"{count} {kind}" for kind, count in kinds.items()]
    counts += [f"{len(found.uncovered)} not judged"] if found.uncovered else []
    yield f"THE THREE BOOKS DO NOT BALANCE: {', '.join(counts)}"
