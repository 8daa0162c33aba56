"""What the working loop does again and again: each chore at its pace, and none that fails ends the loop."""

from __future__ import annotations

import logging
from collections.abc import Callable

from dappled.errors import report, sentence

log = logging.getLogger(__name__)
AGAIN_NS = 10**9


class PeriodicTask:
    """Something to do in every turn of the loop, or every `every_ns`. Where it fails it is tried again a second later;
    the log hears of it once, until it has been well again. Times are monotonic."""

    def __init__(self, name: str, do: Callable[[], object], *, every_ns: int = 0) -> None:
        self.name = name
        self.problem = ""
        self._do, self._every_ns = do, every_ns
        self._due_ns = 0

    def turn(self, now_ns: int) -> None:
        """Do it if it is due."""
        if now_ns < self._due_ns:
            return
        try:
            self._do()
        except Exception as error:  # noqa: BLE001  # a disk that refuses, or a bug in one chore: the flight goes on
            if not self.problem:
                report(log, self.name, error)
            self.problem = f"{self.name}: {sentence(error)}"
            self._due_ns = now_ns + AGAIN_NS
        else:
            self.problem = ""
            self._due_ns = now_ns + self._every_ns
