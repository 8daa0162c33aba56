"""The simulated flight is smooth, agrees with itself, and stands where the ellipsoid says."""

from __future__ import annotations

import math

import pytest
from pyproj import Geod
from scipy.spatial.transform import Rotation

from dappled.decode.geometry import from_euler, metres_per_radian, turn_rad
from dappled.mocks.autopilot.path import FlightPath, TruePose

TIMES_S = (0.0, 3.7, 61.2, 599.0)


def turn(pose: TruePose) -> Rotation:
    w, x, y, z = pose.attitude
    return Rotation.from_quat((x, y, z, w))


@pytest.mark.parametrize("t_s", TIMES_S)
@pytest.mark.parametrize("seed", [1, 5])
def test_velocity_and_rates_lead_to_the_next_pose(seed: int, t_s: float) -> None:
    path, span_s = FlightPath(seed), 0.02
    here, there, middle = path.pose(t_s), path.pose(t_s + span_s), path.pose(t_s + span_s / 2)
    for axis in range(3):
        moved = here.position_ned_m[axis] + middle.velocity_ned_m_s[axis] * span_s
        assert there.position_ned_m[axis] == pytest.approx(moved, abs=1e-5)
    turned = turn(here) * Rotation.from_rotvec([rate * span_s for rate in middle.rates_body_rad_s])
    assert (turned.inv() * turn(there)).magnitude() < 1e-5


@pytest.mark.parametrize("t_s", TIMES_S)
def test_its_place_is_the_ellipsoids(t_s: float) -> None:
    path = FlightPath(2, home_altitude_msl_m=0.0)
    pose = path.pose(t_s)
    azimuth_deg, _, metres = Geod(ellps="WGS84").inv(
        path.home_longitude_deg, path.home_latitude_deg, pose.longitude_deg, pose.latitude_deg
    )
    north, east, down = pose.position_ned_m
    assert metres == pytest.approx(math.hypot(north, east), abs=1e-3)
    assert metres * math.sin(math.radians(azimuth_deg)) == pytest.approx(east, abs=1e-3)
    assert pose.altitude_msl_m == pytest.approx(-down)


@pytest.mark.parametrize("t_s", TIMES_S)
def test_the_daemons_mathematics_is_another_and_says_the_same(t_s: float) -> None:
    path = FlightPath(3)
    pose = path.pose(t_s)
    yaw, pitch, roll = turn(pose).as_euler("ZYX")
    assert turn_rad(from_euler(roll, pitch, yaw), pose.attitude) < 1e-7
    north_m, east_m = metres_per_radian(math.radians(path.home_latitude_deg), path.home_altitude_msl_m)
    north, east, _ = pose.position_ned_m
    assert math.radians(pose.latitude_deg - path.home_latitude_deg) * north_m == pytest.approx(north, abs=1e-6)
    assert math.radians(pose.longitude_deg - path.home_longitude_deg) * east_m == pytest.approx(east, abs=1e-6)
