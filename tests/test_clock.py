"""Clocks."""

from __future__ import annotations

import threading
import time

import pytest

from dappled.clock import RecordedClock, SystemClock, TimeOfDayClock


def test_the_system_clock_keeps_its_offset() -> None:
    clock = SystemClock(5)
    before = clock.monotonic_ns()
    assert before + 5 <= clock.utc_ns() <= clock.monotonic_ns() + 5


def test_the_time_of_day_follows_the_system_s_steps(monkeypatch: pytest.MonkeyPatch) -> None:
    clock = TimeOfDayClock()
    monkeypatch.setattr(time, "time_ns", lambda: 7)
    assert clock.utc_ns() == 7
    assert clock.monotonic_ns() > 7


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
    deadline = time.monotonic() + 60
    while waiter.is_alive() and time.monotonic() < deadline:
        clock.advance(11)
        waiter.join(0.01)
    assert not waiter.is_alive()
    event.set()
    assert clock.wait(event, 1e6)
    clock.close()
    assert not clock.wait(threading.Event(), 1e6)


@pytest.mark.parametrize("step_s", [3600, -3600])
def test_a_step_of_the_systems_clock_reaches_no_stamp(monkeypatch: pytest.MonkeyPatch, step_s: int) -> None:
    clock = SystemClock()
    before_ns = clock.utc_ns()
    truly = time.time_ns
    monkeypatch.setattr(time, "time_ns", lambda: truly() + step_s * 10**9)
    assert 0 <= clock.utc_ns() - before_ns < 60 * 10**9
    assert abs(SystemClock().utc_ns() - before_ns) > 3500 * 10**9  # the next flight goes by the new time
