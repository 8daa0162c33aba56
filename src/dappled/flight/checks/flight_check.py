"""Check that every byte of a flight is intact, and that files, ledger, journal and telemetry agree."""

from __future__ import annotations

import hashlib
import json
import os
from collections.abc import Collection, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from dappled import durable
from dappled.confined import OutsideError
from dappled.errors import DappledError, counted
from dappled.findings import Code, Finding, finding, told
from dappled.flight import layout, log_reading, provenance, pruning, seals
from dappled.flight.checks import chain_check, place_check, seal_check, telemetry_check
from dappled.flight.checks.chain_check import ChainFindings
from dappled.flight.checks.place_check import PlaceFindings
from dappled.flight.checks.seal_check import SEAL, LedgerBytes, SealFindings, Vouched
from dappled.flight.errors import FlightError
from dappled.flight.layout import FlightFolder
from dappled.flight.ledger import LedgerReader
from dappled.flight.pruning import Removed
from dappled.flight.seal_key import SealKey
from dappled.flight.stored_rows import StoredRows


@dataclass(frozen=True, slots=True)
class CheckReport:
    """What was checked and what is wrong, in sentences; `notes` are no faults. `offloaded` counts the files that were
    removed here after their copies were proved: they were not read. `verdict` says what the seals vouch for."""

    flight: str
    files: int
    size: int
    telemetry_packets: int
    problems: tuple[str, ...]
    notes: tuple[str, ...]
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
    problems: list[str] = []
    notes: list[str] = []
    counts = _Counts()
    sealed = SealFindings("not sealed", finding(Code.SEAL_NONE, SEAL), (), ())
    with _examining("flight.toml", problems):
        layout.read_facts(folder)
    place = PlaceFindings((), (), (), (), None)
    closed, recorded_as = False, ""
    with _examining("the folder", problems):
        place = place_check.look(folder)
    with _examining("the ledger", problems):
        if place.rollback is not None:
            raise FlightError(place.rollback)
        before = LedgerBytes.of(folder)
        chained = _chained(folder, problems)
        with _examining("the flight", problems), LedgerReader.open(folder.ledger) as ledger:
            closed, recorded_as = "closed_utc_ns" in ledger.facts(), seals.of_flight(ledger.facts())
            _compare(folder, ledger, counts, problems, notes)
            with _examining("the telemetry", problems):
                problems += telemetry_check.compare(folder.telemetry, chained.links)
            with _examining("the seals", problems):
                sealed = seal_check.compare(folder, ledger, chained.links, before, key)
    wrong, odd = place_check.compare(place, folder, recorded_as, closed=closed, at_work=sealed.unsealed > 0)
    problems += [*sealed.problems, *wrong]
    notes += [*sealed.notes, *odd]
    return CheckReport(
        flight=folder.name,
        files=counts.files,
        size=counts.size,
        telemetry_packets=counts.packets,
        problems=tuple(problems),
        notes=tuple(notes),
        offloaded=len(counts.elsewhere),
        vouched=sealed.vouched,
        verdict=sealed.verdict,
    )


def _compare(
    folder: FlightFolder,
    ledger: LedgerReader,
    counts: _Counts,
    problems: list[str],
    notes: list[str],
) -> None:
    """Compare files, journal and telemetry with the ledger. Raises FlightError where that can't be read."""
    facts = ledger.facts()
    closed = "closed_utc_ns" in facts
    if not closed:
        (notes if layout.is_locked(folder.path.parent) else problems).append(
            "the flight is still being recorded, or was never closed: the next `dappled run` repairs it"
        )
    with _examining("the offloaded files", problems):
        counts.elsewhere = _elsewhere(folder, ledger)
        notes += _where(counts.elsewhere)
    with _examining("the files", problems):
        for size, problem in _files(folder, ledger, counts.elsewhere):
            counts.files, counts.size = counts.files + 1, counts.size + size
            problems += [problem] if problem else []
        problems += _names(folder, ledger, closed)
    with _examining("the inputs", problems):
        problems += _inputs(folder, facts)
    with _examining("the shot journal", problems):
        problems += _shots(folder, ledger, notes)
    with _examining("the telemetry", problems):
        counts.packets = _telemetry(folder, ledger, problems, notes)
    with _examining("the tags", problems):
        problems += _tags(ledger)


@contextmanager
def _examining(what: str, problems: list[str]) -> Iterator[None]:
    """Whatever a damaged value leads to is a finding, and the rest is examined all the same."""
    try:
        yield
    except DappledError as error:
        problems.append(str(error))
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
        problems.append(f"{what} can't be compared, a value in it is damaged: {error}")


def _chained(folder: FlightFolder, problems: list[str]) -> ChainFindings:
    """What SQLite, the records' own digests, and the chain say about the ledger. Raises FlightError."""
    with StoredRows.open(folder.ledger) as stored:
        problems += [f"the ledger is damaged: {text}" for text in stored.damage()]
        found = chain_check.compare(stored)
        problems += found.problems
        problems += _records(stored)
    return found


def _elsewhere(folder: FlightFolder, ledger: LedgerReader) -> dict[str, Removed]:
    """The files that were removed here after their copies were proved, as far as they are the ledger's and gone."""
    removed = pruning.removed(folder)
    rows = {row.name: row for row in ledger.files()}
    return {
        name: one
        for name, one in removed.items()
        if name in rows and one.sha256 == rows[name].sha256 and not folder.file(name).exists()
    }


def _where(elsewhere: Mapping[str, Removed]) -> Iterator[str]:
    """A sentence for each folder that frames were offloaded to."""
    for destination in sorted({one.destination for one in elsewhere.values()}):
        names = sorted(name for name, one in elsewhere.items() if one.destination == destination)
        which = names[0] if len(names) == 1 else f"{names[0]} to {names[-1]}"
        yield (
            f"{counted(len(names), 'file')} ({which}) were offloaded to {destination} and removed here: they were not "
            f"read, check them there ({pruning.RECORD} names each)"
        )


def _files(folder: FlightFolder, ledger: LedgerReader, elsewhere: Collection[str]) -> Iterator[tuple[int, str | None]]:
    """(bytes read, problem) for every file that the ledger acknowledges and that was not offloaded `elsewhere`."""
    for row in ledger.files():
        if row.name not in elsewhere:
            yield _read(folder, row.name, row.size, [row.sha256])


def _inputs(folder: FlightFolder, facts: Mapping[str, Any]) -> Iterator[str]:
    """A sentence for each input that differs from its hash. `read_facts` tells of a missing flight.toml."""
    for name, hashes in provenance.noted(facts).items():
        _, problem = _read(folder, name, None, hashes)
        if problem is not None and (name != folder.settings.name or folder.settings.exists()):
            yield problem


def _read(folder: FlightFolder, name: str, size: int | None, hashes: Sequence[str]) -> tuple[int, str | None]:
    """(bytes read, problem) of one file that the ledger holds hashes of, any of which is right."""
    try:
        path = folder.file(name)
        found = path.stat().st_size
        if size not in (found, None):
            return found, f"{name} has {found} bytes, the ledger says {size}"
        right = durable.hash_file(path) in hashes
        return found, None if right else f"{name} was changed: its SHA-256 is not the ledger's"
    except OutsideError as error:
        return 0, str(error)
    except FileNotFoundError:
        return 0, f"{name} is in the ledger, but the file is missing"
    except OSError as error:
        return 0, f"{name} can't be read: {error.strerror}"


def _names(folder: FlightFolder, ledger: LedgerReader, closed: bool) -> Iterator[str]:
    """Files that no row acknowledges. While a flight is recorded, one may be on its way."""
    known = {row.name for row in ledger.files()}
    try:
        names = sorted(os.listdir(folder.frames))
    except OSError as error:
        yield f"the folder frames can't be read: {error.strerror}"
        return
    for name in names:
        if durable.is_temporary(name):
            if closed:
                yield f"frames/{name} is a half-written file"
        elif f"frames/{name}" not in known and not name.endswith(layout.SIDECAR) and closed:
            yield f"frames/{name} is in no row of the ledger"


def _shots(folder: FlightFolder, ledger: LedgerReader, notes: list[str]) -> Iterator[str]:
    journal = log_reading.read_journal(folder.journal)
    notes.extend(journal.problems)  # a torn line; where it hid a shot, that is a problem below
    rows = {row.shot.index: row for row in ledger.shots()}
    noted = {shot.index: shot for shot in journal.shots}
    framed = {frame.index for frame in ledger.frames()}
    for index in sorted(rows.keys() | noted.keys()):
        row = rows.get(index)
        if row is None:
            yield f"shot {index} is in shots.jsonl, but not in the ledger"
        elif index not in noted:
            yield f"shot {index} is in the ledger, but not in shots.jsonl"
        elif noted[index] != row.shot:
            yield f"shot {index} differs between shots.jsonl and the ledger"
        if row is not None and (row.state == "safe") != (index in framed):
            yield f"shot {index} is {row.state}, but the ledger has {'a' if index in framed else 'no'} frame for it"


def _records(stored: StoredRows) -> Iterator[str]:
    """Poses and tags against their digests, and results against their hashes."""
    for table in ("poses", "tags"):
        for (index,), (_, sha256, text) in stored.keyed_rows(table):
            if hashlib.sha256(str(text).encode("utf-8", "surrogateescape")).hexdigest() != sha256:
                yield f"the {table[:-1]} of frame {index!r} was changed: its SHA-256 is not the one noted"
    for (index, run), (_, _, sha256, text) in stored.keyed_rows("results"):
        try:
            noted = json.loads(str(text))["slices_sha256"]
        except (ValueError, TypeError, KeyError, RecursionError):
            noted = None
        if noted != sha256:
            yield f"the result of frame {index!r} in run {run!s} has two different hashes"


def _tags(ledger: LedgerReader) -> Iterator[str]:
    """Tags that are about other bytes than their frame's."""
    frames = {frame.index: frame.sha256 for frame in ledger.frames()}
    for index, tag in ledger.tags().items():
        if frames.get(index) != tag.frame_sha256:
            yield f"the tag of frame {index} is about other bytes than the frame's"


def _telemetry(folder: FlightFolder, ledger: LedgerReader, problems: list[str], notes: list[str]) -> int:
    facts = ledger.facts()
    if not folder.telemetry.exists():
        if "telemetry_sha256" in facts:
            problems.append("telemetry.tlog is missing")
        else:
            notes.append("the flight has no telemetry")
        return 0
    gaps: list[Finding] = []
    found = log_reading.summarise(folder.telemetry, gaps.append)
    noted = facts.get("telemetry_sha256")
    if noted is not None and noted != found.sha256:
        problems.append("telemetry.tlog was changed: its SHA-256 is not the ledger's")
        problems.extend(map(told, gaps))
    else:
        notes.extend(map(told, gaps))  # they were there when the flight was closed
    return found.packets
