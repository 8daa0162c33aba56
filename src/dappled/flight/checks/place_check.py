"""Look for what dappled does not leave in a flight folder: links, pipes, half-written files, empty folders, leftovers.

Files that no seal covers are found with the seals.
"""

from __future__ import annotations

import os
from collections.abc import Container
from dataclasses import dataclass, replace

from dappled import durable
from dappled.findings import Code, Finding, Level, Subject, finding
from dappled.flight import layout
from dappled.flight.layout import FlightFolder

_ROLLBACK = "-journal"
_OF_READERS = ("-wal", "-shm")
_RECORDED = ("frames", "inputs")  # folders in which only dappled writes


@dataclass(frozen=True, slots=True)
class PlaceFindings:
    """What stands in a flight folder apart from ordinary files, and what stands in frames/, by name, as it was before
    the ledger was opened. `rollback` says why the ledger can't be opened without being changed."""

    unknown: tuple[Finding, ...] = ()
    half_written: tuple[Finding, ...] = ()
    empty: tuple[Finding, ...] = ()
    left_by_readers: tuple[Finding, ...] = ()
    rollback: Finding | None = None
    frames: tuple[str, ...] = ()


def look(folder: FlightFolder) -> PlaceFindings:
    """Look through a flight folder; no link is followed, and no file opened. Raises OSError."""
    unknown, half_written, empty, frames = [], [], [], []
    if not folder.frames.is_dir():
        unknown.append(_found(Code.FILE_SPECIAL, folder.frames.name))
    for name, entry in folder.entries():
        if name.rpartition("/")[0] == folder.frames.name and not durable.is_temporary(entry.name):
            frames.append(name)
        if entry.is_symlink():
            unknown.append(_found(Code.FILE_LINKED, name))
        elif name == layout.UNFINISHED:
            unknown.append(_found(Code.FLIGHT_COPY_UNFINISHED, name))
        elif durable.is_temporary(entry.name):
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
    return PlaceFindings(tuple(unknown), tuple(half_written), tuple(empty), left, rollback, tuple(frames))


def compare(
    found: PlaceFindings, folder: FlightFolder, recorded_as: str, known: Container[str], *, closed: bool, at_work: bool
) -> list[Finding]:
    """What is wrong, and notes. It was recorded as `recorded_as`, "" where that isn't known; `known` files have a row.

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
            stays = recorded and (not at_work or name.startswith(f"{folder.frames.name}/."))
            whole.append(one if stays else replace(one, level=Level.NOTE))
        unlisted = (name for name in found.frames if name not in known and not name.endswith(layout.SIDECAR))
        whole += [_found(Code.FILE_UNLISTED, name) for name in unlisted]
        whole += [*found.empty, *found.left_by_readers]
    return whole


def _found(code: Code, name: str) -> Finding:
    return finding(code, Subject("file", name), name=name)
