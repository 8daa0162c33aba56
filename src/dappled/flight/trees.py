"""Hold a folder and the folders below it open, and work on their files by descriptor, so that no link is ever followed.

A path is looked up anew by each call: a link or a mount that is put there in between leads it elsewhere. A descriptor
stays with its folder.
"""

from __future__ import annotations

import contextlib
import os
import stat
from collections.abc import Iterable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Self

from dappled import durable
from dappled.closing import Closing
from dappled.flight.errors import FlightError, disk_errors

_CLOEXEC, _HERE, _NONBLOCK = (getattr(os, name, 0) for name in ("O_CLOEXEC", "O_NOFOLLOW", "O_NONBLOCK"))
"""Flags that Windows lacks. It has no `dir_fd` either: a Tree can't be opened there, but light fields can be read."""
_FOLDER = os.O_RDONLY | getattr(os, "O_DIRECTORY", 0) | _HERE | _CLOEXEC
_READ = os.O_RDONLY | _HERE | _NONBLOCK | _CLOEXEC


@dataclass(frozen=True, slots=True)
class FileIdentity:
    """Which file this is, and whether it was written since: device, inode, size in bytes, times of the last change of
    its bytes (which any program can set) and of anything about it (which the kernel alone sets)."""

    device: int
    inode: int
    size: int
    mtime_ns: int
    ctime_ns: int

    @classmethod
    def of(cls, found: os.stat_result) -> Self:
        return cls(found.st_dev, found.st_ino, found.st_size, found.st_mtime_ns, found.st_ctime_ns)

    @classmethod
    def of_fd(cls, fd: int) -> Self:
        """Of the file behind a descriptor. Raises OSError."""
        return cls.of(os.fstat(fd))


class Tree(Closing):
    """A folder, open, and the folders below it that were opened or made. Names are relative to it, with "/" between.
    `written` are the files that were put there."""

    def __init__(self, path: Path) -> None:
        """Open a folder; a link at its end is not followed. Raises FlightError."""
        self.path = path
        self.written: set[str] = set()
        self._folders: dict[str, int] = {}
        with disk_errors("open", self.path):
            self._folders[""] = os.open(path, _FOLDER)

    def close(self) -> None:
        for fd in self._folders.values():
            os.close(fd)
        self._folders.clear()

    @property
    def folders(self) -> dict[str, int]:
        """The descriptor of each open folder by its name; "" is the top."""
        return dict(self._folders)

    def enter(self, name: str, *, make: bool = False) -> None:
        """Open a folder whose parent is open; `make` it, durably, where it is missing. Raises FlightError."""
        if name in self._folders:
            return
        parent, last = self._at(name)
        with disk_errors("open the folder", self.path / name):
            if make:
                with contextlib.suppress(FileExistsError):
                    os.mkdir(last, 0o750, dir_fd=parent)
                os.fsync(parent)  # also where an earlier attempt made it and was cut short
            self._folders[name] = os.open(last, _FOLDER, dir_fd=parent)

    def walk(self) -> list[str]:
        """Open every folder below, and name all files, in order. Raises FlightError, also for a link or a device."""
        found: list[str] = []
        todo = [""]
        while todo:
            folder = todo.pop(0)
            with disk_errors("list", self.path / folder):
                entries = sorted(os.scandir(self._folders[folder]), key=lambda entry: entry.name)
            for entry in entries:
                name = f"{folder}/{entry.name}" if folder else entry.name
                if entry.is_dir(follow_symlinks=False):
                    self.enter(name)
                    todo.append(name)
                elif entry.is_file(follow_symlinks=False):
                    found.append(name)
                else:
                    kind = "a link, which is not followed" if entry.is_symlink() else "no file"
                    raise FlightError(
                        f"{self.path / name} is {kind}: nothing was touched; remove it, or put a file there"
                    )
        return sorted(found)

    @contextmanager
    def reading(self, name: str) -> Iterator[int]:
        """A file's descriptor, open for reading. Raises FlightError, also for what is no file, and for an OSError or
        EOFError in the block."""
        parent, last = self._at(name)
        with disk_errors("read", self.path / name):
            fd = os.open(last, _READ, dir_fd=parent)
            try:
                if not stat.S_ISREG(os.fstat(fd).st_mode):
                    raise FlightError(f"{self.path / name} is no file: nothing was touched")
                durable.check_plain(fd, name)
                yield fd
            except EOFError as error:
                raise FlightError(f"{self.path / name} changed while it was read ({error}); try again") from error
            finally:
                os.close(fd)

    def stat(self, name: str) -> os.stat_result | None:
        """What stands under a name, a link itself; None where there is nothing. Raises FlightError."""
        parent, last = self._at(name)
        with disk_errors("look at", self.path / name):
            try:
                return os.stat(last, dir_fd=parent, follow_symlinks=False)
            except FileNotFoundError:
                return None

    def write(self, name: str, pieces: Iterable[bytes | memoryview]) -> None:
        """Put a file under a name, durably, whole or not at all. Raises FlightError."""
        parent, last = self._at(name)

        def fill(fd: int) -> None:
            for piece in pieces:
                durable.write_all(fd, piece)

        with disk_errors("write", self.path / name):
            durable.fill_file(Path(last), fill, folder=parent)
        self.written.add(name)

    def remove_part(self, name: str) -> None:
        """Remove what an attempt to write a file left half-written, if there is something. Raises FlightError."""
        parent, last = self._at(name)
        with disk_errors("remove the half-written", self.path / name), contextlib.suppress(FileNotFoundError):
            os.unlink(durable.temporary(Path(last)).name, dir_fd=parent)

    def unlink(self, name: str) -> None:
        """Remove a file. Raises FlightError."""
        parent, last = self._at(name)
        with disk_errors("remove", self.path / name):
            os.unlink(last, dir_fd=parent)

    def sync(self) -> None:
        """fsync every open folder, the inner ones first. Raises FlightError."""
        for name in sorted(self._folders, reverse=True):
            with disk_errors("sync", self.path / name):
                os.fsync(self._folders[name])

    def sync_above(self) -> None:
        """fsync the folders above, as far as they are on the same file system and may be opened. Raises FlightError."""
        device = os.fstat(self._folders[""]).st_dev
        for fd in self.above():
            if os.fstat(fd).st_dev != device:
                break
            with disk_errors("sync a folder above", self.path):
                os.fsync(fd)

    def above(self) -> Iterator[int]:
        """A descriptor of each folder above in turn, up to the root or one that may not be opened."""
        fd = os.dup(self._folders[""])
        try:
            while True:
                here = os.fstat(fd)
                try:
                    with disk_errors("open a folder above", self.path):
                        upper = os.open("..", _FOLDER, dir_fd=fd)
                except FlightError as error:
                    if isinstance(error.__cause__, PermissionError):
                        return
                    raise
                os.close(fd)
                fd = upper
                if os.path.samestat(here, os.fstat(fd)):
                    return
                yield fd
        finally:
            os.close(fd)

    def _at(self, name: str) -> tuple[int, str]:
        """(descriptor of the folder, last part) of a name."""
        folder, _, last = name.rpartition("/")
        return self._folders[folder], last
