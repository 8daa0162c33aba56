"""`dappled run`: the daemon, with real hardware or with everything around it simulated."""

from __future__ import annotations

import argparse
import os
import signal
import sys
import tempfile
import threading
import time
from collections.abc import Callable
from contextlib import ExitStack
from dataclasses import replace
from pathlib import Path
from typing import Protocol

from dappled.cli import story
from dappled.cli.common import seconds, whole
from dappled.config import settings as configuration
from dappled.config.settings import Settings
from dappled.daemon import health
from dappled.daemon.notify import Notifier
from dappled.daemon.service import Service
from dappled.daemon.stages import Stage
from dappled.daemon.story import Story, Watchers
from dappled.daemon.succession import Succession, flights
from dappled.drivers.camera import StateChanged
from dappled.errors import DappledError


class Asker(Protocol):
    """A ground station that asks for frames."""

    def running(self) -> bool:
        """Whether it still asks, or waits for an answer."""


def configure(parser: argparse.ArgumentParser) -> None:
    parser.epilog = "examples:\n  dappled run --config dappled.toml\n  dappled run --simulate --frames 8"
    parser.add_argument("--config", type=Path, metavar="FILE", help="settings (default: every default)")
    parser.add_argument("--simulate", action="store_true", help="no hardware: simulated camera and autopilot")
    parser.add_argument("--seed", type=int, default=1, metavar="N", help="of the simulation (default 1)")
    parser.add_argument("--for", dest="seconds", type=seconds, metavar="SECONDS", help="end after this time")
    parser.add_argument("--frames", type=whole, metavar="N", help="end after N frames; a simulated ground station asks")
    parser.add_argument("--console", metavar="HOST:PORT", help="serve the operator's console here (as console.bind)")
    parser.add_argument("--json", action="store_true", help="one JSON object a frame")


def run(arguments: argparse.Namespace) -> int:
    before = signal.signal(signal.SIGTERM, signal.default_int_handler)  # until there is a daemon to end in order
    hung_up = signal.signal(signal.SIGHUP, signal.SIG_IGN)
    try:
        return _run(arguments)
    finally:
        signal.signal(signal.SIGTERM, before)
        signal.signal(signal.SIGHUP, hung_up)


def _run(arguments: argparse.Namespace) -> int:
    settings = configuration.load(arguments.config)
    if arguments.console:
        settings = replace(settings, console=replace(settings.console, bind=arguments.console))
    if not arguments.simulate:
        return _serve(settings, arguments, None)
    from dappled.mocks.simulation import Simulation, World  # noqa: PLC0415  # a real flight doesn't load the mocks

    if arguments.config is None:
        here = Path("flights").absolute()
        settings = replace(settings, record=replace(settings.record, directory=str(here)))
    with tempfile.TemporaryDirectory(prefix="dappled-") as folder:
        simulation = Simulation(World(seed=arguments.seed), settings, Path(folder))
        print("simulating a masked camera, an autopilot and a ground station", file=sys.stderr)
        with simulation as simulated:
            ask = (lambda: simulation.ground_station(arguments.frames)) if arguments.frames else None
            return _serve(simulated, arguments, ask)


def _serve(settings: Settings, arguments: argparse.Namespace, ask: Callable[[], Asker] | None) -> int:
    """Run the daemon, flight after flight, until it is told to end, or has had its frames or its time."""
    told, manager = _Told(arguments.json), Notifier()
    asked, hung_up = threading.Event(), threading.Event()
    goal = _Goal(told, arguments.frames, arguments.seconds, ask)

    def fly(flown: Settings, after: Succession) -> bool:
        """One flight; whether another may follow."""
        service = Service(flown, watchers=Watchers(finished=told.finished, camera=told.camera), after=after)
        problems = _Problems(service, manager)

        def turn() -> bool:
            """After each turn of the working loop: whether to end."""
            if hung_up.is_set():
                hung_up.clear()
                _reload(service, arguments, manager)
            if service.whole():
                manager.working(time.monotonic_ns())
            problems.tell()
            return asked.is_set() or goal.reached()

        with ExitStack() as stack:
            service.start()
            stack.callback(service.stop)
            stack.callback(lambda: None if after.next and not asked.is_set() else manager.stopping())
            after.began = True
            manager.ready(time.monotonic_ns())
            print(f"flight {service.folder}", file=sys.stderr)
            print(f"stream {flown.publish.slices}", file=sys.stderr)
            if service.console_url:
                print(f"console {service.console_url}", file=sys.stderr)
            goal.begin(service)
            service.run(turn)
            problems.tell(now=True)
            manager.working(time.monotonic_ns(), now=True)  # closing one flight and opening the next takes a while
        return not asked.is_set()

    with ExitStack() as stack:
        stack.callback(signal.signal, signal.SIGHUP, signal.signal(signal.SIGHUP, lambda *_: hung_up.set()))
        for number in (signal.SIGINT, signal.SIGTERM):  # until all is closed: a second ^C must not cut that short
            stack.callback(signal.signal, number, signal.signal(number, lambda *_: asked.set()))
        stack.callback(told.close)
        flights(settings, fly)
    print(told.summary(), file=sys.stderr)
    short = bool(arguments.frames) and told.good < arguments.frames
    return 1 if short and not asked.is_set() else 0  # who ends it by a signal has had enough


class _Goal:
    """When the daemon has had its frames or its time. The ground station asks once the camera is ready."""

    def __init__(self, told: _Told, frames: int | None, seconds: float | None, ask: Callable[[], Asker] | None) -> None:
        self._told, self._frames, self._seconds, self._ask = told, frames, seconds, ask
        self._until: float | None = None
        self._asker: Asker | None = None
        self._wished: Callable[[], int] = lambda: 0

    def begin(self, service: Service) -> None:
        """A flight has begun: its shots come on top of those of the ones before, which have all ended."""
        if self._until is None and self._seconds is not None:
            self._until = time.monotonic() + self._seconds
        earlier = self._told.count
        self._wished = lambda: earlier + service.wished

    def reached(self) -> bool:
        if self._until is not None and time.monotonic() >= self._until:
            return True
        if self._frames is None:
            return False
        if self._ask is not None and self._asker is None and self._told.camera_state == "ready":
            self._asker = self._ask()
        if self._told.count >= self._frames:
            return True
        return self._asker is not None and not self._asker.running() and self._told.count >= self._wished()


class _Told:
    """Prints a line a frame, and what becomes of the camera; counts. A terminal that stands still holds up nobody."""

    def __init__(self, as_json: bool) -> None:
        self.count = self.safe = self.decoded = self.good = 0
        self.camera_state = "starting"
        self._as_json = as_json
        self._lock = threading.Lock()
        self._lines: Stage[str] = Stage("print", _print, capacity=1000, policy="drop oldest")
        self._lines.start()

    def finished(self, one: Story) -> None:
        with self._lock:
            self.count += 1
            self.safe += one.frame is not None
            self.decoded += one.developed is not None
            self.good += not one.problem
        self._lines.put(story.as_json(one) if self._as_json else story.line(one))

    def close(self) -> None:
        """Print what waits, for a second at most."""
        self._lines.stop(1.0)

    def camera(self, change: StateChanged) -> None:
        if change.state in ("busy", self.camera_state):
            return
        self.camera_state = change.state
        reason = f": {change.reason}" if change.reason else ""
        print(f"camera {change.state}{reason}", file=sys.stderr)

    def summary(self) -> str:
        bad = self.count - self.good
        return f"{self.count} shots: {self.safe} frames safe, {self.decoded} decoded, {bad} with a problem"


def _print(line: str) -> None:
    try:
        print(line, flush=True)
    except OSError:  # nobody reads any more; the record is what counts
        sys.stdout = open(os.devnull, "w", encoding="utf-8")  # noqa: SIM115  # for as long as we live


class _Problems:
    """Says each problem once, when it comes up; the service manager's status line has all of them."""

    def __init__(self, service: Service, manager: Notifier) -> None:
        self._service, self._manager = service, manager
        self._said: set[str] = set()
        self._due = time.monotonic() + 1.0

    def tell(self, *, now: bool = False) -> None:
        if now or time.monotonic() >= self._due:
            self._due = time.monotonic() + 1.0
            told = self._service.health()
            problems = set(told["problems"])
            for text in sorted(problems - self._said):
                print(f"problem: {text}", file=sys.stderr)
            self._said = problems
            self._manager.status(health.line(told))


def _reload(service: Service, arguments: argparse.Namespace, manager: Notifier) -> None:
    """SIGHUP: read the settings again, take what can change in flight, refuse the rest in words."""
    manager.reloading(time.monotonic_ns())
    try:
        told = service.reload(configuration.load(arguments.config)) if arguments.config else ["there is no --config"]
    except DappledError as error:
        told = [f"the settings stay as they are: {error}"]
    for text in told or ["nothing has changed"]:
        print(f"reload: {text}", file=sys.stderr)
    manager.ready(time.monotonic_ns())
