"""Fly a long simulated flight in which something goes wrong every few seconds, and check the recording afterwards.

The daemon runs in a process of its own as a service manager would run it (restarted when it dies), in front of the
simulated body, autopilot and ground station. At the end every request that was acknowledged is exactly one shot, every
shot is a frame or failed with a reason, each flight is intact, and the daemon's memory, open files and threads are
what they were.
"""

from __future__ import annotations

import random
import socket
import time
from collections import Counter
from collections.abc import Callable
from contextlib import ExitStack
from dataclasses import dataclass, field
from pathlib import Path

import tomli_w

from dappled.config import settings as configuration
from dappled.daemon.camera_protocol.ground_client import GroundClient
from dappled.drivers.mavlink import mavlink
from dappled.findings import text
from dappled.flight import flight_report
from dappled.flight.checks import flight_check
from dappled.mocks.simulation import World, free_port
from dappled.workers import Loop
from tests.soak.supervised import Resources, Supervised
from tests.soak.troubles import RebootingSimulation, Troubles

SETTLE_S = 8.0
START_S = 60.0


@dataclass(frozen=True, slots=True)
class SoakPlan:
    """How long a soak lasts, and how often it requests a frame and makes a fault. `scale`: of the simulated sensor."""

    seconds: float = 1800.0
    seed: int = 1
    interval_s: float = 1.0
    fault_every_s: float = 4.0
    scale: float = 0.5


@dataclass(frozen=True, slots=True)
class SoakReport:
    """The result. `problems` are sentences, none if all is well; requests are counted by the answers on the ground."""

    asked: int
    accepted: int
    refused: int
    unanswered: int
    shots: int
    safe: int
    failed: int
    flights: int
    lives: int
    faults: dict[str, int]
    before: Resources | None
    after: Resources | None
    problems: list[str] = field(default_factory=list)


def soak(plan: SoakPlan, folder: Path, tell: Callable[[str], None] = lambda _: None) -> SoakReport:
    """Fly the plan in `folder`, and compare the ground station's reports with the recording."""
    chance = random.Random(plan.seed)  # noqa: S311  # which fault comes when: no secret
    root = folder / "flights"
    settings = configuration.load(None)
    config = folder / "dappled.toml"
    answers: dict[int, int | None] = {}
    with ExitStack() as stack:
        simulation = RebootingSimulation(World(seed=plan.seed, scale=plan.scale), settings, folder)
        simulated = stack.enter_context(simulation)
        tables = configuration.to_tables(simulated)
        tables["record"]["directory"] = str(root)
        tables["publish"] |= {"slices": f"ipc://{folder}/s", "ask": f"ipc://{folder}/a"}
        tables["console"]["bind"] = f"127.0.0.1:{free_port(socket.SOCK_STREAM)}"
        config.write_text(tomli_w.dumps(tables), encoding="utf-8")
        daemon = stack.enter_context(Supervised(config, folder / "daemon.log"))
        ground = stack.enter_context(GroundClient(simulation.ground_url))
        ground.find_camera(START_S)
        troubles = stack.enter_context(Troubles(simulation, daemon, config, chance))
        requester = _Requester(ground, plan.interval_s, answers)
        stack.callback(requester.stop)
        requester.start()
        began = time.monotonic()
        end, next_fault = began + plan.seconds, began + SETTLE_S
        # The daemon dies in the first half only. Then it warms up (a minute of telemetry, the heap at its largest)
        # and is measured.
        last_life, warm = began + plan.seconds / 2, began + plan.seconds * 2 / 3
        before: Resources | None = None
        while time.monotonic() < end:
            time.sleep(0.1)
            daemon.keep_alive()
            if before is None and time.monotonic() > max(warm, last_life + SETTLE_S):
                troubles.clear()
                before = _calm(daemon, SETTLE_S)
            if time.monotonic() > next_fault:
                next_fault += plan.fault_every_s * chance.uniform(0.5, 1.5)
                tell(troubles.strike(daemon_may_die=time.monotonic() < last_life))
        troubles.clear()
        requester.stop()
        after = _calm(daemon, 2 * SETTLE_S)
        code = daemon.end()
    problems = [] if code == 0 else [f"the daemon ended with {code}: see {folder / 'daemon.log'}"]
    return _settle(root, answers, problems, resources=(before, after), lives=daemon.lives, faults=troubles.counts)


def _calm(daemon: Supervised, seconds: float) -> Resources:
    """The daemon's resources after some time without a fault."""
    until = time.monotonic() + seconds
    while time.monotonic() < until:
        time.sleep(0.1)
        daemon.keep_alive()
    return daemon.resources()


def _settle(
    root: Path,
    answers: dict[int, int | None],
    problems: list[str],
    *,
    resources: tuple[Resources | None, Resources | None],
    lives: int,
    faults: Counter[str],
) -> SoakReport:
    """Compare the answers on the ground with the recorded flights."""
    shots: Counter[int] = Counter()
    safe = failed = flights = 0
    for listed in flight_report.list_flights(root):
        flights += 1
        problems += [f"{listed.name}: {text(one)}" for one in flight_check.check(listed.path).problems]
        if listed.balance is None:
            problems.append(f"{listed.name}: {listed.problem and str(text(listed.problem))}")
            continue
        safe, failed = safe + listed.balance.safe, failed + listed.balance.failed
        if not listed.balance.balanced or listed.balance.open:
            problems.append(f"{listed.name}: the counts do not agree: {listed.balance}")
        for line in flight_report.show(listed.path).lines:
            shots[line.row.shot.cause.sequence or 0] += 1
            if line.row.state == "failed" and not line.row.reason:
                problems.append(f"{listed.name}: shot {line.row.shot.index} failed without a reason")
    results = Counter(answers.values())
    accepted = mavlink.MAV_RESULT_ACCEPTED
    problems += [
        f"request {n} was acknowledged but did not become a shot"
        for n, r in answers.items()
        if r == accepted and not shots[n]
    ]
    problems += [f"request {n} became {count} shots" for n, count in shots.items() if count > 1]
    problems += [f"a shot of request {n}, which was never sent" for n in shots if n not in answers]
    before, after = resources
    if before is not None and after is not None:
        problems += before.grown(after)
    return SoakReport(
        asked=len(answers),
        accepted=results[accepted],
        refused=len(answers) - results[accepted] - results[None],
        unanswered=results[None],
        shots=shots.total(),
        safe=safe,
        failed=failed,
        flights=flights,
        lives=lives,
        faults=dict(sorted(faults.items())),
        before=before,
        after=after,
        problems=problems,
    )


class _Requester:
    """Requests a photograph every `interval_s`, and keeps the answer: MAV_RESULT, or None."""

    def __init__(self, ground: GroundClient, interval_s: float, answers: dict[int, int | None]) -> None:
        self._ground, self._interval_s, self._answers = ground, interval_s, answers
        self._loop = Loop("requests", self._run)

    def start(self) -> None:
        self._loop.start()

    def stop(self) -> None:
        """Stop; the current request is finished first."""
        self._loop.stop(10.0)

    def _run(self) -> None:
        sequence = 0
        due = time.monotonic()
        while not self._loop.stopping.wait(max(0.0, due - time.monotonic())):
            due = max(due + self._interval_s, time.monotonic())
            sequence += 1
            self._answers[sequence] = None
            result, _ = self._ground.command(mavlink.MAV_CMD_IMAGE_START_CAPTURE, 0, 0, 1, sequence)
            self._answers[sequence] = result
