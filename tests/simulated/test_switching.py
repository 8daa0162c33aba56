"""Locks where threads change: one that is there keeps a count right by any seed, and one that is missing shows."""

from __future__ import annotations

from contextlib import AbstractContextManager, nullcontext

import pytest

from dappled.workers import Loop
from tests.simulated.switching import SwitchingLock
from tests.simulated.virtual_clock import VirtualClock


def counted(seed: int, *, locked: bool) -> int:
    """Four threads add to one number a hundred times each; they may change between its reading and its writing."""
    total = 0
    with VirtualClock(seed) as clock:
        lock: AbstractContextManager[None] = SwitchingLock(clock, reentrant=False) if locked else nullcontext()

        def add() -> None:
            nonlocal total
            for _ in range(100):
                with lock:
                    before = total
                    clock.switch()
                    total = before + 1

        loops = [Loop(f"adds {number}", add, clock=clock) for number in range(4)]
        for loop in loops:
            loop.start()
        clock.sleep(60.0)
        assert all(loop.stop(1.0) for loop in loops)
    return total


@pytest.mark.parametrize("seed", range(5))
def test_a_lock_keeps_the_count_and_a_missing_one_shows(seed: int) -> None:
    assert counted(seed, locked=True) == 400
    assert counted(seed, locked=False) < 400


def test_a_lock_that_another_thread_holds_is_waited_for_no_longer_than_wanted() -> None:
    with VirtualClock() as clock:
        lock = SwitchingLock(clock, reentrant=False)

        def hold() -> None:
            with lock:
                clock.sleep(5.0)

        holder = Loop("holds", hold, clock=clock)
        holder.start()
        clock.sleep(1.0)
        assert not lock.acquire(blocking=False)
        assert not lock.acquire(timeout=1.0)
        assert lock.acquire(timeout=10.0)
        holder.stop(1.0)
