"""The loop's chores: each at its pace, and none that fails takes another with it."""

from __future__ import annotations

import logging

import pytest

from dappled.daemon.periodic_tasks import AGAIN_NS, PeriodicTask
from dappled.errors import DappledError

S = 10**9


def test_every_turn_or_at_its_own_pace() -> None:
    done: list[str] = []
    chores = [
        PeriodicTask("each", lambda: done.append("each")),
        PeriodicTask("slow", lambda: done.append("slow"), every_ns=S),
    ]
    for now_ns in (5 * S, 5 * S + 1, 6 * S - 1, 6 * S):
        for chore in chores:
            chore.turn(now_ns)
    assert (done.count("each"), done.count("slow")) == (4, 2)


@pytest.mark.parametrize("error", [DappledError("the disk is full"), RuntimeError("a bug")])
def test_one_that_fails_is_tried_again_and_told_once(error: Exception, caplog: pytest.LogCaptureFixture) -> None:
    tries: list[int] = []
    broken = True

    def do() -> None:
        tries.append(1)
        if broken:
            raise error

    chore = PeriodicTask("events", do)
    with caplog.at_level(logging.WARNING):
        for now_ns in (S, S + 1, S + AGAIN_NS - 1, S + AGAIN_NS, S + 2 * AGAIN_NS):
            chore.turn(now_ns)
    assert len(tries) == 3
    assert len(caplog.records) == 1
    assert str(error) in chore.problem
    broken = False
    chore.turn(10 * S)
    chore.turn(10 * S)
    assert (len(tries), chore.problem) == (5, "")
    broken = True
    with caplog.at_level(logging.WARNING):
        chore.turn(11 * S)
    assert len(caplog.records) == 2
