"""A file that is only appended to: by one write(2) each time, and brought to the disk within a set time.

What was written survives the death of the process at once; a flusher makes it survive a power cut, without the writer
waiting for it.
"""

from __future__ import annotations

import os
from pathlib import Path

from dappled.flight.errors import FlightError, disk_error
from dappled.flight.flusher import Flusher


class AppendedFile:
    """Owns its descriptor and its flusher. Its owner lets one thread at a time in. What comes after `shut` is refused:
    it must not get into another file, opened since, that was given the same descriptor."""

    def __init__(self, path: Path, what: str, flush_interval_s: float, *, new: bool) -> None:
        """Open or make the file; `new`: there must be none. `what` it is called in sentences. Raises FlightError."""
        self.path, self._what = path, what
        doing = f"{'make' if new else 'open'} {what}"
        flags = os.O_RDWR | os.O_CREAT | os.O_APPEND | os.O_CLOEXEC | (os.O_EXCL if new else 0)
        try:
            self._fd = os.open(path, flags, 0o644)
        except OSError as error:
            raise disk_error(doing, path, error) from error
        try:
            size = os.fstat(self._fd).st_size
            self.last = os.pread(self._fd, 1, size - 1) if size else b""  # byte, when it was opened
        except OSError as error:
            os.close(self._fd)
            raise disk_error(doing, path, error) from error
        self._flusher = Flusher(self._fd, flush_interval_s)
        self._closed = False

    def append(self, data: bytes, doing: str) -> int:
        """One write; how many bytes the disk took. Raises FlightError, "cannot `doing` …", when it took none."""
        self._open_for(doing)
        try:
            written = os.write(self._fd, data)
        except OSError as error:
            raise disk_error(doing, self.path, error) from error
        self._flusher.poke()
        return written

    def cut(self, size: int, doing: str) -> None:
        """Take away what stands beyond `size`. Raises FlightError as `append` does."""
        self._open_for(doing)
        try:
            os.ftruncate(self._fd, size)
        except OSError as error:
            raise disk_error(doing, self.path, error) from error

    @property
    def problem(self) -> str | None:
        """Why what was written may not survive a power cut, if so."""
        error = self._flusher.error
        return None if error is None else str(disk_error(f"flush {self._what}", self.path, error))

    def shut(self) -> bool:
        """From now on nothing is written. False where that had been said before."""
        was, self._closed = self._closed, True
        return not was

    def close(self) -> None:
        """Flush and close, once, after `shut`; the owner need not keep others out meanwhile."""
        self._flusher.close()
        os.close(self._fd)

    def _open_for(self, doing: str) -> None:
        if self._closed:
            raise FlightError(f"cannot {doing} {self.path}: the flight is closed")
