"""Say what the ledger holds of each file, and keep the hashes of flight.toml and inputs/ in it: what a flight was flown
and decoded with."""

from __future__ import annotations

import hashlib
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

from dappled import durable
from dappled.flight import layout
from dappled.flight.errors import disk_errors
from dappled.flight.layout import FlightFolder
from dappled.flight.ledger import Ledger, LedgerReader

_FACT = "sha256:"  # and the name relative to the flight; the value lists every hash that is right


def note(folder: FlightFolder, ledger: Ledger, under: str) -> None:
    """Store the current hash of a file, or of every file below a folder. Raises FlightError."""
    place = folder.path / under
    with disk_errors("read", place):
        for path in sorted(place.rglob("*")) if place.is_dir() else [place]:
            if path.is_file():
                ledger.set_fact(_FACT + str(path.relative_to(folder.path)), [durable.hash_file(path)])


def write_facts(folder: FlightFolder, ledger: Ledger, facts: Mapping[str, Any]) -> None:
    """Replace flight.toml. The ledger accepts the old and the new hash until the file is in place, so that a crash in
    between does not look like damage. Raises FlightError."""
    key = _FACT + folder.settings.name
    data = layout.facts_as_toml(facts)
    sha256 = hashlib.sha256(data).hexdigest()
    before = ledger.facts().get(key, [])
    with disk_errors("write", folder.settings):
        ledger.set_fact(key, [*before, sha256])
        durable.write_file(folder.settings, data)
        ledger.set_fact(key, [sha256])


@dataclass(frozen=True, slots=True)
class HeldDigests:
    """What the ledger holds of a file: its `size` (None: it holds none), and every SHA-256 (hex) that is right."""

    size: int | None
    right: tuple[str, ...]

    @property
    def whole(self) -> tuple[int, str] | None:
        """Size and SHA-256, where it holds both."""
        return None if self.size is None else (self.size, self.right[0])


def held(ledger: LedgerReader) -> dict[str, HeldDigests]:
    """What the ledger holds of each file, by name: frames, companions, strays, telemetry, and those that were noted.
    Raises FlightError."""
    facts = ledger.facts()
    files = {
        key.removeprefix(_FACT): HeldDigests(None, tuple(value) if isinstance(value, list) else ())
        for key, value in facts.items()
        if key.startswith(_FACT)
    }
    if "telemetry_sha256" in facts:
        files["telemetry.tlog"] = HeldDigests(facts.get("telemetry_bytes"), (facts["telemetry_sha256"],))
    return files | {row.name: HeldDigests(row.size, (row.sha256,)) for row in ledger.files()}
