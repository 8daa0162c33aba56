"""Write files so that they survive a power cut: temporary name, fsync, rename, fsync of the folder.

In tests that cut the power, every shorter order lost acknowledged files or left torn ones under their final name.
"""

from __future__ import annotations

import contextlib
import errno
import hashlib
import mmap
import os
import secrets
import shutil
import stat
import struct
from collections.abc import Callable, Iterator
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

_PART = ".part"
_PIECE_BYTES = 1 << 20
_BELIEVED_BYTES, _BELIEVED_TIMES = 256 << 20, 200  # of a file's size: always, and times what is stored of it
_LOOKS, _LOOK_BYTES, _LOOKS_FULL = 64, 4096, 8  # fewer say nothing: of a hundredth, 8 are met once in a million files
_CLOEXEC, _NOFOLLOW = (getattr(os, name, 0) for name in ("O_CLOEXEC", "O_NOFOLLOW"))  # Windows has neither


def temporary(path: Path) -> Path:
    """The name that `path` has while it is being written: hidden, in the same folder."""
    return path.with_name(f".{path.name}{_PART}")


def is_temporary(name: str) -> bool:
    """Whether this is the name of a file that was still being written."""
    return name.startswith(".") and name.endswith(_PART)


@contextlib.contextmanager
def descriptor(path: Path | str, flags: int, dir_fd: int | None = None) -> Iterator[int]:
    """A file's or a folder's descriptor, closed at the end. Raises OSError."""
    fd = os.open(path, flags | _CLOEXEC, dir_fd=dir_fd)
    try:
        yield fd
    finally:
        os.close(fd)


def sync_folder(path: Path) -> None:
    """fsync a folder: its names are durable afterwards. Windows can't open folders, and keeps names by itself.

    Raises OSError.
    """
    if not hasattr(os, "O_DIRECTORY"):
        return
    with descriptor(path, os.O_RDONLY | os.O_DIRECTORY) as fd:
        os.fsync(fd)


def sync_file(path: Path) -> None:
    """fsync a file and its folder: its bytes and its name are durable afterwards. Raises OSError."""
    with descriptor(path, os.O_RDONLY) as fd:
        os.fsync(fd)
    sync_folder(path.parent)


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


@contextlib.contextmanager
def replacing(path: Path) -> Iterator[Path]:
    """The name to write under, with the ending of `path`. A folder can't replace one that isn't empty, so an old one is
    moved aside first. Raises OSError; then `path` is as it was."""
    part = path.with_name(f".{path.stem}.{secrets.token_hex(4)}.part{path.suffix}")
    old = part.with_name(f"{part.name}.old.part")
    try:
        yield part
        _sync_all(part)
        if path.is_dir():
            path.rename(old)
        try:
            part.replace(path)
        except OSError:
            if old.exists():
                old.rename(path)
            raise
        sync_folder(path.parent)
    finally:
        _remove(part)
    _remove(old)


def _sync_all(path: Path) -> None:
    """fsync a file, or a folder with its content."""
    if path.is_file():
        with descriptor(path, os.O_RDWR) as fd:  # Windows flushes no file that is open for reading
            os.fsync(fd)
        return
    for inner in path.iterdir():
        _sync_all(inner)
    sync_folder(path)


def _remove(path: Path) -> None:
    if path.is_dir():
        shutil.rmtree(path)
    else:
        path.unlink(missing_ok=True)


def write_file(path: Path, data: bytes, mode: int = 0o644) -> None:
    """Put `data` under `path`, replacing what was there, whole or not at all. Raises OSError."""

    fill_file(path, lambda fd: write_all(fd, data), mode)


def write_all(fd: int, data: bytes | memoryview) -> None:
    """Write all of `data` where the descriptor stands. Raises OSError."""
    view = memoryview(data)
    while view:
        view = view[os.write(fd, view) :]


def unnamed(folder: Path) -> int:
    """Make a file without a name in this folder, and open it to write and read: it is gone when it is closed, unless
    `take_in` gave it a name. Raises OSError, also where the file system has no such files."""
    return os.open(folder, os.O_RDWR | getattr(os, "O_TMPFILE", 0) | _CLOEXEC, 0o644)


def take_in(source_fd: int, size: int, path: Path, sha256: str | None = None) -> str:
    """Put the first `size` bytes of a file or memfd under `path`, durably; return their SHA-256 (hex): the one given by
    whoever wrote them, else it is computed.

    A file without a name (`unnamed`) on the same file system, with its SHA-256, gets this name. Others are copied.
    Raises OSError, FileExistsError perhaps where something stands at `path`, and EOFError when the source is shorter;
    `path` is then missing or complete, never torn.
    """
    if sha256 is not None:
        if not _given_name(source_fd, size, path):
            fill_file(path, lambda fd: copy(source_fd, fd, size))
        return sha256
    with ThreadPoolExecutor(1, "dappled-hash") as beside:
        computed = beside.submit(hash_descriptor, source_fd, size)
        fill_file(path, lambda fd: copy(source_fd, fd, size))
        return computed.result()


def _given_name(fd: int, size: int, path: Path) -> bool:
    """Make a file without a name durable, then its name. False for any other file, and where the system refuses: a file
    whose name was removed can't have another one, and the name is given by way of /proc."""
    found = os.fstat(fd)
    if found.st_nlink or found.st_size != size or found.st_dev != os.stat(path.parent).st_dev:
        return False
    os.fsync(fd)
    try:
        os.link(f"/proc/self/fd/{fd}", path, src_dir_fd=fd)  # src_dir_fd: only linkat(2) follows the link
    except FileExistsError:
        raise
    except OSError:
        return False
    sync_folder(path.parent)
    return True


def copy(source_fd: int, fd: int, size: int) -> None:
    """Append the first `size` bytes of a file or memfd, whose offset stays. The kernel copies from file to file:
    writing from a memory map would cost a page fault for every 4 KiB. Raises OSError, EOFError."""
    done = 0
    while done < size:
        sent = os.sendfile(fd, source_fd, done, size - done)
        if sent == 0:
            raise EOFError(f"only {done} of {size} bytes arrived")
        done += sent


class NoPlainFileError(OSError):
    """What stands there is not to be read; `strerror` says why, and what to do."""


def plain_file(path: str, flags: int) -> int:
    """Open a file that others may have put there, an opener for `open`: a pipe is not waited for. Raises OSError, also
    for what `check_plain` refuses."""
    fd = os.open(path, flags | getattr(os, "O_NONBLOCK", 0))
    try:
        check_plain(fd, path)
    except OSError:
        os.close(fd)
        raise
    return fd


def check_plain(fd: int, path: str) -> None:
    """Raises NoPlainFileError for a device, which may have no end, and for a file of holes, which can claim any size.
    A folder is the caller's to refuse."""
    found = os.fstat(fd)
    if stat.S_ISDIR(found.st_mode):
        return
    if not stat.S_ISREG(found.st_mode):
        raise NoPlainFileError(errno.EINVAL, "it is no plain file: somebody put it there; use another copy", path)
    if found.st_size <= _BELIEVED_BYTES:
        return
    stored = stored_bytes(fd)
    if found.st_size > _BELIEVED_TIMES * stored:
        said = f"its content would take {found.st_size} bytes, and {stored} are stored: it has holes; use another copy"
        raise NoPlainFileError(errno.EINVAL, said, path)


def stored_bytes(fd: int) -> int:
    """How many bytes of an open plain file its disk bears out. Raises OSError.

    Some file systems (ZFS) give a new file its blocks seconds after it was written. So pieces at random places are
    looked at as well: holes are zeros. Who made the file can't know the places.
    """
    found = os.fstat(fd)
    stored = found.st_blocks * 512 if hasattr(found, "st_blocks") else found.st_size
    if stored * _BELIEVED_TIMES >= found.st_size:
        return stored
    places = struct.unpack(f"{_LOOKS}Q", os.urandom(8 * _LOOKS))
    full = sum(any(os.pread(fd, _LOOK_BYTES, place % found.st_size)) for place in places)
    return max(stored, found.st_size * full // _LOOKS if full >= _LOOKS_FULL else 0)


def read_plain(path: Path) -> bytes:
    """Read such a file whole. Raises OSError."""
    with open(path, "rb", opener=plain_file) as file:
        return file.read()


def hash_file(path: Path) -> str:
    """SHA-256 (hex) of a file's bytes. Raises OSError."""
    with open(path, "rb", opener=plain_file) as file:
        return hashlib.file_digest(file, "sha256").hexdigest()


def hash_descriptor(fd: int, size: int) -> str:
    """SHA-256 (hex) of the first `size` bytes of a file or memfd; its offset stays. Raises OSError, EOFError."""
    sha256 = hashlib.sha256()
    for piece in pieces(fd, size):
        sha256.update(piece)
    return sha256.hexdigest()


def pieces(fd: int, size: int) -> Iterator[memoryview]:
    """The first `size` bytes of a file or memfd, piece by piece in one buffer; its offset stays.

    Places and buffer are aligned as O_DIRECT needs it. Raises OSError, and EOFError where the file is shorter.
    """
    buffer = memoryview(mmap.mmap(-1, _PIECE_BYTES))
    done = 0
    while done < size:
        got = min(os.preadv(fd, [buffer], done), size - done)
        if got == 0:
            raise EOFError(f"only {done} of {size} bytes arrived")
        yield buffer[:got]
        done += got


def fill_file(path: Path, fill: Callable[[int], None], mode: int = 0o644, *, folder: int | None = None) -> None:
    """`write_file` where `fill` writes into a descriptor; what it raises leaves `path` as it was. `folder`: the
    descriptor of the open folder that `path` is relative to. Raises OSError."""
    part = temporary(path)
    try:
        fd = _new(part, mode, folder)
        try:
            fill(fd)
            os.fsync(fd)
        finally:
            os.close(fd)
        os.replace(part, path, src_dir_fd=folder, dst_dir_fd=folder)
        if folder is None:
            sync_folder(path.parent)
        else:
            os.fsync(folder)
    except BaseException:
        with contextlib.suppress(OSError):
            os.unlink(part, dir_fd=folder)
        raise


def _new(part: Path, mode: int, folder: int | None) -> int:
    """Make a temporary file and open it; what an earlier attempt left, or somebody put there, is removed first: a pipe
    would be waited for, a file that has a second name be changed under that too."""
    flags = os.O_WRONLY | os.O_CREAT | os.O_EXCL | _NOFOLLOW | _CLOEXEC
    try:
        return os.open(part, flags, mode, dir_fd=folder)
    except FileExistsError:
        os.unlink(part, dir_fd=folder)
        return os.open(part, flags, mode, dir_fd=folder)
