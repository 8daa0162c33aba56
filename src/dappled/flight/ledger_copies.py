"""Bring a ledger and its seals to a copy of the flight, and say by their chains which of the two is the later one.

Links are only added to a chain. So the ledger whose chain begins with all of the other's is the later one; where
neither does, work went on at both, and nothing is replaced.
"""

from __future__ import annotations

import hashlib
from collections.abc import Mapping, Sequence
from pathlib import Path

from dappled import durable
from dappled.bounds.parsing import check_stored
from dappled.findings import Finding, text
from dappled.flight import seals
from dappled.flight.chain import Column
from dappled.flight.checks import chain_check
from dappled.flight.errors import FlightError
from dappled.flight.stored_rows import StoredRows
from dappled.flight.trees import Tree
from dappled.flight.verified_copy import Proved, different, prove

Rows = Mapping[str, Sequence[Sequence[Column]]]


def is_part(name: str) -> bool:
    """Whether a file of the flight belongs to the ledger: SQLite's own files, which are not copied as they are, and the
    seals, which go with the ledger."""
    return name in ("flight.sqlite", "flight.sqlite-wal", "flight.sqlite-shm", "seals.jsonl")


def bring(source: Tree, there: Tree, name: str) -> tuple[Proved, Rows]:
    """Copy the ledger as SQLite sees it, its write-ahead log included. A copy that is an earlier state of the source's
    is replaced, a later one stays. Returns the proof of the copy, and the rows that it has and the source's lacks, by
    table, with their links: work at the copy added them.

    Raises FlightError where each has links that the other lacks, where one of them is not what its own chain says and
    the copy would be replaced, or a disk refuses.
    """
    with StoredRows.open(source.path / name) as ours:
        image, head = ours.image(), ours.last_link()
        if there.stat(name) is not None:
            goal = there.path / name
            try:
                with StoredRows.open(goal) as theirs:
                    held, their_head = theirs.image(), theirs.last_link()
                    stays = held == image or (head is not None and theirs.link(head.number) == head)
                    later = theirs.written_after(head.number) if stays and head is not None else {}
                    wrong = () if stays else chain_check.compare(theirs).problems
            except FlightError as error:
                raise FlightError(
                    f"{goal} is there already and is no copy of the ledger ({error}): move it away first"
                ) from error
            if stays:
                return _proved(source, there, name, held), later
            if their_head is None or ours.link(their_head.number) != their_head:
                raise _apart(source, there, name)
            _refuse_edited(goal, wrong)
            _refuse_edited(source.path / name, chain_check.compare(ours).problems)
    there.write(name, [image])
    return _proved(source, there, name, image), {}


def _apart(source: Tree, there: Tree, name: str) -> FlightError:
    return FlightError(
        f"{there.path / name} is there already and differs from {source.path / name}, and each holds what the other "
        f"lacks: move {there.path} away, and offload again; where frames were removed here, copy them back first"
    )


def _refuse_edited(ledger: Path, problems: Sequence[Finding]) -> None:
    """Raise FlightError for a ledger that something other than dappled wrote in: neither the only one of its kind nor
    one that may replace another."""
    if problems:
        raise FlightError(
            f"{ledger} is not what its chain says ({text(problems[0])}): the copy's ledger was not replaced, and "
            f"nothing was removed; run `dappled flight check {ledger.parent}`, and move the copy with the wrong one "
            "away"
        )


class SealLines:
    """The seals of a flight and of a copy of it, and which earlier states of its files they show, where one of the two
    has all lines of the other and more: it is the later one."""

    def __init__(self, source: Tree, there: Tree, name: str) -> None:
        """`name` is that of the file of seals. Raises FlightError, also where each has lines that the other lacks."""
        self._source, self._there, self._name = source, there, name
        self._ours, self._theirs = _content(source, name), _content(there, name)
        if not self._ours.startswith(self._theirs) and not self._theirs.startswith(self._ours):
            raise _apart(source, there, name)
        self.source_is_later = len(self._ours) > len(self._theirs) > 0
        self.copy_is_later = len(self._theirs) > len(self._ours) > 0
        self._states: set[tuple[str, str]] = set()
        if self.source_is_later or self.copy_is_later:
            found = seals.parse(max(self._ours, self._theirs, key=len), name).seals.values()
            self._states = {(file, sha256) for seal in found for file, (_, sha256) in seal.files.items()}

    def bring(self) -> dict[str, Proved]:
        """Copy the seals, unless the copy has them all; the proof by name, none where the source has none. Raises
        FlightError."""
        if self._source.stat(self._name) is None:
            return {}
        if len(self._ours) > len(self._theirs):
            self._there.write(self._name, [self._ours])
        later = max(self._ours, self._theirs, key=len)
        return {self._name: _proved(self._source, self._there, self._name, later)}

    def differ(self, name: str) -> bool:
        """Whether work may have written this file anew since one of the two copies was sealed."""
        return bool(self._states) and not seals.never_changes(name)

    def has(self, name: str, sha256: str) -> bool:
        """Whether a file that later work may write anew had this content when the flight was sealed."""
        return not seals.never_changes(name) and (name, sha256) in self._states


def _content(tree: Tree, name: str) -> bytes:
    """A file's bytes; none where there is no file."""
    if tree.stat(name) is None:
        return b""
    with tree.reading(name) as fd:
        return b"".join(bytes(piece) for piece in durable.pieces(fd, check_stored(fd)))


def _proved(source: Tree, there: Tree, name: str, image: bytes) -> Proved:
    return prove(there, name, hashlib.sha256(image).hexdigest(), different(source, there, name))
