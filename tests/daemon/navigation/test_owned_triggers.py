"""A shot that the autopilot's message created has that message's time: of the contact, or of the command to fire."""

from __future__ import annotations

import pytest

from dappled.config.settings import CameraSettings, MavlinkSettings
from dappled.daemon.navigation import BodyLatency, ExposureTime, Telemetry, clocks
from dappled.drivers.mavlink import MavlinkMessage, mavlink
from dappled.findings import Code
from dappled.flight import Cause, Shot, TimeSource
from dappled.mocks.autopilot.autopilot import BootTime, telemetry_message
from dappled.mocks.autopilot.path import FlightPath
from tests.simulated.personality import CameraPort, CameraTriggers

START_NS = 1_790_000_000 * 10**9
MS = 10**6
LATENCY = BodyLatency(60.0, 10.0, fired_outside=True)
WIRED = CameraPort("wire", pin=True)


class Vehicle:
    """A vehicle with a camera on a wire, and what the daemon hears of it. `heard` are (message, when)."""

    def __init__(self, boot: BootTime, cameras: tuple[CameraPort, ...], personality: str, cam_idx: int = 0) -> None:
        self.boot, self.pose = boot, FlightPath(3).pose(0.0)
        self.telemetry = Telemetry(cam_idx=cam_idx)
        self.autopilot = CameraTriggers(personality, cameras)
        self.heard: list[tuple[MavlinkMessage, int]] = []
        self.number = 0

    def say(self, message: MavlinkMessage, utc_ns: int) -> None:
        message.pack(mavlink.MAVLink(None, srcSystem=1, srcComponent=1))
        self.telemetry.feed(self.number, utc_ns // 1000, message)
        self.number += 1
        self.heard.append((message, utc_ns))

    def fly(self, start_s: float, stop_s: float) -> None:
        """Telemetry at 5 Hz, which arrives at once."""
        for step in range(round(start_s * 5), round(stop_s * 5)):
            t_s = step / 5
            for kind in (mavlink.MAVLINK_MSG_ID_GLOBAL_POSITION_INT, mavlink.MAVLINK_MSG_ID_ATTITUDE):
                message = telemetry_message(kind, self.pose, self.boot.ns(t_s))
                self.say(message, START_NS + round(t_s * 1e9))
            unix_us = START_NS // 1000 + round(t_s * 1e6)
            system = mavlink.MAVLink_system_time_message(unix_us, self.boot.ns(t_s) // 10**6)
            self.say(system, START_NS + round(t_s * 1e9))

    def expose(self, at_s: float, *, contact: bool = True, camera: int = 0) -> None:
        """It triggers the camera; the shutter opens 60 ms later, and the daemon hears of both 5 ms after they were."""
        unix_us = START_NS // 1000 + round(at_s * 1e6)
        for message in self.autopilot.trigger(self.boot.ns(at_s) // 1000, unix_us, camera):
            self.say(message, START_NS + round((at_s + 0.005) * 1e9))
        for message in self.autopilot.contact(self.boot.ns(at_s + 0.06) // 1000, camera) if contact else ():
            self.say(message, START_NS + round((at_s + 0.065) * 1e9))

    def shots(self, cam_idx: int = 0) -> list[tuple[Shot, ExposureTime]]:
        """What the daemon expects of each message that is a shot: requested and "called" as it was heard."""
        made = []
        for message, utc_ns in self.heard:
            kind = message.get_type()
            if kind == "CAMERA_TRIGGER" or (kind == "CAMERA_FEEDBACK" and message.cam_idx == cam_idx):
                number = message.seq if kind == "CAMERA_TRIGGER" else message.img_idx
                shot = Shot(number, Cause("mavlink:1/1", kind, number), utc_ns, utc_ns)
                made.append((shot, clocks.owned(clocks.mid_exposure(utc_ns + MS, LATENCY, 0.002), shot, LATENCY)))
        return made


@pytest.mark.parametrize(
    ("personality", "port"),
    [("ardupilot", WIRED), ("ardupilot", CameraPort("wire")), ("px4", CameraPort("wire")), ("px4", WIRED)],
    ids=["ardupilot, pin", "ardupilot, no pin", "px4", "px4, contact"],
)
@pytest.mark.parametrize(
    ("booted_s", "hz"),
    [(41.7, 5.0), (2**32 / 1e6 - 10.1, 0.25), (2**32 / 1e6 - 10.1, 5.0), (2**33 / 1e6 + 300, 5.0)],
    ids=["early", "wrapping slowly", "wrapping", "late"],
)
def test_each_shot_has_its_own_time(personality: str, port: CameraPort, hz: float, booted_s: float) -> None:
    """They were 68 to 87 ms wrong, at 5 Hz 220.7 ms with a sigma of 1 ms, and after 71.6 minutes without a time."""
    vehicle = Vehicle(BootTime(booted_s, drift=0.0), (port,), personality)
    vehicle.fly(0, 8)
    for number in range(10):
        at_s = 8 + number / hz
        vehicle.expose(at_s)
        vehicle.fly(at_s + 0.06, at_s + 1 / hz)
    vehicle.fly(8 + 10 / hz, 10 + 10 / hz)
    shots = vehicle.shots()
    assert len(shots) == 10
    for number, (_, expected) in enumerate(shots):
        exposure, pose = vehicle.telemetry.locate(expected)
        truth_ns = START_NS + round((8 + number / hz + 0.061) * 1e9)
        assert abs(exposure.utc_ns - truth_ns) < 3 * MS
        assert exposure.source == (TimeSource.HOT_SHOE if port.pin else TimeSource.AUTOPILOT_TRIGGER)
        assert pose.boot_us is not None
        assert pose.boot_us == pytest.approx(vehicle.boot.ns(8 + number / hz + 0.061) / 1e3, abs=1000)
        assert exposure.sigma_ns < (6 if port.pin else 12) * MS


@pytest.mark.parametrize("of_contact", [True, False])
def test_px4s_own_report_of_a_photograph_has_the_time_of_the_contact_or_of_the_trigger(*, of_contact: bool) -> None:
    """With CAM_CAP_FBACK nothing else need come; without it CAMERA_TRIGGER has the same time, and may come later."""
    vehicle = Vehicle(BootTime(drift=0.0), (WIRED,), "px4")
    vehicle.fly(0, 8)
    for number in range(5):
        boot_us, heard_ns = vehicle.boot.ns(8 + number) // 1000, START_NS + round((8.005 + number) * 1e9)
        (captured,) = vehicle.autopilot.contact(boot_us + 60_000 * of_contact)
        vehicle.say(captured, heard_ns + 60 * MS * of_contact)
        if not of_contact:
            vehicle.say(mavlink.MAVLink_camera_trigger_message(boot_us, number), heard_ns)
        vehicle.fly(8.1 + number, 9 + number)
    for number in range(5):
        heard_ns = START_NS + round((8.005 + number + 0.06 * of_contact) * 1e9)
        shot = Shot(number, Cause("mavlink:1/1", "CAMERA_IMAGE_CAPTURED", number), heard_ns, heard_ns)
        expected = clocks.owned(clocks.mid_exposure(heard_ns, LATENCY, 0.002), shot, LATENCY)
        exposure, _ = vehicle.telemetry.locate(expected)
        assert abs(exposure.utc_ns - START_NS - round((8.061 + number) * 1e9)) < 3 * MS
        assert exposure.source == (TimeSource.HOT_SHOE if of_contact else TimeSource.AUTOPILOT_TRIGGER)


@pytest.mark.parametrize("hz", [0.25, 1.0, 5.0])
@pytest.mark.parametrize("other_first", [True, False])
def test_two_cameras_that_are_triggered_together_have_their_own_times(hz: float, other_first: bool) -> None:
    """ArduPilot counts at the trigger and stamps at the contact: the report of the camera whose contact comes first
    repeats the other's old time with its new number. Each frame had the time of the exposure before it, with 5 ms."""
    vehicle = Vehicle(BootTime(drift=0.0), (WIRED, WIRED), "ardupilot")
    vehicle.fly(0, 8)
    for number in range(6):
        at_s = 8 + number / hz
        vehicle.autopilot.trigger(vehicle.boot.ns(at_s) // 1000, camera=None)
        for camera in (1, 0) if other_first else (0, 1):
            contact_s = at_s + (0.06 if camera == 0 else 0.055 if other_first else 0.065)
            for message in vehicle.autopilot.contact(vehicle.boot.ns(contact_s) // 1000, camera):
                vehicle.say(message, START_NS + round((contact_s + 0.003) * 1e9))
        vehicle.fly(at_s + 0.1, at_s + 1 / hz)
    vehicle.fly(8 + 6 / hz, 10 + 6 / hz)
    for number in range(6):
        heard_ns = START_NS + round((8 + number / hz + 0.058) * 1e9)
        shot = Shot(number, Cause("mavlink:1/1", "CAMERA_FEEDBACK", number + 1), heard_ns, heard_ns)
        expected = clocks.owned(clocks.mid_exposure(heard_ns, LATENCY, None), shot, LATENCY)
        exposure, _ = vehicle.telemetry.locate(expected)
        assert abs(exposure.utc_ns - START_NS - round((8 + number / hz + 0.06) * 1e9)) < 3 * MS


def test_another_cameras_contact_and_a_time_of_zero_are_no_times() -> None:
    vehicle = Vehicle(BootTime(), (WIRED, WIRED), "ardupilot", cam_idx=1)
    vehicle.fly(0, 8)
    vehicle.expose(8.0, camera=0)  # (time, 0, 1) and (0, 1, 0)
    vehicle.fly(8.06, 10)
    assert vehicle.telemetry.statistics().feedbacks == 0
    vehicle.expose(10.0, camera=1)
    assert vehicle.telemetry.statistics().feedbacks == 1


def test_a_shot_without_a_contact_has_no_other_shots_time() -> None:
    """The second of three contacts is lost; its shot was reported without satellites, so without a time."""
    vehicle = Vehicle(BootTime(), (WIRED,), "ardupilot")
    vehicle.fly(0, 8)
    for at_s in (8.0, 8.2, 8.4):
        vehicle.expose(at_s, contact=at_s != 8.2)
    vehicle.fly(8.5, 10)
    lost_ns = START_NS + 8_265 * MS
    shot = Shot(2, Cause("mavlink:1/1", "CAMERA_FEEDBACK", 2), lost_ns, lost_ns)
    expected = clocks.owned(clocks.mid_exposure(lost_ns, LATENCY, None), shot, LATENCY)
    exposure, _ = vehicle.telemetry.locate(expected)
    assert exposure.utc_ns == expected.utc_ns
    assert exposure.sigma_ns >= 300 * MS
    assert [one.code for one in exposure.doubts] == [Code.TIME_TRIGGER_UNUSABLE]


def test_a_report_from_before_a_reboot_is_no_time_of_a_shot_after_it() -> None:
    """The autopilot's clock starts again: both were exposed 13.06 s after a start."""
    vehicle = Vehicle(BootTime(5.0, drift=0.0), (WIRED,), "ardupilot")
    vehicle.fly(0, 8)
    vehicle.expose(8.0)
    vehicle.fly(8.1, 10)
    vehicle.boot = BootTime(-9.0, drift=0.0)
    vehicle.fly(10, 24)
    exposure, _ = vehicle.telemetry.locate(clocks.mid_exposure(START_NS + 22_000 * MS, BodyLatency(60.0, 15.0), 0.002))
    assert exposure.source != TimeSource.HOT_SHOE


def test_what_a_trigger_creates_and_the_settings_that_say_so() -> None:
    inside = BodyLatency.of(CameraSettings())
    outside = BodyLatency.of(CameraSettings(driver="folder"))
    assert (inside.fired_outside, outside.fired_outside) == (False, True)
    assert not CameraSettings(driver="folder", shutter="relay:0").fired_outside
    exposure = clocks.mid_exposure(START_NS, inside, None)
    for kind in ("CAMERA_FEEDBACK", "CAMERA_TRIGGER", "IMAGE_START_CAPTURE"):
        shot = Shot(1, Cause("mavlink:1/1", kind, 1), START_NS, START_NS)
        assert clocks.owned(exposure, shot, inside) == exposure
        assert (clocks.owned(exposure, shot, outside).trigger is not None) == kind.startswith("CAMERA")
    assert [MavlinkSettings(component_id=one).cam_idx for one in (100, 101, 105, 42)] == [0, 1, 5, 0]
    assert MavlinkSettings(component_id=101, autopilot_camera=1).cam_idx == 0
