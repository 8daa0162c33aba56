"""Read a ledger's rows as they are stored, however damaged the file is."""

from __future__ import annotations

import json
from pathlib import Path

from dappled.flight.chain import ChainLink, Column
from dappled.flight.errors import FlightError
from dappled.flight.ledger import LedgerReader
from dappled.flight.tables import LINKS, ROW_OF

StoredRow = tuple[Column, ...]


class StoredRows(LedgerReader):
    """A ledger as it was when this was opened, in one read transaction. Text that is not UTF-8 is read all the same.

    Methods raise FlightError where SQLite can't read on.
    """

    def __init__(self, path: Path, *, uri: str) -> None:
        """Open a ledger."""
        super().__init__(path, uri=uri)
        self._db.text_factory = lambda data: data.decode("utf-8", "surrogateescape")
        self._rows("BEGIN")

    def damage(self) -> list[str]:
        """What SQLite's integrity check finds wrong; empty when the file is sound."""
        try:
            found = [str(row[0]) for row in self._rows("PRAGMA integrity_check(10)")]
            return [] if found == ["ok"] else found
        except FlightError as error:
            return [str(error)]

    def definitions(self) -> list[StoredRow]:
        """(name, type, table, SQL) of each table and index."""
        return self._rows("SELECT name, type, tbl_name, sql FROM sqlite_master ORDER BY name")

    def links(self) -> list[StoredRow]:
        """The chain: (number, subject, key, sha256, link)."""
        return self._rows(f"{LINKS} ORDER BY number")

    def link(self, number: int) -> ChainLink | None:
        """One link of the chain."""
        return self._one(lambda row: ChainLink(*row), f"{LINKS} WHERE number = ?", number)

    def written_after(self, number: int) -> dict[str, list[StoredRow]]:
        """The rows that have a link after this one, by table, and those links."""
        links = self._rows("SELECT * FROM chain WHERE number > ? ORDER BY number", number)
        found: dict[str, list[StoredRow]] = {}
        for table, key in dict.fromkeys((link[1], link[2]) for link in links if link[1] in ROW_OF):
            try:
                found.setdefault(table, []).extend(self._rows(ROW_OF[table], *json.loads(key)))
            except (ValueError, TypeError, ArithmeticError, RecursionError) as error:
                raise FlightError(f"a link of {table} in the ledger {self.path} can't be read: {error}") from error
        return found | ({"chain": links} if links else {})


def ledger_damage(path: Path) -> str | None:
    """What SQLite finds wrong with the content of a ledger; None where it is sound, missing, or can't be read."""
    if not path.is_file():
        return None
    try:
        with StoredRows.open(path) as ledger:
            return next(iter(ledger.damage()), None)
    except FlightError as error:
        code = getattr(error.__cause__, "sqlite_errorname", "") or ""
        damaged = isinstance(error.__cause__, UnicodeDecodeError) or code.startswith(
            ("SQLITE_NOTADB", "SQLITE_CORRUPT")
        )
        return str(error) if damaged else None
