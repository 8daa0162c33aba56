"""Give frames the positions of their camera marks: match marks with shots, check them, apply them."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from datetime import UTC, datetime
from pathlib import Path
from statistics import median

import numpy as np

from dappled.decode.geometry import Gnss, Vector3, camera_pose, metres_per_radian
from dappled.errors import DappledError, counted
from dappled.findings import Code, Finding, Subject, finding, told
from dappled.flight import LedgerReader, ShotRow, Tag, TimeSource, layout
from dappled.products.geotags import pos_file
from dappled.products.geotags.mark_matching import MarkPairs, TimedShot, pair
from dappled.products.geotags.pos_file import Mark
from dappled.products.maps.earth import Geoid
from dappled.shown import few

_CONTACT_SIGMA_NS = 1_000_000  # contact bounce and shutter: as for the autopilot's hot shoe
_BOUNCE_NS = 50_000_000
_PLAUSIBLE_S = 26 * 3600.0  # a time zone, and a clock that was set by hand
_SOME = 0.6  # share of shots or marks that must be paired
_LEAST_PAIRS = 3  # for a match without the time
MARKS = Subject("marks")
_OFFSET_S = 0.15  # a larger offset of the clocks is a doubt, if it isn't explained by the shots' sigmas
_EPOCH_NS, _EPOCHS, _EPOCH_SHARE = (
    50_000_000,
    5,
    0.9,
)  # receivers give epochs on a grid of 0.05 s; marks come at any time
_FAR_M = 50.0
_VERTICAL_M = 15.0  # a geoid left out is more, nearly everywhere; an autopilot's height is better
_SIGMAS, _LEAST_OUT_M, _AUTOPILOT_SIGMA_M = 5.0, 5.0, 3.0
_NAMED = 8
_FIXES = {1: 6, 2: 5, 3: 4, 4: 4, 5: 3, 6: 8}  # RTKLIB's Q → MAVLink's GPS_FIX_TYPE


@dataclass(frozen=True, slots=True)
class Marked:
    """The marks of a flight's frames by image index, and what was found.

    `lost`: frames without a mark. `extra`: marks without a frame. `offset_s`: the flight's clock minus
    the marks' time (median), `spread_s` how far a mark's time is from that. `shift_m`: the marks minus the autopilot's
    positions, (north, east, up), medians; None where none has both. `arm_m` goes from the autopilot's antenna to the
    marks' (forward, right, down): positions are moved back by it, so that one lever arm leads to the camera.
    """

    marks: Mapping[int, Mark]
    above_geoid: bool
    lost: tuple[int, ...]
    extra: tuple[Finding, ...]
    doubts: tuple[Finding, ...]
    offset_s: float
    spread_s: float
    shift_m: Vector3 | None
    arm_m: Vector3 = (0.0, 0.0, 0.0)

    def tag(self, tag: Tag, geoid: Geoid | None) -> Tag:
        """The tag with time and position of the frame's mark, at mid-exposure; as it is where the frame has none.

        The attitude stays the autopilot's. Raises EarthError."""
        mark = self.marks.get(tag.index)
        return tag if mark is None else _applied(tag, mark, None if self.above_geoid else geoid, self.arm_m)


def find(flight: Path, path: Path, geoid: Geoid | None, arm_m: Vector3 = (0.0, 0.0, 0.0)) -> Marked:
    """Match the marks of a .pos file with the shots of a flight. `arm_m` goes from the autopilot's antenna to the
    marks' (see `Marked`). Raises DappledError, DappledError, FlightError."""
    found = pos_file.read(path)
    if geoid is None and not found.above_geoid:
        raise DappledError(
            f"the heights in {path} are above the ellipsoid, and no geoid grid is on this machine: install Debian's "
            "proj-data, or say with --geoid how many metres mean sea level is above the ellipsoid here"
        )
    _not_epochs(path, found.marks)
    with LedgerReader.open(layout.open_folder(flight).ledger) as ledger:
        tags, rows, correction_ns = ledger.tags(), ledger.shots(), ledger.utc_correction_ns()
    if not tags:
        raise DappledError(f"no frame of {flight} is tagged: there is nothing to match with {path}")
    shots = _shots(rows, tags, correction_ns or 0)
    heard, bounced = _without_bounces(found.marks)
    matched, doubts = _matched(path, heard, shots, utc_known=correction_ns is not None)
    paired = {shots[i].index: heard[j] for i, j in matched.pairs}
    late_s = {shot.index: shot.begins_s - paired[shot.index].utc_ns / 1e9 for shot in shots if shot.index in paired}
    taken = {mark.number for mark in paired.values()}
    geoid = None if found.above_geoid else geoid
    marks, shift_m, far = _placed(path, {index: one for index, one in paired.items() if index in tags}, tags, geoid)
    free = (one for one in heard if one.number not in taken)
    extra = [finding(Code.MARK_OF_NO_SHOT, _mark(one), at=_clock(one)) for one in free]
    extra += [finding(Code.MARK_OF_NO_FRAME, _mark(one), shot=n) for n, one in paired.items() if n not in tags]
    return Marked(
        marks,
        found.above_geoid,
        tuple(index for index in sorted(tags) if index not in marks),
        (*extra, *bounced),
        (*found.doubts, *doubts, *_solutions(marks), *far, *_unmoved(marks, tags, arm_m)),
        matched.offset_s,
        max(abs(one - matched.offset_s) for one in late_s.values()),
        shift_m,
        arm_m,
    )


def sentences(marked: Marked) -> list[str]:
    """What a person should know of the matching of marks and frames."""
    times = f"times agree within {1e3 * marked.spread_s:.1f} ms after {1e3 * marked.offset_s:+.1f} ms"
    lines = [f"{counted(len(marked.marks), 'frame')} placed by a mark; {times}"]
    if marked.shift_m:
        north, east, up = marked.shift_m
        lines.append(f"marks less autopilot (median): {north:+.2f} m north, {east:+.2f} m east, {up:+.2f} m up")
    lines += few(f"frame {index} has no mark: it keeps the autopilot's position" for index in marked.lost)
    for code in dict.fromkeys(one.code for one in marked.extra):
        lines += few(str(told(one)) for one in marked.extra if one.code is code)
    return lines


def _mark(mark: Mark) -> Subject:
    return Subject("mark", mark.number)


def _shots(rows: Sequence[ShotRow], tags: Mapping[int, Tag], correction_ns: int) -> list[TimedShot]:
    """The shots that fired, in the order of their exposures."""
    usual_s = float(median(tag.utc_sigma_ns for tag in tags.values())) / 1e9
    shots = []
    for row in rows:
        tag = tags.get(row.shot.index)
        if tag is not None:
            begins_ns, sigma_s = tag.utc_ns - _half_ns(tag), tag.utc_sigma_ns / 1e9
        elif row.fired_called_monotonic_ns is not None:
            begins_ns = row.fired_called_monotonic_ns + row.shot.wished_utc_ns - row.shot.wished_monotonic_ns
            sigma_s = max(0.1, usual_s)  # the body's latency is not added
        else:
            continue
        shots.append(TimedShot(row.shot.index, (begins_ns + correction_ns) / 1e9, sigma_s))
    return sorted(shots, key=lambda shot: (shot.begins_s, shot.index))


def _without_bounces(marks: Sequence[Mark]) -> tuple[list[Mark], list[Finding]]:
    """The marks without those that follow another at once, and each of these."""
    heard: list[Mark] = []
    bounced = []
    for mark in marks:
        after_ns = mark.utc_ns - heard[-1].utc_ns if heard else _BOUNCE_NS
        if after_ns < _BOUNCE_NS:
            after = finding(Code.MARK_BOUNCED, _mark(mark), after_ms=after_ns / 1e6, before=heard[-1].number)
            bounced.append(after)
        else:
            heard.append(mark)
    return heard, bounced


def _matched(
    path: Path, marks: Sequence[Mark], shots: Sequence[TimedShot], *, utc_known: bool
) -> tuple[MarkPairs, list[Finding]]:
    """The pairs by time, count and interval, with doubts. Raises DappledError."""
    times_s = [mark.utc_ns / 1e9 for mark in marks]
    if abs(shots[len(shots) // 2].begins_s - times_s[len(times_s) // 2]) > _PLAUSIBLE_S:
        days = [datetime.fromtimestamp(s, UTC).strftime("%Y-%m-%d") for s in (times_s[0], shots[0].begins_s)]
        raise DappledError(
            f"the marks in {path} are of {days[0]}, the flight of {days[1]}: give the file of this flight"
        )
    matched = pair(shots, times_s, utc_known=utc_known, most_s=_PLAUSIBLE_S)
    usual_s = float(median(shot.sigma_s for shot in shots))
    by_time = utc_known and abs(matched.offset_s) <= max(_OFFSET_S, 6 * usual_s)
    enough = max(1 if by_time else _LEAST_PAIRS, _SOME * min(len(shots), len(marks)))
    if not matched.certain or len(matched.pairs) < enough:
        raise DappledError(
            f"{counted(len(marks), 'mark')} of {path} and {counted(len(shots), 'shot')}: neither their times nor count "
            "and intervals say which belong together; is it the file of this flight?"
        )
    if by_time:
        return matched, []
    off = finding(Code.MARKS_OFF_SHOTS, MARKS, by_s=-matched.offset_s)
    return matched, [
        finding(Code.MARKS_UNTIMED, MARKS, why=off if utc_known else finding(Code.TIME_NEVER_KNOWN, MARKS))
    ]


def _not_epochs(path: Path, marks: Sequence[Mark]) -> None:
    """Raises DappledError for the file of all epochs in place of the events'."""
    on_grid = sum(min(mark.utc_ns % _EPOCH_NS, -mark.utc_ns % _EPOCH_NS) <= 1000 for mark in marks)
    if len(marks) >= _EPOCHS and on_grid > _EPOCH_SHARE * len(marks):
        raise DappledError(
            f"{path} holds {len(marks)} positions at a receiver's even times, the whole track and not the camera's "
            "marks: give the file of events that was written beside it (…_events.pos)"
        )


def _solutions(marks: Mapping[int, Mark]) -> list[Finding]:
    """The marks that are not fixed."""
    worse = [f"{mark.number} (frame {n}, {mark.solution})" for n, mark in marks.items() if mark.quality != 1]
    more = ", …" if len(worse) > _NAMED else ""
    if not worse:
        return []
    which = f"{', '.join(worse[:_NAMED])}{more}"
    return [finding(Code.MARKS_NOT_FIXED, MARKS, worse=len(worse), marks=len(marks), which=which)]


def _unmoved(marks: Mapping[int, Mark], tags: Mapping[int, Tag], arm_m: Vector3) -> list[Finding]:
    """Frames whose mark can't be brought to mid-exposure, or to the other antenna."""
    poses = {index: tags[index].pose for index in marks}
    unknown = sum(tags[index].exposure_s is None or poses[index].velocity_ned_m_s is None for index in marks)
    untold = sum(pose.attitude is None for pose in poses.values()) if any(arm_m) else 0
    told_of = (Code.MARKS_NOT_MOVED, unknown), (Code.MARKS_ARMLESS, untold)
    return [finding(code, MARKS, frames=n) for code, n in told_of if n]


def _placed(
    path: Path, marks: Mapping[int, Mark], tags: Mapping[int, Tag], geoid: Geoid | None
) -> tuple[dict[int, Mark], Vector3 | None, list[Finding]]:
    """The marks that are where the others and the autopilot are, the medians of marks minus autopilot, and doubts: each
    mark that lies elsewhere, and heights. Raises DappledError where all are too far away to be of this flight."""
    steps: dict[int, Vector3] = {}
    for index, mark in marks.items():
        pose = tags[index].pose
        if pose.latitude_rad is None or pose.longitude_rad is None or pose.altitude_msl_m is None:
            continue
        north, east = metres_per_radian(mark.latitude_rad, mark.height_m)
        turn = math.remainder(mark.longitude_rad - pose.longitude_rad, math.tau)
        up = mark.height_m - _undulation_m(mark, geoid) - pose.altitude_msl_m
        steps[index] = ((mark.latitude_rad - pose.latitude_rad) * north, turn * east, up)
    if not steps:
        return dict(marks), None, [finding(Code.MARKS_UNPLACED, MARKS)]
    north_m, east_m, up_m = (float(median(part)) for part in zip(*steps.values(), strict=True))
    if math.hypot(north_m, east_m) > _FAR_M:
        raise DappledError(
            f"the marks in {path} lie {math.hypot(north_m, east_m):,.0f} m from where the autopilot was: are they of "
            "this flight, and were the base's coordinates right and in WGS 84?"
        )
    kept, doubts = dict(marks), []
    for index, (north, east, up) in steps.items():
        pose = tags[index].pose
        sigma_m = math.hypot(pose.position_sigma_m or _AUTOPILOT_SIGMA_M, pose.vertical_sigma_m or _AUTOPILOT_SIGMA_M)
        away_m = math.dist((north, east, up), (north_m, east_m, up_m))
        if away_m > max(_LEAST_OUT_M, _SIGMAS * sigma_m):
            doubts.append(finding(Code.MARK_AWAY, _mark(kept.pop(index)), frame=index, away_m=away_m))
    if abs(up_m) > _VERTICAL_M:
        doubts.append(finding(Code.MARKS_HEIGHTS_DIFFER, MARKS, up_m=up_m))
    return kept, (north_m, east_m, up_m), doubts


def _applied(tag: Tag, mark: Mark, geoid: Geoid | None, arm_m: Vector3) -> Tag:
    half_ns, pose = _half_ns(tag), tag.pose
    velocity = np.array(pose.velocity_ned_m_s or (0.0, 0.0, 0.0))
    moved = velocity * half_ns / 1e9  # from the contact to mid-exposure, and to the autopilot's antenna
    if pose.attitude is not None:
        moved = moved - camera_pose.matrix_of(pose.attitude) @ np.array(arm_m)
    north, east = metres_per_radian(mark.latitude_rad, mark.height_m)
    altitude_m = mark.height_m - _undulation_m(mark, geoid) - float(moved[2])
    height_m = pose.height_above_home_m
    if height_m is not None and pose.altitude_msl_m is not None:
        height_m += altitude_m - pose.altitude_msl_m
    covariance = None
    if mark.covariance_m2 is not None:
        blur = velocity * _CONTACT_SIGMA_NS / 1e9
        pairs = ((0, 0), (0, 1), (0, 2), (1, 1), (1, 2), (2, 2))
        nn, ne, nd, ee, ed, dd = (
            own + float(blur[i] * blur[j]) for own, (i, j) in zip(mark.covariance_m2, pairs, strict=True)
        )
        covariance = (nn, ne, nd, ee, ed, dd)
    placed = replace(
        pose,
        source="mark",
        utc_ns=mark.utc_ns + half_ns,
        latitude_rad=mark.latitude_rad + float(moved[0]) / north,
        longitude_rad=mark.longitude_rad + float(moved[1]) / east,
        altitude_msl_m=altitude_m,
        height_above_home_m=height_m,
        position_sigma_m=None if covariance is None else math.sqrt(covariance[0] + covariance[3]),
        vertical_sigma_m=None if covariance is None else math.sqrt(covariance[5]),
        position_covariance_m2=covariance,
        gnss=Gnss(_FIXES.get(mark.quality, 0), mark.satellites, None, None, None, None, None, half_ns / 1e6),
        age_ms=half_ns / 1e6,
    )
    return replace(
        tag, utc_ns=placed.utc_ns, utc_sigma_ns=_CONTACT_SIGMA_NS, time_source=TimeSource.LOGGED_MARK, pose=placed
    )


def _half_ns(tag: Tag) -> int:
    return round((tag.exposure_s or 0.0) / 2 * 1e9)


def _undulation_m(mark: Mark, geoid: Geoid | None) -> float:
    """The height of the geoid to take off a mark's height; 0 where the file's heights are above it already."""
    if geoid is None:
        return 0.0
    return geoid.undulation_m(math.degrees(mark.latitude_rad), math.degrees(mark.longitude_rad))


def _clock(mark: Mark) -> str:
    return datetime.fromtimestamp(mark.utc_ns / 1e9, UTC).strftime("%H:%M:%S.%f")[:-3] + " UTC"
