"""Tags against the truth that only the simulation knows: when each frame was exposed, where, and how it pointed."""

from __future__ import annotations

import json
import math
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from dappled.clock import SystemClock
from dappled.config.settings import Settings, resolve
from dappled.daemon.service import Service
from dappled.decode.geometry import metres_per_radian
from dappled.flight import flight_report
from dappled.mocks.autopilot.path import FlightPath
from dappled.mocks.simulation import Simulation, World

SEED, FRAMES, GROUND_M = 8, 3, 12.5


@pytest.mark.alone
@pytest.mark.long  # 12 s; and its tolerance is of milliseconds, which a machine busy with other tests does not keep
def test_tags_hold_the_true_time_place_and_attitude(tmp_path: Path, sockets: Path) -> None:
    """The body's latency is 60 ± 15 ms, the vehicle flies 4 m/s and sways; the autopilot's clock drifts by 50 ppm."""
    truth = tmp_path / "truth"
    truth.mkdir()
    settings = resolve(Settings())
    settings = replace(
        settings,
        record=replace(settings.record, directory=str(tmp_path / "flights")),
        publish=replace(settings.publish, slices=f"ipc://{sockets}/truth", ask=""),
        decode=replace(settings.decode, enabled=False),
    )
    clock = SystemClock()
    simulation = Simulation(World(seed=SEED, truth=truth, ground_m=GROUND_M), settings, tmp_path)
    with simulation as simulated:
        service = Service(simulated, clock=clock)
        service.start()
        try:
            service.run(lambda: service.health()["camera"]["state"] == "ready")
            station = simulation.ground_station(FRAMES)
            service.run(lambda: not station.running())
        finally:
            service.stop()
        code, _ = station.wait(10)
    assert code == 0
    path = FlightPath(SEED)
    lines = flight_report.show(service.folder).lines
    assert len(lines) == FRAMES
    for line, shot in zip(lines, sorted(truth.glob("*.json")), strict=True):
        tag = line.tag
        assert tag is not None
        pose = tag.pose
        assert pose.source == "interpolated"
        assert pose.latitude_rad is not None
        assert pose.longitude_rad is not None
        assert pose.altitude_msl_m is not None
        assert pose.attitude is not None
        tagged_t_s = (tag.utc_ns - clock.utc_minus_monotonic_ns - simulation.start_monotonic_ns) / 1e9
        exposed_t_s = json.loads(shot.read_text())["mid_exposure_t_s"]
        assert abs(tagged_t_s - exposed_t_s) < 0.018  # ± 15 ms of latency that nobody can know, and the way to the body
        true = path.pose(tagged_t_s)
        north_m, east_m = metres_per_radian(pose.latitude_rad, pose.altitude_msl_m)
        north = (pose.latitude_rad - math.radians(true.latitude_deg)) * north_m
        east = (pose.longitude_rad - math.radians(true.longitude_deg)) * east_m
        assert math.hypot(north, east) < 0.05
        assert abs(pose.altitude_msl_m - true.altitude_msl_m) < 0.05
        turn = 2 * math.degrees(math.acos(min(1.0, abs(float(np.dot(pose.attitude, true.attitude))))))
        assert turn < 0.2
        assert pose.ground is not None
        assert pose.ground.source == "rangefinder"
        assert pose.height_above_home_m is not None
        assert pose.ground.metres == pytest.approx(pose.height_above_home_m - GROUND_M, abs=0.3)  # 5 cm, and its age
        at_exposure = path.pose(exposed_t_s)  # what the frame shows; within what the tag says of itself
        moved = math.dist(true.position_ned_m, at_exposure.position_ned_m)
        assert moved < 3 * tag.utc_sigma_ns / 1e9 * path.speed_m_s
