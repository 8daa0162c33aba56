"""A flood of refusals is a few lines in the log: the first of each peer and reason, then counts."""

from __future__ import annotations

import logging

import pytest

from dappled.clock import RecordedClock
from dappled.refusals import INTERVAL_S, OTHERS, PEERS, RefusalLog, Refusals


@pytest.fixture
def clock() -> RecordedClock:
    return RecordedClock(10**18)


@pytest.fixture
def refusals(clock: RecordedClock) -> RefusalLog:
    return RefusalLog(logging.getLogger("dappled.test"), clock)


def test_the_first_is_logged_at_once_and_a_flood_as_a_count(
    refusals: RefusalLog, clock: RecordedClock, caplog: pytest.LogCaptureFixture
) -> None:
    for _ in range(516):
        refusals.refused("10.0.0.5", "no key")
    assert caplog.messages == ["10.0.0.5: refused: no key"]
    clock.advance(INTERVAL_S)
    refusals.settle()
    refusals.settle()
    assert caplog.messages[1:] == ["10.0.0.5: refused 515 more times in 60 s: no key"]


def test_another_peer_or_reason_is_logged_at_once(refusals: RefusalLog, caplog: pytest.LogCaptureFixture) -> None:
    for peer, reason in (("a", "x"), ("a", "y"), ("b", "x"), ("a", "x")):
        refusals.refused(peer, reason)
    assert len(caplog.messages) == 3


def test_after_a_quiet_interval_a_peer_is_new_again(
    refusals: RefusalLog, clock: RecordedClock, caplog: pytest.LogCaptureFixture
) -> None:
    refusals.refused("a", "x", 3)
    clock.advance(INTERVAL_S)
    refusals.refused("a", "x")
    assert caplog.messages == ["a: refused 3 times: x", "a: refused: x"]


def test_a_thousand_peers_are_as_many_lines_as_a_person_reads(
    refusals: RefusalLog, clock: RecordedClock, caplog: pytest.LogCaptureFixture
) -> None:
    for number in range(1000):
        refusals.refused(f"10.0.{number // 256}.{number % 256}", "x")
    assert len(caplog.messages) == PEERS + 1
    clock.advance(INTERVAL_S)
    refusals.settle()
    assert caplog.messages[-1] == f"other peers: refused {1000 - PEERS - 1} more times in 60 s: x"


def test_reasons_that_differ_in_numbers_alone_are_one(
    refusals: RefusalLog, clock: RecordedClock, caplog: pytest.LogCaptureFixture
) -> None:
    for left in range(500):
        refusals.refused("a", f"the disk is nearly full: {left} MB left")
    clock.advance(INTERVAL_S)
    (last,) = refusals.settle()
    assert (len(caplog.messages), last.count, last.reason) == (2, 499, "the disk is nearly full: 499 MB left")


@pytest.mark.parametrize(
    "one",
    [
        Refusals("IMAGE_START_CAPTURE from mavlink:7/1", "no camera: it is off", 1),
        Refusals("interval from mavlink:7/1", "no camera, 3 more times in 4 s: it is off", 512, 60.0),
        Refusals(OTHERS, "no camera", 70_000, 60.0),
        Refusals("console", "no camera", 3),
    ],
)
def test_an_event_is_read_as_it_was_written(one: Refusals) -> None:
    assert Refusals.of_text(one.text()) == one


def test_a_text_that_is_no_refusal_counts_nothing() -> None:
    assert Refusals.of_text("gibberish") is None
