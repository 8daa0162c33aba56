"""Hash a file as it is on its disk, past the page cache: what was just written is in memory and always reads well.

With O_DIRECT the kernel reads from the device itself. Where a file system refuses that, the file's pages are dropped,
and a probe (preadv2 with RWF_NOWAIT) says whether they are gone. On a network this passes this machine's cache only.
"""

from __future__ import annotations

import errno
import mmap
import os
import stat
from typing import Literal

from dappled import durable

ReadBack = Literal["O_DIRECT", "dropped pages", "page cache"]
"""How a file was read: past the cache in two ways, or from it, which proves nothing about the disk."""

_REFUSED = {errno.EINVAL, errno.EOPNOTSUPP}


def hash_on_disk(name: str, folder: int) -> tuple[str, ReadBack]:
    """fsync a file in an open folder and return its SHA-256 (hex), and how it was read. Raises OSError."""
    try:
        with durable.descriptor(name, os.O_RDONLY | os.O_NOFOLLOW | os.O_NONBLOCK, folder) as fd:
            if not stat.S_ISREG(os.fstat(fd).st_mode):
                raise OSError(errno.ENOTSUP, "it is no file")  # a pipe would be waited for
            os.fsync(fd)
            os.posix_fadvise(fd, 0, 0, os.POSIX_FADV_DONTNEED)
            size = os.fstat(fd).st_size
            direct = _direct(name, folder, size)
            if direct is not None:
                return direct, "O_DIRECT"
            how: ReadBack = "page cache" if _in_memory(fd, size) else "dropped pages"
            return durable.hash_descriptor(fd, size), how
    except EOFError as error:
        raise OSError(errno.EIO, str(error)) from error


def _direct(name: str, folder: int, size: int) -> str | None:
    """The hash by O_DIRECT; None where the file system refuses it."""
    try:
        with durable.descriptor(name, os.O_RDONLY | os.O_DIRECT | os.O_NOFOLLOW, folder) as fd:
            return durable.hash_descriptor(fd, size)
    except OSError as error:
        if error.errno in _REFUSED:
            return None
        raise


def _in_memory(fd: int, size: int) -> bool:
    """Whether some page of a file is still in memory, or that can't be asked."""
    byte = bytearray(1)
    os.posix_fadvise(fd, 0, 0, os.POSIX_FADV_RANDOM)  # a probe must not fetch the pages behind its own
    for at in range(0, size, mmap.PAGESIZE):
        try:
            if os.preadv(fd, [byte], at, os.RWF_NOWAIT):
                return True
        except BlockingIOError:
            continue
        except OSError as error:
            if error.errno in _REFUSED:
                return True
            raise
    return False
