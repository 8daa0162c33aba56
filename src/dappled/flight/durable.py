"""Files that survive a power cut: temporary name, fsync, rename, fsync of the folder.

In trials that cut the power, every shorter order lost acknowledged files or left torn ones under their final name.
"""

from __future__ import annotations

import contextlib
import hashlib
import mmap
import os
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

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
    _put(path, data)


def copy_in(source_fd: int, size: int, path: Path) -> str:
    """Put the first `size` bytes of a file or memfd under `path`, durably; return their SHA-256 (hex).

    The hash is taken beside the write, in another thread. Raises OSError, and EOFError when the source is shorter;
    what stands under `path` then, if anything, is whole.
    """
    data = _mapped(source_fd, size)
    with ThreadPoolExecutor(1, "dappled-hash") as beside:
        hashed = beside.submit(hashlib.sha256, data)
        _put(path, data)
        return hashed.result().hexdigest()


def hash_file(path: Path) -> str:
    """SHA-256 (hex) of a file's bytes. Raises OSError."""
    with path.open("rb") as file:
        return hashlib.file_digest(file, "sha256").hexdigest()


def hash_descriptor(fd: int, size: int) -> str:
    """SHA-256 (hex) of the first `size` bytes of a file or memfd. Raises OSError, EOFError."""
    return hashlib.sha256(_mapped(fd, size)).hexdigest()


def _mapped(fd: int, size: int) -> mmap.mmap:
    """Unmapped when nobody holds it any more: an error's traceback may hold a view of it for a while."""
    there = os.fstat(fd).st_size
    if there < size:
        raise EOFError(f"only {there} of {size} bytes came")
    return mmap.mmap(fd, size, prot=mmap.PROT_READ)


def _put(path: Path, data: bytes | mmap.mmap) -> None:
    part = temporary(path)
    try:
        fd = os.open(part, os.O_WRONLY | os.O_CREAT | os.O_TRUNC | os.O_CLOEXEC, 0o644)
        try:
            view = memoryview(data)
            while view:
                view = view[os.write(fd, view) :]
            os.fsync(fd)
        finally:
            os.close(fd)
        os.rename(part, path)
        sync_folder(path.parent)
    except BaseException:
        with contextlib.suppress(OSError):
            os.unlink(part)
        raise
