"""Seal a flight when it closes: the digest of every file, and the head of the ledger's chain, in seals.jsonl.

A seal stands outside the files that it covers, names the one before it, and may be signed. Work on a closed flight
(late tags, pickups, another run, sidecars) adds rows with links of their own, and ends with a new seal.
"""

from __future__ import annotations

import hashlib
import json
import os
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass
from enum import StrEnum
from pathlib import Path

from dappled import codec, durable, file_lock
from dappled.bounds.parsing import read_log
from dappled.clock import Clock
from dappled.codec import canonical
from dappled.findings import Code, Finding, Subject, finding
from dappled.flight import layout, provenance, pruning
from dappled.flight.errors import FlightError, disk_errors
from dappled.flight.layout import FlightFolder
from dappled.flight.ledger import Ledger, LedgerReader, is_closed
from dappled.flight.provenance import HeldDigests
from dappled.flight.seal_key import SealKey
from dappled.shown import printable

SEAL = Subject("seal")
FACT = "seals"  # {"count": seals announced, "missing": those that were never written}
OPENED = "opened again"  # an event: for what later work
CHANGED = "changed in between"  # an event: what later work found that was not as the seal before it covers it
_NAMED = 5
_BESIDE_LEDGER = ("-wal", "-shm")
_MOST_SEALS = 100_000
_MAC = "mac"
_DIGEST = "sha256"


class Occasion(StrEnum):
    """What a seal is made for, and a closed flight opened again."""

    CLOSED = "closed"
    RECOVERED = "recovered"
    RUN = "run"
    LATE_TAGS = "late tags"
    PICKUP = "pickup"
    GEOTAG = "geotag"
    PRUNE = "offload --prune"
    OWNER = "signed by its owner"


@dataclass(frozen=True, slots=True)
class Seal:
    """One seal. `files` gives size and SHA-256 by name relative to the flight; `links` and `head` are the chain's.

    `previous` is the SHA-256 of the line before it; `key` the name of the key that signed it (`mac`), None without one.
    """

    seal: int
    flight: str
    utc_ns: int
    why: str  # an Occasion, or what a later version has
    links: int
    head: str
    files: Mapping[str, tuple[int, str]]
    previous: str
    key: str | None = None
    mac: str | None = None

    def signed_part(self) -> bytes:
        """What `mac` covers."""
        return canonical({name: value for name, value in codec.plain(self).items() if name != _MAC})

    def line(self) -> bytes:
        """As it stands in the file, with a digest of itself."""
        values = codec.plain(self)
        return canonical({**values, _DIGEST: hashlib.sha256(canonical(values)).hexdigest()})


@dataclass(frozen=True, slots=True)
class SealFile:
    """The seals of a flight, by number, and what is wrong with their file."""

    seals: Mapping[int, Seal]
    problems: tuple[Finding, ...]

    @property
    def last(self) -> Seal | None:
        """The newest seal."""
        return self.seals[max(self.seals)] if self.seals else None


def seal(folder: FlightFolder, clock: Clock, why: Occasion, key: SealKey | None = None) -> None:
    """Seal a closed flight; one that is not closed yet is left alone. The caller has closed the ledger.

    The ledger says first how many seals there are, so that one cut off is missed. Frames and telemetry count with the
    digests that the ledger took when they were written. Raises FlightError.
    """
    with disk_errors("seal the flight", folder.path), _alone(folder.path):
        before, known = _content(folder), read(folder)
        before += b"" if before.endswith(b"\n") or not before else b"\n"  # a torn line stays, by itself
        with Ledger(folder.ledger, clock) as ledger:
            facts = ledger.facts()
            if "closed_utc_ns" not in facts:
                return
            count = max([announced(facts)[0], *known.seals]) + 1
            missing = sorted(set(range(1, count)) - known.seals.keys())
            ledger.set_fact(FACT, {"count": count, "missing": missing})
            ledger.fold()
            head, held = ledger.last_link(), provenance.held(ledger)
        assert head is not None, "a ledger that is open for writing has a chain"
        chain = (head.number, head.link, digests(folder, held), _last_digest(before))
        values = (count, of_flight(facts), clock.utc_ns(), why.value, *chain)
        made = Seal(*values, key=None if key is None else key.name)
        if key is not None:
            made = Seal(*values, key=key.name, mac=key.sign(made.signed_part()))
        durable.write_file(folder.seals, before + made.line() + b"\n")


@contextmanager
def work(folder: FlightFolder, clock: Clock, why: Occasion, doing: str, key: SealKey | None) -> Iterator[None]:
    """Hold the flights' lock, and open the flight again (see `reopened`). `doing` is a verb for those who find the lock
    held: "tags frames in". Raises FlightError, also where another process holds the lock."""
    with layout.work_lock(folder.path.resolve().parent, doing), reopened(folder, clock, why, key):
        yield


@contextmanager
def reopened(
    folder: FlightFolder, clock: Clock, why: Occasion, key: SealKey | None = None, *, judged: bool = False
) -> Iterator[None]:
    """Work on a closed flight: the ledger says so first, and the flight is sealed again after the work, also where that
    raised. Should the work be killed, `flight check` says what is not sealed. A flight that is still open is left to
    the daemon.

    `key` signs the seal only where it had signed all that was there before: otherwise its signature would cover what
    somebody else did in between. `judged`: the caller has made sure of that. Raises FlightError."""
    if not is_closed(folder.ledger):
        yield
        return
    before = standing(folder)
    changed = before.changed()
    signs = key if key is not None and (judged or before.signed_by(key)) else None
    layout.refuse_unfinished(folder)
    layout.remove_parts(folder)
    with Ledger(folder.ledger, clock) as ledger:
        ledger.add_event(OPENED, finding(Code.FLIGHT_OPENED_AGAIN, Subject("flight"), work=why.value))
        if before.last is not None and changed:
            names, more = printable(", ".join(changed[:_NAMED])), max(0, len(changed) - _NAMED)
            also = f"{more} more" if more else ""
            ledger.add_event(CHANGED, finding(Code.SEAL_CHANGED, SEAL, seal=before.last.seal, names=names, more=also))
    try:
        yield
    finally:
        seal(folder, clock, why, signs)


@dataclass(frozen=True, slots=True)
class SealStanding:
    """How a flight stands to its newest seal, None where there is none: how many the ledger tells of (`count`), whether
    it covers all links of the chain, and what the ledger holds of the files."""

    folder: FlightFolder
    last: Seal | None
    count: int
    covered: bool
    held: Mapping[str, HeldDigests]

    def changed(self) -> list[str]:
        """The files that something other than dappled changed since, by name: also the ledger, down to the bytes that
        no row uses. None where rows were written since, or there is no seal: then the files may be newer too.

        Frames and telemetry are compared with the ledger by `flight check`, and with its digests here only by their
        names. Raises FlightError.
        """
        if self.last is None or not self.covered:
            return []
        ledger = self.folder.ledger
        with disk_errors("read the files of", self.folder.path):
            now, sealed = digests(self.folder, self.held), self.last.files
            found = {name for name in now.keys() | sealed.keys() if now.get(name) != sealed.get(name)}
            wal = ledger.with_name(f"{ledger.name}-wal")
            found |= {ledger.name} if wal.is_file() and wal.stat().st_size else set()
        try:
            found -= pruning.removed(self.folder).keys()
        except FlightError:  # `flight check` says what is wrong with it
            found.add(pruning.RECORD)
        return sorted(found)

    def signed_by(self, key: SealKey) -> bool:
        """Whether this key signed all that is there: the newest seal, which covers the whole chain, and nothing that it
        covers was changed since. Raises FlightError."""
        last = self.last
        signed = last is not None and last.key == key.name and key.signed(last.signed_part(), last.mac or "")
        return signed and self.covered and not self.changed()


def standing(folder: FlightFolder) -> SealStanding:
    """How a closed flight stands to its newest seal. Raises FlightError."""
    last = read(folder).last
    with LedgerReader.open(folder.ledger) as ledger:
        facts = ledger.facts()
        head = ledger.last_link() if "chain" in facts else None
        covered = last is not None and head is not None and last.head == head.link
        return SealStanding(folder, last, announced(facts)[0], covered, provenance.held(ledger))


def read(folder: FlightFolder) -> SealFile:
    """The seals of a flight; none where there is no file. A line that is no seal, or does not follow from the line
    before it, is reported. Raises FlightError when the file can't be read."""
    with disk_errors("read the seals", folder.seals):
        return parse(_content(folder), folder.seals.name)


def parse(content: bytes, name: str) -> SealFile:
    """The seals in the content of a file; see `read`."""
    if content.count(b"\n") > _MOST_SEALS:
        raise FlightError(f"{name} has more than {_MOST_SEALS} lines: it was changed; use another copy of the flight")
    lines = content.split(b"\n")
    tail = lines.pop()
    seals: dict[int, Seal] = {}
    problems: list[Finding] = []
    previous = ""
    for number, line in enumerate(lines, 1):
        found = _parse(line)
        if found is None:
            problems.append(finding(Code.SEAL_LINE_CHANGED, SEAL, line=number, file=name))
        elif found.previous != previous:
            problems.append(finding(Code.SEAL_LINE_UNLINKED, SEAL, line=number, file=name))
        elif found.seal in seals:
            problems.append(finding(Code.SEAL_TWICE, SEAL, line=number, file=name, seal=found.seal))
        if found is not None:
            seals.setdefault(found.seal, found)
        previous = hashlib.sha256(line).hexdigest()
    if tail:
        problems.append(finding(Code.SEAL_LINE_TORN, SEAL, file=name, bytes=len(tail)))
    return SealFile(seals, tuple(problems))


def digests(folder: FlightFolder, held: Mapping[str, HeldDigests]) -> dict[str, tuple[int, str]]:
    """Size and SHA-256 of each file that a seal covers, by name: as the ledger holds them of frames and telemetry, of
    the others as they are now. Raises OSError."""
    known = {name: one.whole for name, one in held.items()}
    return {name: known.get(name) or digest(path) for name, path in sealed_paths(folder).items()}


def digest(path: Path) -> tuple[int, str]:
    """Size and SHA-256 of a file. Raises OSError."""
    return path.stat().st_size, durable.hash_file(path)


def sealed_paths(folder: FlightFolder) -> dict[str, Path]:
    """Every file of a flight that a seal covers, by name: all but seals.jsonl, the record of what was removed (the
    ledger has its digest, and a copy lacks it), SQLite's files beside the ledger, and half-written ones. Links are not
    followed.

    Raises OSError."""
    left_out = {folder.seals.name, pruning.RECORD, *(folder.ledger.name + suffix for suffix in _BESIDE_LEDGER)}
    files = folder.files().items()
    return {name: path for name, path in files if name not in left_out and not durable.is_temporary(path.name)}


def of_flight(facts: Mapping[str, object]) -> str:
    """The name that a flight was recorded under, from the ledger's facts; the folder may be called otherwise by now."""
    value = facts.get("chain")
    return str(value.get("flight", "")) if isinstance(value, dict) else ""


def never_changes(name: str) -> bool:
    """Whether a file is of the recording itself: later work adds files and sidecars, and changes none of these."""
    recorded = name in ("flight.toml", "telemetry.tlog", "shots.jsonl") or name.startswith(("frames/", "inputs/"))
    return recorded and not name.endswith(layout.SIDECAR)


def announced(facts: Mapping[str, object]) -> tuple[int, frozenset[int]]:
    """From the ledger's facts: how many seals there are, and which of them were never written."""
    value = facts.get(FACT)
    if not isinstance(value, dict):
        return 0, frozenset()
    count, missing = int(value.get("count", 0)), frozenset(value.get("missing", ()))
    if not 0 <= count <= _MOST_SEALS:
        raise FlightError(f"the ledger tells of {count} seals: it was changed; use another copy of the flight")
    return count, missing


def _parse(line: bytes) -> Seal | None:
    """A seal, where the line is exactly one, with the digest of itself."""
    try:
        values = json.loads(line)
        del values[_DIGEST]
        found = codec.read(Seal, values)
    except (ValueError, TypeError, KeyError, RecursionError):
        return None
    return found if found.line() == line else None


def _content(folder: FlightFolder) -> bytes:
    try:
        return read_log(folder.seals)
    except FileNotFoundError:
        return b""


def _last_digest(content: bytes) -> str:
    """SHA-256 of the last line; "" before the first one."""
    return hashlib.sha256(content.split(b"\n")[-2]).hexdigest() if content else ""


@contextmanager
def _alone(path: Path) -> Iterator[None]:
    """Keep other processes from sealing the same flight meanwhile. Raises OSError."""
    with durable.descriptor(path, os.O_RDONLY | os.O_DIRECTORY) as fd:
        file_lock.lock(fd, wait=True)
        yield
