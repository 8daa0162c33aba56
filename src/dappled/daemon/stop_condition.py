"""When a daemon that is to take so many frames, or to run for so long, has had them; and what came of its shots."""

from __future__ import annotations

import threading
import time
from collections.abc import Callable
from typing import Protocol

from dappled.daemon.pipeline.capture import PendingShot


class Asker(Protocol):
    """A ground station that asks for frames."""

    def running(self) -> bool:
        """Whether it still asks, or waits for an answer."""


class Tally:
    """Counts the shots that have ended, over all flights of the process. Any thread may `add`."""

    def __init__(self) -> None:
        self.count = self.safe = self.decoded = self.good = 0
        self._lock = threading.Lock()

    def add(self, one: PendingShot) -> None:
        """A shot has come to its end."""
        with self._lock:
            self.count += 1
            self.safe += one.frame is not None
            self.decoded += one.decoded is not None
            self.good += not one.problem

    def summary(self) -> str:
        """The counts as a line."""
        bad = self.count - self.good
        return f"{self.count} shots: {self.safe} frames safe, {self.decoded} decoded, {bad} with a problem"


class StopCondition:
    """So many shots ended, or so many seconds gone since the first flight began; None: no such end.

    `ask` starts who asks for the frames, once the camera is `ready`. When they have nothing more to ask, and all that
    they asked for has ended, there is nothing left to wait for either.
    """

    def __init__(
        self,
        tally: Tally,
        frames: int | None,
        seconds: float | None,
        *,
        ask: Callable[[], Asker] | None,
        ready: Callable[[], bool],
        clock_s: Callable[[], float] = time.monotonic,
    ) -> None:
        self._tally, self._frames, self._seconds = tally, frames, seconds
        self._ask, self._ready, self._clock_s = ask, ready, clock_s
        self._until_s: float | None = None
        self._asker: Asker | None = None
        self._requested: Callable[[], int] = lambda: 0

    @property
    def short(self) -> bool:
        """Whether good frames are missing of those wanted."""
        return self._frames is not None and self._tally.good < self._frames

    def begin(self, requested: Callable[[], int]) -> None:
        """A flight has begun. Its requested shots are added to those of earlier flights, which have ended."""
        if self._until_s is None and self._seconds is not None:
            self._until_s = self._clock_s() + self._seconds
        earlier = self._tally.count
        self._requested = lambda: earlier + requested()

    def reached(self) -> bool:
        """Whether it is time to end."""
        if self._until_s is not None and self._clock_s() >= self._until_s:
            return True
        if self._frames is None:
            return False
        if self._ask is not None and self._asker is None and self._ready():
            self._asker = self._ask()
        if self._tally.count >= self._frames:
            return True
        return self._asker is not None and not self._asker.running() and self._tally.count >= self._requested()
