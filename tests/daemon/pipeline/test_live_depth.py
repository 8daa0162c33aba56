"""Depth and pictures in flight: one frame now and then, and never in anybody's way."""

from __future__ import annotations

import gc
import json
import mmap
import threading
import weakref
from typing import Any, cast

import jsonschema
import numpy as np
import pytest

from dappled import codec
from dappled.clock import RecordedClock
from dappled.daemon.navigation import ExposureTime
from dappled.daemon.pipeline.capture import PendingShot, PendingShots
from dappled.daemon.pipeline.decode_process import (
    DecodedFrame,
    DecodeProcess,
    DecodeProcessError,
    FrameDepth,
    FramePicture,
)
from dappled.daemon.pipeline.flight_writer import FlightWriter
from dappled.daemon.pipeline.live_depth import LiveDepth
from dappled.daemon.pipeline.live_picture import LivePictures
from dappled.daemon.pipeline.tagging import tag
from dappled.daemon.stream import wire
from dappled.daemon.stream.publisher import Publisher
from dappled.drivers.raw.exposure_settings import ExposureSettings
from dappled.findings import FRAME, Code, finding
from dappled.flight import Cause, Frame, Shot, TimeSource
from tests.daemon.fakes import FakeCamera, no_pose
from tests.schemas import schema
from tests.waiting import eventually

DOUBT = finding(Code.FRAME_CLIPPED, FRAME, share=0.03)


class FakeMaker:
    """Finds the same depth in every frame, or fails."""

    def __init__(self) -> None:
        self.gate = threading.Event()
        self.gate.set()
        self.problem = ""
        self.nearest_m: tuple[float, float] | None = None
        self.asked: list[tuple[str, str]] = []
        self.closed = False

    def close(self) -> None:
        self.closed = True

    def picture(self, path: str, focal_length_mm: float | None, f_number: float | None) -> FramePicture:
        self.asked.append((path, "picture"))
        return FramePicture(b"jpeg", (2048, 1388), (0, 76), (1388, 2200), "frame", (DOUBT,))

    def depth(self, path: str, focal_length_mm: float | None, f_number: float | None, method: str) -> FrameDepth:
        self.asked.append((path, method))
        assert self.gate.wait(60)
        if self.problem:
            raise DecodeProcessError(self.problem)
        body = mmap.mmap(-1, 48)
        both = np.zeros((2, 2, 3), dtype=np.float32)
        body.write(both.tobytes())
        arrays = [wire.describe_array(name, both[0], "px") for name in ("disparity", "sigma")]
        grid = [[5.0, 0.0, 0.0], [0.0, 5.0, 0.0]]
        return FrameDepth(body, arrays, [-0.5, 0.5], grid, "geometric", self.nearest_m, (DOUBT,))


def shot(index: int, *, decoded: bool = True) -> PendingShot:
    frame = Frame(index, f"frames/{index}.dng", "IMG.DNG", 10, "0" * 64, 0)
    exposure = ExposureTime(0, 1, TimeSource.REQUEST)
    shown = ExposureSettings(focal_length_mm=50.0, f_number=8.0, exposure_s=0.01, iso=100.0)
    made = tag(frame, exposure, shown, camera="c", mask="m", pose=no_pose())
    result = None
    if decoded:
        grid = [[5.0, 0.0, 0.0], [0.0, 5.0, 0.0]]
        result = DecodedFrame(mmap.mmap(-1, 16), "0" * 64, [], [], "measured", 0, 0, "geometric", grid, b"", (0, 0))
    return PendingShot(Shot(index, Cause("t", "t"), 0, 0), frame=frame, tag=made, decoded=result)


class Bench:
    """Live depth with a clock that the test turns, and what it published."""

    def __init__(self, interval_s: float = 5.0) -> None:
        self.maker, self.clock = FakeMaker(), RecordedClock(0)
        self.published: list[tuple[str, dict[str, Any], Any]] = []
        self.nearest: list[tuple[float, float]] = []
        self.depth = LiveDepth(
            cast(DecodeProcess, self.maker),
            cast(FlightWriter, self),
            PendingShots(FakeCamera(), self.clock),
            cast(Publisher, self),
            method="contrast",
            interval_s=interval_s,
            nearest=self.send_distance,
        )

        self.viewers: set[str] = set()
        self.pictures = LivePictures(
            cast(DecodeProcess, self.maker),
            cast(FlightWriter, self),
            PendingShots(FakeCamera(), self.clock),
            cast(Publisher, self),
            interval_s=interval_s,
        )

    def wanted(self, topic: str) -> bool:
        return topic in self.viewers

    def send_distance(self, nearest_m: tuple[float, float]) -> None:
        self.nearest.append(nearest_m)

    def path(self, frame: Frame) -> str:
        return frame.name

    def publish(self, topic: str, facts: dict[str, Any], body: Any) -> None:
        self.published.append((topic, dict(facts), body))


@pytest.fixture
def bench() -> Any:
    one = Bench()
    one.depth.start()
    one.pictures.start()
    yield one
    one.maker.gate.set()
    one.depth.stop()
    one.pictures.stop()


def test_a_message_as_the_schema_says(bench: Bench) -> None:
    bench.depth.offer(shot(3))
    eventually(lambda: bench.published, "it is published")
    ((topic, facts, body),) = bench.published
    assert topic == "depth"
    envelope = {"schema": "dappled/depth", "version": 1, "flight": "f", "seq": 0, "dropped": 0}
    header = {**envelope, **facts}
    jsonschema.validate(header, schema("depth"))
    arrays = wire.Message("depth", header, body).arrays()
    assert [arrays[name].shape for name in ("disparity", "sigma")] == [(2, 3), (2, 3)]
    assert header["doubts"] == [codec.plain(DOUBT)]
    assert bench.maker.asked == [("frames/3.dng", "contrast")]


def test_not_more_often_than_asked_for(bench: Bench) -> None:
    for index in range(5):
        bench.depth.offer(shot(index))
    eventually(lambda: len(bench.published) == 1, "the first")
    bench.clock.advance(5)
    bench.depth.offer(shot(9))
    eventually(lambda: len(bench.published) == 2, "the next that is due")
    assert [path for path, _ in bench.maker.asked] == ["frames/0.dng", "frames/9.dng"]


def test_a_slow_one_loses_the_older_frame(bench: Bench) -> None:
    bench.maker.gate.clear()
    for index in range(4):
        bench.clock.advance(10)
        bench.depth.offer(shot(index))
        eventually(lambda: bench.maker.asked, "the first is in hand")
    bench.maker.gate.set()
    eventually(lambda: len(bench.published) == 2, "the first and the newest")
    assert [path for path, _ in bench.maker.asked] == ["frames/0.dng", "frames/3.dng"]
    assert bench.depth._worker.statistics().dropped == 2


def test_what_was_not_decoded_has_no_depth_and_a_failure_is_counted(bench: Bench) -> None:
    bench.depth.offer(shot(0, decoded=False))
    bench.maker.problem = "no carriers"
    bench.depth.offer(shot(1))
    eventually(lambda: bench.depth._worker.statistics().failed == 1, "it failed")
    assert [path for path, _ in bench.maker.asked] == ["frames/1.dng"]
    assert bench.published == []


def test_the_nearest_distance_is_told_where_it_is_known(bench: Bench) -> None:
    bench.depth.offer(shot(0))
    eventually(lambda: len(bench.published) == 1, "without metres")
    bench.maker.nearest_m = (7.5, 0.2)
    bench.clock.advance(10)
    bench.depth.offer(shot(1))
    eventually(lambda: bench.nearest, "it is told")
    assert bench.nearest == [(7.5, 0.2)]


def test_who_begins_to_look_at_pictures_gets_that_of_the_newest_frame_without_a_further_one(bench: Bench) -> None:
    for index in (3, 4):
        bench.pictures.offer(shot(index))
        bench.pictures.look()
    bench.viewers.add("picture")
    bench.pictures.look()
    bench.pictures.offer(shot(5))  # too soon
    bench.clock.advance(10)
    bench.pictures.look()
    eventually(lambda: bench.published, "it is published")
    bench.pictures.stop()
    assert [facts["frame"] for _, facts, _ in bench.published] == [4], "once"


def test_slices_are_not_kept_for_a_picture_that_nobody_has_asked_for(bench: Bench) -> None:
    one = shot(3)
    assert one.decoded is not None
    slices = weakref.ref(one.decoded.body)
    bench.pictures.offer(one)
    del one
    gc.collect()
    assert slices() is None
    bench.viewers.add("picture")
    bench.pictures.look()
    eventually(lambda: bench.published, "the frame was kept all the same")


def test_a_picture_is_made_only_while_somebody_has_subscribed_to_it_and_as_the_schema_says(bench: Bench) -> None:
    bench.pictures.offer(shot(3))
    bench.viewers.add("picture")
    bench.pictures.offer(shot(4))
    bench.pictures.offer(shot(5))  # too soon
    eventually(lambda: bench.published, "it is published")
    ((topic, facts, body),) = bench.published
    assert (topic, body) == ("picture", b"jpeg")
    header = {"schema": "dappled/picture", "version": 1, "flight": "f", "seq": 0, "dropped": 0, **facts}
    jsonschema.validate(json.loads(wire.encode(header)), schema("picture"))
    assert (header["frame"], header["width"], header["height"]) == (4, 2048, 1388)
    assert header["doubts"] == [codec.plain(DOUBT)]
    assert bench.maker.asked == [("frames/4.dng", "picture")]
    bench.viewers.clear()
    bench.clock.advance(10)
    bench.pictures.offer(shot(6))
    bench.viewers.add("picture")
    bench.pictures.offer(shot(7))
    eventually(lambda: len(bench.published) == 2, "the next one")
    assert [path for path, _ in bench.maker.asked] == ["frames/4.dng", "frames/7.dng"]
