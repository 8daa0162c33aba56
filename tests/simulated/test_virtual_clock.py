"""The virtual clock: order by seed, jumps, and what it says where nothing can go on."""

from __future__ import annotations

import threading
import time

import pytest

from dappled.workers import Loop, Worker
from tests.simulated.virtual_clock import StuckError, VirtualClock


def order(seed: int) -> list[str]:
    """Three threads that wait for the same moments, in the order of their turns."""
    turns: list[str] = []
    with VirtualClock(seed) as clock:

        def run(name: str) -> None:
            for _ in range(5):
                turns.append(name)
                clock.sleep(1.0)

        loops = [Loop(name, lambda name=name: run(name), clock=clock) for name in "abc"]  # type: ignore[misc]
        for loop in loops:
            loop.start()
        clock.sleep(10.0)
        assert all(loop.stop(0.0) for loop in loops)
    return turns


def test_the_seed_gives_the_order_of_threads_that_are_ready_together() -> None:
    assert order(1) == order(1)
    assert len({tuple(order(seed)) for seed in range(5)}) > 1


def test_an_hour_of_waiting_takes_no_time() -> None:
    began, stopping = time.monotonic(), threading.Event()
    with VirtualClock() as clock:
        start_ns = clock.monotonic_ns()
        assert not clock.wait(stopping, 3600.0)
        assert clock.monotonic_ns() - start_ns == 3600 * 10**9
    assert time.monotonic() - began < 60


def test_a_worker_is_served_before_time_goes_on() -> None:
    done: list[tuple[int, int]] = []
    with VirtualClock() as clock:
        worker = Worker[int]("work", lambda item: done.append((item, clock.monotonic_ns())), capacity=9, clock=clock)
        worker.start()
        at_ns = clock.monotonic_ns()
        for item in range(3):
            worker.put(item)
        clock.sleep(1.0)
        assert worker.stop(1.0)
    assert done == [(item, at_ns) for item in range(3)]


def test_a_wait_that_nothing_can_end_is_told_with_the_threads() -> None:
    never = threading.Condition()
    with VirtualClock() as clock, pytest.raises(StuckError, match="all wait without end: the test"), never:
        clock.wait_for(never, bool, None)


def test_a_thread_that_asks_without_end_is_told() -> None:
    def ask(clock: VirtualClock) -> None:
        while True:
            clock.sleep(0.0)

    with VirtualClock() as clock, pytest.raises(StuckError, match="turns at one moment"):
        ask(clock)


def test_a_thread_of_another_kind_is_told() -> None:
    caught: list[BaseException] = []
    clock = VirtualClock()

    def wait() -> None:
        try:
            clock.sleep(1.0)
        except StuckError as error:
            caught.append(error)

    thread = threading.Thread(target=wait, name="stranger")
    thread.start()
    thread.join()
    assert str(caught[0]) == "stranger waits, and was not started by this clock"


def test_threads_that_are_left_are_told() -> None:
    with pytest.raises(StuckError, match="not ended: left"), VirtualClock() as clock:
        Loop("left", lambda: clock.sleep(1.0), clock=clock).start()
