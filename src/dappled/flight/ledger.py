"""The ledger: one SQLite file that records the outcome of every shot. A row in it is the acknowledgement.

WAL with synchronous=FULL: a committed row survives a power cut. Poses, tags and results are kept as the canonical JSON
that was hashed, so that `sha256(record)` can be checked with SQLite and sha256sum alone.
"""

from __future__ import annotations

import os
import sqlite3
import threading
from abc import abstractmethod
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import astuple, replace
from pathlib import Path
from typing import Any, Self, TypeVar, cast

from dappled import codec, findings
from dappled.clock import Clock
from dappled.closing import Closing
from dappled.codec import CodecError, canonical
from dappled.decode.geometry import Pose
from dappled.findings import FRAME, Code, Finding, finding
from dappled.flight import chain
from dappled.flight.chain import ChainLink, Column, digest
from dappled.flight.errors import FlightError, ledger_error
from dappled.flight.logs import TelemetryLog
from dappled.flight.records import Cause, Frame, LedgerEvent, Result, Shot, ShotRow, ShotState, Stray, Tag
from dappled.flight.tables import (
    APPLICATION_ID,
    DEFINITIONS,
    KEYS,
    LINKS,
    ROW_OF,
    SCHEMA,
    SCHEMA_VERSION,
    TELEMETRY,
    TRANSITIONS,
)

LIVE = "live"
BUSY_S = 10.0
_MOST_VALUE = 16 << 20  # bytes of a value or row; the longest that dappled writes takes some kB
_Record = TypeVar("_Record")
_COMPUTES = (
    "SELECT iif(type = 'table', 'virtual table', type), name FROM sqlite_master "
    "WHERE type NOT IN ('table', 'index') OR type = 'table' AND rootpage = 0"
)
_COMPUTED = (
    "SELECT 'computed column', made.name FROM sqlite_master, pragma_table_xinfo(sqlite_master.name) AS made "
    "WHERE sqlite_master.type = 'table' AND made.hidden"
)


def advance(index: int, old: ShotState, new: ShotState) -> ShotState:
    """`new`, when a shot may go there from `old`. Raises FlightError."""
    if new not in TRANSITIONS[old]:
        raise FlightError(f"shot {index} is {old}: it can't become {new}")
    return new


class Database(Closing):
    """One SQLite connection behind a lock, so that threads may share it. `_sentence` words SQLite's errors."""

    def __init__(self, path: Path, uri: str) -> None:
        """Connect to `uri` and check with `_identify` that the file is ours. Raises FlightError."""
        self.path = path
        self._lock = threading.RLock()
        try:
            self._db = sqlite3.connect(uri, uri=True, timeout=BUSY_S, isolation_level=None, check_same_thread=False)
            self._db.setlimit(sqlite3.SQLITE_LIMIT_LENGTH, _MOST_VALUE)
        except sqlite3.Error as error:
            raise self._sentence(error) from error
        try:
            with self._speaking():
                self._identify()
                self._refuse_what_computes()
        except BaseException:
            self._db.close()
            raise

    def close(self) -> None:
        """Close the connection; the last one to close folds the WAL into the file."""
        with self._lock:
            self._db.close()

    @abstractmethod
    def _identify(self) -> None:
        """Check that the file is ours; set up a new one. Raises FlightError and sqlite3.Error."""

    @abstractmethod
    def _sentence(self, error: sqlite3.Error | UnicodeDecodeError) -> FlightError:
        """The error for a person: what can't be done, why, and what to do."""

    def _identity(self) -> tuple[bool, int, int]:
        """(whether the file is empty, application id, version)."""
        empty = self._db.execute("SELECT count(*) FROM sqlite_master").fetchone()[0] == 0
        application = self._db.execute("PRAGMA application_id").fetchone()[0]
        return empty, application, self._db.execute("PRAGMA user_version").fetchone()[0]

    def _refuse_what_computes(self) -> None:
        """Views, triggers, virtual tables and generated columns compute without end, or more than memory holds."""
        strange = self._db.execute(_COMPUTES).fetchone() or self._db.execute(_COMPUTED).fetchone()
        if strange:
            kind, name = strange
            raise FlightError(
                f"{self.path} holds the {kind} {name!r}, which dappled didn't make: use another copy of it"
            )

    def _rows(self, sql: str, *values: object) -> list[Any]:
        with self._lock, self._speaking():
            return self._db.execute(sql, values).fetchall()

    @contextmanager
    def _speaking(self) -> Iterator[None]:
        try:
            yield
        except (sqlite3.Error, UnicodeDecodeError) as error:
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
        journal = path.with_name(path.name + "-journal")
        if journal.is_file() and journal.stat().st_size:
            raise FlightError(f"{journal} stands beside the ledger, and SQLite would change it by that: move it away")
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
        return self._one(_shot_row, "SELECT * FROM shots WHERE idx = ?", index)

    def frames(self) -> list[Frame]:
        """All safe frames, by index."""
        return [Frame(*row) for row in self._rows("SELECT * FROM frames ORDER BY idx")]

    def frame(self, index: int) -> Frame | None:
        return self._one(lambda row: Frame(*row), "SELECT * FROM frames WHERE idx = ?", index)

    def companions(self) -> list[Frame]:
        """Files beside frames, such as the JPEG of a raw frame; each has the index of its frame."""
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
        rows = self._rows("SELECT * FROM strays ORDER BY name")
        return [replace(Stray(*row), reason=findings.of_json_text(row[5])) for row in rows]

    def poses(self) -> dict[int, Pose]:
        return {index: self._load(Pose, text) for index, text in self._rows("SELECT idx, record FROM poses")}

    def tags(self) -> dict[int, Tag]:
        return {index: self._load(Tag, text) for index, text in self._rows("SELECT idx, record FROM tags")}

    def tag(self, index: int) -> Tag | None:
        return self._record(Tag, "SELECT record FROM tags WHERE idx = ?", index)

    def results(self, run: str = "live") -> dict[int, Result]:
        """The decoding results of one run, by index."""
        rows = self._rows("SELECT record FROM results WHERE run = ? ORDER BY idx", run)
        return {result.index: result for result in (self._load(Result, row[0]) for row in rows)}

    def result(self, index: int, run: str = "live") -> Result | None:
        return self._record(Result, "SELECT record FROM results WHERE idx = ? AND run = ?", index, run)

    def runs(self) -> dict[str, int]:
        """The number of results of each run; "live" is the flight itself."""
        return dict(self._rows("SELECT run, count(*) FROM results GROUP BY run ORDER BY min(rowid)"))

    def digests(self, table: str) -> dict[int, tuple[str, str]]:
        """(stored sha256, record text) by index, of "poses" or "tags"."""
        if table not in ("poses", "tags"):
            raise ValueError(f"no digests are kept of {table}")
        rows = self._rows(f"SELECT idx, sha256, record FROM {table} ORDER BY idx")  # noqa: S608  one of two words
        return {index: (sha256, text) for index, sha256, text in rows}

    def keyed_rows(self, table: str) -> list[tuple[tuple[Column, ...], tuple[Column, ...]]]:
        """(primary key, whole row) of each row of a table that the chain covers."""
        key = KEYS[table]
        rows = self._rows(f"SELECT {', '.join(key)}, * FROM {table} ORDER BY {', '.join(key)}")  # noqa: S608  constants
        return [(row[: len(key)], row[len(key) :]) for row in rows]

    def last_link(self) -> ChainLink | None:
        """The head of the chain. Raises FlightError."""
        return self._one(lambda row: ChainLink(*row), f"{LINKS} ORDER BY number DESC LIMIT 1")

    def events(self) -> list[LedgerEvent]:
        return [LedgerEvent(*row) for row in self._rows("SELECT * FROM events ORDER BY number")]

    def found(self, *kinds: str) -> list[Finding]:
        """What the events of these kinds hold, in their order, as far as it can be read."""
        marks = ", ".join("?" * len(kinds))
        rows = self._rows(f"SELECT text FROM events WHERE kind IN ({marks}) ORDER BY number", *kinds)  # noqa: S608  marks
        return [found for (text,) in rows if (found := findings.of_json_text(text)) is not None]

    def facts(self) -> dict[str, Any]:
        """Values that hold for the whole flight: telemetry_sha256, closed_utc_ns …"""
        return {key: self._load(Any, value) for key, value in self._rows("SELECT key, value FROM facts")}

    def fact(self, kind: type[_Record], name: str) -> _Record | None:
        """One of these values; None where there is none. Raises FlightError for one of another kind."""
        return self._record(kind, "SELECT value FROM facts WHERE key = ?", name)

    def began_utc_ns(self) -> int | None:
        """When the flight began, by the machine's clock."""
        return self.fact(int, "began_utc_ns")

    def utc_correction_ns(self) -> int | None:
        """What to add to every `utc_ns` of this flight to get UTC: 0 where the machine knew UTC, None where it never
        learnt it."""
        correction = self.fact(dict[str, Any], "utc_correction")
        if correction is None:
            return None if self.fact(bool, "utc_known") is False else 0
        if type(found := correction.get("correction_ns")) is not int:
            raise FlightError(f"a record in the ledger {self.path} can't be read: UTC's correction is no whole number")
        return found

    def image(self) -> bytes:
        """The ledger as one file would hold it now, what stands in its write-ahead log included."""
        with self._lock, self._speaking():
            return self._db.serialize()

    def _one(self, read: Callable[[Sequence[Any]], _Record], sql: str, *values: object) -> _Record | None:
        """The first row, read; None where there is none."""
        return next((read(row) for row in self._rows(sql, *values)), None)

    def _record(self, kind: type[_Record], sql: str, *values: object) -> _Record | None:
        """The record in the first row; None where there is none."""
        return self._one(lambda row: self._load(kind, row[0]), sql, *values)

    def _load(self, kind: type[_Record], text: str) -> _Record:
        try:
            return codec.read_json(kind, text)
        except CodecError as error:
            raise FlightError(f"a record in the ledger {self.path} can't be read: {error}") from error

    def _sentence(self, error: sqlite3.Error | UnicodeDecodeError) -> FlightError:
        return ledger_error(self.path, error)

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


def is_closed(path: Path) -> bool:
    """Whether a ledger says that its flight was closed. Raises FlightError."""
    with LedgerReader.open(path) as ledger:
        return "closed_utc_ns" in ledger.facts()


def moved_aside(path: Path) -> Path:
    """Move a damaged SQLite file away; what stands beside it goes. Returns its new name. Raises OSError."""
    aside = path.with_name(path.name + ".damaged")
    os.replace(path, aside)
    for suffix in ("-wal", "-shm"):
        path.with_name(path.name + suffix).unlink(missing_ok=True)
    return aside


class Ledger(LedgerReader):
    """Write a ledger. Every method is one short transaction, durable when it returns, and may raise FlightError."""

    def __init__(self, path: Path, clock: Clock, telemetry: TelemetryLog | None = None) -> None:
        """Open a flight's ledger, or make it. `clock` stamps events; the chain covers the blocks of `telemetry` too."""
        self._clock, self._telemetry = clock, telemetry
        self._blocks = 0  # of the telemetry that have a link
        self._written: dict[tuple[str, tuple[Column, ...]], None] = {}  # (table, key) of rows that need a link
        super().__init__(path, uri=f"{path.absolute().as_uri()}?mode=rwc", create=True)
        try:
            with self._speaking():
                self._db.execute("PRAGMA journal_mode=WAL")
                self._db.execute("PRAGMA synchronous=FULL")
                self._db.execute("PRAGMA foreign_keys=ON")
            self._set_up()
        except BaseException:
            self._db.close()
            raise

    def add_shot(self, shot: Shot) -> None:
        """Add a shot that is in the journal."""
        with self._transaction():
            if self.shot(shot.index) is not None:
                raise FlightError(f"shot {shot.index} is in the ledger {self.path} already")
            values = (shot.index, *astuple(shot.cause), shot.wished_utc_ns, shot.wished_monotonic_ns)
            self._insert("shots", *values, "wished", None, None, None)

    def fired(self, index: int, called_monotonic_ns: int, returned_monotonic_ns: int) -> None:
        """Note that the trigger call was made between these times."""
        with self._transaction():
            self._advance(index, "fired")
            self._db.execute(
                "UPDATE shots SET fired_called_monotonic_ns = ?, fired_returned_monotonic_ns = ? WHERE idx = ?",
                (called_monotonic_ns, returned_monotonic_ns, index),
            )

    def failed(self, index: int, why: Finding) -> None:
        """Note that the shot gives no frame."""
        with self._transaction():
            self._end(index, "failed", why)

    def safe(self, frame: Frame) -> None:
        """Acknowledge a frame whose bytes and name are durable."""
        with self._transaction():
            before = self._advance(frame.index, "safe")
            self._insert("frames", *astuple(frame))
            if before == "failed":
                late = finding(Code.FRAME_LATE, FRAME, file=frame.camera_name)
                self._event("late", late, frame.index)

    def follows(self, index: int, why: Finding) -> None:
        """Note that the shot was fired and its file is still on the camera: it counts as failed until picked up."""
        with self._transaction():
            self._end(index, "follows", why)

    def add_companion(self, companion: Frame) -> None:
        """Add a file beside a frame; it is durable under its name."""
        with self._transaction():
            index, name, *others = astuple(companion)
            self._insert("companions", name, index, *others)

    def add_stray(self, stray: Stray) -> None:
        """Add a file that belongs to no shot, or is a second one; it is durable under its name."""
        with self._transaction():
            why = "" if stray.reason is None else findings.json_text(stray.reason)
            self._insert("strays", *astuple(replace(stray, reason=None))[:-1], why)
            if stray.reason is not None:
                self._event("stray", stray.reason, None)

    def add_tag(self, tag: Tag) -> None:
        """Add a frame's tag and, with a digest of its own, the pose in it."""
        with self._transaction():
            for table, record in (("poses", tag.pose), ("tags", tag)):
                self._insert(table, tag.index, digest(record), canonical(record).decode())

    def add_result(self, result: Result) -> None:
        """Add the result of decoding a frame; once for each run."""
        with self._transaction():
            self._insert("results", result.index, result.run, result.slices_sha256, canonical(result).decode())

    def add_event(self, kind: str, found: Finding, index: int | None = None) -> None:
        with self._transaction():
            self._event(kind, found, index)

    def set_fact(self, key: str, value: object) -> None:
        """Store a value that holds for the whole flight; replaces an earlier one."""
        with self._transaction():
            self._fact(key, value)

    def adopt(self, rows: Mapping[str, Iterable[Sequence[Column]]], found: Finding) -> None:
        """Add rows of a later state of this ledger, by table, with the links that they have there; `found` says so."""
        with self._transaction():
            for table, some in rows.items():
                for row in some:
                    self._put(table, row, "INSERT OR REPLACE")
            self._event("brought home", found, None)

    def fold(self) -> None:
        """Fold the WAL into the file, which then stays as it is until the next row. Raises FlightError where another
        program is reading for too long."""
        ((busy, _, _),) = self._rows("PRAGMA wal_checkpoint(TRUNCATE)")
        if busy:
            raise FlightError(
                f"the ledger {self.path} could not be folded: another program holds it; close that program"
            )

    def _fact(self, key: str, value: object) -> None:
        self._insert("facts", key, canonical(value).decode())

    def _event(self, kind: str, found: Finding, index: int | None) -> None:
        values = (self._clock.utc_ns(), kind, index, findings.json_text(found))
        row = self._db.execute("INSERT INTO events (utc_ns, kind, idx, text) VALUES (?, ?, ?, ?)", values)
        self._written["events", (row.lastrowid,)] = None

    def _insert(self, table: str, *values: Column) -> None:
        """Add a row, whose key stands first; only a fact may replace an earlier one."""
        self._put(table, values, "INSERT OR REPLACE" if table == "facts" else "INSERT")
        self._written[table, values[: len(KEYS[table])]] = None

    def _put(self, table: str, values: Sequence[Column], verb: str) -> None:
        self._db.execute(f"{verb} INTO {table} VALUES ({', '.join('?' * len(values))})", values)

    def _end(self, index: int, kind: str, why: Finding) -> None:
        self._advance(index, "failed", findings.json_text(why))
        self._event(kind, why, index)

    def _advance(self, index: int, new: ShotState, reason: str | None = None) -> ShotState:
        row = self.shot(index)
        if row is None:
            raise FlightError(f"no shot {index} is in the ledger {self.path}: it was never requested")
        advance(index, row.state, new)
        self._db.execute("UPDATE shots SET state = ?, reason = ? WHERE idx = ?", (new, reason, index))
        self._written["shots", (index,)] = None
        return row.state

    @contextmanager
    def _transaction(self) -> Iterator[None]:
        """Commit the rows written meanwhile together with their links, or neither."""
        with self._lock, self._speaking():
            self._db.execute("BEGIN IMMEDIATE")
            try:
                yield
                blocks = self._chain()
                self._db.execute("COMMIT")
                self._blocks += blocks
            except BaseException:
                if self._db.in_transaction:
                    self._db.execute("ROLLBACK")
                raise
            finally:
                self._written.clear()

    def _chain(self) -> int:
        """Add a link for each row that this transaction has written, as the row is now, and for each block of telemetry
        that has come since the last one; returns the number of blocks."""
        head = self.last_link()
        for table, key in self._written:
            row = self._db.execute(ROW_OF[table], key).fetchone()
            head = self._link(head, table, key, chain.row_digest(row))
        blocks = self._telemetry.blocks(self._blocks) if self._telemetry is not None and self._written else []
        for block in blocks:
            head = self._link(head, TELEMETRY, (block.start, block.end), block.sha256)
        return len(blocks)

    def _link(self, last: ChainLink | None, subject: str, key: Sequence[Column], sha256: str) -> ChainLink:
        link = chain.follow(last, subject, chain.json_array(key), sha256)
        self._put("chain", astuple(link), "INSERT")
        return link

    def _set_up(self) -> None:
        """Make the tables of a new ledger. Raises FlightError for one that has lost its chain."""
        with self._transaction():
            found = {row[0] for row in self._db.execute("SELECT name FROM sqlite_master WHERE type = 'table'")}
            if "chain" in found:
                return
            if found:
                raise FlightError(f"the chain was removed from the ledger {self.path}: nothing is added to it")
            for statement in SCHEMA.split(";\n"):
                self._db.execute(statement)
            self._db.execute(f"PRAGMA application_id={APPLICATION_ID}")
            self._db.execute(f"PRAGMA user_version={SCHEMA_VERSION}")
            last = None
            for row in self._db.execute("SELECT name, type, tbl_name, sql FROM sqlite_master ORDER BY name").fetchall():
                last = self._link(last, DEFINITIONS, row[:1], chain.row_digest(row))
            self._fact("chain", {"flight": self.path.absolute().parent.name})


def _shot_row(row: Sequence[Any]) -> ShotRow:
    """A row of `shots`."""
    index, source, kind, sequence, utc_ns, monotonic_ns, state, reason, called, returned = row
    shot = Shot(index, Cause(source, kind, sequence), utc_ns, monotonic_ns)
    why = None if reason is None else findings.of_json_text(reason)
    return ShotRow(shot, cast(ShotState, state), why, called, returned)
