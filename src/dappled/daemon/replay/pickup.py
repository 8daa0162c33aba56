"""Bring the files that stayed in the camera into a flight after landing, as frames of the shots that made them.

Matching is by order, count and the camera's own time; only what is sure is taken, and what a person says. The frames
are recorded, tagged from the flight's own telemetry, and entered in the index: the flight is then as if they had come
in the air. Decoding is the ground's business (`dappled replay`).
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from contextlib import ExitStack
from dataclasses import dataclass, field
from pathlib import Path
from statistics import median
from typing import Any

from dappled.clock import Clock
from dappled.config import settings as configuration
from dappled.daemon.navigation import BodyLatency, clocks, recorded_vehicles
from dappled.daemon.pipeline import tagging
from dappled.daemon.pipeline.tagging import Zoom
from dappled.daemon.replay.replay import RecordedTelemetry, tagging_rules
from dappled.drivers.raw import reading
from dappled.drivers.raw.darkroom import camera_name
from dappled.drivers.wired.matching import PLAUSIBLE_S, DatedFile, FiredShot, Matching, in_order, match
from dappled.drivers.wired.sources import FileGroup, FileSource, FoundFile, groups
from dappled.errors import DappledError, counted
from dappled.flight import FlightsLock, Frame, ImageIndex, Ledger, LedgerReader, Recorder, ShotRow, layout, seals
from dappled.flight.index import IndexEntry
from dappled.flight.seal_key import SealKey


class PickupError(DappledError):
    """Nothing can be picked up for this flight, or not like this; one sentence."""


@dataclass(frozen=True, slots=True)
class Choice:
    """What a person says about the matching. `pairs`: image index → file name (or its last part). `offset_s`: the
    camera's clock minus UTC. `any_clock`: it may be off by more than a day. `by_order`: take files in the order of
    their names where there are as many as shots."""

    pairs: Mapping[int, str] = field(default_factory=dict)
    offset_s: float | None = None
    any_clock: bool = False
    by_order: bool = False


@dataclass(frozen=True, slots=True)
class Proposal:
    """What would be picked up: `pairs` (image index, file), each for a reason; what is open, and why.

    `missing`: shots without a file. `strangers`: files that belong to no shot of the flight. `there_already`: files
    that the flight has. `offset_s`: the camera's clock minus UTC, as the pairs show it.
    """

    pairs: tuple[tuple[int, FileGroup], ...]
    reasons: Mapping[int, str]
    doubts: tuple[str, ...]
    missing: tuple[int, ...]
    strangers: tuple[str, ...]
    there_already: int
    offset_s: float | None


@dataclass(frozen=True, slots=True)
class Picked:
    """What was picked up. `zooms` are sentences."""

    frames: tuple[Frame, ...]
    companions: int
    zooms: tuple[str, ...]


def propose(flight: Path, source: FileSource, choice: Choice) -> Proposal:
    """Which files belong to which shots. Changes nothing. Raises PickupError, FlightError, CameraError."""
    folder = layout.open_folder(flight)
    with LedgerReader.open(folder.ledger) as ledger:
        if "closed_utc_ns" not in ledger.facts():
            raise PickupError(f"{flight} is still being recorded, or was never closed: stop the daemon first")
        rows = {row.shot.index: row for row in ledger.shots()}
        frames = ledger.frames()
    found = groups(source.list())
    had = {(frame.camera_name.lower(), frame.size): frame for frame in frames}
    known = {group.main.name: had.get((group.main.base.lower(), group.main.size)) for group in found}
    fresh = [group for group in found if known[group.main.name] is None]
    times = {group.main.name: source.taken_s(group.main) for group in found}
    waiting = [
        _fired(row) for row in rows.values() if row.state == "failed" and row.fired_called_monotonic_ns is not None
    ]
    chosen = _chosen(choice, fresh, rows)
    taken = {group.main.name for group in chosen.values()}
    shots = [shot for shot in waiting if shot.index not in chosen]
    files = [DatedFile(group.main.name, times[group.main.name]) for group in fresh if group.main.name not in taken]
    anchors = [
        (times[name], _fired(rows[frame.index]))
        for name, frame in known.items()
        if frame is not None and rows[frame.index].fired_called_monotonic_ns is not None
    ]
    offset_s = choice.offset_s if choice.offset_s is not None else _offset(anchors)
    matched = _matched(shots, files, choice, offset_s)
    by_name = {group.main.name: group for group in fresh}
    pairs = [(index, by_name[name]) for index, name in matched.pairs] + list(chosen.items())
    reason = _reason(choice, matched)
    reasons = {index: "as you said" if index in chosen else reason for index, _ in pairs}
    doubtful = {text.split(" ", 1)[0] for text in matched.doubts}
    return Proposal(
        tuple(sorted(pairs, key=lambda pair: pair[0])),
        reasons,
        matched.doubts,
        matched.shots,
        tuple(name for name in matched.files if name not in doubtful),
        len(found) - len(fresh),
        matched.offset_s if matched.offset_s is not None else offset_s,
    )


def bring(
    flight: Path,
    source: FileSource,
    proposal: Proposal,
    *,
    clock: Clock,
    key: SealKey | None = None,
    progress: Callable[[int], Any],
) -> Picked:
    """Record, tag and index what was proposed. `key` signs the seal after it. `progress` gets the bytes of each file.

    What was brought when an error comes stays; doing it again brings the rest. Raises FlightError, CameraError."""
    folder = layout.open_folder(flight)
    facts = layout.read_facts(folder)
    settings = configuration.of_tables(facts.get("settings", {}), str(folder.settings))
    names = facts.get("names", {})
    latency = BodyLatency.of(settings.camera)
    with LedgerReader.open(folder.ledger) as reader:
        turns = recorded_vehicles(reader)
    log = folder.telemetry if folder.telemetry.is_file() else None
    telemetry = RecordedTelemetry.flown(settings, log, {}, turns, rules=tagging_rules(facts))
    frames: list[Frame] = []
    zooms: list[str] = []
    companions = 0
    root = flight.resolve().parent  # of the flight itself, whatever link leads to it
    zoom = Zoom()
    with ExitStack() as stack:
        stack.enter_context(FlightsLock(root, "picks up files into"))
        index = stack.enter_context(ImageIndex(root))
        stack.enter_context(seals.reopened(folder, clock, "pickup", key))
        ledger = stack.enter_context(Ledger(folder.ledger, clock))
        recorder = Recorder(folder, ledger)
        stack.callback(recorder.close)
        for number, group in proposal.pairs:
            frame = _record(recorder, source, number, group.main, clock.utc_ns())
            ledger.add_event("picked up", f"{group.main.name}: {proposal.reasons[number]}", number)
            for other in group.companions:
                _accompany(recorder, source, number, other, clock.utc_ns())
                companions += 1
            row = ledger.shot(number)
            assert row is not None
            facts_of = _settings(folder.file(frame.name))
            exposure = clocks.mid_exposure(_called_utc_ns(row), latency, facts_of.exposure_s)
            exposure = clocks.owned(exposure, row.shot, latency)
            exposure, pose = telemetry.pose(number, exposure)
            camera = camera_name(names.get("camera", "auto"), facts_of.model)
            ledger.add_tag(tagging.tag(frame, exposure, facts_of, camera=camera, mask=names.get("mask", ""), pose=pose))
            index.put(IndexEntry(number, folder.name, frame.name, "safe"))
            if zoomed := zoom.look(number, facts_of.focal_length_mm):
                zooms.append(f"frame {number}: {zoomed}")
                ledger.add_event("zoom", zoomed, number)
            frames.append(frame)
            progress(frame.size)
    return Picked(tuple(frames), companions, tuple(zooms))


def _fired(row: ShotRow) -> FiredShot:
    """When a shot's shutter was released, in seconds of UTC."""
    return FiredShot(row.shot.index, _called_utc_ns(row) / 1e9)


def _called_utc_ns(row: ShotRow) -> int:
    assert row.fired_called_monotonic_ns is not None
    return clocks.called_utc_ns(row.shot, row.fired_called_monotonic_ns)


def _offset(anchors: list[tuple[float | None, FiredShot]]) -> float | None:
    offsets = [taken_s - shot.fired_s for taken_s, shot in anchors if taken_s is not None]
    return median(offsets) if offsets else None


def _chosen(choice: Choice, fresh: list[FileGroup], rows: Mapping[int, ShotRow]) -> dict[int, FileGroup]:
    chosen: dict[int, FileGroup] = {}
    for index, name in choice.pairs.items():
        row = rows.get(index)
        if row is None or row.state == "safe":
            raise PickupError(
                f"--pair {index}={name}: shot {index} {'has its frame' if row else 'is not in the flight'}"
            )
        if row.fired_called_monotonic_ns is None:
            raise PickupError(f"--pair {index}={name}: shot {index} never fired, according to the flight: {row.reason}")
        fitting = [group for group in fresh if name in (group.main.name, group.main.base)]
        if len(fitting) != 1:
            raise PickupError(f"--pair {index}={name}: {len(fitting)} new files have this name; give the full name")
        chosen[index] = fitting[0]
    return chosen


def _matched(shots: list[FiredShot], files: list[DatedFile], choice: Choice, offset_s: float | None) -> Matching:
    if choice.by_order:
        pairs = in_order(shots, files)
        if pairs is None:
            raise PickupError(
                f"--by-order needs as many files as shots: {counted(len(shots), 'shot')}, {counted(len(files), 'file')}"
            )
        return Matching(pairs, (), (), ())
    plausible_s = math.inf if choice.any_clock else PLAUSIBLE_S
    return match(shots, files, offset_s=offset_s, plausible_s=plausible_s)


def _reason(choice: Choice, matched: Matching) -> str:
    if choice.by_order:
        return "by order and count alone"
    return f"by order, count and time (the camera's clock is {matched.offset_s or 0.0:+.1f} s from UTC)"


def _record(recorder: Recorder, source: FileSource, index: int, found: FoundFile, utc_ns: int) -> Frame:
    blob = source.open(found)
    try:
        return recorder.record(index, found.base, blob, arrived_utc_ns=utc_ns)
    finally:
        blob.close()


def _accompany(recorder: Recorder, source: FileSource, index: int, found: FoundFile, utc_ns: int) -> None:
    blob = source.open(found)
    try:
        recorder.record_companion(index, found.base, blob, arrived_utc_ns=utc_ns)
    finally:
        blob.close()


def _settings(path: Path) -> tagging.FrameSettings:
    try:
        return tagging.FrameSettings.of(reading.read_metadata(path))
    except DappledError:
        return tagging.FrameSettings()  # an unreadable frame is still recorded
