"""An autopilot whose clock steps, runs fast or starts again: what a pose near that is worth, and that it says so."""

from __future__ import annotations

import math
import random
from dataclasses import replace

import pytest

from dappled.daemon.navigation import BodyLatency, Telemetry, clocks
from dappled.daemon.navigation.clocks import from_arrivals
from dappled.decode.geometry import Pose, metres_per_radian
from dappled.drivers.mavlink import MavlinkMessage, mavlink
from dappled.findings import Code, Finding, text
from dappled.flight import Cause, Shot, TimeSource
from dappled.mocks.autopilot.autopilot import BootTime

START_NS = 1_790_000_000 * 10**9
SPEED_M_S, LATITUDE_DEG = 10.0, 41.0
MS = 10**6
NORTH_M, _ = metres_per_radian(math.radians(LATITUDE_DEG), 200.0)
LATENCY = BodyLatency(0.0, 1.0)


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

    def locate(self, t_s: float) -> tuple[list[Finding], Pose, float]:
        """(doubts of the time, the pose, the position's error in σ) of an exposure."""
        exposure = clocks.mid_exposure(START_NS + round(t_s * 1e9), LATENCY, None)
        better, pose = self.telemetry.locate(exposure)
        assert pose.latitude_rad is not None
        assert pose.position_sigma_m is not None
        truth_rad = math.radians(LATITUDE_DEG) + SPEED_M_S * t_s / NORTH_M
        return list(better.doubts), pose, abs(pose.latitude_rad - truth_rad) * NORTH_M / pose.position_sigma_m


@pytest.mark.parametrize("by_s", [0.12, 0.4, 1.5])
def test_a_step_ahead_without_answers_to_timesync_is_seen_as_well(by_s: float) -> None:
    """Telemetry that comes all at once sooner: an exposure before it was placed by it, some metres off, in no doubt."""
    vehicle = Vehicle(answers=False)
    vehicle.fly(BootTime(drift=20e-6, jumps=((20.05, by_s),)), 0, 30)
    for t_s in (10.0, 15.37, 19.0, 19.85, 21.0, 22.5, 29.3):
        doubts, pose, sigmas = vehicle.locate(t_s)
        assert (pose.source, bool(doubts), sigmas < 1.2) == ("interpolated", False, True), t_s
    doubts, pose, sigmas = vehicle.locate(20.07)
    assert (pose.source, bool(doubts), sigmas < 1.2) == ("nearest", True, True)
    told = vehicle.telemetry.doubts()[0]
    assert told.code is Code.CLOCK_STEPPED
    assert float(str(told.facts["by_s"])) < 0


@pytest.mark.parametrize("late_s", [0.05, 0.3, 2.0])
def test_telemetry_that_was_late_for_a_while_is_no_step(late_s: float) -> None:
    """A link stalls and then brings everything at once; before that, at the start, it was buffered."""
    vehicle, boot = Vehicle(answers=False), BootTime(drift=20e-6)
    rng = random.Random(5)  # noqa: S311  a simulation
    receive = vehicle.feed
    stalls_s = ((0.0, late_s), (10.0, 10.0 + late_s), (14.0, 14.0 + late_s / 3))

    def late(utc_ns: int, message: MavlinkMessage, component: int = 1) -> None:
        t_s = (utc_ns - START_NS) / 1e9
        until_s = max([end for begin, end in stalls_s if begin <= t_s < end], default=t_s)
        receive(START_NS + round((until_s + rng.expovariate(1 / 0.004)) * 1e9), message, component)

    vehicle.feed = late  # type: ignore[method-assign]  # the link between
    vehicle.fly(boot, 0, 30)
    assert vehicle.telemetry.doubts() == ()
    assert vehicle.locate(25.0)[2] < 1.2


@pytest.mark.parametrize("answers", [True, False])
@pytest.mark.parametrize("fast_port", [True, False])
def test_a_request_that_a_link_held_is_known_as_late(answers: bool, fast_port: bool) -> None:
    """From 10 s to 13.5 s a link holds its bytes, then brings all: five photographs of one place, in no doubt. What a
    second port brings in time says nothing about them."""
    vehicle, boot = Vehicle(answers=answers), BootTime(drift=20e-6)
    receive = vehicle.feed

    def stamp_ns(utc_ns: int) -> int:
        t_s = (utc_ns - START_NS) / 1e9
        return START_NS + round((13.5 + (t_s - 10) / 2000) * 1e9) if 10 <= t_s < 13.5 else utc_ns

    def hold(utc_ns: int, message: MavlinkMessage, component: int = 1) -> None:
        receive(stamp_ns(utc_ns), message, component)

    vehicle.feed = hold  # type: ignore[method-assign]  # the link between
    vehicle.fly(boot, 0, 10)
    if fast_port:
        receive(START_NS + round(13.499e9), mavlink.MAVLink_attitude_message(boot.ns(13.49) // 10**6, *[0] * 6))
    vehicle.fly(boot, 10, 30)
    for t_s in (3.02, 10.22, 11.02, 12.22, 13.22, 20.02):
        heard_ns = stamp_ns(START_NS + round(t_s * 1e9))
        shot = Shot(0, Cause("mavlink:1/1", "IMAGE_START_CAPTURE", 1), heard_ns, heard_ns)
        exposure = clocks.asked(clocks.mid_exposure(heard_ns, LATENCY, None), shot)
        doubts = vehicle.telemetry.locate(exposure)[0].doubts
        late_s = (heard_ns - START_NS) / 1e9 - t_s
        held = late_s > 1.05 and not fast_port
        assert [one.code for one in doubts] == [Code.FRAME_REQUEST_LATE] * held, t_s
        if held:
            assert doubts[0].facts["late_s"] == pytest.approx(late_s, abs=0.1)


@pytest.mark.parametrize("by_s", [0.12, -0.4, 1.5])
def test_a_pose_next_to_a_step_is_in_doubt_and_those_around_it_are_right(by_s: float) -> None:
    """The clock steps at 20.05 s, between two answers (20.02 and 20.22 s)."""
    boot = BootTime(drift=20e-6, jumps=((20.05, by_s),))
    vehicle = Vehicle()
    vehicle.fly(boot, 0, 30)
    for t_s in (10.0, 15.37, 19.0, 19.95, 21.0 + max(0, -by_s), 22.5, 29.3):
        doubts, pose, sigmas = vehicle.locate(t_s)
        assert (pose.source, bool(doubts)) == ("interpolated", False), t_s
        assert sigmas < 1
        assert pose.position_sigma_m is not None
        assert pose.position_sigma_m < 0.3
    for t_s in (20.04, 20.08, 20.15, 20.21):
        doubts, pose, sigmas = vehicle.locate(t_s)
        assert pose.source == "nearest", t_s
        assert [(one.code, one.facts["steps"]) for one in doubts] == [(Code.CLOCK_STEPPED, 1)]
        assert doubts[0].facts["by_s"] == pytest.approx(abs(by_s), abs=0.001)
        assert sigmas <= 1.2, t_s
    (told,) = vehicle.telemetry.doubts()
    assert told.code is Code.CLOCK_STEPPED
    assert told.facts["by_s"] == pytest.approx(-by_s, abs=0.001)
    vehicle.fly(boot, 30, 82)  # a minute of telemetry without another step ends it, not the time that passes
    assert vehicle.telemetry.doubts() == ()


def test_a_pose_waits_for_the_answer_that_may_show_a_step_before_it() -> None:
    boot = BootTime(drift=0.0, jumps=((20.05, 0.3),))
    vehicle = Vehicle()
    vehicle.fly(boot, 0, 20.2)  # a sample from after the exposure has come, the answer has not
    exposure = clocks.mid_exposure(START_NS + round(20.07 * 1e9), LATENCY, None)
    assert not vehicle.telemetry.settled(exposure)
    vehicle.fly(boot, 20.2, 20.5)
    assert vehicle.telemetry.settled(exposure)
    assert vehicle.telemetry.locate(exposure)[0].doubts


@pytest.mark.parametrize("drift", [0.02, 1.0, 4.0])
def test_a_clock_that_runs_fast_gives_no_confident_pose(drift: float) -> None:
    """SIM_SPEEDUP. Poses were confident and up to 98 s old."""
    vehicle = Vehicle()
    vehicle.fly(BootTime(drift=drift), 0, 30)
    worst = 0.0
    for number in range(60):
        doubts, pose, sigmas = vehicle.locate(15 + number * 0.2317)
        assert pose.source == "nearest"
        assert [one.code for one in doubts] == [Code.CLOCK_STEPPED]
        worst = max(worst, sigmas)
    assert worst < 3
    (told,) = vehicle.telemetry.doubts()
    if drift < 0.2:
        assert told.code is Code.CLOCK_UNSTEADY
    else:
        assert told.code is Code.CLOCK_NOT_REAL_TIME
        assert told.facts["rate"] == pytest.approx(1 + drift, rel=0.05)
        assert f"{1 + drift:.1f} times as fast" in str(text(told))


@pytest.mark.parametrize("drift", [0.0, 50e-6, -400e-6])
def test_a_steady_clock_has_no_steps(drift: float) -> None:
    vehicle = Vehicle()
    vehicle.fly(BootTime(drift=drift), 0, 60)
    assert vehicle.telemetry.doubts() == ()
    assert vehicle.locate(59.0)[1].source == "interpolated"


@pytest.mark.parametrize("answers", [True, False])
def test_an_exposure_before_a_reboot_is_posed_by_the_boot_before(answers: bool) -> None:
    """The new boot's samples have small times; they were taken for those around the exposure."""
    vehicle = Vehicle(answers=answers)
    vehicle.fly(BootTime(drift=0.0), 0, 20)
    vehicle.fly(BootTime(-22.0, drift=0.0), 23, 30)
    for t_s in (10.02, 19.83):
        doubts, pose, sigmas = vehicle.locate(t_s)
        assert pose.source == "interpolated"
        assert sigmas < 1
        assert not doubts
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


@pytest.mark.parametrize(("at_s", "told"), [(20.01, False), (20.06, True)])
def test_a_hot_shoe_beside_a_step_has_a_pose_as_wide_as_it(at_s: float, told: bool) -> None:
    """Its time is exact, but the samples around it may be from before or after a step: errors were up to 17 sigma. Of
    one before an answer that shows no step, they are not."""
    boot = BootTime(drift=0.0, jumps=((14.05, 0.3), (20.05, 0.4)))
    vehicle = Vehicle()
    vehicle.fly(boot, 0, 20.1)
    heard_ns = START_NS + round((at_s + 0.002) * 1e9)
    contact = mavlink.MAVLink_camera_feedback_message(boot.ns(at_s) // 1000, 0, 0, 1, 0, 0, 0, 0, 0, 0, 0, 0, 0, 1)
    vehicle.feed(heard_ns, contact)
    vehicle.fly(boot, 20.1, 25)
    trigger = clocks.TriggerMessage("CAMERA_FEEDBACK", 1, heard_ns, LATENCY)
    exposure = replace(clocks.mid_exposure(heard_ns, LATENCY, None), trigger=trigger)
    better, pose = vehicle.telemetry.locate(exposure)
    assert [(one.code, one.facts["steps"]) for one in better.doubts] == [(Code.CLOCK_STEPPED, 2)] * told
    assert pose.source == "nearest"
    assert pose.latitude_rad is not None
    assert pose.position_sigma_m is not None
    assert (pose.position_sigma_m >= 0.4 * SPEED_M_S) == told
    truth_rad = math.radians(LATITUDE_DEG) + SPEED_M_S * at_s / NORTH_M
    assert abs(pose.latitude_rad - truth_rad) * NORTH_M < 1.2 * pose.position_sigma_m
    assert told or better.source == TimeSource.HOT_SHOE


def test_contacts_between_steps_keep_their_times() -> None:
    """A simulator's clock steps each 1.5 s: of 41 shots with contacts of their own 11 had the time of the call."""
    boot = BootTime(drift=0.0, jumps=tuple((10.07 + 1.5 * number, (-0.1, 0.3)[number % 2]) for number in range(14)))
    vehicle, contacts = Vehicle(), 0
    calls_s = [10.0 + 0.37 * number for number in range(50)]
    for last_s, at_s in zip([0.0, *calls_s], calls_s, strict=False):
        vehicle.fly(boot, math.floor(last_s * 10) / 10, math.floor(at_s * 10) / 10)
        contact = mavlink.MAVLink_camera_feedback_message(
            boot.ns(at_s + 0.06) // 1000, 0, 0, round(at_s * 100), 0, 0, 0, 0, 0, 0, 0, 0, 0, 1
        )
        vehicle.feed(START_NS + round((at_s + 0.07) * 1e9), contact)
    vehicle.fly(boot, calls_s[-1], 35)
    for at_s in calls_s:
        called_ns = START_NS + round(at_s * 1e9)
        better = vehicle.telemetry.locate(clocks.mid_exposure(called_ns, BodyLatency(75.0, 9.0), None))[0]
        contacts += better.source == TimeSource.HOT_SHOE
        assert better.doubts or abs(better.utc_ns - called_ns - 60 * MS) < max(4 * better.sigma_ns, 5 * MS), at_s
    assert contacts >= 35  # of 50; the others were within the 0.2 s between two answers in which it steps


@pytest.mark.parametrize("by_s", [0.4, -0.4])
def test_right_after_the_answer_that_shows_a_step_there_is_a_pose(by_s: float) -> None:
    """Samples of the old epoch were compared with times of the new one: 7 of 240 frames had none."""
    vehicle, boot = Vehicle(), BootTime(drift=0.0, jumps=((20.05, by_s),))
    vehicle.fly(boot, 0, 20.3)  # ends with the answer of 20.22 s, the first after the step
    for t_s in (20.21, 20.23, 20.26):
        exposure = clocks.mid_exposure(START_NS + round(t_s * 1e9), LATENCY, None)
        assert not vehicle.telemetry.settled(exposure), t_s
        _, pose, sigmas = vehicle.locate(t_s)
        assert pose.source == "nearest"
        assert sigmas < 1.2


@pytest.mark.parametrize(("gap_s", "by_s"), [(11, 0.3), (11, 15.0), (60, -0.3), (100, -0.3)])
def test_a_step_in_a_silence_of_timesync_is_seen(gap_s: float, by_s: float) -> None:
    """A simulator that was halted. Nothing was compared: poses were 0.3 and 15 s wrong with a sigma of 7 and 30 ms."""
    boot = BootTime(drift=0.0, jumps=((30.0, by_s),))
    vehicle = Vehicle()
    vehicle.fly(boot, 0, 20)
    vehicle.fly(boot, 20 + gap_s, 30 + gap_s)
    for t_s in (15.0, 22.0 + gap_s + max(0.0, -by_s), 29.0 + gap_s):
        doubts, pose, sigmas = vehicle.locate(t_s)
        assert (pose.source, bool(doubts)) == ("interpolated", False), t_s
        assert sigmas < 1, t_s
    for t_s in (20.5, 25.0, 19.5 + gap_s):  # also more than ten seconds from the first answer after the step
        better, pose = vehicle.telemetry.locate(clocks.mid_exposure(START_NS + round(t_s * 1e9), LATENCY, None))
        assert pose.source != "interpolated", t_s
        (told,) = better.doubts
        assert told.facts["by_s"] == pytest.approx(abs(by_s), abs=0.001), t_s


def test_beside_steps_no_shot_gets_the_next_ones_contact() -> None:
    """Tagged 2.2 s late at one shot a second: the time was 1 s wrong, the pose interpolated, 10 m off with 2 cm."""
    boot = BootTime(drift=0.0, jumps=((30.0, 0.3), (35.0, -0.3)))
    vehicle = Vehicle()
    for at in range(10, 50):
        vehicle.fly(boot, at, at + 0.4)
        contact = mavlink.MAVLink_camera_feedback_message(
            boot.ns(at + 0.36) // 1000, 0, 0, at, 0, 0, 0, 0, 0, 0, 0, 0, 0, 1
        )
        vehicle.feed(START_NS + at * 10**9 + 370 * MS, contact)
        vehicle.fly(boot, at + 0.4, at + 1)
    for at in range(20, 46):
        called_ns, truth_ns = START_NS + at * 10**9 + 300 * MS, START_NS + at * 10**9 + 360 * MS
        better, pose = vehicle.telemetry.locate(clocks.mid_exposure(called_ns, BodyLatency(60.0, 15.0), None))
        assert abs(better.utc_ns - truth_ns) < 100 * MS, at
        assert pose.boot_us is not None
        assert pose.source != "interpolated" or abs(pose.boot_us * 1000 - boot.ns(at + 0.36)) < 5 * MS, at


@pytest.mark.parametrize("boot_ns", [-(2**63), -(2**62), -(10**9), 2**62, 2**63 - 10**9])
def test_an_absurd_answer_to_timesync_is_none(boot_ns: int) -> None:
    """Before the first position: sums of such times do not fit 64 bits, and no frame had a tag for two minutes."""
    vehicle = Vehicle()
    vehicle.feed(START_NS, mavlink.MAVLink_system_time_message(0, 5))
    for step in range(5):
        sent_ns = START_NS + step * 200 * MS
        vehicle.feed(sent_ns, mavlink.MAVLink_timesync_message(0, sent_ns), component=100)
        vehicle.feed(sent_ns + 4 * MS, mavlink.MAVLink_timesync_message(boot_ns + step * 200 * MS, sent_ns))
    assert vehicle.telemetry.pose_at(START_NS + 10**9, 0.0).source == "none"
    assert vehicle.telemetry.utc_correction() is None
    assert vehicle.telemetry.boot_clock() is None
