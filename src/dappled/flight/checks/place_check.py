"""Look for what dappled does not leave in a flight folder: links, pipes, half-written files, empty folders, leftovers.

Files that no seal covers are found with the seals, and files in frames/ with the ledger's rows.
"""

from __future__ import annotations

import os
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

from dappled import durable
from dappled.errors import counted
from dappled.flight import layout
from dappled.flight.layout import FlightFolder

_ROLLBACK = "-journal"
_OF_READERS = ("-wal", "-shm")
_RECORDED = ("frames", "inputs")  # folders in which only dappled writes


@dataclass(frozen=True, slots=True)
class PlaceFindings:
    """What stands in a flight folder apart from ordinary files, as it was before the ledger was opened: (name relative
    to the flight, sentence). `rollback` says why the ledger can't be opened without being changed."""

    unknown: tuple[tuple[str, str], ...]
    half_written: tuple[tuple[str, str], ...]
    empty: tuple[tuple[str, str], ...]
    left_by_readers: tuple[str, ...]
    rollback: str | None


def look(folder: FlightFolder) -> PlaceFindings:
    """Look through a flight folder; no link is followed, and no file opened. Raises OSError."""
    unknown, half_written, empty = [], [], []
    for entry, name in _entries(folder.path):
        if entry.is_symlink():
            unknown.append((name, f"{name} is a link, which dappled never makes; it was not followed"))
        elif name == layout.UNFINISHED:
            unknown.append((name, "an offload to this folder was cut short: run it again"))
        elif durable.is_temporary(entry.name) and Path(name).parent.as_posix() != folder.frames.name:
            half_written.append((name, f"{name} is a half-written file"))
        elif entry.is_dir():
            if name != folder.frames.name and not os.listdir(entry):
                empty.append((name, f"{name} is an empty folder, which no seal covers"))
        elif not entry.is_file():
            unknown.append((name, f"{name} is no file (a pipe, a socket or a device), which dappled never makes"))
    beside = {suffix: folder.ledger.with_name(folder.ledger.name + suffix) for suffix in (*_OF_READERS, _ROLLBACK)}
    rollback = None
    if beside[_ROLLBACK].is_file() and (size := beside[_ROLLBACK].stat().st_size):
        rollback = (
            f"{beside[_ROLLBACK].name} ({counted(size, 'byte')}) stands beside the ledger, where dappled leaves none: "
            "SQLite would change the ledger by it, so the ledger was not opened; move it away, and check again"
        )
    left = tuple(
        f"{path.name} stands beside the ledger: another program has it open, or was killed; it holds no row"
        for suffix, path in beside.items()
        if path.is_file() and (suffix == "-shm" or path.stat().st_size == 0)
    )
    return PlaceFindings(tuple(unknown), tuple(half_written), tuple(empty), left, rollback)


def compare(
    found: PlaceFindings, folder: FlightFolder, recorded_as: str, *, closed: bool, at_work: bool
) -> tuple[list[str], list[str]]:
    """(problems, notes). `recorded_as` is the name that the flight was recorded under, "" where that isn't known.

    While a flight is recorded, files are half-written and the ledger is open; `at_work` after it was opened again and
    not sealed since.
    """
    problems = [text for _, text in found.unknown]
    notes: list[str] = []
    if recorded_as not in ("", folder.name):
        text = f"the folder is called {folder.name}, and the flight was recorded as {recorded_as}"
        (problems if layout.is_flight_name(folder.name) else notes).append(text)
    if closed:
        notes += [text for _, text in found.empty]
        for name, text in found.half_written:
            recorded = name.split("/")[0] in _RECORDED or durable.is_temporary(name)
            (problems if recorded and not at_work else notes).append(text)
        notes += found.left_by_readers
    return problems, notes


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
