"""The MAVLink camera, message by message, without a link: what peers send, and what they must hear."""

from __future__ import annotations

import math
import struct
from dataclasses import replace
from itertools import pairwise

import pytest
from hypothesis import given
from hypothesis import strategies as st

from dappled.clock import RecordedClock
from dappled.config.settings import PoseSettings
from dappled.daemon.camera_protocol.camera_status import CameraFacts, Captured
from dappled.daemon.camera_protocol.component import Component
from dappled.daemon.camera_protocol.earlier_outcomes import EarlierOutcomes
from dappled.daemon.camera_protocol.own_autopilot import OwnAutopilot
from dappled.daemon.camera_protocol.parameters import Parameter, Parameters, code
from dappled.daemon.pipeline.repeats import CaptureRequest
from dappled.daemon.pipeline.shutter import Shutter
from dappled.daemon.pipeline.spacing import DistanceTrigger, Spacing
from dappled.decode.geometry import GroundHeight, Quaternion
from dappled.drivers.camera import Setting, SettingName, check_change
from dappled.drivers.mavlink import MavlinkMessage, Packet, mavlink, pack
from dappled.findings import Code, Finding, Level
from dappled.flight.layout import DiskSpace
from tests.daemon.camera_protocol.rig import NothingEarlier
from tests.daemon.fakes import NO_CAMERA, FakeSink, Nowhere, no_pose

NAN = math.nan
GCS = (255, 190)
AUTOPILOT = (1, 1)


class Body:
    """A body's settings: it takes a change when the test lets it."""

    def __init__(self) -> None:
        self.now = {"iso": Setting("iso", "100", ("100", "200", "400")), "aperture": Setting("aperture", "5.6")}
        self.asked: list[tuple[str, str]] = []

    def settings(self) -> tuple[Setting, ...]:
        return tuple(self.now.values())

    def change(self, name: SettingName, value: str) -> None:
        check_change(self.settings(), name, value)
        self.asked.append((name, value))

    def take(self, name: SettingName, value: str) -> None:
        self.now[name] = Setting(name, value, self.now[name].choices)


class Rig:
    """A component whose links are a list."""

    def __init__(
        self,
        *,
        capacity: int = 8,
        earlier: EarlierOutcomes | None = None,
        cam_idx: int = 0,
        fires: bool = True,
        on_gimbal: bool = False,
        configured: Spacing | None = None,
    ) -> None:
        self.body = Body()
        self.on_gimbal = on_gimbal
        self.decode = "on"
        self.system_id, self.component_id = 1, 100
        self.packer = mavlink.MAVLink(None)
        self.copies = 1
        self.trusted = True
        self.exposed = False
        self.sent: list[MavlinkMessage] = []
        self.sent_on: list[int | None] = []  # None: on all links
        self.without: list[int | None] = []
        self.lost_triggers: list[Finding] = []
        self.well, self.critical = True, False
        self.clock = RecordedClock(10**18, 10**18 - 10**9)
        self.sink = FakeSink()
        self.shutter = Shutter(self.sink, self.clock, next_index=5, capacity=capacity, fires=fires)
        self.series = DistanceTrigger(self.shutter, Nowhere(), self.clock, mount=self.mount, configured=configured)
        parameters = Parameters(self.body, (self,))
        self.autopilot = OwnAutopilot(self, self.clock, on_gimbal=on_gimbal, cam_idx=cam_idx)
        self.component = Component(
            self.autopilot,
            self.shutter,
            parameters,
            model=self,
            earlier=earlier or NothingEarlier(),
            series=self.series,
        )

    @property
    def fired(self) -> list[int]:
        return self.sink.fired

    mount = PoseSettings().mount

    def facts(self) -> CameraFacts:
        return CameraFacts("Canon", "EOS 450D", (0, 1, 0), 50.0, 22.2, 14.8, 4272, 2848)

    def storage(self) -> DiskSpace:
        return DiskSpace(2**34, 2**33, 2**33)

    def lookup(self, index: int) -> Captured | None:
        return Captured(index, ok=index != 3) if index < 5 else None

    def pose(self) -> None:
        """Not known."""

    def lost(self, triggers: Finding) -> None:
        self.lost_triggers.append(triggers)

    def troubled(self) -> bool:
        return self.critical

    def parameters(self) -> tuple[Parameter]:
        return (Parameter("LF_DECODE", "Decode in flight", self.decode, ("on", "off")),)

    def set(self, name: str, value: str) -> None:
        assert name == "LF_DECODE"
        self.decode = value

    def send(self, message: MavlinkMessage, link: int | None = None, *, without: int | None = None) -> bool:
        self.sent.append(message)
        self.sent_on.append(link)
        self.without.append(without)
        return True

    def of(self, kind: str) -> list[MavlinkMessage]:
        """What was sent of this type."""
        return [m for m in self.sent if m.get_type() == kind]

    def hear(self, message: MavlinkMessage, sender: tuple[int, int] = GCS, link: int = 0) -> None:
        self.packer.srcSystem, self.packer.srcComponent = sender
        raw = pack(message, self.packer, version_1=False)
        for _ in range(self.copies):
            self.component.on_packet(Packet(0, 0, link, message, raw, trusted=self.trusted, exposed=self.exposed))

    def command(
        self,
        name: int,
        *p: float,
        target: tuple[int, int] = (1, 100),
        confirmation: int = 0,
        sender: tuple[int, int] = GCS,
    ) -> int | None:
        """Its MAV_RESULT, None for no acknowledgement."""
        self.sent.clear()
        padded = (*p, *[0.0] * (7 - len(p)))
        self.hear(mavlink.MAVLink_command_long_message(*target, name, confirmation, *padded), sender)
        acks = [m for m in self.sent if m.get_type() == "COMMAND_ACK"]
        assert len(acks) <= 1
        if acks:
            assert self.sent[0] is acks[0]  # first the answer, then the message
            assert (acks[0].target_system, acks[0].target_component) == sender
        return int(acks[0].result) if acks else None

    def tick(self, seconds: float = 0.0) -> list[str]:
        self.clock.advance(seconds)
        self.sent.clear()
        self.component.tick(healthy=lambda: self.well)
        return [m.get_type() for m in self.sent]


@pytest.mark.parametrize("exposed", [True, False])
def test_what_strangers_ask_for_is_answered_at_a_rate_and_all_others_always(exposed: bool) -> None:
    """One packet may ask for 32 of a file, or for all parameters; and its name may be words for the pilot."""
    rig = Rig()
    rig.exposed = exposed
    rig.hear(ftp(4, 0, b"camera.xml", number=0))
    for number in range(1, 200):
        rig.hear(ftp(15, 0, number=number))
    for _ in range(200):
        rig.packer.seq = (rig.packer.seq + 1) % 256
        rig.hear(mavlink.MAVLink_param_ext_request_list_message(1, 100))
    for number in range(200):
        name = b"TURN BACK %d" % number
        rig.hear(mavlink.MAVLink_param_ext_set_message(1, 100, name, bytes(128), mavlink.MAV_PARAM_EXT_TYPE_UINT32))
    counts = [
        len(rig.of(kind)) for kind in ("FILE_TRANSFER_PROTOCOL", "PARAM_EXT_VALUE", "PARAM_EXT_ACK", "STATUSTEXT")
    ]
    assert counts[2] == 200  # one for one
    assert (counts[0] + counts[1] <= 500) == exposed
    assert (counts[3] <= 1) == exposed
    assert rig.command(mavlink.MAV_CMD_REQUEST_MESSAGE, 259) == mavlink.MAV_RESULT_ACCEPTED
    rig.clock.advance(4)
    rig.sent.clear()
    rig.hear(mavlink.MAVLink_param_ext_request_list_message(1, 100))
    assert len(rig.of("PARAM_EXT_VALUE")) == 3


def ftp(opcode: int, session: int, data: bytes = b"", *, number: int) -> MavlinkMessage:
    payload = struct.pack("<HBBBBBxI", number, session, opcode, len(data), 0, 0, 0) + data
    return mavlink.MAVLink_file_transfer_protocol_message(0, 1, 100, payload.ljust(251, b"\0"))


def test_one_request_one_shot_acknowledged_at_once() -> None:
    rig = Rig()
    assert rig.command(mavlink.MAV_CMD_IMAGE_START_CAPTURE, 0, 0, 1, 1) == mavlink.MAV_RESULT_ACCEPTED
    assert rig.command(mavlink.MAV_CMD_IMAGE_START_CAPTURE, 0, 0, 1, 1, confirmation=1) == mavlink.MAV_RESULT_ACCEPTED
    assert rig.fired == [5]


@pytest.mark.parametrize("target", [(0, 0), (1, 0), (1, 100)])
@pytest.mark.parametrize(
    ("command", "parameters"), [(203, (0.0, 0, 0, 0, 1)), (2000, (0.0, 0, 1, 0)), (2000, (0.0, 2.0, 3))]
)
def test_a_request_that_says_that_it_repeats_is_no_second_shot(
    command: int, parameters: tuple[float, ...], target: tuple[int, int]
) -> None:
    """A broadcast 203, which nobody acknowledges and which has no number, repeated with confirmation 1."""
    rig = Rig()
    rig.tick(4)
    for confirmation in (0, 1, 2):
        result = rig.command(command, *parameters, target=target, confirmation=confirmation)
        assert result == mavlink.MAV_RESULT_ACCEPTED
        rig.clock.advance(0.7)
    assert rig.fired == [5]
    rig.clock.advance(11)
    rig.command(command, *parameters, target=target)
    assert rig.fired == [5, 6]


def test_px4s_triple_is_one_shot() -> None:
    rig = Rig()
    rig.tick(4)
    rig.hear(mavlink.MAVLink_camera_trigger_message(123456, 9), AUTOPILOT)
    nans = [NAN] * 4
    rig.hear(
        mavlink.MAVLink_command_long_message(1, 100, mavlink.MAV_CMD_IMAGE_START_CAPTURE, 0, 0, 0, 1, 7, *nans[:3]),
        AUTOPILOT,
    )
    rig.hear(
        mavlink.MAVLink_command_long_message(1, 0, mavlink.MAV_CMD_DO_DIGICAM_CONTROL, 0, *nans, 1, NAN, NAN), AUTOPILOT
    )
    assert rig.fired == [5]


def test_a_broadcast_that_the_network_doubled_is_one_shot_and_the_next_one_another() -> None:
    rig = Rig()
    rig.tick(4)
    rig.copies = 2
    for _ in range(3):
        rig.clock.advance(0.35)
        nans = [NAN] * 4
        rig.hear(
            mavlink.MAVLink_command_long_message(0, 0, mavlink.MAV_CMD_DO_DIGICAM_CONTROL, 0, *nans, 1, NAN, NAN),
            AUTOPILOT,
        )
    assert rig.fired == [5, 6, 7]


def test_a_refusal_says_why_and_pushes_the_status() -> None:
    rig = Rig()
    rig.tick(4)
    rig.sink.problem = NO_CAMERA
    result = rig.command(mavlink.MAV_CMD_IMAGE_START_CAPTURE, 0, 0, 1, 1)
    assert result == mavlink.MAV_RESULT_TEMPORARILY_REJECTED
    assert any("none is on the bus" in str(m) for m in rig.sent)
    assert "CAMERA_CAPTURE_STATUS" in rig.tick()


@pytest.mark.parametrize(
    ("command", "parameters", "then"),
    [
        (mavlink.MAV_CMD_REQUEST_MESSAGE, (259,), "CAMERA_INFORMATION"),
        (mavlink.MAV_CMD_REQUEST_MESSAGE, (260, NAN), "CAMERA_SETTINGS"),
        (mavlink.MAV_CMD_REQUEST_MESSAGE, (261,), "STORAGE_INFORMATION"),
        (mavlink.MAV_CMD_REQUEST_MESSAGE, (262,), "CAMERA_CAPTURE_STATUS"),
        (mavlink.MAV_CMD_REQUEST_MESSAGE, (271,), "CAMERA_FOV_STATUS"),
        (mavlink.MAV_CMD_GET_MESSAGE_INTERVAL, (262,), "MESSAGE_INTERVAL"),
        (mavlink.MAV_CMD_REQUEST_CAMERA_INFORMATION, (0,), "CAMERA_INFORMATION"),
        (mavlink.MAV_CMD_REQUEST_CAMERA_SETTINGS, (1,), "CAMERA_SETTINGS"),
        (mavlink.MAV_CMD_REQUEST_STORAGE_INFORMATION, (0, 1), "STORAGE_INFORMATION"),
        (mavlink.MAV_CMD_REQUEST_CAMERA_CAPTURE_STATUS, (NAN,), "CAMERA_CAPTURE_STATUS"),
        (mavlink.MAV_CMD_SET_CAMERA_MODE, (0, 2), "CAMERA_SETTINGS"),
        (mavlink.MAV_CMD_RESET_CAMERA_SETTINGS, (1,), "CAMERA_SETTINGS"),
    ],
)
def test_what_is_asked_for_follows_its_acknowledgement(command: int, parameters: tuple[float, ...], then: str) -> None:
    rig = Rig()
    assert rig.command(command, *parameters) == mavlink.MAV_RESULT_ACCEPTED
    assert [m.get_type() for m in rig.sent] == ["COMMAND_ACK", then]


@pytest.mark.parametrize(("command", "before"), [(mavlink.MAV_CMD_REQUEST_MESSAGE, (261.0,)), (525, ())])
@pytest.mark.parametrize(("storage", "known"), [(0, True), (NAN, True), (1, True), (2, False), (255, False)])
def test_the_disk_is_storage_1_and_there_is_no_other(
    command: int, before: tuple[float, ...], storage: float, *, known: bool
) -> None:
    rig = Rig()
    result = rig.command(command, *before, storage, 1)
    assert result == (mavlink.MAV_RESULT_ACCEPTED if known else mavlink.MAV_RESULT_DENIED)
    assert [m.storage_id for m in rig.of("STORAGE_INFORMATION")] == [1] * known


def test_past_images_are_answered_failures_too_and_without_an_index_one_after_the_other() -> None:
    rig = Rig()
    rig.tick(4)
    for index, wanted in ((0, 0), (3, 3), *((NAN, one) for one in (0, 1, 2, 3, 4, 0))):
        assert rig.command(mavlink.MAV_CMD_REQUEST_MESSAGE, 263, index) == mavlink.MAV_RESULT_ACCEPTED
        rig.tick()
        (image,) = [m for m in rig.sent if m.get_type() == "CAMERA_IMAGE_CAPTURED"]
        assert (image.image_index, image.capture_result) == (wanted, int(wanted != 3))
    assert rig.command(mavlink.MAV_CMD_REQUEST_CAMERA_IMAGE_CAPTURE, 5) == mavlink.MAV_RESULT_DENIED


def test_more_past_images_than_can_wait_are_refused_and_every_accepted_one_is_told() -> None:
    rig = Rig()
    rig.tick(4)
    results = [rig.command(mavlink.MAV_CMD_REQUEST_MESSAGE, 263, at % 5) for at in range(300)]
    told = 0
    for _ in range(300):
        told += rig.tick().count("CAMERA_IMAGE_CAPTURED")
    assert results == [mavlink.MAV_RESULT_ACCEPTED] * told + [mavlink.MAV_RESULT_TEMPORARILY_REJECTED] * (300 - told)
    assert told == 256
    assert rig.command(mavlink.MAV_CMD_REQUEST_MESSAGE, 263, 1) == mavlink.MAV_RESULT_ACCEPTED


def test_a_past_image_whose_flight_was_moved_away_is_missed_in_words() -> None:
    rig = Rig()
    rig.tick(4)
    assert rig.command(mavlink.MAV_CMD_IMAGE_START_CAPTURE, 0, 0, 1, 1) == mavlink.MAV_RESULT_ACCEPTED
    assert rig.command(mavlink.MAV_CMD_REQUEST_MESSAGE, 263, 5) == mavlink.MAV_RESULT_ACCEPTED
    rig.tick()
    assert b"image 5 is in none of the flights" in b"".join(m._text_raw for m in rig.of("STATUSTEXT"))


def test_refused_by_name_and_silent_on_broadcasts() -> None:
    rig = Rig()
    for command in (mavlink.MAV_CMD_VIDEO_START_CAPTURE, 214, 534, 2504, 2505):
        assert rig.command(command, NAN) == mavlink.MAV_RESULT_UNSUPPORTED
        assert rig.command(command, NAN, target=(0, 0)) is None
    assert rig.command(mavlink.MAV_CMD_SET_CAMERA_MODE, 0, 1) == mavlink.MAV_RESULT_DENIED
    assert rig.command(mavlink.MAV_CMD_STORAGE_FORMAT, 1, 1, 1) == mavlink.MAV_RESULT_DENIED
    for video in (269, 270):  # there are no streams: any answer to 269 would be one in MAVProxy's list
        assert rig.command(mavlink.MAV_CMD_REQUEST_MESSAGE, video, 1) == mavlink.MAV_RESULT_UNSUPPORTED
    assert rig.command(mavlink.MAV_CMD_IMAGE_START_CAPTURE, 0, 0, 1, target=(2, 100)) is None
    assert rig.command(mavlink.MAV_CMD_IMAGE_START_CAPTURE, 0, 0, 1, target=(1, 101)) is None
    assert not rig.fired


def test_an_interval_starts_stops_and_shows() -> None:
    rig = Rig()
    rig.tick(4)
    assert rig.command(mavlink.MAV_CMD_IMAGE_START_CAPTURE, 0, 2.0, 0, 3) == mavlink.MAV_RESULT_ACCEPTED
    rig.tick()
    (status,) = [m for m in rig.sent if m.get_type() == "CAMERA_CAPTURE_STATUS"]
    assert (status.image_status, status.image_interval, status.image_count) == (3, 2.0, 6)
    assert rig.command(mavlink.MAV_CMD_IMAGE_STOP_CAPTURE, 0) == mavlink.MAV_RESULT_ACCEPTED
    assert rig.shutter.statistics().interval_s is None


@pytest.mark.parametrize(("autopilots", "system"), [((7,), 7), ((), 1), ((7, 8), 1)])
def test_the_sole_autopilots_system_is_adopted(autopilots: tuple[int, ...], system: int) -> None:
    rig = Rig()
    assert rig.tick() == []
    for each in autopilots:
        rig.hear(mavlink.MAVLink_heartbeat_message(2, 3, 0, 0, 4, 3), (each, 1))
    assert "HEARTBEAT" in rig.tick(3.1)
    assert rig.system_id == system


def autopilot_heartbeat(rig: Rig, system: int) -> None:
    rig.hear(mavlink.MAVLink_heartbeat_message(2, 3, 0, 0, 4, 3), (system, 1))


def test_an_autopilot_that_boots_after_the_camera_is_taken_and_fires_it() -> None:
    rig = Rig()
    assert "HEARTBEAT" in rig.tick(3.1)
    assert (rig.system_id, rig.component.findings()) == (1, [])
    rig.clock.advance(60)
    autopilot_heartbeat(rig, 7)
    rig.tick(1.3)
    assert (rig.system_id, rig.component.vehicle, rig.component.findings()) == (7, 7, [])
    rig.hear(mavlink.MAVLink_camera_trigger_message(1, 1), (7, 1))
    assert rig.fired == [5]
    autopilot_heartbeat(rig, 8)
    rig.tick(1.3)
    assert (rig.system_id, [one.code for one in rig.component.findings()]) == (7, [Code.LINK_VEHICLE])


def test_several_autopilots_that_come_late_leave_the_configured_system_and_it_is_said() -> None:
    rig = Rig()
    rig.tick(3.1)
    for system in (8, 7):
        autopilot_heartbeat(rig, system)
        rig.tick(0.5)
    rig.tick(1)
    assert rig.system_id == 1
    (found,) = rig.component.findings()
    assert (found.code, dict(found.facts)) == (Code.LINK_OTHER_SYSTEM, {"heard": "7, 8", "system": 1})
    autopilot_heartbeat(rig, 1)
    assert [one.code for one in rig.component.findings()] == [Code.LINK_VEHICLE]


@pytest.mark.parametrize("kind", ["ANTENNA_TRACKER", "ONBOARD_CONTROLLER", "GIMBAL", "ADSB"])
@pytest.mark.parametrize("late", [False, True])
def test_what_is_no_vehicle_is_none_whatever_autopilot_it_names(kind: str, *, late: bool) -> None:
    """An antenna tracker runs ArduPilot, and many programs say that they are a generic autopilot."""
    rig = Rig()
    for system in (7, 1) if late else (1, 7):
        number = getattr(mavlink, f"MAV_TYPE_{kind}") if system == 1 else mavlink.MAV_TYPE_QUADROTOR
        rig.hear(mavlink.MAVLink_heartbeat_message(number, 3, 0, 0, 4, 3), (system, 1))
    rig.tick(3.1)
    assert (rig.system_id, rig.component.vehicle, rig.component.findings()) == (7, 7, [])


def test_of_several_vehicles_the_one_that_fires_the_camera_counts_and_the_others_are_told() -> None:
    rig = Rig()
    for system in (2, 1):
        autopilot_heartbeat(rig, system)
    rig.tick(3.1)

    def told() -> tuple[object, ...]:
        (found,) = rig.component.findings()
        assert (found.code, found.level) == (Code.LINK_VEHICLE, Level.NOTE)
        rig.tick(0.1)
        return rig.system_id, rig.component.vehicle, found.facts["vehicle"], found.facts["by"]

    fire = (mavlink.MAV_CMD_IMAGE_START_CAPTURE, 0, 0.0, 1)
    assert any("vehicle 1 counts" in m.text for m in rig.of("STATUSTEXT"))
    assert told() == (1, 1, 1, "id in mavlink.system_id")
    rig.command(*fire, 1, sender=(2, 1), target=(0, 0))  # meant for all: nothing follows
    assert told() == (1, 1, 1, "id in mavlink.system_id")
    rig.clock.advance(5)
    assert rig.command(*fire, 1, sender=(2, 1)) == mavlink.MAV_RESULT_ACCEPTED
    assert told() == (2, 2, 2, "requests to this camera")
    rig.clock.advance(5)
    assert rig.command(*fire, 1, sender=(1, 1), target=(2, 100)) == mavlink.MAV_RESULT_ACCEPTED  # both: undecided again
    assert told() == (1, 1, 1, "id in mavlink.system_id")


def test_heartbeats_time_requests_and_streams_come_in_time_and_none_while_faulted() -> None:
    rig = Rig()
    rig.hear(mavlink.MAVLink_heartbeat_message(2, 3, 0, 0, 4, 3), AUTOPILOT)
    first = rig.tick(1.3)
    assert first.count("HEARTBEAT") == 1
    assert first.count("COMMAND_LONG") == 7
    seen = [kind for _ in range(100) for kind in rig.tick(0.02)]
    assert seen.count("HEARTBEAT") == 2
    assert seen.count("TIMESYNC") == 10
    assert {m.system_status for m in rig.of("HEARTBEAT")} == {mavlink.MAV_STATE_ACTIVE}
    rig.critical = True
    rig.sent.clear()
    rig.tick(1.5)
    assert {m.system_status for m in rig.of("HEARTBEAT")} == {mavlink.MAV_STATE_CRITICAL}
    rig.well = False
    assert "HEARTBEAT" not in rig.tick(1.5)


def extended(rig: Rig, name: bytes, value: int, kind: int = mavlink.MAV_PARAM_EXT_TYPE_UINT32) -> list[int]:
    """The results that follow a PARAM_EXT_SET at once."""
    rig.sent.clear()
    rig.hear(mavlink.MAVLink_param_ext_set_message(1, 100, name, struct.pack("<I", value), kind))
    return [m.param_result for m in rig.of("PARAM_EXT_ACK")]


def test_settings_are_listed_read_and_match_the_definition_that_is_served() -> None:
    rig = Rig()
    rig.hear(mavlink.MAVLink_param_ext_request_list_message(1, 100))
    listed = [(m.param_id, m.param_index, m.param_count) for m in rig.of("PARAM_EXT_VALUE")]
    assert listed == [("CAM_ISO", 0, 3), ("CAM_APERTURE", 1, 3), ("LF_DECODE", 2, 3)]
    rig.sent.clear()
    rig.hear(mavlink.MAVLink_param_ext_request_read_message(1, 100, b"CAM_ISO", -1))
    rig.hear(mavlink.MAVLink_param_ext_request_read_message(1, 100, b"", 2))
    rig.hear(mavlink.MAVLink_param_ext_request_read_message(1, 100, b"NOT_THERE", -1))
    assert [m.param_id for m in rig.sent] == ["CAM_ISO", "LF_DECODE"]
    assert struct.unpack("<I", rig.sent[0]._param_value_raw[:4]) == (100,)


def test_a_setting_of_ours_takes_effect_at_once() -> None:
    rig = Rig()
    assert extended(rig, b"LF_DECODE", code("off")) == [mavlink.PARAM_ACK_ACCEPTED]
    assert rig.decode == "off"
    assert extended(rig, b"LF_DECODE", 12345) == [mavlink.PARAM_ACK_VALUE_UNSUPPORTED]
    assert extended(rig, b"LF_DECODE", code("on"), 1) == [mavlink.PARAM_ACK_VALUE_UNSUPPORTED]
    assert extended(rig, b"NO_SUCH", 1) == [mavlink.PARAM_ACK_VALUE_UNSUPPORTED]


def test_a_refused_setting_is_acknowledged_with_its_value_of_now() -> None:
    rig = Rig()
    for value, kind in ((200, mavlink.MAV_PARAM_EXT_TYPE_UINT8), (200, mavlink.MAV_PARAM_EXT_TYPE_REAL32), (7, 5)):
        assert extended(rig, b"CAM_ISO", value, kind) == [mavlink.PARAM_ACK_VALUE_UNSUPPORTED]
        (ack,) = rig.of("PARAM_EXT_ACK")
        assert struct.unpack("<I", ack._param_value_raw[:4].ljust(4, b"\0")) == (100,)
    assert rig.body.asked == []


@pytest.mark.parametrize("kind", [kind for kind in range(1, 12) if kind != mavlink.MAV_PARAM_EXT_TYPE_UINT32])
def test_a_setting_in_a_type_that_is_not_its_own_changes_nothing(kind: int) -> None:
    rig = Rig()
    assert extended(rig, b"LF_DECODE", code("off"), kind) == [mavlink.PARAM_ACK_VALUE_UNSUPPORTED]
    assert rig.decode == "on"


def test_what_one_ground_station_sets_the_others_see_too() -> None:
    rig = Rig()
    rig.tick(4)
    assert extended(rig, b"LF_DECODE", code("off")) == [mavlink.PARAM_ACK_ACCEPTED]
    assert [m.param_id for m in rig.of("PARAM_EXT_VALUE")] == ["LF_DECODE"]
    assert extended(rig, b"LF_DECODE", code("off")) == [mavlink.PARAM_ACK_ACCEPTED]
    assert rig.of("PARAM_EXT_VALUE") == []
    rig.body.take("iso", "400")  # somebody turns the dial
    rig.sent.clear()
    rig.component.settings_changed()
    (value,) = rig.of("PARAM_EXT_VALUE")
    assert (value.param_id, struct.unpack("<I", value._param_value_raw[:4])) == ("CAM_ISO", (400,))


def test_a_bodys_setting_is_in_progress_until_the_body_has_it_and_a_retry_asks_it_once() -> None:
    rig = Rig()
    rig.tick(4)
    assert extended(rig, b"CAM_ISO", 400) == [mavlink.PARAM_ACK_IN_PROGRESS]
    assert extended(rig, b"CAM_ISO", 400) == [mavlink.PARAM_ACK_IN_PROGRESS]
    assert rig.body.asked == [("iso", "400")]
    rig.body.take("iso", "400")
    rig.sent.clear()
    rig.component.settings_changed()
    assert [m.param_result for m in rig.of("PARAM_EXT_ACK")] == [mavlink.PARAM_ACK_ACCEPTED]
    assert extended(rig, b"CAM_ISO", 400) == [mavlink.PARAM_ACK_ACCEPTED]


@pytest.mark.parametrize("silent", [True, False])
def test_a_body_that_will_not_or_does_not_answer_has_failed_in_words(silent: bool) -> None:
    rig = Rig()
    rig.tick(4)
    assert extended(rig, b"CAM_ISO", 200) == [mavlink.PARAM_ACK_IN_PROGRESS]
    if silent:
        rig.tick(5.1)
    else:
        rig.sent.clear()
        rig.component.settings_changed("the dial stands on Auto")
    (ack,) = rig.of("PARAM_EXT_ACK")
    assert ack.param_result == mavlink.PARAM_ACK_FAILED
    assert struct.unpack("<I", ack._param_value_raw[:4].ljust(4, b"\0")) == (100,)
    said = b"".join(m._text_raw for m in rig.of("STATUSTEXT")).decode()
    assert ("5 s" if silent else "dial stands on Auto") in said
    assert extended(rig, b"CAM_APERTURE", 8) == [mavlink.PARAM_ACK_VALUE_UNSUPPORTED]


def test_a_packet_on_two_links_is_one_packet_and_is_answered_on_both() -> None:
    rig = Rig()
    rig.tick(4)
    rig.packer.srcSystem, rig.packer.srcComponent = GCS
    message = mavlink.MAVLink_command_long_message(1, 100, mavlink.MAV_CMD_IMAGE_START_CAPTURE, 0, 0, 0, 1, 0, 0, 0, 0)
    raws = [message.pack(rig.packer), message.pack(rig.packer, force_mavlink1=True)]
    for link, raw in enumerate(raws):  # one link speaks version 1: the same packet all the same
        rig.component.on_packet(Packet(0, 0, link, mavlink.MAVLink(None).decode(bytearray(raw)), raw))
    assert rig.fired == [5]
    assert [m.result for m in rig.of("COMMAND_ACK")] == [mavlink.MAV_RESULT_ACCEPTED] * 2


def test_an_unsigned_packet_on_a_signed_link_is_heard_and_not_obeyed() -> None:
    rig = Rig()
    rig.tick(4)
    rig.trusted = False
    assert rig.command(mavlink.MAV_CMD_IMAGE_START_CAPTURE, 0, 0, 1, 0) is None
    rig.hear(mavlink.MAVLink_camera_trigger_message(1, 1), AUTOPILOT)
    rig.hear(mavlink.MAVLink_param_ext_set_message(1, 100, b"LF_DECODE", struct.pack("<I", code("off")), 5))
    assert (rig.fired, rig.decode, rig.of("COMMAND_ACK")) == ([], "on", [])


@pytest.mark.parametrize("late_s", [0.0, 60.0])
def test_an_unsigned_heartbeat_does_not_decide_whose_camera_this_is(late_s: float) -> None:
    rig = Rig()
    rig.tick(late_s)
    rig.trusted = False
    autopilot_heartbeat(rig, 66)
    rig.tick(4)
    assert (rig.system_id, rig.component.vehicle) == (1, None)
    rig.trusted = True
    autopilot_heartbeat(rig, 7)
    rig.trusted = False
    autopilot_heartbeat(rig, 66)
    rig.tick(4)
    assert (rig.system_id, rig.component.vehicle) == (7, 7)
    assert rig.autopilot.command(2000, (0,)) is None
    assert rig.of("COMMAND_LONG")[-1].target_system == 7


@pytest.mark.parametrize("counts", [True, False])
def test_feedback_is_a_shot_only_where_the_autopilot_fires(counts: bool) -> None:
    rig = Rig(fires=not counts)
    rig.tick(4)
    feedback = mavlink.MAVLink_camera_feedback_message(1, 0, 0, 1, 0, 0, 0, 0, 0, 0, 0, 0, 0, 0)
    rig.hear(feedback, AUTOPILOT)
    rig.hear(feedback, (9, 1))  # somebody else's autopilot
    assert rig.fired == ([5] if counts else [])


def test_the_echo_of_an_order_is_no_wish_and_the_next_trigger_is_one() -> None:
    rig = Rig()
    rig.hear(mavlink.MAVLink_heartbeat_message(2, mavlink.MAV_AUTOPILOT_PX4, 0, 0, 4, 3), AUTOPILOT)
    rig.tick(4)
    fire = mavlink.MAVLink_command_long_message(0, 0, mavlink.MAV_CMD_DO_DIGICAM_CONTROL, 0, 0, 0, 0, 0, 1, 0, 0)
    feedback = mavlink.MAVLink_camera_feedback_message(1, 0, 0, 1, 0, 0, 0, 0, 0, 0, 0, 0, 0, 0)
    for turn in range(2):
        assert rig.autopilot.command(mavlink.MAV_CMD_DO_DIGICAM_CONTROL, (0, 0, 0, 0, 1)) is None
        rig.clock.advance(0.05)
        for message in (mavlink.MAVLink_camera_trigger_message(1, turn), fire, feedback):
            rig.hear(message, AUTOPILOT)
        rig.clock.advance(0.5)
    assert rig.fired == []
    rig.hear(mavlink.MAVLink_camera_trigger_message(9, 2), AUTOPILOT)
    assert rig.fired == [5]
    rig.autopilot.command(mavlink.MAV_CMD_DO_DIGICAM_CONTROL, (0, 0, 0, 0, 1))
    rig.clock.advance(2.1)
    rig.hear(mavlink.MAVLink_camera_trigger_message(10, 3), AUTOPILOT)
    assert rig.fired == [5, 6]
    rig.tick(3)
    assert rig.lost_triggers == []


def test_zoom_and_focus_by_hand_are_refused_in_words() -> None:
    rig = Rig()
    rig.tick(4)
    assert rig.command(mavlink.MAV_CMD_SET_CAMERA_ZOOM, 3, 35) == mavlink.MAV_RESULT_DENIED
    assert "by hand" in rig.of("STATUSTEXT")[0].text
    assert rig.command(mavlink.MAV_CMD_SET_CAMERA_FOCUS, 0, 1) == mavlink.MAV_RESULT_DENIED
    assert "by hand" in rig.of("STATUSTEXT")[0].text


@pytest.mark.parametrize(
    ("kind", "value", "wanted"),
    [(3, 33.0, "35"), (3, 1e9, "55"), (2, 0.0, "18"), (2, 100.0, "55"), (0, 1.0, "35"), (0, -1.0, "18"),
     (4, 63.0, "18"), (1, 0.5, "35"), (1, NAN, None), (2, 101.0, None), (3, NAN, None), (4, 200.0, None)],
)  # fmt: skip
def test_a_lens_that_can_be_set_zooms_to_the_nearest_focal_length(kind: int, value: float, wanted: str | None) -> None:
    rig = Rig()
    rig.tick(4)
    rig.body.now["focal_length"] = Setting("focal_length", "24", ("18", "24", "35", "55"))
    result = rig.command(mavlink.MAV_CMD_SET_CAMERA_ZOOM, kind, value)
    assert result == (mavlink.MAV_RESULT_DENIED if wanted is None else mavlink.MAV_RESULT_ACCEPTED)
    assert rig.body.asked == ([] if wanted is None else [("focal_length", wanted)])
    rig.command(mavlink.MAV_CMD_REQUEST_MESSAGE, 260)
    assert rig.of("CAMERA_SETTINGS")[0].zoomLevel == pytest.approx(100 / 3, abs=0.01)
    rig.command(mavlink.MAV_CMD_REQUEST_MESSAGE, 259)
    assert rig.of("CAMERA_INFORMATION")[0].flags & mavlink.CAMERA_CAP_FLAGS_HAS_BASIC_ZOOM


@pytest.mark.parametrize("by_hand", [True, False])
@pytest.mark.parametrize(
    ("flag", "commands"),
    [
        ("CAPTURE_IMAGE", [(2000, 0.0, 0, 1)]),
        ("HAS_IMAGE_SURVEY_MODE", [(530, 0.0, 2)]),
        ("HAS_BASIC_ZOOM", [(531, 0, 1.0), (531, 1, 1.0), (531, 2, 50.0), (531, 3, 35.0)]),
        ("HAS_BASIC_FOCUS", [(532, 0.0, 1)]),
        ("CAPTURE_VIDEO", [(2500, 0.0, 1), (530, 0.0, 1)]),
        ("HAS_VIDEO_STREAM", [(512, 269.0, 1), (512, 270.0, 1), (534, 0.0, 1), (2502, 1.0), (2504, 1.0), (2505, 1.0)]),
    ],
)
def test_what_is_declared_is_obeyed_and_what_is_not_is_refused(
    flag: str, commands: list[tuple[float, ...]], *, by_hand: bool
) -> None:
    rig = Rig()
    if not by_hand:
        rig.body.now["focal_length"] = Setting("focal_length", "24", ("18", "24", "35", "55"))
    rig.command(mavlink.MAV_CMD_REQUEST_MESSAGE, 259)
    (information,) = rig.of("CAMERA_INFORMATION")
    declared = bool(information.flags & getattr(mavlink, f"CAMERA_CAP_FLAGS_{flag}"))
    for command, *parameters in commands:
        rig.clock.advance(2)
        obeyed = rig.command(round(command), *parameters) == mavlink.MAV_RESULT_ACCEPTED
        assert obeyed == declared


def test_a_stranger_cannot_zoom_which_changes_how_frames_are_decoded() -> None:
    rig = Rig()
    rig.tick(4)
    rig.exposed = True
    rig.body.now["focal_length"] = Setting("focal_length", "24", ("18", "24", "35", "55"))
    assert rig.command(mavlink.MAV_CMD_SET_CAMERA_ZOOM, 3, 35.0) == mavlink.MAV_RESULT_DENIED
    assert rig.body.asked == []
    assert rig.of("STATUSTEXT")[0].text.startswith("no zoom: CAM_FOCALLEN can't be set")


def test_a_continuous_zoom_goes_on_until_it_is_stopped_or_at_the_end() -> None:
    """HAS_BASIC_ZOOM is declared, and ZOOM_TYPE_CONTINUOUS was denied."""
    rig = Rig()
    rig.tick(4)
    rig.body.now["focal_length"] = Setting("focal_length", "18", ("18", "24", "35", "55", "70"))

    def asked(direction: float | None, seconds: float = 0.0) -> list[str]:
        """What the body was asked for since."""
        rig.body.asked.clear()
        if direction is not None:
            assert rig.command(mavlink.MAV_CMD_SET_CAMERA_ZOOM, 1, direction) == mavlink.MAV_RESULT_ACCEPTED
            assert len(rig.of("CAMERA_SETTINGS")) == 1
        for _ in range(round(10 * seconds)):
            if rig.body.asked:
                rig.body.take("focal_length", rig.body.asked[-1][1])
            rig.tick(0.1)
        return [value for _, value in rig.body.asked]

    assert asked(1.0, 1.5) == ["24", "35"]
    assert asked(1.0) == []  # a retry
    assert asked(0.0, 3.0) == []
    assert asked(1.0, 5.0) == ["55", "70"]
    assert asked(-1.0, 1.5) == ["55", "35"]
    assert asked(0.3, 0.5) == ["55"]
    rig.command(mavlink.MAV_CMD_SET_CAMERA_ZOOM, 2, 0.0)  # another zoom ends it
    assert asked(None, 3.0) == []


def test_an_accepted_zoom_is_answered_with_the_settings_and_again_when_the_body_has_it() -> None:
    """Peers wait for CAMERA_SETTINGS, also where the lens is there already or the command is a retry."""
    rig = Rig()
    rig.tick(4)
    rig.body.now["focal_length"] = Setting("focal_length", "18", ("18", "24", "35", "55"))
    for kind, value in ((0, 1.0), (0, 1.0), (2, 0.0), (3, 55.0)):
        rig.clock.advance(0.6)
        assert rig.command(mavlink.MAV_CMD_SET_CAMERA_ZOOM, kind, value) == mavlink.MAV_RESULT_ACCEPTED
        assert [m.get_type() for m in rig.sent] == ["COMMAND_ACK", "CAMERA_SETTINGS"]
        assert rig.sent[1].zoomLevel == 0.0
    rig.body.take("focal_length", "55")
    rig.sent.clear()
    rig.component.settings_changed()
    assert rig.of("CAMERA_SETTINGS")[0].zoomLevel == 100.0
    rig.command(mavlink.MAV_CMD_SET_CAMERA_ZOOM, 2, 101.0)
    assert rig.of("CAMERA_SETTINGS") == []


def test_a_repeated_zoom_step_is_one_step_and_another_step_is_another() -> None:
    rig = Rig()
    rig.tick(4)

    def step(after_s: float, value: float, confirmation: int = 0) -> str:
        """The focal length that the body has after it."""
        rig.clock.advance(after_s)
        result = rig.command(mavlink.MAV_CMD_SET_CAMERA_ZOOM, 0, value, confirmation=confirmation)
        assert result == mavlink.MAV_RESULT_ACCEPTED
        rig.body.take("focal_length", rig.body.asked[-1][1])
        return rig.body.now["focal_length"].value

    rig.body.now["focal_length"] = Setting("focal_length", "18", ("18", "24", "35", "55"))
    assert [step(0, 1), step(0.5, 1), step(3, 1, confirmation=1)] == ["24", "24", "24"]
    assert [step(0.1, -1), step(0.1, 1), step(2, 1), step(2, 1)] == ["18", "24", "35", "55"]


def test_field_of_view_from_lens_and_sensor() -> None:
    rig = Rig()
    rig.command(mavlink.MAV_CMD_REQUEST_MESSAGE, 271)
    (view,) = rig.of("CAMERA_FOV_STATUS")
    assert view.hfov == pytest.approx(math.degrees(2 * math.atan(22.2 / 100)), abs=1e-3)
    assert view.lat_camera == view.lat_image == 2**31 - 1
    assert math.isnan(view.q[0])


@pytest.mark.parametrize(
    ("on_gimbal", "gimbal", "q"),
    [
        (False, None, (math.sqrt(0.5), 0, -math.sqrt(0.5), 0)),  # the camera looks down, and the vehicle ahead
        (True, (math.sqrt(0.5), 0, math.sqrt(0.5), 0), (1, 0, 0, 0)),  # its head is turned up by 90°
        (True, None, (NAN,) * 4),
    ],
)
def test_a_photograph_is_told_with_the_cameras_orientation_and_its_height_above_the_ground(
    on_gimbal: bool, gimbal: Quaternion | None, q: Quaternion
) -> None:
    rig = Rig(on_gimbal=on_gimbal)
    pose = replace(no_pose(), attitude=(1.0, 0.0, 0.0, 0.0), gimbal_attitude=gimbal, height_above_home_m=60.0)
    for ground, above_m in ((None, 60_000), (GroundHeight(42.5, None, "rangefinder", 3.0), 42_500)):
        rig.component.announce(Captured(5, ok=True, pose=replace(pose, ground=ground)))
        image = rig.of("CAMERA_IMAGE_CAPTURED")[-1]
        assert tuple(image.q) == pytest.approx(q, nan_ok=True)
        assert image.relative_alt == above_m


def test_the_same_line_is_said_once_in_ten_seconds_and_a_long_one_in_pieces() -> None:
    rig = Rig()
    rig.tick(4)
    text = "the camera is absent: nothing is on the bus; plug it in, switch it on and set it to PTP"
    for _ in range(3):
        rig.component.say(text)
    pieces = rig.of("STATUSTEXT")
    assert "".join(m.text for m in pieces) == text
    assert [m.chunk_seq for m in pieces] == list(range(len(pieces)))
    assert len({m.id for m in pieces}) == 1
    rig.clock.advance(11)
    rig.component.say(text)
    assert len(rig.of("STATUSTEXT")) == 2 * len(pieces)


@given(
    st.sampled_from(
        [2000, 2001, 203, 511, 512, 521, 522, 525, 526, 527, 529, 530, 531, 532, 510, 2002, 206, 2500, 0, 65535]
    ),
    st.lists(st.one_of(st.floats(width=32), st.integers(-3, 300).map(float)), min_size=7, max_size=7),
    st.integers(0, 255),
    st.booleans(),
)
def test_no_parameters_crash_it(command: int, parameters: list[float], confirmation: int, broadcast: bool) -> None:
    rig = Rig()
    rig.tick(4)
    target = (0, 0) if broadcast else (1, 100)
    result = rig.command(command, *parameters, target=target, confirmation=confirmation)
    assert (result is None) <= broadcast
    assert len(rig.fired) <= 1
    for message in rig.sent:
        message.pack(mavlink.MAVLink(None))
    rig.tick(1)


def test_the_autopilot_is_given_orders_and_its_refusal_is_told() -> None:
    rig = Rig()
    assert rig.autopilot.command(181, (0, 1)) is not None  # nobody was heard yet
    rig.hear(mavlink.MAVLink_heartbeat_message(2, 3, 81, 0, 4, 3), sender=(1, 1))
    rig.tick(4)
    assert rig.autopilot.command(181, (0, 1)) is None
    (order,) = rig.of("COMMAND_LONG")[-1:]
    assert (order.target_system, order.target_component, order.command) == (1, 1, 181)
    assert (order.param1, order.param2, order.param7) == (0, 1, 0)
    for command, result, words in ((181, 0, 0), (999, 2, 0), (181, 2, 1)):
        rig.sent.clear()
        rig.hear(mavlink.MAVLink_command_ack_message(command, result, 0, 0, 1, 100), sender=(1, 1))
        assert len(rig.of("STATUSTEXT")) >= words
        assert bool(rig.of("STATUSTEXT")) == bool(words)


def test_a_trigger_replayed_long_after_is_the_same_photograph_and_one_of_another_instant_is_not() -> None:
    rig = Rig()
    rig.tick(4)
    rig.hear(mavlink.MAVLink_camera_trigger_message(123456, 9), AUTOPILOT)
    rig.clock.advance(13)
    rig.hear(mavlink.MAVLink_camera_trigger_message(123456, 9), AUTOPILOT)
    assert rig.fired == [5]
    rig.clock.advance(13)
    rig.hear(mavlink.MAVLink_camera_trigger_message(123457, 9), AUTOPILOT)  # rebooted: its numbers start again
    assert rig.fired == [5, 6]
    for _ in range(2):  # no time: no rule
        rig.clock.advance(13)
        rig.hear(mavlink.MAVLink_camera_trigger_message(0, 9), AUTOPILOT)
    assert rig.fired == [5, 6, 7, 8]


def test_a_command_with_a_known_number_long_after_is_a_new_photograph() -> None:
    rig = Rig()
    for turn in range(2):  # a ground station that was restarted, and numbers from 1 again
        rig.clock.advance(13)
        assert rig.command(mavlink.MAV_CMD_IMAGE_START_CAPTURE, 0, 0, 1, 1) == mavlink.MAV_RESULT_ACCEPTED
        assert rig.fired == [5, 6][: turn + 1]


def test_a_distance_between_photographs_begins_ends_and_is_refused_with_a_sentence() -> None:
    """MAV_CMD_DO_SET_CAM_TRIGG_DIST to the camera itself; one to all components is the autopilot's."""
    rig = Rig()
    assert rig.command(206, 12.5, 0, 0) == mavlink.MAV_RESULT_ACCEPTED
    found = rig.series.statistics()
    assert found is not None
    assert found.wanted == Spacing(12.5)
    for command in ((206, 0), (2001,)):  # a pilot's "stop" ends every series
        rig.command(206, 12.5)
        assert rig.command(*command) == mavlink.MAV_RESULT_ACCEPTED
        assert rig.series.statistics() is None
    said = ""
    for wrong in (-5.0, math.nan, math.inf, 1e9):
        assert rig.command(206, wrong) == mavlink.MAV_RESULT_DENIED
        said += "".join(message.text for message in rig.of("STATUSTEXT"))
    assert "must be 0 to 10000 m" in said
    assert rig.command(206, 10.0, target=(1, 0)) is None
    assert rig.series.statistics() is None
    assert Rig(fires=False).command(206, 10.0) == mavlink.MAV_RESULT_DENIED


def test_the_series_of_the_settings_begins_and_ends_by_command() -> None:
    rig = Rig(configured=Spacing(overlap=0.8))
    assert rig.command(2003, 1, -1, -1) == mavlink.MAV_RESULT_ACCEPTED
    found = rig.series.statistics()
    assert found is not None
    assert found.wanted == Spacing(overlap=0.8)
    assert rig.command(2003, -1, -1, -1) == mavlink.MAV_RESULT_ACCEPTED
    assert rig.series.statistics() is not None
    assert rig.command(2003, 0, -1, -1) == mavlink.MAV_RESULT_ACCEPTED
    assert rig.series.statistics() is None
    assert Rig().command(2003, 1, -1, -1) == mavlink.MAV_RESULT_DENIED  # there is none in the settings


def places_of_camera_ids() -> dict[int, int]:
    """Which parameter of each command is a target camera id, by the texts of the installed dialect."""
    texts = (
        (command, place, text.lower())
        for command, entry in mavlink.enums["MAV_CMD"].items()
        for place, text in entry.param.items()
    )
    return {
        command: place
        for command, place, text in texts
        if text.startswith("target camera id") or "component id of camera to address" in text
    }


CAMERA_IDS = places_of_camera_ids()


def named(command: int, camera: float) -> tuple[float, ...]:
    """A command's parameters that would do something, for this camera."""
    p: dict[int, list[float]] = {
        2000: [0, 2.0, 0, 3],
        206: [5.0],
        2003: [1],
        530: [0, mavlink.CAMERA_MODE_IMAGE_SURVEY],
        531: [2, 100.0],
    }
    parameters = [*p.get(command, []), *[0.0] * 7][:7]
    parameters[CAMERA_IDS[command] - 1] = camera
    return tuple(parameters)


def busy(rig: Rig) -> tuple[object, ...]:
    """What a command could have changed."""
    return rig.shutter.statistics().interval_s, rig.series.statistics(), rig.component._status.mode, *rig.fired


def test_the_dialect_has_the_target_camera_ids_that_are_known_of() -> None:
    assert CAMERA_IDS == {
        206: 4, 214: 3, 529: 2, 530: 1, 531: 3, 532: 3, 534: 1, 2000: 1, 2001: 1, 2003: 4, 2004: 4, 2005: 5, 2010: 1,
        2500: 3, 2501: 2, 2502: 2, 2503: 2,
    }  # fmt: skip


@pytest.mark.parametrize("command", CAMERA_IDS)
def test_a_command_for_another_camera_is_denied_and_not_done(command: int) -> None:
    """MAV_CMD_IMAGE_START_CAPTURE's text: all other values than 0 and the camera's own are denied, in a broadcast, too.
    Which others are refused in a broadcast nobody says: they may be the autopilot's own."""
    rig = Rig(configured=Spacing(2.0))
    before = busy(rig)
    for camera in (101, 2, 6, 7, 99, 255, -1, 0.5, math.inf):
        assert rig.command(command, *named(command, camera)) == mavlink.MAV_RESULT_DENIED
        to_all = mavlink.MAV_RESULT_DENIED if command in (2000, 2001) else None
        assert rig.command(command, *named(command, camera), target=(0, 0)) == to_all
        assert rig.command(command, *named(command, camera), target=(1, 0)) == to_all
        assert rig.command(command, *named(command, 0), target=(1, 101)) is None
    assert busy(rig) == before


@pytest.mark.parametrize("command", CAMERA_IDS)
@pytest.mark.parametrize("camera", [NAN, 100, 1])
def test_a_command_for_this_camera_or_all_is_answered_as_one_without_a_camera_id(command: int, camera: float) -> None:
    plain, rig = Rig(configured=Spacing(2.0)), Rig(configured=Spacing(2.0))
    assert rig.command(command, *named(command, camera)) == plain.command(command, *named(command, 0))
    assert busy(rig) == busy(plain)
    if camera != 1:  # in a broadcast 1 is the autopilot's first camera
        to_all = plain.command(command, *named(command, 0), target=(0, 0))
        assert rig.command(command, *named(command, camera), target=(0, 0)) == to_all


def test_a_stop_for_another_camera_leaves_the_series_running() -> None:
    rig = Rig()
    rig.command(mavlink.MAV_CMD_IMAGE_START_CAPTURE, 0, 2.0, 0)
    for target in ((1, 100), (1, 0), (1, 101)):
        rig.command(mavlink.MAV_CMD_IMAGE_STOP_CAPTURE, 101, target=target)
        assert rig.shutter.statistics().interval_s == 2.0
    rig.command(mavlink.MAV_CMD_IMAGE_STOP_CAPTURE, 100)
    assert rig.shutter.statistics().interval_s is None


def test_the_autopilots_requests_for_another_camera_are_not_counted_as_this_ones() -> None:
    rig = Rig()
    autopilot_heartbeat(rig, 1)
    for number, camera in ((1, 0), (5, 101), (2, 0)):
        rig.clock.advance(3)
        capture = mavlink.MAVLink_command_long_message(1, 0, 2000, 0, camera, 0, 1, number, 0, 0, 0)
        rig.hear(capture, AUTOPILOT)
    rig.tick(3)
    rig.tick(3)
    assert rig.fired == [5, 6]
    assert rig.lost_triggers == []


@pytest.mark.parametrize("nothing", [0.0, NAN])
def test_a_request_with_zeros_alone_is_one_photograph(nothing: float) -> None:
    """As ArduPilot does; with an interval it runs until it is stopped."""
    rig = Rig()
    assert rig.command(mavlink.MAV_CMD_IMAGE_START_CAPTURE, nothing, nothing, 0) == mavlink.MAV_RESULT_ACCEPTED
    assert rig.command(mavlink.MAV_CMD_IMAGE_START_CAPTURE, nothing, nothing, 0) == mavlink.MAV_RESULT_ACCEPTED
    assert rig.shutter.statistics().interval_s is None
    assert rig.fired == [5]
    assert rig.command(mavlink.MAV_CMD_IMAGE_START_CAPTURE, 0, 0.5, 0) == mavlink.MAV_RESULT_ACCEPTED
    assert (rig.shutter.statistics().interval_s, rig.shutter.statistics().interval_count) == (0.5, None)


def test_the_status_is_sent_twice_a_second_at_most_unless_it_is_asked_for() -> None:
    """A time lapse of 5 Hz changes it ten times a second."""
    rig = Rig()
    rig.tick(4)
    sent: list[float] = []
    last = 0
    for step in range(100):
        rig.component.state_changed()
        rig.command(mavlink.MAV_CMD_REQUEST_MESSAGE, 262)
        assert len(rig.of("CAMERA_CAPTURE_STATUS")) == 1  # an answer
        if step % 2 == 0 and step < 90:
            rig.shutter.request(CaptureRequest("test", "console", step, acknowledged=False))
            rig.shutter.settled(5 + step // 2, ok=True)
        rig.tick(0.1)
        for status in rig.of("CAMERA_CAPTURE_STATUS"):
            sent.append(step / 10)
            last = status.image_count
    assert 10 < len(sent) <= 20
    assert min(after - before for before, after in pairwise(sent)) >= 0.5
    assert last == 5 + 45


@pytest.mark.parametrize("by", [(512, 262.0), (527, 1.0), (512, 259.0), (521, 1.0)])
def test_a_station_that_asks_each_second_is_answered_each_time(by: tuple[float, float]) -> None:
    """One that hears nothing for three seconds drops the camera; each change has just been told without being asked."""
    rig = Rig()
    rig.tick(4)
    wanted = "CAMERA_CAPTURE_STATUS" if 262.0 in by or by[0] == 527 else "CAMERA_INFORMATION"
    for _ in range(10):
        rig.component.state_changed()
        rig.tick(1.0)
        for target in ((1, 100), (1, 0), (0, 0)):
            assert rig.command(int(by[0]), by[1], target=target) == mavlink.MAV_RESULT_ACCEPTED
            assert [m.get_type() for m in rig.sent] == ["COMMAND_ACK", wanted]
