"""Compare every row of a ledger with the ledger's hash chain."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass

from dappled.flight import chain
from dappled.flight.chain import ChainLink, Column
from dappled.flight.errors import FlightError
from dappled.flight.stored_rows import StoredRow, StoredRows
from dappled.flight.tables import CHANGED_LATER, DEFINITIONS, KEYS


@dataclass(frozen=True, slots=True)
class ChainFindings:
    """What the chain shows. `links` are as they are stored, by number."""

    links: dict[int, ChainLink]
    problems: tuple[str, ...]


def compare(stored: StoredRows) -> ChainFindings:
    """Follow the chain, and compare each row of each table with its last link. Raises FlightError where the chain
    itself can't be read."""
    definitions = stored.definitions()
    if "chain" not in {row[0] for row in definitions}:
        return ChainFindings({}, ("the chain was removed from the ledger",))
    links = [ChainLink(*row) for row in stored.links()]  # type: ignore[arg-type]  # a damaged one has other types; it won't match
    problems = [*_broken(links)]
    latest: dict[str, dict[str, str]] = {}
    for link in links:
        keys = latest.setdefault(link.subject, {})
        if link.key in keys and link.subject in KEYS and link.subject not in CHANGED_LATER:
            problems.append(f"the row of {link.subject} {_shown(link.key)} was written again, which dappled never does")
        keys[link.key] = link.sha256
    problems += _differences("definition", latest.get(DEFINITIONS, {}), ((row[:1], row) for row in definitions))
    for table in KEYS:
        try:
            problems += _differences(f"row of {table}", latest.get(table, {}), stored.keyed_rows(table))
        except FlightError as error:
            problems.append(f"the rows of {table} can't be compared with the chain: {error}")
    return ChainFindings({link.number: link for link in links}, tuple(problems))


def _broken(links: Sequence[ChainLink]) -> Iterator[str]:
    """A sentence for each place where the chain does not hold."""
    last: ChainLink | None = None
    for link in links:
        expected = 1 if last is None else last.number + 1
        if link.number != expected:
            yield f"the chain lacks links: number {expected} is followed by {link.number}"
        elif chain.follow(last, link.subject, link.key, link.sha256) != link:
            yield f"link {link.number} of the chain ({link.subject} {link.key}) does not follow from the one before it"
        last = link
    if last is None:
        yield "the chain is empty"


def _differences(
    what: str, latest: dict[str, str], rows: Iterable[tuple[Sequence[Column], StoredRow]]
) -> Iterator[str]:
    """Sentences for the rows that were changed or added since they were written, and for those that are missing."""
    left, changed, added = dict(latest), [], []
    for key, row in rows:
        name = chain.json_array(key)
        sha256 = left.pop(name, None)
        if sha256 is None:
            added.append(name)
        elif sha256 != chain.row_digest(row):
            changed.append(name)
    for keys, words in (
        (changed, "changed since dappled wrote it"),
        (added, "added by something other than dappled"),
        (left, "removed since dappled wrote it"),
    ):
        for name in keys:
            yield f"the {what} {_shown(name)} was {words}"


def _shown(name: str) -> str:
    """A key for a sentence: without its brackets, and printable."""
    return str(name)[1:-1].encode("utf-8", "backslashreplace").decode()
