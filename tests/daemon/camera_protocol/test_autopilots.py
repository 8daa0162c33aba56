"""The camera beside ArduPilot and PX4 as they behave: which of their messages are photographs, and whose."""

from __future__ import annotations

import pytest

from dappled.drivers.mavlink import MavlinkMessage, mavlink
from dappled.mocks.autopilot.personality import CameraPort, CameraTriggers
from dappled.refusals import LostTriggers
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


@pytest.mark.parametrize("own", [0, 1])
@pytest.mark.parametrize("gap_s", [0.2, 1.0, 4.0])
@pytest.mark.parametrize("order", [(0, 1), (1, 0)])
def test_two_wired_cameras_triggered_together_are_one_shot_of_ours_each_time(
    own: int, gap_s: float, order: tuple[int, int]
) -> None:
    rig = rig_of(feedback_is_shot=True, cam_idx=own)
    autopilot = CameraTriggers(cameras=(CameraPort("wire", pin=True), CameraPort("wire", pin=True)))
    for number in range(6):
        rig.clock.advance(gap_s)
        at_us = BOOT_US + round(number * gap_s * 1e6)
        rig.hear(mavlink.MAVLink_attitude_message(at_us // 1000, 0, 0, 0, 0, 0, 0), AUTOPILOT)
        hear(rig, autopilot.trigger(at_us))
        for place, camera in enumerate(order):
            hear(rig, autopilot.contact(at_us + 55_000 + 5_000 * place, camera))
        assert len(rig.fired) == number + 1


@pytest.mark.parametrize("unix_us", [0, UNIX_US])
def test_what_another_camera_repeats_before_any_clock_is_known_is_no_shot(unix_us: int) -> None:
    """The daemon starts in flight; ours was last triggered a minute ago, without satellites or before SYSTEM_TIME."""
    autopilot = CameraTriggers(cameras=(CameraPort("wire"), CameraPort("wire")))
    for number in range(5):
        autopilot.trigger(BOOT_US + number * 10**6, unix_us and unix_us + number * 10**6, camera=0)
    rig = rig_of(feedback_is_shot=True)
    for number in range(60, 63):
        rig.clock.advance(1)
        hear(rig, autopilot.trigger(BOOT_US + number * 10**6, unix_us and unix_us + number * 10**6, camera=1))
    assert rig.fired == []
    hear(rig, autopilot.trigger(BOOT_US + 64 * 10**6, unix_us and unix_us + 64 * 10**6, camera=0))
    assert len(rig.fired) == 1
    rig.tick(4)
    assert [(one.first, one.last) for one in rig.lost_triggers] == [(5, 5)]  # it may have been one: it is told


def test_an_autopilot_without_time_that_starts_again_begins_its_numbers_again() -> None:
    """The first of its messages is lost: the second may be a repeated one and is told, the third is a shot."""
    rig = rig_of(feedback_is_shot=True)
    for missed in (0, 1):
        autopilot = CameraTriggers(cameras=(CameraPort("wire"),))
        rig.hear(mavlink.MAVLink_attitude_message(BOOT_US // 1000, 0, 0, 0, 0, 0, 0), AUTOPILOT)
        for number in range(3):
            rig.clock.advance(1)
            messages = autopilot.trigger(BOOT_US + number * 10**6)
            hear(rig, messages if number >= missed else [])
        rig.hear(mavlink.MAVLink_attitude_message(BOOT_US // 1000 + 60_000, 0, 0, 0, 0, 0, 0), AUTOPILOT)
    rig.tick(4)
    assert len(rig.fired) == 4
    assert [(one.first, one.last) for one in rig.lost_triggers] == [(2, 2)]


@pytest.mark.parametrize("personality", ["ardupilot", "px4"])
@pytest.mark.parametrize(("command", "parameters"), [(2000, (0, 0, 1, 0)), (203, (0, 0, 0, 0, 1))])
@pytest.mark.parametrize("autopilot_first", [True, False])
def test_a_broadcast_through_the_component_is_one_shot_and_one_refusal(
    personality: str, command: int, parameters: tuple[float, ...], autopilot_first: bool
) -> None:
    for capacity in (8, 0):
        rig = rig_of(capacity=capacity)
        autopilot = CameraTriggers(personality)
        for turn in range(3):
            rig.tick(3)
            padded = (*parameters, *[0.0] * (7 - len(parameters)))
            asked = mavlink.MAVLink_command_long_message(0, 0, command, 0, *padded)
            made = autopilot.trigger(BOOT_US + turn * 3 * 10**6, UNIX_US + turn * 3 * 10**6)
            made = [m for m in made if getattr(m, "target_component", 100) in (0, 100)]
            if autopilot_first:
                hear(rig, made)
            rig.hear(asked)
            if not autopilot_first:
                hear(rig, made)
        if capacity:
            assert len(rig.fired) == 3
        elif personality == "ardupilot":
            assert (rig.fired, rig.shutter.statistics().refused) == ([], 3)


LOST = ((4,), (4, 5, 6), (2, 9), ())


@pytest.mark.parametrize("lost", LOST)
@pytest.mark.parametrize(
    ("personality", "port", "what"),
    [
        ("ardupilot", CameraPort(), "all"),
        ("ardupilot", CameraPort(), "COMMAND_LONG"),
        ("ardupilot", CameraPort("wire"), "all"),
        ("px4", CameraPort(), "all"),
        ("px4", CameraPort("wire"), "all"),
    ],
)
def test_each_trigger_that_was_lost_on_the_link_is_named(
    personality: str, port: CameraPort, what: str, lost: tuple[int, ...]
) -> None:
    """The link was down for 8 s: 36 triggers, 33 received, and the counts agreed."""
    rig = Rig(fires=port.wiring != "wire", capacity=100)
    kind = mavlink.MAV_AUTOPILOT_PX4 if personality == "px4" else mavlink.MAV_AUTOPILOT_ARDUPILOTMEGA
    rig.hear(mavlink.MAVLink_heartbeat_message(2, kind, 0, 0, 4, 3), AUTOPILOT)
    rig.tick(4)
    autopilot = CameraTriggers(personality, (port,))
    said = ""
    for number in range(1, 13):
        rig.tick(1.0)
        said += "".join(m.text for m in rig.of("STATUSTEXT"))
        messages = autopilot.trigger(BOOT_US + number * 10**6, UNIX_US + number * 10**6)
        hear(rig, [m for m in messages if number not in lost or (what != "all" and m.get_type() != what)])
    rig.tick(3)
    said += "".join(m.text for m in rig.of("STATUSTEXT"))
    named = {number for one in rig.lost_triggers for number in range(one.first, one.last + 1)}
    assert named == set(lost)
    assert len(rig.fired) == 12 - len(lost)
    assert sum(one.count for one in rig.lost_triggers) == len(lost)
    assert ("lost: the autopilot's trigger" in said) == bool(lost)
    for one in rig.lost_triggers:
        assert one.where.startswith("noticed at 20")
        assert LostTriggers.of_text(one.text()) == one
    assert "lost" not in "".join(rig.tick(10))


def test_messages_that_are_lost_out_of_order_or_start_again_are_no_lost_triggers() -> None:
    """PX4's numbered message alone is lost; ArduPilot's requests come late over a second link; it starts again."""
    rig = Rig(capacity=100)
    rig.hear(mavlink.MAVLink_heartbeat_message(2, mavlink.MAV_AUTOPILOT_PX4, 0, 0, 4, 3), AUTOPILOT)
    rig.tick(4)
    px4 = CameraTriggers("px4")
    for number in range(8):
        rig.tick(1.0)
        messages = px4.trigger(BOOT_US + number * 10**6)
        hear(rig, messages[1:] if number in (3, 4) else messages)
    rig.tick(5)
    assert (rig.lost_triggers, len(rig.fired)) == ([], 8)

    rig = rig_of(capacity=100)
    autopilot = CameraTriggers()
    sent = [autopilot.trigger(BOOT_US + number * 10**6, UNIX_US + number * 10**6) for number in range(6)]
    for number in (0, 1, 3, 2, 4, 5):
        rig.tick(0.5)
        hear(rig, sent[number])
    rig.hear(mavlink.MAVLink_attitude_message(300_000, 0, 0, 0, 0, 0, 0), AUTOPILOT)
    rig.hear(mavlink.MAVLink_attitude_message(1000, 0, 0, 0, 0, 0, 0), AUTOPILOT)
    rig.tick(1.0)
    hear(rig, CameraTriggers().trigger(10**6, UNIX_US + 20 * 10**6))
    rig.tick(5)
    assert (rig.lost_triggers, len(rig.fired)) == ([], 7)
