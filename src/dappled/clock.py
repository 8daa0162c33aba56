"""Clocks: read the time, wait, and run threads. Each part is given a clock; tests and replays pass their own."""

from __future__ import annotations

import threading
import time
from collections.abc import Callable
from typing import Protocol


class Clock(Protocol):
    """Two times that run at the same rate, waits against them, and the threads that wait. Times are integer
    nanoseconds. A thread that was started here waits through this clock alone, so that a simulated one may know
    of every wait."""

    def monotonic_ns(self) -> int:
        """Time that never steps, the same in every process of this machine (CLOCK_MONOTONIC)."""

    def utc_ns(self) -> int:
        """Time since 1970 as far as this machine knows it."""

    def wait(self, event: threading.Event, timeout_s: float) -> bool:
        """Until the event is set (True) or this clock has gone on by `timeout_s` (False)."""

    def pause(self, event: threading.Event, timeout_s: float | None) -> bool:
        """As `wait`, in the machine's time even where this clock stands still; None: without end."""

    def wait_for(self, changed: threading.Condition, holds: Callable[[], object], timeout_s: float | None) -> bool:
        """As `changed.wait_for`, whose lock is held, in the machine's time; None: without end."""

    def start(self, run: Callable[[], None], name: str) -> threading.Thread:
        """Start a daemon thread."""

    def join(self, thread: threading.Thread, timeout_s: float) -> None:
        """Wait for the end of a thread that was started here, in the machine's time."""


class _MachineThreads:
    """Threads that the machine runs."""

    def pause(self, event: threading.Event, timeout_s: float | None) -> bool:
        """As `wait`, in the machine's time even where this clock stands still; None: without end."""
        return event.wait(timeout_s)

    def wait_for(self, changed: threading.Condition, holds: Callable[[], object], timeout_s: float | None) -> bool:
        """As `changed.wait_for`, whose lock is held, in the machine's time; None: without end."""
        return bool(changed.wait_for(holds, timeout_s))

    def start(self, run: Callable[[], None], name: str) -> threading.Thread:
        """Start a daemon thread."""
        thread = threading.Thread(target=run, name=name, daemon=True)
        thread.start()
        return thread

    def join(self, thread: threading.Thread, timeout_s: float) -> None:
        """Wait for the end of a thread that was started here, in the machine's time."""
        thread.join(timeout_s)


class SystemClock(_MachineThreads):
    """The machine's clock. UTC is the monotonic time plus an offset that is read once, at the flight's start.

    A step of the system's time of day (NTP, a person) does not reach it, so intervals between stamps are exact.
    """

    def __init__(self, utc_minus_monotonic_ns: int | None = None) -> None:
        if utc_minus_monotonic_ns is None:
            utc_minus_monotonic_ns = _offset_now_ns()
        self.utc_minus_monotonic_ns = utc_minus_monotonic_ns

    def monotonic_ns(self) -> int:
        """Time that never steps, the same in every process of this machine (CLOCK_MONOTONIC)."""
        return time.monotonic_ns()

    def utc_ns(self) -> int:
        """Time since 1970 as far as this machine knows it."""
        return time.monotonic_ns() + self.utc_minus_monotonic_ns

    def wait(self, event: threading.Event, timeout_s: float) -> bool:
        """Until the event is set (True) or this clock has gone on by `timeout_s` (False)."""
        return event.wait(max(0.0, timeout_s))


class TimeOfDayClock(SystemClock):
    """The machine's clock. UTC is the system's time of day and follows its steps (NTP, a person)."""

    def utc_ns(self) -> int:
        """Time since 1970 as far as this machine knows it."""
        return time.time_ns()


class RecordedClock(_MachineThreads):
    """A clock that stands still until it is advanced: for replays, and for tests.

    `advance_to` moves it (never backwards). `close` ends every wait, so that no thread
    waits longer than the record lasts.
    """

    def __init__(self, utc_ns: int, utc_minus_monotonic_ns: int = 0) -> None:
        self.utc_minus_monotonic_ns = utc_minus_monotonic_ns
        self._utc_ns = utc_ns
        self._closed = False
        self._changed = threading.Condition()

    def monotonic_ns(self) -> int:
        """Time that never steps, the same in every process of this machine (CLOCK_MONOTONIC)."""
        return self.utc_ns() - self.utc_minus_monotonic_ns

    def utc_ns(self) -> int:
        """Time since 1970 as far as this machine knows it."""
        with self._changed:
            return self._utc_ns

    def advance_to(self, utc_ns: int) -> None:
        """It is now `utc_ns`; an earlier time is ignored."""
        with self._changed:
            self._utc_ns = max(self._utc_ns, utc_ns)
            self._changed.notify_all()

    def advance(self, seconds: float) -> None:
        """Some time has passed."""
        self.advance_to(self.utc_ns() + round(seconds * 1e9))

    def close(self) -> None:
        """The record is over: waits return at once."""
        with self._changed:
            self._closed = True
            self._changed.notify_all()

    def wait(self, event: threading.Event, timeout_s: float) -> bool:
        """Wait in steps: the event is looked at every 10 ms of real time, the clock as soon as it moves."""
        with self._changed:
            until_ns = self._utc_ns + round(timeout_s * 1e9)
            while not (event.is_set() or self._closed or self._utc_ns >= until_ns):
                self._changed.wait(0.01)
        return event.is_set()


def _offset_now_ns() -> int:
    """UTC minus monotonic, from the tightest of a few readings (an interrupted one would be late)."""
    best: tuple[int, int] | None = None
    for _ in range(5):
        before_ns = time.monotonic_ns()
        utc_ns = time.time_ns()
        after_ns = time.monotonic_ns()
        reading = (after_ns - before_ns, utc_ns - (before_ns + after_ns) // 2)
        best = reading if best is None else min(best, reading)
    assert best is not None
    return best[1]
