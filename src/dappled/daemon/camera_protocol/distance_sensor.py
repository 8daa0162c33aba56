"""The nearest distance in a frame as MAVLink DISTANCE_SENSOR, for an autopilot that is set up to listen."""

from __future__ import annotations

from collections.abc import Sequence

from dappled.drivers.mavlink.links import Message, mavlink

_NEAREST_M, _FARTHEST_M = 0.3, 655.0  # what the message's centimetres can say
_UNKNOWN_VARIANCE = 255
_DOWN, _FORWARD = mavlink.MAV_SENSOR_ROTATION_PITCH_270, mavlink.MAV_SENSOR_ROTATION_NONE


def orientation(mount: Sequence[float]) -> int | None:
    """MAV_SENSOR_ORIENTATION of a mount (camera axes to body, row by row): down or forward, None for another one."""
    forward, _, down = mount[2], mount[5], mount[8]  # where the camera's axis points on the vehicle
    if down > 0.9:
        return int(_DOWN)
    return int(_FORWARD) if forward > 0.9 else None


def message(nearest: tuple[float, float], boot_ms: int, mount: Sequence[float]) -> Message | None:
    """DISTANCE_SENSOR (132) of a distance and its standard error in m; None where the camera looks aside, or the
    distance is beyond what the message can say."""
    distance_m, sigma_m = nearest
    looks = orientation(mount)
    if looks is None or not _NEAREST_M <= distance_m <= _FARTHEST_M:
        return None
    variance_cm2 = (100 * sigma_m) ** 2
    return mavlink.MAVLink_distance_sensor_message(
        boot_ms,
        round(100 * _NEAREST_M),
        round(100 * _FARTHEST_M),
        round(100 * distance_m),
        mavlink.MAV_DISTANCE_SENSOR_UNKNOWN,
        0,
        looks,
        round(variance_cm2) if variance_cm2 < _UNKNOWN_VARIANCE - 0.5 else _UNKNOWN_VARIANCE,
    )
