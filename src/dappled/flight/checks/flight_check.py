"""Check that every byte of a flight is intact, and that files, ledger, journal and telemetry agree."""

from __future__ import annotations

import hashlib
import json
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass, field, replace
from pathlib import Path

from dappled import durable
from dappled.confined import OutsideError
from dappled.errors import DappledError
from dappled.findings import Code, Finding, Level, Subject, Value, above_note, finding
from dappled.flight import layout, log_reading, provenance, pruning, seals
from dappled.flight.checks import chain_check, place_check, seal_check
from dappled.flight.checks.chain_check import ChainFindings
from dappled.flight.checks.place_check import PlaceFindings
from dappled.flight.checks.seal_check import LedgerBytes, SealFindings, Vouched
from dappled.flight.layout import FlightFolder
from dappled.flight.ledger import LedgerReader
from dappled.flight.provenance import HeldDigests
from dappled.flight.pruning import Removed
from dappled.flight.seal_key import SealKey
from dappled.flight.seals import SEAL
from dappled.flight.stored_rows import StoredRows


@dataclass(frozen=True, slots=True)
class CheckReport:
    """What was checked and what was found: `problems`, and `notes`, which are no faults. `offloaded` counts the
    files that were removed here after their copies were proved: they were not read. `verdict` says what the seals
    vouch for."""

    flight: str
    files: int
    size: int
    telemetry_packets: int
    problems: tuple[Finding, ...]
    notes: tuple[Finding, ...]
    offloaded: int
    vouched: Vouched
    verdict: Finding

    @property
    def intact(self) -> bool:
        return not self.problems


@dataclass(slots=True)
class _Counts:
    """How much was read: files with a row and their bytes, and telemetry packets; and which files are `elsewhere`."""

    files: int = 0
    size: int = 0
    packets: int = 0
    elsewhere: Mapping[str, Removed] = field(default_factory=dict)


def check(path: Path, key: SealKey | None = None) -> CheckReport:
    """Read a whole flight and compare its parts; `key` verifies the signatures of its seals. Raises FlightError when it
    is not a flight."""
    folder = layout.open_folder(path)
    found: list[Finding] = []
    counts = _Counts()
    sealed = SealFindings("not sealed", finding(Code.SEAL_NONE, SEAL))
    with _examining("flight.toml", found):
        layout.read_facts(folder)
    place = PlaceFindings()
    closed, recorded_as, known = False, "", frozenset[str]()
    with _examining("the folder", found):
        place = place_check.look(folder)
    if place.rollback is not None:
        found.append(place.rollback)
    else:
        with _examining("the ledger", found):
            before = LedgerBytes.of(folder)
            chained = _chained(folder, found)
            with _examining("the flight", found), LedgerReader.open(folder.ledger) as ledger:
                closed, recorded_as = "closed_utc_ns" in ledger.facts(), seals.of_flight(ledger.facts())
                known = frozenset(row.name for row in ledger.files())
                _compare(folder, ledger, counts, found)
                with _examining("the telemetry", found):
                    found += chain_check.compare_log(folder.telemetry, chained.links)
                with _examining("the seals", found):
                    sealed = seal_check.compare(folder, ledger, chained.links, before, key)
    found += sealed.found
    found += place_check.compare(place, folder, recorded_as, known, closed=closed, at_work=sealed.unsealed > 0)
    return CheckReport(
        flight=folder.name,
        files=counts.files,
        size=counts.size,
        telemetry_packets=counts.packets,
        problems=tuple(above_note(found)),
        notes=tuple(one for one in found if one.level is Level.NOTE),
        offloaded=len(counts.elsewhere),
        vouched=sealed.vouched,
        verdict=sealed.verdict,
    )


def _compare(
    folder: FlightFolder,
    ledger: LedgerReader,
    counts: _Counts,
    found: list[Finding],
) -> None:
    """Compare files, journal and telemetry with the ledger. Raises FlightError where that can't be read."""
    facts = ledger.facts()
    closed = "closed_utc_ns" in facts
    if not closed:
        level = Level.NOTE if layout.is_locked(folder.path.parent) else Level.STOP
        found.append(finding(Code.FLIGHT_UNCLOSED, Subject("flight"), level))
    with _examining("the offloaded files", found):
        counts.elsewhere = pruning.removed(folder)
        found += _where(counts.elsewhere)
    with _examining("the files", found):
        found += _files(folder, ledger, counts)
    with _examining("the shot journal", found):
        found += _shots(folder, ledger)
    with _examining("the telemetry", found):
        counts.packets = _telemetry(folder, ledger, found)
    with _examining("the tags", found):
        found += _tags(ledger)


@contextmanager
def _examining(what: str, found: list[Finding]) -> Iterator[None]:
    """Whatever a damaged value leads to is a finding, and the rest is examined all the same."""
    try:
        yield
    except DappledError as error:
        found.append(finding(Code.FLIGHT_PART_UNREAD, Subject("part", what), why=error))
    except (
        ValueError,
        TypeError,
        LookupError,
        AttributeError,
        ArithmeticError,
        RecursionError,
        OSError,
        MemoryError,
    ) as error:
        found.append(finding(Code.FLIGHT_PART_DAMAGED, Subject("part", what), part=what, why=error))


def _chained(folder: FlightFolder, found: list[Finding]) -> ChainFindings:
    """What SQLite, the records' own digests, and the chain say about the ledger. Raises FlightError."""
    with StoredRows.open(folder.ledger) as stored:
        found += [finding(Code.LEDGER_DAMAGED, Subject("ledger"), why=why) for why in stored.damage()]
        chained = chain_check.compare(stored)
        found += [*chained.problems, *_records(stored)]
    return chained


def _where(elsewhere: Mapping[str, Removed]) -> Iterator[Finding]:
    """The folders that frames were offloaded to."""
    for destination in sorted({one.destination for one in elsewhere.values()}):
        names = sorted(name for name, one in elsewhere.items() if one.destination == destination)
        which = names[0] if len(names) == 1 else f"{names[0]} to {names[-1]}"
        facts: dict[str, Value] = {"files": len(names), "which": which, "there": destination, "record": pruning.RECORD}
        yield Finding(Code.FLIGHT_OFFLOADED, Subject("folder", destination), facts)


def _files(folder: FlightFolder, ledger: LedgerReader, counts: _Counts) -> Iterator[Finding]:
    """What is wrong with files that the ledger holds digests of, but the telemetry. Those with a row are counted."""
    for name, one in provenance.held(ledger).items():
        if name in counts.elsewhere or name == folder.telemetry.name:
            continue
        size, problem = _read(folder, name, one)
        if one.size is not None:
            counts.files, counts.size = counts.files + 1, counts.size + size
        yield from [problem] if problem else []


def _read(folder: FlightFolder, name: str, held: HeldDigests) -> tuple[int, Finding | None]:
    """(bytes read, problem) of one file."""
    about = Subject("file", name)
    try:
        path = folder.file(name)
        found = path.stat().st_size
        if held.size not in (found, None):
            return found, finding(Code.FILE_OTHER_SIZE, about, name=name, bytes=found, noted=held.size)
        right = durable.hash_file(path) in held.right
        return found, None if right else finding(Code.FILE_CHANGED, about, name=name)
    except OutsideError as error:
        return 0, finding(Code.FILE_OUTSIDE, about, why=error)
    except FileNotFoundError:
        return 0, finding(Code.FILE_MISSING, about, name=name)
    except OSError as error:
        return 0, finding(Code.FILE_UNREADABLE, about, name=name, why=error)


def _shots(folder: FlightFolder, ledger: LedgerReader) -> Iterator[Finding]:
    journal = log_reading.read_journal(folder.journal)
    yield from journal.problems  # notes: where a torn line hid a shot, that is a problem below
    rows = {row.shot.index: row for row in ledger.shots()}
    noted = {shot.index: shot for shot in journal.shots}
    framed = {frame.index for frame in ledger.frames()}
    for index in sorted(rows.keys() | noted.keys()):
        row, about = rows.get(index), Subject("shot", index)
        if row is None:
            yield finding(Code.SHOT_NOT_IN_LEDGER, about, shot=index)
        elif index not in noted:
            yield finding(Code.SHOT_NOT_IN_JOURNAL, about, shot=index)
        elif noted[index] != row.shot:
            yield finding(Code.SHOT_DIFFERS, about, shot=index)
        if row is not None and (row.state == "safe") != (index in framed):
            frames = "a" if index in framed else "no"
            yield finding(Code.SHOT_CONTRADICTED, about, shot=index, state=row.state, frames=frames)


def _records(stored: StoredRows) -> Iterator[Finding]:
    """Poses and tags against their digests, and results against their hashes."""
    for table in ("poses", "tags"):
        for (index,), (_, sha256, text) in stored.keyed_rows(table):
            if hashlib.sha256(str(text).encode("utf-8", "surrogateescape")).hexdigest() != sha256:
                record, shown = table[:-1], repr(index)
                yield finding(Code.LEDGER_DIGEST_WRONG, Subject(record, shown), record=record, frame=shown)
    for (index, run), (_, _, sha256, text) in stored.keyed_rows("results"):
        try:
            noted = json.loads(str(text))["slices_sha256"]
        except (ValueError, TypeError, KeyError, RecursionError):
            noted = None
        if noted != sha256:
            yield finding(Code.LEDGER_TWO_HASHES, Subject("result", repr(index)), frame=repr(index), run=str(run))


def _tags(ledger: LedgerReader) -> Iterator[Finding]:
    """Tags that are about other bytes than their frame's."""
    frames = {frame.index: frame.sha256 for frame in ledger.frames()}
    for index, tag in ledger.tags().items():
        if frames.get(index) != tag.frame_sha256:
            yield finding(Code.TAG_OTHER_BYTES, Subject("tag", index), frame=index)


def _telemetry(folder: FlightFolder, ledger: LedgerReader, found: list[Finding]) -> int:
    facts, about = ledger.facts(), Subject("file", folder.telemetry.name)
    if not folder.telemetry.exists():
        found.append(finding(Code.TELEMETRY_MISSING if "telemetry_sha256" in facts else Code.TELEMETRY_NONE, about))
        return 0
    gaps: list[Finding] = []
    summary = log_reading.summarise(folder.telemetry, gaps.append)
    level = Level.NOTE  # they were there when the flight was closed
    if facts.get("telemetry_sha256") not in (None, summary.sha256):
        found.append(finding(Code.TELEMETRY_CHANGED, about))
        level = Level.STOP
    found += [replace(one, level=level) for one in gaps]
    return summary.packets
