"""The camera beside ArduPilot and PX4 as they behave: which of their messages are photographs, and whose."""

from __future__ import annotations

import struct

import pytest

from dappled.daemon.vehicle_battery import VehicleBattery, battery_of
from dappled.drivers.mavlink import MavlinkMessage, PacketParser, mavlink, pack
from dappled.findings import Code, text
from tests.daemon.camera_protocol.test_component import GCS, Rig
from tests.simulated.personality import CameraPort, CameraTriggers
from tests.simulated.vehicle import heartbeat

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


def fly(rig: Rig, boot_s: float, seconds: float, *, at_hz: float = 10.0) -> None:
    """Telemetry of an autopilot that was booted `boot_s` ago."""
    for step in range(round(seconds * at_hz) + 1):
        boot_ms = round((boot_s + step / at_hz) * 1e3)
        rig.hear(mavlink.MAVLink_attitude_message(boot_ms, 0, 0, 0, 0, 0, 0), AUTOPILOT)
        rig.tick(1 / at_hz)


def named(rig: Rig) -> list[tuple[int, int]]:
    """The lost triggers that were told so far."""
    return [(first := one.number("first"), first + one.number("triggers") - 1) for one in rig.lost_triggers]


@pytest.mark.parametrize("unix_us", [UNIX_US, 0])
@pytest.mark.parametrize("own", [0, 1])
def test_a_trigger_of_one_of_two_wired_cameras_is_one_shot_of_that_camera(own: int, unix_us: int) -> None:
    """ArduPilot reports both cameras at each trigger of one: three triggers were six shots."""
    rig = rig_of(fires=False, cam_idx=own)
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
    rig = rig_of(fires=False)
    later_us = BOOT_US + 60 * 10**6
    rig.hear(mavlink.MAVLink_attitude_message(later_us // 1000, 0, 0, 0, 0, 0, 0), AUTOPILOT)
    hear(rig, autopilot.trigger(later_us, camera=1) + autopilot.contact(later_us, 1))
    assert rig.fired == []
    hear(rig, autopilot.trigger(later_us, camera=0) + autopilot.contact(later_us, 0))
    assert len(rig.fired) == 1


def test_a_pins_time_counts_as_now_after_it_has_wrapped() -> None:
    """ArduPilot counts it in 32 bits: 71.6 minutes after the boot it starts again."""
    rig = rig_of(fires=False)
    autopilot = CameraTriggers(cameras=(CameraPort("wire", pin=True),))
    late_us = 2**32 + 5_000_000
    rig.hear(mavlink.MAVLink_attitude_message(late_us // 1000, 0, 0, 0, 0, 0, 0), AUTOPILOT)
    hear(rig, autopilot.trigger(late_us) + autopilot.contact(late_us))
    assert len(rig.fired) == 1


@pytest.mark.parametrize(("late_s", "shots"), [(0.2, 2), (4.5, 2), (5.5, 1), (60.0, 1)])
def test_a_contact_that_is_reported_more_than_five_seconds_late_is_no_shot_and_is_named(
    late_s: float, shots: int
) -> None:
    """A slow radio is seconds behind; a frame that came long ago can't be told from the next one's."""
    rig = rig_of(fires=False)
    autopilot = CameraTriggers(cameras=(CameraPort("wire", pin=True),))
    booted_s = BOOT_US / 1e6
    fly(rig, booted_s, 1.0)
    hear(rig, autopilot.trigger(BOOT_US + 10**6) + autopilot.contact(BOOT_US + 10**6))
    assert len(rig.fired) == 1
    held = autopilot.trigger(BOOT_US + 2 * 10**6) + autopilot.contact(BOOT_US + 2 * 10**6)
    fly(rig, booted_s + 1.0, 1.0 + late_s)
    hear(rig, held)
    fly(rig, booted_s + 2.0 + late_s, 8.0)
    assert len(rig.fired) == shots
    assert named(rig) == [(2, 2)] * (shots == 1)
    assert all("late" in str(text(one)) for one in rig.lost_triggers)


@pytest.mark.parametrize("personality", ["ardupilot", "px4"])
def test_a_camera_shoots_whether_the_vehicle_is_armed_or_not(personality: str) -> None:
    """On the bench it is not; and neither arming nor disarming is a restart, which would end what is known of it."""
    rig = Rig()
    autopilot = CameraTriggers(personality, (CameraPort("mavlink"),))
    hear(rig, [heartbeat(armed=False, personality=personality)])
    rig.tick(4)
    for number, armed in enumerate((False, True, True, False, False)):
        fly(rig, BOOT_US / 1e6 + number, 1.0)
        hear(rig, [heartbeat(armed=armed, personality=personality)])
        hear(rig, autopilot.trigger(BOOT_US + (number + 1) * 10**6, UNIX_US))
        assert len(rig.fired) == number + 1
    fly(rig, BOOT_US / 1e6 + 6, 8.0)
    assert named(rig) == []


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
    rig = rig_of(fires=False, cam_idx=own)
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
    rig = rig_of(fires=False)
    for number in range(60, 63):
        rig.clock.advance(1)
        hear(rig, autopilot.trigger(BOOT_US + number * 10**6, unix_us and unix_us + number * 10**6, camera=1))
    assert rig.fired == []
    hear(rig, autopilot.trigger(BOOT_US + 64 * 10**6, unix_us and unix_us + 64 * 10**6, camera=0))
    assert len(rig.fired) == 1
    rig.tick(4)
    assert named(rig) == [(5, 5)]  # it may have been one: it is told


def test_an_autopilot_without_time_that_starts_again_begins_its_numbers_again() -> None:
    """The first of its messages is lost and told; the second one and the third are shots."""
    rig = rig_of(fires=False)
    for missed, boot_s in ((0, 300.0), (1, 3.0)):
        autopilot = CameraTriggers(cameras=(CameraPort("wire"),))
        rig.clock.advance(3)
        fly(rig, boot_s, 1.0)
        for number in range(3):
            rig.clock.advance(1)
            messages = autopilot.trigger(BOOT_US + number * 10**6)
            hear(rig, messages if number >= missed else [])
    rig.tick(4)
    assert len(rig.fired) == 5
    assert named(rig) == [(1, 1)]


def test_triggers_of_a_new_start_that_seemed_old_before_it_was_certain_are_told_as_lost() -> None:
    """Without satellites, and the first ones were lost on the link: no number is above the last start's yet."""
    rig = rig_of(fires=False)
    for boot_s, seen in ((300.0, range(1, 10)), (3.0, range(3, 5))):
        autopilot = CameraTriggers(cameras=(CameraPort("wire"),))
        rig.clock.advance(3)
        fly(rig, boot_s, 0.2)
        for number in range(1, 10):
            messages = autopilot.trigger(BOOT_US + number * 10**6)
            hear(rig, messages if number in seen else [])
            rig.clock.advance(0.01)
        fly(rig, boot_s + 0.3, 1.0)
    assert rig.autopilot.restarts == 1
    hear(rig, autopilot.trigger(BOOT_US + 10 * 10**6))
    rig.tick(4)
    assert len(rig.fired) == 10
    assert [number for first, last in named(rig) for number in range(first, last + 1)] == list(range(1, 10))


def test_a_contact_of_a_new_start_is_a_shot_before_anything_else_shows_it() -> None:
    """Its number had another time before."""
    rig = rig_of(fires=False)
    for boot_s in (300.0, 3.0):
        autopilot = CameraTriggers(cameras=(CameraPort("wire", pin=True),))
        for number in range(2):
            at_us = round((boot_s + number) * 1e6)
            hear(rig, [*autopilot.trigger(at_us), *autopilot.contact(at_us)])
            fly(rig, boot_s + number, 0.4)
        rig.clock.advance(3)
    rig.tick(4)
    assert (len(rig.fired), named(rig)) == (4, [])


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
    assert {number for first, last in named(rig) for number in range(first, last + 1)} == set(lost)
    assert len(rig.fired) == 12 - len(lost)
    assert sum(one.number("triggers") for one in rig.lost_triggers) == len(lost)
    assert ("lost: trigger" in said) == bool(lost)
    for one in rig.lost_triggers:
        assert str(one.facts["where"]).startswith("noticed at 20")
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
    fly(rig, 300.0, 1.0)
    fly(rig, 1.0, 1.0)
    hear(rig, CameraTriggers().trigger(10**6, UNIX_US + 20 * 10**6))
    rig.tick(5)
    assert (rig.lost_triggers, len(rig.fired)) == ([], 7)


def asked(number: int) -> MavlinkMessage:
    """ArduPilot's request to CAM1."""
    return mavlink.MAVLink_command_long_message(1, 100, 2000, 0, 0, 0, 1, number, 0, 0, 0)


@pytest.mark.parametrize("next_number", [266, 267, 900, 65_000])
def test_a_jump_of_however_many_numbers_is_told_as_lost(next_number: int) -> None:
    """52 s without a link at 5 Hz: 256 lost, and the books agreed."""
    rig = rig_of(capacity=1000)
    for number in (*range(1, 11), next_number):
        rig.clock.advance(1)
        hear(rig, [asked(number)])
    rig.tick(3)
    assert named(rig) == [(11, next_number - 1)]
    (lost,) = rig.lost_triggers
    assert lost.code == (Code.TRIGGER_JUMP if next_number > 266 else Code.TRIGGER_LOST)


def test_one_wrong_number_between_right_ones_is_no_loss() -> None:
    rig = rig_of(capacity=1000)
    for number in (*range(1, 11), 5000, 11, 12, 13):
        rig.clock.advance(0.5)
        hear(rig, [asked(number)])
    rig.tick(3)
    assert named(rig) == []


def test_a_number_that_comes_late_over_a_second_link_is_not_part_of_a_jump() -> None:
    rig = rig_of(capacity=1000)
    for number in (1, 2, 500, 498, 499):
        rig.clock.advance(0.2)
        hear(rig, [asked(number)])
    rig.tick(3)
    assert named(rig) == [(3, 497)]


def test_losses_of_the_last_seconds_are_told_when_the_flight_ends() -> None:
    rig = rig_of(capacity=1000)
    for number in (9, 10, 14):
        rig.clock.advance(0.5)
        hear(rig, [asked(number)])
    rig.tick(0.1)
    assert named(rig) == []
    rig.component.finish()
    rig.component.finish()
    assert named(rig) == [(11, 13)]
    assert any("trigger 11 to 13" in m.text for m in rig.of("STATUSTEXT"))


def test_losses_around_a_restart_of_the_autopilot_are_told() -> None:
    """Those that were still waited for, and the first ones after it: it counts from 1 again."""
    rig = rig_of(capacity=1000)
    fly(rig, 300.0, 0.5)
    for number in (9, 10, 14):
        rig.clock.advance(0.1)
        hear(rig, [asked(number)])
    rig.clock.advance(2)
    fly(rig, 2.0, 0.7)
    rig.clock.advance(1)
    hear(rig, [asked(3)])
    rig.tick(3)
    assert named(rig)[0] == (11, 13)
    assert {number for first, last in named(rig)[1:] for number in range(first, last + 1)} >= {1, 2}


def test_a_trigger_between_a_restart_and_its_proof_is_not_forgotten() -> None:
    rig = rig_of(capacity=100)
    fly(rig, 300.0, 0.5)
    first, second = CameraTriggers(), CameraTriggers()
    for number in range(4):
        rig.tick(1)
        hear(rig, first.trigger(BOOT_US + number * 10**6, UNIX_US + number * 10**6))
    fly(rig, 1.0, 0.2)
    hear(rig, second.trigger(10**6, UNIX_US + 20 * 10**6))
    fly(rig, 1.4, 0.8)
    hear(rig, second.trigger(3 * 10**6, UNIX_US + 22 * 10**6))
    rig.tick(4)
    assert (named(rig), len(rig.fired)) == ([], 6)


@pytest.mark.parametrize("trusted", [True, False])
@pytest.mark.parametrize("late_s", [6.0, 290.0, -4000.0])
def test_a_packet_with_another_time_is_no_restart(late_s: float, trusted: bool) -> None:
    """A late copy on a slow second link, a wrong time, or anybody's packet on an unsigned link: the books stay, and
    an exposure is a shot."""
    rig = rig_of(fires=False, capacity=100)
    autopilot = CameraTriggers(cameras=(CameraPort("wire", pin=True),))
    for number in range(8):
        fly(rig, 300.0 + number, 0.9)
        if number == 5:
            continue
        rig.trusted = trusted
        for copy in range(1 if trusted else 20):
            old_ms = round((300.0 + number - late_s) * 1e3) + copy * 50
            rig.hear(mavlink.MAVLink_attitude_message(old_ms, 0, 0, 0, 0, 0, 0), AUTOPILOT)
            rig.clock.advance(0 if trusted else 0.05)
        rig.trusted = True
        at_us = round((300.9 + number) * 1e6)
        hear(rig, autopilot.trigger(at_us) + autopilot.contact(at_us))
        if number == 4:
            autopilot.trigger(at_us)
    rig.tick(4)
    assert len(rig.fired) == 7
    assert (named(rig), rig.autopilot.restarts) == ([(6, 6)], 0)


def test_old_packets_alone_are_no_restart_when_the_fast_link_has_died() -> None:
    rig = rig_of(fires=False, capacity=100)
    fly(rig, 300.0, 1.0)
    fly(rig, 294.0, 8.0)
    assert rig.autopilot.restarts == 0
    fly(rig, 2.0, 0.8)
    assert rig.autopilot.restarts == 1


@pytest.mark.parametrize("on_gimbal", [True, False])
def test_a_gimbals_attitude_is_requested_where_the_camera_hangs_on_it_until_it_comes(on_gimbal: bool) -> None:
    """ArduPilot sends 285 to a companion's port only on request."""
    rig = rig_of(on_gimbal=on_gimbal)

    def wanted() -> set[int]:
        return {round(m.param1) for m in rig.of("COMMAND_LONG") if m.command == mavlink.MAV_CMD_SET_MESSAGE_INTERVAL}

    number = mavlink.MAVLINK_MSG_ID_GIMBAL_DEVICE_ATTITUDE_STATUS
    assert (number in wanted()) == on_gimbal
    assert mavlink.MAVLINK_MSG_ID_ATTITUDE_QUATERNION in wanted()
    for step in range(100):
        status = mavlink.MAVLink_gimbal_device_attitude_status_message(0, 0, step * 50, 0, [1, 0, 0, 0], 0, 0, 0, 0)
        rig.hear(status, (1, 154))
    rig.tick(5)
    assert number not in wanted()
    rig.tick(5)
    assert (number in wanted()) == on_gimbal


def test_the_vehicles_battery_is_requested_until_it_comes_and_only_the_own_autopilots_counts() -> None:
    rig = rig_of()
    number = mavlink.MAVLINK_MSG_ID_SYS_STATUS

    def wanted() -> list[float]:
        return [
            m.param2
            for m in rig.of("COMMAND_LONG")
            if m.command == mavlink.MAV_CMD_SET_MESSAGE_INTERVAL and round(m.param1) == number
        ]

    def status(percent: int) -> MavlinkMessage:
        return mavlink.MAVLink_sys_status_message(0, 0, 0, 0, 24_000, -1, percent, 0, 0, 0, 0, 0, 0)

    assert wanted() == [1_000_000]  # microseconds
    assert rig.autopilot.battery() is None
    for _ in range(5):
        rig.hear(status(80), (1, 1))
        rig.hear(status(3), (1, 154))  # a gimbal's
        rig.hear(status(3), (9, 1))  # another vehicle's
    assert rig.autopilot.battery() == VehicleBattery(24.0, 80, low=False)
    rig.tick(5)
    assert wanted() == []
    for n in range(5000):
        rig.hear(status(n % 256 - 128), (1, 1))
    assert rig.autopilot.battery() == battery_of(status(4999 % 256 - 128))
    rig.tick(5.1)
    assert rig.autopilot.battery() is None


def test_a_request_for_the_time_is_for_the_autopilot_alone() -> None:
    """One for all components was forwarded to the ground station's radio."""
    rig = rig_of()
    (request,) = rig.of("TIMESYNC")
    packer = mavlink.MAVLink(None, srcSystem=1, srcComponent=100)
    raw = pack(request, packer, version_1=False)
    assert raw[10:-2] == struct.pack("<qqBB", 0, request.ts1, 1, 1)
    heard, old_heard = PacketParser()(raw), PacketParser()(pack(request, packer, version_1=True))
    assert heard is not None
    assert (heard.get_type(), heard.tc1, heard.ts1) == ("TIMESYNC", 0, request.ts1)
    assert old_heard is not None
    assert (old_heard.ts1, len(old_heard.get_payload())) == (request.ts1, 16)


def test_a_request_for_the_time_is_the_same_where_the_dialect_has_its_target(monkeypatch: pytest.MonkeyPatch) -> None:
    """With the fields of the extension in pymavlink the packing raised, and the link's task failed."""
    (request,) = rig_of().of("TIMESYNC")
    packer = mavlink.MAVLink(None, srcSystem=1, srcComponent=100)
    monkeypatch.setattr(mavlink.MAVLink_timesync_message, "unpacker", struct.Struct("<qqBB"))
    assert pack(request, packer, version_1=False)[10:-2] == struct.pack("<qqBB", 0, request.ts1, 1, 1)
    assert pack(request, packer, version_1=True)[6:-2] == struct.pack("<qq", 0, request.ts1)


def px4_rig(**options: object) -> Rig:
    rig = Rig(capacity=100, **options)  # type: ignore[arg-type]  # as the rig takes them
    rig.hear(mavlink.MAVLink_heartbeat_message(2, mavlink.MAV_AUTOPILOT_PX4, 0, 0, 4, 3), AUTOPILOT)
    rig.tick(4)
    return rig


def numbered(number: int, at_s: int) -> MavlinkMessage:
    """PX4's trigger, by the time since its boot."""
    return mavlink.MAVLink_camera_trigger_message(BOOT_US + at_s * 10**6, number)


def test_triggers_that_are_lost_after_px4s_counter_was_set_back_are_named() -> None:
    """MAV_CMD_DO_TRIGGER_CONTROL with parameter 2 = 1, which is not forwarded to the camera: its numbers start again
    below the highest one, and nothing was missed until they reached it."""
    rig = px4_rig()
    heard = [*range(7), 9, 0, 1, 2, 5, 6, 0, 1, 4]  # 7, 8; then 3, 4; then 2, 3 are lost
    for at_s, number in enumerate(heard):
        rig.tick(1.0)
        hear(rig, [numbered(number, at_s)])
    rig.tick(5)
    assert named(rig) == [(7, 8), (3, 4), (2, 3)]
    assert len(rig.fired) == len(heard)


def test_late_numbers_of_a_slow_second_link_set_no_counter_back() -> None:
    rig = px4_rig()
    for at_s, number in enumerate(range(1, 8)):
        rig.tick(0.3)
        hear(rig, [numbered(number, at_s)] if number not in (3, 4) else [])
    for late in (4, 3):
        rig.tick(0.3)
        hear(rig, [numbered(late, late - 1)])
    rig.tick(5)
    assert (named(rig), len(rig.fired)) == ([], 7)
    for number, at_s in ((1, 10), (7, 6), (2, 11)):  # set back; a copy from before; the next one
        rig.tick(1.0)
        hear(rig, [numbered(number, at_s)])
    rig.tick(5)
    assert (named(rig), len(rig.fired)) == ([], 9)


@pytest.mark.parametrize(("sender", "after_s"), [(AUTOPILOT, 600.0), ((9, 1), 1.0)])
def test_old_shots_without_a_number_and_those_of_others_cover_no_loss(sender: tuple[int, int], after_s: float) -> None:
    """Items of a mission, or another vehicle's, became shots; then triggers were lost, and the books balanced."""
    rig, px4 = px4_rig(), CameraTriggers("px4")
    hear(rig, px4.trigger(BOOT_US))
    for number in range(3):
        rig.tick(3.0)
        seven = (0, 0, 1, number + 50, 0, 0, 0)
        asked = mavlink.MAVLink_command_long_message(1, 100, mavlink.MAV_CMD_IMAGE_START_CAPTURE, 0, *seven)
        rig.hear(asked, sender)
    assert len(rig.fired) == 4
    rig.tick(after_s)
    for number in range(4):
        rig.tick(1.0)
        messages = px4.trigger(BOOT_US + number * 10**6)
        hear(rig, messages if number == 3 else [])
    rig.tick(5)
    assert sum(one.number("triggers") for one in rig.lost_triggers) == 3


@pytest.mark.parametrize(
    ("kind", "named", "own", "fires"),
    [(6, 0, 0, None), (6, 100, 0, None), (6, 0, 1, 101), (6, 42, 0, 42), (6, None, 0, None), (1, 42, 0, None)],
)
def test_a_component_that_is_not_this_one_in_ardupilots_parameters_is_told(
    kind: int, named: int | None, own: int, fires: int | None
) -> None:
    """CAMn_COMPID is of ArduPilot 4.8; what is not answered is asked for three times."""
    rig = Rig(cam_idx=own)
    rig.hear(heartbeat(armed=False), AUTOPILOT)
    asked: list[str] = []
    for _ in range(60):
        rig.tick(0.5)
        for read in rig.of("PARAM_REQUEST_READ"):
            assert (read.target_system, read.target_component, read.param_index) == (1, 1, -1)
            asked.append(read.param_id)
            value = kind if read.param_id == f"CAM{own + 1}_TYPE" else named
            if value is not None:
                rig.hear(mavlink.MAVLink_param_value_message(read.param_id.encode(), value, 2, 1, 9), AUTOPILOT)
    assert asked == [f"CAM{own + 1}_TYPE", *[f"CAM{own + 1}_COMPID"] * (3 if named is None else 1)]
    found = [one for one in rig.component.findings() if one.code is Code.LINK_OTHER_COMPONENT]
    assert [one.number("named") for one in found] == ([] if fires is None else [fires])
    rig.hear(mavlink.MAVLink_param_value_message(b"CAM%d_COMPID" % (own + 1), 100, 2, 1, 9), AUTOPILOT)
    assert Code.LINK_OTHER_COMPONENT not in [one.code for one in rig.component.findings()]


@pytest.mark.parametrize("attitude", ["ATTITUDE", "ATTITUDE_QUATERNION"])
def test_telemetry_that_comes_too_seldom_is_named_with_its_rate_until_it_comes_as_requested(attitude: str) -> None:
    """ArduPilot over TCP sends some messages at the rate of its SR1 parameters."""
    rig = rig_of()
    boot_ms = 10_000

    def fly(seconds: float, position_hz: float, attitude_hz: float) -> None:
        nonlocal boot_ms
        for step in range(round(seconds * 10)):
            for _ in range(round((step + 1) * position_hz / 10) - round(step * position_hz / 10)):
                rig.hear(mavlink.MAVLink_global_position_int_message(boot_ms, 1, 1, 0, 0, 0, 0, 0, 0), AUTOPILOT)
            for _ in range(round(attitude_hz / 10)):
                zeros = (0,) * (6 if attitude == "ATTITUDE" else 7)
                rig.hear(getattr(mavlink, f"MAVLink_{attitude.lower()}_message")(boot_ms, *zeros), AUTOPILOT)
            boot_ms += 100
            rig.tick(0.1)

    def slow() -> list[tuple[object, ...]]:
        found = [one for one in rig.component.findings() if one.code is Code.TELEMETRY_SLOW]
        return [(one.subject.which, round(float(str(one.facts["seen_hz"]))), one.facts["wanted_hz"]) for one in found]

    fly(12, 50, 10)
    assert slow() == [("ATTITUDE_QUATERNION", 10, 50)]
    fly(16, 4, 50)
    assert slow() == [("GLOBAL_POSITION_INT", 4, 50)]
    fly(16, 5, 15)  # enough: more was asked for
    assert slow() == []
    fly(6, 50, 50)
    assert slow() == []
    fly(12, 0, 50)  # nothing at all is another finding
    assert slow() == []


@pytest.mark.parametrize("test_shot", [True, False])
def test_a_test_shot_is_a_photograph_that_covers_no_lost_trigger(test_shot: bool) -> None:
    """Parameter 7 = 1: PX4 doesn't count it. Any other shot without a number may be the one whose number is missing."""
    rig, px4 = px4_rig(), CameraTriggers("px4")
    hear(rig, px4.trigger(BOOT_US))
    rig.tick(3.0)
    seven = (0, 0, 0, 0, 1, 0, int(test_shot))
    hear(rig, [mavlink.MAVLink_command_long_message(0, 0, mavlink.MAV_CMD_DO_DIGICAM_CONTROL, 0, *seven)])
    assert len(rig.fired) == 2
    for number in (1, 2):
        rig.tick(1.0)
        messages = px4.trigger(BOOT_US + number * 10**6)
        hear(rig, messages if number == 2 else [])
    rig.tick(5)
    assert named(rig) == [(2, 2)] * test_shot


def test_a_shot_that_could_not_be_fired_is_not_told_as_a_lost_trigger(monkeypatch: pytest.MonkeyPatch) -> None:
    rig, px4 = px4_rig(fires=False), CameraTriggers("px4", (CameraPort("wire"),))

    def fails(shot: object) -> None:
        raise OSError("the disk is gone")

    for number in range(4):
        rig.tick(1.0)
        messages = px4.trigger(BOOT_US + number * 10**6)
        if number != 2:
            hear(rig, messages)
            continue
        with monkeypatch.context() as broken:
            broken.setattr(rig.sink, "fire", fails)
            with pytest.raises(OSError, match="the disk is gone"):
                hear(rig, messages)
    rig.tick(5)
    assert rig.lost_triggers == []


@pytest.mark.parametrize("triggered", [True, False])
@pytest.mark.parametrize("links", [1, 2])
def test_each_contact_that_px4_reports_is_one_shot_whether_a_trigger_has_told_of_it_or_not(
    links: int, *, triggered: bool
) -> None:
    """With CAM_CAP_FBACK: with TRIG_MODE 0 nothing else comes, and six exposures were six strays."""
    rig, px4 = px4_rig(fires=False), CameraTriggers("px4", (CameraPort("wire", pin=True),))
    fly(rig, BOOT_US / 1e6, 1.0)
    for number in range(6):
        rig.tick(1.0)
        at_us = BOOT_US + (20 + 18 * number) * 100_000
        parts = (px4.trigger(at_us) if triggered else [], px4.contact(at_us + 400_000))
        for part in parts:
            for _ in range(links):
                hear(rig, part)
            rig.tick(0.4)
        if number == 3:
            px4.trigger(at_us + 500_000)
            px4.contact(at_us + 900_000)  # nothing of it arrives
        assert len(rig.fired) == number + 1
    rig.tick(5)
    assert named(rig) == [(5, 5) if triggered else (4, 4)]


def test_a_report_of_px4s_own_trigger_is_that_photograph_and_stands_in_for_it() -> None:
    """Without CAM_CAP_FBACK both have one number and one time; here the third CAMERA_TRIGGER is lost, and the fifth
    comes last. A camera that is fired from here, and another camera's report, are left alone."""
    rig, px4 = px4_rig(fires=False), CameraTriggers("px4", (CameraPort("wire"),))
    fires = px4_rig()

    def captured(number: int, at_us: int, result: int = 1) -> MavlinkMessage:
        at = at_us // 1000, 0, 1, 0, 0, 0, 0, (1.0, 0.0, 0.0, 0.0)
        return mavlink.MAVLink_camera_image_captured_message(*at, number, result, b"")

    for number in range(1, 7):
        rig.tick(1.0)
        at_us = BOOT_US + number * 10**6
        both = [*px4.trigger(at_us), captured(number, at_us)]
        hear(rig, both[1:] if number == 3 else both[::-1] if number == 5 else both)
        rig.hear(captured(number, at_us), (1, 101))
        hear(rig, [captured(100 + number, at_us, result=0)])
        fires.hear(captured(number, at_us), AUTOPILOT)
        assert len(rig.fired) == number
    rig.tick(5)
    assert rig.lost_triggers == []
    assert fires.fired == []


def test_a_contact_of_px4s_that_is_reported_late_is_no_shot_and_is_named() -> None:
    rig, px4 = px4_rig(fires=False), CameraTriggers("px4", (CameraPort("wire", pin=True),))
    fly(rig, BOOT_US / 1e6, 1.0)
    hear(rig, px4.contact(BOOT_US + 10**6))
    held = px4.contact(BOOT_US + 2 * 10**6)
    fly(rig, BOOT_US / 1e6 + 1.0, 7.0)
    hear(rig, held)
    fly(rig, BOOT_US / 1e6 + 8.0, 4.0)
    assert len(rig.fired) == 1
    assert named(rig) == [(1, 1)]


def test_a_list_of_photographs_that_always_asks_for_the_first_one_ends() -> None:
    """MAVSDK through ArduPilot: p2 = 0 without end, 60 times in 30 s."""
    rig = rig_of()
    told: list[int] = []
    for _ in range(6):
        assert rig.command(mavlink.MAV_CMD_REQUEST_MESSAGE, 263, 0.0) == mavlink.MAV_RESULT_ACCEPTED
        rig.tick(0.5)
        told += [m.image_index for m in rig.of("CAMERA_IMAGE_CAPTURED")]
    assert told == [0, 1, 0, 2, 0, 3, 0, 4, 0, 0]
    rig.tick(11)
    assert rig.command(mavlink.MAV_CMD_REQUEST_MESSAGE, 263, 0.0) == mavlink.MAV_RESULT_ACCEPTED
    rig.tick(0.5)
    assert [m.image_index for m in rig.of("CAMERA_IMAGE_CAPTURED")] == [0]
