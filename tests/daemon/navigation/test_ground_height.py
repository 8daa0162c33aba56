"""What rangefinder and terrain say of the height above ground, and when they say nothing."""

from __future__ import annotations

import math

import pytest

from dappled.daemon.navigation.ground_height import ground_height, ground_sample
from dappled.daemon.navigation.navigation import Telemetry
from dappled.decode.geometry import GroundHeight, Quaternion, from_euler
from dappled.drivers.mavlink import MavlinkMessage, mavlink, pack

NOW_NS = 10**18
LEVEL: Quaternion = (1.0, 0.0, 0.0, 0.0)


def distance(cm: int = 2000, *, orientation: int = 25, variance: int = 4, quality: int = 0) -> MavlinkMessage:
    return mavlink.MAVLink_distance_sensor_message(
        1000, 10, 4000, cm, 0, 0, orientation, variance, signal_quality=quality
    )


def terrain(metres: float = 18.5, spacing: int = 100) -> MavlinkMessage:
    return mavlink.MAVLink_terrain_report_message(0, 0, spacing, 0.0, metres, 0, 4)


def sent_by(message: MavlinkMessage, system: int, component: int) -> MavlinkMessage:
    pack(message, mavlink.MAVLink(None, system, component), version_1=False)
    return message


def height(age_s: float, message: MavlinkMessage, attitude: Quaternion | None = LEVEL) -> GroundHeight | None:
    sample = ground_sample(0, NOW_NS - round(age_s * 1e9), message)
    return ground_height([] if sample is None else [sample], NOW_NS, attitude, None)


def test_a_distance_down_holds_for_a_second_and_terrain_for_three() -> None:
    assert height(1.0, distance()) == GroundHeight(20.0, 0.02, "rangefinder", 1000.0)
    assert height(1.001, distance()) is None
    assert height(3.0, terrain()) == GroundHeight(18.5, None, "terrain", 3000.0)
    assert height(3.001, terrain()) is None


def test_the_beam_is_along_the_vehicle_s_own_down() -> None:
    tilted = height(0.0, distance(), from_euler(math.radians(20), math.radians(-15), 1.0))
    assert tilted is not None
    assert tilted.metres == pytest.approx(20 * math.cos(math.radians(20)) * math.cos(math.radians(15)))
    assert height(0.0, distance(), from_euler(math.radians(61), 0.0, 0.0)) is None
    assert height(0.0, distance(), None) is None
    assert height(0.0, terrain(), None) is not None


@pytest.mark.parametrize(
    "other",
    [distance(4000), distance(10), distance(0), distance(quality=1), distance(65535)],
    ids=["at its farthest", "at its nearest", "nothing", "invalid", "beyond"],
)
def test_beyond_its_limits_it_says_nothing_and_an_older_distance_holds_no_more(other: MavlinkMessage) -> None:
    old, new, map_ = (
        ground_sample(number, NOW_NS - age_ns, one)
        for number, (age_ns, one) in enumerate(((5 * 10**8, distance()), (10**8, other), (10**8, terrain())))
    )
    assert old is not None
    assert new is not None
    assert map_ is not None
    assert ground_height([old, new], NOW_NS, LEVEL, None) is None
    assert ground_height([old, new, map_], NOW_NS, LEVEL, None) == GroundHeight(18.5, None, "terrain", 100.0)


def test_a_sensor_that_looks_ahead_and_terrain_that_is_not_there_say_nothing() -> None:
    assert ground_sample(0, NOW_NS, distance(orientation=0)) is None
    assert height(0.0, terrain(spacing=0)) is None
    assert height(0.0, terrain(math.nan)) is None


@pytest.mark.parametrize("variance", [0, 255])
def test_an_accuracy_that_is_not_told_is_unknown(variance: int) -> None:
    assert height(0.0, distance(variance=variance)) == GroundHeight(20.0, None, "rangefinder", 0.0)


def test_the_sigma_grows_as_the_vehicle_climbs() -> None:
    sample = ground_sample(0, NOW_NS - 5 * 10**8, distance())
    assert sample is not None
    found = ground_height([sample], NOW_NS, LEVEL, -4.0)
    assert found is not None
    assert found.sigma_m == pytest.approx(math.hypot(0.02, 2.0))


def test_only_our_vehicle_s_autopilot_counts() -> None:
    level = mavlink.MAVLink_attitude_message(1000, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0)
    for system, component, known in ((1, 1, True), (2, 1, False), (1, 154, False)):
        telemetry = Telemetry(vehicles=[(0, 1)])
        telemetry.feed(0, NOW_NS // 1000, sent_by(level, 1, 1))
        telemetry.feed(1, NOW_NS // 1000, sent_by(distance(), system, component))
        pose = telemetry.pose_at(NOW_NS, 0.0)
        assert pose.attitude is not None
        assert (pose.ground is not None) == known, (system, component)
