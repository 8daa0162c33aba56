"""Keep the hashes of flight.toml and inputs/, which say what a flight was flown and decoded with, in the ledger."""

from __future__ import annotations

import hashlib
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any

from dappled import durable
from dappled.confined import OutsideError
from dappled.flight import layout
from dappled.flight.errors import disk_error
from dappled.flight.layout import FlightFolder
from dappled.flight.ledger import Ledger, LedgerReader

_FACT = "sha256:"  # and the name relative to the flight; the value lists every hash that is right


def note(folder: FlightFolder, ledger: Ledger, under: str) -> None:
    """Store the current hash of a file, or of every file below a folder. Raises FlightError."""
    place = folder.path / under
    try:
        for path in sorted(place.rglob("*")) if place.is_dir() else [place]:
            if path.is_file():
                ledger.set_fact(_FACT + str(path.relative_to(folder.path)), [durable.hash_file(path)])
    except OSError as error:
        raise disk_error("read", place, error) from error


def write_facts(folder: FlightFolder, ledger: Ledger, facts: Mapping[str, Any]) -> None:
    """Replace flight.toml. The ledger accepts the old and the new hash until the file is in place, so that a crash in
    between does not look like damage. Raises FlightError."""
    key = _FACT + folder.settings.name
    data = layout.facts_as_toml(facts)
    sha256 = hashlib.sha256(data).hexdigest()
    before = ledger.facts().get(key, [])
    try:
        ledger.set_fact(key, [*before, sha256])
        durable.write_file(folder.settings, data)
        ledger.set_fact(key, [sha256])
    except OSError as error:
        raise disk_error("write", folder.settings, error) from error


def problems(folder: FlightFolder, ledger: LedgerReader) -> Iterator[str]:
    """A sentence for each file that differs from its stored hash. `read_facts` reports a missing flight.toml."""
    for key, hashes in sorted(ledger.facts().items()):
        if not key.startswith(_FACT):
            continue
        name = key.removeprefix(_FACT)
        try:
            path = folder.file(name)
        except OutsideError as error:
            yield str(error)
            continue
        if path == folder.settings and not path.exists():
            continue
        yield from _problem(path, name, hashes)


def _problem(path: Path, name: str, hashes: list[str]) -> Iterator[str]:
    try:
        if durable.hash_file(path) not in hashes:
            yield f"{name} was changed: its SHA-256 is not the ledger's"
    except FileNotFoundError:
        yield f"{name} is in the ledger, but the file is missing"
    except OSError as error:
        yield f"{name} can't be read: {error.strerror}"
