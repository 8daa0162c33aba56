"""Bring the files that stayed in the camera into a flight after landing, as frames of the shots that made them.

Matching is by order, count and the camera's own time; only what is sure is taken, and what a person says. The frames
are recorded, tagged from the flight's own telemetry, and entered in the index: the flight is then as if they had come
in the air. Decoding is the ground's business (`dappled replay`).
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from contextlib import ExitStack, closing
from dataclasses import dataclass, field
from pathlib import Path
from statistics import median
from typing import Any

from dappled import durable
from dappled.clock import Clock
from dappled.config import settings as configuration
from dappled.daemon.navigation import BodyLatency, clocks, recorded_doubt, recorded_vehicles
from dappled.daemon.pipeline import tagging
from dappled.daemon.pipeline.tagging import Zoom
from dappled.daemon.replay.replay import RecordedTelemetry
from dappled.drivers.camera import CameraError
from dappled.drivers.raw import reading
from dappled.drivers.raw.exposure_settings import ExposureSettings
from dappled.drivers.raw.raw_file import read_exif
from dappled.drivers.raw.recipe import camera_name
from dappled.drivers.wired import matching
from dappled.drivers.wired.matching import PLAUSIBLE_S, DatedFile, FiredShot, Matching
from dappled.drivers.wired.sources import FileGroup, FileSource, FoundFile, groups
from dappled.errors import CallError, DappledError, counted
from dappled.findings import FRAME, Code, Finding, Subject, above_note, finding, text
from dappled.flight import FlightsLock, Frame, ImageIndex, Ledger, LedgerReader, Recorder, ShotRow, layout, seals
from dappled.flight.index import IndexEntry
from dappled.flight.records import DOUBT, NOTICED
from dappled.flight.seal_key import SealKey

_ANCHORS = 64  # frames whose times tell the camera's clock


@dataclass(frozen=True, slots=True)
class Choice:
    """What a person says about the matching. `pairs`: image index → file name (or its last part). `offset_s`: the
    camera's clock minus UTC. `any_clock`: it may be off by more than a day. `by_order`: take files in their order where
    there are as many as shots."""

    pairs: Mapping[int, str] = field(default_factory=dict)
    offset_s: float | None = None
    any_clock: bool = False
    by_order: bool = False


@dataclass(frozen=True, slots=True)
class Proposal:
    """What would be picked up: `pairs` (image index, file), each for a reason; what was found, such as a doubt.

    `missing`: shots without a file. `strangers`: files that belong to no shot of the flight. `there_already`: files
    whose bytes the flight has. `offset_s`: the camera's clock minus UTC, as the pairs show it.
    """

    pairs: tuple[tuple[int, FileGroup], ...]
    reasons: Mapping[int, Finding]
    findings: tuple[Finding, ...]
    missing: tuple[int, ...]
    strangers: tuple[str, ...]
    there_already: int
    offset_s: float | None

    @property
    def doubts(self) -> list[Finding]:
        """What a person should look at."""
        return above_note(self.findings)


@dataclass(frozen=True, slots=True)
class Picked:
    """What was picked up. `zooms` are the frames whose focal length is not that of the one before."""

    frames: tuple[Frame, ...]
    companions: int
    zooms: tuple[Finding, ...]


def propose(
    flight: Path, source: FileSource, choice: Choice, progress: Callable[[int], Any] = lambda _: None
) -> Proposal:
    """Which files belong to which shots. Changes nothing. `progress` gets the bytes that were compared. Raises
    DappledError, CallError, FlightError, CameraError."""
    folder = layout.open_folder(flight)
    with LedgerReader.open(folder.ledger) as ledger:
        if "closed_utc_ns" not in ledger.facts():
            raise DappledError(f"{flight} is still being recorded, or was never closed: stop the daemon first")
        rows = {row.shot.index: row for row in ledger.shots()}
        frames = ledger.frames()
        had = frames + ledger.companions()
        files = {row.sha256: (row.size, row if isinstance(row, Frame) else None) for row in reversed(ledger.files())}
    found = groups(source.list())
    same = _same(source, [group.main for group in found], files, progress)
    known = {name: row for name, row in same.items() if row is not None}
    fresh = [group for group in found if group.main.name not in known]
    times = {group.main.name: source.taken_s(group.main) for group in found}
    waiting = [
        _fired(row) for row in rows.values() if row.state == "failed" and row.fired_called_monotonic_ns is not None
    ]
    chosen = _chosen(choice, fresh, known, rows)
    taken = {group.main.name for group in chosen.values()}
    shots = [shot for shot in waiting if shot.index not in chosen]
    left = [DatedFile(group.main.name, times[group.main.name]) for group in fresh if group.main.name not in taken]
    anchors = [
        (_taken_s(folder.file(frame.name)), _fired(rows[frame.index]))
        for frame in frames[-_ANCHORS:]
        if rows[frame.index].fired_called_monotonic_ns is not None
    ]
    offset_s = choice.offset_s if choice.offset_s is not None else _offset(anchors)
    matched = _matched(shots, left, choice, offset_s)
    by_name = {group.main.name: group for group in fresh}
    pairs = [(index, by_name[name]) for index, name in matched.pairs] + list(chosen.items())
    by = Code.PICKUP_BY_ORDER if choice.by_order else Code.PICKUP_BY_TIME
    reasons = {index: finding(by, Subject("frame", index), offset_s=matched.offset_s) for index, _ in matched.pairs}
    reasons |= {index: finding(Code.PICKUP_AS_TOLD, Subject("frame", index)) for index in chosen}
    doubtful = {one.subject.which for one in matched.doubts}
    nobodys = [name for name in matched.files if name not in doubtful]
    known_s, offset_s = offset_s, matched.offset_s if matched.offset_s is not None else offset_s
    dated = [DatedFile(name, time_s) for name, time_s in times.items()]
    named = [(index, group.main.name) for index, group in pairs]
    off = matching.disagreeing(
        named, [_fired(rows[index]) for index, _ in pairs], dated, known_s if known_s is not None else offset_s
    )
    changed = _changed_card([group.main for group in found], same, had)
    return Proposal(
        tuple(sorted(pairs, key=lambda pair: pair[0])),
        reasons,
        (*changed, *matched.doubts, *off),
        matched.shots,
        tuple(name for name in nobodys if name not in same),
        len(known) + sum(name in same for name in nobodys),
        offset_s,
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
        turns, before = recorded_vehicles(reader), recorded_doubt(reader)
    log = folder.telemetry if folder.telemetry.is_file() else None
    telemetry = RecordedTelemetry(settings, log, {}, turns, doubt=before)
    frames: list[Frame] = []
    zooms: list[Finding] = []
    companions = 0
    root = flight.resolve().parent  # of the flight itself, whatever link leads to it
    zoom = Zoom()
    with ExitStack() as stack:
        stack.enter_context(FlightsLock(root, "picks up files into"))
        index = stack.enter_context(ImageIndex(root))
        stack.enter_context(seals.reopened(folder, clock, seals.Occasion.PICKUP, key))
        ledger = stack.enter_context(Ledger(folder.ledger, clock))
        recorder = Recorder(folder, ledger)
        stack.callback(recorder.close)
        for one in proposal.findings:
            if one.code is Code.CARD_CHANGED:
                ledger.add_event(NOTICED, one)
        for number, group in proposal.pairs:
            frame = _record(recorder, source, number, group.main, clock.utc_ns())
            found = finding(Code.FRAME_PICKED_UP, FRAME, file=group.main.name, why=proposal.reasons[number])
            ledger.add_event("picked up", found, number)
            doubt = next((one for one in proposal.doubts if one.subject == Subject("frame", number)), None)
            if doubt is not None:
                ledger.add_event(DOUBT, doubt, number)
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
            mask = names.get("mask", "")
            ledger.add_tag(tagging.tag(frame, exposure, facts_of, camera=camera, mask=mask, pose=pose, doubt=doubt))
            index.put(IndexEntry(number, folder.name, frame.name, "safe"))
            if zoomed := zoom.look(number, facts_of.focal_length_mm):
                zooms.append(zoomed)
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


def _taken_s(path: Path) -> float | None:
    """When a recorded frame was taken by the body's clock; None where it has no time, or is elsewhere now."""
    try:
        with open(path, "rb", opener=durable.plain_file) as file:
            return matching.seconds(read_exif(file).taken)
    except OSError:
        return None


def _offset(anchors: list[tuple[float | None, FiredShot]]) -> float | None:
    offsets = [taken_s - shot.fired_s for taken_s, shot in anchors if taken_s is not None]
    return median(offsets) if offsets else None


def _same(
    source: FileSource,
    found: list[FoundFile],
    had: Mapping[str, tuple[int, Frame | None]],
    progress: Callable[[int], Any],
) -> dict[str, Frame | None]:
    """The files whose bytes the flight has, by name, with the frame that they are; None for a stray.

    `had`: size and frame by hash. Only files of a size that it has are read. Raises CameraError.
    """
    sizes = {size for size, _ in had.values()}
    same = {}
    for one in found:
        if one.size in sizes:
            sha256 = _sha256(source, one)
            progress(one.size)
            if sha256 in had:
                same[one.name] = had[sha256][1]
    return same


def _sha256(source: FileSource, found: FoundFile) -> str:
    with closing(source.open(found)) as blob:
        try:
            return durable.hash_descriptor(blob.fd, blob.size)
        except (OSError, EOFError) as error:
            raise CameraError(f"{found.name} can't be read: {error}") from error


def _changed_card(found: list[FoundFile], same: Mapping[str, Frame | None], had: list[Frame]) -> list[Finding]:
    """That this card isn't the one which files came from: it has other bytes under their names, and not theirs."""
    here = {row.sha256 for row in same.values() if row is not None}
    names = {row.camera_name.lower() for row in had if row.sha256 not in here}
    other = [one.name for one in found if one.name not in same and one.base.lower() in names]
    return [finding(Code.CARD_CHANGED, Subject("card"), pictures=len(other), first=other[0])] if other else []


def _chosen(
    choice: Choice, fresh: list[FileGroup], known: Mapping[str, Frame], rows: Mapping[int, ShotRow]
) -> dict[int, FileGroup]:
    chosen: dict[int, FileGroup] = {}
    for index, name in choice.pairs.items():
        row = rows.get(index)
        if row is None or row.state == "safe":
            raise CallError(f"--pair {index}={name}: shot {index} {'has its frame' if row else 'is not in the flight'}")
        if row.fired_called_monotonic_ns is None:
            why = "" if row.reason is None else f": {text(row.reason)}"
            raise CallError(f"--pair {index}={name}: shot {index} never fired, according to the flight{why}")
        fitting = [group for group in fresh if name in (group.main.name, group.main.base)]
        frames = [frame.index for full, frame in known.items() if name in (full, full.rpartition("/")[2])]
        if frames and not fitting:
            raise CallError(f"--pair {index}={name}: its bytes are the frame of shot {frames[0]} already")
        if len(fitting) != 1:
            raise CallError(f"--pair {index}={name}: {len(fitting)} new files have this name; give the full name")
        if (other := next((one for one, group in chosen.items() if group is fitting[0]), None)) is not None:
            raise CallError(f"--pair {index}={name}: the same file is named for shot {other}; a file has one shot")
        chosen[index] = fitting[0]
    return chosen


def _matched(shots: list[FiredShot], files: list[DatedFile], choice: Choice, offset_s: float | None) -> Matching:
    if choice.by_order:
        pairs = matching.in_order(shots, files)
        if pairs is None:
            raise CallError(
                f"--by-order needs as many files as shots: {counted(len(shots), 'shot')}, {counted(len(files), 'file')}"
            )
        return Matching(pairs, (), (), tuple(_against(files)))
    plausible_s = math.inf if choice.any_clock else PLAUSIBLE_S
    matched = matching.match(shots, files, offset_s=offset_s, plausible_s=plausible_s)
    if matched.pairs or offset_s is None or choice.offset_s is not None:
        return matched
    return matching.match(shots, files, plausible_s=plausible_s)  # the camera's clock may have been set: a doubt


def _against(files: list[DatedFile]) -> list[Finding]:
    """Where the order of names contradicts the times most."""
    against = matching.by_time(files).against
    if against is None:
        return []
    before, name, earlier_s = against
    return [finding(Code.PICTURE_NAMES_DISAGREE, Subject("picture", name), before=before, earlier_s=earlier_s)]


def _record(recorder: Recorder, source: FileSource, index: int, found: FoundFile, utc_ns: int) -> Frame:
    with closing(source.open(found)) as blob:
        return recorder.record(index, found.base, blob, arrived_utc_ns=utc_ns)


def _accompany(recorder: Recorder, source: FileSource, index: int, found: FoundFile, utc_ns: int) -> None:
    with closing(source.open(found)) as blob:
        recorder.record_companion(index, found.base, blob, arrived_utc_ns=utc_ns)


def _settings(path: Path) -> ExposureSettings:
    try:
        return reading.read_metadata(path)
    except DappledError:
        return ExposureSettings()  # an unreadable frame is still recorded
