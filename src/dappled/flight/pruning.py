"""Remove frames whose copies are proved, and keep a record of which were removed here and where they are.

The record, `offloaded.jsonl`, stands in the flight that was pruned and never in its copy; the ledger has its SHA-256 in
an event. Both are durable before the first file is removed.
"""

from __future__ import annotations

import hashlib
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path

from dappled import codec, durable
from dappled.bounds.parsing import read_log
from dappled.clock import Clock
from dappled.codec import canonical
from dappled.findings import Code, Subject, finding
from dappled.flight.errors import FlightError, disk_errors
from dappled.flight.layout import FlightFolder
from dappled.flight.ledger import Ledger, LedgerReader
from dappled.flight.trees import FileIdentity, Tree
from dappled.flight.verified_copy import Proved, copy_of
from dappled.shown import printable

RECORD = "offloaded.jsonl"
EVENT = "offloaded"


@dataclass(frozen=True, slots=True)
class Removed:
    """A file that was removed here: its size and SHA-256, the folder that holds it, and when it was removed."""

    name: str
    size: int
    sha256: str
    destination: str
    utc_ns: int


def removed(folder: FlightFolder) -> dict[str, Removed]:
    """The files that were removed from a flight, by name, as far as they are the ledger's and still gone. Raises
    FlightError where the record is not the one that the ledger vouches for."""
    path = folder.file(RECORD)
    with disk_errors("read", path):
        try:
            data = read_log(path)
        except FileNotFoundError:
            return {}
    with LedgerReader.open(folder.ledger) as ledger:
        noted = [one.facts.get("sha256") for one in ledger.found(EVENT)]
        held = {row.name: row.sha256 for row in ledger.files()}
    if hashlib.sha256(data).hexdigest() not in noted:
        raise FlightError(f"{path} was changed: the ledger has no event with its SHA-256; use another copy of it")
    try:
        rows = [codec.read_json(Removed, line) for line in data.splitlines()]
    except codec.CodecError as error:
        raise FlightError(f"{path} can't be read: {error}") from error
    known = (row for row in rows if held.get(row.name) == row.sha256)
    return {row.name: row for row in known if not folder.file(row.name).exists()}


def remove(source: Tree, there: Tree, sure: Mapping[str, Proved]) -> int:
    """Remove files that `note` has written down; how many. Each must still be the file that was copied, and its copy
    the one that was read back from `there`.

    Raises FlightError where one isn't, a copy has vanished, or a disk refuses; the other files then stay.
    """
    for name, one in sure.items():
        with source.reading(name) as fd:
            _refuse_other(source, name, fd, one)
            if copy_of(there, name) != one.copy:
                raise FlightError(f"{there.path / name} is not the file any more that was read back: {name} stays here")
            source.unlink(name)
            if copy_of(there, name) != one.copy:  # one file under two names that nothing told apart
                source.write(name, durable.pieces(fd, one.identity.size))
                source.sync()
                raise FlightError(
                    f"{there.path / name} vanished with {source.path / name}: they are one file under two names; it "
                    "was put back here, and nothing more was removed"
                )
    source.sync()
    return len(sure)


def note(
    folder: FlightFolder, there: Path, sure: Mapping[str, Proved], elsewhere: Mapping[str, Proved], clock: Clock
) -> None:
    """Write down which files will be removed (`sure`), and which were never here (`elsewhere`), durably: first the
    ledger's event. Raises FlightError."""
    now = clock.utc_ns()
    rows = removed(folder) | {
        name: Removed(name, one.identity.size, one.sha256, str(there), now)
        for name, one in {**elsewhere, **sure}.items()
    }
    data = b"".join(canonical(row) + b"\n" for _, row in sorted(rows.items()))
    sha256 = hashlib.sha256(data).hexdigest()
    names = sorted(sure)
    which = names[0] if len(names) == 1 else f"{names[0]} to {names[-1]}"
    with Ledger(folder.ledger, clock) as ledger:
        to = printable(str(there))
        noted = finding(
            Code.FLIGHT_FILES_REMOVED, Subject("flight"), files=len(sure), which=which, there=to, sha256=sha256
        )
        ledger.add_event(EVENT, noted)
    with disk_errors("write", folder.path / RECORD):
        durable.write_file(folder.path / RECORD, data)


def _refuse_other(source: Tree, name: str, fd: int, one: Proved) -> None:
    """Raise FlightError where a file is not the one that was copied any more."""
    named = source.stat(name)
    same = FileIdentity.of_fd(fd) == one.identity and named is not None and FileIdentity.of(named) == one.identity
    if not same or durable.hash_descriptor(fd, one.identity.size) != one.sha256:
        raise FlightError(
            f"{source.path / name} is not the file any more that was copied: it stays here; offload again"
        )
