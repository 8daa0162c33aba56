"""`dappled run`: run the daemon with real hardware, or with everything around it simulated."""

from __future__ import annotations

import faulthandler
import gc
import signal
import sys
import tempfile
import threading
import time
from collections.abc import Callable
from contextlib import ExitStack, suppress
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import TYPE_CHECKING

from dappled import durable
from dappled.cli.table import words_only
from dappled.cli.verb import Output, Report, SettingsArgument, Verb, flag, option
from dappled.clock import SystemClock
from dappled.config import settings as configuration
from dappled.config.schema import ConfigError, refuse
from dappled.config.settings import Settings
from dappled.daemon.health.systemd import Notifier
from dappled.errors import DappledError, sentence
from dappled.key_files import KeyFileError

if not words_only:
    import numpy  # noqa: F401  # first: from deep in the imports below it takes 1 500 page faults more

    from dappled.cli.stop_condition import StopCondition
    from dappled.cli.terminal import CameraRemarks, FrameLines, ProblemRemarks, RunObserver, Tally, remark
    from dappled.daemon import after_ready, settings_check
    from dappled.daemon.flight_handover import FlightHandover, flights
    from dappled.daemon.grounded import answer_meanwhile
    from dappled.daemon.health.patience import Patience
    from dappled.daemon.service import Service
    from dappled.drivers.mavlink import SigningError
    from dappled.flight import FlightError
    from dappled.flight.layout import LockHeldError

if TYPE_CHECKING:
    from dappled.mocks.simulation import Simulation


_ALL, _CAMERA = "all", "camera"
_LOOK_NS = 5 * 10**9
_SWITCH_S = 0.0005  # a thread that computes gives Python to one that acknowledges; by itself after 5 ms, at each call


@dataclass(frozen=True, kw_only=True)
class RunDaemon(SettingsArgument, Verb):
    """Run the daemon."""

    examples = (
        "dappled run --config dappled.toml",
        "dappled run --simulate --frames 8",
        "dappled run --simulate camera --config sitl.toml",
    )

    simulate: str | None = option(
        "--simulate", "use a simulated camera and autopilot (all, without another word), no hardware; camera: not "
        "the autopilot, which mavlink.url leads to", None, const=_ALL, choices=(_ALL, _CAMERA),
    )  # fmt: skip
    seed: int = option("--seed", "seed of the simulation", 1)
    seconds: float | None = option("--for", "end after this time", None, metavar="SECONDS", low=0)
    frames: int | None = option(
        "--frames", "end after N frames; with --simulate, a ground station asks for them", None, low=1,
    )  # fmt: skip
    console: str | None = option(
        "--console", "serve the operator's console here; overrides console.bind", None, metavar="HOST:PORT",
    )  # fmt: skip
    json: bool = flag("--json", "print one JSON object per frame")

    def run(self, output: Output) -> Report:
        before = signal.signal(signal.SIGTERM, signal.default_int_handler)  # until a daemon can end in order
        hung_up = signal.signal(signal.SIGHUP, signal.SIG_IGN)
        try:
            return Report(failed=self._run() != 0)
        finally:
            signal.signal(signal.SIGTERM, before)
            signal.signal(signal.SIGHUP, hung_up)

    def _run(self) -> int:
        file = configuration.examine_file(self.config)
        settings = file.settings
        plan = RunPlan(self.frames, self.seconds, self.config, self.json)
        if self.console:
            settings = replace(settings, console=replace(settings.console, bind=self.console))
        if not self.simulate:
            return serve(settings_check.checked(replace(file, settings=settings), starting=True), plan, None)
        refuse(file.findings)
        if self.simulate == _CAMERA and not settings.mavlink.url:
            raise ConfigError(
                "--simulate camera leaves the autopilot out, and no link leads to another one: "
                'set [mavlink] url in --config FILE, such as "udpin:127.0.0.1:14550"'
            )
        from dappled.mocks.simulation import Simulation, World  # noqa: PLC0415  # a real flight doesn't load the mocks

        if self.config is None:
            settings = replace(
                settings, record=replace(settings.record, directory=str(configuration.SIMULATED_FLIGHTS.absolute()))
            )
        with tempfile.TemporaryDirectory(prefix="dappled-") as folder:
            world = World(seed=self.seed, autopilot=self.simulate == _ALL, real=True, overlapping=True)
            simulation = Simulation(world, settings, Path(folder))
            remark(f"simulating {simulation.rig}{', an autopilot' if world.autopilot else ''} and a ground station")
            with simulation as simulated:
                checked = settings_check.checked(replace(file, settings=simulated), starting=True)
                return serve(checked, plan, simulation)


@dataclass(frozen=True, slots=True)
class RunPlan:
    """When a run ends, the settings file that it was started with, and how it prints frames."""

    frames: int | None = None
    seconds: float | None = None
    config: Path | None = None
    as_json: bool = False


def serve(settings: Settings, plan: RunPlan, simulation: Simulation | None) -> int:
    """Run the daemon, flight after flight, until a signal, --frames or --for ends it."""
    manager, camera, tally = Notifier(), CameraRemarks(), Tally()
    frames = FrameLines(as_json=plan.as_json)
    asked, hung_up = threading.Event(), threading.Event()
    ask = None if simulation is None else lambda frames: simulation.ground_station(frames).running
    goal = StopCondition(tally, plan.frames, plan.seconds, camera=camera, ask=ask, clock=SystemClock())

    def fly(flown: Settings, after: FlightHandover) -> bool:
        """Run one flight. Returns whether another may follow."""
        service = _begun(
            lambda: Service(flown, observer=RunObserver(tally, frames, camera), after=after), flown, manager, asked
        )
        if service is None:
            return False
        problems = ProblemRemarks(service, manager.status)

        def turn() -> bool:
            """Do what is due after each turn of the working loop. Returns whether to end."""
            if hung_up.is_set():
                hung_up.clear()
                _reload(service, plan, manager)
            if service.healthy():
                manager.working(time.monotonic_ns())
            problems.look()
            return asked.is_set() or goal.reached()

        with ExitStack() as stack:
            stack.callback(service.stop)
            stack.callback(lambda: None if after.next and not asked.is_set() else manager.stopping())
            after.began = True
            manager.ready(time.monotonic_ns())
            after_ready.begin()
            remark(f"flight {service.folder}")
            remark(f"stream {flown.publish.slices}")
            if service.console_url:
                remark(f"console {service.console_url}")
            goal.begin(service)
            service.run(turn)
            problems.look(now=True)
            manager.working(time.monotonic_ns(), now=True)  # closing one flight and opening the next takes a while
        return not asked.is_set()

    with ExitStack() as stack:
        # Python looks at all objects now and then, for cycles: 60 ms in which no command is answered. What is loaded by
        # now stays, and is left out: 7 ms.
        gc.freeze()
        stack.callback(gc.unfreeze)
        if manager.listens:
            faulthandler.enable()  # what the watchdog kills (SIGABRT) tells the journal where each thread stood
            stack.callback(faulthandler.disable)
        if manager.watchdog_ns:
            patience = Patience(manager)
            stack.callback(patience.stop)
            patience.start()
        stack.callback(sys.setswitchinterval, sys.getswitchinterval())
        sys.setswitchinterval(_SWITCH_S)
        stack.callback(signal.signal, signal.SIGHUP, signal.signal(signal.SIGHUP, lambda *_: hung_up.set()))
        for number in (
            signal.SIGINT,
            signal.SIGTERM,
        ):  # until everything is closed: a second ^C must not interrupt that
            stack.callback(signal.signal, number, signal.signal(number, lambda *_: asked.set()))
        stack.callback(frames.close)
        flights(settings, fly)
    remark(tally.summary())
    return 1 if goal.short and not asked.is_set() else 0  # a signal is a regular end


def _begun(make: Callable[[], Service], flown: Settings, manager: Notifier, asked: threading.Event) -> Service | None:
    """Begin a flight. A service whose flights can't be recorded says so on its links until they can, or until it is
    stopped (None): ending would be silence, and restarts would not mend a disk. Raises DappledError."""
    said = ""
    while not asked.is_set():
        service = make()
        try:
            service.start()
        except (FlightError, SigningError, KeyFileError) as error:  # signing times are kept beside the flights
            answered = isinstance(error, LockHeldError) and error.records  # by the daemon that records there
            if answered or not manager.listens or not flown.mavlink.url:
                raise
            reason = sentence(error)
            if reason != said:
                remark(f"no photographs: {reason}")
            said = reason
            manager.ready(time.monotonic_ns())
            manager.status(f"no photographs: {reason}")
            answer_meanwhile(flown, reason, _FlightsDisk(Path(flown.record.directory), manager, asked).may_do)
        else:
            return service
    return None


@dataclass(slots=True)
class _FlightsDisk:
    """Where flights can't be recorded now; looked at every few seconds."""

    directory: Path
    manager: Notifier
    asked: threading.Event
    due_ns: int = field(default_factory=lambda: time.monotonic_ns() + _LOOK_NS)

    def may_do(self) -> bool:
        """Whether a flight may begin there by now, or the daemon is to end. Feeds the watchdog."""
        now_ns = time.monotonic_ns()
        self.manager.working(now_ns)
        if now_ns < self.due_ns or self.asked.is_set():
            return self.asked.is_set()
        self.due_ns = now_ns + _LOOK_NS
        with suppress(OSError):
            durable.make_folder(self.directory)
            with tempfile.TemporaryFile(dir=self.directory):
                return True
        return False


def _reload(service: Service, plan: RunPlan, manager: Notifier) -> None:
    """Answer SIGHUP: read the settings again, apply what can change in flight, and say what can't."""
    manager.reloading(time.monotonic_ns())
    try:
        changes = service.reload(configuration.load(plan.config)) if plan.config else ["there is no --config"]
    except DappledError as error:
        changes = [f"the settings stay as they are: {error}"]
    for text in changes or ["nothing has changed"]:
        remark(f"reload: {text}")
    manager.ready(time.monotonic_ns())
