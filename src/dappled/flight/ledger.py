"""The ledger: one SQLite file that says what became of every shot. A row in it is the acknowledgement.

WAL with synchronous=FULL: a committed row survives a power cut. Poses, tags and results are kept as the canonical JSON
that was hashed, so that `sha256(record)` can be checked with SQLite and sha256sum alone.
"""

from __future__ import annotations

import json
import sqlite3
import threading
from abc import ABC, abstractmethod
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import asdict
from pathlib import Path
from typing import Any, Self, TypeVar, cast

from dappled.decode.geometry import Gnss, Pose
from dappled.flight.errors import FlightError
from dappled.flight.records import (
    Cause,
    Frame,
    LedgerEvent,
    Result,
    Shot,
    ShotRow,
    ShotState,
    Stray,
    Tag,
    canonical,
    digest,
)

LIVE = "live"
_APPLICATION_ID = 0x4450504C  # "DPPL"
_SCHEMA_VERSION = 1

SCHEMA = """
CREATE TABLE shots (
    idx INTEGER PRIMARY KEY,           -- the image index, going on over flights
    source TEXT NOT NULL, kind TEXT NOT NULL, sequence INTEGER,
    wished_utc_ns INTEGER NOT NULL, wished_monotonic_ns INTEGER NOT NULL,
    state TEXT NOT NULL CHECK (state IN ('wished', 'fired', 'safe', 'failed')),
    reason TEXT,
    fired_called_monotonic_ns INTEGER, fired_returned_monotonic_ns INTEGER
) STRICT;
CREATE TABLE frames (
    idx INTEGER PRIMARY KEY REFERENCES shots (idx),
    name TEXT NOT NULL UNIQUE,         -- relative to the flight folder
    camera_name TEXT NOT NULL, size INTEGER NOT NULL, sha256 TEXT NOT NULL, arrived_utc_ns INTEGER NOT NULL
) STRICT;
CREATE TABLE strays (
    name TEXT PRIMARY KEY, camera_name TEXT NOT NULL, size INTEGER NOT NULL, sha256 TEXT NOT NULL,
    arrived_utc_ns INTEGER NOT NULL, reason TEXT NOT NULL
) STRICT;
CREATE TABLE companions (             -- the JPEG beside a raw frame
    name TEXT PRIMARY KEY, idx INTEGER NOT NULL REFERENCES frames (idx),
    camera_name TEXT NOT NULL, size INTEGER NOT NULL, sha256 TEXT NOT NULL, arrived_utc_ns INTEGER NOT NULL
) STRICT;
CREATE TABLE poses (idx INTEGER PRIMARY KEY REFERENCES frames (idx), sha256 TEXT NOT NULL, record TEXT NOT NULL) STRICT;
CREATE TABLE tags (idx INTEGER PRIMARY KEY REFERENCES frames (idx), sha256 TEXT NOT NULL, record TEXT NOT NULL) STRICT;
CREATE TABLE results (
    idx INTEGER NOT NULL REFERENCES frames (idx), run TEXT NOT NULL,
    slices_sha256 TEXT NOT NULL, record TEXT NOT NULL,
    PRIMARY KEY (idx, run)
) STRICT;
CREATE TABLE events (
    number INTEGER PRIMARY KEY, utc_ns INTEGER NOT NULL, kind TEXT NOT NULL, idx INTEGER, text TEXT NOT NULL
) STRICT;
CREATE TABLE facts (key TEXT PRIMARY KEY, value TEXT NOT NULL) STRICT;
"""
_BUSY_S = 10.0
# The life of a shot: wished → fired → safe | failed. A file is proof of an exposure: it makes a shot safe even when the
# trigger call was not seen to return, and even when the shot had been given up. What is safe stays safe.
TRANSITIONS: dict[ShotState, frozenset[ShotState]] = {
    "wished": frozenset({"fired", "safe", "failed"}),
    "fired": frozenset({"safe", "failed"}),
    "failed": frozenset({"safe"}),
    "safe": frozenset(),
}
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


class IllegalTransitionError(FlightError):
    """A shot can't go from its state to the one asked for."""


def advance(index: int, old: ShotState, new: ShotState) -> ShotState:
    """`new`, when a shot may go there from `old`. Raises IllegalTransitionError."""
    if new not in TRANSITIONS[old]:
        raise IllegalTransitionError(f"shot {index} is {old}: it can't become {new}")
    return new


class Database(ABC):
    """One SQLite connection behind a lock, so that threads may share it. `_sentence` words SQLite's errors."""

    def __init__(self, path: Path, uri: str) -> None:
        """Connect to `uri` and check with `_identify` that the file is ours. Raises FlightError."""
        self.path = path
        self._lock = threading.RLock()
        try:
            self._db = sqlite3.connect(uri, uri=True, timeout=_BUSY_S, isolation_level=None, check_same_thread=False)
        except sqlite3.Error as error:
            raise self._sentence(error) from error
        try:
            with self._speaking():
                self._identify()
        except BaseException:
            self._db.close()
            raise

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def close(self) -> None:
        """Close the connection; the last one to close folds the WAL into the file."""
        with self._lock:
            self._db.close()

    @abstractmethod
    def _identify(self) -> None:
        """Check that the file is ours; set up a new one. Raises FlightError and sqlite3.Error."""

    @abstractmethod
    def _sentence(self, error: sqlite3.Error) -> FlightError:
        """The error for a person: what can't be done, why, and what to do."""

    def _identity(self) -> tuple[bool, int, int]:
        """(whether the file is empty, application id, version)."""
        empty = self._db.execute("SELECT count(*) FROM sqlite_master").fetchone()[0] == 0
        application = self._db.execute("PRAGMA application_id").fetchone()[0]
        return empty, application, self._db.execute("PRAGMA user_version").fetchone()[0]

    def _rows(self, sql: str, *values: object) -> list[Any]:
        with self._lock, self._speaking():
            return self._db.execute(sql, values).fetchall()

    @contextmanager
    def _speaking(self) -> Iterator[None]:
        try:
            yield
        except sqlite3.Error as error:
            raise self._sentence(error) from error


class LedgerReader(Database):
    """Read a ledger's rows as records, also while it is written, also on a read-only disk."""

    def __init__(self, path: Path, *, uri: str, create: bool = False) -> None:
        """Open a ledger. `create`: an empty file is accepted. Raises FlightError."""
        self._create = create
        super().__init__(path, uri)

    @classmethod
    def open(cls, path: Path) -> Self:
        """Open a ledger for reading. Raises FlightError."""
        if not path.is_file():
            raise FlightError(f"there is no ledger at {path}; give a flight folder that dappled recorded")
        try:
            # Not mode=ro: when such a connection is the last one, it leaves -wal and -shm behind. We change nothing.
            reader = cls(path, uri=f"{path.absolute().as_uri()}?mode=rw")
        except FlightError:
            # In a read-only folder a WAL database opens only as immutable, and only if it was closed properly.
            wal = path.with_name(path.name + "-wal")
            if wal.exists() and wal.stat().st_size > 0:
                raise
            reader = cls(path, uri=f"{path.absolute().as_uri()}?mode=ro&immutable=1")
        reader._rows("PRAGMA query_only=ON")
        return reader

    def shots(self) -> list[ShotRow]:
        """All shots, by index."""
        return [_shot_row(row) for row in self._rows("SELECT * FROM shots ORDER BY idx")]

    def shot(self, index: int) -> ShotRow | None:
        rows = self._rows("SELECT * FROM shots WHERE idx = ?", index)
        return _shot_row(rows[0]) if rows else None

    def frames(self) -> list[Frame]:
        """All safe frames, by index."""
        return [Frame(*row) for row in self._rows("SELECT * FROM frames ORDER BY idx")]

    def frame(self, index: int) -> Frame | None:
        rows = self._rows("SELECT * FROM frames WHERE idx = ?", index)
        return Frame(*rows[0]) if rows else None

    def companions(self) -> list[Frame]:
        """Files beside frames, such as the JPEG of a raw frame; each has the index of its frame."""
        if not self._rows("SELECT 1 FROM sqlite_master WHERE name = 'companions'"):
            return []  # recorded by a version without companions
        columns = "idx, name, camera_name, size, sha256, arrived_utc_ns"
        return [Frame(*row) for row in self._rows(f"SELECT {columns} FROM companions ORDER BY name")]  # noqa: S608  constant

    def files(self) -> list[Frame | Stray]:
        """Every file that has a row: frames, companions, strays."""
        return [*self.frames(), *self.companions(), *self.strays()]

    def following(self) -> frozenset[int]:
        """Shots that were fired and whose files are still on the camera. They count as failed until picked up."""
        noted = "SELECT idx FROM events WHERE kind = 'follows'"
        rows = self._rows(f"SELECT idx FROM shots WHERE state = 'failed' AND idx IN ({noted})")  # noqa: S608  constant
        return frozenset(row[0] for row in rows)

    def strays(self) -> list[Stray]:
        return [Stray(*row) for row in self._rows("SELECT * FROM strays ORDER BY name")]

    def poses(self) -> dict[int, Pose]:
        return {index: self._load(_pose, text) for index, text in self._rows("SELECT idx, record FROM poses")}

    def pose(self, index: int) -> Pose | None:
        rows = self._rows("SELECT record FROM poses WHERE idx = ?", index)
        return self._load(_pose, rows[0][0]) if rows else None

    def tags(self) -> dict[int, Tag]:
        return {index: self._load(_tag, text) for index, text in self._rows("SELECT idx, record FROM tags")}

    def tag(self, index: int) -> Tag | None:
        rows = self._rows("SELECT record FROM tags WHERE idx = ?", index)
        return self._load(_tag, rows[0][0]) if rows else None

    def results(self, run: str = "live") -> dict[int, Result]:
        """The decoding results of one run, by index."""
        rows = self._rows("SELECT record FROM results WHERE run = ? ORDER BY idx", run)
        return {result.index: result for result in (self._load(_result, row[0]) for row in rows)}

    def result(self, index: int, run: str = "live") -> Result | None:
        rows = self._rows("SELECT record FROM results WHERE idx = ? AND run = ?", index, run)
        return self._load(_result, rows[0][0]) if rows else None

    def contradictions(self) -> list[str]:
        """A sentence for each result whose record and column hold different hashes."""
        rows = self._rows("SELECT idx, run, slices_sha256, record FROM results ORDER BY idx, run")
        return [
            f"the result of frame {index} in run {run} has two different hashes"
            for index, run, sha256, text in rows
            if self._load(_result, text).slices_sha256 != sha256
        ]

    def runs(self) -> dict[str, int]:
        """The number of results of each run; "live" is the flight itself."""
        return dict(self._rows("SELECT run, count(*) FROM results GROUP BY run ORDER BY min(rowid)"))

    def digests(self, table: str) -> dict[int, tuple[str, str]]:
        """(stored sha256, record text) by index, of "poses" or "tags"."""
        if table not in ("poses", "tags"):
            raise ValueError(f"no digests are kept of {table}")
        rows = self._rows(f"SELECT idx, sha256, record FROM {table} ORDER BY idx")  # noqa: S608  one of two words
        return {index: (sha256, text) for index, sha256, text in rows}

    def events(self) -> list[LedgerEvent]:
        return [LedgerEvent(*row) for row in self._rows("SELECT * FROM events ORDER BY number")]

    def facts(self) -> dict[str, Any]:
        """Values that hold for the whole flight: telemetry_sha256, closed_utc_ns …"""
        return {key: json.loads(value) for key, value in self._rows("SELECT key, value FROM facts")}

    def utc_correction_ns(self) -> int | None:
        """What to add to every `utc_ns` of this flight to get UTC: 0 where the machine knew UTC, None where it never
        learnt it."""
        facts = self.facts()
        if "utc_correction" in facts:
            return int(facts["utc_correction"]["correction_ns"])
        return 0 if facts.get("utc_known", True) else None

    def damage(self) -> list[str]:
        """What SQLite's integrity check finds wrong; empty when the file is intact."""
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
        if application != _APPLICATION_ID:
            raise FlightError(f"{self.path} is not a dappled ledger; give a flight folder that dappled recorded")
        if version != _SCHEMA_VERSION:
            raise FlightError(
                f"the ledger {self.path} has version {version}, this dappled reads version {_SCHEMA_VERSION}; "
                "use the dappled that recorded it, or a newer one"
            )


def ledger_damage(path: Path) -> str | None:
    """What SQLite finds wrong with the content of a ledger; None where it is intact, missing, or can't be read."""
    if not path.is_file():
        return None
    try:
        with LedgerReader.open(path) as ledger:
            return next(iter(ledger.damage()), None)
    except FlightError as error:
        code = getattr(error.__cause__, "sqlite_errorname", "") or ""
        return str(error) if code.startswith(("SQLITE_NOTADB", "SQLITE_CORRUPT")) else None


class Ledger(LedgerReader):
    """Write a ledger. Every method is one short transaction, durable when it returns, and may raise FlightError."""

    def __init__(self, path: Path, utc_ns: Callable[[], int]) -> None:
        """Open a flight's ledger, or make it. `utc_ns` stamps the events."""
        self._utc_ns = utc_ns
        super().__init__(path, uri=f"{path.absolute().as_uri()}?mode=rwc", create=True)
        try:
            with self._speaking():
                self._db.execute("PRAGMA journal_mode=WAL")
                self._db.execute("PRAGMA synchronous=FULL")
                self._db.execute("PRAGMA foreign_keys=ON")
                if self._db.execute("PRAGMA application_id").fetchone()[0] == 0:
                    self._db.executescript(
                        f"BEGIN IMMEDIATE; PRAGMA application_id={_APPLICATION_ID};"
                        f"PRAGMA user_version={_SCHEMA_VERSION};{SCHEMA}COMMIT;"
                    )
        except BaseException:
            self._db.close()
            raise

    def add_shot(self, shot: Shot) -> None:
        """Add a shot that is in the journal."""
        with self._transaction():
            if self.shot(shot.index) is not None:
                raise FlightError(f"shot {shot.index} is in the ledger {self.path} already")
            cause = shot.cause
            self._db.execute(
                "INSERT INTO shots VALUES (?, ?, ?, ?, ?, ?, 'wished', NULL, NULL, NULL)",
                (shot.index, cause.source, cause.kind, cause.sequence, shot.wished_utc_ns, shot.wished_monotonic_ns),
            )

    def fired(self, index: int, called_monotonic_ns: int, returned_monotonic_ns: int) -> None:
        """Note that the trigger call was made between these times."""
        with self._transaction():
            self._advance(index, "fired")
            self._db.execute(
                "UPDATE shots SET fired_called_monotonic_ns = ?, fired_returned_monotonic_ns = ? WHERE idx = ?",
                (called_monotonic_ns, returned_monotonic_ns, index),
            )

    def failed(self, index: int, reason: str) -> None:
        """Note that the shot gives no frame. `reason` is a sentence."""
        with self._transaction():
            self._advance(index, "failed", reason)
            self._event("failed", reason, index)

    def safe(self, frame: Frame) -> None:
        """Acknowledge a frame whose bytes and name are durable."""
        with self._transaction():
            before = self._advance(frame.index, "safe")
            values = (frame.index, frame.name, frame.camera_name, frame.size, frame.sha256, frame.arrived_utc_ns)
            self._db.execute("INSERT INTO frames VALUES (?, ?, ?, ?, ?, ?)", values)
            if before == "failed":
                self._event("late", f"the file {frame.camera_name} came after the shot had been given up", frame.index)

    def follows(self, index: int, reason: str) -> None:
        """Note that the shot was fired and its file is still on the camera: it counts as failed until picked up."""
        with self._transaction():
            self._advance(index, "failed", reason)
            self._event("follows", reason, index)

    def add_companion(self, companion: Frame) -> None:
        """Add a file beside a frame; it is durable under its name."""
        with self._transaction():
            one = companion
            values = (one.name, one.index, one.camera_name, one.size, one.sha256, one.arrived_utc_ns)
            self._db.execute("INSERT INTO companions VALUES (?, ?, ?, ?, ?, ?)", values)

    def add_stray(self, stray: Stray) -> None:
        """Add a file that belongs to no shot, or is a second one; it is durable under its name."""
        with self._transaction():
            values = (stray.name, stray.camera_name, stray.size, stray.sha256, stray.arrived_utc_ns, stray.reason)
            self._db.execute("INSERT INTO strays VALUES (?, ?, ?, ?, ?, ?)", values)
            self._event("stray", stray.reason, None)

    def add_tag(self, tag: Tag) -> None:
        """Add a frame's tag and, with a digest of its own, the pose in it."""
        with self._transaction():
            for table, record in (("poses", tag.pose), ("tags", tag)):
                self._db.execute(
                    f"INSERT INTO {table} VALUES (?, ?, ?)",  # noqa: S608  one of two words
                    (tag.index, digest(record), canonical(asdict(record)).decode()),
                )

    def add_result(self, result: Result) -> None:
        """Add the result of decoding a frame; once for each run."""
        with self._transaction():
            values = (result.index, result.run, result.slices_sha256, canonical(asdict(result)).decode())
            self._db.execute("INSERT INTO results VALUES (?, ?, ?, ?)", values)

    def add_event(self, kind: str, text: str, index: int | None = None) -> None:
        with self._transaction():
            self._event(kind, text, index)

    def set_fact(self, key: str, value: object) -> None:
        """Store a value that holds for the whole flight; replaces an earlier one."""
        with self._transaction():
            self._db.execute("INSERT OR REPLACE INTO facts VALUES (?, ?)", (key, canonical(value).decode()))

    def _event(self, kind: str, text: str, index: int | None) -> None:
        values = (self._utc_ns(), kind, index, text)
        self._db.execute("INSERT INTO events (utc_ns, kind, idx, text) VALUES (?, ?, ?, ?)", values)

    def _advance(self, index: int, new: ShotState, reason: str | None = None) -> ShotState:
        row = self.shot(index)
        if row is None:
            raise FlightError(f"no shot {index} is in the ledger {self.path}: it was never requested")
        advance(index, row.state, new)
        self._db.execute("UPDATE shots SET state = ?, reason = ? WHERE idx = ?", (new, reason, index))
        return row.state

    @contextmanager
    def _transaction(self) -> Iterator[None]:
        with self._lock, self._speaking():
            self._db.execute("BEGIN IMMEDIATE")
            try:
                yield
                self._db.execute("COMMIT")
            except BaseException:
                if self._db.in_transaction:
                    self._db.execute("ROLLBACK")
                raise


def _shot_row(row: Sequence[Any]) -> ShotRow:
    """A row of `shots`."""
    index, source, kind, sequence, utc_ns, monotonic_ns, state, reason, called, returned = row
    shot = Shot(index, Cause(source, kind, sequence), utc_ns, monotonic_ns)
    return ShotRow(shot, cast(ShotState, state), reason, called, returned)


def _pose(value: dict[str, Any]) -> Pose:
    """A record of `poses`. Raises TypeError for anything else."""
    made: dict[str, Any] = {key: tuple(item) for key, item in value.items() if isinstance(item, list)}
    if value.get("gnss") is not None:
        made["gnss"] = Gnss(**value["gnss"])
    return Pose(**{**value, **made})


def _tag(value: dict[str, Any]) -> Tag:
    """A record of `tags`. Raises TypeError or KeyError for anything else."""
    return Tag(**{**value, "pose": _pose(value["pose"])})


def _result(value: dict[str, Any]) -> Result:
    """A record of `results`. Raises TypeError for anything else."""
    return Result(**value)
