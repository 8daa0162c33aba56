"""Time marks of a GNSS receiver of our own time the exposures, as the autopilot's hot shoe does."""

from __future__ import annotations

import pytest

from dappled.daemon.navigation import ExposureTime
from dappled.drivers.gnss import recorded
from dappled.drivers.gnss.ubx import TimeMark
from dappled.drivers.mavlink import mavlink
from dappled.flight import TimeSource
from dappled.mocks.autopilot.autopilot import BootTime
from tests.daemon.navigation.test_owned_triggers import MS, START_NS, Vehicle
from tests.simulated.personality import CameraPort

EXPOSED_S, HALF_MS = 10.2, 1.0


def mark(vehicle: Vehicle, count: int, at_s: float, sender: tuple[int, int] = (1, 220)) -> None:
    """The receiver has marked a contact, and says so 0.1 s later."""
    message = recorded.mark_message(TimeMark(count, START_NS + round(at_s * 1e9), 30))
    message.pack(mavlink.MAVLink(None, *sender))
    vehicle.telemetry.feed(vehicle.number, START_NS // 1000 + round((at_s + 0.1) * 1e6), message)
    vehicle.number += 1


def flown(*marks_s: float, sender: tuple[int, int] = (1, 220), pin: bool = False) -> Vehicle:
    """A vehicle whose camera exposes at 10.2 s; these marks are heard 0.1 s after they were."""
    vehicle = Vehicle(BootTime(drift=0.0), (CameraPort("wire", pin=pin),), "ardupilot")
    vehicle.fly(0, EXPOSED_S)
    if pin:
        vehicle.expose(EXPOSED_S - 0.06)
    for count, at_s in enumerate(marks_s):
        mark(vehicle, count, at_s, sender)
    vehicle.fly(EXPOSED_S, EXPOSED_S + 3)
    return vehicle


def expected(off_ms: float = 25.0) -> ExposureTime:
    """By the trigger call, with a body's latency that is not well known."""
    middle_ns = START_NS + round((EXPOSED_S + HALF_MS / 1e3) * 1e9)
    return ExposureTime(
        middle_ns + round(off_ms * MS), 15 * MS, TimeSource.TRIGGER_CALL, round(HALF_MS * MS), middle_ns - 90 * MS
    )


def test_an_exposure_has_the_time_of_its_mark() -> None:
    exposure, pose = flown(EXPOSED_S).telemetry.locate(expected())
    assert exposure.source == TimeSource.RECEIVER_MARK
    assert exposure.utc_ns == pytest.approx(START_NS + round((EXPOSED_S + HALF_MS / 1e3) * 1e9), abs=2 * MS)
    assert exposure.sigma_ns < 10 * MS
    assert pose.source == "interpolated"


def test_the_autopilot_s_contact_and_the_receiver_s_mark_are_one_contact() -> None:
    """Two contacts so near used to be none: either might have been the exposure."""
    exposure, _ = flown(EXPOSED_S + 0.004, pin=True).telemetry.locate(expected())
    assert exposure.source.contact
    assert exposure.utc_ns == pytest.approx(START_NS + round((EXPOSED_S + HALF_MS / 1e3) * 1e9), abs=6 * MS)


def test_a_contact_that_bounces_is_its_first_mark() -> None:
    exposure, _ = flown(EXPOSED_S, EXPOSED_S + 0.003, EXPOSED_S + 0.02).telemetry.locate(expected())
    assert exposure.source == TimeSource.RECEIVER_MARK
    assert exposure.utc_ns == pytest.approx(START_NS + round((EXPOSED_S + HALF_MS / 1e3) * 1e9), abs=2 * MS)


@pytest.mark.parametrize("personality", ["ardupilot", "px4"])
@pytest.mark.parametrize("marked", [True, False])
def test_a_body_that_the_autopilot_fires_by_wire_has_the_time_of_its_mark(personality: str, marked: bool) -> None:
    """Its hot shoe leads to the receiver: the autopilot has the time of its command only, ± the body's latency."""
    vehicle = Vehicle(BootTime(drift=0.0), (CameraPort("wire"),), personality)
    vehicle.fly(0, EXPOSED_S)
    vehicle.expose(EXPOSED_S - 0.06)
    if marked:
        mark(vehicle, 0, EXPOSED_S + 0.02)  # 20 ms later than the body is said to be
    vehicle.fly(EXPOSED_S, EXPOSED_S + 3)
    (_, own), *_ = vehicle.shots()
    exposure, pose = vehicle.telemetry.locate(own)
    assert exposure.source == (TimeSource.RECEIVER_MARK if marked else exposure.source)
    late_ns = 20 * MS if marked else 0
    assert exposure.utc_ns == pytest.approx(START_NS + round((EXPOSED_S + 0.001) * 1e9) + late_ns, abs=3 * MS)
    assert exposure.sigma_ns < (8 if marked else 13) * MS
    assert pose.source == "interpolated"
    if not marked:
        assert exposure.source == TimeSource.AUTOPILOT_TRIGGER


@pytest.mark.parametrize("sender", [(2, 220), (1, 100), (1, 154)], ids=["another vehicle", "a camera", "a gimbal"])
def test_marks_of_others_are_not_taken(sender: tuple[int, int]) -> None:
    exposure, _ = flown(EXPOSED_S, sender=sender).telemetry.locate(expected())
    assert exposure.source == TimeSource.TRIGGER_CALL


def test_a_mark_far_from_the_call_is_another_one_s() -> None:
    exposure, _ = flown(EXPOSED_S + 0.5).telemetry.locate(expected())
    assert exposure.source == TimeSource.TRIGGER_CALL


def test_an_exposure_is_settled_when_its_mark_is_there_or_has_had_time_to_come() -> None:
    """Receivers send their marks with the next solution: at 1 Hz up to a second later."""
    vehicle = flown(EXPOSED_S - 5, EXPOSED_S)
    last_s = EXPOSED_S + 2.8  # of the last sample
    assert vehicle.telemetry.settled(expected())
    for ago_s, settled in ((1.3, True), (0.9, False)):
        unmarked = ExposureTime(START_NS + round((last_s - ago_s) * 1e9), MS, TimeSource.TRIGGER_CALL, 0, 0)
        assert vehicle.telemetry.settled(unmarked) == settled
