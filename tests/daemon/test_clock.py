"""Clocks."""

from __future__ import annotations

import threading
import time

from dappled.daemon.clock import RecordedClock, SystemClock


def test_the_system_clock_keeps_its_offset() -> None:
    clock = SystemClock(5)
    before = clock.monotonic_ns()
    assert before + 5 <= clock.utc_ns() <= clock.monotonic_ns() + 5


def test_a_recorded_clock_moves_only_when_told_and_never_back() -> None:
    clock = RecordedClock(1000, 400)
    assert (clock.utc_ns(), clock.monotonic_ns()) == (1000, 600)
    clock.advance_to(900)
    assert clock.utc_ns() == 1000
    clock.advance(1.5)
    assert clock.monotonic_ns() == 1_500_000_600


def test_waits_end_with_the_recorded_time_the_event_or_the_record() -> None:
    clock, event = RecordedClock(0), threading.Event()
    waiter = threading.Thread(target=clock.wait, args=(event, 10))
    waiter.start()
    deadline = time.monotonic() + 10
    while waiter.is_alive() and time.monotonic() < deadline:
        clock.advance(11)
        waiter.join(0.01)
    assert not waiter.is_alive()
    event.set()
    assert clock.wait(event, 1e6)
    clock.close()
    assert not clock.wait(threading.Event(), 1e6)
