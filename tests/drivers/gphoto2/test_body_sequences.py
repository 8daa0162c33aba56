"""Random sequences as in `test_sequences`, with the real libgphoto2, its process and the simulated body over PTP/IP."""

from __future__ import annotations

import random
import re
import subprocess
import time
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, field

import pytest

from dappled.drivers.camera import Arrival, CameraEvent, Fired, Noticed, ShotFailed
from dappled.drivers.child_process import ProcessChannel
from dappled.drivers.gphoto2.client import GPhoto2Camera, spawn_process
from dappled.drivers.gphoto2.messages import Carryover
from dappled.drivers.gphoto2.settings import GPhoto2Settings, parse_settings
from dappled.findings import Code
from dappled.mocks.body.body import BodyOptions, SimulatedBody
from dappled.testing import content, until_state

_KINDS = {
    "shot": 8,
    "hand": 2,
    "hand at once": 1,
    "no-event": 1,
    "no-focus": 0.5,
    "drop": 1,
    "drop-transfer": 1,
    "change card": 1,
    "change card, no cut": 0.5,
    "restart": 0.7,
    "turn clock": 0.5,
}
_ALIKE_S = 3.5
_TIMEOUTS = {"complete_s": 1.0, "look_s": 2.0, "file_s": 5.0, "retry_s": 0.3}


@dataclass
class Made:
    """An exposure: its shot, None for one by hand; when; its name, and on which card."""

    shot: int | None
    at_s: float
    name: str
    card: int


@dataclass
class Flight:
    """A body, a driver, and what they did. `made` is by the number of the exposure, from 1."""

    body: SimulatedBody
    chance: random.Random
    processes: list[subprocess.Popen[bytes]] = field(default_factory=list)
    events: list[tuple[CameraEvent, bytes]] = field(default_factory=list)
    made: dict[int, Made] = field(default_factory=dict)
    shots: int = 0
    cards: int = 0
    numbered: int = 0
    lossy: set[int] = field(default_factory=set)  # cards with pictures that nobody may have seen before they went

    def __post_init__(self) -> None:
        settings = parse_settings({"port": self.body.port, "timeouts": _TIMEOUTS})
        self.camera = GPhoto2Camera(settings, spawn=self._spawn)
        self.camera.start()
        until_state(self.camera, "ready")

    def _spawn(self, settings: GPhoto2Settings, carry: Carryover) -> tuple[subprocess.Popen[bytes], ProcessChannel]:
        process, channel = spawn_process(settings, carry)
        self.processes.append(process)
        return process, channel

    def follow(self, seconds: float, until: tuple[int, type[Fired] | None] | None = None) -> None:
        """Hear events for so long, or until a shot was fired or has ended."""
        end_s = time.monotonic() + seconds
        while (left_s := end_s - time.monotonic()) > 0:
            event = self.camera.next_event(left_s)
            if event is None:
                continue
            self.hear(event)
            if until and isinstance(event, Arrival | ShotFailed | (until[1] or ShotFailed)) and event.shot == until[0]:
                return

    def hear(self, event: CameraEvent) -> None:
        self.events.append((event, content(event)[:12] if isinstance(event, Arrival) else b""))

    def note(self, shot: int | None) -> None:
        number = self.body.releases
        if number not in self.made and number:
            name = f"IMG_{number - self.numbered:04d}.DNG"
            self.made[number] = Made(shot, time.monotonic(), name, self.cards)

    def fire(self) -> None:
        self.shots += 1
        self.camera.fire(self.shots)
        self.follow(20.0, (self.shots, Fired))
        self.note(self.shots)

    def press(self) -> None:
        if self.body.contact():
            self.note(None)

    def do(self, kind: str) -> None:
        if kind in ("no-event", "no-focus", "hand at once", "drop", "drop-transfer", "restart"):
            self.lossy.add(self.cards)
        match kind:
            case "shot":
                self.fire()
            case "hand":
                self.press()
            case "hand at once":
                self.press()
                time.sleep(0.15)  # its event waits in the body
                self.fire()
            case "change card" | "change card, no cut":
                if self._open:
                    self.follow(8.0, (self.shots, None))
                self.cards, self.numbered = self.cards + 1, self.body.releases
                self.body.ask("change card")
                if kind == "change card":
                    self.body.fault("drop")
            case "restart":
                self.processes[-1].kill()
            case "turn clock":
                self.body.ask(f"turn clock {self.chance.choice((-3600, 3600, 40))}")
            case _:
                self.body.fault(kind)

    @property
    def _open(self) -> bool:
        return all(getattr(event, "shot", None) != self.shots or isinstance(event, Fired) for event, _ in self.events)

    def _missing(self) -> set[int]:
        """Exposures that have not arrived."""
        return set(self.made) - {int(found) for _, data in self.events for found in re.findall(rb"shot (\d+)", data)}

    def fired_s(self, shot: int | None) -> float:
        """When a shot was fired; or had failed, where the link broke in the trigger call."""
        of_shot = [one for one, _ in self.events if isinstance(one, Fired | ShotFailed) and one.shot == shot]
        first = of_shot[0]
        return (first.called_monotonic_ns if isinstance(first, Fired) else first.monotonic_ns) / 1e9

    def problems(self) -> list[str]:
        """Stop the camera, and say what went wrong."""
        if self._open and self.shots:
            self.follow(12.0, (self.shots, None))
        self.follow(1.0)
        for _ in range(20):  # by which a busy machine has brought them
            if not self._missing():
                break
            self.follow(1.0)
        self.camera.stop()
        while event := self.camera.next_event(0.0):
            self.hear(event)
        found, accounted = [], set[int]()
        noticed = [event.finding for event, _ in self.events if isinstance(event, Noticed)]
        doubted = {one.subject.which for one in noticed if one.subject.kind == "frame"}
        left = {str(one.subject.which).rpartition("/")[2] for one in noticed if one.code is Code.PICTURE_ON_CARD}
        for event, data in self.events:
            if not isinstance(event, Arrival):
                continue
            (number,) = map(int, re.findall(rb"shot (\d+)", data))
            accounted.add(number)
            made = self.made[number]
            if event.shot in (None, made.shot) or "doubt" in event.facts or event.shot in doubted:
                continue
            if abs(made.at_s - self.fired_s(event.shot)) > _ALIKE_S:
                found.append(f"the frame of shot {event.shot} is exposure {number}, of shot {made.shot}")
        if any(one.code is Code.CARD_NOT_LISTED for one in noticed):  # said of all that may be on it
            return found
        for number, made in self.made.items():
            gone = made.card in self.lossy if made.card < self.cards else made.name not in self.body.card
            if number not in accounted and made.name not in left and not gone:
                found.append(f"exposure {number} ({made.name} of shot {made.shot}) is unaccounted for")
        return found


def flown(seed: int, things: int = 7) -> str:
    """What went wrong in a sequence, with its seed; "" for nothing."""
    chance = random.Random(seed)  # noqa: S311  a simulation
    kinds = ["shot", "shot", *chance.choices(list(_KINDS), list(_KINDS.values()), k=things)]
    with SimulatedBody.start(BodyOptions(picture="pattern:70000:dng")) as body:
        flight = Flight(body, chance)
        try:
            for kind in kinds:
                flight.do(kind)
                flight.follow(chance.uniform(0.4, 1.6))
            found = flight.problems()
        finally:
            flight.camera.stop()
    return f"seed {seed}, {kinds}: {found}" if found else ""


def test_no_picture_goes_astray_in_a_random_sequence_with_a_body() -> None:
    assert flown(1, things=3) == ""


@pytest.mark.long
@pytest.mark.timeout(900)
def test_no_picture_goes_astray_in_40_random_sequences_with_bodies() -> None:
    with ThreadPoolExecutor(8) as pool:
        assert [found for found in pool.map(flown, range(2, 42)) if found] == []
