from __future__ import annotations

import pytest

from dappled.mocks.body.faults import BodyFaults


def test_a_lasting_fault_ends_by_itself() -> None:
    now_ns = 5
    faults = BodyFaults(lambda: now_ns)
    faults.command("busy 2")
    assert faults.lasts("busy")
    assert not faults.lasts("silence")
    now_ns += 2_000_000_000
    assert not faults.lasts("busy")


def test_a_lasting_fault_without_a_number_ends_at_clear() -> None:
    now_ns = 0
    faults = BodyFaults(lambda: now_ns)
    faults.command("silence")
    now_ns = 10**18
    assert faults.lasts("silence")
    faults.command("clear")
    assert not faults.lasts("silence")


def test_a_counted_fault_strikes_so_many_times() -> None:
    faults = BodyFaults(lambda: 0)
    faults.command("error 2")
    faults.command("short")
    assert [faults.take("error") for _ in range(3)] == [True, True, False]
    assert [faults.take("short") for _ in range(2)] == [True, False]
    assert not faults.take("no-event")


def test_drop_drops_at_once() -> None:
    dropped: list[int] = []
    faults = BodyFaults(lambda: 0)
    faults.drop = lambda: dropped.append(1)
    faults.command("drop")
    assert dropped == [1]


@pytest.mark.parametrize("line", ["earthquake", "busy soon", "error 1.5", ""])
def test_words_that_are_no_fault_are_refused(line: str) -> None:
    with pytest.raises(ValueError, match=r"."):
        BodyFaults(lambda: 0).command(line)
