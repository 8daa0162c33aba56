"""Look for what dappled does not leave in a flight folder: links, pipes, half-written files, empty folders, leftovers.

Files that no seal covers are found with the seals, and files in frames/ with the ledger's rows.
"""

from __future__ import annotations

import os
from collections.abc import Iterator
from dataclasses import dataclass, replace
from pathlib import Path

from dappled import durable
from dappled.findings import Code, Finding, Level, Subject, finding
from dappled.flight import layout
from dappled.flight.layout import FlightFolder

_ROLLBACK = "-journal"
_OF_READERS = ("-wal", "-shm")
_RECORDED = ("frames", "inputs")  # folders in which only dappled writes


@dataclass(frozen=True, slots=True)
class PlaceFindings:
    """What stands in a flight folder apart from ordinary files, as it was before the ledger was opened. `rollback` says
    why the ledger can't be opened without being changed."""

    unknown: tuple[Finding, ...] = ()
    half_written: tuple[Finding, ...] = ()
    empty: tuple[Finding, ...] = ()
    left_by_readers: tuple[Finding, ...] = ()
    rollback: Finding | None = None


def look(folder: FlightFolder) -> PlaceFindings:
    """Look through a flight folder; no link is followed, and no file opened. Raises OSError."""
    unknown, half_written, empty = [], [], []
    for entry, name in _entries(folder.path):
        if entry.is_symlink():
            unknown.append(_found(Code.FILE_LINKED, name))
        elif name == layout.UNFINISHED:
            unknown.append(_found(Code.FLIGHT_COPY_UNFINISHED, name))
        elif durable.is_temporary(entry.name) and Path(name).parent.as_posix() != folder.frames.name:
            half_written.append(_found(Code.FILE_HALF_WRITTEN, name))
        elif entry.is_dir():
            if name != folder.frames.name and not os.listdir(entry):
                empty.append(_found(Code.FLIGHT_EMPTY_FOLDER, name))
        elif not entry.is_file():
            unknown.append(_found(Code.FILE_SPECIAL, name))
    beside = {suffix: folder.ledger.with_name(folder.ledger.name + suffix) for suffix in (*_OF_READERS, _ROLLBACK)}
    rollback = None
    if beside[_ROLLBACK].is_file() and (size := beside[_ROLLBACK].stat().st_size):
        rollback = finding(Code.LEDGER_ROLLBACK, Subject("ledger"), name=beside[_ROLLBACK].name, bytes=size)
    left = tuple(
        _found(Code.FLIGHT_LEFT_OPEN, path.name)
        for suffix, path in beside.items()
        if path.is_file() and (suffix == "-shm" or path.stat().st_size == 0)
    )
    return PlaceFindings(tuple(unknown), tuple(half_written), tuple(empty), left, rollback)


def compare(
    found: PlaceFindings, folder: FlightFolder, recorded_as: str, *, closed: bool, at_work: bool
) -> list[Finding]:
    """What is wrong, and notes. `recorded_as` is the name that it was recorded under, "" where that isn't known.

    While a flight is recorded, files are half-written and the ledger is open; `at_work` after it was opened again and
    not sealed since.
    """
    whole = [*found.unknown]
    if recorded_as not in ("", folder.name):
        level = Level.STOP if layout.is_flight_name(folder.name) else Level.NOTE
        names = {"folder": folder.name, "recorded": recorded_as}
        whole.append(Finding(Code.FLIGHT_RENAMED, Subject("flight"), names, level))
    if closed:
        for one in found.half_written:
            name = str(one.subject.which)
            recorded = name.split("/", maxsplit=1)[0] in _RECORDED or durable.is_temporary(name)
            whole.append(one if recorded and not at_work else replace(one, level=Level.NOTE))
        whole += [*found.empty, *found.left_by_readers]
    return whole


def _found(code: Code, name: str) -> Finding:
    return finding(code, Subject("file", name), name=name)


def _entries(top: Path) -> Iterator[tuple[os.DirEntry[str], str]]:
    """Everything below a folder, with its name relative to it; folders before what is in them."""
    todo = [""]
    while todo:
        place = todo.pop()
        with os.scandir(top / place) as scan:
            entries = sorted(scan, key=lambda entry: entry.name)
        for entry in entries:
            name = f"{place}{entry.name}"
            yield entry, name
            if entry.is_dir(follow_symlinks=False):
                todo.append(f"{name}/")
