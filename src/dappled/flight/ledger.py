"""The ledger: one SQLite file that says what became of every wish. A row in it is the acknowledgement.

WAL with synchronous=FULL: a committed row survives a power cut. Poses, tags and results are kept as the canonical JSON
that was hashed, so that anybody can check `sha256(record)` with SQLite and sha256sum alone.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import asdict
from pathlib import Path

from dappled.flight.entries import Result, Stray
from dappled.flight.errors import FlightError
from dappled.flight.ledger_reader import LedgerReader, ledger_damage
from dappled.flight.ledger_schema import APPLICATION_ID, LIVE, SCHEMA, SCHEMA_VERSION
from dappled.flight.records import Frame, Shot, ShotState, Tag, canonical, digest
from dappled.flight.states import advance

__all__ = ["LIVE", "Ledger", "LedgerReader", "ledger_damage"]


class Ledger(LedgerReader):
    """The ledger's one writer. Every method is one short transaction, durable when it returns.

    All raise FlightError with a sentence when the ledger can't take it.
    """

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
                        f"BEGIN IMMEDIATE; PRAGMA application_id={APPLICATION_ID};"
                        f"PRAGMA user_version={SCHEMA_VERSION};{SCHEMA}COMMIT;"
                    )
        except BaseException:
            self._db.close()
            raise

    def add_shot(self, shot: Shot) -> None:
        """A wish, from the journal."""
        with self._transaction():
            if self.shot(shot.index) is not None:
                raise FlightError(f"shot {shot.index} is in the ledger {self.path} already")
            cause = shot.cause
            self._db.execute(
                "INSERT INTO shots VALUES (?, ?, ?, ?, ?, ?, 'wished', NULL, NULL, NULL)",
                (shot.index, cause.source, cause.kind, cause.sequence, shot.wished_utc_ns, shot.wished_monotonic_ns),
            )

    def fired(self, index: int, called_monotonic_ns: int, returned_monotonic_ns: int) -> None:
        """The trigger call was made, between these times."""
        with self._transaction():
            self._advance(index, "fired")
            self._db.execute(
                "UPDATE shots SET fired_called_monotonic_ns = ?, fired_returned_monotonic_ns = ? WHERE idx = ?",
                (called_monotonic_ns, returned_monotonic_ns, index),
            )

    def failed(self, index: int, reason: str) -> None:
        """The shot brings no frame. `reason` is a sentence."""
        with self._transaction():
            self._advance(index, "failed", reason)
            self._event("failed", reason, index)

    def safe(self, frame: Frame) -> None:
        """The frame's bytes and name are durable: this row acknowledges them."""
        with self._transaction():
            before = self._advance(frame.index, "safe")
            values = (frame.index, frame.name, frame.camera_name, frame.size, frame.sha256, frame.arrived_utc_ns)
            self._db.execute("INSERT INTO frames VALUES (?, ?, ?, ?, ?, ?)", values)
            if before == "failed":
                self._event("late", f"the file {frame.camera_name} came after the shot had been given up", frame.index)

    def follows(self, index: int, reason: str) -> None:
        """The shot was fired and its file stays at the camera: it has failed until the file is picked up."""
        with self._transaction():
            self._advance(index, "failed", reason)
            self._event("follows", reason, index)

    def add_companion(self, companion: Frame) -> None:
        """A file beside a frame, durable under its name."""
        with self._transaction():
            one = companion
            values = (one.name, one.index, one.camera_name, one.size, one.sha256, one.arrived_utc_ns)
            self._db.execute("INSERT INTO companions VALUES (?, ?, ?, ?, ?, ?)", values)

    def add_stray(self, stray: Stray) -> None:
        """A file that belongs to no shot, or is one too many, durable under its name."""
        with self._transaction():
            values = (stray.name, stray.camera_name, stray.size, stray.sha256, stray.arrived_utc_ns, stray.reason)
            self._db.execute("INSERT INTO strays VALUES (?, ?, ?, ?, ?, ?)", values)
            self._event("stray", stray.reason, None)

    def add_tag(self, tag: Tag) -> None:
        """A frame's tag and, with a digest of its own, the pose in it."""
        with self._transaction():
            for table, record in (("poses", tag.pose), ("tags", tag)):
                self._db.execute(
                    f"INSERT INTO {table} VALUES (?, ?, ?)",  # noqa: S608  one of two words
                    (tag.index, digest(record), canonical(asdict(record)).decode()),
                )

    def add_result(self, result: Result) -> None:
        """What decoding made of a frame; once for each run."""
        with self._transaction():
            values = (result.index, result.run, result.slices_sha256, canonical(asdict(result)).decode())
            self._db.execute("INSERT INTO results VALUES (?, ?, ?, ?)", values)

    def add_event(self, kind: str, text: str, index: int | None = None) -> None:
        with self._transaction():
            self._event(kind, text, index)

    def set_fact(self, key: str, value: object) -> None:
        """Something that holds for the whole flight; replaces what was noted before."""
        with self._transaction():
            self._db.execute("INSERT OR REPLACE INTO facts VALUES (?, ?)", (key, canonical(value).decode()))

    def _event(self, kind: str, text: str, index: int | None) -> None:
        values = (self._utc_ns(), kind, index, text)
        self._db.execute("INSERT INTO events (utc_ns, kind, idx, text) VALUES (?, ?, ?, ?)", values)

    def _advance(self, index: int, new: ShotState, reason: str | None = None) -> ShotState:
        row = self.shot(index)
        if row is None:
            raise FlightError(f"no shot {index} is in the ledger {self.path}: it was never wished for")
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
