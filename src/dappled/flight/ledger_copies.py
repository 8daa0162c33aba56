"""Copy a ledger as SQLite sees it, its write-ahead log included, and say which of two copies of it is the later one."""

from __future__ import annotations

import hashlib
import os
import sqlite3
from collections.abc import Mapping, Sequence
from contextlib import closing
from dataclasses import dataclass

from dappled import durable
from dappled.bounds.claims import ClaimError, check_size
from dappled.flight import seals
from dappled.flight.chain import Column
from dappled.flight.errors import FlightError
from dappled.flight.ledger import LedgerReader
from dappled.flight.pruning import Proved
from dappled.flight.tables import KEYS
from dappled.flight.trees import FileIdentity, Tree

_TABLES = "SELECT name FROM sqlite_master WHERE type = 'table'"
_GROWS = ("chain", "frames", "companions", "strays", "poses", "tags", "results", "events")
"""Tables whose rows are added and never changed. Of shots the state changes, of facts the value."""


def is_part(name: str) -> bool:
    """Whether a file of the flight belongs to the ledger: SQLite's own files, which are not copied as they are, and the
    seals, which go with the ledger."""
    return name in ("flight.sqlite", "flight.sqlite-wal", "flight.sqlite-shm", "seals.jsonl")


@dataclass(frozen=True, slots=True)
class Brought:
    """A ledger's copy: whether it was written, what it is now, and which rows it has that the source's lacks, by table:
    work at the copy added them."""

    written: bool
    proved: Proved
    later: Mapping[str, Sequence[Sequence[Column]]]


def bring(source: Tree, there: Tree, name: str) -> Brought:
    """Copy the ledger. A copy that is an earlier state of the source's is replaced, a later one stays: rows were added
    to it there.

    Raises FlightError where each has rows that the other lacks, or a disk refuses.
    """
    with LedgerReader.open(source.path / name) as ledger:
        image = ledger.image()
    goal = there.path / name
    if there.stat(name) is not None:
        try:
            with LedgerReader.open(goal) as held:
                theirs = held.image()
        except FlightError as error:
            raise FlightError(
                f"{goal} is there already and is no copy of the ledger ({error}): move it away first"
            ) from error
        if theirs == image:
            return Brought(False, _proved(there, name, image), {})
        if _within(image, theirs):
            return Brought(False, _proved(there, name, theirs), _added(image, theirs))
        if not _within(theirs, image):
            raise _apart(source, there, name)
    there.write(name, [image])
    return Brought(True, _proved(there, name, image), {})


def bring_seals(source: Tree, there: Tree, name: str) -> tuple[bool, Proved] | None:
    """Copy the seals, as `bring` does the ledger: lines are only added to them. None where the source has none.

    Raises FlightError where each has lines that the other lacks, or a disk refuses.
    """
    if source.stat(name) is None:
        return None
    ours, theirs = _content(source, name), _content(there, name)
    if theirs.startswith(ours):
        return False, _proved(there, name, theirs)
    if not ours.startswith(theirs):
        raise _apart(source, there, name)
    there.write(name, [ours])
    return True, _proved(there, name, ours)


def _apart(source: Tree, there: Tree, name: str) -> FlightError:
    return FlightError(
        f"{there.path / name} is there already and differs from {source.path / name}, and each holds what the other "
        f"lacks: move {there.path} away, and offload again; where frames were removed here, copy them back first"
    )


class SealedStates:
    """Which earlier states of a flight's files the seals of two copies of it show, where one of them has all seals of
    the other and more: it is the later one."""

    def __init__(self, source: Tree, there: Tree, name: str) -> None:
        """`name` is that of the file of seals. Raises FlightError."""
        ours, theirs = _content(source, name), _content(there, name)
        self.source_is_later = theirs != b"" and ours.startswith(theirs) and ours != theirs
        self.copy_is_later = ours != b"" and theirs.startswith(ours) and ours != theirs
        self._states: set[tuple[str, str]] = set()
        if self.source_is_later or self.copy_is_later:
            found = seals.parse(max(ours, theirs, key=len), name).seals.values()
            self._states = {(file, sha256) for seal in found for file, (_, sha256) in seal.files.items()}

    def has(self, name: str, sha256: str) -> bool:
        """Whether a file that later work may write anew had this content when the flight was sealed."""
        return not seals.never_changes(name) and (name, sha256) in self._states


def _content(tree: Tree, name: str) -> bytes:
    """A file's bytes; none where there is no file."""
    if tree.stat(name) is None:
        return b""
    with tree.reading(name) as fd:
        found = os.fstat(fd)
        try:
            check_size(found.st_size, found.st_blocks * 512, "content")
        except ClaimError as error:
            raise FlightError(f"{tree.path / name} can't be read: {error}") from error
        return b"".join(bytes(piece) for piece in durable.pieces(fd, found.st_size))


def _proved(there: Tree, name: str, image: bytes) -> Proved:
    found = there.stat(name)
    assert found is not None
    return Proved(FileIdentity.of(found), hashlib.sha256(image).hexdigest())


def _within(earlier: bytes, later: bytes) -> bool:
    """Whether every row of one ledger is in the other."""
    try:
        with closing(_opened(earlier)) as one, closing(_opened(later)) as other:
            return all(_rows(one, query) <= _rows(other, query) for query in _queries(one))
    except sqlite3.Error:
        return False


def _opened(image: bytes) -> sqlite3.Connection:
    connection = sqlite3.connect(":memory:")
    # SQLite reads no WAL database from memory; bytes 18 and 19 of the header say how it is journalled
    try:
        connection.deserialize(image[:18] + b"\1\1" + image[20:])
    except sqlite3.Error:
        connection.close()
        raise
    return connection


def _queries(ledger: sqlite3.Connection) -> list[str]:
    tables = {row[0] for row in ledger.execute(_TABLES)}
    whole = [f"SELECT * FROM {table}" for table in _GROWS if table in tables]  # noqa: S608  names of our own
    return [*whole, "SELECT idx, source, kind, sequence, wished_utc_ns FROM shots", "SELECT key FROM facts"]


def _added(earlier: bytes, later: bytes) -> dict[str, list[tuple[Column, ...]]]:
    """The rows of a later state of a ledger that the earlier one lacks or has otherwise, by table."""
    with closing(_opened(earlier)) as one, closing(_opened(later)) as other:
        known, tables = ({row[0] for row in db.execute(_TABLES)} for db in (one, other))
        found = {}
        for table in (name for name in (*KEYS, "chain") if name in tables):
            query = f"SELECT * FROM {table}"  # noqa: S608  names of our own
            before = _rows(one, query) if table in known else set()
            found[table] = [row for row in other.execute(query) if row not in before]
        return {table: rows for table, rows in found.items() if rows}


def _rows(ledger: sqlite3.Connection, query: str) -> set[tuple[Column, ...]]:
    return set(ledger.execute(query))
