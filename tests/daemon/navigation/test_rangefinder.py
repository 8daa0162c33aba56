"""What a rangefinder says of the height, and when it says nothing."""

from __future__ import annotations

import pytest

from dappled.clock import RecordedClock
from dappled.daemon.navigation.rangefinder import Range, Rangefinder
from dappled.drivers.mavlink import MavlinkMessage, Packet, mavlink, pack

VEHICLE = 1


def distance(cm: int = 2000, *, orientation: int = 25, variance: int = 4, quality: int = 0) -> MavlinkMessage:
    return mavlink.MAVLink_distance_sensor_message(
        1000, 10, 4000, cm, 0, 0, orientation, variance, signal_quality=quality
    )


class Rig:
    """A rangefinder that hears messages of a vehicle."""

    def __init__(self) -> None:
        self.clock = RecordedClock(10**18, 5 * 10**9)
        self.finder = Rangefinder(self.clock)

    def hear(self, message: MavlinkMessage, sender: tuple[int, int] = (VEHICLE, 1), *, sent: bool = False) -> None:
        raw = pack(message, mavlink.MAVLink(None, *sender), version_1=False)
        self.finder.heard(Packet(0, 0, 0, message, raw, sent), VEHICLE)


def test_a_distance_down_is_the_range_for_a_second() -> None:
    rig = Rig()
    assert rig.finder.range() is None
    rig.hear(distance())
    rig.clock.advance(1.0)
    assert rig.finder.range() == Range(20.0, 0.02)
    rig.clock.advance(0.001)
    assert rig.finder.range() is None


@pytest.mark.parametrize(
    "other",
    [distance(4000), distance(10), distance(0), distance(quality=1), distance(65535)],
    ids=["at its farthest", "at its nearest", "nothing", "invalid", "beyond"],
)
def test_beyond_its_limits_it_says_nothing_and_an_older_distance_holds_no_more(other: MavlinkMessage) -> None:
    rig = Rig()
    rig.hear(distance())
    rig.hear(other)
    assert rig.finder.range() is None


@pytest.mark.parametrize(
    ("message", "sender", "sent"),
    [
        (distance(orientation=0), (VEHICLE, 1), False),
        (mavlink.MAVLink_attitude_message(0, 0, 0, 0, 0, 0, 0), (VEHICLE, 1), False),
        (distance(), (2, 1), False),
        (distance(), (VEHICLE, 154), False),
        (distance(), (VEHICLE, 1), True),
    ],
    ids=["it looks ahead", "no distance", "another vehicle's", "not the autopilot's", "our own"],
)
def test_what_is_not_the_vehicle_s_height_is_passed_over(
    message: MavlinkMessage, sender: tuple[int, int], sent: bool
) -> None:
    rig = Rig()
    rig.hear(message, sender, sent=sent)
    assert rig.finder.range() is None


@pytest.mark.parametrize("variance", [0, 255])
def test_an_accuracy_that_is_not_told_is_unknown(variance: int) -> None:
    rig = Rig()
    rig.hear(distance(variance=variance))
    assert rig.finder.range() == Range(20.0, None)
