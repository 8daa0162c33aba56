"""A flight is brought to another disk: copied, read back, compared; only then, and only if asked, pruned here."""

from __future__ import annotations

import os
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path

from dappled.flight import check, durable, layout
from dappled.flight.errors import FlightError, disk_error
from dappled.flight.layout import FlightFolder
from dappled.flight.ledger import Ledger, LedgerReader

FACT = "offloaded"
_SHARED_MEMORY = "-shm"


@dataclass(frozen=True, slots=True)
class Offloaded:
    """What was done. `copied` and `there_already` count files; `size` is that of all of them, in bytes."""

    flight: str
    destination: Path
    copied: int
    there_already: int
    size: int
    pruned: int


def offload(
    flight: Path,
    destination: Path,
    *,
    prune: bool,
    utc_ns: Callable[[], int],
    progress: Callable[[int], object] = lambda size: None,
) -> Offloaded:
    """Copy a closed flight to `destination/<its name>`; every file is read back from there and compared by SHA-256
    with its source, and the copy is checked whole against its own ledger. Doing so again finishes what was left.

    `prune` then removes the frames (and strays) here; ledger, journal and telemetry stay, so that image indices go on
    and can be answered. Raises FlightError: flight open or not intact, copy different, disk refuses. Nothing is
    removed then. `progress` is told the bytes done.
    """
    folder = layout.open_folder(flight)
    gone = _offloaded_before(folder)
    target = destination / flight.resolve().name
    if target.resolve().is_relative_to(flight.resolve()):
        raise FlightError(f"cannot offload {flight} into itself: {target}; give a folder on another disk")
    if gone is not None:
        return _finish(folder, target, gone, prune=prune)
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
    pruned = _prune(folder, target, utc_ns) if prune else 0
    return Offloaded(folder.path.name, target, copied, there, size, pruned)


def _offloaded_before(folder: FlightFolder) -> str | None:
    """Where a closed flight's frames were copied to before they were pruned; None where they weren't."""
    with LedgerReader.open(folder.ledger) as ledger:
        facts = ledger.facts()
    if "closed_utc_ns" not in facts:
        raise FlightError(
            f"{folder.path} is still recorded, or was never closed: stop the daemon, or start it once to close it"
        )
    return facts[FACT]["destination"] if FACT in facts else None


def _finish(folder: FlightFolder, target: Path, gone: str, *, prune: bool) -> Offloaded:
    """Remove what a prune that was cut short left here, where the copy still holds it."""
    with LedgerReader.open(folder.ledger) as ledger:
        left = [row for row in ledger.files() if (folder.path / row.name).exists()]
    if not (left and prune):
        rest = f"; --prune removes the {len(left)} files that are left" if left else ""
        raise FlightError(f"{folder.path} was offloaded to {gone} and pruned already{rest}")
    for row in left:
        try:
            whole = _hash_on_disk(target / row.name) == row.sha256
        except OSError as error:
            raise disk_error("read the copy", target / row.name, error) from error
        if not whole:
            raise FlightError(f"{target / row.name} differs from what the ledger says: nothing more was removed")
    _remove(folder, [row.name for row in left])
    return Offloaded(folder.path.name, target, 0, len(left), sum(row.size for row in left), len(left))


def _files(flight: Path) -> Iterator[Path]:
    """All files but SQLite's shared memory; the reader that was just closed has folded the WAL into the ledger."""
    for root, folders, names in os.walk(flight):
        folders.sort()
        for name in sorted(names):
            path = Path(root) / name
            if not name.endswith(_SHARED_MEMORY) and path.is_file() and not path.is_symlink():
                yield path


def _bring(source: Path, goal: Path) -> tuple[bool, int]:
    """(copied or not, size). A file that is there with the same bytes stays; another one is refused."""
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
    """SHA-256 of a file, its pages dropped from memory first, so that the disk is asked."""
    with path.open("rb") as file:
        os.posix_fadvise(file.fileno(), 0, 0, os.POSIX_FADV_DONTNEED)
        return durable.hash_descriptor(file.fileno(), os.fstat(file.fileno()).st_size)


def _prune(folder: FlightFolder, target: Path, utc_ns: Callable[[], int]) -> int:
    """Remove the frames and strays that the ledger acknowledges. The ledger says so before the first one goes."""
    with Ledger(folder.ledger, utc_ns) as ledger:
        names = [row.name for row in ledger.files()]
        ledger.set_fact(FACT, {"destination": str(target.absolute()), "utc_ns": utc_ns(), "files": len(names)})
        ledger.add_event(FACT, f"{len(names)} files were copied to {target}, verified, and removed here")
    _remove(folder, names)
    return len(names)


def _remove(folder: FlightFolder, names: Sequence[str]) -> None:
    try:
        for name in names:
            (folder.path / name).unlink(missing_ok=True)
        durable.sync_folder(folder.frames)
    except OSError as error:
        raise disk_error("prune", folder.frames, error) from error
