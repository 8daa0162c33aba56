"""The application over HTTP, with a daemon's stream and socket that the test holds the other ends of."""

from __future__ import annotations

import asyncio
import json
import logging
import re
import socket
import threading
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import httpx
import numpy as np
import pytest
import uvicorn

from dappled import codec
from dappled.daemon.console import feed as feeds
from dappled.daemon.console.access import Access
from dappled.daemon.console.app import ConsoleApp
from dappled.daemon.console.feed import Feed, Hub
from dappled.daemon.console.process import DaemonChannel
from dappled.daemon.console.seen_ground import SeenGround
from dappled.daemon.console.studio import Studio
from dappled.daemon.stream import wire
from dappled.daemon.stream.publisher import Publisher, Reply
from dappled.daemon.stream.wire import Message
from dappled.decode.geometry import camera_pose
from dappled.decode.geometry.area import PlannedArea
from dappled.drivers.child_process import ChannelError, ProcessChannel
from dappled.findings import FRAME, Code, Subject, finding
from tests import globe
from tests.waiting import eventually

STACK = (np.random.default_rng(1).random((2, 30, 40)) + 0.1).astype(np.complex64)
POSE = {
    "source": "interpolated", "utc_ns": 1, "latitude_deg": 41.6, "longitude_deg": -91.5, "altitude_msl_m": 223.0,
    "height_above_home_m": 20.0, "attitude": [1.0, 0.0, 0.0, 0.0], "position_sigma_m": 0.1, "attitude_sigma_deg": 1.0,
}  # fmt: skip
NO_ATTITUDE = {**codec.plain(finding(Code.POSITION_NO_ATTITUDE, Subject("vehicle"))), "age_s": 7.0}
HEALTH = {
    "utc_ns": 1_800_000_000_000_000_000, "camera": {"state": "ready", "reason": ""},
    "link": {"urls": 1, "silent": 0, "packets": 5, "positions": 5}, "disk": {"free_bytes": 10**11, "folder": "/x"},
    "shots": {"wished": 0, "safe": 0, "failed": 0, "pending": 0, "refused": 0, "lost": 0}, "stages": [],
    "findings": [NO_ATTITUDE],
    "interval_s": None, "clock": {"source": "timesync", "sigma_ms": 0.1}, "vehicle": None, "min_free_bytes": 0,
    "decode": {"mask": "m", "calibration": "c", "running": True},
}  # fmt: skip


def frame(index: int) -> dict[str, Any]:
    facts = {"frame": index, "utc_ns": 1, "pose": POSE, "focal_length_mm": 50.0, "f_number": 8.0, "law": "geometric"}
    more = {"camera": "reference-36mm", "mask": "reference-5x5", "sha256": "0" * 64, "utc_sigma_ns": 1, "iso": 100.0}
    return {**facts, **more, "time_source": "t", "exposure_s": 0.01, "name": "frames/x.dng", "size": 5_000_000}


def slices(index: int) -> tuple[dict[str, Any], bytes]:
    facts = {name: frame(index)[name] for name in ("frame", "utc_ns", "pose", "camera", "mask", "law", "sha256")}
    header = {
        **facts, "focal_length_mm": 50.0, "f_number": None, "carriers": [[0, 0, 0.0, 0.0], [0, 1, 0.0, 0.2]],
        "carriers_from": "predicted", "carriers_found": 0, "grid": [[46.3, 0.0, 0.0], [0.0, 46.1, 0.0]],
        "frame_shape": [1388, 1844], "mosaic": True, "noise_rms": 0.01, "predicted": [], "histogram": [1 / 64] * 64,
        "clipped_share": 0.0, "slices_sha256": "0" * 64,
        "arrays": [wire.describe_array("slices", STACK, "1")],
    }  # fmt: skip
    return header, STACK.tobytes()


@dataclass
class Rig:
    """A console at work: its address, the stream that feeds it, and what it asked of the daemon."""

    url: str
    publisher: Publisher
    feed: Feed
    asked: list[dict[str, Any]] = field(default_factory=list)
    answer: dict[str, Any] = field(default_factory=lambda: {"ok": True, "text": "shot 0", "lines": []})

    def client(self, **headers: str) -> httpx.Client:
        return httpx.Client(base_url=self.url, timeout=60, headers=headers, trust_env=False)

    def post(self, path: str, body: Any, **headers: str) -> httpx.Response:
        given = {"origin": self.url, **headers}
        with self.client(**given) as client:
            return client.post(path, json=body)


@pytest.fixture
def rig(tmp_path: Path) -> Iterator[Rig]:
    def answer(request: Mapping[str, Any], reply: Reply) -> None:
        if request.get("frame", 101) > 100:
            reply(Message("error", {"error": f"there is no frame {request.get('frame')} in this flight"}))
        else:
            reply(Message("slices", *slices(request["frame"])))

    endpoint = f"ipc://{tmp_path}/s"
    publisher = Publisher(endpoint, endpoint + ".ask", capacity=1000)
    publisher.start("f", answer)
    here, there = ProcessChannel.pair()
    studio = Studio(None, camera_pose.NADIR.ravel().tolist())
    feed = Feed(endpoint, endpoint + ".ask", Hub(), studio)
    app = ConsoleApp(feed, studio, DaemonChannel(ProcessChannel(there)), Access(""), None)
    listener = socket.create_server(("127.0.0.1", 0))
    made = Rig(f"http://127.0.0.1:{listener.getsockname()[1]}", publisher, feed)
    server = uvicorn.Server(
        uvicorn.Config(app.asgi(), lifespan="off", ws="none", http="h11", log_config=None,
                       timeout_graceful_shutdown=1)
    )  # fmt: skip

    async def serve() -> None:
        tasks = [asyncio.create_task(feed.run()), asyncio.create_task(app.follow_log())]
        await server.serve(sockets=[listener])
        for task in tasks:
            task.cancel()
        await asyncio.gather(*tasks, return_exceptions=True)

    def daemon() -> None:
        try:
            while True:
                question = here.receive(0.2)
                if question is not None:
                    if question.body["do"] != "log":
                        made.asked.append(dict(question.body))
                    here.send({**made.answer, "number": question.body["number"]})
        except ChannelError:
            return

    threads = [threading.Thread(target=lambda: asyncio.run(serve())), threading.Thread(target=daemon)]
    for thread in threads:
        thread.start()
    eventually(lambda: server.started, "the server is up")
    try:
        yield made
    finally:
        server.should_exit = True
        threads[0].join(60)
        there.close()
        threads[1].join(60)
        here.close()
        app.close()
        publisher.stop(0.1)
        listener.close()


def seen(rig: Rig, index: int) -> None:
    """Publish a frame until the console has it: a subscription takes effect some time after it is asked for."""

    def there() -> bool:
        rig.publisher.publish("frame", frame(index))
        threading.Event().wait(0.02)
        return index in rig.feed.frames

    eventually(there, f"frame {index} is there")


def test_the_page_and_its_parts_are_served_under_strict_rules(rig: Rig) -> None:
    with rig.client() as client:
        page = client.get("/")
        assert "<title>dappled</title>" in page.text
        assert "default-src 'none'" in page.headers["content-security-policy"]
        assert page.headers["cache-control"] == "no-store"
        for part in (
            "main.js",
            "settings.js",
            "stage.js",
            "refocus.js",
            "map.js",
            "format.js",
            "console.css",
            "icon.svg",
        ):
            assert client.get(f"/static/{part}").status_code == 200
        assert client.get("/static/../app.py").status_code == 404
        assert "http" not in page.text.replace("http-equiv", "")  # nothing from elsewhere


def test_a_wish_goes_to_the_daemon_with_its_number(rig: Rig) -> None:
    clock = {"token": rig.feed.state()["token"], "elapsed_ms": 3}
    assert rig.post("/api/shoot", {"sequence": 7, **clock}).json() == {"ok": True, "text": "shot 0", "lines": []}
    assert rig.post("/api/interval", {"sequence": 8, "interval_s": 2.5, "count": 3, **clock}).status_code == 200
    assert rig.post("/api/interval/stop", {}).status_code == 200
    assert rig.post("/api/interval/stop", clock).status_code == 200
    assert rig.post("/api/setting", {"sequence": 9, "name": "CAM_ISO", "value": "200", **clock}).status_code == 200
    asked = [{key: value for key, value in one.items() if key != "number"} for one in rig.asked]
    assert asked == [
        {"do": "shoot", "sequence": 7, **clock},
        {"do": "interval", "sequence": 8, "interval_s": 2.5, "count": 3, **clock},
        {"do": "stop interval"},
        {"do": "stop interval", **clock},
        {"do": "set", "sequence": 9, "name": "CAM_ISO", "value": "200", **clock},
    ]


def test_frames_close_the_holes_of_the_planned_area_and_a_bad_one_opens_them_again(rig: Rig) -> None:
    half = 2 / 111_000  # degrees; the frame sees some ten metres
    square = tuple((41.6 + half * y, -91.5 + half * x) for y, x in ((-1, -1), (-1, 1), (1, 1), (1, -1)))
    rig.feed.hub.globe_asked()  # a viewer
    with rig.client() as client:
        assert client.get("/api/holes.png").status_code == 404
        rig.feed.area = ground = SeenGround(PlannedArea("field", ((square,),)))
        before = client.get("/api/holes.png").content
        seen(rig, 0)

        def decoded() -> bool:
            rig.publisher.publish("slices", *slices(0))
            threading.Event().wait(0.02)
            return ground.share == 1.0

        eventually(decoded, "the area is seen")
        judged = {
            "last": [
                {"frame": 0, "state": "bad", "reasons": [codec.plain(finding(Code.FRAME_DARK, FRAME, share=0.01))]}
            ]
        }
        decode = {"mask": "m", "calibration": "c", "running": True, "judged": judged}
        rig.publisher.publish("health", {**HEALTH, "decode": decode})
        eventually(lambda: rig.feed.frames[0].verdict is not None, "the verdict")
        assert client.get("/api/state").json()["area"] == {"share": 0.0, "frames": 0, "version": 2}
        assert client.get("/api/holes.png").content == before
        assert rig.feed.frames[0].corners is not None


def test_a_refusal_comes_with_its_sentence(rig: Rig) -> None:
    rig.answer = {"ok": False, "error": "the camera is absent"}
    answer = rig.post("/api/shoot", {"sequence": 1})
    assert (answer.status_code, answer.json()["error"]) == (409, "the camera is absent")


@pytest.mark.parametrize(
    ("path", "body", "code"),
    [
        ("/api/shoot", {}, 422),
        ("/api/shoot", {"sequence": -1}, 422),
        ("/api/shoot", {"sequence": True}, 422),
        ("/api/shoot", {"sequence": "1"}, 422),
        ("/api/shoot", {"sequence": 1, "token": 1}, 422),
        ("/api/shoot", {"sequence": 1, "token": "x" * 41}, 422),
        ("/api/outcome", {"sequence": 1, "elapsed_ms": 1.5}, 422),
        ("/api/shoot", [1], 422),
        ("/api/interval/stop", {"token": 5}, 422),
        ("/api/setting", {"sequence": 1, "name": "CAM_ISO"}, 422),
        ("/api/setting", {"sequence": 1, "name": "CAM_ISO", "value": 200}, 422),
        ("/api/setting", {"sequence": 1, "name": "CAM_ISO", "value": "x" * 201}, 422),
        ("/api/interval", {"sequence": 1, "interval_s": -1, "count": 1}, 422),
        ("/api/interval", {"sequence": 1, "interval_s": "2", "count": 1}, 422),
        ("/api/interval", {"sequence": 1, "interval_s": 2, "count": 1.5}, 422),
        ("/api/nothing", {}, 404),
    ],
)
def test_a_malformed_wish_is_refused_in_words_and_asks_nothing(rig: Rig, path: str, body: Any, code: int) -> None:
    answer = rig.post(path, body)
    assert answer.status_code == code
    assert "Traceback" not in answer.text
    assert rig.asked == []


def test_nothing_changes_by_get_or_from_elsewhere(rig: Rig) -> None:
    with rig.client() as client:
        for path in ("/api/shoot", "/api/interval", "/api/interval/stop", "/api/login"):
            assert client.get(path).status_code == 405
    assert rig.post("/api/shoot", {"sequence": 1}, origin="http://evil.example").status_code == 403
    assert rig.post("/api/shoot", {"sequence": 1}, host="evil.example").status_code == 421
    assert rig.post("/api/shoot", {"sequence": 1, "x": "y" * 5000}).status_code == 413
    assert rig.asked == []


def test_a_frame_s_pictures(rig: Rig) -> None:
    seen(rig, 4)
    with rig.client() as client:
        kinds = {"thumb.jpg": "image/jpeg", "mean.jpg": "image/jpeg", "slices.jpg": "image/jpeg",
                 "spectrum.jpg": "image/jpeg", "map.png": "image/png"}  # fmt: skip
        for name, kind in kinds.items():
            answer = client.get(f"/api/frames/4/{name}")
            assert (answer.status_code, answer.headers["content-type"]) == (200, kind), name
        assert "no mask is configured" in client.get("/api/frames/4/views.json").json()["error"]
        assert "no depth" in client.get("/api/frames/4/depth.png").json()["error"]
        assert client.get("/api/frames/4/fish.jpg").status_code == 404
        assert client.get("/api/frames/5/mean.jpg").status_code == 404
        assert client.get("/api/frames/-1/mean.jpg").status_code == 404
        for disparity in ("nan", "99", "x"):
            assert client.get(f"/api/frames/4/refocus.jpg?disparity={disparity}").status_code == 422


@pytest.mark.parametrize("digits", ["9" * 26, "9" * 5000, "٣", "1e3", "-1"])
def test_a_frame_number_that_is_none_is_a_sentence(rig: Rig, digits: str) -> None:
    with rig.client() as client:
        for path in (f"/api/frames/{digits}/mean.jpg", f"/kml/{digits}.png"):
            answer = client.get(path)
            assert answer.status_code == 404
            assert "a frame is named by its number" in answer.json()["error"]


@pytest.mark.parametrize("body", ["[" * 4000, '{"sequence": ' + "9" * 4000 + "}", '{"sequence": NaN}', "\xff", "{"])
def test_a_body_that_no_parser_likes_is_a_sentence(rig: Rig, body: str) -> None:
    with rig.client(origin=rig.url) as client:
        sent = {"content": body.encode("latin-1"), "headers": {"content-type": "application/json"}}
        answer = client.post("/api/shoot", **sent)  # type: ignore[arg-type]  # httpx takes both
    assert answer.status_code == 422
    assert answer.json()["error"] == "a request's body must be one JSON object"
    assert {"do": "shoot"} not in [{"do": each["do"]} for each in rig.asked]


def test_a_body_in_chunks_is_refused_before_it_is_read(rig: Rig) -> None:
    with rig.client(origin=rig.url) as client:
        chunks = iter([b" " * 65536] * 100)
        headers = {"content-type": "application/json", "content-length": "2", "transfer-encoding": "chunked"}
        assert client.post("/api/shoot", content=chunks, headers=headers).status_code == 411


def test_a_fault_of_the_console_is_one_line_of_log(
    rig: Rig, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    monkeypatch.setattr(rig.feed, "state", lambda: 1 / 0)
    with rig.client() as client:
        answer = client.get("/api/state")
    assert answer.status_code == 500
    assert answer.json() == {"error": "the console failed (ZeroDivisionError): see its log"}
    assert answer.headers["content-security-policy"]

    def told() -> list[logging.LogRecord]:
        return [record for record in caplog.records if record.levelname in ("WARNING", "ERROR")]

    eventually(lambda: bool(told()), "a line of log: it follows the answer")
    (line,) = told()
    assert line.getMessage() == "GET '/api/state' failed: unexpected ZeroDivisionError: division by zero"
    assert line.exc_info is None


def test_slices_that_the_daemon_can_t_give_are_a_sentence(rig: Rig) -> None:
    seen(rig, 101)
    with rig.client() as client:
        assert client.get("/api/frames/101/mean.jpg").json()["error"] == "there is no frame 101 in this flight"


def test_a_depth_message_becomes_a_picture(rig: Rig) -> None:
    seen(rig, 4)
    disparity = np.linspace(-1, 1, 12, dtype=np.float32).reshape(3, 4)
    sigma = np.full((3, 4), 0.01, dtype=np.float32)
    arrays = [wire.describe_array("disparity", disparity, "px"), wire.describe_array("sigma", sigma, "px")]

    def told() -> bool:
        rig.feed.hub.globe_asked()  # a viewer
        rig.publisher.publish("depth", {"frame": 4, "arrays": arrays}, disparity.tobytes() + sigma.tobytes())
        threading.Event().wait(0.02)
        return rig.feed.frames[4].depth is not None

    eventually(told, "the depth is there")
    with rig.client() as client:
        assert client.get("/api/frames/4/depth.png").content.startswith(b"\x89PNG")


def test_a_picture_of_the_stream_is_shown_at_full_size_with_its_doubts(rig: Rig) -> None:
    seen(rig, 4)
    doubt = codec.plain(finding(Code.PICTURE_CLIPPED, FRAME, share=0.03))

    def told() -> bool:
        rig.feed.hub.looked_at_full_size()
        rig.publisher.publish("picture", {"frame": 4, "doubts": [doubt]}, b"\xff\xd8 a picture")
        return bool(rig.feed.frame_event(4)["picture"])

    assert not rig.feed.frame_event(4)["picture"]
    eventually(told, "the picture is there")
    with rig.client() as client:
        assert client.get("/api/frames/4/full.jpg").content == b"\xff\xd8 a picture"
        assert client.get("/api/frames/4/full.json").json()["doubts"][0].startswith("3.0% of its pixels are clipped")
        seen(rig, 5)
        assert "no picture at full size" in client.get("/api/frames/5/full.jpg").json()["error"]


def test_pictures_at_full_size_are_asked_for_only_while_one_is_looked_at(
    rig: Rig, monkeypatch: pytest.MonkeyPatch
) -> None:
    with rig.client() as client, client.stream("GET", "/api/events") as stream:
        lines = stream.iter_lines()  # the page is open as long as it reads
        events(lines, "ready")
        eventually(lambda: rig.publisher.wanted("slices"), "the page counts")
        seen(rig, 4)
        seen(rig, 5)
        assert not rig.publisher.wanted("picture"), "a page is open, and shows no picture at full size"
        assert rig.post("/api/full", {}).json() == {"ok": True}
        eventually(lambda: rig.publisher.wanted("picture"), "a picture is asked for")
        monkeypatch.setattr(feeds, "LOOK_S", 0.0)
        eventually(lambda: not rig.publisher.wanted("picture"), "nobody looks any more")
        assert rig.publisher.wanted("slices")


def test_a_globe_gets_link_overlay_and_picture(rig: Rig) -> None:
    seen(rig, 4)
    with rig.client() as client:
        link = client.get("/kml")
        assert f"{rig.url}/kml/latest.kml" in link.text
        latest = client.get("/kml/latest.kml").text
        globe.check(link.content)
        globe.check(latest.encode())
        assert f"{rig.url}/kml/4.png" in latest
        assert "<LatLonBox>" in latest
        assert client.get("/kml/4.png").headers["content-type"] == "image/png"


def test_a_globes_addresses_carry_the_token_that_only_reads(tmp_path: Path) -> None:
    studio = Studio(None, camera_pose.NADIR.ravel().tolist())
    token, endpoint = "sesame-sesame-sesame", f"ipc://{tmp_path}/s"
    channel, other = ProcessChannel.pair()
    app = ConsoleApp(Feed(endpoint, endpoint, Hub(), studio), studio, DaemonChannel(channel), Access(token), None)

    async def globe_asks() -> None:
        transport = httpx.ASGITransport(app.asgi())
        async with httpx.AsyncClient(transport=transport, base_url="http://127.0.0.1:1") as client:
            link = (await client.get("/kml", headers={"authorization": f"Bearer {token}"})).text
            assert token not in link
            address = re.findall(r"http://127.0.0.1:1(/kml/latest.kml\?token=[^<]+)", link)[0]
            assert (await client.get(address)).status_code == 200
            assert (await client.get(address.replace("/kml/latest.kml", "/api/state"))).status_code == 401

    asyncio.run(globe_asks())
    other.close()
    app.close()
    channel.close()


def events(lines: Iterator[str], kind: str) -> dict[str, Any]:
    for line in lines:
        if line.startswith("data: "):
            event: dict[str, Any] = json.loads(line.removeprefix("data: "))
            if event["is"] == kind:
                return event
    raise AssertionError(f"the stream ended without {kind}")


def test_a_page_hears_state_frames_and_log(rig: Rig) -> None:
    rig.answer["lines"] = [{"number": 1, "utc_ns": 1, "level": "info", "text": "camera ready"}]
    seen(rig, 4)
    with rig.client() as client, client.stream("GET", "/api/events") as stream:
        assert stream.headers["content-type"].startswith("text/event-stream")
        lines = stream.iter_lines()
        assert events(lines, "frame")["tag"]["frame"] == 4
        assert events(lines, "log")["lines"][0]["text"] == "camera ready"
        vehicle = {"latitude_deg": 41.0, "longitude_deg": 2.0, "yaw_deg": None, "position_sigma_m": None, "age_ms": 1.0}
        for _ in range(2):
            rig.publisher.publish("health", HEALTH | {"vehicle": vehicle})
        state = events(lines, "state")
        while state["health"] is None:
            state = events(lines, "state")
        assert state["verdict"] == "caution"
        assert list(rig.feed.path) == [(2.0, 41.0)]
        words = "the attitude is unknown: frames are tagged without the direction of view"
        shown = {"code": "position.no_attitude", "state": "caution", "text": words, "todo": "", "age_s": 7.0}
        assert state["findings"] == [shown]
        eventually(lambda: rig.feed.hub.watched, "the page counts")
    eventually(lambda: len(rig.feed.hub) == 0, "a page that went away is forgotten")


def test_metrics_for_whoever_scrapes(rig: Rig) -> None:
    with rig.client() as client:
        assert client.get("/metrics").status_code == 503
        vehicle = {"latitude_deg": 41.0, "longitude_deg": 2.0, "yaw_deg": None, "position_sigma_m": None, "age_ms": 1.0}

        def heard() -> bool:  # a message sent before the page's socket listens is nobody's
            rig.publisher.publish("health", HEALTH | {"vehicle": vehicle})
            return client.get("/metrics").status_code == 200

        eventually(heard, "the daemon is heard")
        answer = client.get("/metrics")
    assert answer.headers["content-type"].startswith("text/plain; version=0.0.4")
    assert 'dappled_camera_state{state="ready"} 1.0' in answer.text


def test_pages_are_not_without_number(rig: Rig, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(feeds, "PAGES", 0)
    with rig.client() as client:
        assert client.get("/api/events").status_code == 503


def test_a_page_that_stops_reading_costs_a_bounded_queue() -> None:
    async def flood() -> tuple[int, list[str]]:
        pages = Hub()
        reading = pages.listen([{"is": "ready"}])
        await anext(reading)
        waiting: asyncio.Future[str] = asyncio.ensure_future(anext(reading))
        await asyncio.sleep(0)
        pages.send({"is": "n", "n": -1})
        await waiting
        for n in range(feeds.WAITING + 36):
            pages.send({"is": "n", "n": n})
        got = [await anext(reading) for _ in range(feeds.WAITING)]
        await reading.aclose()  # type: ignore[attr-defined]  # it is a generator
        return pages.dropped, got

    dropped, got = asyncio.run(flood())
    assert dropped == 36
    assert json.loads(got[0].removeprefix("data: "))["n"] == 36  # the oldest went
    assert json.loads(got[-1].removeprefix("data: "))["n"] == feeds.WAITING + 35


def test_messages_that_are_none_are_passed_over(rig: Rig) -> None:
    rig.publisher.publish("frame", {"frame": 1})
    rig.publisher.publish("health", {"camera": None})
    seen(rig, 4)


@pytest.mark.parametrize("token", ['"\\ud800"', '"é€"', '""', "7", "null"])
def test_any_token_is_well_where_none_is_asked_for(rig: Rig, token: str) -> None:
    with rig.client(origin=rig.url) as client:
        answer = client.post(
            "/api/login", content=f'{{"token": {token}}}'.encode(), headers={"content-type": "application/json"}
        )
    assert answer.status_code == 200
    assert "set-cookie" not in answer.headers
