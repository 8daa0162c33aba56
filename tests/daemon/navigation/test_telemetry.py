"""Poses against the truth of a simulated flight, against a real flight's own samples, and the clock filters."""

from __future__ import annotations

import math
import random
import struct
from collections.abc import Iterator
from dataclasses import asdict
from pathlib import Path as File

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from dappled.daemon.navigation import Telemetry, first_position_utc_ns
from dappled.daemon.navigation.clocks import TimesyncAnswer, from_arrivals, from_timesync
from dappled.daemon.navigation.navigation import HISTORY_NS
from dappled.daemon.navigation.samples import MOST_SAMPLES
from dappled.decode.geometry import Pose, from_euler, hermite, metres_per_radian, normalised, slerp, turn_rad
from dappled.drivers.mavlink import MavlinkMessage, PacketParser, mavlink
from dappled.findings import Code
from dappled.flight import digest
from dappled.mocks.autopilot.autopilot import BootTime
from dappled.mocks.autopilot.path import FlightPath, TruePose
from tests.simulated.vehicle import flight

START_NS = 1_790_000_000 * 10**9
BOOT = BootTime()
Stamped = tuple[int, int, MavlinkMessage]


def numbered(events: list[tuple[int, MavlinkMessage]]) -> list[Stamped]:
    return [(number, stamp, message) for number, (stamp, message) in enumerate(sorted(events, key=lambda e: e[0]))]


def made(message: MavlinkMessage, component: int = 1) -> MavlinkMessage:
    """With a header, as received."""
    message.pack(mavlink.MAVLink(None, srcSystem=1, srcComponent=component))
    return message


def recording(
    path: FlightPath,
    seconds: float,
    *,
    latency_s: float = 0.0,
    jitter_s: float = 0.0,
    timesync: bool = True,
    seed: int = 1,
) -> list[Stamped]:
    """What the daemon would log of a simulated flight that began at START_NS."""
    rng = random.Random(seed)  # noqa: S311 (a simulation)

    def delay() -> float:
        return max(0.0, rng.gauss(latency_s, jitter_s)) if jitter_s else latency_s

    def us(t_s: float) -> int:
        return START_NS // 1000 + round(t_s * 1e6)

    events = [(us(t + delay()), made(message)) for t, message in flight(path, BOOT, 0, seconds)]
    for step in range(round(seconds * 5) if timesync else 0):
        sent_s = step / 5
        ts1 = us(sent_s) * 1000
        there_s = sent_s + delay()
        events.append((us(sent_s) + 1, made(mavlink.MAVLink_timesync_message(0, ts1), component=100)))
        answer = mavlink.MAVLink_timesync_message(BOOT.ns(there_s), ts1)
        events.append((us(there_s + delay()) + 2, made(answer)))
    return numbered(events)


def fed(packets: list[Stamped]) -> Telemetry:
    telemetry = Telemetry()
    for packet in packets:
        telemetry.feed(*packet)
    return telemetry


def position_error_m(pose: Pose, truth: TruePose) -> float:
    assert pose.latitude_rad is not None
    assert pose.longitude_rad is not None
    assert pose.altitude_msl_m is not None
    north, east = metres_per_radian(math.radians(truth.latitude_deg), truth.altitude_msl_m)
    return math.hypot(
        (pose.latitude_rad - math.radians(truth.latitude_deg)) * north,
        (pose.longitude_rad - math.radians(truth.longitude_deg)) * east,
        pose.altitude_msl_m - truth.altitude_msl_m,
    )


def rms(values: list[float]) -> float:
    return float(np.sqrt(np.mean(np.square(values))))


@pytest.mark.parametrize(
    ("latency_s", "jitter_s", "speed_m_s"), [(0.0005, 0.0, 3.0), (0.02, 0.01, 3.0), (0.02, 0.01, 15.0)]
)
def test_poses_match_the_true_path(latency_s: float, jitter_s: float, speed_m_s: float) -> None:
    """Exact exposure times, 10 Hz position, 50 Hz attitude, 50 ppm drift."""
    path = FlightPath(3, speed_m_s=speed_m_s, radius_m=60 if speed_m_s > 10 else 25)
    telemetry = fed(recording(path, 40, latency_s=latency_s, jitter_s=jitter_s))
    times = np.random.default_rng(5).uniform(33, 39, 60)
    errors, angles, sigmas = [], [], []
    for t_s in times:
        pose = telemetry.pose_at(START_NS + round(float(t_s) * 1e9), 0)
        truth = path.pose(float(t_s))
        assert pose.source == "interpolated"
        assert pose.attitude is not None
        errors.append(position_error_m(pose, truth))
        angles.append(math.degrees(turn_rad(pose.attitude, truth.attitude)))
        sigmas.append(pose.position_sigma_m or 0.0)
    assert rms(errors) <= 0.03
    assert rms(angles) <= 0.05
    assert rms(errors) <= 2 * rms(sigmas)


def test_a_replay_gets_the_same_pose_whether_it_stops_at_the_limit_or_read_on() -> None:
    packets = recording(FlightPath(3), 20, latency_s=0.02, jitter_s=0.01)
    utc_ns = START_NS + 11 * 10**9
    telemetry = Telemetry()
    live = None
    for number, stamp_us, message in packets:
        telemetry.feed(number, stamp_us, message)
        if live is None and telemetry.bracketed(utc_ns):
            live = telemetry.pose_at(utc_ns, 10**6)
    assert live is not None
    assert live.source == "interpolated"
    later = telemetry.pose_at(utc_ns, 10**6, upto_packet=live.telemetry_packets)
    stopped = fed(packets[: live.telemetry_packets]).pose_at(utc_ns, 10**6)
    assert digest(live) == digest(later) == digest(stopped)
    assert digest(telemetry.pose_at(utc_ns, 10**6)) != digest(live)


def test_an_instant_after_the_last_sample_is_nearest_and_far_away_none() -> None:
    telemetry = fed(recording(FlightPath(3), 10))
    assert not telemetry.bracketed(START_NS + 11 * 10**9)
    near = telemetry.pose_at(START_NS + 12 * 10**9, 0)
    assert near.source == "nearest"
    assert near.age_ms == pytest.approx(2100, abs=5)
    assert near.position_sigma_m is not None
    assert near.position_sigma_m > 5
    far = telemetry.pose_at(START_NS + 60 * 10**9, 0)
    assert (far.source, far.latitude_rad, far.attitude, far.age_ms) == ("none", None, None, None)


def test_a_gap_in_the_telemetry_at_the_exposure_is_marked_and_counted() -> None:
    """4 s without a packet around the exposure: nothing is bridged, the nearest sample stands, and sigma says so."""
    around_us = START_NS // 1000 + 20 * 10**6
    packets = [p for p in recording(FlightPath(3, speed_m_s=8.0), 40) if abs(p[1] - around_us) > 2 * 10**6]
    pose = fed(packets).pose_at(START_NS + 20 * 10**9, 0)
    assert pose.source == "nearest"
    assert pose.age_ms == pytest.approx(2000, abs=200)
    assert pose.position_sigma_m is not None
    assert pose.position_sigma_m >= position_error_m(pose, FlightPath(3, speed_m_s=8.0).pose(20.0)) / 3
    assert pose.position_sigma_m > 10
    beside = fed(packets).pose_at(START_NS + 30 * 10**9, 0)
    assert beside.source == "interpolated"


def test_without_telemetry_there_is_no_pose_and_no_zero() -> None:
    pose = Telemetry().pose_at(START_NS, 0)
    assert pose.source == "none"
    assert {k for k, v in asdict(pose).items() if v is not None} == {"source", "utc_ns", "telemetry_packets"}


def test_a_reboot_drops_clock_and_history_but_a_late_packet_does_not() -> None:
    before = recording(FlightPath(3), 60)
    telemetry = fed(before)
    late = before[len(before) // 3][2]
    number, stamp_us = before[-1][0] + 1, before[-1][1]
    telemetry.feed(number, stamp_us + 10, late)
    assert telemetry.statistics().reboots == 0
    assert telemetry.boot_clock() is not None
    again = BootTime(offset_s=1.0)
    for t_s, message in flight(FlightPath(3), again, 0, 5):
        number += 1
        telemetry.feed(number, stamp_us + 10**6 + round(t_s * 1e6), made(message))
    assert telemetry.statistics().reboots == 1
    clock = telemetry.boot_clock()
    assert clock is not None
    assert clock.source == "arrival"
    assert clock.utc_ns(again.ns(3.0)) == pytest.approx((stamp_us + 4 * 10**6) * 1000, abs=2e6)
    assert telemetry.pose_at(START_NS + 28 * 10**9, 0).source == "interpolated"  # by what the first boot sent


def test_answers_meant_for_others_are_not_taken() -> None:
    packets = recording(FlightPath(3), 5, timesync=False)
    number, stamp_us = packets[-1][0], packets[-1][1]
    telemetry = fed(packets)
    for step in range(10):
        number += 1
        telemetry.feed(number, stamp_us + step, made(mavlink.MAVLink_timesync_message(10**9, stamp_us * 1000 - 5)))
    clock = telemetry.boot_clock()
    assert clock is not None
    assert clock.source == "arrival"


@given(st.floats(-50, 50), st.floats(1, 80), st.floats(0, 0.03), st.integers(0, 99))
def test_the_timesync_filter_finds_offset_and_drift(ppm: float, seconds: float, jitter_s: float, seed: int) -> None:
    rng = random.Random(seed)  # noqa: S311 (a simulation)
    answers = []
    for n in range(max(10, int(5 * seconds))):
        sent = START_NS + n * 200_000_000
        there = sent + 10**6 + round(rng.expovariate(1) * jitter_s * 1e9)
        back = there + 10**6 + round(rng.expovariate(1) * jitter_s * 1e9)
        answers.append(TimesyncAnswer(n, sent, back, round((there - START_NS) * (1 + ppm * 1e-6)) + 7 * 10**9))
    clock = from_timesync(answers)
    assert clock is not None
    last = answers[-1].boot_ns
    truth = START_NS + round((last - 7 * 10**9) / (1 + ppm * 1e-6))
    assert abs(clock.utc_ns(last) - truth) <= 6 * clock.sigma_ns + 2e4
    assert abs(clock.boot_ns(clock.utc_ns(last)) - last) <= 2


def test_arrivals_use_the_quickest_packet() -> None:
    clock = from_arrivals([(n * 10**9, START_NS + n * 10**9 + delay) for n, delay in enumerate([9, 3, 5])])
    assert clock is not None
    assert clock.offset_ns == START_NS + 3
    assert from_arrivals([]) is None


unit = st.tuples(*[st.floats(-1, 1)] * 4).filter(lambda q: math.hypot(*q) > 0.1).map(lambda q: normalised(*q))


@given(unit, unit, st.floats(0, 1))
def test_slerp_turns_evenly_along_the_shorter_way(
    a: tuple[float, float, float, float], b: tuple[float, float, float, float], share: float
) -> None:
    q, whole = slerp(a, b, share), turn_rad(a, b)
    assert math.hypot(*q) == pytest.approx(1)
    assert turn_rad(a, q) == pytest.approx(share * whole, abs=1e-4)


@given(st.tuples(*[st.floats(-10, 10)] * 4), st.floats(0.01, 3), st.floats(0, 1))
def test_hermite_reproduces_every_cubic(c: tuple[float, ...], span: float, share: float) -> None:
    def value(t: float) -> float:
        return c[0] + c[1] * t + c[2] * t**2 + c[3] * t**3

    def slope(t: float) -> float:
        return c[1] + 2 * c[2] * t + 3 * c[3] * t**2

    got = hermite((value(0), value(span)), (slope(0), slope(span)), span, share)
    assert got == pytest.approx(value(share * span), abs=1e-6)


def real_flight(shared_data: File) -> Iterator[Stamped]:
    data = (shared_data / "telemetry" / "dronekit-flight.tlog").read_bytes()
    decode, place, number = PacketParser(), 0, 0
    while place + 10 <= len(data):
        length = data[place + 9] + 8
        message = decode(data[place + 8 : place + 8 + length])
        if message is not None:
            yield number, struct.unpack(">Q", data[place : place + 8])[0], message
        number += 1
        place += 8 + length


def test_a_real_flight_predicts_each_of_its_samples_from_the_neighbours(shared_data: File) -> None:
    """MAVLink 1, 2 Hz, no TIMESYNC, one reboot: leave one position (and attitude) out, and ask for it."""
    packets = list(real_flight(shared_data))
    first = first_position_utc_ns(packets)
    assert first is not None
    kinds = {"GLOBAL_POSITION_INT", "ATTITUDE"}
    errors, angles, reboots = [], [], 0
    chosen = [i for i, p in enumerate(packets) if p[2].get_type() in kinds and p[1] * 1000 > first + 60 * 10**9][::97]
    for place in chosen[:50:3]:
        left_out = packets[place]
        boot_ns = left_out[2].time_boot_ms * 10**6 + 500_000
        window = [p for p in packets[max(0, place - 1500) : place + 400] if p is not left_out]
        telemetry = fed(window)
        clock = telemetry.boot_clock()
        assert clock is not None
        assert clock.source == "arrival"
        pose = telemetry.pose_at(clock.utc_ns(boot_ns), 0)
        reboots += telemetry.statistics().reboots
        if pose.source != "interpolated":
            continue
        if left_out[2].get_type() == "ATTITUDE" and pose.attitude is not None:
            roll, pitch, yaw = left_out[2].roll, left_out[2].pitch, left_out[2].yaw
            truth = from_euler(roll, pitch, yaw)
            angles.append(math.degrees(turn_rad(pose.attitude, truth)))
        elif pose.latitude_rad is not None and pose.longitude_rad is not None:
            north, east = metres_per_radian(pose.latitude_rad, 0.0)
            errors.append(
                math.hypot(
                    (pose.latitude_rad - math.radians(left_out[2].lat / 1e7)) * north,
                    (pose.longitude_rad - math.radians(left_out[2].lon / 1e7)) * east,
                )
            )
    assert len(errors) + len(angles) >= 14
    assert np.median(errors) < 0.3
    assert np.percentile(errors, 90) < 2.0
    assert np.median(angles) < 3.0


def test_history_is_bounded_in_time_whatever_stands_between_its_packets() -> None:
    """Every second packet says nothing: no place in the numbering may keep the others from being forgotten."""
    telemetry, beat = Telemetry(), made(mavlink.MAVLink_heartbeat_message(2, 3, 0, 0, 4, 3))
    for step in range(3000):
        stamp_us = START_NS // 1000 + step * 100_000
        at_ms = 1000 + step * 100
        telemetry.feed(2 * step, stamp_us, beat)
        place = mavlink.MAVLink_global_position_int_message(at_ms, 10**7, 10**7, 0, 0, 0, 0, 0, 0)
        telemetry.feed(2 * step + 1, stamp_us, made(place))
    assert telemetry.statistics().positions == 3000
    assert len(telemetry._history._positions) <= HISTORY_NS / 1e8 + 256


def test_a_flood_of_one_kind_keeps_the_newest_and_the_rest_of_the_history() -> None:
    packets = recording(FlightPath(3), 5)
    telemetry = fed(packets)
    number, stamp_us = packets[-1][0], packets[-1][1]
    flood = made(mavlink.MAVLink_gps_raw_int_message(0, 3, 10**7, 10**7, 0, 100, 100, 0, 0, 9))
    for _ in range(MOST_SAMPLES + 1000):
        number += 1
        telemetry.feed(number, stamp_us, flood)
    assert len(telemetry._history._receiver) <= MOST_SAMPLES
    assert telemetry._history._receiver[-1].number == number
    assert telemetry.pose_at(START_NS + 4 * 10**9, 0).source == "interpolated"


NAN, FAR = math.nan, 2**31 - 1


@pytest.mark.parametrize(
    "message",
    [
        mavlink.MAVLink_global_position_int_message(0, FAR, FAR, FAR, 0, 0, 0, 0, 0),
        mavlink.MAVLink_global_position_int_message(0, 900_000_001, 10**8, 0, 0, 0, 0, 0, 0),
        mavlink.MAVLink_global_position_int_message(0, -900_000_001, 10**8, 0, 0, 0, 0, 0, 0),
        mavlink.MAVLink_global_position_int_message(0, 4 * 10**8, -1_800_000_001, 0, 0, 0, 0, 0, 0),
        mavlink.MAVLink_global_position_int_message(0, 4 * 10**8, 10**8, -FAR, 0, 0, 0, 0, 0),
        mavlink.MAVLink_attitude_message(0, NAN, 0, 0, 0, 0, 0),
        mavlink.MAVLink_attitude_message(0, 0, math.inf, 0, 0, 0, 0),
        mavlink.MAVLink_attitude_quaternion_message(0, 1, 0, NAN, 0, 0, 0, 0),
        mavlink.MAVLink_attitude_quaternion_cov_message(0, [1, 0, 0, NAN], 0, 0, 0, [0] * 9),
    ],
    ids=lambda message: message.get_type(),
)
def test_an_impossible_message_is_no_pose_and_is_counted(message: MavlinkMessage) -> None:
    """A position of 2147483647 (MAVLink's unknown) among good ones gave a pose at 131 degrees, without a doubt."""
    packets = recording(FlightPath(3), 4.0)
    stamp_us = START_NS // 1000 + 2_050_000
    boot_ms = BOOT.ns(2.05) // 10**6
    if hasattr(message, "time_boot_ms"):
        message.time_boot_ms = boot_ms
    else:
        message.time_usec = boot_ms * 1000
    with_it = numbered([*((stamp, one) for _, stamp, one in packets), (stamp_us + 600, made(message))])
    good, telemetry = fed(packets), fed(with_it)
    at_ns = START_NS + 2_070_000_000
    pose, expected = telemetry.pose_at(at_ns, 0.0), good.pose_at(at_ns, 0.0)
    assert pose.source == "interpolated"
    assert (pose.latitude_rad, pose.longitude_rad, pose.attitude) == (
        expected.latitude_rad,
        expected.longitude_rad,
        expected.attitude,
    )
    assert (telemetry.statistics().impossible, good.statistics().impossible) == (1, 0)
    assert [one.code for one in telemetry.doubts()] == [Code.POSITION_IMPOSSIBLE]  # however long nothing is heard
    good_one = mavlink.MAVLink_attitude_message(BOOT.ns(65.0) // 10**6, 0, 0, 0, 0, 0, 0)
    telemetry.feed(len(with_it), START_NS // 1000 + 65 * 10**6, made(good_one))
    assert telemetry.doubts() == ()


def test_an_answer_to_timesync_that_can_t_be_true_is_counted() -> None:
    telemetry = fed(recording(FlightPath(3), 2.0, timesync=False))
    now_us, number = START_NS // 1000 + 2_100_000, 10_000
    for time_ns in (-1, 2**62 + 5):
        telemetry.feed(number, now_us, made(mavlink.MAVLink_timesync_message(0, now_us * 1000), component=100))
        telemetry.feed(number + 1, now_us + 900, made(mavlink.MAVLink_timesync_message(time_ns, now_us * 1000)))
        now_us, number = now_us + 10_000, number + 2
    assert telemetry.statistics().impossible == 2
