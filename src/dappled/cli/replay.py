"""`dappled replay`: run a recorded flight, or a folder of frames with a .tlog, through the same pipeline."""

from __future__ import annotations

import math
from collections.abc import Mapping
from contextlib import ExitStack
from dataclasses import dataclass, replace
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

from dappled import codec
from dappled.cli import paths, sealing
from dappled.cli.table import words_only
from dappled.cli.verb import Doubtable, Output, Report, SettingsArgument, Verb, argument, flag, option
from dappled.clock import TimeOfDayClock
from dappled.config import settings as configuration
from dappled.errors import CallError, DappledError, counted
from dappled.findings import Finding, first_of_each, in_order, named

if not words_only:
    from dappled.cli.terminal import frame_line, frame_values
    from dappled.config import profiles
    from dappled.daemon.navigation import BodyLatency
    from dappled.daemon.pipeline import recipes
    from dappled.daemon.pipeline.capture import PendingShot
    from dappled.daemon.pipeline.recipes import Names
    from dappled.daemon.replay import playback, replay, runs
    from dappled.daemon.replay.playback import FlownWith
    from dappled.daemon.replay.replay import ReplayProgress
    from dappled.daemon.replay.runs import Run, RunWriter
    from dappled.daemon.replay.vehicle_choice import VehicleError
    from dappled.daemon.replay.verifier import MOST_SHARE, ReplayVerifier
    from dappled.drivers.raw.recipe import Recipe
    from dappled.flight import LIVE, TimeSource, layout
    from dappled.flight.checks import flight_check

_OF_FOLDERS = ("telemetry", "vehicle", "match", "start", "interval")
_LATEST_S = 4_102_444_800  # 2100
_GIVEN = ("camera", "mask", "white", "dark", "calibration")


def _rate(text: str) -> float:
    """The factor on the recorded speed; inf for max."""
    try:
        rate = math.inf if text == "max" else float(text)
    except ValueError:
        rate = math.nan
    if not rate > 0 or (rate == math.inf and text != "max"):
        raise ValueError(f"{text!r} is neither a number above 0 nor max")
    return rate


def _utc_ns(text: str) -> int:
    try:
        time = datetime.fromisoformat(text)
        since_s = (time if time.tzinfo else time.replace(tzinfo=UTC)).timestamp()
    except (ValueError, OverflowError):
        since_s = math.inf
    if not 0 <= since_s < _LATEST_S:
        raise ValueError(f"{text!r} is not a UTC time such as 2026-11-21T10:15:03Z")
    return round(since_s * 1e9)


@dataclass(frozen=True, kw_only=True)
class ReplayFlight(SettingsArgument, Doubtable, Verb):
    """Run a recorded flight."""

    examples = (
        "dappled replay flights/20261121T101503Z-0a1b2c3d --verify",
        "dappled replay flights/20261121T101503Z-0a1b2c3d --calibration new.toml --run new",
        "dappled replay frames/ --mask lenslet --white white.png --telemetry flight.tlog --publish",
    )

    flight: Path = argument("FLIGHT", "flight folder, or a folder of frames", there=True)
    rate: float = option(
        "--rate", "1: as fast as recorded; 2: twice as fast; max: as fast as possible", math.inf, parse=_rate,
        metavar="RATE", otherwise="max",
    )  # fmt: skip
    step: bool = flag("--step", "wait for Enter before each frame")
    publish: bool | None = option("--publish", "publish over ZeroMQ", None, otherwise="no")
    verify: bool = flag("--verify", "compare every hash; exit 1 on any difference")
    run_name: str | None = option(
        "--run", "store the results under this name, beside the flight's own (default with another recipe: the "
        "time); with --verify: check them", None, metavar="NAME",
    )  # fmt: skip
    camera: str | None = option("--camera", "camera profile or TOML file", None, otherwise="the flight's")
    mask: str | None = option("--mask", "mask profile or TOML file, or lenslet", None, otherwise="the flight's")
    telemetry: Path | None = option(
        "--telemetry", "telemetry for a folder of frames: a .tlog, or the autopilot's own log (ArduPilot's .bin, "
        "PX4's .ulg)", None, there=paths.file, otherwise="the only one in it",
    )  # fmt: skip
    vehicle: int | None = option(
        "--vehicle", "system id of the vehicle that carried the camera, where a .tlog holds several", None,
        metavar="SYSID", low=1, high=255,
    )  # fmt: skip
    white: str | None = option("--white", "white frame", None, metavar="FILE", there=True)
    dark: str | None = option("--dark", "dark frame", None, metavar="FILE", there=True)
    calibration: str | None = option(
        "--calibration", "file written by dappled calibrate", None, metavar="FILE", there=True,
    )  # fmt: skip
    match: str | None = option("--match", "which files in a folder are frames", None, metavar="GLOB", otherwise="all")
    start: int | None = option(
        "--start", "time of a folder's first frame, such as 2026-11-21T10:15:03Z", None, parse=_utc_ns, metavar="UTC",
        otherwise="the telemetry's first position",
    )  # fmt: skip
    interval: float | None = option(
        "--interval", "time between the frames of a folder", None, unit="s", low=0, high=86400, otherwise="1",
    )  # fmt: skip
    json: bool = flag("--json", "print one JSON object per frame, and one with what was found, if anything was")

    @property
    def _is_flight(self) -> bool:
        return layout.FlightFolder(self.flight).ledger.is_file()

    @property
    def _given(self) -> dict[str, str | None]:
        """What the call names of a recipe other than the flight's own."""
        return {name: getattr(self, name) for name in _GIVEN}

    def check(self) -> None:
        if not self._is_flight:
            if not self.flight.is_dir():
                raise CallError(f"{self.flight} is neither a flight nor a folder of frames")
            if self.verify:
                raise CallError(f"{self.flight} is not a recorded flight: it has no hashes to verify")
            if self.run_name:
                raise CallError(f"{self.flight} is not a recorded flight: --run stores results in the ledger of one")
        for name in _OF_FOLDERS if self._is_flight else ():
            if getattr(self, name) is not None:
                what = "a recorded flight has its own frames, times and telemetry"
                raise CallError(f"--{name} is for a folder of frames: {what}; leave it out, or replay its frames/")
        if self.camera and self.camera != "auto":
            profiles.camera(self.camera)
        if self.mask and self.mask != profiles.LENSLET:
            profiles.mask(self.mask)

    def run(self, output: Output) -> Report:
        settings = configuration.load(self.config)
        problems = [*flight_check.check(self.flight).problems] if self.verify else []
        facts = layout.read_facts(layout.open_folder(self.flight)) if self._is_flight else {}
        recipe = self._recipe(facts, settings)
        recording = self._recording()
        found: list[Finding] = list(recording.findings)
        flown = self._as_recorded(facts, recipe)
        of_flight: list[Finding] = []

        def tell(shot: PendingShot) -> None:
            output.row(frame_values(shot), frame_line(shot))
            if shot.decoded:
                of_flight[:] = shot.decoded.about_flight

        progress = ReplayProgress(tell)
        with ExitStack() as stack:
            keep: RunWriter | None = None
            if self._is_flight and recipe and (self.run_name or any(self._given.values())) and not self.verify:
                name = self.run_name or datetime.now(UTC).strftime("%Y%m%dT%H%M%SZ")
                key = sealing.key_of(self.config)
                results = stack.enter_context(
                    RunWriter(self.flight, Run(name, recipe, flown.names), TimeOfDayClock(), key)
                )
                recipe, keep = results.run.recipe, results
                output.remark(f"storing the results beside the old ones, as run {name}")
            writer = replay.verifier(recording, keep)
            playback.run(
                recording,
                writer,
                progress,
                replace(flown, recipe=recipe),
                publish=settings.publish if self.publish else None,
                pace=self._pace(),
                report=found.append,
            )
        told = first_of_each([*found, *of_flight])
        if not self.verify:
            if told:
                output.row({"findings": codec.plain(in_order(told))})
            return Report(findings=told, failed=bool(progress.bad))
        problems += writer.verdict(decoded=recipe is not None)
        for one in problems:
            output.remark(f"different: {named(one)}")
        count = sum(one.frame is not None for one in recording.expected)
        undecoded = sum(one.frame is not None and one.left_undecoded for one in recording.expected)
        left = f" ({undecoded} left undecoded in flight)" if undecoded else ""
        verdict = counted(len(problems), "difference") if problems else _same(writer)
        values = {"verified": count, "differences": codec.plain(problems), "left_undecoded": undecoded}
        values["findings"] = codec.plain(in_order(told))
        output.row(values, f"verified {counted(count, 'frame')}: {verdict}{left}")
        return Report(findings=told, failed=bool(problems))

    def _recipe(self, facts: Mapping[str, Any], settings: configuration.Settings) -> Recipe | None:
        if facts:
            if self.verify and self.run_name:
                return runs.of_flight(self.flight, self.run_name).recipe
            if not facts.get("decode_in_flight") and not self.mask:
                return None
            return recipes.of_flight(self.flight, facts, self._given)
        if not self.mask:
            return None
        set_here = {name: value for name, value in self._given.items() if value is not None}
        given: dict[str, Any] = {"camera": settings.camera.profile, "workers": settings.decode.workers, **set_here}
        return Recipe(**given)

    def _recording(self) -> replay.RecordedFlight:
        if self._is_flight:
            return replay.of_flight(self.flight, (self.verify and self.run_name) or LIVE)
        try:
            return replay.of_folder(
                self.flight,
                self.match or "*",
                telemetry=self.telemetry,
                start_utc_ns=self.start,
                interval_s=1.0 if self.interval is None else self.interval,
                vehicle=self.vehicle,
            )
        except VehicleError as error:
            if self.vehicle is None:
                raise
            raise CallError(str(error)) from None

    def _as_recorded(self, facts: Mapping[str, Any], recipe: Recipe | None) -> FlownWith:
        """Names, body latency and settings of the flight. The frames of a folder begin to expose at their times."""
        if not facts:
            latency = BodyLatency(0.0, 0.0, TimeSource.GIVEN)
            return FlownWith(recipes.names(recipe), latency, configuration.Settings())
        if "settings" not in facts or "names" not in facts:
            raise DappledError(f"{self.flight}/flight.toml lacks its settings; replay its folder frames/ with --mask")
        recorded = configuration.of_tables(facts["settings"], "flight.toml")
        names = recipes.names(recipe) if self.camera or self.mask else Names(**facts["names"])
        return FlownWith(names, BodyLatency.of(recorded.camera), recorded)

    def _pace(self) -> replay.Pace | None:
        if self.step:
            return lambda shot, before: (input(f"Enter for shot {shot.index} "), None)[1]
        return None if self.rate == math.inf else replay.as_recorded(self.rate)


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
