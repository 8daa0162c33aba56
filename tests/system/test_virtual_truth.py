"""Virtual flights against the truth that only the simulation knows: when, where and how each frame was taken."""

from __future__ import annotations

import math
from itertools import pairwise
from pathlib import Path

import numpy as np
import pytest

from dappled.decode.geometry import metres_per_radian
from dappled.flight import LedgerReader
from tests.simulated.bad_link import LinkFaults
from tests.simulated.virtual_flight import Airborne, MemoryCamera, Plan, airborne
from tests.system.flying import told

GROUND_M, APART_M = 12.5, 12.0
GOOD = LinkFaults(late_s=0.03)


def test_tags_hold_the_true_time_place_and_attitude(tmp_path: Path) -> None:
    """The body's latency is 60 ± 15 ms, the vehicle flies 4 m/s and sways; the autopilot's clock drifts by 50 ppm."""
    with airborne(Plan(8, 0, 0.0, faults=GOOD, ground_m=GROUND_M), tmp_path) as now:
        now.clock.sleep(5.0)
        assert all(one.ok for one in now.ground.capture(5, 2.0))
    path, offset_ns = now.path, now.clock.utc_ns() - now.clock.monotonic_ns()
    assert isinstance(now.camera, MemoryCamera)
    with LedgerReader.open(now.flown.folder / "flight.sqlite") as ledger:
        tags = {index: ledger.tag(index) for index in range(5)}
    for index, tag in tags.items():
        assert tag is not None
        pose, exposed_ns = tag.pose, now.camera.exposed_ns[index]
        assert pose.source == "interpolated"
        assert pose.latitude_rad is not None
        assert pose.longitude_rad is not None
        assert pose.altitude_msl_m is not None
        assert pose.attitude is not None
        assert abs(tag.utc_ns - offset_ns - exposed_ns) <= 15 * 10**6  # of latency that nobody can know
        true = path.pose((tag.utc_ns - offset_ns - now.began_ns) / 1e9)
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
        at_exposure = path.pose((exposed_ns - now.began_ns) / 1e9)  # what it shows; within what the tag says of itself
        moved = math.dist(true.position_ned_m, at_exposure.position_ned_m)
        assert moved < 3 * tag.utc_sigma_ns / 1e9 * path.speed_m_s


def test_photographs_by_distance_begin_by_height_and_end_and_change_on_command(tmp_path: Path) -> None:
    counts = []

    def until(now: Airborne, photographs: int) -> None:
        assert now.clock.until(lambda: now.service.requested >= photographs, 60)
        counts.append(now.service.requested)

    trigger = {"distance_m": APART_M, "from_height_m": 5.0}
    with airborne(Plan(1, 0, 0.0, hz=20.0, faults=GOOD), tmp_path, trigger=trigger) as now:
        until(now, 4)
        now.ground.by_distance(0)
        now.clock.sleep(30.0)
        assert now.service.requested == counts[0]
        now.ground.by_distance(2 * APART_M)
        until(now, counts[0] + 3)
        now.ground.by_distance(None)
        until(now, counts[1] + 3)
    first, second, _ = counts
    with LedgerReader.open(now.flown.folder / "flight.sqlite") as ledger:
        shots, poses = [row.shot for row in ledger.shots()], ledger.poses()
    assert [shot.cause.kind for shot in shots] == ["distance"] * len(shots)
    assert {shot.cause.source for shot in shots[:first]} == {"settings"}
    assert {shot.cause.source.partition(":")[0] for shot in shots[first:]} == {"mavlink"}
    apart = []
    for one, other in pairwise(poses[shot.index] for shot in shots):
        assert one.latitude_rad is not None
        assert one.longitude_rad is not None
        assert other.latitude_rad is not None
        assert other.longitude_rad is not None
        north_m, east_m = metres_per_radian(one.latitude_rad, one.altitude_msl_m or 0.0)
        north, east = other.latitude_rad - one.latitude_rad, other.longitude_rad - one.longitude_rad
        apart.append(math.hypot(north * north_m, east * east_m))
    assert apart[1 : first - 1] == pytest.approx([APART_M] * (first - 2), abs=1.5)
    assert apart[first : second - 1] == pytest.approx([2 * APART_M] * (second - first - 1), abs=1.5)
    assert apart[second:] == pytest.approx([APART_M] * (len(apart) - second), abs=1.5)
    assert not any(event.startswith("refused") for event in told(now.flown.folder))
