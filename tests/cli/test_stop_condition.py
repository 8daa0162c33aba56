"""When a daemon has had its frames or its time."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field

import pytest

from dappled.cli.stop_condition import StopCondition
from dappled.cli.terminal import CameraRemarks, Tally
from dappled.clock import RecordedClock
from dappled.daemon.pipeline.capture import PendingShot
from dappled.flight import Frame
from tests.flight.makers import shot
from tests.standing import failure


def ended(index: int, problem: str = "") -> PendingShot:
    frame = None if problem else Frame(index, f"frames/{index:06d}.cr2", "IMG_0001.CR2", 10, "0" * 64, 5)
    return PendingShot(shot(index), frame=frame, problem=failure(problem) if problem else None)


@dataclass
class Asker:
    busy: bool = True

    def running(self) -> bool:
        return self.busy


@dataclass
class Flight:
    requested: int


@dataclass
class World:
    """Everything that a condition looks at, turned by hand."""

    tally: Tally = field(default_factory=Tally)
    asker: Asker = field(default_factory=Asker)
    asked: int = 0
    asks: bool = False
    camera: CameraRemarks = field(default_factory=CameraRemarks)
    clock: RecordedClock = field(default_factory=lambda: RecordedClock(10**11))

    def ground_station(self, frames: int) -> Callable[[], bool]:
        self.asked += frames
        return self.asker.running

    def condition(self, frames: int | None = None, seconds: float | None = None) -> StopCondition:
        ask = self.ground_station if self.asks else None
        return StopCondition(self.tally, frames, seconds, camera=self.camera, ask=ask, clock=self.clock)


def test_without_a_goal_it_never_ends() -> None:
    world = World()
    condition = world.condition()
    condition.begin(Flight(0))
    for index in range(5):
        world.tally.add(ended(index))
    world.clock.advance(1e6)
    assert not condition.reached()
    assert not condition.short


def test_the_time_counts_from_the_first_flight() -> None:
    world = World()
    condition = world.condition(seconds=60.0)
    world.clock.advance(1000)
    assert not condition.reached()
    condition.begin(Flight(0))
    world.clock.advance(59)
    condition.begin(Flight(0))  # another flight has begun meanwhile
    assert not condition.reached()
    world.clock.advance(1)
    assert condition.reached()


def test_so_many_shots_whatever_came_of_them() -> None:
    world = World()
    condition = world.condition(frames=3)
    condition.begin(Flight(3))
    world.tally.add(ended(0))
    world.tally.add(ended(1, "the card is full"))
    assert not condition.reached()
    world.tally.add(ended(2))
    assert condition.reached()
    assert condition.short
    assert world.tally.summary() == "3 shots: 2 frames safe, 0 decoded, 1 with a problem"


def test_the_ground_station_asks_once_and_only_a_ready_camera() -> None:
    world = World(asks=True)
    condition = world.condition(frames=2)
    condition.begin(Flight(0))
    assert not condition.reached()
    assert world.asked == 0
    world.camera.state = "ready"
    assert not condition.reached()
    world.camera.state = "busy"
    assert not condition.reached()
    world.camera.state = "ready"
    assert not condition.reached()
    assert world.asked == 2, "once, for both frames"


@pytest.mark.parametrize("earlier", [0, 2])
def test_a_ground_station_that_gave_up_ends_it_when_all_it_wished_has_ended(earlier: int) -> None:
    """Requests that failed were refused, say; those of flights before have ended and count no more."""
    world = World(asks=True)
    world.camera.state = "ready"
    condition = world.condition(frames=8)
    for index in range(earlier):
        world.tally.add(ended(index))
    condition.begin(Flight(2))
    assert not condition.reached()
    world.asker.busy = False
    world.tally.add(ended(earlier))
    assert not condition.reached()
    world.tally.add(ended(earlier + 1))
    assert condition.reached()
    assert condition.short
