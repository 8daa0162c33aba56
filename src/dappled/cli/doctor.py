"""`dappled doctor`: say what is missing on this machine, fire a test shot, measure latency, judge go or no-go."""

from __future__ import annotations

import json
import statistics
import tempfile
import time
from collections.abc import Collection, Iterable, Iterator, Mapping, Sequence
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

from dappled import codec
from dappled.cli import status
from dappled.cli.status import is_listening, stream_endpoint
from dappled.cli.table import words_only
from dappled.cli.verb import Output, Report, SettingsArgument, Verb, flag, option
from dappled.config import settings as configuration
from dappled.config.schema import read_toml
from dappled.config.settings import Settings
from dappled.daemon.health import go_no_go
from dappled.errors import DappledError, counted
from dappled.findings import Code, Finding, Level, Subject, finding, remedy, text

if not words_only:
    from dappled.daemon import settings_check, test_shot
    from dappled.daemon.health import frame_checks, host_checks
    from dappled.daemon.health.standing import in_record
    from dappled.daemon.pipeline import recipes
    from dappled.daemon.test_shot import Latency
    from dappled.drivers import usb_bus

_WORDS = {Level.NOTE: "go", Level.CAUTION: "caution", Level.STOP: "NO GO"}
_SETTINGS = Subject("settings")
_VERDICTS = {"go": "GO", "caution": "GO, with the cautions above", "no-go": "NO GO"}
HEAR_S = 5.0  # a daemon publishes its health every second


@dataclass(frozen=True, kw_only=True)
class ExamineMachine(SettingsArgument, Verb):
    """Say what is missing on this machine."""

    examples = (
        "dappled doctor",
        "dappled doctor --config dappled.toml --test-shot",
        "dappled doctor --simulate --latency 10",
    )
    notes = "exits 1 if something prevents a flight"

    simulate: bool = flag("--simulate", "use a simulated camera and autopilot")
    seed: int = option("--seed", "seed of the simulation", 1)
    test_shot: bool = flag("--test-shot", "fire one frame and say go or no-go")
    latency: int | None = option(
        "--latency", "measure the latency of N shots, of 10 without a number", None, const=10, low=1,
    )  # fmt: skip
    keep: Path | None = option("--keep", "keep the test flight here", None, metavar="DIR")
    watch: bool = flag("--watch", "print which cameras appear and disappear on USB, until Ctrl-C")

    def run(self, output: Output) -> Report:
        return _watch(output) if self.watch else _examined(self, output)


def _examined(arguments: ExamineMachine, output: Output) -> Report:
    settings = settings_check.checked(configuration.examine_file(arguments.config), by_this_user=False)
    if not arguments.simulate and is_listening(endpoint := stream_endpoint(arguments.config)):
        return _beside(endpoint, settings, arguments)
    with tempfile.TemporaryDirectory(prefix="dpl-") as place, ExitStack() as stack:
        folder = Path(place)
        truth = None
        if arguments.simulate:
            settings, truth = stack.enter_context(_simulated(settings, arguments.seed, folder))
        checked = host_checks.run(settings)
        report: dict[str, Any] = {"checks": codec.plain(checked)}
        ready = all(one.level < Level.STOP for one in checked if one.subject.kind in ("camera", "disk"))
        good = not host_checks.next_step(checked)
        lines = [*_lines(checked)]
        if (arguments.test_shot or arguments.latency) and ready:
            more, shot = _shoot(settings, arguments, folder, truth, output)
            lines, report, good = [*lines, *more], {**report, **shot}, good and shot["verdict"] != "no-go"
        elif arguments.test_shot or arguments.latency:
            lines.append("no shot was fired: the camera or the disk is not ready")
    lines.append(_last(checked, report.get("verdict")))
    report["next"] = host_checks.next_step(checked)
    return Report(report, lines, failed=not good)


def _beside(endpoint: str, settings: Settings, arguments: ExamineMachine) -> Report:
    """Judge go or no-go by the health record of the daemon that runs here, as the console does."""
    if arguments.test_shot or arguments.latency:
        raise DappledError(
            f"a daemon runs at {endpoint} and holds the camera: stop it first "
            f"(sudo systemctl stop {status.unit(arguments.config)}), or ask it for a photograph "
            "(dappled trigger, the ground station, the console)"
        )
    report, user = status.health(endpoint, HEAR_S, status.unit(arguments.config)), status.stranger(endpoint)
    checks = in_record(report)
    looked: list[Finding] = []
    if report["camera"]["state"] not in ("ready", "busy", "starting"):  # then another program may hold it
        looked = [
            one
            for check in (host_checks.bodies, host_checks.grabbers)
            for one in check(settings, host_checks.Machine(served=True))
        ]
    verdict = go_no_go.state(checks)
    if arguments.config is not None:
        compared = _differences(arguments.config, settings, report, endpoint)
        looked += compared
        verdict = go_no_go.state([*checks, *compared])
    todo = host_checks.next_step(looked) or ("`dappled status` says more" if verdict == "no-go" else "")
    whose = "a daemon runs here" if user is None else f"not your own daemon but that of user {user} runs here"
    lines = [f"{whose}, flight {report['flight']}; it reports", *_lines([*checks, *looked])]
    lines.append(f"{_VERDICTS[verdict]}{f'; next: {todo}' if todo else ''}")
    rows = codec.plain([*checks, *looked])
    found = {"flight": report["flight"], "user": user, "checks": rows, "verdict": verdict, "next": todo}
    return Report(found, lines, failed=verdict == "no-go")


def _differences(file: Path, wanted: Settings, report: Mapping[str, Any], endpoint: str) -> list[Finding]:
    """What the daemon at this endpoint was not started with, though the file says it. The flight's folder holds its
    settings."""
    flown = Path(report["disk"]["folder"]) / "flight.toml"
    try:
        tables, _ = read_toml(flown)
    except DappledError as error:
        return [finding(Code.SETTINGS_UNREAD, _SETTINGS, file=file, why=error)]
    live = tables.get("settings", {})
    live.get("record", {})["min_free_mb"] = report.get("min_free_bytes", 0) // 1_000_000  # it can change in flight
    ours = configuration.to_tables(wanted)
    if wanted.publish.slices == f"ipc://{configuration.runtime_folder()}/slices":  # not named: a service has another
        ours["publish"]["slices"] = endpoint
        if wanted.publish.ask == f"{wanted.publish.slices}.ask":
            ours["publish"]["ask"] = f"{endpoint}.ask"
    simulated: Collection[tuple[str, str]] = ()
    found = []
    if str(tables.get("camera", {}).get("serial", "")).startswith("SIM"):
        from dappled.mocks.simulation import REPLACED  # noqa: PLC0415  # a real flight doesn't load the mocks

        simulated = REPLACED
        found = [finding(Code.SETTINGS_SIMULATED, _SETTINGS, file=file)]
    of_file = {"file": str(file), "unit": status.unit(file)}
    return found + [
        finding(
            Code.SETTINGS_DIFFER, Subject("settings"), setting=f"{table}.{key}", wanted=wish, live=there
        ).with_facts(**of_file)
        for table, key, *_ in configuration.describe()
        if (table, key) not in simulated and (there := _toml(live, table, key)) != (wish := _toml(ours, table, key))
    ]


def _toml(tables: Mapping[str, Any], table: str, key: str) -> str:
    return json.dumps(tables.get(table, {}).get(key), ensure_ascii=False)


def _lines(found: Iterable[Finding], *, remedies: bool = False) -> Iterator[str]:
    for one in found:
        todo = f": {remedy(one)}" if remedies and one.level > Level.NOTE and remedy(one) else ""
        which = f"{one.subject.which}: " if one.subject.which != "" else ""
        yield f"{_WORDS[one.level]:8} {one.subject.kind:11} {which}{text(one)}{todo}"


def _last(found: Sequence[Finding], verdict: str | None) -> str:
    if todo := host_checks.next_step(found):
        return f"next: {todo}"
    if verdict is not None:
        return _VERDICTS[verdict]
    return "nothing is missing; next: dappled doctor --test-shot"


def _shoot(
    settings: Settings, arguments: ExamineMachine, folder: Path, truth: Path | None, output: Output
) -> tuple[list[str], dict[str, Any]]:
    """Fire the test shots; the lines and the values of the report."""
    place = folder if arguments.keep is None else arguments.keep
    place.mkdir(parents=True, exist_ok=True)
    count = arguments.latency or 1
    _, recipe = recipes.recipe(settings)
    ours = settings if arguments.test_shot else replace(settings, decode=replace(settings.decode, enabled=False))
    latencies: list[Latency] = []
    frame: Path | None = None
    judged: list[Finding] = []
    with test_shot.daemon(ours, folder, place) as daemon, _hot_shoe(ours, truth):
        for _ in output.each(range(count), "shot"):
            pending = daemon.shoot()
            if pending.frame is None:
                ended = pending.problem or pending.follows
                judged = [finding(Code.SHOT_WITHOUT_FRAME, Subject("test shot"), why=ended)]
                break
            latencies.append(test_shot.latency(pending))
            frame = frame or daemon.flight / pending.frame.name
        flight = str(daemon.flight) if arguments.keep else None
        if arguments.test_shot and frame is not None and not judged:
            judged = _judged(frame, recipe)
    lines = [*_lines(judged, remedies=True)]
    facts: dict[str, Any] = {"verdict": go_no_go.state(judged), "flight": flight}
    if arguments.test_shot:
        facts["test_shot"] = codec.plain(judged)
    if arguments.latency and latencies:
        timed = _timed(latencies, None if truth is None else _true_latencies(truth, len(latencies)))
        lines += timed.pop("lines")
        facts |= {"latency": timed}
    return lines, facts


def _judged(frame: Path, recipe: Any) -> list[Finding]:
    try:
        return frame_checks.check_frame(frame, recipe)
    except DappledError as error:
        return [finding(Code.FRAME_UNREADABLE, Subject("picture"), why=error)]


_SPANS = {
    "wish_to_trigger": "command to trigger call",
    "trigger_call": "trigger call",
    "to_exposure": "trigger call to exposure",
    "to_file": "trigger call to file",
    "recorded": "file to safe on disk",
}


def _timed(latencies: Sequence[Latency], truth_ms: list[float] | None) -> dict[str, Any]:
    """Statistics in milliseconds, and lines that print them."""
    facts: dict[str, Any] = {}
    lines = []
    for name, title in _SPANS.items():
        values = [value for one in latencies if (value := getattr(one, name)) is not None]
        if not values:
            facts[name] = None
            lines.append(f"         {title:26} not measured: connect a hot shoe to the autopilot (docs/drivers.md)")
            continue
        facts[name] = {
            "median": statistics.median(values),
            "low": min(values),
            "high": max(values),
            "deviation": statistics.pstdev(values),
            "shots": len(values),
        }
        one = facts[name]
        lines.append(
            f"         {title:26} {one['median']:8.1f} ms ({one['low']:.1f} to {one['high']:.1f}, "
            f"σ {one['deviation']:.1f}, {counted(one['shots'], 'shot')})"
        )
    if facts["to_exposure"]:
        mean = statistics.mean(value for one in latencies if (value := one.to_exposure) is not None)
        lines.append(
            f"         set camera.latency_ms = {mean:.0f}, latency_sigma_ms = {facts['to_exposure']['deviation']:.0f}"
        )
    if truth_ms is not None:
        measured = [one.to_exposure for one in latencies]
        errors = [a - b for a, b in zip(measured, truth_ms, strict=True) if a is not None]
        facts["truth_ms"], facts["worst_error_ms"] = truth_ms, max((abs(e) for e in errors), default=None)
        if errors:
            lines.append(
                f"         the times of the simulation itself differ by at most {facts['worst_error_ms']:.1f} ms"
            )
    return {**facts, "lines": lines}


def _watch(output: Output) -> Report:
    """Print cameras on USB as they appear and disappear."""
    before: list[usb_bus.UsbBody] = []
    output.remark("watching USB for cameras; press ^C to end")
    while True:
        now = usb_bus.bodies()
        came, went = usb_bus.changes(before, now)
        for word, bodies in (("gone", went), ("here", came)):
            for body in bodies:
                fires = "can be fired over USB" if body.fires else "USB can't fire it"
                facts = {"event": word, **codec.plain(body)}
                output.row(facts, f"{word}  {body.port}  {body.maker} {body.name} ({body.mode}): {fires}")
        before = now
        time.sleep(0.5)


# --- the simulation -------------------------------------------------------------------------------------------------


@contextmanager
def _simulated(settings: Settings, seed: int, folder: Path) -> Iterator[tuple[Settings, Path]]:
    """Settings for a simulated camera and autopilot, and the folder where the simulation writes the truth."""
    from dappled.mocks.simulation import Simulation, World  # noqa: PLC0415  # a real flight doesn't load the mocks

    truth = folder / "truth"
    truth.mkdir()
    with Simulation(World(seed=seed, truth=truth), settings, folder) as simulated:
        yield simulated, truth


@contextmanager
def _hot_shoe(settings: Settings, truth: Path | None) -> Iterator[None]:
    """Wire the simulated body's hot shoe to the simulated autopilot."""
    if truth is None:
        yield
        return
    from dappled.mocks.autopilot.autopilot import HotShoe  # noqa: PLC0415  # as above

    shoe = HotShoe(truth, settings.mavlink.url[0])
    try:
        yield
    finally:
        shoe.close()


def _true_latencies(truth: Path, count: int) -> list[float]:
    """The simulation's own times from trigger to exposure, in milliseconds."""
    from dappled.mocks.autopilot import shot_times  # noqa: PLC0415  # as above

    return [shot_times.read(path).latency_s * 1e3 for path in sorted(truth.glob("*.json"))[:count]]
