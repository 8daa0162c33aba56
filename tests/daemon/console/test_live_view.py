"""When the console may look through the camera, and what it is told otherwise."""

from __future__ import annotations

import pytest

from dappled.clock import RecordedClock
from dappled.daemon.console.live_view import QUIET_S, CameraLook
from dappled.daemon.pipeline.repeats import CaptureRequest
from dappled.daemon.pipeline.shutter import Shutter
from dappled.drivers.camera import CameraError, LivePicture, PlainCamera
from tests.daemon.fakes import FakeSink


class Viewing(PlainCamera):
    """A camera with live view."""

    def __init__(self) -> None:
        super().__init__()
        self.looks: list[LivePicture | str | None] = []

    identity = None

    def start(self) -> None: ...

    def stop(self) -> None: ...

    def fire(self, shot: int) -> None: ...

    def look(self) -> LivePicture | None:
        now = self.looks.pop(0)
        if isinstance(now, str):
            raise CameraError(now)
        return now


class Blind(PlainCamera):
    """A camera without."""

    identity = None

    def start(self) -> None: ...

    def stop(self) -> None: ...

    def fire(self, shot: int) -> None: ...


@pytest.fixture
def clock() -> RecordedClock:
    return RecordedClock(10**12)


@pytest.fixture
def shutter(clock: RecordedClock) -> Shutter:
    return Shutter(FakeSink(), clock, next_index=0)


def test_pictures_come_before_the_flight_and_none_around_a_shot(shutter: Shutter, clock: RecordedClock) -> None:
    camera = Viewing()
    look = CameraLook(camera, shutter, clock)
    camera.looks = [None, LivePicture(b"jpeg", 1), "this body has no live view"]
    assert look.answer() == {"ok": True, "text": "waiting for the camera's picture"}
    assert look.answer() == {"ok": True, "picture": b"jpeg"}
    assert look.answer() == {"ok": False, "error": "this body has no live view"}
    decision = shutter.request(CaptureRequest("page", "console", 1))
    assert decision.index is not None
    assert "off while shooting" in look.answer()["error"]
    clock.advance(60.0)
    assert "off while shooting" in look.answer()["error"]  # it is still under way
    shutter.settled(decision.index, ok=True)
    clock.advance(QUIET_S - 0.1)
    assert "off while shooting" in look.answer()["error"]
    clock.advance(0.2)
    camera.looks = [None]
    assert look.answer()["ok"]


def test_a_camera_without_live_view_says_so(shutter: Shutter, clock: RecordedClock) -> None:
    assert CameraLook(Blind(), shutter, clock).answer() == {"ok": False, "error": "this camera has no live view"}
