"""The mission over a survey's holes, flown item by item with our own trigger by distance: every hole closes."""

from __future__ import annotations

import json
import math
from dataclasses import replace
from typing import Any

import numpy as np
import pytest

from dappled import findings
from dappled.clock import RecordedClock
from dappled.config.settings import PoseSettings
from dappled.daemon.pipeline.shutter import Shutter
from dappled.daemon.pipeline.spacing import DistanceTrigger, Height, Spacing
from dappled.decode.geometry import Pose
from dappled.products.maps import coverage, refly
from dappled.products.maps.photographs import Station
from tests.daemon.fakes import FakeSink
from tests.products.maps.test_coverage import HEIGHT_M, HOME, PROJECTION, frame, grid, seen, square, survey

STEP_S, POSITIONS_HZ, BUSY_S = 0.02, 5.0, 0.7
TAKEOFF, WAYPOINT, SPEED, DISTANCE = 22, 16, 178, 206


class Vehicle:
    """Flies a plan with wind and tilt, at the plan's speed. It reports its position five times a second, and the body
    needs 0.7 s a photograph. `stations` are its frames."""

    def __init__(self, rng: np.random.Generator, first: int) -> None:
        self.rng, self._first = rng, first
        self.clock = RecordedClock(10**18, 10**18 - 10**9)
        self.sink = FakeSink()
        self.shutter = Shutter(self.sink, self.clock, next_index=0, capacity=1)
        self.trigger = DistanceTrigger(self.shutter, self, self.clock, mount=PoseSettings().mount)
        self.at, self.heading, self.speed, self.t_s = np.zeros(2), 0.0, 5.0, 0.0
        self.stations: list[Station] = []
        self._told: tuple[float, Pose] | None = None
        self._ready_s = 0.0

    def pose(self) -> Pose | None:
        if self._told is None:
            return None
        told_s, pose = self._told
        return replace(pose, age_ms=1e3 * (self.t_s - told_s))

    def height(self) -> Height | None:
        return Height(HEIGHT_M, "take-off")

    def field(self) -> tuple[float, float] | None:
        return None

    def busy(self) -> bool:
        return self.t_s < self._ready_s

    def fly(self, plan: dict[str, Any]) -> None:
        for item in plan["mission"]["items"]:
            if item["command"] == SPEED:
                self.speed = item["params"][1]
            elif item["command"] == DISTANCE:
                metres, _, at_once = item["params"][:3]
                if metres:
                    self.trigger.begin(Spacing(metres), "mission", at_once=at_once == 1)
                else:
                    self.trigger.end()
            elif item["command"] in (TAKEOFF, WAYPOINT):
                self.go(np.array(PROJECTION.to_map(*item["params"][4:6])) - np.array(HOME))

    def go(self, to: np.ndarray[Any, np.dtype[np.float64]]) -> None:
        while (left := np.linalg.norm(to - self.at)) > self.speed * STEP_S:
            way = (to - self.at) / left
            self.heading = math.atan2(way[0], way[1])
            self.at = self.at + way * self.speed * STEP_S
            self.t_s += STEP_S
            self.clock.advance(STEP_S)
            self._step()

    def _step(self) -> None:
        if self._told is None or self.t_s - self._told[0] >= 1 / POSITIONS_HZ:
            self._told = self.t_s, self._here(0).tag.pose
        before = len(self.sink.fired)
        self.trigger.serve()
        for index in self.sink.fired[before:]:
            self.stations.append(self._here(self._first + index))
            self._ready_s = self.t_s + BUSY_S
            self.shutter.settled(index, True)

    def _here(self, index: int) -> Station:
        east, north = self.at + self.rng.normal(0, 0.3, 2)
        tilt = {"pitch": -0.06 + self.rng.normal(0, 0.03), "roll": self.rng.normal(0, 0.03)}
        return frame(index, float(east), float(north), heading=self.heading, speed=self.speed, **tilt)


@pytest.mark.parametrize("seed", [0, *(pytest.param(seed, marks=pytest.mark.slow) for seed in (1, 2))])
def test_a_mission_flown_with_the_camera_s_own_trigger_closes_every_hole(seed: int) -> None:
    rng = np.random.default_rng(seed)
    area, frames = square(80), survey(rng, 80, lost=0.4)
    survived = seen(frames)
    before = coverage.cover(survived, grid(), area)
    assert before.holes().sum() * before.cell_m2 > 500
    made = refly.plan(survived, before)
    assert made is not None
    vehicle = Vehicle(rng, 1000)
    vehicle.fly(json.loads(json.dumps(refly.qgc_plan(made))))
    assert vehicle.shutter.statistics().refused == 0
    again = vehicle.stations
    assert coverage.cover(seen([*frames, *again]), grid(), area).holes().sum() == 0
    too_few = seen([*frames, *again[::8]])  # and the yardstick can fail
    assert coverage.cover(too_few, grid(), area).holes().sum() > 0


def test_a_body_that_is_too_slow_for_the_mission_is_told() -> None:
    rng = np.random.default_rng(0)
    survived = seen(survey(rng, 80, lost=0.4))
    made = refly.plan(survived, coverage.cover(survived, grid(), square(80)))
    assert made is not None
    vehicle = Vehicle(rng, 1000)
    problems = set()
    plan = refly.qgc_plan(replace(made, speed_m_s=30.0))
    serve = vehicle.trigger.serve

    def told() -> float:
        wait_s = serve()
        found = vehicle.trigger.statistics()
        problems.add(None if found is None or found.trouble is None else str(findings.told(found.trouble)))
        return wait_s

    vehicle.trigger.serve = told  # type: ignore[method-assign]
    vehicle.fly(plan)
    assert any("fly slower" in problem for problem in problems if problem)


@pytest.mark.slow
def test_after_a_battery_change_the_mission_is_the_rest_of_the_plan_by_what_was_really_taken() -> None:
    rng = np.random.default_rng(5)
    area, planned = square(80), survey(rng, 80, lost=0.0)
    first = planned[: len(planned) // 2]  # then the battery was empty; two of them came to nothing
    taken = [one for number, one in enumerate(first) if number not in (10, 11)]
    survived = seen(taken)
    before = coverage.cover(survived, grid(), area)
    rest = refly.plan(survived, before)
    assert rest is not None
    whole = refly.plan(seen(taken[:1]), coverage.cover(seen(taken[:1]), grid(), area))
    assert whole is not None
    assert length_m(rest) < 0.75 * length_m(whole), "what was taken is not flown again"
    vehicle = Vehicle(rng, 1000)
    vehicle.fly(json.loads(json.dumps(refly.qgc_plan(rest))))
    assert coverage.cover(seen([*taken, *vehicle.stations]), grid(), area).holes().sum() == 0


def length_m(mission: refly.Refly) -> float:
    """Of all lines."""
    ends = [[np.array(PROJECTION.to_map(*at)) for at in (one.begin, one.end)] for one in mission.lines]
    return float(sum(np.linalg.norm(end - begin) for begin, end in ends))
