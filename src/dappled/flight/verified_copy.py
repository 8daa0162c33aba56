"""Bring a file's bytes to another folder, and prove that they are on the disk there.

This is the one way to another disk: written whole under a temporary name, fsynced, renamed, the folder fsynced, then
read back past the page cache and compared. The caller syncs the folders of what was there already (`Tree.sync`).
"""

from __future__ import annotations

import hashlib
from collections.abc import Callable, Iterable, Iterator
from dataclasses import dataclass

from dappled import durable
from dappled.flight import read_back
from dappled.flight.errors import FlightError, disk_errors
from dappled.flight.read_back import ReadBack
from dappled.flight.trees import FileIdentity, Tree


@dataclass(frozen=True, slots=True)
class Proved:
    """A file with a proved copy: which file it is, the SHA-256 of its bytes, which file the copy is, and how that was
    read back. Where it has no file here any more, `identity` is the copy's."""

    identity: FileIdentity
    sha256: str
    copy: FileIdentity
    how: ReadBack


def copy_verified(origin: Tree, goal: Tree, name: str, before: FileIdentity | None = None) -> Proved:
    """Copy a file over what stands at the goal. `before`: only while it is still that file. Raises FlightError where
    it changed meanwhile, the copy reads back different, or a disk refuses."""
    sha256 = hashlib.sha256()
    with origin.reading(name) as fd:
        found = FileIdentity.of_fd(fd)
        _refuse_changed(origin, name, before or found, found)
        goal.write(name, _hashed(durable.pieces(fd, found.size), sha256.update))
        _refuse_changed(origin, name, found, FileIdentity.of_fd(fd))
    return prove(goal, name, sha256.hexdigest(), different(origin, goal, name), found)


def different(origin: Tree, goal: Tree, name: str) -> str:
    """The sentence on a file that was written, and reads back with other bytes."""
    return f"{goal.path / name} reads back different from {origin.path / name}: check that disk; nothing was removed"


def hashed(tree: Tree, name: str) -> tuple[FileIdentity, str]:
    """Which file stands there, and its SHA-256. Raises FlightError, also where it changes meanwhile."""
    with tree.reading(name) as fd:
        before = FileIdentity.of_fd(fd)
        sha256 = durable.hash_descriptor(fd, before.size)
        _refuse_changed(tree, name, before, FileIdentity.of_fd(fd))
    return before, sha256


def prove(goal: Tree, name: str, sha256: str, wrong: str, identity: FileIdentity | None = None) -> Proved:
    """fsync a copy and read it back. `identity` is the original's, where there is one. Raises FlightError (`wrong`)
    where it has other bytes, and where it can't be read."""
    copy = copy_of(goal, name)
    folder, _, last = name.rpartition("/")
    with disk_errors("read back", goal.path / name):
        found, how = read_back.hash_on_disk(last, goal.folders[folder])
    if found != sha256 or copy is None:
        raise FlightError(wrong)
    return Proved(identity or copy, sha256, copy, how)


def copy_of(goal: Tree, name: str) -> FileIdentity | None:
    """Which file a copy is now; None where there is none."""
    found = goal.stat(name)
    return None if found is None else FileIdentity.of(found)


def _hashed(pieces: Iterable[memoryview], update: Callable[[memoryview], object]) -> Iterator[memoryview]:
    for piece in pieces:
        update(piece)
        yield piece


def _refuse_changed(tree: Tree, name: str, before: FileIdentity, after: FileIdentity) -> None:
    if before != after:
        raise FlightError(f"{tree.path / name} changed while it was copied; try again")
