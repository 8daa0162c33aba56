"""A whole flight in one process and in virtual time: the daemon, its links, its camera, an autopilot and a ground
station. The seed decides what goes wrong, and which of several threads that can go on does so first."""

from __future__ import annotations

import random
import threading
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager, nullcontext
from dataclasses import dataclass, field
from functools import partial
from pathlib import Path
from typing import Any
from unittest.mock import patch

import numpy as np

from dappled.config import settings as configuration
from dappled.config.schema import TomlSource
from dappled.config.settings import Settings
from dappled.daemon.camera_protocol.ground_client import GroundClient, Outcome
from dappled.daemon.service import Service, StandIns
from dappled.daemon.stream.publisher import Answer, PublisherStatistics
from dappled.drivers.camera import Arrival, Blob, Camera, Fired, Identity, PlainCamera, ShotFailed, StateChanged
from dappled.drivers.mavlink import MavlinkLinks, mavlink
from dappled.drivers.wired.composed import ComposedCamera, ComposedSettings
from dappled.drivers.wired.sources import FolderSource
from dappled.flight import layout
from dappled.flight.layout import DiskSpace
from dappled.mocks.autopilot.autopilot import RATES_HZ, BootTime
from dappled.mocks.autopilot.path import FlightPath
from dappled.mocks.scene import dng
from dappled.mocks.scene.dng import Exif
from dappled.workers import Loop, Worker
from tests.simulated.bad_link import LinkFaults
from tests.simulated.memory_links import MemoryNetwork
from tests.simulated.on_request import OnRequest
from tests.simulated.switching import switching
from tests.simulated.vehicle import Vehicle
from tests.simulated.virtual_clock import VirtualClock

AUTOPILOT, GROUND = 14550, 14551
EXPOSURE_NS = 10**6
_OTHERS_HZ = 10.0  # positions
_IDENTITY = Identity("dappled", "Virtual Camera", "SIM1", "memory")


def picture(number: int, utc_ns: int) -> bytes:
    """A raw file that no other number has."""
    exif = Exif("dappled", "Virtual Camera", "SIM1", 28.0, 8.0, EXPOSURE_NS / 1e9, 200, utc_ns)
    return dng.encode(np.full((32, 48), 256 + number, np.uint16), black=256, white=4095, exif=exif)


class MemoryCamera(PlainCamera):
    """A camera whose shutter opens 45 to 75 ms after its trigger, and whose files come within a second. One shot in
    `fails` fails, in place of its file."""

    def __init__(self, clock: VirtualClock, seed: int, fails: int = 50) -> None:
        super().__init__(clock)
        self._clock, self._fails = clock, fails
        self._random = random.Random(f"camera {seed}")  # noqa: S311  # a simulation
        self._wanted: list[int] = []
        self.exposed_ns: dict[int, int] = {}  # the middle of each exposure
        self._stopping = threading.Event()
        self._loop = Loop("camera", self._run, self._stopping, clock)

    @property
    def identity(self) -> Identity:
        return _IDENTITY

    def start(self) -> None:
        self._loop.start()

    def fire(self, shot: int) -> None:
        self._wanted.append(shot)

    def stop(self) -> None:
        self._loop.stop(2.0)

    def _run(self) -> None:
        self._say("ready")
        while self._clock.until(lambda: self._wanted or self._stopping.is_set(), 1e6) and not self._stopping.is_set():
            self._say("busy")
            self._expose(self._wanted.pop(0))
            self._say("ready")

    def _expose(self, shot: int) -> None:
        called_ns = self._clock.monotonic_ns()
        self._clock.sleep(self._random.uniform(0.045, 0.075))
        self.exposed_ns[shot] = self._clock.monotonic_ns() + EXPOSURE_NS // 2
        self.report(Fired(shot, called_ns, self._clock.monotonic_ns()))
        self._clock.sleep(self._random.uniform(0.3, 0.9))
        if not self._random.randrange(self._fails):
            self.report(ShotFailed(shot, "the mirror is stuck", self._clock.monotonic_ns()))
            return
        blob = Blob.of(picture(shot, self._clock.utc_ns()))
        self.report(Arrival(shot, f"VIR_{shot:04d}.DNG", blob, self._clock.monotonic_ns()))

    def _say(self, state: Any) -> None:
        self.report(StateChanged(state, "", self._clock.monotonic_ns(), _IDENTITY))


class MemoryLine:
    """A ShutterLine. Each press puts a file on the card within a second; one press in `fails` does not."""

    def __init__(self, clock: VirtualClock, seed: int, card: Path, fails: int = 50) -> None:
        self._clock, self._card, self._fails = clock, card, fails
        self._random = random.Random(f"line {seed}")  # noqa: S311  # a simulation
        self._exposures = Worker("exposure", self._expose, capacity=9, clock=clock)
        self._taken = 0

    def open(self) -> None:
        self._exposures.start()

    def press(self) -> None:
        self._taken += 1
        if self._random.randrange(self._fails):
            self._exposures.put(self._taken)

    def let_go(self) -> None:
        """Nothing is held."""

    def close(self) -> None:
        self._exposures.stop(2.0)

    def _expose(self, number: int) -> None:
        data = picture(number, self._clock.utc_ns())
        self._clock.sleep(self._random.uniform(0.3, 0.9))
        part = self._card / f".{number}"
        part.write_bytes(data)
        part.rename(self._card / f"VIR_{number:04d}.DNG")


class MemoryStream:
    """A Stream that keeps its topics."""

    def __init__(self) -> None:
        self.messages: list[tuple[str, Mapping[str, Any]]] = []

    def start(self, flight: str, answer: Answer) -> None:
        """Nobody asks."""

    def publish(self, topic: str, facts: Mapping[str, Any], body: Any = None) -> None:
        self.messages.append((topic, facts))

    def wanted(self, topic: str) -> bool:
        return False

    def statistics(self) -> PublisherStatistics:
        return PublisherStatistics({}, {}, 0, 0, 0)

    def dead_threads(self) -> list[str]:
        return []

    def stop(self) -> None:
        """Nothing waits."""


class VirtualAutopilot:
    """The simulated autopilot, its thread in the clock. Attitudes at `hz`, all else at most at 10 Hz."""

    def __init__(self, clock: VirtualClock, network: MemoryNetwork, plan: Plan) -> None:
        self._clock = clock
        url = f"udpout:127.0.0.1:{AUTOPILOT}"
        self._links = MavlinkLinks([url], system_id=1, component_id=1, clock=clock, transport=network)
        path, send = FlightPath(plan.seed), self._links.sender.send
        rates = dict.fromkeys(RATES_HZ, min(plan.hz, _OTHERS_HZ))
        rates[mavlink.MAVLINK_MSG_ID_ATTITUDE_QUATERNION] = plan.hz
        has = OnRequest(ground_m=plan.ground_m)
        self._flyer = Vehicle(path, clock.monotonic_ns(), plan.boot, send, clock, request=has, fastest_hz=rates)
        self._loop = Loop("autopilot", self._run, clock=clock)

    def start(self) -> None:
        self._links.start(self._flyer)
        self._loop.start()

    def stop(self) -> None:
        self._loop.stop(1.0)
        self._links.stop()

    def _run(self) -> None:
        while not self._loop.stopping.is_set():
            self._clock.wait(self._loop.stopping, self._flyer.step(self._clock.monotonic_ns()))


@dataclass
class VirtualFlight:
    """What came of a flight."""

    folder: Path
    outcomes: list[Outcome] = field(default_factory=list)
    sent: list[tuple[int, int, int, bytes]] = field(default_factory=list)
    stream: list[tuple[str, Mapping[str, Any]]] = field(default_factory=list)
    seconds: float = 0.0


@dataclass(frozen=True)
class Plan:
    """What is flown: `frames` requests, `interval_s` apart, with telemetry at `hz`. `by_files`: the camera is composed
    of a shutter line and a folder, in place of one that hands over its files itself. `ground_m`: it has a rangefinder,
    over ground so high above the take-off place. `switches`: threads change at locks and writes, too."""

    seed: int
    frames: int
    interval_s: float
    hz: float = 50.0
    faults: LinkFaults = field(default_factory=partial(LinkFaults, loss=0.02, doubles=0.01, late_s=0.03))
    cuts: tuple[tuple[float, float], ...] = ()
    boot: BootTime = field(default_factory=BootTime)
    by_files: bool = False
    ground_m: float | None = None
    switches: bool = False


def camera(plan: Plan, clock: VirtualClock, card: Path) -> Camera:
    if not plan.by_files:
        return MemoryCamera(clock, plan.seed)
    card.mkdir(parents=True)
    line = MemoryLine(clock, plan.seed, card)
    return ComposedCamera(_IDENTITY, line, FolderSource(card), ComposedSettings(file_s=10.0, hold_s=0.05), clock)


def settings(folder: Path, tables: Mapping[str, Mapping[str, Any]]) -> Settings:
    """Of a flight in this folder; the tables given come on top."""
    ours: dict[str, Mapping[str, Any]] = {
        "record": {"directory": str(folder), "min_free_mb": 0},
        "mavlink": {"url": [f"udpin:127.0.0.1:{port}" for port in (AUTOPILOT, GROUND)]},
        "console": {"bind": ""},
        "camera": {"latency_ms": 60.0, "latency_sigma_ms": 15.0 / 3**0.5},
        **tables,
    }
    return configuration.resolve(configuration.parse(ours, TomlSource("test")))


@contextmanager
def memory_disk(seed: int) -> Iterator[None]:
    """What the disk and chance would add to a record: free space, and the ends of the folders' names."""
    chance = random.Random(f"names {seed}")  # noqa: S311  # a simulation
    space = DiskSpace(10**11, 10**10, 9 * 10**10, 10**6)
    with (
        patch("secrets.token_hex", lambda size: chance.randbytes(size).hex()),
        patch.object(layout, "disk_space", lambda _: space),
    ):
        yield


@contextmanager
def started(part: Any) -> Iterator[None]:
    part.start()
    try:
        yield
    finally:
        part.stop()


@dataclass
class Airborne:
    """A flight that goes on: its daemon at work, its autopilot and its ground station connected."""

    clock: VirtualClock
    service: Service
    camera: Camera
    ground: GroundClient
    flown: VirtualFlight
    path: FlightPath
    began_ns: int


@contextmanager
def airborne(
    plan: Plan, folder: Path, watch: Callable[[bytes], object] | None = None, **tables: Mapping[str, Any]
) -> Iterator[Airborne]:
    """Fly, 5 s after the daemon's start until its end. `watch` is shown each datagram of the daemon before it is on its
    way; `tables` of the settings come on top."""
    with VirtualClock(plan.seed) as clock, memory_disk(plan.seed), switching(clock) if plan.switches else nullcontext():
        network, stream = MemoryNetwork(clock, plan.seed, plan.faults, plan.cuts), MemoryStream()
        if watch is not None:
            network.watch = lambda source, data: watch(data) if source in (AUTOPILOT, GROUND) else None
        body = camera(plan, clock, folder / "card")
        wanted = settings(folder / "flights", tables)
        service = Service(wanted, clock=clock, instead=StandIns(body, network, stream))
        autopilot = VirtualAutopilot(clock, network, plan)
        began_ns = clock.monotonic_ns()
        with started(service):
            flown = VirtualFlight(service.folder, sent=network.sent, stream=stream.messages)
            loop = Loop("daemon", service.run, clock=clock)
            loop.start()
            with started(autopilot):
                clock.sleep(5.0)
                with GroundClient(f"udpout:127.0.0.1:{GROUND}", clock=clock, transport=network) as ground:
                    yield Airborne(clock, service, body, ground, flown, FlightPath(plan.seed), began_ns)
            service.ask_to_stop()
            loop.stop(5.0)
        flown.seconds = (clock.monotonic_ns() - began_ns) / 1e9


def fly(plan: Plan, folder: Path, watch: Callable[[bytes], object] | None = None) -> VirtualFlight:
    """All of the plan's requests, each after the last one ended."""
    with airborne(plan, folder, watch) as now:
        now.ground.capture(plan.frames, plan.interval_s, on_outcome=now.flown.outcomes.append)
    return now.flown
