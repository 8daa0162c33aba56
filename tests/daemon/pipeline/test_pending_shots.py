"""A shot's end is reported once, and a late file still belongs to its shot for a while."""

from __future__ import annotations

import threading
from pathlib import Path
from typing import cast

import pytest

from dappled.daemon.pipeline import capture as module
from dappled.daemon.pipeline.capture import GIVEN_UP, Observer, PendingShot, PendingShots, ShotEnds
from dappled.daemon.pipeline.flight_writer import FlightWriter
from dappled.findings import Finding
from dappled.flight import Cause, FlightError, Frame, Shot, Tag
from tests.daemon.fakes import CallingObserver, FakeCamera, arrival, fired, rig
from tests.standing import failure
from tests.waiting import eventually


class Events:
    """The part of a flight writer that is needed here."""

    def __init__(self) -> None:
        self.told: list[str] = []

    def event(self, kind: str, found: Finding, index: int | None = None) -> None:
        self.told.append(f"{index} {kind}")


def shot(index: int) -> Shot:
    return Shot(index, Cause("test", "test"), 0, 0)


def frame(index: int) -> Frame:
    return Frame(index, f"frames/{index}.dng", "IMG.DNG", 10, "0" * 64, 0)


def begun(observer: Observer, count: int) -> tuple[ShotEnds, list[PendingShot], Events]:
    events = Events()
    ends = ShotEnds(PendingShots(FakeCamera()), cast(FlightWriter, events), observer)
    for index in range(count):
        ends.shots.fire(shot(index))
    return ends, [cast(PendingShot, ends.shots.in_hand(index)) for index in range(count)], events


def test_an_end_that_comes_from_many_threads_at_once_is_told_once() -> None:
    ended: list[int] = []
    ends, all_of_them, _ = begun(CallingObserver(finished=lambda pending: ended.append(pending.shot.index)), 200)
    start = threading.Barrier(4)

    def end() -> None:
        start.wait(60)
        for pending in all_of_them:
            ends.finish(pending)

    threads = [threading.Thread(target=end) for _ in range(4)]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join(60)
    assert sorted(ended) == list(range(200))
    assert ends.shots.open() == []


def test_only_the_last_failures_are_still_known_for_theirs() -> None:
    ends, all_of_them, _ = begun(CallingObserver(), GIVEN_UP + 1)
    for pending in all_of_them:
        ends.fail(pending, failure("the mirror is stuck"))
    assert ends.shots.of_file(0) is None
    assert ends.shots.of_file(1) is all_of_them[1]


def test_files_that_follow_are_known_within_a_bound(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(module, "FOLLOWING", 2)
    ended: list[int] = []
    ends, all_of_them, events = begun(CallingObserver(finished=lambda pending: ended.append(pending.shot.index)), 3)
    for pending in all_of_them:
        ends.follow(pending, failure("on the card"))
        ends.finish(pending)
    assert [ends.shots.of_file(index) is not None for index in range(3)] == [False, True, True]
    again = ends.safe(all_of_them[2], frame(2), "IMG.DNG")
    assert ends.shots.in_hand(2) is again
    ends.finish(again)
    assert (ended, events.told) == ([0, 1, 2], ["2 followed"])


def test_waiting_for_the_decoder_ends_with_the_last_tagged_frame() -> None:
    ends, (first, second), _ = begun(Observer(), 2)
    assert ends.shots.wait_decoded(0.0)  # no file has come yet
    first.tag = cast(Tag, object())
    assert not ends.shots.wait_decoded(0.05)
    threading.Timer(0.05, ends.finish, [first]).start()
    assert ends.shots.wait_decoded(20)
    assert second.open


def test_a_shot_is_entered_with_its_first_event_and_again_where_the_ledger_refused(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    with rig(tmp_path, lambda _: []) as one:
        one.request(1)
        assert one.flight.ledger.shot(0) is None  # the journal holds it; the ledger was not waited for

        tries: list[Shot] = []

        def refuse(shot: Shot) -> None:
            tries.append(shot)
            raise FlightError("the disk is full")

        with monkeypatch.context() as broken:
            broken.setattr(one.flight.ledger, "add_shot", refuse)
            one.camera.say(fired(0))
            eventually(lambda: tries, "the first try")
        one.camera.say(arrival(0))
        assert one.ended(0).frame is not None
        row = one.flight.ledger.shot(0)
        assert row is not None
        assert row.state == "safe"
