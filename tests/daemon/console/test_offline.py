"""The console's page over a recording: what it is told, and pictures of frames that nobody published."""

from __future__ import annotations

import asyncio
import io
import json
import threading
from collections.abc import Mapping, Sequence
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import httpx
import numpy as np
import pytest
from PIL import Image

from dappled import codec
from dappled.clock import RecordedClock
from dappled.daemon.console.access import Access
from dappled.daemon.console.app import ConsoleApp
from dappled.daemon.console.feed import FeedError
from dappled.daemon.console.offline import RecordedFeed, RecordedHub, RecordedStudio
from dappled.daemon.console.recorded import FlightFrames, FrameSource, LightFieldFrames, ShownFrame
from dappled.daemon.stream.wire import Message
from dappled.decode.geometry import camera_pose
from dappled.decode.lightfield import LightField
from dappled.decode.picture.picture import UnmaskedPicture
from dappled.drivers.raw.picture_maker import MadePicture, PictureMaker, ToldShadow
from dappled.errors import DappledError
from dappled.findings import FRAME, Code, Finding, finding, text
from dappled.flight import Result, flight_report, layout, recording
from tests.flight.makers import deliver, request, tag

MOUNT = camera_pose.NADIR.ravel().tolist()
START_NS = 1_795_256_103_000_000_000


def light_field(*, slices: bool = True, views: bool = True) -> LightField:
    rng = np.random.default_rng(1)
    pictures = rng.random((3, 3, 24, 32)).astype(np.float32)
    steps = np.linspace(-1 / 3, 1 / 3, 3)
    offsets = np.stack(np.meshgrid(steps, steps, indexing="ij"), axis=-1)
    count = 5 if slices else 0
    orders = np.array([[0, 0], [0, 1], [1, -1], [1, 0], [1, 1]], dtype=np.float64)[:count]
    carriers = np.concatenate([orders, orders * 0.1], axis=1)
    stack = (rng.random((count, 24, 32)) + 1j * rng.random((count, 24, 32))).astype(np.complex64)
    grid = np.array([[5.0, 0.0, 0.0], [0.0, 5.0, 0.0]])
    facts = {"shape": [120, 160], "camera": "c", "mask": "m", "f_number": 8.0, "focal_length_mm": 50.0}
    if not views:
        pictures, offsets = np.zeros((0, 0, 24, 32), np.float32), np.zeros((0, 0, 2))
    return LightField(stack, carriers, pictures, offsets, grid, facts)


class Served:
    """The application over a source, asked without a network."""

    def __init__(self, source: FrameSource) -> None:
        studio = RecordedStudio(source, None, MOUNT)
        self.hub = RecordedHub(source.shots)
        self.feed = RecordedFeed(source, self.hub, studio)
        self._app = ConsoleApp(self.feed, studio, Nobody(), Access(""), None)

    async def get(self, path: str) -> httpx.Response:
        transport = httpx.ASGITransport(app=self._app.asgi())
        async with httpx.AsyncClient(transport=transport, base_url="http://127.0.0.1") as client:
            return await client.get(path)

    def asked(self, *paths: str) -> list[httpx.Response]:
        async def ask() -> list[httpx.Response]:
            return [await self.get(path) for path in paths]

        try:
            return asyncio.run(ask())
        finally:
            self._app.close()
            self.feed.close()


class Nobody:
    """No daemon."""

    def ask(self, _question: Mapping[str, Any]) -> dict[str, Any]:
        return {"ok": False, "error": "nobody"}


def test_a_light_field_s_own_views_are_shown() -> None:
    field = light_field()
    layout, views, slices, spectrum, missing = Served(LightFieldFrames("a.npz", 9, field)).asked(
        *(f"/api/frames/0/{name}" for name in ("views.json", "views.jpg", "slices.jpg", "spectrum.jpg")),
        "/api/frames/1/mean.jpg",
    )
    assert layout.json()["source"] == "the file"
    assert len(layout.json()["row_steps"]) == 3
    assert {one.headers["content-type"] for one in (views, slices, spectrum)} == {"image/jpeg"}
    assert missing.status_code == 404


def test_a_light_field_of_views_alone_and_one_of_slices_alone() -> None:
    mean, layout = Served(LightFieldFrames("folder", 9, light_field(slices=False))).asked(
        "/api/frames/0/mean.jpg", "/api/frames/0/views.json"
    )
    assert (mean.status_code, layout.status_code) == (200, 200)
    mean, layout = Served(LightFieldFrames("a.npz", 9, light_field(views=False))).asked(
        "/api/frames/0/mean.jpg", "/api/frames/0/views.json"
    )
    assert mean.status_code == 200
    assert (layout.status_code, layout.json()["error"]) == (
        422,
        "this light field has no views, only slices: decode it with a calibration",
    )


class SlowViews(LightFieldFrames):
    """Its views take as long as somebody holds them."""

    def __init__(self) -> None:
        super().__init__("a.npz", 9, light_field())
        self.begun, self.gate = threading.Event(), threading.Event()

    def light_field(self, _index: int) -> LightField | None:
        self.begun.set()
        assert self.gate.wait(60)
        return super().light_field(_index)


def test_what_can_be_shown_at_once_does_not_wait_for_the_views() -> None:
    source = SlowViews()
    served = Served(source)

    async def look() -> list[int]:
        views = asyncio.create_task(served.get("/api/frames/0/views.json"))
        await asyncio.to_thread(source.begun.wait, 60)
        quick = [await asyncio.wait_for(served.get(f"/api/frames/0/{one}.jpg"), 30) for one in ("mean", "thumb")]
        assert not views.done()
        source.gate.set()
        return [one.status_code for one in (*quick, await views)]

    try:
        assert asyncio.run(look()) == [200, 200, 200]
    finally:
        source.gate.set()
        served.asked()


def test_a_new_page_is_told_everything_and_then_that_the_flight_has_ended() -> None:
    served = Served(LightFieldFrames("a.npz", 9, light_field()))

    async def told() -> list[dict[str, Any]]:
        feed = served.feed
        pages = served.hub.listen([feed.state(), *(feed.frame_event(n) for n in feed.frames)])
        served.hub.close()
        return [json.loads(text.removeprefix("data: ")) async for text in pages if text.startswith("data: ")]

    events = asyncio.run(told())
    assert [event["is"] for event in events] == ["state", "frame", "end"]
    assert events[0]["health"] is None
    assert events[-1]["shots"] == {"wished": 1, "safe": 1}


BLACK = finding(Code.FRAME_BLACK, FRAME, share=0.4)


class FakeDecoder:
    """Decodes frame 0, and refuses frame 1."""

    def decode(self, path: str, focal_length_mm: float | None, f_number: float | None, *, index: int) -> Any:
        if index:
            raise DappledError(f"{path} is damaged")
        return FakeDecoded()


class FakeDecoded:
    law, carriers, carriers_from, carriers_found = "law", [[0, 0, 0.0, 0.0]], "calibrated", 24
    carriers_predicted, sha256, grid = 24, "00", [[5.0, 0.0, 0.0], [0.0, 5.0, 0.0]]
    seen: Mapping[str, Any] = {"frame_shape": [120, 160], "mosaic": False, "noise_rms": None}
    doubts: tuple[Finding, ...] = ()
    body = np.full((1, 24, 32), 0.5, dtype="<c8").tobytes()
    arrays = ({"name": "slices", "dtype": "<c8", "shape": [1, 24, 32], "unit": "1"},)


@pytest.fixture
def flight(tmp_path: Path) -> Path:
    begun = recording.begin(tmp_path, RecordedClock(START_NS))
    for index in (0, 1, 2):
        request(begun, index)
        frame = deliver(begun, index, b"raw", f"IMG_{index}.CR2")
        if index < 2:
            begun.ledger.add_tag(tag(frame))
    verdict = {"verdict": {"state": "usable", "reasons": [codec.plain(BLACK)]}}
    begun.ledger.add_result(Result(1, "00", 24, 24, "law", "calibrated", details=verdict))
    begun.close()
    return begun.folder.path


def test_a_flight_s_frames_are_its_tags_and_verdicts_and_slices_are_decoded_when_asked_for(flight: Path) -> None:
    contents = flight_report.show(flight)
    source = FlightFrames(layout.open_folder(flight), contents, FakeDecoder())
    assert source.start["flight"] == flight.name
    assert source.shots == {"wished": 3, "safe": 3}
    shown: Sequence[ShownFrame] = source.frames()
    assert [(one.header["frame"], one.verdict) for one in shown] == [
        (0, None),
        (1, {"state": "usable", "reasons": [str(text(BLACK))]}),
    ]
    served = Served(source)
    mean, bad, state = served.asked("/api/frames/0/mean.jpg", "/api/frames/1/mean.jpg", "/api/state")
    assert mean.status_code == 200
    assert bad.status_code == 404
    assert bad.json()["error"].endswith("frames/000001.cr2 is damaged")
    assert state.json()["newest"] == 0
    assert served.feed.frames[0].thumb is not None
    assert served.feed.frames[1].verdict == {"state": "usable", "reasons": [str(text(BLACK))]}


def test_all_frames_get_their_small_pictures_and_a_bad_one_stops_none(
    flight: Path, caplog: pytest.LogCaptureFixture
) -> None:
    source = FlightFrames(layout.open_folder(flight), flight_report.show(flight), FakeDecoder())
    served = Served(source)
    asyncio.run(served.feed.run())
    served.asked()
    assert [one.thumb is not None for one in served.feed.frames.values()] == [True, False]
    assert "frame 1: " in caplog.text
    assert "is damaged" in caplog.text


class Gated(FakeDecoder):
    """Notes the order of frames; the first waits until the others have been asked for."""

    def __init__(self) -> None:
        self.order: list[int] = []
        self.begun, self.gate = threading.Event(), threading.Event()

    def decode(self, path: str, focal_length_mm: float | None, f_number: float | None, *, index: int) -> Any:
        self.order.append(index)
        self.begun.set()
        assert self.gate.wait(60)
        return FakeDecoded()


def test_the_frame_that_is_asked_for_is_decoded_before_those_that_nobody_waits_for(tmp_path: Path) -> None:
    begun = recording.begin(tmp_path, RecordedClock(START_NS))
    for index in range(8):
        request(begun, index)
        begun.ledger.add_tag(tag(deliver(begun, index, b"raw", f"IMG_{index}.CR2")))
    begun.close()
    decoder = Gated()
    folder = begun.folder.path
    served = Served(FlightFrames(layout.open_folder(folder), flight_report.show(folder), decoder))

    async def looked_at() -> None:
        beside = asyncio.create_task(served.feed.run())
        await asyncio.to_thread(decoder.begun.wait, 60)
        asked = [asyncio.create_task(served.feed.slices(index)) for index in (0, 1, 2, 0)]
        await asyncio.sleep(0)  # they have asked
        decoder.gate.set()
        await asyncio.gather(beside, *asked)

    asyncio.run(looked_at())
    served.asked()
    assert decoder.order == [7, 0, 2, 1, 6, 5, 4, 3]


class PlainMaker(PictureMaker):
    """Makes a grey picture in doubt, and notes what it was asked for."""

    def __init__(self) -> None:
        self.asked: list[tuple[str, float | None, float | None]] = []

    def picture(
        self,
        path: Path | str,
        *,
        focal_length_mm: float | None = None,
        f_number: float | None = None,
        told: Sequence[ToldShadow] = (),
    ) -> MadePicture:
        self.asked.append((Path(path).name, focal_length_mm, f_number))
        plane = np.full((40, 60), 0.25, np.float32)
        facts: Any = {
            "plane": plane,
            "pattern": np.zeros((1, 1), np.intp),
            "shadow": None,
            "sigma": plane,
            "valid": None,
        }
        picture = UnmaskedPicture(trusted=plane > 0, dark_share=0.0, soft_share=0.0, sure_noise=1.0, **facts)
        clipped = finding(Code.PICTURE_CLIPPED, FRAME, share=0.03)
        rest: Any = {"raw": SimpleNamespace(colour_names=("G",)), "sensor": None, "corner": (0, 0)}
        return MadePicture(picture, focal_length_mm=50.0, f_number=8.0, colour_matrix=None, findings=(clipped,), **rest)


def test_a_frame_is_looked_at_pixel_by_pixel_with_the_doubts_of_its_picture(flight: Path) -> None:
    maker = PlainMaker()
    source = FlightFrames(layout.open_folder(flight), flight_report.show(flight), FakeDecoder(), maker)
    picture, facts, missing = Served(source).asked(
        "/api/frames/0/full.jpg", "/api/frames/0/full.json", "/api/frames/2/full.jpg"
    )
    with Image.open(io.BytesIO(picture.content)) as image:
        assert image.size == (60, 40)  # the sensor's, not a view's 32 × 24
    (doubt,) = facts.json()["doubts"]
    assert doubt.startswith("3.0% of its pixels are clipped")
    assert len(maker.asked) == 1, "made once for both"
    assert missing.status_code == 404
    field = Served(LightFieldFrames("a.npz", 9, light_field())).asked("/api/frames/0/full.jpg")[0]
    assert "`dappled picture` makes" in field.json()["error"]


def test_a_flight_without_a_mask_says_so(flight: Path) -> None:
    source = FlightFrames(layout.open_folder(flight), flight_report.show(flight), None)
    with pytest.raises(DappledError, match="without a mask: name one with --mask"):
        source.slices(0)
    served = Served(source)
    with pytest.raises(FeedError, match="there is no frame 7"):
        asyncio.run(served.feed.slices(7))
    served.asked()


def test_messages_of_a_light_field_are_of_the_stream() -> None:
    message = LightFieldFrames("a.npz", 9, light_field()).slices(0)
    assert isinstance(message, Message)
    assert np.array_equal(message.arrays()["slices"], light_field().slices)
