"""Decide when `dappled run --frames N` or `--for SECONDS` has reached its end."""

from __future__ import annotations

from collections.abc import Callable
from typing import Protocol

from dappled.cli.terminal import CameraRemarks, Tally
from dappled.clock import Clock


class BegunFlight(Protocol):
    """A flight that has begun."""

    @property
    def requested(self) -> int:
        """Shots so far."""


class StopCondition:
    """The end of a run: `frames` shots have ended, or `seconds` have passed since the first flight began.

    None means no such end. Where frames are wanted, a ground station that asks for them is started by `ask` once the
    `camera` is ready; what this returns says whether it still asks. The run ends when it has no more requests to send
    and all of its shots have ended.
    """

    def __init__(
        self,
        tally: Tally,
        frames: int | None,
        seconds: float | None,
        *,
        camera: CameraRemarks,
        ask: Callable[[int], Callable[[], bool]] | None,
        clock: Clock,
    ) -> None:
        self._tally, self._frames, self._seconds = tally, frames, seconds
        self._camera, self._ask, self._clock = camera, ask, clock
        self._until_ns: int | None = None
        self._asks: Callable[[], bool] | None = None  # whether it still asks, or waits for an answer
        self._flight: BegunFlight | None = None
        self._earlier = 0

    @property
    def short(self) -> bool:
        """Whether fewer frames are safe than requested."""
        return self._frames is not None and self._tally.safe < self._frames

    def begin(self, flight: BegunFlight) -> None:
        """A flight has begun: its shots come on top of those of earlier flights, which have ended."""
        if self._until_ns is None and self._seconds is not None:
            self._until_ns = self._clock.monotonic_ns() + round(self._seconds * 1e9)
        self._flight, self._earlier = flight, self._tally.count

    def reached(self) -> bool:
        """Whether it is time to end."""
        if self._until_ns is not None and self._clock.monotonic_ns() >= self._until_ns:
            return True
        if self._frames is None:
            return False
        if self._ask is not None and self._asks is None and self._camera.state == "ready":
            self._asks = self._ask(self._frames)
        if self._tally.count >= self._frames:
            return True
        requested = self._earlier + (0 if self._flight is None else self._flight.requested)
        return self._asks is not None and not self._asks() and self._tally.count >= requested
