"""The simulated autopilots send what real ones were seen to send for their cameras."""

from __future__ import annotations

import math
from dataclasses import replace

import pytest

from dappled.daemon.camera_protocol.own_autopilot import TargetedTimesync
from dappled.drivers.mavlink import MavlinkMessage, Packet, PacketParser, mavlink, pack
from dappled.mocks.autopilot.autopilot import BootTime
from dappled.mocks.autopilot.path import FlightPath
from tests.simulated.on_request import OnRequest, distance
from tests.simulated.personality import CameraPort, CameraTriggers
from tests.simulated.vehicle import Vehicle

BOOT_US, UNIX_US = 300_000_000, 1_790_000_000 * 10**6
WIRED = CameraPort("wire", pin=True)


def kinds(messages: list[MavlinkMessage]) -> list[str]:
    return [message.get_type() for message in messages]


def test_a_trigger_of_one_camera_reports_all_of_them() -> None:
    """(time, cam_idx 0, img 1) and (0, cam_idx 1, img 0)."""
    autopilot = CameraTriggers(cameras=(CameraPort("wire"), CameraPort("wire")))
    told = [(m.time_usec, m.cam_idx, m.img_idx) for m in autopilot.trigger(BOOT_US, UNIX_US, camera=0)]
    assert told == [(UNIX_US, 0, 1), (0, 1, 0)]


def test_a_pin_sleeps_until_the_autopilot_has_triggered_its_camera() -> None:
    autopilot = CameraTriggers(cameras=(WIRED, WIRED))
    assert autopilot.contact(BOOT_US, 1) == []
    assert autopilot.trigger(BOOT_US, UNIX_US, camera=0) == []
    assert autopilot.contact(BOOT_US, 1) == []
    assert kinds(autopilot.contact(BOOT_US, 0)) == ["CAMERA_FEEDBACK"] * 2


def test_a_pins_time_has_32_bits() -> None:
    autopilot = CameraTriggers(cameras=(WIRED,))
    autopilot.trigger(2**32)
    assert [m.time_usec for m in autopilot.contact(2**32 + 7)] == [7]


@pytest.mark.parametrize(("command", "parameters"), [(2000, (0, 0, 1, 0)), (203, (0, 0, 0, 0, 1))])
def test_a_broadcast_is_executed_and_one_to_a_camera_is_not(command: int, parameters: tuple[float, ...]) -> None:
    autopilot = CameraTriggers()
    padded = (*parameters, *[0.0] * (7 - len(parameters)))
    asked = mavlink.MAVLink_command_long_message(0, 0, command, 0, *padded)
    (request, _) = autopilot.command(asked, BOOT_US, UNIX_US)
    assert (request.command, request.target_component, request.param4) == (2000, 100, 1)
    asked.target_component = 100
    assert autopilot.command(asked, BOOT_US, UNIX_US) == []


def test_px4_sends_a_trigger_a_request_to_each_of_six_cameras_and_a_broadcast() -> None:
    autopilot = CameraTriggers("px4")
    sent = autopilot.trigger(BOOT_US)
    assert kinds(sent) == ["CAMERA_TRIGGER", *["COMMAND_LONG"] * 7]
    assert [m.target_component for m in sent[1:]] == [100, 101, 102, 103, 104, 105, 0]
    assert [m.param4 for m in sent[1:7]] == [1, 2, 3, 4, 5, 6]
    assert kinds(CameraTriggers("px4", (CameraPort("wire"),)).trigger(BOOT_US)) == ["CAMERA_TRIGGER"]


def test_a_request_for_one_camera_of_two_triggers_that_one() -> None:
    """Parameter 1 of IMAGE_START_CAPTURE is the camera, from 1; 0 is all of them."""
    autopilot = CameraTriggers(cameras=(CameraPort("mavlink"), CameraPort("mavlink")))
    for camera, images in ((1, [1, 0]), (2, [1, 1]), (2, [1, 2]), (0, [2, 3])):
        asked = mavlink.MAVLink_command_long_message(1, 1, 2000, 0, camera, 0, 1, 0, 0, 0, 0)
        sent = autopilot.command(asked, 10**6, UNIX_US)
        assert autopilot.images == images
        targets = [m.target_component for m in sent if m.get_type() == "COMMAND_LONG"]
        assert targets == ([99 + camera] if camera else [100, 101])


def flyer(sent: list[MavlinkMessage], has: OnRequest | None = None) -> Vehicle:
    return Vehicle(FlightPath(1), 0, BootTime(), sent.append, request=has or OnRequest())


def heard(message: MavlinkMessage) -> Packet:
    raw = pack(message, mavlink.MAVLink(None, 1, 100), version_1=False)
    received = PacketParser()(raw)
    assert received is not None
    return Packet(0, 0, 0, received, raw)


@pytest.mark.parametrize(
    ("has", "kind", "sends"),
    [
        (OnRequest(gimbal=True), "GIMBAL_DEVICE_ATTITUDE_STATUS", True),
        (OnRequest(), "GIMBAL_DEVICE_ATTITUDE_STATUS", False),
        (OnRequest(), "SYS_STATUS", True),
        (OnRequest(ground_m=5.0), "DISTANCE_SENSOR", True),
        (OnRequest(ground_m=5.0), "TERRAIN_REPORT", True),
        (OnRequest(), "DISTANCE_SENSOR", False),
        (OnRequest(), "TERRAIN_REPORT", False),
    ],
)
def test_what_a_vehicle_has_is_sent_on_request_alone(has: OnRequest, kind: str, sends: bool) -> None:
    sent: list[MavlinkMessage] = []
    vehicle = flyer(sent, has)
    number = getattr(mavlink, f"MAVLINK_MSG_ID_{kind}")
    vehicle.step(10**9)
    assert kind not in {m.get_type() for m in sent}
    vehicle.on_packet(heard(mavlink.MAVLink_command_long_message(1, 1, 511, 0, number, 50_000, 0, 0, 0, 0, 0)))
    vehicle.step(2 * 10**9)
    assert (kind in {m.get_type() for m in sent}) == sends
    accepted = mavlink.MAV_RESULT_ACCEPTED if sends else mavlink.MAV_RESULT_UNSUPPORTED
    assert [m.result for m in sent if m.get_type() == "COMMAND_ACK"] == [accepted]


def test_a_rangefinder_measures_along_its_beam_and_ends_at_its_reach() -> None:
    level = FlightPath(1).pose(10.0)
    turn = math.radians(25)
    tilted = replace(level, attitude=(math.cos(turn / 2), math.sin(turn / 2), 0.0, 0.0))
    assert distance(20.0, tilted, 10**9).current_distance == round(2000 / math.cos(turn))
    assert distance(80.0, tilted, 10**9).current_distance == distance(80.0, tilted, 10**9).max_distance


@pytest.mark.parametrize(("system", "answered"), [(1, True), (0, True), (2, False)])
def test_a_request_for_the_time_of_another_system_is_not_answered(system: int, answered: bool) -> None:
    sent: list[MavlinkMessage] = []
    flyer(sent).on_packet(heard(TargetedTimesync(1234, system)))
    assert [m.ts1 for m in sent] == ([1234] if answered else [])
