"""Copy a flight to another disk, read it back and compare. Removing the source is refused for now."""

from __future__ import annotations

import os
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path

from dappled.flight import check, durable, layout
from dappled.flight.errors import FlightError, disk_error
from dappled.flight.layout import FlightFolder
from dappled.flight.ledger import LedgerReader

FACT = "offloaded"
_SHARED_MEMORY = "-shm"


@dataclass(frozen=True, slots=True)
class Offloaded:
    """What was done. `copied` and `there_already` count files; `size` is their total in bytes."""

    flight: str
    destination: Path
    copied: int
    there_already: int
    size: int


def offload(
    flight: Path,
    destination: Path,
    *,
    prune: bool,
    progress: Callable[[int], object] = lambda size: None,
) -> Offloaded:
    """Copy a closed flight to `destination/<its name>`. Every file is read back from there and compared by SHA-256 with
    its source, and the copy is checked against its own ledger. A second call finishes what the first one left undone.

    Nothing is ever removed: `prune` is refused, because a destination that is the same disk under another name would
    pass every comparison and hold the only copy. Raises FlightError: `prune` asked for, flight open or not intact, copy
    different, disk refuses. `progress` gets the bytes done.
    """
    if prune:
        raise FlightError(
            f"--prune is switched off: it cannot prove yet that {destination} is another disk than {flight}, and might "
            "delete the only copy; offload without it, and remove frames by hand once you have seen them there"
        )
    folder = layout.open_folder(flight)
    gone = _offloaded_before(folder)
    target = destination / flight.resolve().name
    if target.resolve().is_relative_to(flight.resolve()):
        raise FlightError(f"cannot offload {flight} into itself: {target}; give a folder on another disk")
    if gone is not None:
        raise FlightError(f"{folder.path} was offloaded to {gone} and pruned already")
    copied = there = size = 0
    for source in _files(flight):
        goal = target / source.relative_to(flight)
        done, length = _bring(source, goal)
        copied, there, size = copied + done, there + (not done), size + length
        progress(length)
    durable.make_folder(FlightFolder(target).frames)  # also of a flight without a frame
    found = check.check(target)
    if found.problems:
        raise FlightError(
            f"the copy {target} is not intact ({found.problems[0]}): nothing was removed; "
            f"run `dappled flight check {flight}`"
        )
    return Offloaded(folder.path.name, target, copied, there, size)


def _offloaded_before(folder: FlightFolder) -> str | None:
    """Where a closed flight's frames were copied to before they were pruned; None where they weren't."""
    with LedgerReader.open(folder.ledger) as ledger:
        facts = ledger.facts()
    if "closed_utc_ns" not in facts:
        raise FlightError(
            f"{folder.path} is still being recorded, or was never closed: stop the daemon, or start it once to close it"
        )
    return facts[FACT]["destination"] if FACT in facts else None


def _files(flight: Path) -> Iterator[Path]:
    """All files except SQLite's shared memory. The reader that was just closed has folded the WAL into the ledger."""
    for root, folders, names in os.walk(flight):
        folders.sort()
        for name in sorted(names):
            path = Path(root) / name
            if not name.endswith(_SHARED_MEMORY) and path.is_file() and not path.is_symlink():
                yield path


def _bring(source: Path, goal: Path) -> tuple[bool, int]:
    """Copy a file; returns (whether it was copied, size). An equal file stays; a different one raises FlightError."""
    try:
        with source.open("rb") as file:
            size = os.fstat(file.fileno()).st_size
            if goal.exists():
                if durable.hash_file(goal) != durable.hash_file(source):
                    raise FlightError(f"{goal} is there already and differs from {source}: move it away first")
                return False, size
            durable.make_folder(goal.parent)
            sha256 = durable.copy_in(file.fileno(), size, goal)
        if _hash_on_disk(goal) != sha256:
            raise FlightError(f"{goal} reads back different from {source}: check that disk; nothing was removed")
    except EOFError as error:
        raise FlightError(f"{source} changed while it was copied ({error}); try again") from error
    except OSError as error:
        raise disk_error(f"copy {source} to", goal, error) from error
    return True, size


def _hash_on_disk(path: Path) -> str:
    """SHA-256 of a file as it is on the disk: its pages are dropped from memory first."""
    with path.open("rb") as file:
        os.posix_fadvise(file.fileno(), 0, 0, os.POSIX_FADV_DONTNEED)
        return durable.hash_descriptor(file.fileno(), os.fstat(file.fileno()).st_size)
