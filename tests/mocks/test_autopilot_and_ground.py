"""Autopilot and ground station as processes, a whole camera between them, over real UDP."""

from __future__ import annotations

import math
import queue
import threading
import time
from collections.abc import Iterator

import pytest

from dappled.daemon.boot_clock import BootClock
from dappled.daemon.clock import SystemClock
from dappled.daemon.component import CameraFacts, Captured, Component
from dappled.daemon.ground_client import GroundClient, GroundError
from dappled.daemon.interpolation import turn_rad
from dappled.daemon.knobs import Knobs
from dappled.daemon.shutter import Shutter
from dappled.daemon.telemetry import Telemetry
from dappled.drivers.camera import Setting, SettingName
from dappled.drivers.mavlink import MavlinkLinks, Packet
from dappled.mocks.autopilot import Autopilot, BootTime
from dappled.mocks.ground import GroundStation
from dappled.mocks.path import Path


class Camera:
    """A camera that has each frame 20 ms after the wish; index 2 fails."""

    def __init__(self) -> None:
        self.clock = SystemClock()
        self.telemetry = Telemetry()
        self.count = 0
        self.done: dict[int, Captured] = {}
        self.fired: queue.Queue[int | None] = queue.Queue()
        self.links = MavlinkLinks(
            ["udpin:127.0.0.1:0"],
            system_id=1,
            component_id=100,
            tap=self._tap,
            on_packet=self._on_packet,
            clock=self.clock,
        )
        self.shutter = Shutter(next_index=0, note=lambda _: None, fire=self.fired.put, clock=self.clock)
        self.component = Component(
            self.links,
            self.shutter,
            self.clock,
            Knobs(self),
            facts=lambda: CameraFacts("dappled", "test", (0, 1, 0)),
            storage=lambda: None,
            lookup=self.done.get,
        )
        self._worker = threading.Thread(target=self._work)

    def settings(self) -> tuple[Setting, ...]:
        return ()

    def change(self, name: SettingName, value: str) -> None:
        raise AssertionError

    @property
    def url(self) -> str:
        return f"udpout:127.0.0.1:{self.links.port(0)}"

    def _tap(self, stamp_us: int, raw: bytes) -> int:
        self.count += 1
        return self.count - 1

    def _on_packet(self, packet: Packet) -> None:
        assert packet.number is not None
        self.telemetry.feed(packet.number, packet.stamp_us, packet.message)
        self.component.on_packet(packet)

    def _work(self) -> None:
        while True:
            try:
                index = self.fired.get(timeout=0.02)
            except queue.Empty:
                self.component.tick()
                continue
            if index is None:
                return
            threading.Event().wait(0.02)
            captured = Captured(index, ok=index != 2, utc_ns=self.clock.utc_ns())
            self.done[index] = captured
            self.shutter.settled(index, captured.ok)
            self.component.announce(captured)

    def __enter__(self) -> Camera:
        self.links.start()
        self._worker.start()
        return self

    def __exit__(self, *_: object) -> None:
        self.shutter.stop()
        self.links.stop()
        self.fired.put(None)
        self._worker.join(5)


@pytest.fixture
def camera() -> Iterator[Camera]:
    with Camera() as camera:
        yield camera


def test_a_ground_station_process_gets_every_photograph_or_hears_that_it_failed(camera: Camera) -> None:
    ground = GroundStation.start(camera.url, 4, timeout_s=20)
    code, lines = ground.wait(60)
    assert [(line["index"], line["ok"]) for line in lines] == [(0, True), (1, True), (2, False), (3, True)]
    assert code == 1
    assert camera.shutter.statistics().shots == 4


def test_the_client_reads_what_the_camera_is_and_asks_again_for_a_lost_report(camera: Camera) -> None:
    camera.component.announce = lambda captured: None  # type: ignore[method-assign]  # every report is lost
    with GroundClient(camera.url) as client:
        assert client.find_camera() == (1, 100)
        information = client.request(259)
        assert information is not None
        assert bytes(information.model_name).rstrip(b"\0") == b"test"
        (outcome,) = client.capture(1, timeout_s=20)
        assert (outcome.index, outcome.ok) == (0, True)


def test_nobody_there_is_said_in_one_sentence() -> None:
    with GroundClient("udpin:127.0.0.1:0") as client, pytest.raises(GroundError, match="no camera was heard"):
        client.find_camera(0.2)


def test_the_autopilot_process_flies_the_path_in_its_own_time(camera: Camera) -> None:
    start_ns = time.monotonic_ns()
    autopilot = Autopilot.start(camera.url, seed=4, start_monotonic_ns=start_ns)
    try:
        deadline = time.monotonic() + 30
        clock: BootClock | None = None
        while time.monotonic() < deadline:
            clock = camera.telemetry.boot_clock()
            if camera.telemetry.statistics().timesync_answers >= 10 and clock is not None:
                break
            time.sleep(0.05)
        assert clock is not None
        assert clock.source == "timesync"
        utc_ns = camera.clock.utc_ns()
        while not camera.telemetry.bracketed(utc_ns) and time.monotonic() < deadline:
            time.sleep(0.01)
        pose = camera.telemetry.pose_at(utc_ns, 0)
        t_s = (utc_ns - camera.clock.utc_minus_monotonic_ns - start_ns) / 1e9
        truth = Path(4).pose(t_s)
        assert pose.source == "interpolated"
        assert pose.attitude is not None
        assert pose.latitude_rad is not None
        assert pose.position_sigma_m is not None
        assert abs(pose.latitude_rad - math.radians(truth.latitude_deg)) * 6.4e6 < 0.2
        assert math.degrees(turn_rad(pose.attitude, truth.attitude)) < 0.5
        assert pose.boot_us is not None
        assert abs(pose.boot_us * 1000 - BootTime().ns(t_s)) < 20e6
        assert camera.component.system_id == 1
    finally:
        autopilot.stop()
    assert not autopilot.running()


def test_an_autopilot_ends_with_the_one_that_started_it(camera: Camera) -> None:
    autopilot = Autopilot.start(camera.url, seed=1, start_monotonic_ns=time.monotonic_ns())
    stdin = autopilot._process.stdin
    assert stdin is not None
    stdin.close()
    assert autopilot._process.wait(10) == 0
