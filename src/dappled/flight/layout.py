"""The layout of a flights folder: the names in it, making and finding flights, and the lock of the recording daemon.

`<flights>/<UTC start as 20261121T101503Z>-<8 hex>/` holds flight.toml, flight.sqlite, shots.jsonl, telemetry.tlog,
frames/ and, where asked for, lightfields/. A machine that does not know UTC yet names its flight by boot.
"""

from __future__ import annotations

import errno
import os
import re
import secrets
import shutil
import stat
from collections.abc import Iterator, Mapping
from contextlib import AbstractContextManager, nullcontext
from dataclasses import dataclass
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

import tomli_w

from dappled import codec, confined, durable, file_lock
from dappled.bounds.parsing import parse_toml, read_log
from dappled.closing import Closing
from dappled.findings import Code, Finding, Subject, finding
from dappled.flight.errors import FlightError, disk_error, disk_errors

_FLIGHT_NAME = re.compile(r"(\d{8}T\d{6}Z|boot[0-9a-f]{8})-[0-9a-f]{8}")
_FRAME_NAME = re.compile(r"(\d{6,})\.([a-z0-9]{1,8})")
_LOCK = ".lock"
_NO_LINK = getattr(os, "O_NOFOLLOW", 0) | getattr(os, "O_NONBLOCK", 0) | getattr(os, "O_CLOEXEC", 0)
UNFINISHED = ".offload.part"  # in the copy of a flight, while files of it are missing or its ledger lacks some
SIDECAR = ".xmp"  # written beside frames by later work; in no row of the ledger
FEWEST_FILES = 16  # a frame, its companion, temporary files, for each of the shots that may be under way
JOURNAL_BYTES = 1_000_000  # journal, ledger and telemetry of some seconds
RECORDS = "records into"  # what the daemon does in a flights folder
_NO_LOCKS = frozenset((errno.ENOLCK, errno.ENOTSUP, errno.EOPNOTSUPP, errno.ENOSYS))
_WITHOUT_LOCK = _NO_LOCKS | {errno.EACCES, errno.EPERM, errno.EROFS}
_BOOT_ID = Path("/proc/sys/kernel/random/boot_id")


@dataclass(frozen=True, slots=True)
class FlightFolder:
    """The paths of one flight on disk. The ledger keeps names relative to `path`."""

    path: Path

    @property
    def name(self) -> str:
        return self.path.name

    @property
    def settings(self) -> Path:
        """flight.toml: resolved settings, software versions, camera identity."""
        return self.path / "flight.toml"

    @property
    def ledger(self) -> Path:
        return self.path / "flight.sqlite"

    @property
    def journal(self) -> Path:
        """shots.jsonl: every shot, noted before the camera is touched."""
        return self.path / "shots.jsonl"

    @property
    def telemetry(self) -> Path:
        return self.path / "telemetry.tlog"

    @property
    def seals(self) -> Path:
        """seals.jsonl: the digests of every file, each time the flight was closed."""
        return self.path / "seals.jsonl"

    @property
    def frames(self) -> Path:
        return self.path / "frames"

    def entries(self) -> Iterator[tuple[str, os.DirEntry[str]]]:
        """Everything below with its name relative to the flight, folders before what is in them; no link is followed.
        Raises OSError."""
        todo = [""]
        while todo:
            place = todo.pop()
            with os.scandir(self.path / place) as scan:
                entries = sorted(scan, key=lambda entry: entry.name)
            yield from ((f"{place}{entry.name}", entry) for entry in entries)
            todo += [f"{place}{entry.name}/" for entry in reversed(entries) if entry.is_dir(follow_symlinks=False)]

    def files(self) -> dict[str, Path]:
        """Every plain file below, by its name relative to the flight; links are not followed. Raises OSError."""
        plain = (name for name, entry in self.entries() if entry.is_file(follow_symlinks=False))
        return {name: self.path / name for name in plain}

    def file(self, name: str) -> Path:
        """The path of a file that the ledger names, inside the flight. Raises OutsideError for a name that isn't."""
        return confined.path(self.path, name, f"the ledger {self.ledger}")

    def refuse_links(self) -> None:
        """Raise OutsideError where one of the flight's own files, one that SQLite has beside the ledger, or the folder
        of frames is a link."""
        beside = (self.ledger.name + suffix for suffix in ("-wal", "-shm", "-journal"))
        own = (self.settings, self.ledger, self.journal, self.telemetry, self.frames, self.seals)
        for name in (*(path.name for path in own), *beside):
            confined.path(self.path, name, f"the flight {self.path}")


def extension(camera_name: str) -> str:
    """The extension to store a camera's file with: its own in lower case if it is letters and digits, else "raw".

    >>> extension("IMG_0042.CR2"), extension("../../etc/passwd"), extension("a.j/../p g")
    ('cr2', 'raw', 'raw')
    """
    _, dot, last = camera_name.rpartition(".")
    last = last.lower()
    return last if dot and re.fullmatch(r"[a-z0-9]{1,8}", last) else "raw"


def frame_name(index: int, camera_name: str) -> str:
    """The name of a frame relative to its flight: "frames/000042.cr2"."""
    if index < 0:
        raise ValueError(f"an image index is 0 or more, not {index}")
    return f"frames/{index:06d}.{extension(camera_name)}"


def is_flight_name(name: str) -> bool:
    """Whether a folder of this name is a flight's."""
    return _FLIGHT_NAME.fullmatch(name) is not None


def index_of(file_name: str) -> int | None:
    """The image index in the name of a file in frames/; None when it is not a frame's name."""
    match = _FRAME_NAME.fullmatch(file_name)
    return int(match[1]) if match else None


def _boot() -> str:
    """Eight hex digits of this boot's id, or random ones where /proc can't be read."""
    try:
        return _BOOT_ID.read_text(encoding="ascii").strip().replace("-", "")[:8]
    except OSError:
        return secrets.token_hex(4)


def create(root: Path, utc_ns: int | None, facts: Mapping[str, Any] | None = None) -> FlightFolder:
    """Make a new, empty flight under `root` (made if missing). It and its flight.toml are durable on return.

    `utc_ns` is the start, or None when UTC is not known. `facts` goes to flight.toml. Raises FlightError.
    """
    if utc_ns is None:
        start = f"boot{_boot()}"
    else:
        start = datetime.fromtimestamp(utc_ns // 1_000_000_000, UTC).strftime("%Y%m%dT%H%M%SZ")
    folder = FlightFolder(root / f"{start}-{secrets.token_hex(4)}")
    try:
        durable.make_folder(root)
        with durable.replacing(folder.path) as part:
            part.mkdir(0o750)  # positions and pictures are not for every user of the machine
            made = FlightFolder(part)
            durable.make_folder(made.frames)
            write_facts(made, facts or {})
    except OSError as error:
        shutil.rmtree(folder.path, ignore_errors=True)
        raise disk_error("make the flight folder", folder.path, error) from error
    return folder


def open_folder(path: Path) -> FlightFolder:
    """Open a recorded flight. Raises FlightError when `path` is not one, OutsideError when a part of it is a link."""
    with disk_errors("open the flight", path):
        wrong = not_a_flight(path)
    if wrong:
        raise FlightError(wrong)
    folder = FlightFolder(path)
    folder.refuse_links()
    return folder


def not_a_flight(path: Path) -> str:
    """Why `path` is not a recorded flight; "" where it is. Raises OSError."""
    folder = FlightFolder(path)
    if path.is_dir() and (folder.ledger.is_file() or folder.settings.is_file()):
        return ""
    what = "does not exist" if not path.exists() else "is a file" if path.is_file() else "holds no flight.sqlite"
    return f"{path} is not a flight folder (it {what}); give the folder that holds flight.sqlite"


def unmade(root: Path) -> list[Path]:
    """Flight folders under `root` that still have their temporary names: making them was interrupted. Raises
    FlightError."""
    return [root / name for name in _folders(root) if durable.is_temporary(name)]


def flights(root: Path) -> list[FlightFolder]:
    """All flights under `root`, by name; empty when the folder is missing. Raises FlightError."""
    return [FlightFolder(root / name) for name in _folders(root) if is_flight_name(name)]


def held_flights(root: Path) -> list[FlightFolder]:
    """All flights under `root`, by name, also those that somebody gave another name. Raises FlightError."""
    with disk_errors("list the flights in", root):
        named = [(name, root / name) for name in _folders(root) if not durable.is_temporary(name)]
        return [FlightFolder(path) for name, path in named if is_flight_name(name) or not not_a_flight(path)]


def _folders(root: Path) -> list[str]:
    try:
        return sorted(entry.name for entry in os.scandir(root) if entry.is_dir(follow_symlinks=False))
    except FileNotFoundError:
        return []
    except OSError as error:
        raise disk_error("list the flights in", root, error) from error


@dataclass(frozen=True, slots=True)
class DiskSpace:
    """The space of a disk in bytes: `available` to this user.

    `files` is how many more files it takes (inodes); None where the file system sets no number (btrfs, vfat).
    """

    total: int
    used: int
    available: int
    files: int | None = None

    def shortage(self, least_mb: int) -> Finding | None:
        """Why no photograph should be taken with so many bytes and files left; None where there is room.

        `least_mb` is the setting record.min_free_mb. Shutter, health record and doctor all ask here.
        """
        disk = Subject("disk")
        if self.files is not None and self.files < FEWEST_FILES:
            return finding(Code.DISK_FEW_FILES, disk, files=self.files)
        if self.available < least_mb * 1_000_000:
            return finding(Code.DISK_NEARLY_FULL, disk, left_mb=self.available // 1_000_000, least_mb=least_mb)
        if self.available < JOURNAL_BYTES:
            return finding(Code.DISK_FULL, disk, left_kb=self.available // 1000)
        return None


def disk_space(path: Path) -> DiskSpace:
    """The space of the disk of `path`. Raises FlightError."""
    with disk_errors("ask for the free space of", path):
        disk = os.statvfs(path)
    block = disk.f_frsize
    total, free, available = (count * block for count in (disk.f_blocks, disk.f_bfree, disk.f_bavail))
    return DiskSpace(total, total - free, available, disk.f_favail if disk.f_files else None)


def existing(folder: Path) -> Path:
    """The folder, or the one above it that is there already, as far as this user may look."""
    return next(one for one in (folder, *folder.parents) if os.path.exists(one))


def write_facts(folder: FlightFolder, facts: Mapping[str, Any]) -> None:
    """Replace flight.toml, whole or not at all. TOML has no null: None values are left out.

    Raises OSError, and TypeError for a value that TOML can't hold.
    """
    durable.write_file(folder.settings, facts_as_toml(facts))


def facts_as_toml(facts: Mapping[str, Any]) -> bytes:
    """Encode facts as flight.toml holds them. Raises TypeError for a value that TOML can't hold."""
    return tomli_w.dumps(codec.table(facts)).encode()


_TABLES = ("camera", "names", "settings", "software")  # of flight.toml, where they are there


def read_facts(folder: FlightFolder) -> dict[str, Any]:
    """Read flight.toml. Raises FlightError."""
    try:
        facts = parse_toml(read_log(folder.settings).decode("utf-8"))
    except OSError as error:
        raise disk_error("read", folder.settings, error) from error
    except ValueError as error:
        raise FlightError(f"{folder.settings} is not readable as TOML: {error}") from error
    tables = {name: facts[name] for name in _TABLES if name in facts}
    settings = tables.get("settings")
    tables |= {f"settings.{name}": one for name, one in settings.items()} if isinstance(settings, dict) else {}
    for name, one in tables.items():
        if not isinstance(one, dict):
            raise FlightError(f"{folder.settings} is damaged: {name} is no table")
    return facts


class LockHeldError(FlightError):
    """Another process holds the lock of a flights folder; `records`: it records flights there."""

    def __init__(self, text: str, *, records: bool) -> None:
        super().__init__(text)
        self.records = records


class FlightsLock(Closing):
    """The lock (flock) of the one process that writes in a flights folder: the daemon, or work on its closed flights.

    Held from creation to `close`, or until the process ends in any way.
    """

    def __init__(self, root: Path, doing: str = RECORDS) -> None:
        """Take the lock of `root`, which is made if missing. `doing` is what this process does there, as a verb.

        Raises FlightError when another process holds it.
        """
        path = root / _LOCK
        with disk_errors("make the lock", path):
            durable.make_folder(root)
            self._fd = os.open(path, os.O_RDWR | os.O_CREAT | _NO_LINK, 0o644)
        try:
            file_lock.lock(self._fd)
            _refuse_shared(self._fd, path)
            os.ftruncate(self._fd, 0)
            os.pwrite(self._fd, f"{os.getpid()} {doing}\n".encode(), 0)
        except BlockingIOError as error:
            holder, _, does = os.pread(self._fd, 100, 0).decode("ascii", "replace").strip().partition(" ")
            os.close(self._fd)
            records = (does or RECORDS) == RECORDS
            what = "wait until it has ended"
            if records:
                other = "set record.directory to another folder" if doing == RECORDS else "work on a copy of the flight"
                what = f"stop it, or {other}"
            raise LockHeldError(
                f"another dappled (process {holder or 'unknown'}) {does or RECORDS} {root}; {what}", records=records
            ) from error
        except OSError as error:
            os.close(self._fd)
            raise disk_error("take the lock", path, error) from error
        except FlightError:
            os.close(self._fd)
            raise

    def close(self) -> None:
        os.close(self._fd)


def _refuse_shared(fd: int, path: Path) -> None:
    """Raise FlightError where what should be the lock is another file under a second name, or no file: it is written
    to."""
    found = os.fstat(fd)
    if not stat.S_ISREG(found.st_mode) or found.st_nlink > 1:
        raise FlightError(f"{path} is not the lock of a flights folder, but another file: remove it")


def refuse_unfinished(folder: FlightFolder) -> None:
    """Raise FlightError for the copy of a flight to which an offload was cut short."""
    if (folder.path / UNFINISHED).is_file():
        raise FlightError(f"{folder.path} is the copy of an offload that was cut short: run that offload again first")


def remove_parts(folder: FlightFolder) -> list[str]:
    """Remove what was left half-written when recording or work was killed, durably, and name it. Raises FlightError."""
    with disk_errors("remove what was left half-written in", folder.path):
        parts = [path for path in folder.files().values() if durable.is_temporary(path.name)]
        for path in parts:
            path.unlink()
        for place in {path.parent for path in parts}:
            durable.sync_folder(place)  # or they might stand there again, in a flight that is closed by then
    return [path.name for path in parts]


def work_lock(root: Path, doing: str, *, needed: bool = False) -> AbstractContextManager[object]:
    """The lock of a flights folder for work on its closed flights. Where this user can't make it there and no other
    process holds it, or the file system has no locks, the work goes without, unless it is `needed`. Raises
    FlightError."""
    try:
        return FlightsLock(root, doing)
    except FlightError as error:
        why = error.__cause__.errno if isinstance(error.__cause__, OSError) else None
        if needed or why not in _WITHOUT_LOCK or (why not in _NO_LOCKS and is_locked(root)):
            raise
        return nullcontext()


def is_locked(root: Path) -> bool:
    """Whether some process records into `root` now. Raises FlightError when the lock can't be read."""
    path = root / _LOCK
    with disk_errors("look at the lock", path):
        try:
            with durable.descriptor(path, os.O_RDONLY | _NO_LINK) as fd:
                file_lock.lock(fd, shared=True)
        except FileNotFoundError:
            return False
        except BlockingIOError:
            return True
    return False
