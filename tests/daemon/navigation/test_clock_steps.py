"""An autopilot whose clock steps, runs fast or starts again: what a pose near that is worth, and that it says so."""

from __future__ import annotations

import math

import pytest

from dappled.daemon.navigation import BodyLatency, Telemetry, clocks
from dappled.daemon.navigation.clocks import from_arrivals
from dappled.decode.geometry import Pose, metres_per_radian
from dappled.drivers.mavlink import MavlinkMessage, mavlink
from dappled.mocks.autopilot.autopilot import BootTime

START_NS = 1_790_000_000 * 10**9
SPEED_M_S, LATITUDE_DEG = 10.0, 41.0
MS = 10**6
NORTH_M, _ = metres_per_radian(math.radians(LATITUDE_DEG), 200.0)
LATENCY = BodyLatency(0.0, 1.0, "latency")


class Vehicle:
    """Flies north at 10 m/s. Its telemetry comes at 10 Hz after 3 ms; it answers TIMESYNC at 5 Hz after 4 ms."""

    def __init__(self, *, answers: bool = True) -> None:
        self.telemetry, self.answers, self.number = Telemetry(), answers, 0

    def feed(self, utc_ns: int, message: MavlinkMessage, component: int = 1) -> None:
        message.pack(mavlink.MAVLink(None, srcSystem=1, srcComponent=component))
        self.telemetry.feed(self.number, utc_ns // 1000, message)
        self.number += 1

    def fly(self, boot: BootTime, start_s: float, stop_s: float) -> None:
        for step in range(round(start_s * 10), round(stop_s * 10)):
            t_s = step / 10
            utc_ns = START_NS + round(t_s * 1e9)
            latitude = LATITUDE_DEG + math.degrees(SPEED_M_S * t_s / NORTH_M)
            position = mavlink.MAVLink_global_position_int_message(
                boot.ns(t_s) // 10**6, round(latitude * 1e7), 10**8, 200_000, 0, round(SPEED_M_S * 100), 0, 0, 0
            )
            self.feed(utc_ns + 3 * MS, position)
            receiver = (5, round(latitude * 1e7), 10**8, 200_000, 100, 100, 0, 0, 9, 0, 10, 10, 0, 0, 0)
            self.feed(utc_ns + 4 * MS, mavlink.MAVLink_gps_raw_int_message(boot.ns(t_s) // 1000, *receiver))
            if self.answers and step % 2 == 0:
                sent_ns = (utc_ns + 20 * MS) // 1000 * 1000
                self.feed(sent_ns, mavlink.MAVLink_timesync_message(0, sent_ns), component=100)
                answer = mavlink.MAVLink_timesync_message(boot.ns(t_s + 0.022), sent_ns)
                self.feed(sent_ns + 4 * MS, answer)

    def locate(self, t_s: float) -> tuple[str, Pose, float]:
        """(the time's source, the pose, the position's error in σ) of an exposure."""
        exposure = clocks.mid_exposure(START_NS + round(t_s * 1e9), LATENCY, None)
        better, pose = self.telemetry.locate(exposure)
        assert pose.latitude_rad is not None
        assert pose.position_sigma_m is not None
        truth_rad = math.radians(LATITUDE_DEG) + SPEED_M_S * t_s / NORTH_M
        return better.source, pose, abs(pose.latitude_rad - truth_rad) * NORTH_M / pose.position_sigma_m


@pytest.mark.parametrize("by_s", [0.12, 0.4, -0.12, -0.4, 1.5])
def test_a_pose_next_to_a_step_is_in_doubt_and_those_around_it_are_right(by_s: float) -> None:
    """The clock steps at 20.05 s, between two answers (20.02 and 20.22 s)."""
    boot = BootTime(drift=20e-6, jumps=((20.05, by_s),))
    vehicle = Vehicle()
    vehicle.fly(boot, 0, 30)
    for t_s in (10.0, 15.37, 19.0, 19.95, 21.0 + max(0, -by_s), 22.5, 29.3):
        source, pose, sigmas = vehicle.locate(t_s)
        assert (pose.source, "in doubt" in source) == ("interpolated", False), t_s
        assert sigmas < 1
        assert pose.position_sigma_m is not None
        assert pose.position_sigma_m < 0.3
    for t_s in (20.04, 20.08, 20.15, 20.21):
        source, pose, sigmas = vehicle.locate(t_s)
        assert pose.source == "nearest", t_s
        assert f"in doubt: the autopilot's clock stepped by {abs(by_s):.3f} s" in source
        assert sigmas <= 1.2, t_s
    assert vehicle.telemetry.clock_problem(START_NS + 30 * 10**9) == (
        f"the autopilot's clock stepped by {-by_s:+.3f} s: poses next to that are in doubt"
    )
    assert vehicle.telemetry.clock_problem(START_NS + 90 * 10**9) is None


def test_a_pose_waits_for_the_answer_that_may_show_a_step_before_it() -> None:
    boot = BootTime(drift=0.0, jumps=((20.05, 0.3),))
    vehicle = Vehicle()
    vehicle.fly(boot, 0, 20.2)  # a sample from after the exposure has come, the answer has not
    exposure = clocks.mid_exposure(START_NS + round(20.07 * 1e9), LATENCY, None)
    assert not vehicle.telemetry.settled(exposure)
    vehicle.fly(boot, 20.2, 20.5)
    assert vehicle.telemetry.settled(exposure)
    assert "in doubt" in vehicle.telemetry.locate(exposure)[0].source


@pytest.mark.parametrize("drift", [0.02, 1.0, 4.0])
def test_a_clock_that_runs_fast_gives_no_confident_pose(drift: float) -> None:
    """SIM_SPEEDUP. Poses were confident and up to 98 s old."""
    vehicle = Vehicle()
    vehicle.fly(BootTime(drift=drift), 0, 30)
    worst = 0.0
    for number in range(60):
        source, pose, sigmas = vehicle.locate(15 + number * 0.2317)
        assert pose.source == "nearest"
        assert "in doubt: the autopilot's clock stepped" in source
        worst = max(worst, sigmas)
    assert worst < 3
    assert vehicle.telemetry.clock_problem(START_NS + 30 * 10**9) == (
        "the autopilot's clock does not run steadily: poses are in doubt"
    )


@pytest.mark.parametrize("drift", [0.0, 50e-6, -400e-6])
def test_a_steady_clock_has_no_steps(drift: float) -> None:
    vehicle = Vehicle()
    vehicle.fly(BootTime(drift=drift), 0, 60)
    assert vehicle.telemetry.clock_problem(START_NS + 60 * 10**9) is None
    assert vehicle.locate(59.0)[1].source == "interpolated"


@pytest.mark.parametrize("answers", [True, False])
def test_an_exposure_before_a_reboot_is_posed_by_the_boot_before(answers: bool) -> None:
    """The new boot's samples have small times; they were taken for those around the exposure."""
    vehicle = Vehicle(answers=answers)
    vehicle.fly(BootTime(drift=0.0), 0, 20)
    vehicle.fly(BootTime(-22.0, drift=0.0), 23, 30)
    for t_s in (10.02, 19.83):
        source, pose, sigmas = vehicle.locate(t_s)
        assert pose.source == "interpolated"
        assert sigmas < 1
        assert "in doubt" not in source
    late = vehicle.locate(21.0)[1]
    assert late.source == "nearest"
    assert late.age_ms == pytest.approx(1100, abs=20)
    exposure = clocks.mid_exposure(START_NS + 20 * 10**9, LATENCY, None)
    assert vehicle.telemetry.settled(exposure)
    assert vehicle.locate(29.0)[2] < 1


def test_packets_that_all_come_later_widen_the_clock_of_arrivals() -> None:
    """Without TIMESYNC an autopilot that lost 0.3 s can't be told from a link that became slower."""
    steady = [(step * 10**8, START_NS + step * 10**8 + 5 * MS) for step in range(300)]
    lost = [(boot, utc + 300 * MS * (boot > 20 * 10**9)) for boot, utc in steady]
    before, after = from_arrivals(steady), from_arrivals(lost)
    assert before is not None
    assert after is not None
    assert before.sigma_ns < 6 * MS
    assert 300 * MS <= after.sigma_ns < 310 * MS
