"""Autopilot and ground station as processes, a whole camera between them, over real UDP."""

from __future__ import annotations

import math
import time
from collections.abc import Iterator

import pytest

from dappled.daemon.camera_protocol.ground_client import GroundClient, GroundStationError
from dappled.daemon.navigation.clocks import BootClock
from dappled.decode.geometry import turn_rad
from dappled.mocks.autopilot.autopilot import Autopilot, BootTime
from dappled.mocks.autopilot.ground_station import GroundStation
from dappled.mocks.autopilot.path import FlightPath
from tests.daemon.camera_protocol.rig import Camera


@pytest.fixture
def camera() -> Iterator[Camera]:
    with Camera(fails=[2], settled=False) as camera:
        yield camera


def test_a_ground_station_process_gets_every_photograph_or_hears_that_it_failed(camera: Camera) -> None:
    ground = GroundStation.start(camera.url, 4, timeout_s=60)
    code, lines = ground.wait(100)
    assert [(line["index"], line["ok"]) for line in lines] == [(0, True), (1, True), (2, False), (3, True)]
    assert code == 1
    assert camera.shutter.statistics().shots == 4


def test_the_client_reads_what_the_camera_is_and_asks_again_for_a_lost_report(camera: Camera) -> None:
    camera.component.announce = lambda captured: False  # type: ignore[method-assign]  # every report is lost
    with GroundClient(camera.url) as client:
        assert client.find_camera() == (1, 100)
        information = client.request(259)
        assert information is not None
        assert bytes(information.model_name).rstrip(b"\0") == b"test"
        (outcome,) = client.capture(1, timeout_s=60)
        assert (outcome.index, outcome.ok) == (0, True)


def test_nobody_there_is_said_in_one_sentence() -> None:
    with GroundClient("udpin:127.0.0.1:0") as client, pytest.raises(GroundStationError, match="no camera was heard"):
        client.find_camera(0.2)


def test_the_autopilot_process_flies_the_path_in_its_own_time(camera: Camera) -> None:
    start_ns = time.monotonic_ns()
    autopilot = Autopilot.start(camera.url, seed=4, start_monotonic_ns=start_ns)
    try:
        deadline = time.monotonic() + 60
        clock: BootClock | None = None
        while time.monotonic() < deadline:
            clock = camera.telemetry.boot_clock()
            if clock is not None and clock.source == "timesync":
                break
            time.sleep(0.05)
        assert clock is not None
        assert clock.source == "timesync"
        utc_ns = camera.clock.utc_ns()
        while not camera.telemetry.bracketed(utc_ns) and time.monotonic() < deadline:
            time.sleep(0.01)
        pose = camera.telemetry.pose_at(utc_ns, 0)
        offset_ns = camera.clock.utc_ns() - camera.clock.monotonic_ns()
        t_s = (utc_ns - offset_ns - start_ns) / 1e9
        truth = FlightPath(4).pose(t_s)
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
    assert autopilot._process.wait(60) == 0
