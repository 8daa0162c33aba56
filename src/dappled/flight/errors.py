"""The error of a flight folder, and the sentence for each error of the operating system."""

from __future__ import annotations

import errno
import os
from pathlib import Path

from dappled.errors import DappledError


class FlightError(DappledError):
    """A flight folder can't be written or read."""


_REMEDIES = {
    errno.ENOSPC: "the disk is full; free some space or set record.directory to another disk",
    errno.EDQUOT: "the disk quota is used up; free some space or set record.directory to another disk",
    errno.EFBIG: "the file would be larger than the system allows; raise the file size limit",
    errno.EROFS: "the disk is mounted read-only; remount it for writing or set record.directory to another disk",
    errno.EACCES: "permission denied; make it accessible to this user or set record.directory to another folder",
    errno.EPERM: "permission denied; make it accessible to this user or set record.directory to another folder",
    errno.EIO: "the disk reports an input/output error; check the disk (dmesg) or set record.directory to another one",
    errno.ENOTDIR: "a part of this path is a file, not a folder; set record.directory to a folder",
    errno.EEXIST: "a file of this name is in the way; move it or set record.directory to another folder",
    errno.ELOOP: "a link stands there, and links are not followed; remove it",
    errno.EMFILE: "too many files are open; close other programs or raise the limit (ulimit -n)",
    errno.ENFILE: "too many files are open; close other programs",
    errno.ENOENT: "it does not exist; check the path",
    errno.EISDIR: "it is a folder, not a file; check the path",
}


def disk_error(doing: str, path: Path, error: OSError) -> FlightError:
    """The sentence for an operating system error: "cannot <doing> <path>: <why>; <what to do>"."""
    number = error.errno or 0
    why = _REMEDIES.get(number) or f"{os.strerror(number) if number else error}; check the disk"
    return FlightError(f"cannot {doing} {path}: {why}")
