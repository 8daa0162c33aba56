"""Write a camera's file while it comes: on the flight's own disk where that is possible, else in memory.

A thread writes and hashes each piece while the next one comes. The file on the disk has no name yet, so nothing is left
of one that is cut off. Where the disk refuses (it is full) or doesn't keep up, all that has come goes to memory, and
the camera is not asked for it again: what is wrong with the disk is found when the file is recorded.
"""

from __future__ import annotations

import ctypes
import errno
import hashlib
import logging
import os
import threading
from collections import deque
from collections.abc import Callable
from concurrent.futures import Future, ThreadPoolExecutor
from pathlib import Path
from types import TracebackType
from typing import Self

from dappled import durable
from dappled.clock import Clock, SystemClock
from dappled.drivers.camera import Blob

log = logging.getLogger(__name__)
PIECE_BYTES = 1 << 20
_BELIEVED_BYTES = 1 << 28  # of the size that a camera announces: room for so much is taken at once
_PATIENCE_S = 0.5
"""How long a file that has come waits for the disk: no shot is fired meanwhile."""
_REST_NS = 60 * 10**9
"""How long files go to memory after the disk did not keep up."""
_WRITE = 2  # SYNC_FILE_RANGE_WRITE


class Intake:
    """Where the files of one camera go as they come. One thread calls it."""

    def __init__(self, clock: Clock | None = None, *, begin_thread: Callable[[], None] | None = None) -> None:
        """`begin_thread` is called first in the thread that writes: a new thread doesn't have its process' priority."""
        self.folder: Path | None = None
        """A folder whose file system has files without a name; None: none is known."""
        self.buffers: list[memoryview] = []  # of one piece each, not in use
        self._clock = clock or SystemClock()
        self._begin_thread = begin_thread
        self._thread = self._new_thread()
        self._again_ns = 0

    def begin(self, size: int) -> Incoming:
        """Make room for a file of so many bytes. Raises OSError where there is none in memory either."""
        if self.folder is not None and self._clock.monotonic_ns() >= self._again_ns:
            try:
                return Incoming(self, _on_disk(self.folder, size), in_memory=False)
            except OSError:
                pass  # full, read-only, gone: the recorder will say
        return Incoming(self, _memory_file(), in_memory=True)

    def then(self, work: Callable[[], None]) -> Future[None]:
        """Have the thread do this after all else."""
        return self._thread.submit(work)

    def is_done(self) -> bool:
        """Wait for what the thread has to do; False where the disk does not keep up."""
        done = threading.Event()
        self._thread.submit(done.set)
        return self._clock.wait(done, _PATIENCE_S)

    def spare_disk(self) -> None:
        """Leave the thread to its work, and the disk alone for a while."""
        self._thread.shutdown(wait=False)
        self._thread = self._new_thread()
        self._again_ns = self._clock.monotonic_ns() + _REST_NS
        log.warning("the disk does not keep up with the camera: its files go to memory first for a minute")

    def _new_thread(self) -> ThreadPoolExecutor:
        return ThreadPoolExecutor(1, "disk", self._begin_thread)


class Incoming:
    """One file that comes; as a context it leaves nothing behind unless `finish` was called. The thread of `Intake`
    calls it."""

    def __init__(self, intake: Intake, fd: int, *, in_memory: bool) -> None:
        self.size = 0
        self._intake, self._fd, self._in_memory = intake, fd, in_memory
        self._sha256 = hashlib.sha256()
        self._pieces: deque[tuple[Future[None], memoryview, int]] = deque()  # not known to be written; bytes of each
        self._is_left = False  # nothing more is written
        self._is_whole = False

    def __enter__(self) -> Self:
        return self

    def __exit__(self, _: type[BaseException] | None, __: BaseException | None, ___: TracebackType | None) -> None:
        if not self._is_whole:
            self._leave()

    def take(self, most: int, read: Callable[[memoryview], int]) -> int:
        """Have `read` fill a buffer of at most so many bytes, and write as many as it says, which are returned. Raises
        what `read` raises; what is wrong with the disk shows in `finish`."""
        self._reuse()
        buffers = self._intake.buffers
        buffer = buffers.pop() if buffers else memoryview(bytearray(PIECE_BYTES))
        got = read(buffer[:most])
        self._pieces.append((self._intake.then(lambda: self._write(buffer[:got])), buffer, got))
        self.size += got
        return got

    def finish(self) -> Blob:
        """The file: on the disk, or in memory where that refused or is not done in time. Raises OSError where memory
        refuses."""
        is_done = self._in_memory or self._intake.is_done()
        for future, _, _ in self._pieces if self._in_memory else ():
            future.result()
        self._reuse()
        blob = Blob(self._fd, self.size, self._sha256.hexdigest()) if not self._pieces else self._moved()
        if not is_done:
            self._intake.spare_disk()
        self._is_whole = True
        return blob

    def _reuse(self) -> None:
        """Give the buffers of written pieces back."""
        while self._pieces and self._pieces[0][0].done() and self._pieces[0][0].exception() is None:
            self._intake.buffers.append(self._pieces.popleft()[1])

    def _write(self, piece: memoryview) -> None:
        """In the thread: write and hash a piece, unless one before it was not written."""
        if self._is_left:
            raise OSError(errno.ECANCELED, os.strerror(errno.ECANCELED))
        try:
            durable.write_all(self._fd, piece)
        except OSError:
            self._is_left = True
            raise
        self._sha256.update(piece)
        if not self._in_memory:
            _begin_writing(self._fd)

    def _moved(self) -> Blob:
        """Move to memory what is on the disk and what is not."""
        fd = _memory_file()
        try:
            durable.copy(self._fd, fd, self.size - sum(size for _, _, size in self._pieces))
            for _, buffer, size in self._pieces:
                durable.write_all(fd, buffer[:size])
        except BaseException:
            os.close(fd)
            raise
        self._leave()
        return Blob(fd, self.size)

    def _leave(self) -> None:
        """Write nothing more, and close the file as soon as the thread doesn't use it."""
        self._is_left = True
        fd = self._fd
        self._intake.then(lambda: os.close(fd))


def _memory_file() -> int:
    return os.memfd_create("camera file", os.MFD_CLOEXEC)  # the camera's own name may be too long for one


def _on_disk(folder: Path, size: int) -> int:
    """A file without a name that has room for `size` bytes. Raises OSError."""
    fd = durable.unnamed(folder)
    try:
        os.posix_fallocate(fd, 0, min(size, _BELIEVED_BYTES))
    except OSError:
        os.close(fd)
        raise
    return fd


_sync_file_range = getattr(ctypes.CDLL(None), "sync_file_range", None)


def _begin_writing(fd: int) -> None:
    """Have the kernel begin to bring a file to the disk, which leaves less to fsync. That finds the errors."""
    if _sync_file_range is not None:
        _sync_file_range(fd, ctypes.c_int64(0), ctypes.c_int64(0), _WRITE)
