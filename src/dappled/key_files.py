"""Files that hold a secret: made once and durably, and read where nobody else can use them."""

from __future__ import annotations

import os
import stat
from pathlib import Path

from dappled import durable
from dappled.errors import CallError, DappledError

KEY_BYTES = 32
_MOST = 1 << 16  # the largest holds a few lines


class KeyFileError(CallError):
    """A file is not the secret that it should be, or is not a secret: whoever names it is wrong; one sentence."""


def make(path: Path, text: str) -> None:
    """Write a new secret file for this user alone. Raises DappledError, also where it exists already."""
    try:
        write_new(path, text)
    except FileExistsError:
        raise DappledError(f"{path} exists already; keys are not overwritten: name another file") from None
    except OSError as error:
        raise DappledError(f"{path} can't be written: {error.strerror or error}; check its folder") from error


def write_new(path: Path, text: str, mode: int = 0o600) -> None:
    """Write a file that must not exist yet, durably, with this mode from its first moment. A failure leaves none.

    Raises OSError: FileExistsError where the name is taken.
    """
    fd = os.open(path, os.O_WRONLY | os.O_CREAT | os.O_EXCL | os.O_CLOEXEC, mode)
    try:
        with os.fdopen(fd, "w", encoding="ascii") as file:
            os.fchmod(fd, mode)
            file.write(text)
            file.flush()
            os.fsync(fd)
        durable.sync_folder(path.absolute().parent)
    except OSError:
        path.unlink(missing_ok=True)  # half a key would stop the next attempt
        raise


def read(path: Path, what: str) -> str:
    """The text of a secret file, its first 64 KiB at most, that this user or root alone can read and change.

    `what` says in errors what it should be. Raises KeyFileError.
    """
    try:
        # a pipe must not block, and a folder is open before it is found to be none that can be read
        with durable.descriptor(path, os.O_RDONLY | os.O_NONBLOCK) as fd, open(fd, "rb", closefd=False) as file:
            facts = os.fstat(fd)
            text = file.read(_MOST).decode("ascii")
    except (OSError, UnicodeDecodeError) as error:
        why = error.strerror if isinstance(error, OSError) else "it is not text"
        raise KeyFileError(f"{path} can't be read as {what}: {why}") from error
    if facts.st_mode & 0o077:
        raise KeyFileError(f"{path} can be used by others than its owner: chmod 600 {path}")
    if not stat.S_ISREG(facts.st_mode) or facts.st_uid not in (0, os.geteuid()):
        raise KeyFileError(f"{path} is no file of this user, and can't be {what}: give it to this one with chown")
    return text


def read_key(path: Path, what: str) -> bytes:
    """The key of 32 bytes that 64 hexadecimal digits in a secret file spell. Raises KeyFileError, as `read` does."""
    try:
        key = bytes.fromhex(read(path, what).strip())
    except ValueError:
        key = b""
    if len(key) != KEY_BYTES:
        raise KeyFileError(f"{path} holds no 64 hexadecimal digits: it is not {what}")
    return key
