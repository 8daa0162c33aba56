"""The MAVLink camera, message by message, without a link: what peers send, and what they must hear."""

from __future__ import annotations

import math

import pytest
from hypothesis import given
from hypothesis import strategies as st

from dappled.daemon.clock import RecordedClock
from dappled.daemon.component import CameraFacts, Captured, Component, Storage
from dappled.daemon.shutter import Shutter
from dappled.drivers.mavlink import Message, Packet, mavlink
from dappled.drivers.mavlink_framing import pack

NAN = math.nan
GCS = (255, 190)
AUTOPILOT = (1, 1)


class Rig:
    """A component whose links are a list."""

    def __init__(self) -> None:
        self.system_id, self.component_id = 1, 100
        self.packer = mavlink.MAVLink(None)
        self.copies = 1
        self.sent: list[Message] = []
        self.fired: list[int] = []
        self.obstacle: str | None = None
        self.well = True
        self.clock = RecordedClock(10**18, 10**18 - 10**9)
        self.shutter = Shutter(
            next_index=5,
            note=lambda _: None,
            fire=self.fired.append,
            clock=self.clock,
            obstacle=lambda: self.obstacle,
            on_change=lambda: self.component.state_changed(),  # noqa: PLW0108 (the component is made after the shutter)
        )
        self.component = Component(
            self,
            self.shutter,
            self.clock,
            facts=lambda: CameraFacts("Canon", "EOS 450D", (0, 1, 0), 50.0, None, None, 4272, 2848),
            storage=lambda: Storage(2**34, 2**33, 2**33),
            lookup=lambda index: Captured(index, ok=index != 3) if index < 5 else None,
            healthy=lambda: self.well,
        )

    def send(self, message: Message, link: int | None = None) -> bool:
        self.sent.append(message)
        return True

    def hear(self, message: Message, sender: tuple[int, int] = GCS, link: int = 0) -> None:
        self.packer.srcSystem, self.packer.srcComponent = sender
        raw = pack(message, self.packer, version_1=False)
        for _ in range(self.copies):
            self.component.on_packet(Packet(0, 0, link, message, raw))

    def command(self, name: int, *p: float, target: tuple[int, int] = (1, 100), confirmation: int = 0) -> int | None:
        """Its MAV_RESULT, None for no acknowledgement."""
        self.sent.clear()
        padded = (*p, *[0.0] * (7 - len(p)))
        self.hear(mavlink.MAVLink_command_long_message(*target, name, confirmation, *padded))
        acks = [m for m in self.sent if m.get_type() == "COMMAND_ACK"]
        assert len(acks) <= 1
        if acks:
            assert self.sent[0] is acks[0]  # first the answer, then the message
            assert (acks[0].target_system, acks[0].target_component) == GCS
        return int(acks[0].result) if acks else None

    def tick(self, seconds: float = 0.0) -> list[str]:
        self.clock.advance(seconds)
        self.sent.clear()
        self.component.tick()
        return [m.get_type() for m in self.sent]


def test_one_request_one_shot_acknowledged_at_once() -> None:
    rig = Rig()
    assert rig.command(mavlink.MAV_CMD_IMAGE_START_CAPTURE, 0, 0, 1, 1) == mavlink.MAV_RESULT_ACCEPTED
    assert rig.command(mavlink.MAV_CMD_IMAGE_START_CAPTURE, 0, 0, 1, 1, confirmation=1) == mavlink.MAV_RESULT_ACCEPTED
    assert rig.fired == [5]


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
    rig.obstacle = "no camera on the bus"
    result = rig.command(mavlink.MAV_CMD_IMAGE_START_CAPTURE, 0, 0, 1, 1)
    assert result == mavlink.MAV_RESULT_TEMPORARILY_REJECTED
    assert any("no camera on the bus" in str(m) for m in rig.sent)
    assert "CAMERA_CAPTURE_STATUS" in rig.tick()


@pytest.mark.parametrize(
    ("command", "parameters", "then"),
    [
        (mavlink.MAV_CMD_REQUEST_MESSAGE, (259,), "CAMERA_INFORMATION"),
        (mavlink.MAV_CMD_REQUEST_MESSAGE, (260, NAN), "CAMERA_SETTINGS"),
        (mavlink.MAV_CMD_REQUEST_MESSAGE, (261,), "STORAGE_INFORMATION"),
        (mavlink.MAV_CMD_REQUEST_MESSAGE, (262,), "CAMERA_CAPTURE_STATUS"),
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


def test_past_images_are_answered_failures_too_and_a_missing_index_means_the_last() -> None:
    rig = Rig()
    rig.tick(4)
    for index, wanted in ((0, 0), (3, 3), (NAN, 4)):
        assert rig.command(mavlink.MAV_CMD_REQUEST_MESSAGE, 263, index) == mavlink.MAV_RESULT_ACCEPTED
        rig.tick()
        (image,) = [m for m in rig.sent if m.get_type() == "CAMERA_IMAGE_CAPTURED"]
        assert (image.image_index, image.capture_result) == (wanted, int(wanted != 3))
    assert rig.command(mavlink.MAV_CMD_REQUEST_CAMERA_IMAGE_CAPTURE, 5) == mavlink.MAV_RESULT_DENIED


def test_refused_by_name_and_silent_on_broadcasts() -> None:
    rig = Rig()
    for command in (mavlink.MAV_CMD_VIDEO_START_CAPTURE, mavlink.MAV_CMD_DO_SET_CAM_TRIGG_DIST):
        assert rig.command(command, NAN) == mavlink.MAV_RESULT_UNSUPPORTED
        assert rig.command(command, NAN, target=(0, 0)) is None
    assert rig.command(mavlink.MAV_CMD_SET_CAMERA_MODE, 0, 1) == mavlink.MAV_RESULT_DENIED
    assert rig.command(mavlink.MAV_CMD_STORAGE_FORMAT, 1, 1, 1) == mavlink.MAV_RESULT_DENIED
    assert rig.command(mavlink.MAV_CMD_IMAGE_START_CAPTURE, 0, 0, 1, target=(2, 100)) is None
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


def test_heartbeats_time_requests_and_streams_come_in_time_and_none_while_faulted() -> None:
    rig = Rig()
    rig.hear(mavlink.MAVLink_heartbeat_message(2, 3, 0, 0, 4, 3), AUTOPILOT)
    first = rig.tick(1.3)
    assert first.count("HEARTBEAT") == 1
    assert first.count("COMMAND_LONG") == 4
    seen = [kind for _ in range(100) for kind in rig.tick(0.02)]
    assert seen.count("HEARTBEAT") == 2
    assert seen.count("TIMESYNC") == 10
    rig.well = False
    assert "HEARTBEAT" not in rig.tick(1.5)


@given(
    st.sampled_from([2000, 2001, 203, 511, 512, 521, 522, 525, 526, 527, 529, 530, 531, 2002, 206, 2500, 0, 65535]),
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
