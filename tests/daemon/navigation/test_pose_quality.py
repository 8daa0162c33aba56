"""What else a pose carries: the receiver's word, the height's accuracy, a gimbal, what the autopilot says of itself."""

from __future__ import annotations

import math

import pytest
from hypothesis import given
from hypothesis import strategies as st

from dappled.daemon.navigation import Telemetry
from dappled.daemon.navigation.clocks import from_arrivals
from dappled.decode.geometry import (
    Gnss,
    Pose,
    conjugate,
    from_euler,
    multiply,
    normalised,
    rotation_vector,
    slerp_doubt,
    turn_rad,
    turned_by_heading,
)
from dappled.drivers.mavlink import MavlinkMessage, mavlink

START_NS = 1_790_000_000 * 10**9
LATENCY_NS = 3_000_000
STEPS = 40  # of 100 ms


def headed(message: MavlinkMessage, component: int = 1, system: int = 1) -> MavlinkMessage:
    message.pack(mavlink.MAVLink(None, srcSystem=system, srcComponent=component))
    return message


class Link:
    """Feeds messages that came at a time of the simulation, in seconds."""

    def __init__(self, **telemetry: float) -> None:
        self.telemetry = Telemetry(**telemetry)  # type: ignore[arg-type]  # only floats are asked for here
        self.number = 0

    def send(self, t_s: float, message: MavlinkMessage, component: int = 1, system: int = 1) -> None:
        stamp_us = (START_NS + round(t_s * 1e9) + LATENCY_NS) // 1000
        self.telemetry.feed(self.number, stamp_us, headed(message, component, system))
        self.number += 1

    def vehicle(self, t_s: float, yaw_rad: float = 0.0) -> None:
        """Flies north at 5 m/s and sinks at 2 m/s."""
        boot_ms = round(t_s * 1e3)
        latitude = round(math.degrees(0.7 + 5 * t_s / 6.37e6) * 1e7)
        self.send(t_s, mavlink.MAVLink_global_position_int_message(boot_ms, latitude, 1, 0, 0, 500, 0, 200, 0))
        self.send(t_s, mavlink.MAVLink_attitude_message(boot_ms, 0.0, 0.0, yaw_rad, 0.0, 0.0, 0.0))

    def pose(self, t_s: float, sigma_ms: float = 0.0) -> Pose:
        return self.telemetry.pose_at(START_NS + LATENCY_NS + round(t_s * 1e9), sigma_ms * 1e6)


def receiver(
    fix: int = 3, eph: int = 90, epv: int = 150, accuracies: tuple[int, int, int] = (0, 0, 0)
) -> MavlinkMessage:
    return mavlink.MAVLink_gps_raw_int_message(0, fix, 1, 1, 0, eph, epv, 0, 0, 14, 0, *accuracies)


def test_the_receivers_word_is_carried_along() -> None:
    link = Link()
    for step in range(STEPS):
        link.vehicle(step / 10)
        if step % 5 == 0:
            link.send(step / 10, receiver(accuracies=(800 + step, 1500, 200)))
    pose = link.pose(2.04)
    assert pose.gnss == Gnss(3, 14, 0.9, 1.5, 0.82, 1.5, 0.2, pytest.approx(40, abs=0.01))  # type: ignore[arg-type]  # equal to a float
    assert pose.position_sigma_m == pytest.approx(0.82, abs=0.01)
    assert pose.vertical_sigma_m == pytest.approx(1.5, abs=0.01)
    late = link.pose(2.04, sigma_ms=500)
    assert late.position_sigma_m == pytest.approx(math.hypot(0.82, 2.5), abs=0.02)
    assert late.vertical_sigma_m == pytest.approx(math.hypot(1.5, 1.0), abs=0.02)
    assert late.position_covariance_m2 is not None
    nn, ne, nd, ee, ed, dd = late.position_covariance_m2
    assert math.sqrt(nn + ee) == pytest.approx(late.position_sigma_m)
    assert math.sqrt(dd) == pytest.approx(late.vertical_sigma_m)
    assert (ne, ed) == (0.0, 0.0)  # it flies north and sinks: an unknown time is along that way
    assert nd == pytest.approx(2.5 * 1.0, rel=0.01)
    assert math.sqrt(ee) == pytest.approx(0.82 / math.sqrt(2), abs=0.01)


@pytest.mark.parametrize("speed", [(32_000, 0, 0), (0, 0, -32_768)])
def test_a_position_with_a_speed_that_can_t_be_true_is_none(speed: tuple[int, int, int]) -> None:
    """The same judge as for an autopilot's own log."""
    link = Link()
    for step in range(STEPS):
        link.vehicle(step / 10)
    before = link.pose(2.04)
    other = Link()
    for step in range(STEPS):
        other.vehicle(step / 10)
        if step == 20:
            wrong = mavlink.MAVLink_global_position_int_message(round(2.02e3), 10**7, 10**7, 0, 0, *speed, 0)
            other.send(2.02, wrong)
    after = other.pose(2.04)
    assert (after.latitude_rad, after.longitude_rad) == (before.latitude_rad, before.longitude_rad)
    assert other.telemetry.statistics().impossible == 1


@pytest.mark.parametrize(("first", "second", "counts"), [(1, 6, 6), (2, 6, 6), (3, 6, 3), (1, 2, 1)])
def test_the_second_receiver_counts_while_the_first_has_no_fix(first: int, second: int, counts: int) -> None:
    link = Link()
    for step in range(STEPS):
        link.vehicle(step / 10)
        link.send(step / 10, receiver(fix=first))
        second_one = 0, second, 1, 1, 0, 70, 110, 0, 0, 14, 0, 0, 0, 0, 20, 30, 50
        link.send(step / 10, mavlink.MAVLink_gps2_raw_message(*second_one))
    pose = link.pose(2.0)
    assert pose.gnss is not None
    assert pose.gnss.fix_type == counts


@pytest.mark.parametrize(
    ("message", "horizontal_m", "vertical_m"),
    [
        (receiver(), 0.9 * 2.5, 1.5 * 2.5),
        (receiver(fix=6, eph=100, epv=200), 0.02, 0.04),
        (receiver(eph=65535, epv=65535), None, None),
        (receiver(fix=1), None, None),
    ],
)
def test_without_accuracies_the_dilution_counts_and_without_that_nothing(
    message: MavlinkMessage, horizontal_m: float | None, vertical_m: float | None
) -> None:
    link = Link()
    for step in range(STEPS):
        link.vehicle(step / 10)
        link.send(step / 10, message)
    pose = link.pose(2.0)
    assert pose.position_sigma_m == (None if horizontal_m is None else pytest.approx(horizontal_m, abs=0.03))
    assert pose.vertical_sigma_m == (None if vertical_m is None else pytest.approx(vertical_m, abs=0.03))
    assert pose.gnss is not None
    assert pose.gnss.horizontal_accuracy_m is None


def test_an_old_word_of_the_receiver_is_none() -> None:
    link = Link()
    link.send(0.0, receiver())
    for step in range(STEPS):
        link.vehicle(step / 2)
    assert link.pose(15.0).gnss is None
    assert link.pose(15.0).position_sigma_m is None


def test_the_autopilots_own_attitude_accuracy_counts() -> None:
    told, silent, configured, px4 = Link(), Link(), Link(attitude_sigma_rad=0.02), Link(attitude_sigma_rad=0.02)
    poses = [math.nan] * 15 + [0.0004, 0, 0, 0.0004, 0, 0.0008]
    covariance = [0.0001, 0, 0, 0, 0.0001, 0, 0, 0, 0.0007]
    for step in range(STEPS):
        odometry = (step * 100_000, 1, 12, 0, 0, 0, [1, 0, 0, 0], 0, 0, 0, 0, 0, 0)
        px4.send(step / 10, mavlink.MAVLink_odometry_message(*odometry, poses, [math.nan] * 21))
        silent.send(step / 10, mavlink.MAVLink_odometry_message(*odometry, [math.nan] * 21, [math.nan] * 21))
        for link in (told, silent, configured, px4):
            link.vehicle(step / 10)
        boot_us = step * 100_000 + 50_000
        told.send(
            step / 10 + 0.05,
            mavlink.MAVLink_attitude_quaternion_cov_message(boot_us, [1.0, 0, 0, 0], 0.0, 0.0, 0.0, covariance),
        )
    assert told.pose(2.0).attitude_sigma_rad == pytest.approx(0.03)
    assert silent.pose(2.0).attitude is not None
    assert silent.pose(2.0).attitude_sigma_rad is None
    assert silent.pose(2.0).attitude_covariance_rad2 is None
    assert configured.pose(2.0).attitude_sigma_rad == pytest.approx(0.02)
    assert px4.pose(2.0).attitude_sigma_rad == pytest.approx(0.04)
    found = configured.pose(2.0).attitude_covariance_rad2
    assert found is not None
    assert math.sqrt(found[0] + found[3] + found[5]) == pytest.approx(0.02)


def test_an_unknown_time_is_along_the_turn_in_the_covariance_of_an_attitude() -> None:
    """It rolls: yaw and pitch are as well known as ever."""
    link = Link(attitude_sigma_rad=0.02)
    for step in range(STEPS):
        link.send(
            step / 10, mavlink.MAVLink_global_position_int_message(step * 100, 401070457, 1, 0, 0, 500, 0, 200, 0)
        )
        rolled = (step * 100, 0.01 * step, 0.0, 0.0, 0.1, 0.0, 0.0)  # ms, rad, rad/s
        link.send(step / 10, mavlink.MAVLink_attitude_message(*rolled))
    pose = link.pose(2.04, sigma_ms=500)
    assert pose.attitude_covariance_rad2 is not None
    roll, _, _, pitch, _, yaw = pose.attitude_covariance_rad2
    assert roll - pitch == pytest.approx((0.1 * 0.5) ** 2, rel=0.05)
    assert pitch == yaw
    assert math.sqrt(roll + pitch + yaw) == pytest.approx(pose.attitude_sigma_rad)


@pytest.mark.parametrize(
    ("roll", "pitch", "yaw", "sigma_rad"),
    [(1e-6, 1e-6, 7e-6, 0.02), (4e-4, 4e-4, 8e-4, 0.04), (0, 0, 9e-4, 0.02), (-1e-6, 9e-4, 9e-4, 0.02)],
    ids=["narrow", "wide", "yaw alone", "negative"],
)
def test_a_filters_own_variances_never_narrow_what_the_user_states(
    roll: float, pitch: float, yaw: float, sigma_rad: float
) -> None:
    """The user measured 0.02 rad. A filter doesn't know of its compass's error, and half-given variances are none."""
    odometry, attitudes = Link(attitude_sigma_rad=0.02), Link(attitude_sigma_rad=0.02)
    poses = [math.nan] * 15 + [roll, 0, 0, pitch, 0, yaw]
    for step in range(STEPS):
        fixed = (step * 100_000, 1, 12, 0, 0, 0, [1, 0, 0, 0], 0, 0, 0, 0, 0, 0)
        odometry.send(step / 10, mavlink.MAVLink_odometry_message(*fixed, poses, [math.nan] * 21))
        odometry.vehicle(step / 10)
        covariance = [roll, 0, 0, 0, pitch, 0, 0, 0, yaw]
        message = mavlink.MAVLink_attitude_quaternion_cov_message(step * 100_000, [1.0, 0, 0, 0], 0, 0, 0, covariance)
        attitudes.send(step / 10, message)
        attitudes.vehicle(step / 10 + 0.05)
    for link in (odometry, attitudes):
        assert link.pose(2.0).attitude_sigma_rad == pytest.approx(sigma_rad, rel=1e-3)


def test_an_infinite_variance_is_not_given() -> None:
    link = Link(attitude_sigma_rad=0.02)
    for step in range(STEPS):
        covariance = [1e-4, 0, 0, 0, 1e-4, 0, 0, 0, math.inf]
        message = mavlink.MAVLink_attitude_quaternion_cov_message(step * 100_000, [1.0, 0, 0, 0], 0, 0, 0, covariance)
        link.send(step / 10, message)
    assert link.pose(2.0).attitude_sigma_rad == pytest.approx(0.02)


def gimbal(t_s: float, flags: int, boot_s: float = 0.0) -> MavlinkMessage:
    """A head that looks 40° down, and 30° to the right of where its flags count from; turning right at 0.1 rad/s."""
    head = from_euler(0.0, math.radians(-40), math.radians(30) + 0.1 * t_s)
    return mavlink.MAVLink_gimbal_device_attitude_status_message(
        0, 0, round((boot_s + t_s) * 1e3), flags, list(head), 0.0, 0.0, 0.0, 0
    )


EARTH, VEHICLE, LOCK = 64, 32, 16


@pytest.mark.parametrize("component", [1, 154])
@pytest.mark.parametrize(
    ("flags", "follows"), [(EARTH, False), (VEHICLE, True), (LOCK, False), (0, True), (VEHICLE | LOCK, True)]
)
def test_a_gimbals_attitude_is_there_in_north_east_down(component: int, flags: int, follows: bool) -> None:
    """A gimbal of its own has a clock of its own."""
    link, yaw = Link(), math.radians(70)
    for step in range(STEPS):
        link.vehicle(step / 10, yaw)
        link.send(step / 10, gimbal(step / 10, flags, 1000.0 if component == 154 else 0.0), component)
    pose = link.pose(2.05)
    assert pose.gimbal_attitude is not None
    assert pose.gimbal_source == "GIMBAL_DEVICE_ATTITUDE_STATUS"
    truth = from_euler(0.0, math.radians(-40), math.radians(30) + 0.205 + (yaw if follows else 0.0))
    assert turn_rad(pose.gimbal_attitude, truth) < 1e-3
    assert link.pose(60.0).gimbal_attitude is None


def test_the_older_message_counts_until_the_modern_one_comes() -> None:
    link = Link()
    for step in range(STEPS):
        link.vehicle(step / 10, 0.5)
        boot_ms = step * 100
        link.send(step / 10, mavlink.MAVLink_mount_orientation_message(boot_ms, 0.0, -90.0, 10.0))
        if step > 20:
            link.send(step / 10, gimbal(step / 10, EARTH))
            link.send(step / 10, gimbal(step / 10, EARTH), 171)  # a second gimbal is not listened to
            link.send(step / 10, gimbal(step / 10, EARTH), 154, system=9)  # nor another vehicle's
    old = link.telemetry.pose_at(START_NS + LATENCY_NS + 10**9, 0, upto_packet=45)
    assert old.gimbal_source == "MOUNT_ORIENTATION"
    assert old.gimbal_attitude is not None
    down = from_euler(0.0, math.radians(-90), math.radians(10) + 0.5)
    assert turn_rad(old.gimbal_attitude, down) < 1e-6
    assert link.pose(3.0).gimbal_source == "GIMBAL_DEVICE_ATTITUDE_STATUS"
    assert link.telemetry.statistics().gimbals == 22 + 19


def test_a_gimbal_that_begins_anew_and_one_that_says_nothing() -> None:
    link = Link()
    for step in range(STEPS):
        link.vehicle(step / 10)
        t_s = step / 10
        link.send(t_s, gimbal(t_s, EARTH, 500.0 if step < 20 else 0.0), 154)
        nan = mavlink.MAVLink_gimbal_device_attitude_status_message(0, 0, 0, EARTH, [math.nan] * 4, 0.0, 0.0, 0.0, 0)
        link.send(t_s, nan, 154)
    pose = link.pose(3.0)
    assert pose.gimbal_attitude is not None
    assert turn_rad(pose.gimbal_attitude, from_euler(0.0, math.radians(-40), math.radians(30) + 0.3)) < 1e-3


def test_the_clock_is_fitted_once_while_nothing_better_is_known(monkeypatch: pytest.MonkeyPatch) -> None:
    fits: list[int] = []

    def counted(arrivals: list[tuple[int, int]]) -> object:
        fits.append(len(arrivals))
        return from_arrivals(arrivals)

    monkeypatch.setattr("dappled.daemon.navigation.autopilot_time.from_arrivals", counted)
    link = Link()
    for step in range(STEPS):
        link.vehicle(step / 10)
    for _ in range(100):
        assert not link.telemetry.bracketed(START_NS + 30 * 10**9)
    assert len(fits) == 1
    for step in range(STEPS, 2 * STEPS):
        link.vehicle(step / 10)
        assert not link.telemetry.bracketed(START_NS + 30 * 10**9)
    assert len(fits) == 1  # nor for packets that come while the instant is far
    assert link.telemetry.bracketed(START_NS + 7 * 10**9)
    assert len(fits) == 2


unit = st.tuples(*[st.floats(-1, 1)] * 4).filter(lambda q: math.hypot(*q) > 0.1).map(lambda q: normalised(*q))


@given(unit, unit)
def test_quaternions_turn_back_and_forth(
    a: tuple[float, float, float, float], b: tuple[float, float, float, float]
) -> None:
    between = multiply(conjugate(a), b)
    assert turn_rad(multiply(a, between), b) < 1e-6
    assert math.hypot(*rotation_vector(between)) == pytest.approx(turn_rad(a, b), abs=1e-6)


@given(st.floats(-3, 3), st.floats(-1, 1), st.floats(-0.5, 0.5))
def test_a_heading_turns_about_the_vertical(yaw: float, pitch: float, roll: float) -> None:
    vehicle = from_euler(roll, pitch, yaw)
    assert turn_rad(turned_by_heading(from_euler(0.1, -0.4, 0.2), vehicle), from_euler(0.1, -0.4, 0.2 + yaw)) < 1e-6


@given(st.floats(-2, 2), st.floats(0.02, 1.0), st.floats(0.0, 1.0))
def test_an_even_turn_leaves_nothing_in_doubt_and_a_swinging_one_does(rate: float, span_s: float, share: float) -> None:
    ends = (from_euler(0.0, 0.0, 0.0), from_euler(0.0, 0.0, rate * span_s))
    assert slerp_doubt(ends, ((0.0, 0.0, rate), (0.0, 0.0, rate)), span_s, share) == pytest.approx(0.0, abs=1e-9)
    # yaw = a t² / 2 with a = 1: the cubic through it is exact
    ends = (from_euler(0.0, 0.0, 0.0), from_euler(0.0, 0.0, 0.5 * span_s**2))
    missed = abs(0.5 * (share * span_s) ** 2 - share * 0.5 * span_s**2)
    assert slerp_doubt(ends, ((0.0, 0.0, 0.0), (0.0, 0.0, span_s)), span_s, share) == pytest.approx(missed, abs=1e-9)
