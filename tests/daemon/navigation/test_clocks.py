"""Which hot-shoe word belongs to which exposure, the camera's own clock, and the figures of a whole flight."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest

from dappled.daemon.navigation import BodyLatency, BootClock, CameraClock, ExposureTime, Telemetry, clocks
from dappled.daemon.navigation.clocks import (
    TimesyncAnswer,
    TriggerMessage,
    camera_time,
    exposure_from_camera,
    mid_exposure,
)
from dappled.daemon.navigation.samples import Feedback
from dappled.drivers.mavlink import MavlinkMessage, mavlink
from dappled.findings import FRAME, Code, finding
from dappled.flight import TimeSource
from dappled.mocks.autopilot.autopilot import BootTime
from dappled.mocks.autopilot.path import FlightPath
from tests.benchmarks import program
from tests.simulated.vehicle import flight

MS = 10**6
START_NS = 1_790_000_000 * 10**9
CLOCK = BootClock("timesync", 0, START_NS, 0.0, 0.3 * MS)
EXPECTED = mid_exposure(START_NS + 10**9, BodyLatency(60.0, 10.0), 0.002)


def event(after_call_ms: float, number: int = 0, image: int = 0) -> Feedback:
    boot_ns = 10**9 + round(after_call_ms * MS)
    return Feedback(number, START_NS + boot_ns, boot_ns, "CAMERA_FEEDBACK", image)


@pytest.mark.parametrize("count", [1, 30])
def test_sigma_is_the_error_of_a_clock_that_answers_tell(count: int) -> None:
    """Of one answer its round trip is lost on either way, evenly; of many, each way now and then takes long."""
    chance = np.random.default_rng(count)
    ratios = []
    for _ in range(300):
        answers = []
        for second in range(count):
            there = chance.uniform(0, 4) if count == 1 else 1 + chance.exponential(2)
            back = 4 - there if count == 1 else 1 + chance.exponential(2)
            sent, received = (START_NS + second * 10**9 + round(MS * way) for way in (-there, back))
            answers.append(TimesyncAnswer(second, sent, received, second * 10**9))
        clock = clocks.from_few(answers) if count == 1 else clocks.from_timesync(answers)
        assert clock is not None
        ratios.append((clock.utc_ns(answers[-1].boot_ns) - START_NS - answers[-1].boot_ns) / clock.sigma_ns)
    assert 0.8 < np.sqrt(np.mean(np.square(ratios))) < 1.2


@pytest.mark.parametrize(("there_ms", "back_ms"), [(0, 0), (40, 0), (0, 60), (80, 100)])
def test_what_two_round_trips_can_explain_is_no_step(there_ms: int, back_ms: int) -> None:
    """The first answer took all of its round trip on the way there, the second on the way back: half of both apart, at
    most. Two thousandths of a second more are a step."""
    first = TimesyncAnswer(0, START_NS, START_NS + there_ms * MS, there_ms * MS)
    for step_ms in (0, 2, -(there_ms + back_ms + 2)):
        later_ns = START_NS + 10**9
        second = TimesyncAnswer(1, later_ns, later_ns + back_ms * MS, 10**9 - step_ms * MS)
        assert clocks.stepped_since([first], second) is (first if step_ms else None)


def test_the_contact_is_taken_and_half_the_exposure_added() -> None:
    chosen = clocks.choose_feedback([event(55)], EXPECTED, CLOCK)
    assert chosen == event(55)
    better, boot_ns = clocks.refine(EXPECTED, event(55), CLOCK)
    assert boot_ns == 10**9 + 56 * MS
    assert better.utc_ns == START_NS + boot_ns
    assert better.source == TimeSource.HOT_SHOE
    assert MS <= better.sigma_ns < 1.1 * MS


@pytest.mark.parametrize("after_call_ms", [-200, -30, 0, 2.5])
def test_the_word_for_a_mere_wish_is_not_taken(after_call_ms: float) -> None:
    assert clocks.choose_feedback([event(after_call_ms)], EXPECTED, CLOCK) is None
    assert clocks.choose_feedback([event(after_call_ms), event(64, 1)], EXPECTED, CLOCK) == event(64, 1)


def test_what_is_far_off_or_of_two_minds_is_not_taken() -> None:
    assert clocks.choose_feedback([event(152)], EXPECTED, CLOCK) is None
    assert clocks.choose_feedback([event(50), event(71, 1, image=1)], EXPECTED, CLOCK) is None
    assert clocks.choose_feedback([event(55), event(55, 1)], EXPECTED, CLOCK) == event(55)  # the same, on a second link
    assert clocks.choose_feedback([event(55)], ExposureTime(EXPECTED.utc_ns, 10 * MS, TimeSource.GIVEN), CLOCK) is None


@pytest.mark.parametrize("contact_ms", [45, 58, 75])
def test_a_contact_that_bounces_is_its_first_one(contact_ms: int) -> None:
    """The second one was taken where it was nearer to the expected time: 15 ms wrong with a sigma of 1 ms."""
    bounced = [event(contact_ms + 15, 0, 7), event(contact_ms, 1, 7), event(contact_ms + 31, 2, 7)]
    assert clocks.choose_feedback(bounced, EXPECTED, CLOCK) == bounced[1]
    trigger = TriggerMessage("CAMERA_FEEDBACK", 7, START_NS + 10**9 + 60 * MS, BodyLatency(60.0, 10.0))
    repeated = event(contact_ms - 500, 3, 7)  # another camera's report repeated the contact before, with this number
    assert clocks.own_feedback([*bounced, repeated], trigger) == bounced[1]


@pytest.mark.parametrize("latency_ms", [-25, 0, 25])
def test_at_five_a_second_a_lost_contact_is_not_replaced_by_the_next_shots(latency_ms: int) -> None:
    """The default latency, 60 ± 30 ms: the next shot's contact is 200 ms after the one that was lost."""
    expected = mid_exposure(START_NS + 10**9, BodyLatency(60.0, 30.0), 0.002)
    before, after = event(60 - 200), event(260 + latency_ms, 1)
    assert clocks.choose_feedback([before, after], expected, CLOCK) is None
    own = event(60 + latency_ms, 2)
    assert clocks.choose_feedback([before, own, after], expected, CLOCK) == own
    doubled = event(60 + latency_ms, 3)
    assert clocks.choose_feedback([before, own, doubled, after], expected, CLOCK) == own


@pytest.mark.parametrize("sigma_ms", [21, 30, 60])
@pytest.mark.parametrize("spacing_ms", [200, 250])
def test_a_wide_clock_takes_no_other_shots_contact(sigma_ms: int, spacing_ms: int) -> None:
    """The own contact could not be told from the call, and was left out: the next shot's was then the nearest."""
    expected = mid_exposure(START_NS + 10**9, BodyLatency(60.0, 30.0), 0.002)
    wide = BootClock("arrival", 0, START_NS, 0.0, sigma_ms * MS)
    contacts = [event(60 + spacing_ms * number, number, number) for number in range(5)]
    assert clocks.choose_feedback(contacts, expected, wide) is None


def test_by_a_clock_in_doubt_no_contact_is_chosen() -> None:
    stepped = BootClock("timesync", 0, START_NS, 0.0, 0.3 * MS, finding(Code.CLOCK_STEPPED, FRAME, steps=1, by_s=0.3))
    assert clocks.choose_feedback([event(55)], EXPECTED, stepped) is None


def made(message: MavlinkMessage, component: int = 1) -> MavlinkMessage:
    message.pack(mavlink.MAVLink(None, srcSystem=1, srcComponent=component))
    return message


@pytest.mark.parametrize("kind", ["CAMERA_FEEDBACK", "CAMERA_TRIGGER"])
@pytest.mark.parametrize("epoch", ["boot", "gps"])
def test_a_contact_places_the_frame_and_the_time_of_a_command_does_not(kind: str, epoch: str) -> None:
    """Only ArduPilot's pin gives the contact, since boot. The packets below a replay's limit decide."""
    boot, path, number = BootTime(), FlightPath(3), 0
    telemetry = Telemetry()
    contact_s = 8.0585

    def feed(t_s: float, message: MavlinkMessage) -> None:
        nonlocal number
        telemetry.feed(number, START_NS // 1000 + round(t_s * 1e6), made(message))
        number += 1

    limit = 0
    for t_s, message in flight(path, boot, 0, 10):
        if limit == 0 and t_s > contact_s + 0.3:
            limit = number
            time_us = boot.ns(contact_s) // 1000 if epoch == "boot" else START_NS // 1000 + round(contact_s * 1e6)
            told = (
                mavlink.MAVLink_camera_trigger_message(time_us, 1)
                if kind == "CAMERA_TRIGGER"
                else mavlink.MAVLink_camera_feedback_message(time_us, 1, 0, 1, 0, 0, 0, 0, 0, 0, 0, 0, 0)
            )
            feed(t_s, told)
        if message.get_type() == "SYSTEM_TIME":
            message.time_unix_usec = START_NS // 1000 + round(t_s * 1e6)
        feed(t_s, message)
    expected = mid_exposure(START_NS + 8 * 10**9, BodyLatency(60.0, 10.0), None)
    exposure, pose = telemetry.locate(expected)
    assert telemetry.statistics().feedbacks == 1
    if (kind, epoch) != ("CAMERA_FEEDBACK", "boot"):
        assert exposure == expected
        return
    assert exposure.source == TimeSource.HOT_SHOE
    assert exposure.utc_ns == pytest.approx(START_NS + contact_s * 1e9, abs=2 * MS)
    assert pose.boot_us is not None
    assert pose.boot_us == pytest.approx(boot.ns(contact_s) / 1e3, abs=1500)
    before, _ = telemetry.locate(expected, upto_packet=limit)
    assert before == expected


def test_the_cameras_clock_is_learnt_from_shots() -> None:
    clock, offset_ns = CameraClock(), -3_600_370 * MS
    for number in range(100):
        begin_ns = START_NS + number * 1_370 * MS
        known = ExposureTime(begin_ns + MS, 10 * MS, TimeSource.TRIGGER_CALL, MS)
        assert (exposure_from_camera(clock, 0, 10**9, None) is None) == (number < 3)
        clock = clock.learnt((begin_ns + offset_ns) // 10**9 * 10**9, 10**9, known)
    found = clock.offset_ns()
    assert found is not None
    assert abs(found[0] - offset_ns) < 4 * found[1]
    exposure = exposure_from_camera(clock, (START_NS + offset_ns) // 10**9 * 10**9, 10**9, 0.002)
    assert exposure is not None
    assert abs(exposure.utc_ns - START_NS - MS) <= 0.6 * 10**9
    assert exposure.sigma_ns == pytest.approx(290 * MS, rel=0.02)


def test_a_camera_clock_that_was_set_is_learnt_anew() -> None:
    clock = CameraClock()
    for number in range(8):
        begin_ns = START_NS + number * 10**9
        offset_ns = 0 if number < 5 else 3_600 * 10**9
        clock = clock.learnt(begin_ns + offset_ns, 10**9, ExposureTime(begin_ns, MS, TimeSource.TRIGGER_CALL))
        assert (clock.offset_ns() is None) == (number in (0, 1, 5, 6))
    found = clock.offset_ns()
    assert found is not None
    assert abs(found[0] - 3_600 * 10**9) <= 10**9


def test_what_exif_shows() -> None:
    assert camera_time("1970-01-02T00:00:01") == (86_401 * 10**9, 10**9)
    assert camera_time("1970-01-01T00:00:01.25") == (1_250 * MS, 10 * MS)
    assert camera_time("not a time") is None
    assert camera_time("1970-01-01T00:00:01.x") is None
    assert camera_time(None) is None


@pytest.mark.slow
@pytest.mark.parametrize("seed", [1, *(pytest.param(seed, marks=pytest.mark.long) for seed in (2, 3, 4))])
def test_a_flight_is_placed_as_well_as_promised_and_says_so(seed: int) -> None:
    """The body's latency has σ = 10 ms: 15 cm and 0.30° at this speed and turn, and a fifteenth by chance."""
    figures: dict[str, Any] = program("pose").measure(300, seed)
    assert figures["hot_shoe"]["position_rms_m"] <= 0.03
    assert figures["hot_shoe"]["attitude_rms_deg"] <= 0.05
    assert figures["body_latency"]["position_rms_m"] <= 0.16
    assert figures["body_latency"]["attitude_rms_deg"] <= 0.32
    for row in figures.values():
        assert row["frames"] >= 297
        for what in ("time", "position", "attitude"):
            assert 0.8 <= row[f"{what}_sigma_over_error"] <= 1.2, what


def test_each_sample_of_a_real_flight_is_predicted_by_its_neighbours(shared_data: Path) -> None:
    """A copter, one sample in half a second: with one left out a second is bridged, and the doubt is as large as the
    error."""
    rows: dict[str, Any] = program("pose").leave_one_out(shared_data / "telemetry" / "dronekit-flight.tlog")
    assert rows["position_m"]["samples"] > 2600
    assert rows["attitude_deg"]["samples"] > 2800
    assert rows["position_m"]["median"] < 0.05
    assert rows["position_m"]["rms"] < 0.2
    assert rows["attitude_deg"]["median"] < 0.05
    for row in rows.values():
        assert 0.8 <= row["doubt_over_error"] <= 1.2
        assert row["within_2_doubts"] > 0.9
        assert row["refused"] < 20


BODY = BodyLatency(60.0, 15.0)


def test_mid_exposure_is_latency_and_half_the_exposure_after_the_call() -> None:
    found = clocks.mid_exposure(1_000, BODY, 0.02)
    assert (found.utc_ns, found.sigma_ns, found.source) == (70_001_000, 15_000_000, TimeSource.TRIGGER_CALL)
    assert clocks.mid_exposure(0, BODY, None).utc_ns == 60_000_000


def test_without_a_trigger_call_the_request_and_the_file_bound_the_exposure() -> None:
    """The time of the trigger call is unknown: it was made between the request and the file."""
    found = clocks.mid_exposure_by_request(0, 3_070_000_000, BODY, 0.02)
    assert found.utc_ns == 70_000_000
    assert found.source == TimeSource.REQUEST
    assert found.sigma_ns == pytest.approx(2.99e9 / 3**0.5, rel=1e-3)
    assert found.called_utc_ns == 0
    early = clocks.mid_exposure_by_request(0, 10_000_000, BODY, None)
    assert early.sigma_ns == 15_000_000  # a stamp before the exposure bounds nothing
    assert clocks.mid_exposure_by_request(0, None, BODY, None).sigma_ns > 500_000_000
