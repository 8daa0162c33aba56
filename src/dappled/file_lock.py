"""Lock an open file for this process (flock): recording and what changes a flight need it, reading doesn't.

Systems without flock can't record; there these functions raise OSError, and everything that only reads works.
"""

from __future__ import annotations

import errno

try:
    import fcntl
except ModuleNotFoundError:  # Windows
    fcntl = None  # type: ignore[assignment]  # looked at before each use


def lock(fd: int, *, shared: bool = False, wait: bool = False) -> None:
    """Hold the file behind a descriptor, alone or `shared`, until it is closed or the process ends.

    Raises BlockingIOError where another process holds it and this one doesn't `wait`, and OSError.
    """
    if fcntl is None:
        raise OSError(errno.ENOTSUP, "this system has no flock: record, and change flights, on Linux")
    fcntl.flock(fd, (fcntl.LOCK_SH if shared else fcntl.LOCK_EX) | (0 if wait else fcntl.LOCK_NB))
