"""Photographs by the way flown: where they are taken, and what is said where they can't be."""

from __future__ import annotations

import math
from dataclasses import dataclass, field, replace

import pytest
from hypothesis import given
from hypothesis import strategies as st

from dappled.clock import RecordedClock
from dappled.config.settings import PoseSettings
from dappled.daemon.pipeline.shutter import Shutter
from dappled.daemon.pipeline.spacing import DistanceTrigger, Height, Spacing, seen_m
from dappled.decode.geometry import Pose, from_euler, metres_per_radian
from dappled.findings import Code, text
from tests.daemon.fakes import NO_CAMERA, FakeSink, no_pose

HOME = (math.radians(41.6), math.radians(-91.5), 220.0)
MOUNT = PoseSettings().mount  # down, the image's top forward
STEP_S = 0.02


@dataclass
class Rig:
    """A vehicle that flies a straight line; positions come `hz` times a second. The body takes `busy_s` a shot."""

    speed_m_s: float = 5.0
    course_rad: float = 0.0
    hz: float = 10.0
    busy_s: float = 0.0
    capacity: int = 1
    t_s: float = 0.0
    above: Height | None = field(default_factory=lambda: Height(20.0, "take-off"))
    view: tuple[float, float] | None = (0.4, 0.6)
    silent: bool = False
    climbed_m: float | None = 0.0
    configured: Spacing | None = None
    from_height_m: float = 0.0

    def __post_init__(self) -> None:
        self.clock = RecordedClock(10**18, 10**18 - 10**9)
        self.sink = FakeSink()
        self.shutter = Shutter(self.sink, self.clock, next_index=0, capacity=self.capacity)
        self.trigger = DistanceTrigger(
            self.shutter,
            self,
            self.clock,
            mount=MOUNT,
            configured=self.configured,
            from_height_m=self.from_height_m,
        )
        self.shots_m: list[float] = []
        self._pending: list[tuple[float, int]] = []

    def pose(self) -> Pose | None:
        if self.silent:
            return no_pose()
        age_s = self.t_s % (1 / self.hz)
        reached_m = self.speed_m_s * (self.t_s - age_s)
        north_m, east_m = metres_per_radian(HOME[0], HOME[2])
        north, east = math.cos(self.course_rad), math.sin(self.course_rad)
        return replace(
            no_pose(),
            source="nearest",
            latitude_rad=HOME[0] + reached_m * north / north_m,
            longitude_rad=HOME[1] + reached_m * east / east_m,
            altitude_msl_m=HOME[2],
            height_above_home_m=self.climbed_m,
            velocity_ned_m_s=(self.speed_m_s * north, self.speed_m_s * east, 0.0),
            attitude=from_euler(0.0, 0.0, 0.0),
            age_ms=age_s * 1e3,
        )

    def height(self) -> Height | None:
        return self.above

    def field(self) -> tuple[float, float] | None:
        return self.view

    def busy(self) -> bool:
        return bool(self._pending)

    def fly(self, seconds: float) -> None:
        for _ in range(round(seconds / STEP_S)):
            self.clock.advance(STEP_S)
            self.t_s += STEP_S
            while self._pending and self._pending[0][0] <= self.t_s:
                self.shutter.settled(self._pending.pop(0)[1], True)
            before = len(self.sink.fired)
            self.trigger.serve()
            for index in self.sink.fired[before:]:
                self.shots_m.append(self.speed_m_s * self.t_s)
                self._pending.append((self.t_s + self.busy_s, index))


def gaps(rig: Rig) -> list[float]:
    return [b - a for a, b in zip(rig.shots_m, rig.shots_m[1:], strict=False)]


@given(st.floats(1.0, 20.0), st.floats(2.0, 30.0), st.floats(0, 2 * math.pi), st.sampled_from([2.0, 5.0, 10.0, 50.0]))
def test_photographs_are_a_distance_apart_whatever_speed_course_and_rate(
    speed: float, distance: float, course: float, hz: float
) -> None:
    rig = Rig(speed, course, hz)
    rig.trigger.begin(Spacing(distance), "console", at_once=True)
    rig.fly(10 * distance / speed + 1)
    assert len(rig.shots_m) >= 10
    assert all(distance - 1e-3 <= gap <= distance + speed * STEP_S + 1e-3 for gap in gaps(rig))
    assert rig.trigger.statistics() is not None


def test_the_first_one_is_a_distance_away_unless_it_is_to_be_at_once() -> None:
    for at_once, first_m in ((True, 0.1), (False, 10.1)):
        rig = Rig()
        rig.trigger.begin(Spacing(10.0), "console", at_once=at_once)
        rig.fly(5)
        assert rig.shots_m[0] == pytest.approx(first_m, abs=0.15)


def test_hovering_takes_one_photograph_at_most() -> None:
    rig = Rig(speed_m_s=0.0)
    rig.trigger.begin(Spacing(1.0), "console", at_once=True)
    rig.fly(20)
    assert len(rig.shots_m) == 1


@pytest.mark.parametrize(
    ("course", "seen"),
    [(0.0, 8.0), (math.pi / 2, 12.0), (math.pi, 8.0), (math.pi / 4, 8.0 * math.sqrt(2)), (math.atan2(3, 2), None)],
)
def test_an_overlap_counts_along_the_way_over_the_frame(course: float, seen: float | None) -> None:
    """20 m up, a frame of 0.4 by 0.6 of the focal length sees 8 m by 12 m; its top points ahead of the vehicle, whose
    nose points north."""
    seen = math.hypot(8, 12) if seen is None else seen  # over the corner
    rig = Rig(course_rad=course, speed_m_s=2.0)
    rig.trigger.begin(Spacing(overlap=0.75), "console", at_once=True)
    rig.fly(20)
    assert gaps(rig)[1:] == pytest.approx([seen / 4] * (len(gaps(rig)) - 1), abs=0.05)
    told = rig.trigger.statistics()
    assert told is not None
    assert told.spacing_m == pytest.approx(seen / 4)
    assert told.height == Height(20.0, "take-off")


def test_an_overlap_follows_the_height() -> None:
    rig = Rig(speed_m_s=2.0)
    rig.trigger.begin(Spacing(overlap=0.5), "console", at_once=True)
    rig.fly(20)
    rig.above = Height(40.0, "rangefinder")
    rig.fly(20)
    assert gaps(rig)[3] == pytest.approx(4.0, abs=0.05)
    assert gaps(rig)[-1] == pytest.approx(8.0, abs=0.05)


def test_without_a_course_or_an_attitude_the_shorter_side_counts() -> None:
    assert seen_m(10, (0.4, 0.6), None, from_euler(0, 0, 0), MOUNT) == pytest.approx(4)
    assert seen_m(10, (0.6, 0.4), (1.0, 0, 0), None, MOUNT) == pytest.approx(4)
    assert seen_m(10, (0.6, 0.4), (0, 0, 1.0), from_euler(0, 0, 0), MOUNT) == pytest.approx(4)


@pytest.mark.parametrize(
    ("change", "says"),
    [
        ({"silent": True}, "there is no position"),
        ({"hz": 0.4}, "older than a second"),
        ({"above": None}, "the height is unknown"),
        ({"above": Height(0.5, "take-off")}, "too low"),
        ({"view": None}, "focal length"),
    ],
)
def test_what_is_unknown_takes_no_photograph_by_overlap_and_is_said(change: dict[str, object], says: str) -> None:
    rig = Rig()
    rig.trigger.begin(Spacing(overlap=0.5), "console")
    rig.fly(2.0)
    for name, value in change.items():
        setattr(rig, name, value)
    count = len(rig.shots_m)
    told = []
    for _ in range(100):
        rig.fly(0.1)
        found = rig.trigger.statistics()
        told.append("" if found is None or found.trouble is None else str(text(found.trouble)))
    assert any(says in text for text in told)
    if "hz" not in change:
        assert len(rig.shots_m) == count


def test_without_a_focal_length_the_first_photograph_tells_it() -> None:
    rig = Rig(view=None)
    rig.trigger.begin(Spacing(overlap=0.5), "console", at_once=True)
    rig.fly(3)
    assert len(rig.shots_m) == 1
    rig.view = (0.4, 0.6)
    rig.fly(3)
    assert len(rig.shots_m) > 3


def test_a_body_that_is_not_ready_is_waited_for_and_too_fast_is_said() -> None:
    rig = Rig(busy_s=1.5)
    rig.trigger.begin(Spacing(5.0), "console", at_once=True)  # one a second is wanted
    rig.fly(31)
    assert gaps(rig) == pytest.approx([7.5] * len(gaps(rig)), abs=0.3)
    found = rig.trigger.statistics()
    assert found is not None
    assert found.late == len(gaps(rig))
    assert found.trouble is not None
    assert found.trouble.code == Code.SERIES_LATE
    assert rig.shutter.statistics().refused == 0


def test_a_whole_spacing_late_is_missed_and_counted_as_refused() -> None:
    rig = Rig(busy_s=100.0)
    rig.trigger.begin(Spacing(5.0), "console", at_once=True)
    rig.fly(30.5)
    assert len(rig.shots_m) == 1
    assert rig.shutter.statistics().refused == 15  # one in ten metres, not one in each look


def test_a_camera_that_is_away_costs_one_refusal_a_photograph() -> None:
    rig = Rig()
    rig.sink.problem = NO_CAMERA
    rig.trigger.begin(Spacing(5.0), "console", at_once=True)
    rig.fly(10.1)
    assert rig.shots_m == []
    assert rig.shutter.statistics().refused == 11


def test_it_ends_and_begins_again_and_the_same_wish_twice_is_one() -> None:
    rig = Rig()
    rig.trigger.begin(Spacing(5.0), "mavlink:255/190", at_once=True)
    rig.fly(0.5)
    rig.trigger.begin(Spacing(5.0), "mavlink:255/190", at_once=True)  # a retry
    rig.fly(0.3)
    assert len(rig.shots_m) == 1
    assert rig.trigger.end() == "stopped"
    assert rig.trigger.end() == "none ran"
    rig.fly(10)
    assert len(rig.shots_m) == 1
    assert rig.trigger.statistics() is None


@pytest.mark.parametrize(
    "wrong", [{}, {"distance_m": -1.0}, {"distance_m": math.nan}, {"overlap": 1.0}, {"overlap": -0.1}]
)
def test_what_can_not_be_flown_is_refused(wrong: dict[str, float]) -> None:
    with pytest.raises(ValueError, match=r"distance|overlap"):
        Spacing(**wrong)


def test_a_stop_that_a_link_held_back_ends_no_later_series() -> None:
    rig = Rig()
    pressed_ns = rig.clock.monotonic_ns()
    rig.fly(1)
    rig.trigger.begin(Spacing(5.0), "mavlink:255/190")
    assert rig.trigger.end(asked_ns=pressed_ns) == "began later"
    assert rig.trigger.end(asked_ns=rig.clock.monotonic_ns()) == "stopped"


def surveying(**changes: object) -> Rig:
    rig = Rig(configured=Spacing(5.0), from_height_m=30.0)
    for name, value in changes.items():
        setattr(rig, name, value)
    return rig


def test_the_series_of_the_settings_begins_above_its_height_and_ends_a_fifth_lower() -> None:
    rig = surveying(climbed_m=29.9)
    rig.fly(10)
    assert rig.shots_m == []
    rig.climbed_m = 30.1
    rig.fly(10)
    assert len(rig.shots_m) == 10  # at once, then each 5 m
    rig.climbed_m = 25.0  # a survey line over a hill goes on
    rig.fly(10)
    assert len(rig.shots_m) == 20
    rig.climbed_m = 23.9
    rig.fly(10)
    assert len(rig.shots_m) == 20
    assert rig.trigger.statistics() is None


def test_a_series_that_somebody_ended_begins_again_only_from_below() -> None:
    rig = surveying(climbed_m=40.0)
    rig.fly(1)
    assert rig.trigger.end() == "stopped"
    rig.fly(10)
    assert len(rig.shots_m) == 1
    rig.climbed_m = 10.0
    rig.fly(1)
    rig.climbed_m = 40.0
    rig.fly(1)
    assert len(rig.shots_m) == 2


def test_a_series_that_a_ground_station_asked_for_is_left_alone_by_the_height() -> None:
    rig = surveying(climbed_m=10.0)
    rig.trigger.begin(Spacing(20.0), "mavlink:255/190", at_once=True)
    rig.fly(1)
    rig.climbed_m = 40.0
    rig.fly(1)
    rig.climbed_m = 10.0
    rig.fly(1)
    told = rig.trigger.statistics()
    assert told is not None
    assert told.wanted == Spacing(20.0)


@pytest.mark.parametrize("unknown", [{"silent": True}, {"climbed_m": None}])
def test_an_unknown_height_neither_begins_nor_ends_a_series(unknown: dict[str, object]) -> None:
    rig = surveying(**{"climbed_m": 40.0, **unknown})
    rig.fly(1.5)
    assert rig.shots_m == []
    rig.silent, rig.climbed_m = False, 40.0
    rig.fly(1.5)
    assert len(rig.shots_m) == 2
    for name, value in unknown.items():
        setattr(rig, name, value)
    rig.fly(1)
    assert rig.trigger.statistics() is not None


def test_an_old_height_ends_no_series() -> None:
    rig = surveying(climbed_m=40.0)
    rig.fly(1)
    rig.t_s, rig.hz, rig.climbed_m = 0.0, 0.01, 10.0  # a position of the start is all that comes for 100 s
    rig.fly(0.9)
    assert rig.trigger.statistics() is None
    rig.climbed_m = 40.0
    rig.t_s = 0.0
    rig.fly(0.5)
    assert rig.trigger.statistics() is not None
    rig.fly(1)
    rig.climbed_m = 10.0
    rig.fly(10)
    assert rig.trigger.statistics() is not None


def test_without_a_series_in_the_settings_none_begins() -> None:
    rig = Rig(from_height_m=30.0, climbed_m=40.0)
    assert not rig.trigger.begin_configured("mavlink:255/190")
    rig.fly(5)
    assert rig.shots_m == []
