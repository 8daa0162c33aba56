"""The camera beside ArduPilot and PX4 as they behave: which of their messages are photographs, and whose."""

from __future__ import annotations

import pytest

from dappled.drivers.mavlink import MavlinkMessage, mavlink
from dappled.mocks.autopilot.personality import CameraPort, CameraTriggers
from tests.daemon.camera_protocol.test_component import GCS, Rig

AUTOPILOT = (1, 1)
BOOT_US = 300_000_000
UNIX_US = 1_790_000_000 * 10**6


def rig_of(**options: object) -> Rig:
    rig = Rig(**options)  # type: ignore[arg-type]  # as the rig takes them
    rig.hear(mavlink.MAVLink_heartbeat_message(2, 3, 0, 0, 4, 3), AUTOPILOT)
    rig.tick(4)
    return rig


def hear(rig: Rig, messages: list[MavlinkMessage]) -> None:
    for message in messages:
        rig.hear(message, AUTOPILOT)


@pytest.mark.parametrize("unix_us", [UNIX_US, 0])
@pytest.mark.parametrize("own", [0, 1])
def test_a_trigger_of_one_of_two_wired_cameras_is_one_shot_of_that_camera(own: int, unix_us: int) -> None:
    """ArduPilot reports both cameras at each trigger of one: three triggers were six shots."""
    rig = rig_of(feedback_is_shot=True, cam_idx=own)
    autopilot = CameraTriggers(cameras=(CameraPort("wire"), CameraPort("wire")))
    for number in range(6):
        rig.clock.advance(1.0)
        hear(rig, autopilot.trigger(BOOT_US + number * 10**6, unix_us and unix_us + number * 10**6, camera=number % 2))
        assert len(rig.fired) == (number + 2 - own) // 2


@pytest.mark.parametrize(
    ("personality", "wiring"), [("ardupilot", "mavlink"), ("ardupilot", "broadcast"), ("px4", "mavlink")]
)
def test_a_trigger_over_mavlink_is_one_shot_at_five_a_second(personality: str, wiring: str) -> None:
    rig = rig_of(capacity=100)
    autopilot = CameraTriggers(personality, (CameraPort(wiring),))  # type: ignore[arg-type]  # one of the wirings
    for number in range(20):
        rig.clock.advance(0.2)
        hear(rig, autopilot.trigger(BOOT_US + number * 200_000, UNIX_US + number * 200_000))
    assert len(rig.fired) == 20


def test_the_last_trigger_of_an_earlier_minute_is_no_shot_when_another_camera_is_triggered() -> None:
    """The daemon started after our camera's last trigger, which ArduPilot repeats when it triggers the other one."""
    autopilot = CameraTriggers(cameras=(CameraPort("wire", pin=True), CameraPort("wire", pin=True)))
    for camera in (0, 1):
        autopilot.trigger(BOOT_US, camera=camera)
        autopilot.contact(BOOT_US, camera)
    rig = rig_of(feedback_is_shot=True)
    later_us = BOOT_US + 60 * 10**6
    rig.hear(mavlink.MAVLink_attitude_message(later_us // 1000, 0, 0, 0, 0, 0, 0), AUTOPILOT)
    hear(rig, autopilot.trigger(later_us, camera=1) + autopilot.contact(later_us, 1))
    assert rig.fired == []
    hear(rig, autopilot.trigger(later_us, camera=0) + autopilot.contact(later_us, 0))
    assert len(rig.fired) == 1


def test_a_pins_time_counts_as_now_after_it_has_wrapped() -> None:
    """ArduPilot counts it in 32 bits: 71.6 minutes after the boot it starts again."""
    rig = rig_of(feedback_is_shot=True)
    autopilot = CameraTriggers(cameras=(CameraPort("wire", pin=True),))
    late_us = 2**32 + 5_000_000
    rig.hear(mavlink.MAVLink_attitude_message(late_us // 1000, 0, 0, 0, 0, 0, 0), AUTOPILOT)
    hear(rig, autopilot.trigger(late_us) + autopilot.contact(late_us))
    assert len(rig.fired) == 1


@pytest.mark.parametrize("personality", ["ardupilot", "px4"])
def test_exposures_that_happened_are_never_refused_and_requests_to_fire_are_denied(personality: str) -> None:
    """Two shots may wait for their files; at 5 Hz twenty do."""
    rig = rig_of(capacity=2, fires=False)
    autopilot = CameraTriggers(personality, (CameraPort("wire"),))
    for number in range(20):
        rig.clock.advance(0.2)
        hear(rig, autopilot.trigger(BOOT_US + number * 200_000, UNIX_US + number * 200_000))
    assert len(rig.fired) == 20
    rig.clock.advance(3)
    said = ""
    for command, parameters in ((2000, (0, 0, 1, 7)), (2000, (0, 2, 5, 8)), (203, (0, 0, 0, 0, 1))):
        assert rig.command(command, *parameters) == mavlink.MAV_RESULT_DENIED
        said += "".join(m.text for m in rig.of("STATUSTEXT"))
        assert rig.command(command, *parameters, target=(1, 0)) is None
        assert rig.of("STATUSTEXT") == []
    assert said.count("something else fires it") == 1  # the same line is sent once in ten seconds
    assert len(rig.fired) == 20
    assert rig.shutter.statistics().interval_s is None


def test_px4_that_fires_by_wire_and_commands_too_is_accepted_as_the_same_shot() -> None:
    rig = rig_of(fires=False)
    hear(rig, CameraTriggers("px4").trigger(BOOT_US))
    assert len(rig.fired) == 1
    assert [m.result for m in rig.of("COMMAND_ACK")] == [mavlink.MAV_RESULT_ACCEPTED]
    assert GCS not in {(m.target_system, m.target_component) for m in rig.of("COMMAND_ACK")}
