"""What the console asks of the daemon: one shot for each number, nothing late, and what became of each request."""

from __future__ import annotations

import threading
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest

from dappled.clock import RecordedClock, SystemClock
from dappled.daemon.camera_protocol.parameters import Parameters
from dappled.daemon.console.live_view import CameraLook
from dappled.daemon.console.requests import DEADLINE_MS, HEARD_MS, ConsoleRequests, token
from dappled.daemon.health.logbook import Logbook
from dappled.daemon.pipeline.shutter import IntervalEnd, Shutter
from dappled.daemon.pipeline.spacing import DistanceTrigger
from dappled.drivers.camera import PlainCamera, Setting, SettingName
from tests.daemon.fakes import FakeSink, Rig, rig

MS = 10**6


@pytest.fixture
def pipeline(tmp_path: Path) -> Iterator[Rig]:
    with rig(tmp_path) as one:
        one.shutter.start()
        yield one
        one.shutter.stop()


def asked(shutter: Shutter) -> ConsoleRequests:
    return ConsoleRequests(
        shutter, Parameters(Body()), NoLook(), Logbook(RecordedClock(7)), series=NoSeries(), clock=SystemClock()
    )


class NoSeries(DistanceTrigger):
    """Photographs by distance. `ran`: what a stop finds."""

    def __init__(self, ran: IntervalEnd = "none ran") -> None:
        self.ran, self.asked_ns = ran, 0

    def end(self, *, asked_ns: int | None = None) -> IntervalEnd:
        self.asked_ns = asked_ns or 0
        return self.ran


class NoLook(CameraLook):
    """A camera without live view."""

    def __init__(self) -> None:
        pass

    def answer(self) -> dict[str, Any]:
        return {"ok": False, "error": "none"}


class Body(PlainCamera):
    """A camera with an ISO that can be set, and a battery that can be read."""

    def __init__(self) -> None:
        super().__init__()
        self.asked: list[tuple[str, str]] = []

    def settings(self) -> tuple[Setting, ...]:
        return Setting("iso", "100", ("100", "200")), Setting("battery", "50%")

    def change(self, name: SettingName, value: str) -> None:
        self.asked.append((name, value))


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
    until = time.monotonic() + 60
    while shutter.statistics().shots < 3:
        assert time.monotonic() < until
        threading.Event().wait(0.01)
    assert do(requests, do="stop interval")["text"] == "the interval is stopped"
    answer = do(requests, do="interval", sequence=2, interval_s=-1, count=0)
    assert (answer["ok"], answer["error"]) == (
        False,
        "no photo: an interval must be 0 to 86400 s, and a count 0 or more",
    )
    shutter.stop()


def test_a_refusal_is_told_and_remembered(pipeline: Rig) -> None:
    requests = asked(pipeline.shutter)
    pipeline.shutter.stop()
    refused = do(requests, do="shoot", sequence=1)
    assert refused["error"] == "no photo: the daemon is stopping"
    assert do(requests, do="outcome", sequence=1) == {"ok": True, "state": "known", "answer": refused}


def test_the_log_is_told_from_a_number_on(pipeline: Rig) -> None:
    logbook = Logbook(RecordedClock(7))
    logbook.add("one")
    logbook.add("two", "warning")
    requests = ConsoleRequests(
        pipeline.shutter, Parameters(Body()), NoLook(), logbook, series=NoSeries(), clock=SystemClock()
    )
    assert requests.answer({"do": "log", "after": 1})["lines"] == [
        {"number": 2, "utc_ns": 7, "level": "warning", "text": "two"}
    ]
    assert requests.answer({"do": "nothing"}) == {"ok": True}


class Late:
    """A page that heard the clock at 1 s, and a daemon whose clock the test moves."""

    def __init__(self) -> None:
        self.clock = RecordedClock(1000 * MS)
        self.sink = FakeSink()
        self.body, self.shutter = Body(), Shutter(self.sink, self.clock, next_index=0)
        self.requests = ConsoleRequests(
            self.shutter, Parameters(self.body), NoLook(), Logbook(self.clock), series=NoSeries(), clock=self.clock
        )
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


def test_a_stop_that_a_link_held_back_leaves_alone_what_was_begun_since() -> None:
    one = Late()
    one.at(0, sequence=1, do="interval", interval_s=60, count=0)
    assert one.at(63_000, elapsed_ms=500, do="stop interval")["text"] == "the interval is stopped"  # never too late
    assert one.at(64_000, elapsed_ms=500, do="stop interval")["text"] == "the interval is stopped"  # the same press
    assert one.at(64_000, elapsed_ms=64_000, do="stop interval")["text"] == "no interval was running"
    one.token = token(one.requests.run, one.clock.monotonic_ns())
    assert one.at(70_000, sequence=2, do="interval", interval_s=60, count=0, elapsed_ms=6000)["ok"]
    held = one.at(80_000, elapsed_ms=5000, do="stop interval")
    assert (held["ok"], "press it again" in held["error"]) == (False, True)
    assert one.shutter.statistics().interval_s == 60
    other = one.at(80_000, token="0000-1", do="stop interval")  # noqa: S106  # it opens nothing
    assert other["text"] == "no interval of then is running: the daemon was started again since"
    assert one.shutter.statistics().interval_s == 60
    assert one.at(80_000, elapsed_ms=16_000, do="stop interval")["text"] == "the interval is stopped"


@pytest.mark.parametrize(
    ("ran", "ok", "words"),
    [
        ("stopped", True, "the interval is stopped"),
        ("none ran", True, "no interval was running"),
        ("began later", False, "press it again"),
    ],
)
def test_a_stop_also_ends_photographs_by_distance(ran: IntervalEnd, ok: bool, words: str) -> None:
    shutter, clock, series = Late().shutter, SystemClock(), NoSeries(ran)
    one = ConsoleRequests(shutter, Parameters(Body()), NoLook(), Logbook(RecordedClock(7)), series=series, clock=clock)
    answer = do(one, do="stop interval")
    assert answer["ok"] == ok
    assert words in answer.get("text", "") + answer.get("error", "")
    assert abs(series.asked_ns - clock.monotonic_ns()) < 60 * 10**9  # when it was pressed


def test_a_stop_right_after_the_start_that_the_page_has_seen_is_meant_for_it() -> None:
    one = Late()
    one.at(0, sequence=1, do="interval", interval_s=60, count=0)
    assert one.at(0, elapsed_ms=0, do="stop interval")["text"] == "the interval is stopped"


def test_a_setting_is_asked_of_the_camera_once_and_never_late() -> None:
    one = Late()
    asked = {"do": "set", "name": "CAM_ISO", "value": "200", "sequence": 1}
    assert one.at(100, **asked) == {"ok": True, "text": "the camera was asked for 200"}
    assert one.at(200, **asked)["ok"]
    assert one.body.asked == [("iso", "200")]
    assert one.at(63_000, **{**asked, "sequence": 2})["error"].startswith(
        "nothing was set: the request came 63 s after"
    )
    assert one.body.asked == [("iso", "200")]


@pytest.mark.parametrize(
    ("name", "value", "words"),
    [
        ("CAM_ISO", "6400", "it takes 100, 200"),
        ("CAM_BATTERY", "100%", "can't be changed"),
        ("CAM_X", "1", "no setting CAM_X"),
    ],
)
def test_a_setting_that_can_t_be_is_refused_in_words(name: str, value: str, words: str) -> None:
    one = Late()
    answer = one.at(0, do="set", name=name, value=value, sequence=1)
    assert (answer["ok"], words in answer["error"]) == (False, True), answer
    assert one.body.asked == []
