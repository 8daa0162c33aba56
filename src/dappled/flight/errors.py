"""The error of a flight folder, and the finding for each error of the operating system and of SQLite."""

from __future__ import annotations

import errno
import sqlite3
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from dappled import durable
from dappled.bounds.claims import ClaimError
from dappled.errors import DappledError
from dappled.findings import Code, Subject, finding

DISK, LEDGER = Subject("disk"), Subject("ledger")


class FlightError(DappledError):
    """A flight folder can't be written or read."""


_SYSTEM = {
    errno.ENOSPC: Code.SYSTEM_DISK_FULL,
    errno.EDQUOT: Code.SYSTEM_QUOTA_USED,
    errno.EFBIG: Code.SYSTEM_FILE_LIMIT,
    errno.EROFS: Code.SYSTEM_READ_ONLY,
    errno.EACCES: Code.SYSTEM_DENIED,
    errno.EPERM: Code.SYSTEM_DENIED,
    errno.EIO: Code.SYSTEM_IO_ERROR,
    errno.ENOTDIR: Code.SYSTEM_NO_FOLDER,
    errno.EEXIST: Code.SYSTEM_IN_THE_WAY,
    errno.ELOOP: Code.SYSTEM_LINK,
    errno.EMFILE: Code.SYSTEM_FILES_OPEN,
    errno.ENFILE: Code.SYSTEM_FILES_OPEN_EVERYWHERE,
    errno.ENOENT: Code.SYSTEM_MISSING,
    errno.EISDIR: Code.SYSTEM_FOLDER,
}


def disk_error(doing: str, path: Path, error: OSError) -> FlightError:
    """The error for one of the operating system: "cannot <doing> <path>: <why>; <what to do>"."""
    number = error.errno or 0
    if number == errno.ENOTDIR and path.is_symlink():
        number = errno.ELOOP  # what O_DIRECTORY says of a link
    known = None if isinstance(error, durable.NoPlainFileError) else _SYSTEM.get(number, Code.SYSTEM_OTHER)
    why = error if known is None else finding(known, DISK, why=error)
    return FlightError(finding(Code.DISK_REFUSED, DISK, doing=doing, path=path, why=why))


@contextmanager
def disk_errors(doing: str, path: Path) -> Iterator[None]:
    """Context of work on a file or folder: raises FlightError, as `disk_error` makes it, for an OSError in it, and
    for a file that claims too much."""
    try:
        yield
    except OSError as error:
        raise disk_error(doing, path, error) from error
    except ClaimError as error:
        raise FlightError(f"cannot {doing} {path}: {error}") from error


_SQLITE = {
    "SQLITE_NOTADB": Code.SQLITE_NO_DATABASE,
    "SQLITE_CORRUPT": Code.SQLITE_CORRUPT,
    "SQLITE_FULL": Code.SQLITE_FULL,
    "SQLITE_READONLY": Code.SQLITE_READ_ONLY,
    "SQLITE_CANTOPEN": Code.SQLITE_UNOPENED,
    "SQLITE_TOOBIG": Code.SQLITE_TOO_BIG,
    "SQLITE_BUSY": Code.SQLITE_BUSY,
    "SQLITE_IOERR": Code.SQLITE_IO_ERROR,
}


def ledger_error(path: Path, error: sqlite3.Error | UnicodeDecodeError) -> FlightError:
    """The error for one of SQLite about a ledger: what can't be done, why, and what to do."""
    name = getattr(error, "sqlite_errorname", "") or ""
    if isinstance(error, UnicodeDecodeError):  # SQLite quotes damaged text in the words of its error
        name = "SQLITE_CORRUPT"
    if isinstance(error, sqlite3.ProgrammingError):
        return FlightError(finding(Code.LEDGER_MISUSED, LEDGER, path=path, why=error))
    if name.startswith("SQLITE_CONSTRAINT"):
        return FlightError(finding(Code.LEDGER_CONTRADICTED, LEDGER, path=path, why=error))
    code = next((code for start, code in _SQLITE.items() if name.startswith(start)), Code.SQLITE_OTHER)
    return FlightError(finding(Code.LEDGER_UNUSABLE, LEDGER, path=path, why=finding(code, LEDGER, why=error)))
