"""A SQLite file behind a lock: the ledger's and the index's connection."""

from __future__ import annotations

import sqlite3
import threading
from abc import ABC, abstractmethod
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any, Self

from dappled.flight.errors import FlightError

_BUSY_S = 10.0


class Database(ABC):
    """One connection, which threads may share. What SQLite says is told as `_sentence` has it."""

    def __init__(self, path: Path, uri: str) -> None:
        """Connect to `uri`, and see by `_identify` whose file it is. Raises FlightError."""
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
        """Look whether the file is ours, and make it ours where it is new. Raises FlightError and sqlite3.Error."""

    @abstractmethod
    def _sentence(self, error: sqlite3.Error) -> FlightError:
        """What can't be done, why, and what to do."""

    def _identity(self) -> tuple[bool, int, int]:
        """(whether nothing is in the file, application id, version)."""
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
