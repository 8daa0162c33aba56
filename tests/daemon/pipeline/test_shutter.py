"""The shutter: one shot for every capture request, and the written rules of what one request is."""

from __future__ import annotations

import random
import threading
import time
from collections.abc import Callable

import pytest
from hypothesis import given
from hypothesis import strategies as st

from dappled.clock import RecordedClock, SystemClock
from dappled.daemon.pipeline import shutter as module
from dappled.daemon.pipeline.repeats import CaptureRequest
from dappled.daemon.pipeline.shutter import ShotDecision, Shutter
from dappled.findings import Code, Subject, finding
from dappled.flight import Shot
from dappled.flight.logs import DURABLE_S
from dappled.refusals import PEERS, SHOTS_INTERVAL_S
from tests.daemon.fakes import NO_CAMERA, FakeSink
from tests.waiting import eventually

PILOT = "mavlink:255/190"
VEHICLE = "mavlink:1/1"


class Rig:
    """A shutter with a clock that stands still, and a list of what it did, in order."""

    def __init__(self, capacity: int = 1000) -> None:
        self.clock = RecordedClock(10**18, 10**18 - 10**9)
        self.sink = FakeSink()
        self.shutter = Shutter(self.sink, self.clock, next_index=42, capacity=capacity)

    @property
    def done(self) -> list[tuple[str, int]]:
        return self.sink.done

    def fired(self) -> list[int]:
        return self.sink.fired

    def press(self, after_s: float = 0.0, *, sequence: int = 0, confirmation: int = 0, link: int = 0) -> str:
        self.clock.advance(after_s)
        return self.shutter.request(CaptureRequest(PILOT, "IMAGE_START_CAPTURE", sequence, confirmation, link)).outcome

    def tick(self, seconds: float, step_s: float = 0.05) -> None:
        for _ in range(round(seconds / step_s)):
            self.clock.advance(step_s)
            self.shutter.serve()


def test_a_wish_is_written_down_before_the_camera_is_touched() -> None:
    rig = Rig()
    decision = rig.shutter.request(CaptureRequest("console", "button"))
    assert (decision.outcome, decision.index) == ("shot", 42)
    assert rig.done == [("note", 42), ("fire", 42)]


@pytest.mark.parametrize(
    "ask",
    [
        lambda shutter, request: shutter.request(request),
        lambda shutter, request: shutter.start_interval(request, 5.0, 2),
    ],
    ids=["single", "interval"],
)
def test_a_wish_that_comes_while_another_is_written_down_waits_for_it(
    ask: Callable[[Shutter, CaptureRequest], ShotDecision], monkeypatch: pytest.MonkeyPatch
) -> None:
    """Both would have the same index otherwise."""
    rig = Rig()
    decided: list[ShotDecision] = []
    others: list[threading.Thread] = []
    written = rig.sink.note

    def note(shot: Shot) -> None:
        if not others:
            call = threading.Thread(target=lambda: decided.append(ask(rig.shutter, CaptureRequest("b", "button", 2))))
            others.append(call)
            call.start()
            call.join(0.2)  # as long as it may want to overtake
        written(shot)

    monkeypatch.setattr(rig.sink, "note", note)
    first = ask(rig.shutter, CaptureRequest("a", "button", 1))
    others[0].join(60)
    assert [first.index, *(one.index for one in decided)] == [42, 43]
    assert rig.done == [("note", 42), ("fire", 42), ("note", 43), ("fire", 43)]


def test_retries_every_half_second_are_one_shot() -> None:
    rig = Rig()
    assert [rig.press(gap) for gap in (0, 0.5, 0.5, 0.5)] == ["shot", "duplicate", "duplicate", "duplicate"]


def test_a_numbered_confirmation_is_a_retry_for_ten_seconds_and_a_lost_first_one_a_shot() -> None:
    rig = Rig()
    assert [rig.press(0), rig.press(3, confirmation=1), rig.press(3, confirmation=2)] == ["shot"] + ["duplicate"] * 2
    assert rig.press(11, confirmation=1) == "shot"


def test_other_sequences_and_later_presses_are_shots_of_their_own() -> None:
    rig = Rig()
    assert [rig.press(0, sequence=1), rig.press(0.4, sequence=2), rig.press(1.3, sequence=2)] == ["shot"] * 3


def test_a_sender_that_presses_every_second_with_sequence_0_is_not_silenced_for_ever() -> None:
    rig = Rig()
    assert [rig.press(1.0) for _ in range(6)].count("shot") == 2


@given(
    st.lists(st.floats(0.35, 5.0), min_size=1, max_size=12),
    st.integers(1, 2),
    st.randoms(use_true_random=False),
    st.sets(st.sampled_from(["CAMERA_TRIGGER", "IMAGE_START_CAPTURE", "DO_DIGICAM_CONTROL"]), min_size=1),
)
def test_px4s_triple_on_several_links_is_one_shot_a_trigger(
    gaps: list[float], links: int, order: random.Random, kinds: set[str]
) -> None:
    """Every trigger comes as up to three messages over up to two links, in any order, within 50 ms."""
    rig = Rig()
    for trigger, gap in enumerate(gaps):
        rig.clock.advance(gap)
        messages = [(kind, link) for kind in sorted(kinds) for link in range(links)]
        order.shuffle(messages)
        for kind, link in messages:
            sequence = None if kind == "DO_DIGICAM_CONTROL" else trigger + 1
            rig.shutter.request(
                CaptureRequest(VEHICLE, kind, sequence, 0, link, acknowledged=kind == "IMAGE_START_CAPTURE")
            )
            rig.clock.advance(0.05 / len(messages))
    assert rig.fired() == list(range(42, 42 + len(gaps)))


@given(st.lists(st.floats(0.31, 3.0), min_size=1, max_size=10))
def test_broadcast_203_without_a_number_is_a_shot_each_time(gaps: list[float]) -> None:
    """ArduPilot's way: nobody answers it, so nobody repeats it."""
    rig = Rig()
    for gap in gaps:
        rig.clock.advance(gap)
        rig.shutter.request(CaptureRequest(VEHICLE, "DO_DIGICAM_CONTROL", None, 0, 0, acknowledged=False))
    assert len(rig.fired()) == len(gaps)


@given(
    st.lists(
        st.tuples(
            st.floats(0, 2),
            st.sampled_from([PILOT, VEHICLE]),
            st.sampled_from("AB"),
            st.integers(0, 2),
            st.integers(0, 1),
        ),
        max_size=40,
    )
)
def test_the_counts_add_up_and_no_index_is_used_twice(messages: list[tuple[float, str, str, int, int]]) -> None:
    rig = Rig(capacity=5)
    outcomes: list[str] = []
    for gap, source, kind, sequence, link in messages:
        rig.clock.advance(gap)
        decision = rig.shutter.request(CaptureRequest(source, kind, sequence, 0, link))
        assert decision.accepted == (decision.index is not None)
        outcomes.append(decision.outcome)
        if decision.outcome == "shot" and (decision.index or 0) % 2:
            rig.shutter.settled(decision.index or 0, ok=decision.index != 43)
    now = rig.shutter.statistics()
    assert rig.done == [(act, index) for index in rig.fired() for act in ("note", "fire")]
    assert rig.fired() == list(range(42, now.next_index))
    assert now.shots == outcomes.count("shot")
    assert sum(one.number("times") for one in rig.sink.refusals) <= now.refused <= outcomes.count("refused")
    assert now.shots == now.pending + now.succeeded + now.failed
    assert now.pending <= 5


def test_refusals_say_why_and_use_no_index() -> None:
    rig = Rig(capacity=1)
    rig.sink.problem = NO_CAMERA
    assert rig.shutter.request(CaptureRequest(PILOT, "x", 1)).reason == NO_CAMERA
    rig.sink.problem, rig.sink.note_error = None, OSError(28, "No space left on device")
    assert "No space left" in rig.shutter.request(CaptureRequest(PILOT, "x", 2)).words
    rig.sink.note_error = None
    assert rig.shutter.request(CaptureRequest(PILOT, "x", 3)).index == 42
    assert rig.shutter.request(CaptureRequest(PILOT, "x", 4)).words == "no photo: 1 shot waiting for the camera already"
    rig.shutter.settled(42, ok=True)
    rig.shutter.settled(42, ok=False)
    assert rig.shutter.request(CaptureRequest(PILOT, "x", 5)).index == 43
    rig.shutter.stop()
    assert rig.shutter.request(CaptureRequest(PILOT, "x", 6)).words == "no photo: the daemon is stopping"


@pytest.mark.parametrize("kinds", [("IMAGE_START_CAPTURE",), ("CAMERA_TRIGGER", "IMAGE_START_CAPTURE", "DO_DIGICAM")])
def test_a_request_that_several_messages_bring_over_two_links_is_refused_once(kinds: tuple[str, ...]) -> None:
    """Each port has its own count of packets, so these are no copies of one packet; the report counted each."""
    rig = Rig()
    rig.sink.problem = NO_CAMERA
    for trigger in range(41):
        rig.clock.advance(0.5)
        for link in (0, 1):
            rig.clock.advance(0.02)
            for kind in kinds:
                number = None if kind == "DO_DIGICAM" else trigger + 1
                request = CaptureRequest(VEHICLE, kind, number, 0, link, acknowledged=False)
                assert rig.shutter.request(request).reason == NO_CAMERA
    rig.shutter.settle_refusals(all_of_them=True)
    assert rig.shutter.statistics().refused == sum(one.number("times") for one in rig.sink.refusals) == 41
    rig.sink.problem = None
    exposed = CaptureRequest(VEHICLE, "CAMERA_FEEDBACK", 41, 0, 0, acknowledged=False, happened=True)
    assert rig.shutter.request(exposed).outcome == "shot"
    retry = CaptureRequest(VEHICLE, kinds[0], 41, 1, 0)
    assert rig.shutter.request(retry).accepted


def test_an_exposure_after_a_broadcast_that_was_refused_is_a_shot() -> None:
    """The camera can't be fired here; the autopilot heard the broadcast, and fired it by wire."""
    rig = Rig()
    rig.sink.problem = NO_CAMERA
    asked = CaptureRequest(PILOT, "IMAGE_START_CAPTURE", 0, 0, 0, broadcast=True)
    assert not rig.shutter.request(asked).accepted
    rig.clock.advance(0.1)
    exposed = CaptureRequest(VEHICLE, "CAMERA_FEEDBACK", 1, 0, 0, acknowledged=False, autopilot=True, happened=True)
    assert rig.shutter.request(exposed).outcome == "shot"


def test_an_interval_counts_to_its_end_and_a_single_shot_does_not_cancel_it() -> None:
    rig = Rig()
    request = CaptureRequest(PILOT, "IMAGE_START_CAPTURE", 7)
    assert rig.shutter.start_interval(request, 1.0, 3).index == 42
    assert rig.shutter.start_interval(request, 1.0, 3).outcome == "duplicate"
    rig.tick(0.5)
    assert rig.press(sequence=8) == "shot"
    assert rig.shutter.statistics().interval_s == 1.0
    rig.tick(5)
    assert rig.fired() == [42, 43, 44, 45]
    assert rig.shutter.statistics().interval_s is None


def test_an_endless_interval_ends_when_told_and_late_ticks_are_not_bunched() -> None:
    rig = Rig()
    rig.shutter.start_interval(CaptureRequest(PILOT, "IMAGE_START_CAPTURE", 1), 0.5, 0)
    rig.tick(2.0)
    assert len(rig.fired()) == 5
    rig.clock.advance(10)
    rig.shutter.serve()
    rig.shutter.serve()
    assert len(rig.fired()) == 6
    assert rig.shutter.stop_interval() == "stopped"
    assert rig.shutter.stop_interval() == "none ran"
    rig.tick(3)
    assert len(rig.fired()) == 6


def start(rig: Rig, interval_s: float, count: int = 0, *, source: str = PILOT, link: int = 0) -> str:
    """An interval as ground stations start it, who number everything 0."""
    return rig.shutter.start_interval(
        CaptureRequest(source, "IMAGE_START_CAPTURE", 0, link=link), interval_s, count
    ).outcome


@pytest.mark.parametrize("link", [0, 1])
@pytest.mark.parametrize("gap_s", [0.1, 0.6])
def test_an_interval_right_after_a_press_runs_and_a_press_right_after_its_start_is_a_shot(
    gap_s: float, link: int
) -> None:
    rig = Rig()
    assert rig.press() == "shot"
    rig.clock.advance(gap_s)
    assert start(rig, 2.0, link=link) == "shot"
    assert rig.press(gap_s, sequence=3, link=1 - link) == "shot"
    rig.tick(5)
    assert rig.shutter.statistics().interval_s == 2.0
    assert len(rig.fired()) == 5


def test_an_interval_that_was_stopped_starts_again_at_once_unless_another_stopped_it() -> None:
    rig = Rig()
    for again in ("shot", "shot"):
        assert start(rig, 2.0) == again
        rig.clock.advance(0.3)
        assert rig.shutter.stop_interval(PILOT) == "stopped"
    assert start(rig, 2.0) == "shot"
    assert rig.shutter.stop_interval(VEHICLE) == "stopped"
    assert start(rig, 2.0) == "duplicate"  # a retry that was under way must not undo the stop
    assert rig.shutter.statistics().interval_s is None


def test_a_second_interval_takes_the_place_of_the_first_however_soon_and_the_first_that_of_the_second() -> None:
    rig = Rig()
    for interval_s, count in ((2.0, 0), (5.0, 0), (2.0, 0), (2.0, 7)):
        assert start(rig, interval_s, count) == "shot"
        assert start(rig, interval_s, count) == "duplicate"
        assert rig.shutter.statistics().interval_s == interval_s
        rig.clock.advance(0.2)


def test_a_burst_takes_the_next_shot_when_the_last_one_is_settled() -> None:
    rig = Rig()
    rig.shutter.start_interval(CaptureRequest(PILOT, "IMAGE_START_CAPTURE", 1), 0.0, 3)
    rig.tick(2)
    assert rig.fired() == [42]
    for index in (42, 43, 44):
        rig.shutter.settled(index, ok=True)
        rig.tick(0.2)
    assert rig.fired() == [42, 43, 44]


def test_a_burst_before_a_camera_that_is_gone_asks_once_a_second() -> None:
    rig = Rig()
    rig.shutter.start_interval(CaptureRequest(PILOT, "IMAGE_START_CAPTURE", 1), 0.0, 0)
    rig.shutter.settled(42, ok=True)
    rig.sink.problem = NO_CAMERA
    for _ in range(100):
        rig.tick(0.05)
    assert 4 <= rig.shutter.statistics().refused <= 6  # each is an event of the record
    rig.sink.problem = None
    rig.tick(1.0)
    assert rig.fired() == [42, 43]


@pytest.mark.parametrize(("interval_s", "count"), [(-1.0, 0), (float("nan"), 0), (1e9, 0), (1.0, -2)])
def test_a_senseless_interval_is_refused(interval_s: float, count: int) -> None:
    rig = Rig()
    assert rig.shutter.start_interval(CaptureRequest(PILOT, "x"), interval_s, count).outcome == "refused"
    assert not rig.fired()


def test_the_thread_serves_intervals_on_the_real_clock() -> None:
    sink = FakeSink()
    shutter = Shutter(sink, SystemClock(), next_index=0)
    shutter.start()
    try:
        began = time.monotonic()
        shutter.start_interval(CaptureRequest(PILOT, "x"), 0.1, 3)
        eventually(lambda: len(sink.fired) == 3, "three shots")
        assert time.monotonic() - began > 0.19
    finally:
        shutter.stop()
    assert sink.fired == [0, 1, 2]


def test_an_interval_outlives_whoever_notes_going_wrong(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(module, "_AGAIN_S", 0.01)

    class Forgetful(FakeSink):
        def note(self, shot: Shot) -> None:
            super().note(shot)
            if sum(act == "note" for act, _ in self.done) == 2:
                raise RuntimeError("nobody foresaw this")

    sink = Forgetful()
    shutter = Shutter(sink, SystemClock(), next_index=0)
    shutter.start()
    try:
        shutter.start_interval(CaptureRequest(PILOT, "x"), 0.1, 3)
        eventually(lambda: len(sink.fired) == 3, "three shots")
        assert shutter.dead_threads() == []
    finally:
        shutter.stop()
    assert [index for act, index in sink.done if act == "note"] == [0, 1, 1, 2]
    assert sink.fired == [0, 1, 2]


def test_every_refusal_is_told() -> None:
    sink = FakeSink()
    shutter = Shutter(sink, RecordedClock(10**18), next_index=0, capacity=1)
    shutter.start_interval(CaptureRequest(PILOT, "IMAGE_START_CAPTURE", 1), -1.0, 0)
    for sequence in (2, 3):
        shutter.request(CaptureRequest(PILOT, "IMAGE_START_CAPTURE", sequence))
    assert len(sink.refusals) == shutter.statistics().refused == 2
    assert [one.code for one in sink.refusals] == [Code.SHOT_INTERVAL_BOUNDS, Code.CAMERA_SHOTS_WAITING]


def test_a_flood_of_refused_requests_is_one_line_in_the_log(caplog: pytest.LogCaptureFixture) -> None:
    rig = Rig()
    rig.sink.problem = NO_CAMERA
    for sequence in range(516):
        assert not rig.shutter.request(CaptureRequest(PILOT, "x", sequence)).accepted
    assert len(caplog.messages) == 1
    assert "none is on the bus" in caplog.messages[0]


def test_a_flood_of_refused_requests_is_a_few_events_that_count_each_one() -> None:
    rig = Rig()
    for sequence in range(5000):
        rig.sink.problem = finding(Code.DISK_FULL, Subject("disk"), left_kb=sequence)  # its number defeats no limit
        rig.shutter.request(CaptureRequest(PILOT, "x", sequence))
        rig.clock.advance(0.03)
    rig.shutter.settle_refusals(all_of_them=True)
    assert len(rig.sink.refusals) <= 2 + 150 / SHOTS_INTERVAL_S  # the first, each interval of 150 s, the rest
    assert sum(one.number("times") for one in rig.sink.refusals) == rig.shutter.statistics().refused == 5000


def test_what_was_only_counted_is_written_as_soon_as_the_report_says(monkeypatch: pytest.MonkeyPatch) -> None:
    """A power cut takes it: with no other request after it, it was written up to ten seconds later."""
    rig = Rig()
    rig.sink.problem = NO_CAMERA
    counted_ns: list[int] = []
    written_ns: list[int] = []

    def wait(event: threading.Event, timeout_s: float) -> bool:
        if written_ns:
            return event.wait(60)
        if not counted_ns:
            rig.clock.advance(0.1)
            assert [rig.press(sequence=sequence) for sequence in (1, 2)] == ["refused"] * 2
            counted_ns.append(rig.clock.utc_ns())
            timeout_s -= 0.1
        elif len(rig.sink.refusals) == 2:
            written_ns.append(rig.clock.utc_ns())
        rig.clock.advance(timeout_s)
        return False

    monkeypatch.setattr(rig.clock, "wait", wait)
    rig.shutter.start()
    eventually(lambda: written_ns, "what was counted is written")
    rig.shutter.stop()
    assert (written_ns[0] - counted_ns[0]) / 1e9 < SHOTS_INTERVAL_S + DURABLE_S


def test_a_flood_from_any_number_of_senders_is_a_few_events_too() -> None:
    rig = Rig()
    rig.sink.problem = NO_CAMERA
    for sender in range(5000):
        rig.shutter.request(CaptureRequest(f"mavlink:{sender}/1", "x", 1))
    rig.shutter.settle_refusals(all_of_them=True)
    assert len(rig.sink.refusals) == PEERS + 2
    assert sum(one.number("times") for one in rig.sink.refusals) == 5000
