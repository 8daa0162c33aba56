"""Appended bytes reach the disk within a set time, without the writer waiting for it."""

from __future__ import annotations

import os
import threading


class Flusher:
    """fdatasync of one descriptor, at most `interval_s` after the first write that it was told of.

    Owns a thread, not the descriptor. A failed fdatasync stays readable in `error`: what was written before it may
    not survive a power cut.
    """

    def __init__(self, fd: int, interval_s: float = 0.5) -> None:
        self._fd = fd
        self._interval_s = interval_s
        self._dirty = threading.Event()
        self._closing = threading.Event()
        self.error: OSError | None = None
        self._thread = threading.Thread(target=self._run, name="dappled-flusher", daemon=True)
        self._thread.start()

    def poke(self) -> None:
        """Something was written."""
        if not self._dirty.is_set():
            self._dirty.set()

    def close(self) -> None:
        """Flush what is left and end the thread; the descriptor may be closed afterwards."""
        self._closing.set()
        self._dirty.set()
        self._thread.join()

    def _run(self) -> None:
        while not self._closing.is_set():
            self._dirty.wait()
            self._closing.wait(self._interval_s)
            self._sync()
        if self._dirty.is_set():
            self._sync()  # written, then closed, while the last one ran

    def _sync(self) -> None:
        self._dirty.clear()  # before the sync: a write during it is told of again
        try:
            os.fdatasync(self._fd)
        except OSError as error:
            self.error = error
