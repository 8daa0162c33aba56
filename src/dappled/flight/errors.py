"""The error of a flight folder, and the sentence for each error of the operating system."""

from __future__ import annotations

import errno
import os
import sqlite3
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from dappled import durable
from dappled.bounds.claims import ClaimError
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
    errno.ELOOP: "a link is in its place, and links are not followed; remove it",
    errno.EMFILE: "too many files are open; close other programs or raise the limit (ulimit -n)",
    errno.ENFILE: "too many files are open; close other programs",
    errno.ENOENT: "it does not exist; check the path",
    errno.EISDIR: "it is a folder, not a file; check the path",
}


def disk_error(doing: str, path: Path, error: OSError) -> FlightError:
    """The sentence for an operating system error: "cannot <doing> <path>: <why>; <what to do>"."""
    number = error.errno or 0
    if number == errno.ENOTDIR and path.is_symlink():
        number = errno.ELOOP  # what O_DIRECTORY says of a link
    why = _REMEDIES.get(number) or f"{os.strerror(number) if number else error}; check the disk"
    if isinstance(error, durable.NoPlainFileError):
        why = str(error.strerror)
    return FlightError(f"cannot {doing} {path}: {why}")


@contextmanager
def disk_errors(doing: str, path: Path) -> Iterator[None]:
    """Context of work on a file or folder: raises FlightError, the sentence of `disk_error`, for an OSError in it, and
    for a file that claims too much."""
    try:
        yield
    except OSError as error:
        raise disk_error(doing, path, error) from error
    except ClaimError as error:
        raise FlightError(f"cannot {doing} {path}: {error}") from error


_LEDGER_REASONS = {
    "SQLITE_NOTADB": "it is damaged, or not an SQLite file; move it away: frames and shots.jsonl are intact",
    "SQLITE_CORRUPT": "it is damaged; move it away: frames and shots.jsonl are intact",
    "SQLITE_FULL": "the disk is full; free some space or set record.directory to another disk",
    "SQLITE_READONLY": "the disk or the file is read-only; make it writable or set record.directory elsewhere",
    "SQLITE_CANTOPEN": "it can't be opened; check that its folder exists and is accessible",
    "SQLITE_TOOBIG": "a value in it takes more than 16 MB, which dappled never writes; use another copy of it",
    "SQLITE_BUSY": "another program holds it; close that program",
    "SQLITE_IOERR": "the disk reports an input/output error, or is full; check the disk (df, dmesg)",
}


def ledger_error(path: Path, error: sqlite3.Error | UnicodeDecodeError) -> FlightError:
    """The sentence for an SQLite error in a ledger: what can't be done, why, and what to do."""
    code = getattr(error, "sqlite_errorname", "") or ""
    if isinstance(error, UnicodeDecodeError):  # SQLite quotes damaged text in the words of its error
        code = "SQLITE_CORRUPT"
    if isinstance(error, sqlite3.ProgrammingError):
        return FlightError(f"the ledger {path} was used after it was closed or in a wrong way: {error}")
    if code.startswith("SQLITE_CONSTRAINT"):
        return FlightError(f"the ledger {path} refuses a row that contradicts the others: {error}")
    for start, why in _LEDGER_REASONS.items():
        if code.startswith(start):
            return FlightError(f"cannot use the ledger {path}: {why}")
    return FlightError(f"cannot use the ledger {path}: {error}; check the disk and the file")
