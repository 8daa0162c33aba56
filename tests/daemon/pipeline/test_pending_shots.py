"""Who is told of a story's end, and how long a file may still be known for a shot's."""

from __future__ import annotations

import threading
from typing import cast

import pytest

from dappled.daemon.pipeline import pending_shots as module
from dappled.daemon.pipeline.pending_shot import Book, Story, Watchers
from dappled.daemon.pipeline.pending_shots import GIVEN_UP, Stories
from dappled.flight.records import Cause, Frame, Shot


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


def begun(watchers: Watchers, count: int) -> tuple[Stories, list[Story], Events]:
    events = Events()
    stories = Stories(cast(Book, events), watchers)
    for index in range(count):
        stories.expect(shot(index))
    return stories, [cast(Story, stories.in_hand(index)) for index in range(count)], events


def test_an_end_that_comes_from_many_threads_at_once_is_told_once() -> None:
    ended: list[int] = []
    stories, all_of_them, _ = begun(Watchers(finished=lambda story: ended.append(story.shot.index)), 200)
    start = threading.Barrier(4)

    def end() -> None:
        start.wait(20)
        for story in all_of_them:
            stories.finish(story)

    threads = [threading.Thread(target=end) for _ in range(4)]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join(20)
    assert sorted(ended) == list(range(200))
    assert stories.waiting() == []


def test_only_the_last_failures_are_still_known_for_theirs() -> None:
    stories, all_of_them, _ = begun(Watchers(), GIVEN_UP + 1)
    for story in all_of_them:
        stories.fail(story, "the mirror is stuck")
    assert stories.of_file(0) is None
    assert stories.of_file(1) is all_of_them[1]


def test_files_that_follow_are_known_within_a_bound(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(module, "FOLLOWING", 2)
    ended: list[int] = []
    stories, all_of_them, events = begun(Watchers(finished=lambda story: ended.append(story.shot.index)), 3)
    for story in all_of_them:
        stories.follow(story, "on the card")
        stories.finish(story)
    assert [stories.of_file(index) is not None for index in range(3)] == [False, True, True]
    again = stories.safe(all_of_them[2], frame(2))
    stories.welcome(again, 2, "IMG.DNG")
    assert stories.in_hand(2) is again
    stories.finish(again)
    assert (ended, events.told) == ([0, 1, 2], ["2 followed"])
