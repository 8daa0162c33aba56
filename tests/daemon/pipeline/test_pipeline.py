"""The pipeline with a camera that does what the test says: each shot ends once, and the record says how."""

from __future__ import annotations

import io
import tempfile
import time
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from PIL import Image

from dappled import codec, findings
from dappled.config.settings import DecodeSettings, MaskSettings, Settings
from dappled.daemon.health import record as health
from dappled.daemon.health.standing import in_record
from dappled.daemon.navigation import Telemetry
from dappled.daemon.pipeline import capture
from dappled.daemon.pipeline.picture_facts import PictureFacts
from dappled.daemon.stream import wire
from dappled.daemon.stream.publisher import PublisherStatistics
from dappled.drivers.camera import Blob, CameraError, CameraEvent, Companion, Deferred, Noticed
from dappled.drivers.raw.recipe import LawDecision, of_flight
from dappled.findings import FRAME, Code, Finding, Subject, finding, text, told
from dappled.flight import FlightError, Recording, ShotState, TimeSource, flight_report, layout
from dappled.flight.checks import flight_check
from tests.daemon.fakes import FakeCamera, Rig, arrival, failed, fired, good, rig
from tests.standing import words
from tests.waiting import eventually


def states(flight: Path) -> dict[int, ShotState]:
    return {line.row.shot.index: line.row.state for line in flight_report.show(flight).lines}


def test_a_shot_goes_all_the_way(tmp_path: Path) -> None:
    with rig(tmp_path) as one:
        assert one.request(1).index == 0
        pending = one.ended(0)
        assert pending.problem is None
        assert pending.frame is not None
        assert pending.tag is not None
        assert pending.decoded is not None
        assert (one.settled, one.tagged, one.camera.released) == ([(0, True)], [0], [0])
        assert one.flight.ledger.result(0) is not None
    assert one.camera.stopped
    assert flight_check.check(one.flight.folder.path).intact


class Watching:
    """A stream of which `row` is asked at each message that is published."""

    def __init__(self) -> None:
        self.row: Callable[[], object] = lambda: None
        self.seen: dict[str, object] = {}

    def publish(self, topic: str, *_: object) -> None:
        self.seen.setdefault(topic, self.row())


def test_slices_are_published_when_their_row_stands_in_the_ledger(tmp_path: Path) -> None:
    stream = Watching()
    with rig(tmp_path, publisher=stream) as one:  # type: ignore[arg-type]  # all that the pipeline asks of one
        stream.row = lambda: one.flight.ledger.result(0)
        one.request(1)
        one.ended(0)
    assert stream.seen["slices"] is not None


def test_a_driver_that_raises_fails_the_shot_and_the_next_works(tmp_path: Path) -> None:
    def script(shot: int) -> list[CameraEvent | Exception]:
        return [CameraError("no film")] if shot == 0 else good(shot)

    with rig(tmp_path, script) as one:
        assert one.request(1).outcome == "shot"
        assert "no film" in words(one.ended(0).problem)
        one.request(2)
        assert one.ended(1).frame is not None
        assert one.settled == [(0, False), (1, True)]
    assert states(one.flight.folder.path) == {0: "failed", 1: "safe"}


def test_a_driver_s_bug_in_next_event_does_not_end_the_capture(tmp_path: Path) -> None:
    with rig(tmp_path, lambda shot: [RuntimeError("bug"), *good(shot)]) as one:
        one.request(1)
        assert one.ended(0).frame is not None


def test_a_file_that_comes_twice_is_one_frame(tmp_path: Path) -> None:
    with rig(tmp_path, lambda shot: [*good(shot), arrival(shot)]) as one:
        one.request(1)
        one.ended(0)
        eventually(lambda: len(one.camera.released) == 2, "the second is released too")
        assert (len(one.shots), one.settled, one.tagged) == (1, [(0, True)], [0])
        assert any(line.startswith("double: ") for line in one.events())


def test_a_second_file_of_a_shot_is_a_stray_and_undoes_nothing(tmp_path: Path) -> None:
    with rig(tmp_path, lambda shot: [*good(shot), arrival(shot, b"other")]) as one:
        assert one.decoder is not None
        one.decoder.gate.clear()  # the first is still in the pipeline
        one.request(1)
        eventually(one.flight.ledger.strays, "the stray")
        one.decoder.gate.set()
        assert one.ended(0).problem is None
        assert one.settled == [(0, True)]
    assert flight_check.check(one.flight.folder.path).intact


def test_a_failure_after_the_file_undoes_nothing(tmp_path: Path) -> None:
    with rig(tmp_path, lambda shot: [*good(shot), failed(shot)]) as one:
        one.request(1)
        assert one.ended(0).problem is None
        eventually(lambda: one.camera.released, "released")
    assert (states(one.flight.folder.path), one.settled) == ({0: "safe"}, [(0, True)])


def test_a_file_after_the_failure_is_a_frame_after_all(tmp_path: Path) -> None:
    with rig(tmp_path) as one:
        one.camera.script = lambda shot: [fired(shot), failed(shot)]
        one.request(1)
        assert words(one.ended(0).problem) == "the mirror is stuck"
        one.camera.say(arrival(0))
        eventually(lambda: one.flight.ledger.result(0), "it is decoded too")
        assert one.settled == [(0, False), (0, True)]
        assert one.tagged == [0, 0]
        assert any(line.startswith("late: ") for line in one.events())
    assert len(one.shots) == 1
    assert states(one.flight.folder.path) == {0: "safe"}


def test_a_trigger_told_after_the_file_does_not_change_the_tag(tmp_path: Path) -> None:
    with rig(tmp_path, lambda shot: [arrival(shot), fired(shot)]) as one:
        one.request(1)
        pending = one.ended(0)
        assert pending.tag is not None
        assert pending.tag.utc_ns == pending.shot.wished_utc_ns + 60_000_000
        assert any(line.startswith("untimed: ") for line in one.events())


def test_a_file_of_nobody_is_a_stray(tmp_path: Path) -> None:
    with rig(tmp_path) as one:
        one.camera.say(arrival(None))
        one.camera.say(arrival(77))
        eventually(lambda: len(one.flight.ledger.strays()) == 2, "two strays")
    assert not one.shots
    assert flight_check.check(one.flight.folder.path).intact


def test_what_a_driver_notices_is_written_down(tmp_path: Path) -> None:
    on_card = finding(Code.PICTURE_ON_CARD, Subject("picture", "/DCIM/IMG_0004.CR2"))

    def script(shot: int) -> list[CameraEvent | Exception]:
        return [Noticed(finding(Code.CARD_CHANGED, Subject("card")), 1), *good(shot), Noticed(on_card, 2)]

    with rig(tmp_path, script) as one:
        one.request(1)
        one.ended(0)
        eventually(lambda: any(text.startswith("noticed: picture") for text in one.events()), "both")
        told = [text for text in one.events() if text.startswith("noticed: ")]
    assert told == [
        f"noticed: {findings.told(each)}" for each in (finding(Code.CARD_CHANGED, Subject("card")), on_card)
    ]


def test_an_empty_file_fails_the_shot(tmp_path: Path) -> None:
    with rig(tmp_path) as one:
        one.camera.script = lambda shot: [fired(shot)]
        one.request(1)
        empty = arrival(0, b"x")
        one.camera.say(type(empty)(0, empty.name, type(empty.blob)(empty.blob.fd, 0), empty.monotonic_ns))
        assert "empty" in words(one.ended(0).problem)
        assert one.settled == [(0, False)]


def test_a_shot_that_brings_nothing_fails_when_the_flight_ends(tmp_path: Path) -> None:
    with rig(tmp_path, lambda _: [], stop_s=0.1) as one:
        one.request(1)
    assert one.settled == [(0, False)]
    assert "the flight ended" in words(one.ended(0).problem)
    assert states(one.flight.folder.path) == {0: "failed"}


def test_a_file_that_comes_as_the_camera_is_let_go_of_is_taken_though_the_driver_raises(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(capture, "_LAST_EVENTS_NS", 20 * 10**9)

    class Late(FakeCamera):
        """Finishes its last file when it is stopped, with a bug on the way."""

        def stop(self) -> None:
            self._events.put(RuntimeError("bug"))
            self.say(arrival(0))

    with rig(tmp_path, camera=Late(lambda shot: [fired(shot)]), stop_s=0.1) as one:
        one.request(1)
    assert one.settled == [(0, True)]
    assert states(one.flight.folder.path) == {0: "safe"}


def test_a_watcher_that_raises_stops_nobody(tmp_path: Path) -> None:
    with rig(tmp_path) as one:
        shots = one.shots
        one.shots = None  # type: ignore[assignment]  # as a bug in a watcher would
        one.request(1)
        eventually(lambda: one.flight.ledger.result(0), "decoded all the same")
        one.shots = shots
        one.request(2)
        assert one.ended(1).problem is None


def test_a_full_decode_queue_leaves_frames_in_the_record(tmp_path: Path) -> None:
    with rig(tmp_path, queue_=1) as one:
        assert one.decoder is not None
        one.decoder.gate.clear()
        one.request(1)
        eventually(lambda: one.decoder and one.decoder.seen, "the first is being decoded")
        for number in (2, 3, 4):
            one.request(number)
        assert "the queue was full" in words(one.ended(3).problem)
        one.decoder.gate.set()
        assert one.ended(1).problem is None
    assert set(states(one.flight.folder.path).values()) == {"safe"}
    assert len(one.shots) == 4


def test_a_frame_that_does_not_decode_is_told_and_the_next_does(tmp_path: Path) -> None:
    with rig(tmp_path) as one:
        assert one.decoder is not None
        one.decoder.problem = "no carriers"
        one.request(1)
        assert words(one.ended(0).problem) == "not decoded: no carriers"
        one.decoder.problem = ""
        one.request(2)
        assert one.ended(1).problem is None
        assert "left: frame 0: not decoded: no carriers" in one.events()


def test_a_verdict_that_no_ledger_can_hold_costs_no_frame(tmp_path: Path) -> None:
    with rig(tmp_path) as one:
        assert one.decoder is not None
        share: Any = np.float32(0.9)  # JSON has no such number
        one.decoder.picture = PictureFacts(share, 0.0, 0.2, ((0.5, 1.0, 2.0),) * 2)
        one.request(1)
        assert one.ended(0).problem is None
        found = one.flight.ledger.result(0)
        assert found is not None
        assert found.verdict is not None
        assert found.verdict.state == "unknown"
        assert str(text(found.verdict.reasons[0])).startswith("not judged in flight: TypeError: ")


def test_frames_that_do_not_decode_are_counted_until_one_does(tmp_path: Path, caplog: pytest.LogCaptureFixture) -> None:
    with rig(tmp_path) as one:
        assert one.decoder is not None

        def failures() -> tuple[int, int, findings.Value]:
            now = one.pipeline.decode_failures
            (found,) = now.findings()
            why = found.facts["why"]
            return now.count, now.in_a_row, why.said if isinstance(why, findings.Fault) else why

        for index, problem in enumerate(["", "no carriers", "too dark", "", "no carriers"]):
            one.decoder.problem = problem
            one.request(index)
            one.ended(index)
            if index == 2:
                assert failures() == (2, 2, "too dark")
            if index == 3:
                assert failures() == (2, 0, "too dark")
        assert failures() == (3, 1, "no carriers")
    assert [line for line in caplog.messages if line.startswith("decode")] == [
        "decode of frame 1: no carriers", "decode of frame 2: too dark", "decode of frame 4: no carriers"
    ]  # fmt: skip


def test_frames_are_told_as_left_undecoded_where_that_was_switched_off(tmp_path: Path) -> None:
    with rig(tmp_path) as one:
        for number, decoding in enumerate((True, False, True)):
            one.pending.decoding = decoding
            one.request(number)
            pending = one.ended(number)
            assert ((pending.decoded is not None), pending.problem) == (decoding, None)
        assert [text for text in one.events() if text.startswith("left")] == [
            "left: not decoded: decoding was switched off"
        ]


def test_a_flight_that_decodes_nothing_tells_it_of_no_frame(tmp_path: Path) -> None:
    with rig(tmp_path, decode=False) as one:
        one.request(1)
        assert one.ended(0).problem is None
        assert not any(text.startswith("left") for text in one.events())


@pytest.mark.parametrize("method", ["fired", "add_tag", "add_result", "add_event", "safe"])
def test_a_ledger_that_refuses_once_costs_one_shot_at_most(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, method: str
) -> None:
    with rig(tmp_path) as one:
        with monkeypatch.context() as broken:

            def refuse(*_: object) -> None:
                raise RuntimeError("nobody foresaw this")

            broken.setattr(one.flight.ledger, method, refuse)
            one.request(1)
            one.ended(0)
        one.request(2)
        assert one.ended(1).problem is None
        assert one.ended(1).decoded is not None
    assert len(one.shots) == 2
    assert states(one.flight.folder.path)[1] == "safe"


PIECES = ("fired", "file", "other file", "failed", "stray", "foreign", "bug")


@st.composite
def scripts(draw: st.DrawFn) -> list[tuple[str, int]]:
    """For one shot: what is said, and how many shots later."""
    return draw(st.lists(st.tuples(st.sampled_from(PIECES), st.integers(0, 2)), max_size=5))


@given(st.lists(st.tuples(scripts(), st.booleans(), st.booleans()), min_size=1, max_size=5))
def test_a_request_is_one_shot_and_each_shot_ends_once(
    plan: list[tuple[list[tuple[str, int]], bool, bool]],
) -> None:
    """Events out of order, twice, late, missing, of nobody, exceptions: through pipeline, writer and shutter."""
    late: dict[int, list[tuple[str, int]]] = {}

    def event(piece: str, shot: int) -> CameraEvent | Exception:
        made: dict[str, Callable[[], CameraEvent | Exception]] = {
            "fired": lambda: fired(shot),
            "file": lambda: arrival(shot),
            "other file": lambda: arrival(shot, b"other", "IMG_9999.CR2"),
            "failed": lambda: failed(shot),
            "stray": lambda: arrival(None),
            "foreign": lambda: arrival(shot + 100),
            "bug": lambda: RuntimeError("a driver's bug"),
        }
        return made[piece]()

    def script(shot: int) -> list[CameraEvent | Exception]:
        words, raises, _ = plan[shot]
        for piece, delay in words:
            late.setdefault(shot + delay, []).append((piece, shot))
        said = [event(piece, whose) for piece, whose in late.pop(shot, [])]
        return [CameraError("it will not"), *said] if raises else said

    with tempfile.TemporaryDirectory() as folder:
        with rig(Path(folder), script, stop_s=0.05) as one:
            for number, (_, _, twice) in enumerate(plan):
                decision = one.request(number)
                assert (decision.outcome, decision.index) == ("shot", number)
                if twice:
                    assert (one.request(number).outcome, one.request(number).index) == ("duplicate", number)
        flight = one.flight.folder.path
        assert flight_check.check(flight).problems == ()
        balance = flight_report.balance(flight)
        assert balance.balanced
        assert (balance.wishes, balance.open) == (len(plan), 0)
        assert one.camera.fired == list(range(len(plan)))
        assert set(states(flight).values()) <= {"safe", "failed"}
        eventually(lambda: len(one.shots) == len(plan), "every shot has ended")
        assert sorted(pending.shot.index for pending in one.shots) == list(range(len(plan)))
        counted = one.shutter.statistics()
        assert (counted.shots, counted.pending) == (len(plan), 0)
        assert counted.succeeded + counted.failed == len(plan)
        for index, state in states(flight).items():
            assert [ok for shot, ok in one.settled if shot == index][-1] is (state == "safe")


def with_companion(shot: int) -> list[CameraEvent | Exception]:
    jpeg = Companion(shot, "IMG_0001.JPG", Blob.of(b"jpeg"), time.monotonic_ns())
    return [fired(shot), arrival(shot, name="IMG_0001.CR2"), jpeg]


def test_a_companion_stands_beside_its_frame_in_the_record(tmp_path: Path) -> None:
    with rig(tmp_path, with_companion) as one:
        index = one.request(1).index
        assert index is not None
        one.ended(index)
        eventually(lambda: one.camera.released == [index, index], "both copies at the camera may go")
        (companion,) = one.flight.ledger.companions()
        assert (companion.index, companion.name, companion.size) == (index, f"frames/{index:06d}.jpg", 4)
        assert (one.flight.folder.path / companion.name).read_bytes() == b"jpeg"
        assert one.flight.ledger.strays() == []
        path = one.flight.folder.path
    assert flight_check.check(path).problems == ()


def deferred(shot: int) -> list[CameraEvent | Exception]:
    return [fired(shot), Deferred(shot, "it is on the card", time.monotonic_ns())]


def test_a_shot_whose_file_follows_is_told_where_it_was_and_has_failed_until_then(tmp_path: Path) -> None:
    with rig(tmp_path, deferred) as one:
        index = one.request(1).index
        assert index is not None
        pending = one.ended(index)
        assert pending.where is not None
        assert one.tagged == [index]
        assert one.settled == [(index, False)]
        assert one.flight.ledger.following() == {index}
        assert pending.follows is not None
        assert f"follows: {told(pending.follows)}" in one.events()
        one.camera.say(arrival(index))
        eventually(lambda: one.flight.ledger.tag(index), "the tag of the file that came after all")
        assert one.flight.ledger.following() == set()
        assert one.flight.ledger.frame(index) is not None
        assert len(one.shots) == 1
        path = one.flight.folder.path
    assert flight_check.check(path).problems == ()


def test_a_zoom_that_changed_is_told(tmp_path: Path) -> None:
    frames = [jpeg_at(10.0), jpeg_at(10.0), jpeg_at(24.0)]

    def zooming(shot: int) -> list[CameraEvent | Exception]:
        return [fired(shot), arrival(shot, frames[shot], name=f"DSCF000{shot}.JPG")]

    with rig(tmp_path, zooming) as one:
        for number in range(3):
            index = one.request(number).index
            assert index is not None
            one.ended(index)
        told = [text for text in one.events() if text.startswith("zoom")]
    assert told == ["zoom: frame 2: the focal length is 24 mm; it was 10 mm at frame 1"]


RIVAL = finding(Code.FRAME_RIVAL_SHOTS, Subject("frame", 3), rival=2)


@pytest.mark.parametrize(("doubt", "by"), [(None, TimeSource.CAMERA_CLOCK), (RIVAL, TimeSource.REQUEST)])
def test_a_shot_in_doubt_teaches_no_time(tmp_path: Path, doubt: Finding | None, by: TimeSource) -> None:
    taken = time.strftime("%Y:%m:%d %H:%M:%S", time.gmtime())

    def script(shot: int) -> list[CameraEvent | Exception]:
        came = replace(
            arrival(shot, jpeg_at(10.0, taken), "A.JPG"), facts={"doubt": codec.plain(doubt)} if doubt else {}
        )
        return [fired(shot), came] if shot < 3 else [came]

    with rig(tmp_path, script) as one:
        for number in range(4):
            index = one.request(number).index
            assert index is not None
            last = one.ended(index)
    assert last.tag is not None
    assert last.tag.time_source == by


def jpeg_at(focal_length_mm: float, taken: str = "") -> bytes:
    exif = Image.Exif()
    exif.get_ifd(0x8769)[0x920A] = focal_length_mm
    if taken:
        exif.get_ifd(0x8769)[0x9003] = taken
    file = io.BytesIO()
    Image.new("L", (64, 48)).save(file, "JPEG", exif=exif)
    return file.getvalue()


DOUBT = finding(Code.CARRIERS_ELSEWHERE, FRAME)


def judged(one: Rig) -> list[str]:
    """The check of decoding, as a person sees it."""
    now = health.ServiceState(
        Settings(mask=MaskSettings("mask-1"), decode=DecodeSettings(calibration="c.toml")),
        health.ServiceTime(1, 1, 0),
        health.ShootingState(one.pending, one.shutter.statistics()),
        health.VehicleState((), Telemetry().statistics()),
        health.KeepingState(one.flight.folder.path, one.pipeline.statistics(), PublisherStatistics({}, {}, 0, 0, 0)),
        health.DecodingState(True, one.pipeline.decode_failures),
    )
    return [str(told(one)) for one in in_record(health.record(now)) if one.code.startswith(("decode.", "carriers."))]


def test_a_doubt_about_a_calibrated_flight_is_in_ledger_wire_and_go_no_go(tmp_path: Path) -> None:
    """As where the mask was moved after its calibration: the frames show its carriers elsewhere."""
    with rig(tmp_path) as one:
        assert one.decoder is not None
        one.decoder.doubts = (DOUBT,)
        one.request(1)
        pending = one.ended(0)
        row = one.flight.ledger.result(0)
        assert row is not None
        assert row.details["doubts"] == [codec.plain(DOUBT)]
        assert pending.tag is not None
        assert pending.decoded is not None
        assert wire.slices_header(pending.tag, pending.decoded)["doubts"] == [codec.plain(DOUBT)]
        assert any(str(text(DOUBT)) in words for words in judged(one))
        one.decoder.doubts = ()
        one.request(2)
        one.ended(1)
        assert not any(str(text(DOUBT)) in words for words in judged(one))


def test_a_law_that_a_full_disk_refuses_is_written_down_with_the_next_frame(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    decision = LawDecision("fd", (1.0, 0.0, 0.0, 1.0), 0, "decoded by the law fd from frame 0 on")
    with rig(tmp_path) as one:
        assert one.decoder is not None
        one.decoder.decision = decision
        add = Recording.add_facts
        refused: list[dict[str, Any]] = []

        def full(recording: Recording, facts: dict[str, Any]) -> None:
            if len(refused) < 2:
                refused.append(facts)
                raise FlightError("flight.toml can't be written: no space left on device")
            add(recording, facts)

        monkeypatch.setattr(Recording, "add_facts", full)
        for number in (1, 2, 3):
            one.request(number)
            one.ended(number - 1)
        assert [one.flight.ledger.result(index) is not None for index in (0, 1, 2)] == [False, False, True]
        events = one.events()
        assert sum(text.startswith("left: ") and "no space left" in text for text in events) == 2
        assert events.count(f"law: {decision.sentence}") == 1
        assert any("no space left" in words for words in judged(one))
    facts = layout.read_facts(one.flight.folder)
    made = of_flight(one.flight.folder.path, {**facts, "settings": {"mask": {"profile": "mask-2"}}}, {})
    assert made is not None
    assert made.decided == decision
    assert [line.row.state for line in flight_report.show(one.flight.folder.path).lines] == ["safe"] * 3
