"""What the console asks of the daemon: one shot for each number, nothing late, and what became of each request."""

from __future__ import annotations

import threading
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest

from dappled.clock import RecordedClock, SystemClock
from dappled.daemon.console.requests import DEADLINE_MS, HEARD_MS, ConsoleRequests, token
from dappled.daemon.health.logbook import Logbook
from dappled.daemon.pipeline.shutter import Shutter
from tests.daemon.fakes import FakeSink, Rig, rig

MS = 10**6


@pytest.fixture
def pipeline(tmp_path: Path) -> Iterator[Rig]:
    with rig(tmp_path) as one:
        one.shutter.start()
        yield one
        one.shutter.stop()


def asked(shutter: Shutter) -> ConsoleRequests:
    return ConsoleRequests(shutter, Logbook(RecordedClock(7)), SystemClock())


def do(requests: ConsoleRequests, **request: Any) -> dict[str, Any]:
    """A question whose button was pressed just now."""
    return requests.answer({"token": token(requests.run, time.monotonic_ns()), "elapsed_ms": 0, **request})


def test_a_number_that_comes_twice_is_one_request(pipeline: Rig) -> None:
    requests = asked(pipeline.shutter)
    assert do(requests, do="shoot", sequence=5) == {"ok": True, "index": 0, "text": "shot 0"}
    assert do(requests, do="shoot", sequence=5)["text"] == "already shot 0"
    assert do(requests, do="shoot", sequence=6)["index"] == 1
    pipeline.ended(1)
    assert pipeline.shutter.statistics().shots == 2


def test_an_interval_and_its_end() -> None:
    shutter = Shutter(FakeSink(), SystemClock(), next_index=0, capacity=1000)
    requests = asked(shutter)
    shutter.start()
    assert do(requests, do="interval", sequence=1, interval_s=0.05, count=0)["ok"]
    until = time.monotonic() + 20
    while shutter.statistics().shots < 3:
        assert time.monotonic() < until
        threading.Event().wait(0.01)
    assert do(requests, do="stop interval")["text"] == "the interval is stopped"
    assert do(requests, do="stop interval")["text"] == "no interval was running"
    answer = do(requests, do="interval", sequence=2, interval_s=-1, count=0)
    assert (answer["ok"], answer["error"]) == (False, "an interval must be 0 to 86400 s, and a count 0 or more")
    shutter.stop()


def test_a_refusal_is_told_and_remembered(pipeline: Rig) -> None:
    requests = asked(pipeline.shutter)
    pipeline.shutter.stop()
    refused = do(requests, do="shoot", sequence=1)
    assert refused["error"] == "the daemon is stopping"
    assert do(requests, do="outcome", sequence=1) == {"ok": True, "state": "known", "answer": refused}


def test_the_log_is_told_from_a_number_on(pipeline: Rig) -> None:
    logbook = Logbook(RecordedClock(7))
    logbook.add("one")
    logbook.add("two", "warning")
    requests = ConsoleRequests(pipeline.shutter, logbook, SystemClock())
    assert requests.answer({"do": "log", "after": 1})["lines"] == [
        {"number": 2, "utc_ns": 7, "level": "warning", "text": "two"}
    ]
    assert requests.answer({"do": "nothing"}) == {"ok": True}


class Late:
    """A page that heard the clock at 1 s, and a daemon whose clock the test moves."""

    def __init__(self) -> None:
        self.clock = RecordedClock(1000 * MS)
        self.sink = FakeSink()
        self.requests = ConsoleRequests(Shutter(self.sink, self.clock, next_index=0), Logbook(self.clock), self.clock)
        self.token = token(self.requests.run, self.clock.monotonic_ns())

    def at(self, ms: int, **request: Any) -> dict[str, Any]:
        """The answer to what arrives `ms` after the page heard the clock."""
        self.clock.advance_to((1000 + ms) * MS)
        return self.requests.answer({"token": self.token, **request})


@pytest.mark.parametrize("what", [{"do": "shoot"}, {"do": "interval", "interval_s": 1, "count": 3}])
def test_a_request_that_comes_late_fires_nothing(what: dict[str, Any]) -> None:
    """As over a link that was cut and came back: by the daemon's clock, whatever the page's clock says."""
    one = Late()
    assert one.at(500 + DEADLINE_MS, elapsed_ms=500, sequence=1, **what)["ok"]
    assert one.at(63_000, elapsed_ms=500, sequence=2, **what)["error"] == (
        "nothing was fired: the request came 62 s after the button was pressed"
    )
    assert not one.at(63_000, elapsed_ms=10**9, sequence=3, **what)["ok"]  # a page's clock can't stretch the deadline
    assert one.sink.fired == [0]


def test_a_page_s_clock_adds_at_most_what_it_may_have_heard_nothing() -> None:
    one = Late()
    assert one.at(HEARD_MS + DEADLINE_MS, elapsed_ms=10**9, sequence=1, do="shoot")["ok"]
    assert not one.at(HEARD_MS + DEADLINE_MS + 1, elapsed_ms=10**9, sequence=2, do="shoot")["ok"]


@pytest.mark.parametrize("given", ["", "-", "-1000", "0000-1000", "x", "1000"])
def test_a_token_of_another_daemon_fires_nothing(given: str) -> None:
    one = Late()
    assert "reload it" in one.at(0, token=given, sequence=1, do="shoot")["error"]
    assert one.sink.fired == []


def test_what_became_of_a_request_can_be_asked() -> None:
    one = Late()
    assert one.at(100, sequence=1, elapsed_ms=100, do="outcome")["state"] == "waiting"  # it may still come
    shot = one.at(200, sequence=1, elapsed_ms=100, do="shoot")
    assert one.at(9000, sequence=1, elapsed_ms=100, do="outcome")["answer"] == shot
    assert one.at(9000, sequence=2, elapsed_ms=100, do="outcome")["state"] == "never"
    assert not one.at(9000, sequence=2, elapsed_ms=100, do="shoot")["ok"]
    assert one.at(9000, sequence=1, elapsed_ms=0, do="outcome", token="0000-1")["state"] == "known"  # noqa: S106  # it opens nothing
    assert one.at(9000, sequence=3, elapsed_ms=0, do="outcome", token="0000-1")["state"] == "restarted"  # noqa: S106  # as above
