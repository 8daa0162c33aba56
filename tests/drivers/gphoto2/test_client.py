"""The driver with the real libgphoto2, against the PTP/IP body and against libgphoto2's own virtual USB camera."""

from __future__ import annotations

import errno
import hashlib
import io
import itertools
import math
import os
import signal
import subprocess
import sys
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from dataclasses import replace
from fractions import Fraction
from functools import partial
from pathlib import Path
from typing import Any

import pytest
from PIL import Image

from dappled import durable
from dappled.clock import SystemClock
from dappled.drivers import usb_bus
from dappled.drivers.camera import (
    Arrival,
    CameraError,
    CameraEvent,
    Companion,
    Fired,
    Identity,
    Noticed,
    ShotFailed,
    StateChanged,
)
from dappled.drivers.child_process import ProcessChannel, RestartBudget
from dappled.drivers.gphoto2.client import GPhoto2Camera, Spawn, open_camera, spawn_process
from dappled.drivers.gphoto2.messages import Carryover, event_message
from dappled.drivers.gphoto2.settings import GPhoto2Settings, parse_settings
from dappled.drivers.raw.raw_file import read_exif
from dappled.findings import Code, Subject, finding
from dappled.mocks.body.body import BodyOptions, SimulatedBody, pattern
from dappled.mocks.body.eos450d import thumbnail
from dappled.testing import (
    CameraContract,
    Rig,
    arrived,
    content,
    failed,
    of_shots,
    until,
    until_shot_ends,
    until_state,
)
from tests.waiting import eventually

SIZE = 3_000_001

Make = Callable[..., GPhoto2Camera]


@pytest.fixture
def body() -> Iterator[SimulatedBody]:
    with SimulatedBody.start(BodyOptions(picture=f"pattern:{SIZE}:dng")) as body:
        yield body


@pytest.fixture
def make(body: SimulatedBody) -> Iterator[Make]:
    """Make drivers for the body; all are stopped at the end."""
    made: list[GPhoto2Camera] = []

    def make(**settings: Any) -> GPhoto2Camera:
        made.append(open_camera({"port": body.port, **settings}))
        return made[-1]

    yield make
    for camera in made:
        camera.stop()


@pytest.fixture
def ready(make: Make) -> Make:
    """Likewise, started and ready."""

    def ready(**settings: Any) -> GPhoto2Camera:
        camera = make(**settings)
        camera.start()
        until_state(camera, "ready")
        return camera

    return ready


@contextmanager
def running(camera: GPhoto2Camera) -> Iterator[GPhoto2Camera]:
    """The camera, started; stopped at the end."""
    camera.start()
    try:
        yield camera
    finally:
        camera.stop()


@pytest.mark.parametrize(
    ("f_number", "shown"),
    [
        (None, "2.8"),
        (14.8, "14"),
        *(pytest.param(*pair, marks=pytest.mark.slow) for pair in ((22.0, "22"), (59.2, "32"))),
    ],
)
def test_the_simulated_lens_is_set_to_the_stop_of_its_pictures(f_number: float | None, shown: str) -> None:
    with (
        SimulatedBody.start(BodyOptions(picture="pattern:1000:dng", f_number=f_number)) as body,
        running(open_camera({"port": body.port})) as camera,
    ):
        until_state(camera, "ready")
        assert {one.name: one.value for one in camera.settings()}["aperture"] == shown


def test_the_simulated_body_is_set_to_the_time_of_its_pictures() -> None:
    options = BodyOptions(scale=0.125, scene="white", f_number=14.8)
    with SimulatedBody.start(options) as body, running(open_camera({"port": body.port})) as camera:
        until_state(camera, "ready")
        camera.fire(1)
        file = content(arrived(camera, 1))
        shown = {one.name: one.value for one in camera.settings()}["shutter_speed"]
    taken_s = read_exif(io.BytesIO(file)).exposure_s
    assert taken_s is not None
    assert abs(math.log2(float(Fraction(shown)) / taken_s)) <= 1 / 6 + 0.05  # marked times are rounded


class TestContractToTheCard(CameraContract):
    @pytest.fixture
    def rig(self, make: Make) -> Iterator[Rig]:
        camera = make(capture_target="card")
        yield Rig(camera, partial(pattern, size=SIZE))
        camera.stop()


@pytest.mark.slow
class TestContractToMemory(CameraContract):
    @pytest.fixture
    def rig(self, make: Make) -> Iterator[Rig]:
        camera = make(capture_target="ram")
        yield Rig(camera, partial(pattern, size=SIZE))
        camera.stop()


class TestContractOfTheVirtualUsbCamera(CameraContract):
    """libgphoto2's own simulated body, a Nikon over simulated USB: it shares no code with this project."""

    @pytest.fixture
    def rig(self, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[Rig]:
        picture = b"\xff\xd8\xff" + pattern(1, 200_000)
        (tmp_path / "one.jpg").write_bytes(picture)
        monkeypatch.setenv("VCAMERADIR", str(tmp_path))  # libgphoto2 looks for it when the camera's process starts
        camera = open_camera({"port": "usb:"})
        yield Rig(camera, lambda _number: picture)
        camera.stop()


def test_identity_is_what_the_body_says(make: Make, body: SimulatedBody) -> None:
    camera = make()
    camera.start()
    ready = until_state(camera, "ready")
    assert ready.identity is not None
    assert (ready.identity.make, ready.identity.model) == ("Canon Inc.", "Canon EOS 450D")
    assert (ready.identity.serial, ready.identity.port) == ("0830412345", body.port)


def test_live_view_comes_through_the_library_and_a_shot_ends_it(ready: Make, body: SimulatedBody) -> None:
    camera = ready(timeouts={"answer_s": 30.0})

    def picture(unlike: bytes = b"") -> bytes:
        deadline_s = time.monotonic() + 60
        while time.monotonic() < deadline_s:
            now = None
            with suppress(CameraError):  # off while a shot is at the camera
                now = camera.look()
            if now is not None and now.jpeg != unlike:
                return now.jpeg
            time.sleep(0.01)
        raise AssertionError("no picture")

    first = picture()
    with Image.open(io.BytesIO(first)) as shown:
        assert shown.size == (480, 320)
    assert picture(unlike=first) != first  # each look is a new one
    camera.fire(1)
    assert arrived(camera, 1)
    assert picture(unlike=first)


def test_a_file_on_the_card_keeps_its_name_and_stays_until_released(ready: Make, body: SimulatedBody) -> None:
    camera = ready(delete_after_download=True)
    camera.fire(0)
    arrival = arrived(camera, 0)
    assert arrival.name == "IMG_0001.DNG"
    assert body.card == ["IMG_0001.DNG"]
    arrival.blob.close()
    camera.release(arrival)
    camera.fire(1)  # commands are obeyed in order: the deletion comes first
    last = arrived(camera, 1)
    last.blob.close()
    assert body.card == ["IMG_0002.DNG"]


def test_by_default_the_card_is_left_alone(ready: Make, body: SimulatedBody) -> None:
    camera = ready()
    for shot in range(2):
        camera.fire(shot)
        arrival = arrived(camera, shot)
        arrival.blob.close()
        camera.release(arrival)
    camera.stop()
    assert body.card == ["IMG_0001.DNG", "IMG_0002.DNG"]


def test_only_the_body_with_the_serial_number_is_taken(make: Make) -> None:
    stranger = make(serial="0000000001", timeouts={"retry_s": 0.1})
    stranger.start()
    absent = until_state(stranger, "absent")
    assert "0000000001" in absent.reason
    assert "0830412345" in absent.reason
    stranger.stop()
    wanted = make(serial="0830412345")
    wanted.start()
    until_state(wanted, "ready")


def test_without_a_camera_it_says_what_to_do_and_keeps_looking() -> None:
    with SimulatedBody.start(BodyOptions(picture="pattern:1000:jpg")) as gone:
        port = gone.port
    with running(open_camera({"port": port, "timeouts": {"retry_s": 0.05}})) as camera:
        assert port in until_state(camera, "absent").reason
        camera.fire(1)
        assert port in failed(camera, 1)


def test_a_camera_held_by_another_program_is_named_and_taken_when_it_is_free(make: Make, body: SimulatedBody) -> None:
    body.fault("refuse")
    camera = make(timeouts={"retry_s": 0.05})
    camera.start()
    assert "another program" in until_state(camera, "faulted").reason
    body.fault("clear")
    until_state(camera, "ready")


@pytest.mark.parametrize("target", ["card", pytest.param("ram", marks=pytest.mark.slow)])
def test_a_busy_body_is_asked_again(ready: Make, body: SimulatedBody, target: str) -> None:
    camera = ready(capture_target=target)
    body.fault("busy 0.3")
    camera.fire(1)
    assert of_shots(_ended(until_shot_ends(camera, 1))) == [(Fired, 1), (Arrival, 1)]
    assert body.releases == 1


@pytest.mark.slow
def test_a_body_that_stays_busy_fails_the_shot_and_takes_the_next(ready: Make, body: SimulatedBody) -> None:
    camera = ready(timeouts={"busy_s": 0.2})
    body.fault("busy")
    camera.fire(1)
    assert "busy" in failed(camera, 1)
    body.fault("clear")
    camera.fire(2)
    assert of_shots(_ended(until_shot_ends(camera, 2))) == [(Fired, 2), (Arrival, 2)]


def test_a_refused_release_fails_the_shot_and_takes_the_next(ready: Make, body: SimulatedBody) -> None:
    camera = ready()
    body.fault("error")
    camera.fire(1)
    camera.fire(2)
    assert of_shots(_ended(until_shot_ends(camera, 2))) == [(ShotFailed, 1), (Fired, 2), (Arrival, 2)]


def test_a_full_card_fails_the_shot_with_a_hint() -> None:
    with (
        SimulatedBody.start(BodyOptions(picture="pattern:1000:cr2", card_bytes=1500)) as body,
        running(open_camera({"port": body.port})) as camera,
    ):
        until_state(camera, "ready")
        camera.fire(1)
        camera.fire(2)
        events = _ended(until_shot_ends(camera, 2))
        assert of_shots(events) == [(Fired, 1), (Arrival, 1), (ShotFailed, 2)]
        assert "card" in events[-1].reason


def test_a_lost_event_s_file_is_found_on_the_card(ready: Make, body: SimulatedBody) -> None:
    camera = ready(timeouts={"complete_s": 0.2})
    camera.fire(1)
    _ended(until_shot_ends(camera, 1))
    body.fault("no-event")
    camera.fire(2)
    arrival = arrived(camera, 2)
    assert arrival.name == "IMG_0002.DNG"
    assert content(arrival) == pattern(2, SIZE)


def test_a_lost_event_s_file_in_memory_fails_the_shot(ready: Make, body: SimulatedBody) -> None:
    camera = ready(capture_target="ram", timeouts={"file_s": 0.5})
    body.fault("no-event")
    camera.fire(1)
    assert "0.5 s" in failed(camera, 1)


def test_a_file_of_the_wrong_length_is_asked_for_again(ready: Make, body: SimulatedBody) -> None:
    camera = ready()
    body.fault("short")
    camera.fire(1)
    arrival = arrived(camera, 1)
    assert content(arrival) == pattern(1, SIZE)


def test_a_file_that_stays_of_the_wrong_length_fails_the_shot_and_stays_on_the_card(
    ready: Make, body: SimulatedBody
) -> None:
    camera = ready()
    body.fault("short 1000")
    camera.fire(1)
    reason = failed(camera, 1)
    assert str(SIZE) in reason
    assert "IMG_0001.DNG" in reason
    assert body.card == ["IMG_0001.DNG"]


def test_a_link_dropped_while_idle_comes_back(ready: Make, body: SimulatedBody) -> None:
    camera = ready()
    body.fault("drop")
    assert until_state(camera, "faulted").reason
    until_state(camera, "ready")
    camera.fire(1)
    assert of_shots(_ended(until_shot_ends(camera, 1))) == [(Fired, 1), (Arrival, 1)]


def test_a_link_dropped_in_mid_transfer_loses_no_file_on_the_card(ready: Make, body: SimulatedBody) -> None:
    camera = ready()
    body.fault("drop-transfer")
    camera.fire(1)
    events = until_shot_ends(camera, 1)
    arrival = events[-1]
    assert isinstance(arrival, Arrival)
    assert content(arrival) == pattern(1, SIZE)
    assert any(isinstance(event, StateChanged) and event.state == "faulted" for event in events)
    assert body.releases == 1


def open_in(folder: Path, process: int) -> list[str]:
    """Files without a name that a process has open in a folder."""
    found = [os.readlink(fd) for fd in Path(f"/proc/{process}/fd").iterdir() if fd.is_symlink()]
    return [name for name in found if name.startswith(f"{folder}/#")]


def test_a_file_comes_into_the_flight_s_folder_and_a_part_of_one_leaves_nothing(
    body: SimulatedBody, tmp_path: Path
) -> None:
    """The link breaks in its middle, then the process is killed there."""
    started: list[subprocess.Popen[bytes]] = []
    camera = GPhoto2Camera(parse_settings({"port": body.port}), spawn=_recorded(started))
    camera.receive_into(tmp_path)
    with running(camera):
        until_state(camera, "ready")
        body.fault("drop-transfer")
        camera.fire(1)
        arrival = arrived(camera, 1)
        assert (os.fstat(arrival.blob.fd).st_nlink, os.fstat(arrival.blob.fd).st_dev) == (0, tmp_path.stat().st_dev)
        assert arrival.blob.sha256 == hashlib.sha256(pattern(1, SIZE)).hexdigest()
        assert content(arrival) == pattern(1, SIZE)
        body.fault("crawl")
        camera.fire(2)
        eventually(lambda: open_in(tmp_path, started[0].pid), "the file is on its way")
        started[0].kill()
        until(camera, lambda event: isinstance(event, ShotFailed) and event.shot == 2)
        body.fault("clear")
        assert content(arrived(camera, 2)) == pattern(2, SIZE)  # by the next process, on the disk too
        assert os.listdir(tmp_path) == []
        assert open_in(tmp_path, os.getpid()) == []


def test_a_folder_that_takes_no_file_without_a_name_is_not_used(
    body: SimulatedBody, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    def refuse(folder: Path) -> int:
        raise OSError(errno.EOPNOTSUPP, os.strerror(errno.EOPNOTSUPP))

    monkeypatch.setattr(durable, "unnamed", refuse)
    caplog.set_level("INFO")
    camera = open_camera({"port": body.port})
    camera.receive_into(tmp_path)
    assert f"{tmp_path} has none without a name" in caplog.text
    with running(camera):
        until_state(camera, "ready")
        camera.fire(1)
        arrival = arrived(camera, 1)
        assert os.fstat(arrival.blob.fd).st_dev != tmp_path.stat().st_dev
        assert content(arrival) == pattern(1, SIZE)


def test_a_link_dropped_in_mid_exposure_loses_no_file_on_the_card() -> None:
    with (
        SimulatedBody.start(BodyOptions(picture=f"pattern:{SIZE}:cr2", delay_s=0.5)) as body,
        running(open_camera({"port": body.port})) as camera,
    ):
        until_state(camera, "ready")
        camera.fire(1)
        until(camera, lambda event: isinstance(event, Fired))
        body.fault("drop")
        arrival = arrived(camera, 1)
        assert content(arrival) == pattern(1, SIZE)
        assert body.releases == 1


@pytest.mark.slow
def test_a_silent_body_costs_the_shot_and_the_process_but_not_the_camera(ready: Make, body: SimulatedBody) -> None:
    camera = ready(timeouts={"answer_s": 1.5})
    body.fault("silence")
    camera.fire(1)
    assert "1.5 s" in failed(camera, 1)
    body.fault("clear")
    until_state(camera, "ready")
    camera.fire(2)
    assert of_shots(_ended(until_shot_ends(camera, 2)))[-1] == (Arrival, 2)


@pytest.mark.slow
def test_a_silent_body_is_given_up_by_libgphoto2_itself_and_served_again(ready: Make, body: SimulatedBody) -> None:
    camera = ready()
    body.fault("silence")
    camera.fire(1)
    camera.fire(2)
    events = until_shot_ends(camera, 2)
    reasons = {event.shot: event.reason for event in events if isinstance(event, ShotFailed)}
    assert set(reasons) == {1, 2}
    assert "may have opened" in reasons[1]
    body.fault("clear")
    until_state(camera, "ready")
    camera.fire(3)
    assert of_shots(_ended(until_shot_ends(camera, 3)))[-1] == (Arrival, 3)


@pytest.mark.slow
def test_stop_does_not_wait_for_a_silent_body(body: SimulatedBody) -> None:
    """Its process is killed: libgphoto2 alone would hold on for 7.5 s."""
    started: list[subprocess.Popen[bytes]] = []
    with running(GPhoto2Camera(parse_settings({"port": body.port}), spawn=_recorded(started))) as camera:
        until_state(camera, "ready")
        body.fault("silence")
        camera.fire(1)
        camera.stop()
        assert [one.wait(60) for one in started] == [-signal.SIGKILL]
        assert of_shots(until_shot_ends(camera, 1)) == [(ShotFailed, 1)]


def _recorded(
    started: list[subprocess.Popen[bytes]],
) -> Spawn:
    def spawn(settings: GPhoto2Settings, carryover: Carryover) -> tuple[subprocess.Popen[bytes], ProcessChannel]:
        process, channel = spawn_process(settings, carryover)
        started.append(process)
        return process, channel

    return spawn


def test_a_crash_of_the_process_fails_its_shots_and_is_made_good(body: SimulatedBody) -> None:
    body.fault("no-event")
    started: list[subprocess.Popen[bytes]] = []
    with running(GPhoto2Camera(parse_settings({"port": body.port}), spawn=_recorded(started))) as camera:
        until_state(camera, "ready")
        camera.fire(1)
        camera.fire(2)
        until(camera, lambda event: isinstance(event, Fired))
        started[0].send_signal(signal.SIGKILL)
        events = until(camera, lambda event: isinstance(event, StateChanged) and event.state == "ready")
        assert of_shots(events) == [(ShotFailed, 1), (ShotFailed, 2)]
        camera.fire(3)
        assert of_shots(_ended(until_shot_ends(camera, 3))) == [(Fired, 3), (Arrival, 3)]
        assert len(started) == 2


def test_what_a_dead_process_had_fired_is_fetched_by_the_next_one(body: SimulatedBody) -> None:
    """Also when its file was on the card before the next process looked there for the first time."""
    started: list[subprocess.Popen[bytes]] = []
    with running(GPhoto2Camera(parse_settings({"port": body.port}), spawn=_recorded(started))) as camera:
        until_state(camera, "ready")
        camera.fire(1)
        _ended(until_shot_ends(camera, 1))
        body.fault("no-event")
        camera.fire(2)
        until(camera, lambda event: isinstance(event, Fired) and event.shot == 2)
        started[0].send_signal(signal.SIGKILL)
        until(camera, lambda event: isinstance(event, ShotFailed) and event.shot == 2)
        arrival = arrived(camera, 2)
        assert content(arrival) == pattern(2, SIZE)
        camera.fire(3)
        arrival = arrived(camera, 3)
        assert content(arrival) == pattern(3, SIZE)


@pytest.mark.slow
def test_a_process_that_keeps_dying_is_not_started_for_ever(body: SimulatedBody) -> None:
    started: list[subprocess.Popen[bytes]] = []

    def spawn(settings: GPhoto2Settings, carryover: Carryover) -> tuple[subprocess.Popen[bytes], ProcessChannel]:
        process, channel = _recorded(started)(settings, carryover)
        process.kill()
        return process, channel

    with running(
        GPhoto2Camera(parse_settings({"port": body.port}), spawn=spawn, budget=RestartBudget(2, 3600.0))
    ) as camera:
        until(camera, lambda event: isinstance(event, StateChanged) and "too often" in event.reason)
        assert len(started) == 3  # the first start and two restarts


def test_what_changes_on_the_bus_ends_the_wait_of_a_process_that_kept_dying() -> None:
    """A body that was plugged in again is another one; the budget would allow the next start an hour later."""
    bus = ["1-1"]

    def dies(settings: GPhoto2Settings, carryover: Carryover) -> tuple[subprocess.Popen[bytes], ProcessChannel]:
        channel, other = ProcessChannel.pair()
        other.close()
        return subprocess.Popen(["/bin/false"]), channel

    camera = GPhoto2Camera(GPhoto2Settings(), spawn=dies, budget=RestartBudget(2, 3600.0), bus=lambda: tuple(bus))
    with running(camera):
        for place in ("1-2", "1-3"):
            until(camera, lambda event: isinstance(event, StateChanged) and "too often" in event.reason)
            bus.append(place)


def test_the_process_dies_with_its_parent(body: SimulatedBody) -> None:
    """A parent that is killed can't end its child; the child must end all the same."""
    script = (
        "import sys\n"
        "from dappled.drivers.gphoto2.client import spawn_process\n"
        "from dappled.drivers.gphoto2.settings import parse_settings\n"
        "from dappled.drivers.gphoto2.messages import Carryover\n"
        "process, channel = spawn_process(parse_settings({'port': sys.argv[1]}), Carryover())\n"
        "while channel.receive(30).body.get('state') != 'ready': pass\n"
        "print(process.pid, flush=True)\n"
        "sys.stdin.read()\n"
    )
    with subprocess.Popen(
        [sys.executable, "-c", script, body.port], stdin=subprocess.PIPE, stdout=subprocess.PIPE
    ) as parent:
        assert parent.stdout is not None
        child = int(parent.stdout.readline())
        os.kill(child, 0)
        parent.kill()
        parent.wait()
    deadline = time.monotonic() + 60
    while _lives(child):
        assert time.monotonic() < deadline, "the camera's process outlived its parent"
        time.sleep(0.02)


def _lives(pid: int) -> bool:
    try:
        state = Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()[0]
    except OSError:
        return False
    return state != "Z"


def test_a_shot_in_flight_can_not_be_fired_again(ready: Make) -> None:
    camera = ready()
    camera.fire(1)
    with pytest.raises(CameraError, match="shot 1"):
        camera.fire(1)
    _ended(until_shot_ends(camera, 1))


def _ended(events: list[Any]) -> list[Any]:
    """The events, with the descriptors of arrivals closed."""
    for event in events:
        if isinstance(event, Arrival):
            event.blob.close()
    return events


@pytest.mark.parametrize("target", ["card", pytest.param("ram", marks=pytest.mark.slow)])
def test_raw_and_jpeg_are_one_frame_and_its_companion(target: str) -> None:
    with (
        SimulatedBody.start(BodyOptions(picture=f"pattern:{SIZE}:cr2", pairs=True)) as body,
        running(open_camera({"port": body.port, "capture_target": target, "delete_after_download": True})) as camera,
    ):
        until_state(camera, "ready")
        for shot in (1, 2):
            camera.fire(shot)
            events = until(camera, lambda event: isinstance(event, Companion))
            assert of_shots(events) == [(Fired, shot), (Arrival, shot), (Companion, shot)]
            raw, jpeg = [event for event in events if isinstance(event, Arrival | Companion)]
            assert [one.name.lower().endswith(end) for one, end in ((raw, ".cr2"), (jpeg, ".jpg"))] == [True] * 2
            assert content(raw) == pattern(shot, SIZE)
            assert content(jpeg) == thumbnail(shot)
            camera.release(raw)
            camera.release(jpeg)
        camera.fire(3)  # commands are obeyed in order: the deletions come first
        _ended(until(camera, lambda event: isinstance(event, Companion)))
        assert body.card == (["IMG_0003.CR2", "IMG_0003.JPG"] if target == "card" else [])


def test_no_focus_fails_the_shot_soon_and_takes_the_next(ready: Make, body: SimulatedBody) -> None:
    camera = ready(timeouts={"complete_s": 0.5})
    body.fault("no-focus")
    camera.fire(1)
    assert "focus" in failed(camera, 1)
    camera.fire(2)
    assert of_shots(_ended(until_shot_ends(camera, 2))) == [(Fired, 2), (Arrival, 2)]


def test_a_slow_transfer_is_waited_for(ready: Make, body: SimulatedBody) -> None:
    camera = ready(timeouts={"file_s": 1.0})
    body.fault("slow 1.5")
    camera.fire(1)
    arrival = arrived(camera, 1)
    assert content(arrival) == pattern(1, SIZE)


@pytest.mark.parametrize("wanted", [pytest.param("0000000001", marks=pytest.mark.slow), "0000000002"])
def test_of_two_bodies_of_one_model_the_one_with_the_serial_number_is_taken(wanted: str) -> None:
    numbers = ("0000000001", "0000000002")
    with (
        SimulatedBody.start(BodyOptions(picture="pattern:1000:cr2", serial=numbers[0])) as one,
        SimulatedBody.start(BodyOptions(picture="pattern:1000:cr2", serial=numbers[1])) as other,
        running(open_camera({"port": f"{one.port},{other.port}", "serial": wanted})) as camera,
    ):
        until_state(camera, "ready")
        assert camera.identity is not None
        assert camera.identity.serial == wanted
        camera.fire(1)
        _ended(until_shot_ends(camera, 1))
        assert [one.releases, other.releases] == [int(wanted == number) for number in numbers]


@pytest.mark.slow
def test_after_a_break_the_same_body_is_taken_again_and_not_its_twin() -> None:
    with (
        SimulatedBody.start(BodyOptions(picture="pattern:1000:cr2", serial="0000000001")) as one,
        SimulatedBody.start(BodyOptions(picture="pattern:1000:cr2", serial="0000000002")) as other,
    ):
        one.fault("unplug")
        with running(open_camera({"port": f"{one.port},{other.port}", "timeouts": {"retry_s": 0.1}})) as camera:
            until_state(camera, "ready")
            assert camera.identity is not None
            assert camera.identity.serial == "0000000002"
            one.fault("clear")
            other.fault("drop")
            until_state(camera, "faulted")
            until_state(camera, "ready")
            assert camera.identity.serial == "0000000002"


def test_a_process_that_can_t_be_started_now_is_tried_again(body: SimulatedBody) -> None:
    problems = [OSError(errno.EMFILE, os.strerror(errno.EMFILE)), OSError(errno.ENOMEM, os.strerror(errno.ENOMEM))]

    def spawn(settings: GPhoto2Settings, carryover: Carryover) -> tuple[subprocess.Popen[bytes], ProcessChannel]:
        if problems:
            raise problems.pop(0)
        return spawn_process(settings, carryover)

    with running(GPhoto2Camera(parse_settings({"port": body.port}), spawn=spawn)) as camera:
        assert "Too many open files" in until_state(camera, "faulted").reason
        camera.fire(1)
        assert of_shots(until_shot_ends(camera, 1)) == [(ShotFailed, 1)]
        until_state(camera, "ready")
        camera.fire(2)
        _ended(until_shot_ends(camera, 2))


class HastyClock(SystemClock):
    """Each reading is two seconds later than the one before: a ping is due after every message."""

    def __init__(self) -> None:
        super().__init__(0)
        self._read = itertools.count(0, 2 * 10**9)

    def monotonic_ns(self) -> int:
        return next(self._read)


def test_what_a_process_said_before_it_ended_is_heard_and_the_unlisted_card_is_told() -> None:
    """Of a process that has ended commands can't be sent; its last words wait in the socket."""
    left = [finding(Code.PICTURE_ON_CARD, Subject("picture", f"/store/IMG_{number:04d}.CR2")) for number in range(4)]
    told: list[CameraEvent] = [
        StateChanged("ready", "", 0, Identity("Canon", "450D", "1", "usb:1,2")),
        *(Noticed(one, 0) for one in left),
    ]
    started: list[subprocess.Popen[bytes]] = []

    def spawn(_settings: GPhoto2Settings, _carryover: Carryover) -> tuple[subprocess.Popen[bytes], ProcessChannel]:
        if started:
            raise OSError(errno.ENOMEM, os.strerror(errno.ENOMEM))
        started.append(subprocess.Popen([sys.executable, "-c", "raise SystemExit(1)"]))
        channel, there = ProcessChannel.pair()
        child = ProcessChannel(there)
        for event in told:
            child.send(event_message(event).body)
        child.close()
        return started[0], channel

    camera = GPhoto2Camera(GPhoto2Settings(), spawn=spawn, clock=HastyClock())
    with running(camera):
        events = until(camera, lambda event: isinstance(event, StateChanged) and "can't be started" in event.reason)
    assert [event.finding for event in events if isinstance(event, Noticed)] == left
    last = until_state(camera, "absent")
    assert last.reason == "the camera was stopped"
    notice = camera.next_event(5.0)
    assert isinstance(notice, Noticed)
    assert notice.finding.code is Code.CARD_NOT_LISTED


def test_a_body_that_comes_back_under_another_address_is_found() -> None:
    with (
        SimulatedBody.start(BodyOptions(picture=f"pattern:{SIZE}:cr2", addresses=2)) as body,
        running(open_camera({"port": body.port, "timeouts": {"retry_s": 0.1}})) as camera,
    ):
        until_state(camera, "ready")
        before = camera.identity
        body.ask("move")
        until_state(camera, "faulted")
        until_state(camera, "ready")
        assert before is not None
        assert camera.identity is not None
        assert before.serial == camera.identity.serial
        assert before.port != camera.identity.port
        camera.fire(1)
        _ended(until_shot_ends(camera, 1))


@pytest.mark.slow
def test_a_silent_body_on_usb_has_its_port_reset(body: SimulatedBody, monkeypatch: pytest.MonkeyPatch) -> None:
    resets: list[str] = []
    monkeypatch.setattr(usb_bus, "reset", resets.append)
    settings = parse_settings({"port": body.port, "timeouts": {"answer_s": 1.5}})
    with running(GPhoto2Camera(settings)) as camera:
        until_state(camera, "ready")
        body.fault("silence")
        camera.fire(1)
        until_state(camera, "busy")
        assert camera.identity is not None
        camera.identity = replace(camera.identity, port="usb:001,005")  # as if it were there
        assert "port reset" in failed(camera, 1)
        assert resets == ["usb:001,005"]
        body.fault("clear")
        until_state(camera, "ready")


STARVED = """
import contextlib, os, resource, sys, time
from dappled.drivers.camera import Arrival, ShotFailed
from dappled.drivers.gphoto2.client import GPhoto2Camera, spawn_process
from dappled.drivers.gphoto2.settings import parse_settings
from dappled.testing import content, until_shot_ends, until_state

started, hogs = [], []

def spawn(settings, carryover):
    started.append(spawn_process(settings, carryover))
    return started[-1]

def exhaust():
    resource.setrlimit(resource.RLIMIT_NOFILE, (64, 64))
    with contextlib.suppress(OSError):
        while True:
            hogs.append(os.open(os.devnull, os.O_RDONLY))

def free():
    while hogs:
        os.close(hogs.pop())

def waits_for_descriptors():
    deadline = time.monotonic() + 60
    while not started[-1][1].starved:
        assert time.monotonic() < deadline
        time.sleep(0.01)

camera = GPhoto2Camera(parse_settings({"port": sys.argv[1], "capture_target": sys.argv[2]}), spawn=spawn)
camera.start()
until_state(camera, "ready")
exhaust()
camera.fire(1)
"""


def starved(body: SimulatedBody, target: str, code: str) -> None:
    words = [sys.executable, "-c", f"{STARVED}{code}camera.stop()\nassert len(started) == 1\n", body.port, target]
    subprocess.run(words, check=True, timeout=100)


@pytest.mark.parametrize("target", ["card", pytest.param("ram", marks=pytest.mark.slow)])
def test_without_descriptors_a_file_waits_and_comes_when_there_are_some_again(body: SimulatedBody, target: str) -> None:
    starved(
        body,
        target,
        "waits_for_descriptors()\n"
        "free()\n"
        "arrival = until_shot_ends(camera, 1)[-1]\n"
        "assert isinstance(arrival, Arrival), arrival\n"
        f"assert len(content(arrival)) == {SIZE}\n",
    )


@pytest.mark.slow
def test_without_descriptors_for_long_the_shot_fails_alone_and_its_file_stays_on_the_card(body: SimulatedBody) -> None:
    starved(
        body,
        "card",
        "failed = until_shot_ends(camera, 1)[-1]\n"
        "assert isinstance(failed, ShotFailed), failed\n"
        "assert 'run out of file descriptors (its limit is 64)' in failed.reason, failed.reason\n"
        "assert failed.reason.endswith('IMG_0001.DNG') and 'it stays on the card' in failed.reason, failed.reason\n"
        "free()\n"
        "camera.fire(2)\n"
        "arrival = until_shot_ends(camera, 2)[-1]\n"
        "assert isinstance(arrival, Arrival), arrival\n"
        f"assert len(content(arrival)) == {SIZE}\n",
    )
    assert body.card == ["IMG_0001.DNG", "IMG_0002.DNG"]


def test_a_camera_that_was_started_can_not_be_started_again(ready: Make) -> None:
    camera = ready()
    with pytest.raises(CameraError, match="open another one"):
        camera.start()
    assert camera.dead_threads() == []
