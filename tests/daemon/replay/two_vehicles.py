"""The telemetry of two vehicles on one link."""

from __future__ import annotations

from collections.abc import Callable, Iterator

from dappled.drivers.mavlink import MavlinkMessage, mavlink, pack

Extra = Callable[[int], list[tuple[int, int, MavlinkMessage]]]  # of a step: system, component, message


def nothing_more(step: int) -> list[tuple[int, int, MavlinkMessage]]:
    return []


def camera_of_2(step: int) -> list[tuple[int, int, MavlinkMessage]]:
    return [(2, 100, mavlink.MAVLink_heartbeat_message(mavlink.MAV_TYPE_CAMERA, 8, 0, 0, 4, 3))]


def feedback_of_2(step: int) -> list[tuple[int, int, MavlinkMessage]]:
    values = step * 100_000, 2, 0, step, 0, 0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0, 0
    return [(2, 1, mavlink.MAVLink_camera_feedback_message(*values))]


def camera_of_both(step: int) -> list[tuple[int, int, MavlinkMessage]]:
    return [*camera_of_2(step), (1, 100, camera_of_2(step)[0][2])]


def records(
    begin_us: int, *, extra: Extra = nothing_more, moving: tuple[int, ...] = (), version_1: bool = False
) -> Iterator[tuple[int, bytes]]:
    """(stamp, packet) of ten seconds of vehicles 1 (at 10° north) and 2 (at 20° north); 1 is heard first."""
    for step in range(100):
        packets = list(extra(step))
        for system in (1, 2):
            north, boot_ms = system * 10**8 + (step * 100 if system in moving else 0), 9000 + step * 100
            position = mavlink.MAVLink_global_position_int_message(boot_ms, north, 0, 10**5, 10**4, 0, 0, 0, 0)
            attitude = mavlink.MAVLink_attitude_quaternion_message(boot_ms, 1, 0, 0, 0, 0, 0, 0)
            packets += [(system, 1, position), (system, 1, attitude)]
        for system, component, message in packets:
            packer = mavlink.MAVLink(None, srcSystem=system, srcComponent=component)
            yield begin_us + step * 100_000, pack(message, packer, version_1=version_1)
