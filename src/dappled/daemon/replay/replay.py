"""Replay a recorded flight, or a folder of frames, through the pipeline of a live flight."""

from __future__ import annotations

import math
import threading
from collections import defaultdict
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from datetime import UTC, datetime
from pathlib import Path
from time import sleep

from dappled import __version__, codec, confined, durable, picture_order
from dappled.clock import RecordedClock, TimeOfDayClock
from dappled.config.settings import Settings
from dappled.daemon.navigation import ExposureTime, Telemetry, first_position_utc_ns, recorded_doubt, recorded_vehicles
from dappled.daemon.navigation.samples import PositionDoubt
from dappled.daemon.pipeline import recipes
from dappled.daemon.pipeline.capture import Observer, PendingShot, PendingShots
from dappled.daemon.replay.vehicle_choice import VehicleError, vehicle_of
from dappled.daemon.replay.verifier import Expected, ReplayVerifier, ResultWriter
from dappled.decode.geometry import Pose, Vector3
from dappled.drivers.mavlink import MavlinkMessage, PacketParser
from dappled.drivers.mavlink.own_logs import own_log
from dappled.drivers.raw.raw_file import read_exif
from dappled.drivers.replay import RecordedShot
from dappled.drivers.utc_choice import Date, UtcBounds
from dappled.drivers.wired.matching import seconds
from dappled.errors import CallError, DappledError
from dappled.findings import Code, Finding, Level, Subject, finding, text
from dappled.flight import (
    LIVE,
    Cause,
    FlightFolder,
    Frame,
    LedgerReader,
    Shot,
    ShotRow,
    layout,
    log_reading,
)
from dappled.flight.records import DOUBT, LEFT

_DATED = 8  # frames whose own time is asked
_ZONES_S = 900  # time zones are whole quarters of an hour apart
_AGREES_S = 2.5  # two times of a picture, of which EXIF's has whole seconds
_FAR_M = 10.0  # a receiver alone jumps by less
FRAME_SUFFIXES = (".raf", ".cr2", ".dng", ".tif", ".tiff", ".png", ".npy", ".nef", ".arw", ".jpg", ".jpeg")


@dataclass(frozen=True, slots=True)
class RecordedFlight:
    """What is to be replayed: shots in order with their files, the telemetry beside them, and what was recorded of
    each. `horizons` says how many telemetry packets a frame's pose was made from; `vehicles` whose they were (see
    `Telemetry`); `elsewhere` another platform or other versions that it was recorded with; `findings` what was
    found in a folder of frames; `bounds` which dates of its log can be true."""

    root: Path
    shots: Sequence[Shot]
    files: Sequence[RecordedShot]
    expected: Sequence[Expected]
    telemetry: Path | None
    horizons: dict[int, int]
    vehicles: Sequence[tuple[int, int]] = ()
    elsewhere: str | None = None
    findings: tuple[Finding, ...] = ()
    bounds: UtcBounds | None = None
    doubt: PositionDoubt | None = None


def of_flight(folder: Path, run: str = LIVE) -> RecordedFlight:
    """A recorded flight, with the slices of one run. Raises FlightError when it is not one."""
    flight = layout.open_folder(folder)
    with LedgerReader.open(flight.ledger) as ledger:
        rows = ledger.shots()
        frames = {frame.index: frame for frame in ledger.frames()}
        poses = ledger.poses()
        digests = {table: ledger.digests(table) for table in ("poses", "tags")}
        results = ledger.results(run)
        events = [event for event in ledger.events() if event.index is not None]
        turns, doubt = recorded_vehicles(ledger), recorded_doubt(ledger)
        tags = ledger.tags()
        made_by = ledger.facts().get(f"run:{run}", {}) if run != LIVE else layout.read_facts(flight)
    kinds: dict[int | None, set[str]] = defaultdict(set)
    for event in events:
        kinds[event.index].add(event.kind)
    doubts = {event.index: event.finding for event in events if event.kind == DOUBT}
    left = [(event.index, event.finding) for event in events if event.kind == LEFT]
    undecoded = {index for index, found in left if found and found.code is Code.FRAME_UNDECODED}
    expected, files = [], []
    for row in rows:
        index = row.shot.index
        frame = frames.get(index)
        result = results.get(index)
        expected.append(
            Expected(
                row,
                frame,
                _recorded(digests["poses"], index),
                _recorded(digests["tags"], index),
                None if result is None else result.slices_sha256,
                tags.get(index),
                None if result is None else result.details.get("fingerprint"),
                frozenset(kinds[index]),
                index in undecoded,
            )
        )
        files.append(_file(flight, row, frame, doubts.get(index)))
    if not frames:
        raise DappledError(f"{folder} holds no frames: there is nothing to replay")
    telemetry = flight.telemetry if flight.telemetry.is_file() else None
    horizons = {index: pose.telemetry_packets for index, pose in poses.items()}
    elsewhere = _elsewhere(made_by.get("software", {}))
    shots = [row.shot for row in rows]
    return RecordedFlight(folder, shots, files, expected, telemetry, horizons, turns, elsewhere, doubt=doubt)


def _elsewhere(recorded: Mapping[str, str]) -> str | None:
    """Platform and versions that a flight was recorded with, where they are others than here or unknown; None where
    they are the same."""
    if "machine" not in recorded:
        return "a platform that the flight does not name"
    here = {"dappled": __version__, **recipes.versions()}
    others = [name for name, value in recorded.items() if here.get(name, value) != value]
    if not others:
        return None
    words = [recorded[name] if name in ("machine", "processor") else f"{name} {recorded[name]}" for name in others]
    return ", ".join(word for word in words if word) or "another processor"


def of_folder(
    folder: Path,
    match: str,
    telemetry: Path | None,
    start_utc_ns: int | None,
    interval_s: float,
    *,
    vehicle: int | None = None,
    now_ns: int | None = None,
) -> RecordedFlight:
    """Frames in a folder, in the order of their EXIF's times or else of their names; the first at `start_utc_ns` (None:
    the telemetry's first position, or 1970 without telemetry), the others at `interval_s` after each other; where EXIF
    contradicts that, the telemetry's positions are in doubt. A single
    .tlog (or, without one, a single .bin of ArduPilot or .ulg of PX4) in the folder is the telemetry, where none is
    named. `vehicle`: the system id of the one whose telemetry counts (see `vehicle_of`). `now_ns`: no log is of a
    later time."""
    if telemetry is not None and not telemetry.is_file():
        raise CallError(f"{telemetry}: there is no such telemetry file; check --telemetry")
    telemetry = telemetry or _only_log(folder)
    if Path(match).is_absolute():
        raise CallError(f"--match {match} names another folder: give a pattern of names in {folder}")
    named = [path for path in folder.glob(match) if path.suffix.lower() in FRAME_SUFFIXES and path.is_file()]
    taken_s = {path: _taken_s(path) for path in named}
    ordered = picture_order.by_time(named, Path.as_posix, taken_s.get)
    paths = ordered.items
    if not paths:
        raise CallError(f"no frame in {folder} matches {match!r}; frames end in {', '.join(FRAME_SUFFIXES)}")
    system, told = _vehicle(telemetry, vehicle)
    times_s = [taken_s[path] for path in paths]
    bounds = _bounds(times_s, start_utc_ns, TimeOfDayClock().utc_ns() if now_ns is None else now_ns)
    given = start_utc_ns is not None
    if start_utc_ns is None:
        start_utc_ns = _first_position_utc_ns(telemetry, bounds, system) if telemetry else 0
        if telemetry and not own_log(telemetry) and bounds.judge(start_utc_ns) is not Date.TRUE:
            said = datetime.fromtimestamp(start_utc_ns // 10**9, UTC).strftime("%Y-%m-%d %H:%M")
            told.append(finding(Code.LOG_STAMPS_UNSET, Subject("log", str(telemetry)), utc=said))
    elif telemetry is not None and own_log(telemetry):
        next(packets(telemetry, bounds=bounds), None)  # one that can't be used is refused before all else
    shots, files, expected = [], [], []
    for index, path in enumerate(paths):
        utc_ns = start_utc_ns + round(index * interval_s * 1e9)
        shot = Shot(index, Cause("replay", path.name), utc_ns, utc_ns)
        try:
            name = path.relative_to(folder).as_posix()
            confined.parts(name, folder, f"the pattern {match!r}")
            frame = Frame(index, name, path.name, path.stat().st_size, durable.hash_file(path), utc_ns)
        except OSError as error:
            raise DappledError(f"{path} can't be read: {error.strerror}") from None
        shots.append(shot)
        files.append(RecordedShot(index, path, path.name, (utc_ns, utc_ns), utc_ns))
        expected.append(Expected(ShotRow(shot, "safe", None, utc_ns, utc_ns), frame))
    if telemetry is not None and (away := _away_s(times_s, [shot.wished_utc_ns for shot in shots], given=given)):
        place, off_s = away
        told.append(finding(Code.PICTURE_TIME_DISAGREES, Subject("picture", paths[place].name), off_s=off_s))
    found = tuple(told)
    if ordered.against is not None:  # the better evidence decides
        before, name, earlier_s = ordered.against
        code, subject = Code.PICTURE_NAMES_DISAGREE, Subject("picture", Path(name).name)
        found = (*found, finding(code, subject, Level.NOTE, before=Path(before).name, earlier_s=earlier_s))
    vehicles = [] if system is None else [(0, system)]
    return RecordedFlight(folder, shots, files, expected, telemetry, {}, vehicles, findings=found, bounds=bounds)


def _vehicle(telemetry: Path | None, vehicle: int | None) -> tuple[int | None, list[Finding]]:
    """Whose telemetry counts, and what is to be said of it. Raises VehicleError and DappledError."""
    if telemetry is not None and own_log(telemetry) is None:
        return vehicle_of(telemetry, vehicle)
    if vehicle is not None:
        why = "there is no telemetry" if telemetry is None else "there is no other vehicle in an autopilot's own log"
        raise VehicleError(f"--vehicle is for a .tlog: {why}; leave it out")
    return None, []


def _away_s(taken_s: Sequence[float | None], placed_ns: Sequence[int], *, given: bool) -> tuple[int, float] | None:
    """Which picture's own time contradicts most the time that it was placed at, and by how much: a camera's clock has
    no zone, and may be wrong throughout where a person has `given` the first picture's time. None where all agree."""
    away = [(place, own_s - placed_ns[place] / 1e9) for place, own_s in enumerate(taken_s) if own_s is not None]
    if not away:
        return None
    first_s = away[0][1]
    begins_s = 0.0 if given else math.remainder(first_s, _ZONES_S)
    worst = max(((place, begins_s + off_s - first_s) for place, off_s in away), key=lambda one: abs(one[1]))
    return worst if abs(worst[1]) > _AGREES_S else None


def _bounds(taken_s: Sequence[float | None], start_utc_ns: int | None, now_ns: int) -> UtcBounds:
    """Which dates of a log beside these frames can be true: their own tell, and that of the first by the user."""
    taken = [round(own_s * 1e9) for own_s in taken_s[:_DATED] if own_s is not None]
    return UtcBounds.of_log(now_ns, [*taken, *([] if start_utc_ns is None else [start_utc_ns])])


def _taken_s(path: Path) -> float | None:
    try:
        with open(path, "rb", opener=durable.plain_file) as file:
            return seconds(read_exif(file).taken)
    except OSError as error:
        raise DappledError(f"{path} can't be read: {error.strerror}") from None


def _only_log(folder: Path) -> Path | None:
    logs = sorted(folder.glob("*.tlog"))
    kind = ".tlog"
    if not logs:
        kind = "autopilots' own log"
        named = [*folder.glob("*.[bB][iI][nN]"), *folder.glob("*.[uU][lL][gG]")]
        logs = sorted(path for path in named if path.is_file() and own_log(path))
    if len(logs) > 1:
        raise CallError(f"{folder} holds {len(logs)} {kind} files: say which with --telemetry")
    return logs[0] if logs else None


@dataclass(slots=True)
class _Gap:
    """What is missing in a log, after and before which stamps (None: not read yet, or to its end), and how many frames
    were exposed there."""

    told: Finding
    after_ns: int | None = None
    before_ns: int | None = None
    frames: int = 0

    def finding(self) -> Finding:
        """It is no more than a note where no frame needs what is missing."""
        level = self.told.level if self.frames else Level.NOTE
        return replace(self.told, level=level, facts={**self.told.facts, "frames": self.frames})


class RecordedTelemetry:
    """Poses from a telemetry file, fed packet by packet just as far as each frame's pose was made from."""

    def __init__(
        self,
        settings: Settings,
        path: Path | None,
        horizons: dict[int, int],
        vehicles: Sequence[tuple[int, int]] = (),
        *,
        report: Callable[[Finding], object] = lambda _: None,
        bounds: UtcBounds | None = None,
        doubt: PositionDoubt | None = None,
    ) -> None:
        """`settings`, `vehicles` and `doubt` are those that the recording daemon had. `report` gets what is to be said
        of the log."""
        self._horizons, self._wait_ns = horizons, round(settings.pose.wait_ms * 1e6)
        self._telemetry = Telemetry(
            vehicles=vehicles,
            component_id=settings.mavlink.component_id,
            cam_idx=settings.mavlink.cam_idx,
            attitude_sigma_rad=math.radians(settings.pose.attitude_sigma_deg),
            doubt=doubt,
        )
        self._path, self._report = path, report
        self._packets = packets(path, self._found, bounds) if path else iter(())
        self._fed = self._last_ns = 0
        self._gaps: list[_Gap] = []
        self._of_folder = bounds is not None
        self._unplaced, self._jump_m = 0, 0.0

    def pose(self, index: int, exposure: ExposureTime) -> tuple[ExposureTime, Pose]:
        """When and where a frame was exposed (see `Pipeline`); frames come in the order of their exposure."""
        horizon = self._horizons.get(index)
        while horizon is None or self._fed < horizon:
            if horizon is None and self._telemetry.settled(exposure):
                break
            packet = next(self._packets, None)
            if packet is None:
                for gap in self._gaps:
                    gap.after_ns = self._last_ns if gap.after_ns is None else gap.after_ns
                break
            number, stamp_us, message = packet
            self._telemetry.feed(number, stamp_us, message)
            self._fed, self._last_ns = number + 1, stamp_us * 1000
            for gap in self._gaps:
                if gap.after_ns is not None and gap.before_ns is None:
                    gap.before_ns = self._last_ns
            if horizon is None and self._last_ns > exposure.utc_ns + self._wait_ns:
                break
        for gap in self._gaps:
            within = gap.after_ns is not None and gap.after_ns < exposure.utc_ns
            gap.frames += within and (gap.before_ns is None or exposure.utc_ns < gap.before_ns)
        time, pose = self._telemetry.locate(exposure, upto_packet=horizon)
        self._unplaced += pose.latitude_rad is None
        for one in self._telemetry.doubts():
            if one.code is Code.POSITION_JUMPED and isinstance(by_m := one.facts["by_m"], float):
                self._jump_m = max(self._jump_m, by_m)
        return time, pose

    def rates(self, pose: Pose) -> Vector3 | None:
        return self._telemetry.rates(pose)

    def findings(self) -> list[Finding]:
        """What is to be said of what was fed, and of what is missing in the log."""
        gaps = sorted((gap.finding() for gap in self._gaps), key=lambda one: -one.level)
        count, subject = self._telemetry.statistics().impossible, Subject("log", str(self._path))
        if count:
            gaps.append(finding(Code.LOG_MESSAGES_IMPOSSIBLE, subject, messages=count))
        if self._of_folder and self._path and self._unplaced:  # of a flight these are told beside each frame
            gaps.append(finding(Code.LOG_FRAMES_UNPLACED, subject, frames=self._unplaced))
        if self._of_folder and self._jump_m:
            level = Level.CAUTION if self._jump_m > _FAR_M else Level.NOTE
            gaps.append(finding(Code.POSITION_JUMPED, subject, level, by_m=self._jump_m))
        return gaps

    def _found(self, one: Finding) -> None:
        """Report what was found in the log; of a gap the frames decide how much it weighs."""
        if one.code is Code.LOG_BYTES_SKIPPED:
            self._gaps.append(_Gap(one, after_ns=self._last_ns))
        elif one.code is Code.LOG_CUT_SHORT:
            self._gaps.append(_Gap(one))
        else:
            self._report(one)


class ReplayProgress(Observer):
    """Counts the shots of a replay that have ended: frames, and frames with a problem. `tell` is told of each."""

    def __init__(self, tell: Callable[[PendingShot], object] = lambda _: None) -> None:
        """`tell` may raise OSError, which ends the replay."""
        self._tell = tell
        self._ended = threading.Semaphore(0)
        self._untold: OSError | None = None
        self.frames = self.bad = 0

    def finished(self, pending: PendingShot) -> None:
        """Nothing more is expected of a shot."""
        try:
            self._tell(pending)
        except OSError as error:  # whom it is told has gone
            self._untold = error
        self.frames += pending.frame is not None
        self.bad += bool(pending.problem) and pending.frame is not None
        self._ended.release()

    def await_end(self, shot: Shot, timeout_s: float) -> None:
        """Wait until one more shot has ended. Raises DappledError where none does, and what `tell` raised."""
        if not self._ended.acquire(timeout=timeout_s):
            raise DappledError(f"shot {shot.index} did not come to an end within {timeout_s:g} s")
        self.check()

    def check(self) -> None:
        """Raise what `tell` raised."""
        if self._untold is not None:
            raise self._untold


Pace = Callable[[Shot, Shot | None], None]  # waits between the shot before (None for the first) and this one


def as_recorded(rate: float, sleep: Callable[[float], None] = sleep) -> Pace:
    """The intervals of the flight, `rate` times as fast."""

    def wait(shot: Shot, before: Shot | None) -> None:
        if before is not None:
            sleep(max(0, shot.wished_utc_ns - before.wished_utc_ns) / 1e9 / rate)

    return wait


def clock(recording: RecordedFlight) -> RecordedClock:
    """The recording's clock, at its first capture request."""
    first = recording.shots[0]
    return RecordedClock(first.wished_utc_ns, first.wished_utc_ns - first.wished_monotonic_ns)


def play(
    recording: RecordedFlight,
    shots: PendingShots,
    progress: ReplayProgress,
    *,
    time: RecordedClock,
    pace: Pace | None,
    timeout_s: float = 120.0,
) -> None:
    """Play every shot at its recorded time. Without a pace each waits for the one before, so that none is dropped."""
    before: Shot | None = None
    for shot in recording.shots:
        if pace:
            pace(shot, before)
        time.advance_to(shot.wished_utc_ns)
        shots.fire(shot)
        if pace is None:
            progress.await_end(shot, timeout_s)
        progress.check()
        before = shot
    if pace:
        for shot in recording.shots:
            progress.await_end(shot, timeout_s)


def verifier(recording: RecordedFlight, keep: ResultWriter | None = None) -> ReplayVerifier:
    """A writer that compares a replay with this recording; `keep` takes results that are not to be compared."""
    return ReplayVerifier(recording.root, recording.expected, keep, elsewhere=recording.elsewhere)


def _file(folder: FlightFolder, row: ShotRow, frame: Frame | None, doubt: Finding | None) -> RecordedShot:
    called, returned = row.fired_called_monotonic_ns, row.fired_returned_monotonic_ns
    fired = None if called is None or returned is None else (called, returned)
    if frame is None:
        return RecordedShot(
            row.shot.index, None, "", fired, reason=str(text(row.reason)) if row.reason else "no frame was recorded"
        )
    arrived_ns = frame.arrived_utc_ns - row.shot.wished_utc_ns + row.shot.wished_monotonic_ns
    facts = {} if doubt is None else {"doubt": codec.plain(doubt)}
    return RecordedShot(row.shot.index, folder.file(frame.name), frame.camera_name, fired, arrived_ns, facts=facts)


def _recorded(digests: dict[int, tuple[str, str]], index: int) -> str | None:
    found = digests.get(index)
    return None if found is None else found[0]


def packets(
    path: Path, report: Callable[[Finding], object] = lambda _: None, bounds: UtcBounds | None = None
) -> Iterator[tuple[int, int, MavlinkMessage]]:
    """The messages of a .tlog or of an autopilot's own log. Raises FlightError and AutopilotLogError."""
    decoder, reader = PacketParser(), own_log(path)
    logged = log_reading.read_telemetry(path, report) if reader is None else reader.packets(path, report, bounds)
    for number, stamp_us, raw in logged:
        message = decoder(raw)
        if message is not None:  # a packet with a wrong checksum was never acted on either
            yield number, stamp_us, message


def _first_position_utc_ns(path: Path, bounds: UtcBounds, system: int | None) -> int:
    heard = packets(path, bounds=bounds)
    mine = (one for one in heard if system is None or one[2].get_srcSystem() == system)
    utc_ns = first_position_utc_ns(mine)
    if utc_ns is None:
        raise DappledError(f"{path} holds no position: give --start, the time of the first frame")
    return utc_ns
