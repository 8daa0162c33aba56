"""Compare every row of a ledger, and every block of the telemetry log, with the ledger's hash chain."""

from __future__ import annotations

import hashlib
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

from dappled import codec, durable
from dappled.bounds.parsing import check_stored
from dappled.findings import Code, Finding, Level, Subject, Value, finding
from dappled.flight import chain
from dappled.flight.chain import ChainLink, Column
from dappled.flight.errors import FlightError, disk_errors
from dappled.flight.stored_rows import StoredRow, StoredRows
from dappled.flight.tables import CHANGED_LATER, DEFINITIONS, KEYS, TELEMETRY

CHAIN = Subject("chain")


@dataclass(frozen=True, slots=True)
class ChainFindings:
    """What the chain shows. `links` are as they are stored, by number."""

    links: dict[int, ChainLink]
    problems: tuple[Finding, ...]


def compare(stored: StoredRows) -> ChainFindings:
    """Follow the chain, and compare each row of each table with its last link. Raises FlightError where the chain
    itself can't be read."""
    definitions = stored.definitions()
    if "chain" not in {row[0] for row in definitions}:
        return ChainFindings({}, (finding(Code.CHAIN_REMOVED, CHAIN),))
    links = [ChainLink(*row) for row in stored.links()]  # type: ignore[arg-type]  # a damaged one has other types; it won't match
    problems = [*_broken(links)]
    latest: dict[str, dict[str, str]] = {}
    for link in links:
        keys = latest.setdefault(link.subject, {})
        if link.key in keys and link.subject in KEYS and link.subject not in CHANGED_LATER:
            problems.append(_row(Code.LEDGER_ROW_REWRITTEN, f"row of {link.subject}", link.key))
        keys[link.key] = link.sha256
    problems += _differences("definition", latest.get(DEFINITIONS, {}), ((row[:1], row) for row in definitions))
    for table in KEYS:
        try:
            problems += _differences(f"row of {table}", latest.get(table, {}), stored.keyed_rows(table))
        except FlightError as error:
            problems.append(finding(Code.LEDGER_ROWS_UNREAD, Subject("table", table), table=table, why=error))
    return ChainFindings({link.number: link for link in links}, tuple(problems))


def compare_log(path: Path, links: Mapping[int, ChainLink]) -> Iterator[Finding]:
    """The blocks of the telemetry log that differ from their links. Raises FlightError when it can't be read."""
    blocks = [link for link in links.values() if link.subject == TELEMETRY]
    if not blocks:
        return
    about = Subject("file", path.name)
    with disk_errors("read the telemetry", path):
        try:
            with open(path, "rb", opener=durable.plain_file) as file:
                size = check_stored(file.fileno())
                for link in blocks:
                    start, end = _range(link.key)
                    file.seek(min(start, size))
                    if hashlib.sha256(file.read(min(end, size) - min(start, size))).hexdigest() != link.sha256:
                        yield finding(Code.TELEMETRY_BLOCK_CHANGED, about, name=path.name, start=start, end=end)
        except FileNotFoundError:
            yield finding(Code.TELEMETRY_BLOCKS_MISSING, about, name=path.name, blocks=len(blocks))


def _broken(links: Sequence[ChainLink]) -> Iterator[Finding]:
    """The places where the chain does not hold."""
    last: ChainLink | None = None
    for link in links:
        expected = 1 if last is None else last.number + 1
        if link.number != expected:
            yield finding(Code.CHAIN_LACKS, CHAIN, expected=expected, found=str(link.number))
        elif chain.follow(last, link.subject, link.key, link.sha256) != link:
            facts: dict[str, Value] = {"link": str(link.number), "of": str(link.subject), "key": str(link.key)}
            yield Finding(Code.CHAIN_BROKEN, Subject("link", str(link.number)), facts, Level.STOP)
        last = link
    if last is None:
        yield finding(Code.CHAIN_EMPTY, CHAIN)


def _differences(
    what: str, latest: dict[str, str], rows: Iterable[tuple[Sequence[Column], StoredRow]]
) -> Iterator[Finding]:
    """The rows that were changed or added since they were written, and for those that are missing."""
    left, changed, added = dict(latest), [], []
    for key, row in rows:
        name = chain.json_array(key)
        sha256 = left.pop(name, None)
        if sha256 is None:
            added.append(name)
        elif sha256 != chain.row_digest(row):
            changed.append(name)
    for keys, code in (
        (changed, Code.LEDGER_ROW_CHANGED),
        (added, Code.LEDGER_ROW_ADDED),
        (left, Code.LEDGER_ROW_REMOVED),
    ):
        yield from (_row(code, what, name) for name in keys)


def _row(code: Code, what: str, name: str) -> Finding:
    return finding(code, Subject(what, _shown(name)), row=what, key=_shown(name))


def _shown(name: str) -> str:
    """A key for a sentence: without its brackets, and printable."""
    return str(name)[1:-1].encode("utf-8", "backslashreplace").decode()


def _range(key: str) -> tuple[int, int]:
    """First byte and end of a block; an empty one where the link was damaged, which its chain tells."""
    try:
        start, end = codec.read_json(tuple[int, int], key)
    except codec.CodecError:
        return 0, 0
    return (start, end) if 0 <= start <= end else (0, 0)
