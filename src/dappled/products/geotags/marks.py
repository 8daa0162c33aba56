"""Give frames the positions of their camera marks: match marks with shots, check them, apply them."""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from datetime import UTC, datetime
from itertools import pairwise
from pathlib import Path
from statistics import median

from dappled.decode.geometry import Gnss, Pose, metres_per_radian
from dappled.drivers.wired.matching import PLAUSIBLE_S, DatedFile, FiredShot, Matching, match
from dappled.errors import DappledError, counted
from dappled.flight import LedgerReader, Tag, layout
from dappled.products.geotags import pos_file
from dappled.products.geotags.pos_file import Mark, PosFile
from dappled.products.maps.earth import Geoid

MARK_SOURCE = "GNSS mark"
_CONTACT_SIGMA_NS = 1_000_000  # contact bounce and shutter: as for the autopilot's hot shoe
_LEAST_WINDOW_S, _MOST_WINDOW_S = 0.06, 0.6
_SIGMAS = 6
_SOME = 0.8  # share of marks that intervals alone must explain
_LEAST_PAIRS = 3  # for a match without the time
_EPOCHS = 3  # as many marks a shot and more, evenly spaced, are all epochs of a track
_FAR_M = 50.0
_VERTICAL_M = 15.0  # a geoid left out is more, nearly everywhere; an autopilot's height is better
_FIXES = {1: 6, 2: 5, 3: 4, 4: 4, 5: 3, 6: 8}  # RTKLIB's Q → MAVLink's GPS_FIX_TYPE


class MarksError(DappledError):
    """Marks can't be matched with a flight's shots; one sentence."""


@dataclass(frozen=True, slots=True)
class Marked:
    """The marks of a flight's frames by image index, and what was found.

    `lost`: frames without a mark. `extra`: sentences about marks without a frame. `offset_s`: the flight's clock minus
    the marks' time (median), `spread_s` how far a mark's time is from that. `shift_m`: the marks minus the autopilot's
    positions, (north, east, up), medians; None where none has both.
    """

    marks: Mapping[int, Mark]
    above_geoid: bool
    lost: tuple[int, ...]
    extra: tuple[str, ...]
    doubts: tuple[str, ...]
    offset_s: float
    spread_s: float
    shift_m: tuple[float, float, float] | None

    def tag(self, tag: Tag, geoid: Geoid | None) -> Tag:
        """The tag with time and position of the frame's mark, at mid-exposure; as it is where the frame has none.

        The attitude stays the autopilot's. Raises EarthError."""
        mark = self.marks.get(tag.index)
        return tag if mark is None else _applied(tag, mark, None if self.above_geoid else geoid)


def find(flight: Path, path: Path, geoid: Geoid | None) -> Marked:
    """Match the marks of a .pos file with the shots of a flight. Raises MarksError, PosError, FlightError."""
    found = pos_file.read(path)
    if geoid is None and not found.above_geoid:
        raise MarksError(
            f"the heights in {path} are above the ellipsoid, and no geoid grid is on this machine: install Debian's "
            "proj-data, or say with --geoid how many metres mean sea level is above the ellipsoid here"
        )
    with LedgerReader.open(layout.open_folder(flight).ledger) as ledger:
        tags, rows, correction_ns = ledger.tags(), ledger.shots(), ledger.utc_correction_ns()
    if not tags:
        raise MarksError(f"no frame of {flight} is tagged: there is nothing to match with {path}")
    shots = []
    for row in rows:
        tag = tags.get(row.shot.index)
        if tag is not None:
            begins_ns = tag.utc_ns - _half_ns(tag)
        elif row.fired_called_monotonic_ns is not None:
            begins_ns = row.fired_called_monotonic_ns + row.shot.wished_utc_ns - row.shot.wished_monotonic_ns
        else:
            continue
        shots.append(FiredShot(row.shot.index, (begins_ns + (correction_ns or 0)) / 1e9))
    _not_epochs(path, found.marks, len(shots))
    matched, doubts = _matched(path, found, shots, _window_s(tags.values()), utc_known=correction_ns is not None)
    by_name = {str(mark.number): mark for mark in found.marks}
    paired = {index: by_name[name] for index, name in matched.pairs}
    marks = {index: mark for index, mark in paired.items() if index in tags}
    shift_m, far = _shift(path, marks, tags, None if found.above_geoid else geoid)
    began_s = {shot.index: shot.fired_s for shot in shots}
    late_s = [began_s[index] - mark.utc_ns / 1e9 for index, mark in paired.items()]
    middle_s = median(late_s)
    return Marked(
        marks,
        found.above_geoid,
        tuple(index for index in sorted(tags) if index not in marks),
        tuple(
            [f"mark {by_name[name].number} at {_clock(by_name[name])} belongs to no shot" for name in matched.files]
            + [f"mark {mark.number} is of shot {n}, which left no frame" for n, mark in paired.items() if n not in tags]
        ),
        (*found.doubts, *doubts, *_solutions(marks), *far),
        middle_s,
        max(abs(one - middle_s) for one in late_s),
        shift_m,
    )


def sentences(marked: Marked) -> list[str]:
    """What a person should know of the matching of marks and frames."""
    times = f"times agree within {1e3 * marked.spread_s:.1f} ms after {1e3 * marked.offset_s:+.1f} ms"
    lines = [f"{counted(len(marked.marks), 'frame')} placed by a mark; {times}"]
    if marked.shift_m:
        north, east, up = marked.shift_m
        lines.append(f"marks less autopilot (median): {north:+.2f} m north, {east:+.2f} m east, {up:+.2f} m up")
    lost = [f"frame {index} has no mark: it keeps the autopilot's position" for index in marked.lost]
    return [*lines, *lost, *marked.extra, *(f"in doubt: {text}" for text in marked.doubts)]


def _window_s(tags: Iterable[Tag]) -> float:
    """How much the times of true pairs differ: by the error of each shot's time."""
    sigma_s = max(tag.utc_sigma_ns for tag in tags) / 1e9
    return min(max(_SIGMAS * sigma_s, _LEAST_WINDOW_S), _MOST_WINDOW_S)


def _matched(
    path: Path, found: PosFile, shots: Sequence[FiredShot], window_s: float, *, utc_known: bool
) -> tuple[Matching, list[str]]:
    """The pairs by time, or by count and interval where the times don't agree; with doubts. Raises MarksError."""
    dated = [DatedFile(str(mark.number), mark.utc_ns / 1e9) for mark in found.marks]
    if utc_known:
        by_time = match(shots, dated, offset_s=0.0, window_s=window_s)
        if len(by_time.pairs) >= max(1, _SOME * min(len(shots), len(dated))):
            return by_time, _named(by_time.doubts)
    apart_s = median(shot.fired_s for shot in shots) - median(mark.utc_ns / 1e9 for mark in found.marks)
    if abs(apart_s) > PLAUSIBLE_S:
        days = [datetime.fromtimestamp(s, UTC).strftime("%Y-%m-%d") for s in (dated[0].taken_s or 0, shots[0].fired_s)]
        raise MarksError(f"the marks in {path} are of {days[0]}, the flight of {days[1]}: give the file of this flight")
    matched = match(shots, dated, window_s=window_s)
    enough = max(_LEAST_PAIRS, _SOME * min(len(shots), len(dated)))
    if matched.offset_s is None or len(matched.pairs) < enough:
        raise MarksError(
            f"{counted(len(dated), 'mark')} of {path} and {counted(len(shots), 'shot')}: neither their times nor count "
            "and intervals say which belong together; is it the file of this flight?"
        )
    how = "the flight never knew UTC" if not utc_known else f"their times are {-matched.offset_s:.3f} s from the shots'"
    return matched, [
        f"the marks were matched by count and intervals alone: {how}; compare a picture with its place",
        *_named(matched.doubts),
    ]


def _named(doubts: Sequence[str]) -> list[str]:
    return [f"mark {text}" for text in doubts]


def _not_epochs(path: Path, marks: Sequence[Mark], shots: int) -> None:
    """Raises MarksError for the file of all epochs in place of the events'."""
    steps = [after.utc_ns - before.utc_ns for before, after in pairwise(marks)]
    if len(marks) > _EPOCHS * shots and len(steps) > 9:
        usual = median(steps)
        if sum(abs(step % usual) < 2_000_000 for step in steps if usual) > 0.9 * len(steps):
            raise MarksError(
                f"{path} holds {len(marks)} positions every {usual / 1e9:g} s, the whole track and not the camera's "
                "marks: give the file of events that was written beside it (…_events.pos)"
            )


def _solutions(marks: Mapping[int, Mark]) -> list[str]:
    """A sentence for the marks that are not fixed."""
    worse = [mark for mark in marks.values() if mark.quality != 1]
    if not worse:
        return []
    kinds = ", ".join(
        f"{sum(mark.solution == kind for mark in worse)} {kind}" for kind in sorted({mark.solution for mark in worse})
    )
    return [f"{len(worse)} of {counted(len(marks), 'mark')} {'is' if len(worse) == 1 else 'are'} not fixed: {kinds}"]


def _shift(
    path: Path, marks: Mapping[int, Mark], tags: Mapping[int, Tag], geoid: Geoid | None
) -> tuple[tuple[float, float, float] | None, list[str]]:
    """The medians of marks minus the autopilot's positions, and a doubt about heights. Raises MarksError where they are
    too far apart to be of one flight."""
    steps = []
    for index, mark in marks.items():
        pose = tags[index].pose
        if pose.latitude_rad is None or pose.longitude_rad is None or pose.altitude_msl_m is None:
            continue
        north, east = metres_per_radian(mark.latitude_rad, mark.height_m)
        turn = math.remainder(mark.longitude_rad - pose.longitude_rad, math.tau)
        up = mark.height_m - _undulation_m(mark, geoid) - pose.altitude_msl_m
        steps.append(((mark.latitude_rad - pose.latitude_rad) * north, turn * east, up))
    if not steps:
        return None, []
    north_m, east_m, up_m = (float(median(part)) for part in zip(*steps, strict=True))
    if math.hypot(north_m, east_m) > _FAR_M:
        raise MarksError(
            f"the marks in {path} lie {math.hypot(north_m, east_m):,.0f} m from where the autopilot was: are they of "
            "this flight, and were the base's coordinates right and in WGS 84?"
        )
    if abs(up_m) > _VERTICAL_M:
        doubt = (
            f"the marks are {abs(up_m):.1f} m {'above' if up_m > 0 else 'below'} the autopilot's heights: was the "
            "base's height above sea level in place of above the ellipsoid, or is the geoid wrong?"
        )
        return (north_m, east_m, up_m), [doubt]
    return (north_m, east_m, up_m), []


def _applied(tag: Tag, mark: Mark, geoid: Geoid | None) -> Tag:
    half_ns = _half_ns(tag)
    north, east = metres_per_radian(mark.latitude_rad, mark.height_m)
    v_north, v_east, v_down = tag.pose.velocity_ned_m_s or (0.0, 0.0, 0.0)  # from the contact to mid-exposure
    covariance = mark.covariance_m2
    pose: Pose = replace(
        tag.pose,
        source="mark",
        utc_ns=mark.utc_ns + half_ns,
        latitude_rad=mark.latitude_rad + v_north * half_ns / 1e9 / north,
        longitude_rad=mark.longitude_rad + v_east * half_ns / 1e9 / east,
        altitude_msl_m=mark.height_m - _undulation_m(mark, geoid) - v_down * half_ns / 1e9,
        position_sigma_m=None if covariance is None else math.sqrt(covariance[0] + covariance[3]),
        vertical_sigma_m=None if covariance is None else math.sqrt(covariance[5]),
        position_covariance_m2=covariance,
        gnss=Gnss(_FIXES.get(mark.quality, 0), mark.satellites, None, None, None, None, None, half_ns / 1e6),
        age_ms=half_ns / 1e6,
    )
    return replace(tag, utc_ns=pose.utc_ns, utc_sigma_ns=_CONTACT_SIGMA_NS, time_source=MARK_SOURCE, pose=pose)


def _half_ns(tag: Tag) -> int:
    return round((tag.exposure_s or 0.0) / 2 * 1e9)


def _undulation_m(mark: Mark, geoid: Geoid | None) -> float:
    """The height of the geoid to take off a mark's height; 0 where the file's heights are above it already."""
    if geoid is None:
        return 0.0
    return geoid.undulation_m(math.degrees(mark.latitude_rad), math.degrees(mark.longitude_rad))


def _clock(mark: Mark) -> str:
    return datetime.fromtimestamp(mark.utc_ns / 1e9, UTC).strftime("%H:%M:%S.%f")[:-3] + " UTC"
