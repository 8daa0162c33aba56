"""Who is told of a story's end, and how long a file may still be known for a shot's."""

from __future__ import annotations

import threading
from typing import cast

import pytest

from dappled.daemon.pipeline import pending_shots as module
from dappled.daemon.pipeline.pending_shot import FlightWriter, Observer, PendingShot
from dappled.daemon.pipeline.pending_shots import GIVEN_UP, PendingShots
from dappled.flight import Cause, Frame, Shot


class Events:
    """The part of a book that is needed here."""

    def __init__(self) -> None:
        self.told: list[str] = []

    def event(self, kind: str, text: str, index: int | None = None) -> None:
        self.told.append(f"{index} {kind}")


def shot(index: int) -> Shot:
    return Shot(index, Cause("test", "test"), 0, 0)


def frame(index: int) -> Frame:
    return Frame(index, f"frames/{index}.dng", "IMG.DNG", 10, "0" * 64, 0)


def begun(observer: Observer, count: int) -> tuple[PendingShots, list[PendingShot], Events]:
    events = Events()
    shots = PendingShots(cast(FlightWriter, events), observer)
    for index in range(count):
        shots.expect(shot(index))
    return shots, [cast(PendingShot, shots.in_hand(index)) for index in range(count)], events


def test_an_end_that_comes_from_many_threads_at_once_is_told_once() -> None:
    ended: list[int] = []
    shots, all_of_them, _ = begun(Observer(finished=lambda pending: ended.append(pending.shot.index)), 200)
    start = threading.Barrier(4)

    def end() -> None:
        start.wait(20)
        for pending in all_of_them:
            shots.finish(pending)

    threads = [threading.Thread(target=end) for _ in range(4)]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join(20)
    assert sorted(ended) == list(range(200))
    assert shots.waiting() == []


def test_only_the_last_failures_are_still_known_for_theirs() -> None:
    shots, all_of_them, _ = begun(Observer(), GIVEN_UP + 1)
    for pending in all_of_them:
        shots.fail(pending, "the mirror is stuck")
    assert shots.of_file(0) is None
    assert shots.of_file(1) is all_of_them[1]


def test_files_that_follow_are_known_within_a_bound(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(module, "FOLLOWING", 2)
    ended: list[int] = []
    shots, all_of_them, events = begun(Observer(finished=lambda pending: ended.append(pending.shot.index)), 3)
    for pending in all_of_them:
        shots.follow(pending, "on the card")
        shots.finish(pending)
    assert [shots.of_file(index) is not None for index in range(3)] == [False, True, True]
    again = shots.safe(all_of_them[2], frame(2))
    shots.welcome(again, 2, "IMG.DNG")
    assert shots.in_hand(2) is again
    shots.finish(again)
    assert (ended, events.told) == ([0, 1, 2], ["2 followed"])
