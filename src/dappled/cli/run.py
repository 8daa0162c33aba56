"""`dappled run`: the daemon, with real hardware or with everything around it simulated."""

from __future__ import annotations

import argparse
import signal
import sys
import tempfile
import threading
import time
from collections.abc import Callable
from contextlib import ExitStack
from dataclasses import replace
from pathlib import Path
from types import FrameType

from dappled.cli import story
from dappled.config import settings as configuration
from dappled.config.settings import Settings
from dappled.daemon.service import Service
from dappled.daemon.street import Story, Watchers


def configure(parser: argparse.ArgumentParser) -> None:
    parser.epilog = "examples:\n  dappled run --config dappled.toml\n  dappled run --simulate --frames 8"
    parser.add_argument("--config", type=Path, metavar="FILE", help="settings (default: every default)")
    parser.add_argument("--simulate", action="store_true", help="no hardware: simulated camera and autopilot")
    parser.add_argument("--seed", type=int, default=1, metavar="N", help="of the simulation (default 1)")
    parser.add_argument("--for", dest="seconds", type=float, metavar="SECONDS", help="end after this time")
    parser.add_argument("--frames", type=int, metavar="N", help="end after N frames; a simulated ground station asks")
    parser.add_argument("--json", action="store_true", help="one JSON object a frame")


def run(arguments: argparse.Namespace) -> int:
    settings = configuration.load(arguments.config)
    if not arguments.simulate:
        return _serve(settings, arguments, lambda: None)
    from dappled.mocks.simulation import Simulation, World  # noqa: PLC0415  # a real flight doesn't load the mocks

    if arguments.config is None:
        here = Path("flights").absolute()
        settings = replace(settings, record=replace(settings.record, directory=str(here)))
    with tempfile.TemporaryDirectory(prefix="dappled-") as folder:
        simulation = Simulation(World(seed=arguments.seed), settings, Path(folder))
        print("simulating a masked camera, an autopilot and a ground station", file=sys.stderr)
        with simulation as simulated:
            ask = (lambda: simulation.ground_station(arguments.frames)) if arguments.frames else (lambda: None)
            return _serve(simulated, arguments, ask)


def _serve(settings: Settings, arguments: argparse.Namespace, ask: Callable[[], object]) -> int:
    """Run the daemon until it is told to end, or has had its frames or its time."""
    told = _Told(arguments.json)
    service = Service(settings, watchers=Watchers(finished=told.finished))
    with ExitStack() as stack:
        service.start()
        stack.callback(service.stop)
        for number in (signal.SIGINT, signal.SIGTERM):
            stack.callback(signal.signal, number, signal.signal(number, _stopper(service)))
        print(f"flight {service.folder}", file=sys.stderr)
        print(f"stream {settings.publish.slices}", file=sys.stderr)
        problems = _Problems(service)
        until = time.monotonic() + (arguments.seconds or 1e12)
        ask()
        service.run(
            lambda: (
                problems.tell()
                or time.monotonic() >= until
                or bool(arguments.frames and told.count >= arguments.frames)
            )
        )
    bad = told.failed
    print(f"{told.count} shots: {told.count - bad} frames safe and decoded, {bad} with a problem", file=sys.stderr)
    short = bool(arguments.frames) and told.count - bad < arguments.frames
    return 1 if short else 0


class _Told:
    """Prints a line a frame, and counts."""

    def __init__(self, as_json: bool) -> None:
        self.count = self.failed = 0
        self._as_json = as_json
        self._lock = threading.Lock()

    def finished(self, one: Story) -> None:
        with self._lock:
            self.count += 1
            self.failed += bool(one.problem)
            print(story.as_json(one) if self._as_json else story.line(one), flush=True)


class _Problems:
    """Says each problem once, when it comes up."""

    def __init__(self, service: Service) -> None:
        self._service = service
        self._said: set[str] = set()
        self._due = time.monotonic() + 5.0

    def tell(self) -> bool:
        if time.monotonic() >= self._due:
            self._due = time.monotonic() + 1.0
            problems = set(self._service.health()["problems"])
            for text in sorted(problems - self._said):
                print(f"problem: {text}", file=sys.stderr)
            self._said = problems
        return False


def _stopper(service: Service) -> Callable[[int, FrameType | None], None]:
    def stop(_number: int, _frame: FrameType | None) -> None:
        service.ask_to_stop()

    return stop
