"""Decide when `dappled run --frames N` or `--for SECONDS` has reached its end."""

from __future__ import annotations

import time
from collections.abc import Callable
from typing import Protocol

from dappled.cli.terminal import Tally


class Asker(Protocol):
    """A ground station that asks for frames."""

    def running(self) -> bool:
        """Whether it still asks, or waits for an answer."""


class StopCondition:
    """The end of a run: `frames` shots have ended, or `seconds` have passed since the first flight began.

    None means no such end. `ask` starts the ground station that asks for the frames, once the camera is `ready`. The
    run ends when it has no more requests to send and all of its shots have ended.
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
        """Whether fewer good frames were taken than requested."""
        return self._frames is not None and self._tally.good < self._frames

    def begin(self, requested: Callable[[], int]) -> None:
        """A flight has begun: its `requested` comes on top of the shots of earlier flights, which have ended."""
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
