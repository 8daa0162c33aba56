"""Bounded queues: order, policy when full, counters, and a worker that outlives a bad item."""

from __future__ import annotations

from typing import Literal

import pytest

from dappled.workers import Worker


def test_items_are_worked_off_in_order() -> None:
    seen: list[int] = []
    stage = Worker("test", seen.append, capacity=100)
    stage.start()
    for number in range(50):
        assert stage.put(number)
    assert stage.stop(5)
    assert seen == list(range(50))
    assert (stage.statistics().accepted, stage.statistics().done, stage.statistics().waiting) == (50, 50, 0)


@pytest.mark.parametrize(("policy", "kept", "lost"), [("refuse", [1, 2], [3]), ("drop oldest", [2, 3], [1])])
def test_a_full_queue_keeps_its_policy(
    policy: Literal["refuse", "drop oldest"], kept: list[int], lost: list[int]
) -> None:
    seen: list[int] = []
    dropped: list[int] = []
    stage = Worker("test", seen.append, capacity=2, policy=policy, on_drop=dropped.append)
    taken = [stage.put(number) for number in (1, 2, 3)]
    assert taken[-1] is (policy == "drop oldest")
    stage.start()
    assert stage.stop(5)
    assert (seen, dropped, stage.statistics().dropped) == (kept, lost, 1)


@pytest.mark.filterwarnings("ignore")
def test_one_bad_item_does_not_end_the_stage() -> None:
    seen: list[int] = []
    failed: list[tuple[int, str]] = []

    def work(item: int) -> None:
        if item == 1:
            raise ValueError("one")
        seen.append(item)

    stage = Worker("test", work, capacity=10, on_failure=lambda item, error: failed.append((item, str(error))))
    stage.start()
    for number in range(3):
        stage.put(number)
    assert stage.stop(5)
    assert (seen, failed, stage.statistics().failed) == ([0, 2], [(1, "one")], 1)


def test_a_stopped_stage_takes_nothing_more() -> None:
    stage = Worker[int]("test", lambda _: None, capacity=1)
    stage.start()
    assert stage.stop(5)
    assert not stage.put(1)
