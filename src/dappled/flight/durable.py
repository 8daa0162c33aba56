"""Files that survive a power cut: whole files that replace what was there, and files that are only appended to.

A whole file: temporary name, fsync, rename, fsync of the folder. In tests that cut the power, every shorter order lost
acknowledged files or left torn ones under their final name. An appended file: one write(2) each time, which survives
the death of the process at once, and an fdatasync by a thread within a set time; the writer never waits for it.
"""

from __future__ import annotations

import contextlib
import hashlib
import os
import threading
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

from dappled.flight.errors import FlightError, disk_error

_PART = ".part"


def temporary(path: Path) -> Path:
    """The name that `path` is written under until it is whole: hidden, in the same folder."""
    return path.with_name(f".{path.name}{_PART}")


def is_temporary(name: str) -> bool:
    """Whether a file's name is that of a file not wholly written."""
    return name.startswith(".") and name.endswith(_PART)


def sync_folder(path: Path) -> None:
    """fsync of a folder: its names are durable afterwards. Raises OSError."""
    fd = os.open(path, os.O_RDONLY | os.O_DIRECTORY)
    try:
        os.fsync(fd)
    finally:
        os.close(fd)


def make_folder(path: Path) -> None:
    """Make a folder and its missing parents, durably, level by level. Raises OSError."""
    if path.is_dir():
        return
    if path.parent != path:
        make_folder(path.parent)
    with contextlib.suppress(FileExistsError):
        path.mkdir()
    if not path.is_dir():
        raise NotADirectoryError(20, os.strerror(20), str(path))
    sync_folder(path.parent)


def write_file(path: Path, data: bytes) -> None:
    """Put `data` under `path`, replacing what was there, whole or not at all. Raises OSError."""

    def fill(fd: int) -> None:
        view = memoryview(data)
        while view:
            view = view[os.write(fd, view) :]

    _put(path, fill)


def copy_in(source_fd: int, size: int, path: Path) -> str:
    """Put the first `size` bytes of a file or memfd under `path`, durably; return their SHA-256 (hex).

    The bytes go from file to file inside the kernel, and the hash is taken beside that in another thread. (Writing
    from a map of a memfd costs more: a page fault for every 4 KiB.) Raises OSError, and EOFError when the source is
    shorter; what stands under `path` then, if anything, is whole.
    """

    def fill(fd: int) -> None:
        done = 0
        while done < size:
            sent = os.sendfile(fd, source_fd, done, size - done)
            if sent == 0:
                raise EOFError(f"only {done} of {size} bytes came")
            done += sent

    with ThreadPoolExecutor(1, "dappled-hash") as beside:
        sha256 = beside.submit(hash_descriptor, source_fd, size)
        _put(path, fill)
        return sha256.result()


def hash_file(path: Path) -> str:
    """SHA-256 (hex) of a file's bytes. Raises OSError."""
    with path.open("rb") as file:
        return hashlib.file_digest(file, "sha256").hexdigest()


def hash_descriptor(fd: int, size: int) -> str:
    """SHA-256 (hex) of the first `size` bytes of a file or memfd, whose offset stays. Raises OSError, EOFError."""
    sha256 = hashlib.sha256()
    buffer = memoryview(bytearray(1 << 20))
    done = 0
    while done < size:
        got = os.preadv(fd, [buffer[: size - done]], done)
        if got == 0:
            raise EOFError(f"only {done} of {size} bytes came")
        sha256.update(buffer[:got])
        done += got
    return sha256.hexdigest()


def _put(path: Path, fill: Callable[[int], None]) -> None:
    part = temporary(path)
    try:
        fd = os.open(part, os.O_WRONLY | os.O_CREAT | os.O_TRUNC | os.O_CLOEXEC, 0o644)
        try:
            fill(fd)
            os.fsync(fd)
        finally:
            os.close(fd)
        os.rename(part, path)
        sync_folder(path.parent)
    except BaseException:
        with contextlib.suppress(OSError):
            os.unlink(part)
        raise


class AppendedFile:
    """Owns its descriptor and its flusher. Its owner lets one thread at a time in. What comes after `shut` is refused:
    it must not get into another file, opened since, that was given the same descriptor."""

    def __init__(self, path: Path, what: str, flush_interval_s: float, *, new: bool) -> None:
        """Open or make the file; `new`: there must be none. `what` it is called in sentences. Raises FlightError."""
        self.path, self._what = path, what
        doing = f"{'make' if new else 'open'} {what}"
        flags = os.O_RDWR | os.O_CREAT | os.O_APPEND | os.O_CLOEXEC | (os.O_EXCL if new else 0)
        try:
            self._fd = os.open(path, flags, 0o644)
        except OSError as error:
            raise disk_error(doing, path, error) from error
        try:
            size = os.fstat(self._fd).st_size
            self.last = os.pread(self._fd, 1, size - 1) if size else b""  # byte, when it was opened
        except OSError as error:
            os.close(self._fd)
            raise disk_error(doing, path, error) from error
        self._flusher = Flusher(self._fd, flush_interval_s)
        self._closed = False

    def append(self, data: bytes, doing: str) -> int:
        """One write; how many bytes the disk took. Raises FlightError, "cannot `doing` …", when it took none."""
        self._open_for(doing)
        try:
            written = os.write(self._fd, data)
        except OSError as error:
            raise disk_error(doing, self.path, error) from error
        self._flusher.poke()
        return written

    def cut(self, size: int, doing: str) -> None:
        """Take away what stands beyond `size`. Raises FlightError as `append` does."""
        self._open_for(doing)
        try:
            os.ftruncate(self._fd, size)
        except OSError as error:
            raise disk_error(doing, self.path, error) from error

    @property
    def problem(self) -> str | None:
        """Why what was written may not survive a power cut, if so."""
        error = self._flusher.error
        return None if error is None else str(disk_error(f"flush {self._what}", self.path, error))

    def shut(self) -> bool:
        """From now on nothing is written. False where that had been said before."""
        was, self._closed = self._closed, True
        return not was

    def close(self) -> None:
        """Flush and close, once, after `shut`; the owner need not keep others out meanwhile."""
        self._flusher.close()
        os.close(self._fd)

    def _open_for(self, doing: str) -> None:
        if self._closed:
            raise FlightError(f"cannot {doing} {self.path}: the flight is closed")


class Flusher:
    """fdatasync of one descriptor, at most `interval_s` after the first write that it was told of.

    Owns a thread, not the descriptor. A failed fdatasync stays readable in `error`: what was written before it may
    not survive a power cut.
    """

    def __init__(self, fd: int, interval_s: float = 0.5) -> None:
        self._fd = fd
        self._interval_s = interval_s
        self._dirty = threading.Event()
        self._closing = threading.Event()
        self.error: OSError | None = None
        self._thread = threading.Thread(target=self._run, name="dappled-flusher", daemon=True)
        self._thread.start()

    def poke(self) -> None:
        """Something was written."""
        if not self._dirty.is_set():
            self._dirty.set()

    def close(self) -> None:
        """Flush what is left and end the thread; the descriptor may be closed afterwards."""
        self._closing.set()
        self._dirty.set()
        self._thread.join()

    def _run(self) -> None:
        while not self._closing.is_set():
            self._dirty.wait()
            self._closing.wait(self._interval_s)
            self._sync()
        if self._dirty.is_set():
            self._sync()  # written, then closed, while the last one ran

    def _sync(self) -> None:
        self._dirty.clear()  # before the sync: a write during it is told of again
        try:
            os.fdatasync(self._fd)
        except OSError as error:
            self.error = error
