"""A flood of refusals is a few lines in the log: the first of each peer and reason, then counts."""

from __future__ import annotations

import logging

import pytest

from dappled.clock import RecordedClock
from dappled.findings import Code, Finding, Subject, finding
from dappled.refusals import INTERVAL_S, PEERS, RefusalLog


def by(peer: str, code: Code = Code.PEER_SILENT) -> Finding:
    return finding(code, Subject("peer", peer))


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
        refusals.refused(by("10.0.0.5"))
    assert caplog.messages == ["10.0.0.5: refused: it sent no ZeroMQ greeting"]
    clock.advance(INTERVAL_S)
    refusals.settle()
    refusals.settle()
    assert caplog.messages[1:] == ["10.0.0.5: refused 515 more times in 60 s: it sent no ZeroMQ greeting"]


def test_another_peer_or_reason_is_logged_at_once(refusals: RefusalLog, caplog: pytest.LogCaptureFixture) -> None:
    x, y = Code.PEER_SILENT, Code.PEER_NOT_ZEROMQ
    for peer, code in (("a", x), ("a", y), ("b", x), ("a", x)):
        refusals.refused(by(peer, code))
    assert len(caplog.messages) == 3


def test_after_a_quiet_interval_a_peer_is_new_again(
    refusals: RefusalLog, clock: RecordedClock, caplog: pytest.LogCaptureFixture
) -> None:
    refusals.refused(by("a"), 3)
    clock.advance(INTERVAL_S)
    refusals.refused(by("a"))
    assert caplog.messages == [f"a: refused{times}: it sent no ZeroMQ greeting" for times in (" 3 times", "")]


def test_a_thousand_peers_are_as_many_lines_as_a_person_reads(
    refusals: RefusalLog, clock: RecordedClock, caplog: pytest.LogCaptureFixture
) -> None:
    for number in range(1000):
        refusals.refused(by(f"10.0.{number // 256}.{number % 256}"))
    assert len(caplog.messages) == PEERS + 1
    clock.advance(INTERVAL_S)
    refusals.settle()
    assert caplog.messages[-1] == f"other peers: refused {999 - PEERS} more times in 60 s: it sent no ZeroMQ greeting"


def test_reasons_that_differ_in_numbers_alone_are_one(
    refusals: RefusalLog, clock: RecordedClock, caplog: pytest.LogCaptureFixture
) -> None:
    for left in range(500):
        refusals.refused(finding(Code.DISK_FULL, Subject("source", "a"), left_kb=left))
    clock.advance(INTERVAL_S)
    (last,) = refusals.settle()
    assert len(caplog.messages) == 2
    assert (last.code, dict(last.facts)) == (Code.DISK_FULL, {"left_kb": 499, "times": 499, "within_s": INTERVAL_S})
