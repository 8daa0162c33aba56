"""Everything that a ledger says, also while it is written, also on a read-only disk."""

from __future__ import annotations

import json
import sqlite3
from collections.abc import Callable
from pathlib import Path
from typing import Any, Self, TypeVar

from dappled.decode.geometry.pose import Pose
from dappled.flight import ledger_schema
from dappled.flight.database import Database
from dappled.flight.entries import Event, Result, ShotRow, Stray
from dappled.flight.errors import FlightError
from dappled.flight.ledger_schema import APPLICATION_ID, SCHEMA_VERSION
from dappled.flight.records import Frame, Tag

_Record = TypeVar("_Record")
_REASONS = {
    "SQLITE_NOTADB": "it is damaged, or no SQLite file; move it away, the frames and shots.jsonl beside it are intact",
    "SQLITE_CORRUPT": "it is damaged; move it away, the frames and shots.jsonl beside it are intact",
    "SQLITE_FULL": "the disk is full; free some space or set record.directory to another disk",
    "SQLITE_READONLY": "the disk or the file is read-only; make it writable or set record.directory elsewhere",
    "SQLITE_CANTOPEN": "it can't be opened; check that its folder exists and is accessible",
    "SQLITE_BUSY": "another program holds it; close that program",
    "SQLITE_IOERR": "the disk reports an input/output error, or is full; check the disk (df, dmesg)",
}


class LedgerReader(Database):
    """Everything that a ledger says, as records. One connection, behind a lock: threads may share it."""

    def __init__(self, path: Path, *, uri: str, create: bool = False) -> None:
        """Open a ledger; `create`: an empty file will do. Raises FlightError."""
        self._create = create
        super().__init__(path, uri)

    @classmethod
    def open(cls, path: Path) -> Self:
        """A ledger to read only, also while it is written, also on a read-only disk. Raises FlightError."""
        if not path.is_file():
            raise FlightError(f"there is no ledger at {path}; give a flight folder that dappled recorded")
        try:
            # Not mode=ro: such a connection, when it is the last, would leave -wal and -shm behind. Nothing is changed.
            reader = cls(path, uri=f"{path.absolute().as_uri()}?mode=rw")
        except FlightError:
            # In a folder that can't be written a WAL database opens only as immutable, and only when closed well.
            wal = path.with_name(path.name + "-wal")
            if wal.exists() and wal.stat().st_size > 0:
                raise
            reader = cls(path, uri=f"{path.absolute().as_uri()}?mode=ro&immutable=1")
        reader._rows("PRAGMA query_only=ON")
        return reader

    def shots(self) -> list[ShotRow]:
        """All shots, by index."""
        return [ledger_schema.shot_row(row) for row in self._rows("SELECT * FROM shots ORDER BY idx")]

    def shot(self, index: int) -> ShotRow | None:
        rows = self._rows("SELECT * FROM shots WHERE idx = ?", index)
        return ledger_schema.shot_row(rows[0]) if rows else None

    def frames(self) -> list[Frame]:
        """All safe frames, by index."""
        return [Frame(*row) for row in self._rows("SELECT * FROM frames ORDER BY idx")]

    def frame(self, index: int) -> Frame | None:
        rows = self._rows("SELECT * FROM frames WHERE idx = ?", index)
        return Frame(*rows[0]) if rows else None

    def companions(self) -> list[Frame]:
        """Files beside frames, such as the JPEG of a raw frame; each has the index of its frame."""
        if not self._rows("SELECT 1 FROM sqlite_master WHERE name = 'companions'"):
            return []  # recorded before there were any
        columns = "idx, name, camera_name, size, sha256, arrived_utc_ns"
        return [Frame(*row) for row in self._rows(f"SELECT {columns} FROM companions ORDER BY name")]  # noqa: S608  constant

    def files(self) -> list[Frame | Stray]:
        """Every file that has a row: frames, companions, strays."""
        return [*self.frames(), *self.companions(), *self.strays()]

    def following(self) -> frozenset[int]:
        """Shots that were fired and whose files stayed at the camera: failed for now, until they are picked up."""
        told = "SELECT idx FROM events WHERE kind = 'follows'"
        rows = self._rows(f"SELECT idx FROM shots WHERE state = 'failed' AND idx IN ({told})")  # noqa: S608  constant
        return frozenset(row[0] for row in rows)

    def strays(self) -> list[Stray]:
        return [Stray(*row) for row in self._rows("SELECT * FROM strays ORDER BY name")]

    def poses(self) -> dict[int, Pose]:
        return {
            index: self._load(ledger_schema.pose, text) for index, text in self._rows("SELECT idx, record FROM poses")
        }

    def pose(self, index: int) -> Pose | None:
        rows = self._rows("SELECT record FROM poses WHERE idx = ?", index)
        return self._load(ledger_schema.pose, rows[0][0]) if rows else None

    def tags(self) -> dict[int, Tag]:
        return {
            index: self._load(ledger_schema.tag, text) for index, text in self._rows("SELECT idx, record FROM tags")
        }

    def tag(self, index: int) -> Tag | None:
        rows = self._rows("SELECT record FROM tags WHERE idx = ?", index)
        return self._load(ledger_schema.tag, rows[0][0]) if rows else None

    def results(self, run: str = "live") -> dict[int, Result]:
        """What decoding made of each frame in one run."""
        rows = self._rows("SELECT record FROM results WHERE run = ? ORDER BY idx", run)
        return {result.index: result for result in (self._load(ledger_schema.result, row[0]) for row in rows)}

    def result(self, index: int, run: str = "live") -> Result | None:
        rows = self._rows("SELECT record FROM results WHERE idx = ? AND run = ?", index, run)
        return self._load(ledger_schema.result, rows[0][0]) if rows else None

    def contradictions(self) -> list[str]:
        """Results whose record and column say different hashes, in sentences."""
        rows = self._rows("SELECT idx, run, slices_sha256, record FROM results ORDER BY idx, run")
        return [
            f"the result of frame {index} in run {run} contradicts itself"
            for index, run, sha256, text in rows
            if self._load(ledger_schema.result, text).slices_sha256 != sha256
        ]

    def runs(self) -> dict[str, int]:
        """How many results each run has; "live" is the flight itself."""
        return dict(self._rows("SELECT run, count(*) FROM results GROUP BY run ORDER BY min(rowid)"))

    def digests(self, table: str) -> dict[int, tuple[str, str]]:
        """(sha256 as noted, record text) by index, of "poses" or "tags"."""
        if table not in ("poses", "tags"):
            raise ValueError(f"no digests are kept of {table}")
        rows = self._rows(f"SELECT idx, sha256, record FROM {table} ORDER BY idx")  # noqa: S608  one of two words
        return {index: (sha256, text) for index, sha256, text in rows}

    def events(self) -> list[Event]:
        return [Event(*row) for row in self._rows("SELECT * FROM events ORDER BY number")]

    def facts(self) -> dict[str, Any]:
        """What holds for the whole flight: telemetry_sha256, closed_utc_ns …"""
        return {key: json.loads(value) for key, value in self._rows("SELECT key, value FROM facts")}

    def utc_correction_ns(self) -> int | None:
        """What to add to every `utc_ns` of this flight to have UTC: 0 where the machine knew it, None where nobody ever
        told."""
        facts = self.facts()
        if "utc_correction" in facts:
            return int(facts["utc_correction"]["correction_ns"])
        return 0 if facts.get("utc_known", True) else None

    def damage(self) -> list[str]:
        """What SQLite finds wrong with the file; empty when it is whole."""
        try:
            found = [str(row[0]) for row in self._rows("PRAGMA integrity_check(10)")]
            return [] if found == ["ok"] else found
        except FlightError as error:
            return [str(error)]

    def _load(self, build: Callable[[dict[str, Any]], _Record], text: str) -> _Record:
        try:
            return build(json.loads(text))
        except (ValueError, TypeError, KeyError, AttributeError) as error:
            raise FlightError(f"a record in the ledger {self.path} can't be read: {error}") from error

    def _sentence(self, error: sqlite3.Error) -> FlightError:
        code = getattr(error, "sqlite_errorname", "") or ""
        if isinstance(error, sqlite3.ProgrammingError):
            return FlightError(f"the ledger {self.path} was used after it was closed or in a wrong way: {error}")
        if code.startswith("SQLITE_CONSTRAINT"):
            return FlightError(f"the ledger {self.path} refuses a row that contradicts the others: {error}")
        for start, why in _REASONS.items():
            if code.startswith(start):
                return FlightError(f"cannot use the ledger {self.path}: {why}")
        return FlightError(f"cannot use the ledger {self.path}: {error}; check the disk and the file")

    def _identify(self) -> None:
        empty, application, version = self._identity()
        if empty and self._create and application == 0:
            return
        if application != APPLICATION_ID:
            raise FlightError(f"{self.path} is not a dappled ledger; give a flight folder that dappled recorded")
        if version != SCHEMA_VERSION:
            raise FlightError(
                f"the ledger {self.path} has version {version}, this dappled reads version {SCHEMA_VERSION}; "
                "use the dappled that recorded it, or a newer one"
            )


def ledger_damage(path: Path) -> str | None:
    """What SQLite finds wrong with the content of a ledger; None where it is whole, missing, or can't be looked at."""
    if not path.is_file():
        return None
    try:
        with LedgerReader.open(path) as ledger:
            return next(iter(ledger.damage()), None)
    except FlightError as error:
        code = getattr(error.__cause__, "sqlite_errorname", "") or ""
        return str(error) if code.startswith(("SQLITE_NOTADB", "SQLITE_CORRUPT")) else None
