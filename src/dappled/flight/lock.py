"""One daemon at a time records into a flights folder."""

from __future__ import annotations

import fcntl
import os
from pathlib import Path
from typing import Self

from dappled.flight import durable
from dappled.flight.errors import FlightError, disk_error

FILE_NAME = ".lock"


class FlightsLock:
    """Held from creation to `close`, or to the end of the process however it ends."""

    def __init__(self, root: Path) -> None:
        """Take the lock of `root`, which is made if missing. Raises FlightError when another process has it."""
        path = root / FILE_NAME
        try:
            durable.make_folder(root)
            self._fd = os.open(path, os.O_RDWR | os.O_CREAT | os.O_CLOEXEC, 0o644)
        except OSError as error:
            raise disk_error("make the lock", path, error) from error
        try:
            fcntl.flock(self._fd, fcntl.LOCK_EX | fcntl.LOCK_NB)
            os.ftruncate(self._fd, 0)
            os.pwrite(self._fd, f"{os.getpid()}\n".encode(), 0)
        except BlockingIOError as error:
            holder = os.pread(self._fd, 20, 0).decode("ascii", "replace").strip() or "unknown"
            os.close(self._fd)
            raise FlightError(
                f"another dappled (process {holder}) records into {root}; "
                "stop it, or set record.directory to another folder"
            ) from error
        except OSError as error:
            os.close(self._fd)
            raise disk_error("take the lock", path, error) from error

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def close(self) -> None:
        os.close(self._fd)


def is_held(root: Path) -> bool:
    """Whether some process records into `root` now. Raises FlightError when that can't be told."""
    path = root / FILE_NAME
    try:
        fd = os.open(path, os.O_RDONLY | os.O_CLOEXEC)
    except FileNotFoundError:
        return False
    except OSError as error:
        raise disk_error("look at the lock", path, error) from error
    try:
        fcntl.flock(fd, fcntl.LOCK_SH | fcntl.LOCK_NB)
        return False
    except BlockingIOError:
        return True
    finally:
        os.close(fd)
