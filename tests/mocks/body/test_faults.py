from __future__ import annotations

import pytest

from dappled.clock import RecordedClock
from dappled.mocks.body.faults import BodyFaults


def test_a_lasting_fault_ends_by_itself() -> None:
    clock = RecordedClock(5)
    faults = BodyFaults(clock)
    faults.command("busy 2")
    assert faults.lasts("busy")
    assert not faults.lasts("silence")
    clock.advance(2.0)
    assert not faults.lasts("busy")


def test_a_lasting_fault_without_a_number_ends_at_clear() -> None:
    clock = RecordedClock(0)
    faults = BodyFaults(clock)
    faults.command("silence")
    clock.advance_to(10**18)
    assert faults.lasts("silence")
    faults.command("clear")
    assert not faults.lasts("silence")


def test_a_counted_fault_strikes_so_many_times() -> None:
    faults = BodyFaults(RecordedClock(0))
    faults.command("error 2")
    faults.command("short")
    assert [faults.take("error") for _ in range(3)] == [True, True, False]
    assert [faults.take("short") for _ in range(2)] == [True, False]
    assert not faults.take("no-event")


def test_drop_drops_at_once() -> None:
    dropped: list[int] = []
    faults = BodyFaults(RecordedClock(0))
    faults.drop = lambda: dropped.append(1)
    faults.command("drop")
    assert dropped == [1]


@pytest.mark.parametrize("line", ["earthquake", "busy soon", "error 1.5", ""])
def test_words_that_are_no_fault_are_refused(line: str) -> None:
    with pytest.raises(ValueError, match=r"."):
        BodyFaults(RecordedClock(0)).command(line)
