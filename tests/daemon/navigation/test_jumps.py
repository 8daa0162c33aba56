"""Positions that contradict their velocity, in telemetry as it comes: jumps, ramps, and what is none."""

from __future__ import annotations

import math
import random
from collections.abc import Callable, Iterator
from dataclasses import replace
from pathlib import Path as File

import pytest
from hypothesis import given
from hypothesis import strategies as st

from dappled.clock import RecordedClock
from dappled.config.settings import Settings
from dappled.daemon.live_settings import LiveSettings
from dappled.daemon.navigation import Navigation, Telemetry, recorded_doubt
from dappled.decode.geometry import Pose, metres_per_radian, turn_rad
from dappled.drivers.mavlink import MavlinkMessage, PacketParser, mavlink
from dappled.findings import Code, Finding, text
from dappled.flight import Recording, digest, log_reading, recording
from dappled.mocks.autopilot.autopilot import BootTime, telemetry_message
from dappled.mocks.autopilot.path import FlightPath, TruePose

START_NS = 1_790_000_000 * 10**9
BOOT = BootTime()
PATH = FlightPath(3)
DEGREES_PER_M = 1 / 111_000
AT_S = 20.0  # of the jump
Changed = Callable[[float, TruePose], TruePose]


def telemetry_of(
    path: FlightPath = PATH,
    changed: Changed = lambda _, pose: pose,
    *,
    rate_hz: float = 10.0,
    seconds: float = 60.0,
    delay_s: Callable[[], float] = lambda: 0.003,
    into: Telemetry | None = None,
) -> Telemetry:
    """What is known of a simulated flight, `changed` (by time and true pose) in its telemetry."""
    telemetry, at_us = into or Telemetry(), 0
    for number, (t_s, message) in enumerate(messages(path, changed, rate_hz, seconds)):
        at_us = max(at_us, START_NS // 1000 + round((t_s + delay_s()) * 1e6))
        telemetry.feed(number, at_us, message)
    return telemetry


def messages(
    path: FlightPath, changed: Changed, rate_hz: float, seconds: float
) -> Iterator[tuple[float, MavlinkMessage]]:
    packer = mavlink.MAVLink(None, srcSystem=1, srcComponent=1)
    kinds = (mavlink.MAVLINK_MSG_ID_GPS_RAW_INT, mavlink.MAVLINK_MSG_ID_GLOBAL_POSITION_INT)
    for step in range(round(seconds * rate_hz)):
        t_s = step / rate_hz
        for kind in kinds:
            message = telemetry_message(kind, changed(t_s, path.pose(t_s)), BOOT.ns(t_s))
            message.pack(packer)
            yield t_s, message


def moved(pose: TruePose, north_m: float = 0.0, up_m: float = 0.0) -> TruePose:
    return replace(
        pose, latitude_deg=pose.latitude_deg + north_m * DEGREES_PER_M, altitude_msl_m=pose.altitude_msl_m + up_m
    )


def stepped(north_m: float, up_m: float = 0.0, until_s: float = math.inf) -> Changed:
    return lambda t_s, pose: moved(pose, north_m, up_m) if AT_S <= t_s < until_s else pose


def ramped(north_m: float, over_s: float) -> Changed:
    return lambda t_s, pose: moved(pose, north_m * min(1.0, max(0.0, (t_s - AT_S) / over_s)))


def at(telemetry: Telemetry, t_s: float) -> Pose:
    return telemetry.pose_at(START_NS + round(t_s * 1e9), 0.0)


def sigma_m(telemetry: Telemetry, t_s: float) -> float:
    found = at(telemetry, t_s).position_sigma_m
    assert found is not None
    return found


@pytest.mark.parametrize("rate_hz", [1.0, 5.0, 50.0])
def test_poses_around_a_jump_contain_it(rate_hz: float) -> None:
    """30 m sideways from one message to the next: only frames in the middle between these two were in doubt."""
    telemetry = telemetry_of(changed=stepped(30.0), rate_hz=rate_hz)
    for t_s in (AT_S - 8, AT_S - 1, *(AT_S - share / rate_hz for share in (1.1, 0.9, 0.5, 0.1)), AT_S, AT_S + 25):
        assert 29 < sigma_m(telemetry, t_s) < 36, t_s
    assert (at(telemetry, AT_S).vertical_sigma_m or 9) < 1
    for t_s in (5.0, 9.0):
        assert sigma_m(telemetry, t_s) < 1, t_s
    assert sigma_m(telemetry, 55.0) > 29  # it has not jumped back: no time ends this
    assert telemetry.statistics().jumps == 1


@pytest.mark.parametrize("steps_s", [(), (AT_S + 4, AT_S + 12), (AT_S, AT_S + 20)])
def test_a_doubt_of_the_position_outlives_steps_of_the_clock_and_ends_when_it_is_back(
    steps_s: tuple[float, ...],
) -> None:
    """A simulator's clock steps each few seconds: the doubt was forgotten, and a jump beside one was missed."""
    telemetry, boot = Telemetry(), BootTime(jumps=tuple((t_s, 0.4) for t_s in steps_s))
    packer = mavlink.MAVLink(None, srcSystem=1, srcComponent=1)
    for number, (t_s, message) in enumerate(messages(PATH, stepped(33.0, until_s=AT_S + 40), 5.0, AT_S + 50)):
        if message.get_type() == "GLOBAL_POSITION_INT":
            message.time_boot_ms = boot.ns(t_s) // 10**6
            message.pack(packer)
        telemetry.feed(number, START_NS // 1000 + round(t_s * 1e6) + 3000, message)
    for t_s in (AT_S - 2, AT_S + 2, AT_S + 14, AT_S + 37):
        assert 30 < sigma_m(telemetry, t_s) < 37, t_s
    assert sigma_m(telemetry, AT_S + 42) < 1


@pytest.mark.parametrize("above_m", [0.0, 12.0])
def test_a_position_that_comes_to_where_the_receiver_stayed_is_in_doubt_no_longer(above_m: float) -> None:
    """An estimator that was set anew to its receiver: those before the jump are in doubt. Its height is by a
    barometer, which may have drifted by more than the place is apart."""
    telemetry = Telemetry()
    there = messages(PATH, lambda _, pose: moved(pose, 12.0, above_m), 5.0, AT_S + 10)
    both = zip(messages(PATH, stepped(12.0), 5.0, AT_S + 10), there, strict=True)
    for number, ((t_s, estimated), (_, true)) in enumerate(both):
        message = true if true.get_type() == "GPS_RAW_INT" else estimated
        telemetry.feed(number, START_NS // 1000 + round(t_s * 1e6) + 3000, message)
    assert sigma_m(telemetry, AT_S - 2) > 11
    assert sigma_m(telemetry, AT_S + 2) < 1
    assert telemetry.statistics().jumps == 1


def test_a_doubt_ends_a_minute_after_the_receiver_has_come_back_where_the_position_is() -> None:
    """The estimator flew blind for 13 s, and was set anew to its receiver: the doubt lasted for the flight."""
    telemetry, number = Telemetry(), 0
    for t_s, message in messages(PATH, stepped(12.0), 5.0, AT_S + 80):
        if message.get_type() == "GPS_RAW_INT" and AT_S - 13 < t_s < AT_S + 1:
            continue
        telemetry.feed(number, START_NS // 1000 + round(t_s * 1e6) + 3000, message)
        number += 1
    assert sigma_m(telemetry, AT_S + 50) > 11
    assert sigma_m(telemetry, AT_S + 70) < 1


def test_a_jump_in_height_is_one_of_height() -> None:
    telemetry = telemetry_of(changed=stepped(0.0, up_m=-12.0))
    pose = at(telemetry, AT_S + 3)
    assert pose.vertical_sigma_m == pytest.approx(12, abs=0.2)
    assert pose.position_sigma_m == pytest.approx(0, abs=0.2)
    assert pose.position_covariance_m2 is not None
    assert pose.position_covariance_m2[5] == pytest.approx(144, rel=0.05)
    assert telemetry.statistics().jumps == 1


def test_a_covariance_contains_the_jump() -> None:
    covariance = at(telemetry_of(changed=stepped(30.0)), AT_S + 3).position_covariance_m2
    assert covariance is not None
    assert math.sqrt(covariance[0] + covariance[3]) == pytest.approx(30, abs=0.5)


@pytest.mark.parametrize("until_s", [AT_S + 0.1, AT_S + 5])
def test_there_and_back_is_in_doubt_by_the_way_and_not_by_twice_of_it(until_s: float) -> None:
    telemetry = telemetry_of(changed=stepped(30.0, until_s=until_s))
    for t_s in (AT_S - 2, AT_S + 0.02, until_s - 0.02):
        assert 29 < sigma_m(telemetry, t_s) < 36, t_s
    assert sigma_m(telemetry, until_s + 1) < 1
    assert telemetry.statistics().jumps == (1 if until_s < AT_S + 1 else 2)


@pytest.mark.parametrize(("over_s", "rate_hz"), [(0.2, 50), (0.2, 10), pytest.param(2.0, 50, marks=pytest.mark.slow)])
def test_a_jump_that_is_spread_over_messages_is_seen_whole(over_s: float, rate_hz: float) -> None:
    """Each of its steps may be what a healthy autopilot has."""
    telemetry = telemetry_of(changed=ramped(30.0, over_s), rate_hz=rate_hz)
    for t_s in (AT_S - 2, AT_S, AT_S + over_s / 2, AT_S + over_s + 1):
        assert sigma_m(telemetry, t_s) > (26 if t_s < AT_S or t_s > AT_S + over_s else 13), t_s
    assert telemetry.statistics().jumps == 1


@pytest.mark.parametrize("by_m", [4.0, 7.5])
def test_a_small_jump_counts_too(by_m: float) -> None:
    telemetry = telemetry_of(changed=stepped(by_m))
    assert by_m - 0.1 < sigma_m(telemetry, AT_S + 1) < by_m + 0.5


def test_a_velocity_that_is_not_that_of_the_positions_is_told() -> None:
    def wrong(t_s: float, pose: TruePose) -> TruePose:
        return replace(pose, velocity_ned_m_s=(300.0, 0.0, 0.0)) if AT_S <= t_s < AT_S + 2 else pose

    telemetry = telemetry_of(changed=wrong)
    assert telemetry.statistics().jumps > 0
    assert sigma_m(telemetry, AT_S + 1) > 10


def fast(pose: TruePose, step: int) -> TruePose:
    return replace(pose, velocity_ned_m_s=(150.0 if step % 2 else -280.0, 0.0, 0.0))


def upside_down(pose: TruePose, step: int) -> TruePose:
    return replace(pose, attitude=(0.0, 1.0, 0.0, 0.0))


@pytest.mark.parametrize(
    ("bad", "rate_hz", "in_a_row"),
    [
        (lambda pose, step: moved(pose, 2000.0), 5.0, 4),
        (lambda pose, step: moved(pose, 2000.0), 30.0, 3),
        (lambda pose, step: moved(pose, 0.0, 900.0 * (1 + step % 2)), 5.0, 4),
        (lambda pose, step: moved(pose, 0.0, 900.0 * (1 + step % 2)), 5.0, 1),
        (lambda pose, step: replace(pose, longitude_deg=-pose.longitude_deg), 10.0, 2),
        (fast, 5.0, 1),
        (fast, 5.0, 4),
        (upside_down, 5.0, 4),
        (upside_down, 10.0, 2),
    ],
    ids=[
        "far",
        "far often",
        "high",
        "high once",
        "other side",
        "fast once",
        "fast",
        "upside down",
        "upside down twice",
    ],
)
def test_bad_values_in_a_row_are_missing_ones(
    bad: Callable[[TruePose, int], TruePose], in_a_row: int, rate_hz: float
) -> None:
    """They were a jump there and back, and for half a minute all positions were in doubt by it."""
    begins, telemetry, number = round(AT_S * rate_hz), Telemetry(), 0
    packer = mavlink.MAVLink(None, srcSystem=1, srcComponent=1)
    kinds = (mavlink.MAVLINK_MSG_ID_GPS_RAW_INT, mavlink.MAVLINK_MSG_ID_GLOBAL_POSITION_INT,
             mavlink.MAVLINK_MSG_ID_ATTITUDE_QUATERNION)  # fmt: skip
    for step in range(round(15 * rate_hz), round(37 * rate_hz)):
        t_s = step / rate_hz
        pose = PATH.pose(t_s)
        pose = bad(pose, step) if begins <= step < begins + in_a_row else pose
        for kind in kinds:
            message = telemetry_message(kind, pose, BOOT.ns(t_s))
            message.pack(packer)
            telemetry.feed(number, START_NS // 1000 + round(t_s * 1e6) + 3000, message)
            number += 1
    assert telemetry.statistics().impossible >= in_a_row
    for t_s in (AT_S - 0.1, AT_S + 0.02, AT_S + 1, AT_S + 15):
        found, true = at(telemetry, t_s), PATH.pose(t_s)
        north, east = metres_per_radian(math.radians(true.latitude_deg), true.altitude_msl_m)
        assert abs((found.latitude_rad or 0) - math.radians(true.latitude_deg)) * north < 0.3
        assert abs((found.longitude_rad or 0) - math.radians(true.longitude_deg)) * east < 0.3
        assert (found.altitude_msl_m or 0) == pytest.approx(true.altitude_msl_m, abs=0.3)
        assert found.attitude is not None
        assert turn_rad(found.attitude, true.attitude) < 0.1
        assert (found.position_sigma_m or 99) < 2


def test_a_position_that_is_set_anew_counts_within_a_second_or_two() -> None:
    """An estimator that was reset by a kilometre."""
    telemetry = telemetry_of(changed=stepped(1000.0))
    assert telemetry.statistics().impossible == 0
    for t_s in (AT_S + 0.5, AT_S + 3):
        off_deg = math.degrees(at(telemetry, t_s).latitude_rad or 0) - PATH.pose(t_s).latitude_deg
        assert off_deg / DEGREES_PER_M == pytest.approx(1000, abs=1)
        assert sigma_m(telemetry, t_s) > 900


def test_a_jump_over_a_gap_in_the_telemetry_is_seen() -> None:
    """3 s without a message, too long to be bridged: the poses on both sides are nearest ones and confident."""
    found, number = Telemetry(), 0
    for t_s, message in messages(PATH, stepped(60.0), 10.0, 40.0):
        if not 17.0 < t_s < AT_S:
            found.feed(number, START_NS // 1000 + round(t_s * 1e6) + 3000, message)
            number += 1
    assert sigma_m(found, AT_S + 2) > 55
    assert sigma_m(found, 16.0) > 55


def test_a_jump_is_told_until_a_minute_of_positions_came_without_one() -> None:
    back = stepped(30.0, up_m=-40.0, until_s=AT_S + 5)
    (told,) = telemetry_of(changed=back, seconds=AT_S + 60).doubts()
    assert str(text(told)).startswith("the autopilot's position jumped by 50.0 m against its velocity")
    assert telemetry_of(changed=back, seconds=AT_S + 66).doubts() == ()
    (other,) = telemetry_of(changed=stepped(7.0)).doubts()
    assert other.kind == told.kind
    good = telemetry_of()
    assert (good.doubts(), good.statistics().jumps) == ((), 0)


def test_a_replay_that_read_on_past_a_jump_gets_the_pose_from_before_it() -> None:
    """A frame 2 s before: when it was tagged, nobody knew."""
    telemetry, live = Telemetry(), None
    for number, (t_s, message) in enumerate(messages(PATH, stepped(30.0), 10.0, 40.0)):
        telemetry.feed(number, START_NS // 1000 + round(t_s * 1e6) + 3000, message)
        if live is None and t_s >= AT_S - 1:
            live = at(telemetry, AT_S - 2)
    assert live is not None
    assert (live.position_sigma_m or 9) < 1
    again = telemetry.pose_at(live.utc_ns, 0.0, upto_packet=live.telemetry_packets)
    assert digest(again) == digest(live)
    assert sigma_m(telemetry, AT_S - 2) > 29


@given(
    st.floats(1.0, 50.0),
    st.floats(0.0, 25.0),
    st.floats(1.0, 9.0),
    st.floats(0.0, 0.3),
    st.integers(0, 99),
)
def test_a_healthy_autopilot_has_no_jumps(
    rate_hz: float, speed_m_s: float, turn_m_s2: float, jitter_s: float, seed: int
) -> None:
    """Steps of 1e-7 degrees, 1 cm/s and 1 ms, turns up to 9 m/s², over a link with jitter."""
    rng = random.Random(seed)  # noqa: S311  a simulation
    path = FlightPath(seed, speed_m_s=speed_m_s, radius_m=max(3.0, speed_m_s**2 / turn_m_s2))
    telemetry = telemetry_of(path, rate_hz=rate_hz, seconds=12.0, delay_s=lambda: rng.uniform(0, jitter_s))
    assert telemetry.statistics().jumps == 0


@pytest.mark.parametrize("speed_m_s", [4.0, 25.0])
def test_positions_of_a_5_hz_receiver_in_messages_at_50_hz_are_no_jumps(speed_m_s: float) -> None:
    path = FlightPath(3, speed_m_s=speed_m_s, radius_m=80.0)

    def held(t_s: float, pose: TruePose) -> TruePose:
        old = path.pose(math.floor(t_s * 5 + 1e-9) / 5)
        return replace(pose, latitude_deg=old.latitude_deg, longitude_deg=old.longitude_deg)

    assert telemetry_of(path, held, rate_hz=50.0, seconds=20.0).statistics().jumps == 0


def test_brakes_and_gusts_between_two_sparse_messages_are_no_jump() -> None:
    """At 1 Hz: 2.4 m there within one second, with the same velocity at both ends."""
    assert telemetry_of(changed=stepped(2.4), rate_hz=1.0).statistics().jumps == 0


def test_vertical_speeds_that_count_upwards_are_no_jump() -> None:
    """As ArduCopter 3.2 sends them."""

    def climbing(t_s: float, pose: TruePose) -> TruePose:
        n, e, _ = pose.velocity_ned_m_s
        return replace(pose, altitude_msl_m=200 + 6 * t_s, velocity_ned_m_s=(n, e, 6.0))

    telemetry = telemetry_of(changed=climbing)
    assert telemetry.statistics().jumps == 0


def test_a_vehicle_without_velocities_has_only_jumps_that_none_can_fly() -> None:
    def bare(t_s: float, pose: TruePose) -> TruePose:
        return replace(stepped(60.0)(t_s, pose), velocity_ned_m_s=(0.0, 0.0, 0.0))

    telemetry = telemetry_of(FlightPath(3, speed_m_s=20.0, radius_m=60.0), bare)
    assert telemetry.statistics().jumps == 1
    assert 50 < sigma_m(telemetry, AT_S + 4) < 70


@pytest.mark.parametrize("by_s", [0.4, -0.4, 3.0])
def test_a_clock_that_steps_is_no_jump(by_s: float) -> None:
    telemetry = Telemetry()
    boot = BootTime(jumps=((AT_S, by_s),))
    path = FlightPath(3, speed_m_s=15.0, radius_m=60.0)
    packer = mavlink.MAVLink(None, srcSystem=1, srcComponent=1)
    for step in range(400):
        t_s = step / 10
        message = telemetry_message(mavlink.MAVLINK_MSG_ID_GLOBAL_POSITION_INT, path.pose(t_s), boot.ns(t_s))
        message.pack(packer)
        telemetry.feed(step, START_NS // 1000 + round(t_s * 1e6) + 3000, message)
    assert telemetry.statistics().jumps == 0


def test_a_real_flight_has_one_reboot_and_jumps_only_where_its_home_is_set(shared_data: File) -> None:
    """On the ground: with the first fix, and by the whole height when home was set, in each of its two boots."""
    telemetry, parse = Telemetry(), PacketParser()
    jumps: list[Finding] = []
    for number, stamp_us, raw in log_reading.read_telemetry(shared_data / "telemetry" / "dronekit-flight.tlog"):
        message = parse(raw)
        if message is not None:
            telemetry.feed(number, stamp_us, message)
        if len(jumps) < telemetry.statistics().jumps:
            jumps += [one for one in telemetry.doubts() if one.code is Code.POSITION_JUMPED]
    assert [one.facts["by_m"] for one in jumps] == pytest.approx([3.3, 588.0, 590.0], abs=0.05)
    assert telemetry.statistics().reboots == 1


def test_a_doubt_is_over_by_evidence_and_not_by_the_next_flight(tmp_path: File) -> None:
    """A daemon starts again, twice, while the receiver is 33 m off, as its own messages can't tell."""
    clock = RecordedClock(START_NS)

    def flown(changed: Changed, seconds: float) -> tuple[Telemetry, Telemetry]:
        """One more flight: what was known of it, and what a replay knows."""
        flight: Recording = recording.begin(tmp_path, clock)
        clock.advance_to(clock.utc_ns() + 10**9)
        navigation = Navigation(LiveSettings(Settings()), clock, flight, utc_known=True)
        navigation.note_doubt()  # before a vehicle is heard
        telemetry_of(changed=changed, rate_hz=5.0, seconds=seconds, into=navigation.telemetry)
        navigation.note_doubt()
        told = Telemetry(doubt=recorded_doubt(flight.ledger))
        flight.close()
        return navigation.telemetry, telemetry_of(changed=changed, rate_hz=5.0, seconds=seconds, into=told)

    def off(_: float, pose: TruePose) -> TruePose:
        return moved(pose, 33.0)

    assert sigma_m(flown(stepped(33.0), 25.0)[0], 22.0) > 30
    live, replayed = flown(off, 2.0)
    assert sigma_m(live, 1.0) > 30
    assert digest(at(live, 1.0)) == digest(at(replayed, 1.0))
    live, replayed = flown(off, 75.0)
    assert sigma_m(live, 50.0) > 30
    assert sigma_m(live, 70.0) < 1  # for a minute the receiver has agreed with all velocities
    assert digest(at(live, 50.0)) == digest(at(replayed, 50.0))
    assert sigma_m(flown(off, 2.0)[0], 1.0) < 1
