"""Files that hold a secret: made once and durably, and read with word of who else can use them."""

from __future__ import annotations

import os
import stat
from dataclasses import dataclass, field
from pathlib import Path

from dappled import durable

KEY_BYTES = 32
_MOST = 1 << 16  # the largest holds a few lines


@dataclass(frozen=True, slots=True)
class KeyFile:
    """What a file holds, and whether that is a secret of this user.

    `own`: a file, and not a pipe, of this user or of root. `private`: its mode lets nobody else read or change it.
    """

    data: bytes = field(repr=False)
    own: bool
    private: bool


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


def read(path: Path) -> KeyFile:
    """Read a file that should be a secret of this user, its first 64 KiB at most. Raises OSError."""
    fd = os.open(path, os.O_RDONLY | os.O_NONBLOCK | os.O_CLOEXEC)  # a pipe must not block
    with os.fdopen(fd, "rb") as file:
        facts = os.fstat(fd)
        data = file.read(_MOST)
    own = stat.S_ISREG(facts.st_mode) and facts.st_uid in (0, os.geteuid())
    return KeyFile(data, own, private=not facts.st_mode & 0o077)


def key_in(data: bytes) -> bytes | None:
    """The key of 32 bytes that 64 hexadecimal digits spell; None where they are anything else."""
    try:
        key = bytes.fromhex(data.decode("ascii").strip())
    except ValueError:
        return None
    return key if len(key) == KEY_BYTES else None
