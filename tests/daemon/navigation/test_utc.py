"""What a machine knows of UTC, and how it is learnt."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import pytest

from dappled import findings
from dappled.daemon.navigation import Telemetry, UtcCorrection, machine_clock
from dappled.daemon.navigation.clocks import UtcLearner
from dappled.drivers.mavlink import mavlink
from dappled.drivers.utc_choice import RELEASED_NS, ROLLOVER_NS
from dappled.errors import DappledError
from dappled.findings import Code
from dappled.mocks.autopilot.autopilot import BootTime
from dappled.mocks.autopilot.path import FlightPath
from tests.simulated.vehicle import flight

NOW_NS = RELEASED_NS + 10**16


class Notes:
    """What a learner records. The first `refusals` calls fail."""

    def __init__(self, refusals: int = 0) -> None:
        self.refusals = refusals
        self.noted: list[UtcCorrection] = []

    def learn_utc(self, correction_ns: int, sigma_ns: int, source: str) -> None:
        if self.refusals:
            self.refusals -= 1
            raise DappledError("the disk is full")
        self.noted.append(UtcCorrection(correction_ns, sigma_ns, source))


def machine(root: Path, *, board: bool, clock: bool) -> Path:
    if board:
        (root / "proc/device-tree").mkdir(parents=True)
        (root / "proc/device-tree/model").write_text("Raspberry Pi 4 Model B")
    if clock:
        (root / "sys/class/rtc/rtc0").mkdir(parents=True)
    return root


@pytest.mark.parametrize(
    ("board", "clock", "synchronised", "knows"),
    [(True, False, False, False), (True, False, True, True), (True, True, False, True), (False, False, False, True)],
)
def test_a_board_without_a_clock_knows_utc_only_from_the_network(
    tmp_path: Path, board: bool, clock: bool, synchronised: bool, knows: bool
) -> None:
    root = machine(tmp_path, board=board, clock=clock)
    assert machine_clock.machine_knows_utc(NOW_NS, synchronised=lambda: synchronised, root=root) is knows


def test_where_the_kernel_may_not_be_asked_timesyncd_s_mark_tells(tmp_path: Path) -> None:
    root = machine(tmp_path, board=True, clock=False)
    mark = root / "run/systemd/timesync/synchronized"
    mark.parent.mkdir(parents=True)
    assert not machine_clock.machine_knows_utc(NOW_NS, synchronised=lambda: False, root=root)
    mark.touch()
    assert machine_clock.machine_knows_utc(NOW_NS, synchronised=lambda: False, root=root)


def test_a_clock_that_was_never_set_is_not_believed(tmp_path: Path) -> None:
    assert not machine_clock.machine_knows_utc(RELEASED_NS - 1, synchronised=lambda: True, root=tmp_path)
    assert not machine_clock.utc_known("auto", 10**18)


def test_a_person_may_say_so() -> None:
    assert machine_clock.utc_known("system", 0)
    assert not machine_clock.utc_known("autopilot", NOW_NS)


def test_the_kernel_can_be_asked() -> None:
    assert machine_clock.kernel_synchronised() in (True, False)


def test_the_first_word_is_noted_and_then_only_much_better_ones() -> None:
    notes = Notes()
    learner = UtcLearner(notes.learn_utc, known=False)
    assert learner.utc_ns(5) is None
    learner.look(None)
    assert not learner.known
    for correction_ns, sigma_ns in ((100, 50), (101, 40), (102, 25), (103, 24)):
        learner.look(UtcCorrection(correction_ns, sigma_ns, "test"))
    assert [one.correction_ns for one in notes.noted] == [100, 102]
    assert learner.utc_ns(5) == 107
    assert learner.known


def test_what_could_not_be_noted_is_tried_again() -> None:
    notes = Notes(refusals=1)
    learner = UtcLearner(notes.learn_utc, known=False)
    with pytest.raises(DappledError):
        learner.look(UtcCorrection(1, 1, "test"))
    assert learner.utc_ns(5) is None
    learner.look(UtcCorrection(1, 1, "test"))
    assert learner.utc_ns(5) == 6
    assert notes.noted == [UtcCorrection(1, 1, "test")]


def test_a_machine_that_knows_learns_nothing() -> None:
    notes = Notes()
    learner = UtcLearner(notes.learn_utc, known=True)
    learner.look(UtcCorrection(1, 1, "test"))
    assert learner.utc_ns(5) == 5
    assert notes.noted == []


S = 10**9


@pytest.mark.parametrize(
    ("correction_ns", "sigma_ns", "said"),
    [
        (3600 * S, S // 100, "-3600 s"),
        (-3600 * S, S // 100, "+3600 s"),
        (2 * S, S // 100, "-2 s"),
        (S // 2, 0, None),
        (3 * S, S, None),  # nobody knows it that well
    ],
)
def test_a_clock_that_is_believed_and_wrong_is_told(correction_ns: int, sigma_ns: int, said: str | None) -> None:
    notes = Notes()
    learner = UtcLearner(notes.learn_utc, known=True)
    assert learner.doubt() is None
    learner.look(UtcCorrection(correction_ns, sigma_ns, "test"))
    learner.look(None)  # the autopilot was silent for a moment
    told = learner.doubt()
    assert (told is None) if said is None else (told is not None and said in str(findings.told(told)))
    assert learner.utc_ns(5) == 5
    assert notes.noted == []
    unsure = UtcLearner(notes.learn_utc, known=False)
    unsure.look(UtcCorrection(correction_ns, sigma_ns, "test"))
    assert unsure.doubt() is None


def test_the_autopilots_satellites_tell_what_is_missing() -> None:
    """Our clock began in 1970; the autopilot sends SYSTEM_TIME, first without a time, then with."""
    telemetry, truth_ns = Telemetry(), 1_790_000_000 * 10**9
    for number, (t_s, message) in enumerate(flight(FlightPath(3), BootTime(), 0, 6)):
        if message.get_type() == "SYSTEM_TIME" and t_s > 3:
            message.time_unix_usec = truth_ns // 1000 + round(t_s * 1e6)
        message.pack(mavlink.MAVLink(None, srcSystem=1, srcComponent=1))
        telemetry.feed(number, round((100 + t_s) * 1e6), message)
        found = telemetry.utc_correction()
        assert (found is None) or t_s > 3
    assert found is not None
    assert found.correction_ns == pytest.approx(truth_ns - 100 * 10**9, abs=6e6)
    assert 0 < found.sigma_ns < 10**7


def heard(unix_minus_truth_s: Callable[[float], float | None], *, upto_s: float, our_ns: int = 100 * S) -> Telemetry:
    """Telemetry of an autopilot whose SYSTEM_TIME is so far from the truth at each time. Our clock begins at
    `our_ns`."""
    telemetry = Telemetry()
    for number, (t_s, message) in enumerate(flight(FlightPath(3), BootTime(), 0, upto_s)):
        if message.get_type() == "SYSTEM_TIME":
            off_s = unix_minus_truth_s(t_s)
            message.time_unix_usec = 0 if off_s is None else TRUTH_NS // 1000 + round((t_s + off_s) * 1e6)
        message.pack(mavlink.MAVLink(None, srcSystem=1, srcComponent=1))
        telemetry.feed(number, (our_ns + round(t_s * S)) // 1000, message)
    return telemetry


TRUTH_NS = 1_790_000_000 * S


def test_an_early_utc_is_given_up_when_later_messages_disagree() -> None:
    """A real-time clock is 37 s slow for 8 s, then the satellites' time is known."""
    notes = Notes()
    learner = UtcLearner(notes.learn_utc, known=False)
    for upto_s in (5.0, 7.5, 12.0, 14.0):
        learner.look(heard(lambda t_s: -37.0 if t_s < 8 else 0.0, upto_s=upto_s).utc_correction())
    assert [one.correction_ns / S for one in notes.noted] == pytest.approx(
        [(TRUTH_NS - 100 * S) / S - 37, (TRUTH_NS - 100 * S) / S], abs=0.006
    )


def test_one_wrong_message_moves_no_utc() -> None:
    found = heard(lambda t_s: 5.0 if 8 <= t_s < 9 else 0.0, upto_s=8.5).utc_correction()
    assert found is not None
    assert found.correction_ns == pytest.approx(TRUTH_NS - 100 * S, abs=6e6)


def test_a_time_without_a_fix_does_not_replace_the_satellites() -> None:
    learner = UtcLearner((notes := Notes()).learn_utc, known=False)
    learner.look(UtcCorrection(0, 100, "test", by_fix=True))
    learner.look(UtcCorrection(37 * S, 100, "test"))
    learner.look(UtcCorrection(-37 * S, 100, "test", by_fix=True))
    assert [one.correction_ns for one in notes.noted] == [0, -37 * S]


@pytest.mark.parametrize("year", [2007, 2015, 2050])
def test_a_date_before_the_release_or_after_the_next_rollover_is_no_utc(year: int) -> None:
    off_s = (year - 2026) * 365.25 * 86400
    telemetry = heard(lambda _: off_s, upto_s=4.0)
    assert telemetry.utc_correction() is None
    assert telemetry.doubts()


def test_a_gps_week_that_rolled_over_is_mended_where_the_machine_agrees() -> None:
    """A machine whose clock shows about the right date, and one that shows 1970."""
    off_s = -ROLLOVER_NS / S
    agreed = heard(lambda _: off_s, upto_s=4.0, our_ns=TRUTH_NS - 3600 * S)
    found = agreed.utc_correction()
    assert found is not None
    assert found.correction_ns == pytest.approx(3600 * S, abs=6e6)
    assert agreed.doubts() == ()
    alone = heard(lambda _: off_s, upto_s=4.0)
    assert alone.utc_correction() is None
    (doubt,) = alone.doubts()
    assert doubt.code is Code.TIME_WEEK_ROLLOVER
    assert "2026-09-21" in str(doubt.facts["later"])
