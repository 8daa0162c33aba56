from __future__ import annotations

import pytest

from dappled.daemon.camera_protocol.distance_sensor import message, orientation
from dappled.drivers.mavlink.links import mavlink

DOWN = (0.0, -1.0, 0.0, 1.0, 0.0, 0.0, 0.0, 0.0, 1.0)
FORWARD = (0.0, 0.0, 1.0, 1.0, 0.0, 0.0, 0.0, 1.0, 0.0)
ASIDE = (1.0, 0.0, 0.0, 0.0, 0.0, 1.0, 0.0, -1.0, 0.0)


@pytest.mark.parametrize(
    ("mount", "looks"),
    [
        (DOWN, mavlink.MAV_SENSOR_ROTATION_PITCH_270),
        (FORWARD, mavlink.MAV_SENSOR_ROTATION_NONE),
        (ASIDE, None),
    ],
)
def test_it_looks_where_the_camera_does(mount: tuple[float, ...], looks: int | None) -> None:
    assert orientation(mount) == looks
    told = message((7.5, 0.1), 1234, mount)
    assert (told is None) == (looks is None)
    if told is not None:
        assert told.orientation == looks
        assert told.current_distance == 750
        assert told.covariance == 100
        assert told.time_boot_ms == 1234


def test_what_the_message_cannot_say() -> None:
    vague = message((50.0, 4.0), 0, DOWN)
    assert vague is not None
    assert vague.covariance == 255  # unknown
    assert message((0.1, 0.01), 0, DOWN) is None
    assert message((900.0, 50.0), 0, DOWN) is None
    told = message((655.0, 1.0), 0, DOWN)
    assert told is not None
    assert told.pack(mavlink.MAVLink(None))  # fits the fields
