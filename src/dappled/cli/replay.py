"""`dappled replay`: run a recorded flight, or a folder of frames with a .tlog, through the same pipeline."""

from __future__ import annotations

import argparse
import sys
from collections.abc import Mapping
from contextlib import ExitStack
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

from dappled.cli import sealing
from dappled.cli.arguments import positive, seconds, system_id
from dappled.cli.terminal import frame_json, frame_line
from dappled.clock import TimeOfDayClock
from dappled.config import settings as configuration
from dappled.daemon.navigation import BodyLatency
from dappled.daemon.pipeline import recipes
from dappled.daemon.pipeline.capture import PendingShot
from dappled.daemon.pipeline.recipes import Names
from dappled.daemon.replay import playback, replay, runs
from dappled.daemon.replay.playback import FlownWith
from dappled.daemon.replay.replay import ReplayError, ReplayProgress
from dappled.daemon.replay.runs import Run, RunWriter
from dappled.daemon.replay.verifier import MOST_SHARE, ReplayVerifier
from dappled.drivers.raw.darkroom import Recipe
from dappled.errors import counted
from dappled.findings import Finding, Level, first_of_each, in_order, told, worst
from dappled.flight import LIVE, TimeSource, layout
from dappled.flight.checks import flight_check

_OF_FOLDERS = ("telemetry", "vehicle", "match", "start", "interval")
_GIVEN = ("camera", "mask", "white", "dark", "calibration")


def configure(parser: argparse.ArgumentParser) -> None:
    parser.epilog = (
        "examples:\n  dappled replay flights/20261121T101503Z-0a1b2c3d --verify\n"
        "  dappled replay flights/20261121T101503Z-0a1b2c3d --calibration new.toml --run new\n"
        "  dappled replay frames/ --mask lenslet --white white.png --telemetry flight.tlog --publish"
    )
    parser.add_argument("flight", type=Path, metavar="FLIGHT", help="flight folder, or a folder of frames")
    parser.add_argument(
        "--rate",
        default=None,
        type=_rate,
        metavar="RATE",
        help="1: as fast as recorded; 2: twice as fast; max (default): as fast as possible",
    )
    parser.add_argument("--step", action="store_true", help="wait for Enter before each frame")
    parser.add_argument("--publish", action=argparse.BooleanOptionalAction, default=False, help="publish over ZeroMQ")
    parser.add_argument("--verify", action="store_true", help="compare every hash; exit 1 on any difference")
    parser.add_argument(
        "--run",
        dest="run_name",
        metavar="NAME",
        help="store the results under this name, beside the flight's own (default with another recipe: the time);\n"
        "with --verify: check them",
    )
    parser.add_argument("--camera", metavar="P", help="camera profile or TOML file (default: the flight's)")
    parser.add_argument("--mask", metavar="P", help="mask profile or TOML file, or lenslet (default: the flight's)")
    parser.add_argument(
        "--telemetry",
        type=Path,
        metavar="FILE",
        help="telemetry for a folder of frames: a .tlog, or the autopilot's own log (ArduPilot's .bin, PX4's .ulg)\n"
        "(default: the only one in it)",
    )
    parser.add_argument(
        "--vehicle",
        type=system_id,
        metavar="SYSID",
        help="system id of the vehicle that carried the camera, where a .tlog holds several",
    )
    parser.add_argument("--white", metavar="FILE", help="white frame")
    parser.add_argument("--dark", metavar="FILE", help="dark frame")
    parser.add_argument("--calibration", metavar="FILE", help="file written by dappled calibrate")
    parser.add_argument("--match", metavar="GLOB", help="which files in a folder are frames (default: all)")
    parser.add_argument(
        "--start", type=_utc_ns, metavar="UTC", help="time of a folder's first frame, such as 2026-11-21T10:15:03Z"
    )
    parser.add_argument(
        "--interval", type=seconds, metavar="S", help="time between the frames of a folder (default: 1)"
    )
    parser.add_argument(
        "--config", type=Path, metavar="FILE", help="settings file, for endpoints, workers and record.seal_key"
    )
    parser.add_argument("--anyway", action="store_true", help="exit with 0 though a log is in doubt")
    parser.add_argument("--json", action="store_true", help="print one JSON object per frame")


def run(arguments: argparse.Namespace) -> int:
    settings = configuration.load(arguments.config)
    is_flight = (arguments.flight / layout.FlightFolder(arguments.flight).ledger.name).is_file()
    if arguments.verify and not is_flight:
        raise ReplayError(f"{arguments.flight} is not a recorded flight: it has no hashes to verify")
    if arguments.run_name and not is_flight:
        raise ReplayError(f"{arguments.flight} is not a recorded flight: --run stores results in the ledger of one")
    for option in _OF_FOLDERS if is_flight else ():
        if getattr(arguments, option) is not None:
            what = "a recorded flight has its own frames, times and telemetry"
            raise ReplayError(f"--{option} is for a folder of frames: {what}; leave it out, or replay its frames/")
    problems = list(flight_check.check(arguments.flight).problems) if arguments.verify else []
    facts = layout.read_facts(layout.open_folder(arguments.flight)) if is_flight else {}
    recipe = _recipe(arguments, facts, settings)
    recording = _recording(arguments, is_flight)
    for one in recording.findings:
        print(f"{one.level.word}: {told(one)}", file=sys.stderr)
    found: list[Finding] = []
    flown = _as_recorded(arguments, facts, recipe)
    progress = PrintedProgress(as_json=arguments.json)
    with ExitStack() as stack:
        keep: RunWriter | None = None
        if is_flight and recipe and (arguments.run_name or _changed(arguments)) and not arguments.verify:
            name = arguments.run_name or datetime.now(UTC).strftime("%Y%m%dT%H%M%SZ")
            key = sealing.key_of(arguments.config)
            results = stack.enter_context(
                RunWriter(arguments.flight, Run(name, recipe, flown.names), TimeOfDayClock(), key)
            )
            recipe, keep = results.run.recipe, results
            print(f"storing the results beside the old ones, as run {name}", file=sys.stderr)
        writer = replay.verifier(recording, keep)
        playback.run(
            recording,
            writer,
            progress,
            flown,
            recipe=recipe,
            publish=settings.publish if arguments.publish else None,
            pace=_pace(arguments),
            report=found.append,
        )
    for one in in_order(first_of_each(found)):
        print(f"{one.level.word}: {told(one)}", file=sys.stderr)
    doubted = worst([*recording.findings, *found]) > Level.NOTE and not arguments.anyway
    if not arguments.verify:
        return 1 if progress.bad or doubted else 0
    problems += writer.verdict(decoded=recipe is not None)
    for text in problems:
        print(f"different: {text}", file=sys.stderr)
    count = sum(one.frame is not None for one in recording.expected)
    undecoded = sum(one.frame is not None and one.left_undecoded for one in recording.expected)
    left = f" ({undecoded} left undecoded in flight)" if undecoded else ""
    print(
        f"verified {counted(count, 'frame')}: "
        + (counted(len(problems), "difference") if problems else _same(writer))
        + left
    )
    return 1 if problems else 0


def _same(writer: ReplayVerifier) -> str:
    """In which sense everything was the same."""
    if not writer.close:
        return "all hashes the same"
    share, index = writer.furthest
    worst = f"; the furthest is frame {index}, {share:.1e}" if index >= 0 and share else ""
    return (
        f"equal within {MOST_SHARE:g} of each frame's largest value, root mean square{worst}; "
        f"poses and tags within 1e-9; recorded on {writer.elsewhere}"
    )


class PrintedProgress(ReplayProgress):
    """Prints a line for each shot that has ended."""

    def __init__(self, *, as_json: bool) -> None:
        super().__init__()
        self._as_json = as_json

    def finished(self, pending: PendingShot) -> None:
        """See Observer."""
        print(frame_json(pending) if self._as_json else frame_line(pending), flush=True)
        super().finished(pending)


def _changed(arguments: argparse.Namespace) -> bool:
    """Whether the call names a recipe other than the flight's own."""
    return any(getattr(arguments, name) for name in _GIVEN)


def _recipe(arguments: argparse.Namespace, facts: Mapping[str, Any], settings: configuration.Settings) -> Recipe | None:
    given = {name: getattr(arguments, name) for name in _GIVEN}
    if facts:
        if arguments.verify and arguments.run_name:
            return runs.of_flight(arguments.flight, arguments.run_name).recipe
        if not facts.get("decode_in_flight") and not given["mask"]:
            return None
        return recipes.of_flight(arguments.flight, facts, given)
    if not given["mask"]:
        return None
    named = {name: value for name, value in given.items() if value is not None}
    return Recipe(**{"camera": settings.camera.profile, "workers": settings.decode.workers, **named})


def _recording(arguments: argparse.Namespace, is_flight: bool) -> replay.RecordedFlight:
    if is_flight:
        return replay.of_flight(arguments.flight, (arguments.verify and arguments.run_name) or LIVE)
    if not arguments.flight.is_dir():
        raise ReplayError(f"{arguments.flight} is neither a flight nor a folder of frames")
    return replay.of_folder(
        arguments.flight,
        arguments.match or "*",
        telemetry=arguments.telemetry,
        start_utc_ns=arguments.start,
        interval_s=1.0 if arguments.interval is None else arguments.interval,
        vehicle=arguments.vehicle,
    )


def _as_recorded(arguments: argparse.Namespace, facts: Mapping[str, Any], recipe: Recipe | None) -> FlownWith:
    """Names, body latency and settings of the flight. The frames of a folder begin to expose at their times."""
    if not facts:
        latency = BodyLatency(0.0, 0.0, TimeSource.GIVEN)
        return FlownWith(recipes.names(recipe), latency, configuration.Settings())
    if "settings" not in facts or "names" not in facts:
        raise ReplayError(f"{arguments.flight}/flight.toml lacks its settings; replay its folder frames/ with --mask")
    recorded = configuration.of_tables(facts["settings"], "flight.toml")
    changed = any(getattr(arguments, name) for name in ("camera", "mask"))
    names = recipes.names(recipe) if changed else Names(**facts["names"])
    return FlownWith(names, BodyLatency.of(recorded.camera), recorded)


def _pace(arguments: argparse.Namespace) -> replay.Pace | None:
    if arguments.step:
        return lambda shot, before: (input(f"Enter for shot {shot.index} "), None)[1]
    return None if arguments.rate is None else replay.as_recorded(arguments.rate)


def _rate(text: str) -> float | None:
    """Parse the factor on the recorded speed; None for max."""
    if text == "max":
        return None
    try:
        return positive(text)
    except argparse.ArgumentTypeError:
        raise argparse.ArgumentTypeError(f"{text!r} is neither a number above 0 nor max") from None


def _utc_ns(text: str) -> int:
    try:
        time = datetime.fromisoformat(text)
    except ValueError:
        raise argparse.ArgumentTypeError(f"{text!r} is not a UTC time such as 2026-11-21T10:15:03Z") from None
    return round((time if time.tzinfo else time.replace(tzinfo=UTC)).timestamp() * 1e9)
