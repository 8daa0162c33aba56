"""Plan the mission that flies a survey's holes again, and write it as a QGroundControl plan.

The format (version 1, mission version 2): docs.qgroundcontrol.com, developer guide, file formats, plan.
"""

from __future__ import annotations

import itertools
import math
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy import ndimage

from dappled.decode.array_types import Floats
from dappled.errors import DappledError
from dappled.products.maps.coverage import Coverage, FramesSeen
from dappled.products.maps.photographs import home_m
from dappled.products.whole_files import write_json

_ARDUPILOT, _QUADROTOR, _RELATIVE = 3, 2, 1  # MAV_AUTOPILOT, MAV_TYPE, QGroundControl's altitude mode
_TAKEOFF, _WAYPOINT, _RETURN, _SPEED, _TRIGGER_DISTANCE = 22, 16, 20, 178, 206  # MAV_CMD
_GLOBAL_RELATIVE, _MISSION = 3, 2  # MAV_FRAME
_LEAST_SHARE = 0.5  # of the flight's usual height above ground: nearer to it a mission is not written
_MOST_ASIDE_RAD = math.radians(15)
_FAR_M, _FAR_SPANS = 5000.0, 5.0  # farther than both, an area is taken for another field's
SLOWEST_M_S = 0.5  # of a multicopter that shall keep its spacing in wind
_CLOSE = 2.0  # holes within so many line distances of each other are flown as one


@dataclass(frozen=True, slots=True)
class FlightLine:
    """One line: from and to (latitude, longitude) in degrees. Photographs are taken all along."""

    begin: tuple[float, float]
    end: tuple[float, float]


@dataclass(frozen=True, slots=True)
class Refly:
    """A mission over a survey's holes. `altitude_m` is above home, `home` (latitude, longitude, metres above sea
    level), `trigger_m` the distance between two photographs. The body is known to take
    a photograph in `body_s`; None where that isn't known."""

    lines: tuple[FlightLine, ...]
    altitude_m: float
    trigger_m: float
    speed_m_s: float
    home: tuple[float, float, float]
    body_s: float | None = None

    @property
    def interval_s(self) -> float:
        """The time between two photographs."""
        return self.trigger_m / self.speed_m_s


def plan(
    seen: FramesSeen,
    covered: Coverage,
    *,
    least: int = 1,
    overlap: float = 0.8,
    sidelap: float = 0.6,
    body_s: float | None = None,
    slowest_m_s: float = SLOWEST_M_S,
) -> Refly | None:
    """Lines that cover the holes at the flight's own height; None where there is no hole.

    They are flown as fast as the flight was, or so much slower that the body, which takes a photograph in `body_s`
    (None: as in the flight), keeps up. The camera looks down with a side of the frame along the line, as `pose.mount`
    has it. Raises DappledError where it doesn't, where the flight's height above home isn't known, or the ground
    anywhere on the way isn't, or rises to half of the flight's usual height above it, or the vehicle, which flies at
    `slowest_m_s` or faster, is too fast for the body.
    """
    holes = covered.holes(least)
    if not holes.any():
        return None
    if least * (1 - overlap) > 1 + 1e-9:
        raise DappledError(
            f"with an overlap of {overlap:g} a place is seen by {1 / (1 - overlap):.1f} frames, and {least} are wanted"
            f": give an --overlap of {1 - 1 / least:.2g} or more"
        )
    _check_near(seen, covered, holes)
    heights = [h for one in seen.stations if (h := one.camera.height_above_home_m) is not None]
    base = home_m(seen.stations)
    if not heights or base is None:
        raise DappledError("the flight's height above home is not known, so that no mission can be given a height")
    altitude = float(np.median(heights))
    first = seen.stations[0].camera
    home = np.array(seen.projection.to_map(first.latitude_deg, first.longitude_deg))
    above = base + altitude - _highest(seen, *_places(covered, holes))
    lines: list[tuple[Floats, Floats]] = []
    for _ in range(2):  # the ends of the lines may lie over higher ground than the holes: then lines are closer
        along, across = _footprint(seen, above)
        trigger, line = along * (1 - overlap), across * (1 - sidelap)
        parts = _parts(holes, line / covered.grid.step_x)
        lines = [one for part in parts for one in _lines(part, covered, trigger, line)]
        above = base + altitude - _highest(seen, *_way([home, *(end for one in lines for end in one), home], line / 4))
    usual = float(np.median([one.camera.altitude_msl_m for one in seen.stations])) - _below(seen)
    if not above >= _LEAST_SHARE * usual:
        raise DappledError(
            f"the ground on the way rises to {base + altitude - above:.0f} m, {above:.0f} m below the mission's "
            f"{base + altitude:.0f} m; the flight was {usual:.0f} m above it: plan this area by hand"
        )
    body_s = body_s or _usual_interval_s(seen)
    speed = _speed(seen, trigger, body_s)
    if body_s is not None and speed < slowest_m_s:
        most = math.floor(100 * (1 - slowest_m_s * body_s / along)) / 100
        able = most >= max(0.0, 1 - 1 / least)
        raise DappledError(
            f"the body takes a photograph in {body_s:.2g} s: one every {trigger:.2g} m asks for {speed:.2g} m/s, and "
            f"the vehicle flies no slower than {slowest_m_s:g} m/s: "
            + (f"give an --overlap of {most:.2g} or less" if able else "fly this area by hand, and higher")
        )
    return Refly(
        tuple(FlightLine(_degrees(seen, begin), _degrees(seen, end)) for begin, end in lines),
        altitude,
        trigger,
        speed,
        (first.latitude_deg, first.longitude_deg, base),
        body_s,
    )


def _check_near(seen: FramesSeen, covered: Coverage, holes: NDArray[np.bool_]) -> None:
    """Raises DappledError where a hole is far from all frames: the area is then another field's."""
    frames = np.array([eye.centre[:2] for eye in seen.eyes.values()])
    east, north = _places(covered, holes)
    span_m = float(np.hypot(*np.ptp(frames, axis=0)))
    away_m = float(np.hypot(east - frames[:, 0].mean(), north - frames[:, 1].mean()).max())
    if away_m > max(_FAR_M, _FAR_SPANS * span_m):
        raise DappledError(
            f"the area reaches {away_m / 1000:.0f} km from the flight, which spans {span_m:.0f} m: is it another "
            "field's, or are its coordinates the wrong way round?"
        )


def _places(covered: Coverage, cells: NDArray[np.bool_]) -> tuple[Floats, Floats]:
    """(east, north) on the map of chosen cells."""
    x, y = covered.grid.axes()
    rows, columns = np.nonzero(cells)
    return x[columns], y[rows]


def _way(ends: Sequence[Floats], step_m: float) -> tuple[Floats, Floats]:
    """(east, north) of places along a way, from end to end, at most `step_m` apart."""
    found = [
        begin + (end - begin) * share
        for begin, end in itertools.pairwise(ends)
        for share in np.linspace(0, 1, 2 + int(np.hypot(*(end - begin)) / max(step_m, 0.1)))
    ]
    return np.array(found)[:, 0], np.array(found)[:, 1]


def _highest(seen: FramesSeen, east: Floats, north: Floats) -> float:
    """The highest ground at places on the map (m). Raises DappledError where it isn't known everywhere."""
    heights = seen.ground.heights(east, north)
    if not np.isfinite(heights).all():
        raise DappledError(
            f"the height of the ground is not known everywhere on the way ({seen.ground.name}): a mission there may "
            "lead into it; give --terrain that covers the area, the lines' ends and the way home"
        )
    return float(heights.max())


def _below(seen: FramesSeen) -> float:
    """The height of the ground below the flight (m), the middle one of its frames. Raises DappledError."""
    at = [seen.projection.to_map(one.camera.latitude_deg, one.camera.longitude_deg) for one in seen.stations]
    heights = seen.ground.heights(*np.array(at, dtype=np.float64).reshape(-1, 2).T)
    if not np.isfinite(heights).any():
        raise DappledError(f"the height of the ground below the flight is not known ({seen.ground.name})")
    return float(np.nanmedian(heights))


def _footprint(seen: FramesSeen, above_m: float) -> tuple[float, float]:
    """(along the flight, across) metres on the ground of the narrowest frame that looks down from `above_m`.

    Raises DappledError where the camera looks aside."""
    down = float(np.median([one.camera_to_ned[2, 2] for one in seen.stations]))
    if down < math.cos(_MOST_ASIDE_RAD):
        raise DappledError(
            f"the camera looks {math.degrees(math.acos(max(down, -1))):.0f}° off the vertical: a mission over the "
            "holes is for one that looks down"
        )
    sides = []
    for eye in seen.eyes.values():
        (rows, columns), (across_px, down_px) = eye.shape, np.linalg.norm(eye.matrix[:2, :2], axis=1).tolist()
        sides.append((above_m * rows / down_px, above_m * columns / across_px))
    height, width = np.min(sides, axis=0).tolist()
    forward = seen.mounting.matrix[0]  # of the body, in camera axes: right, down, look
    return (width, height) if abs(forward[0]) > abs(forward[1]) else (height, width)


def _speed(seen: FramesSeen, trigger_m: float, body_s: float | None) -> float:
    """The flight's speed (m/s), or the highest at which the body keeps up."""
    found = [math.hypot(*v[:2]) for one in seen.stations if (v := one.tag.pose.velocity_ned_m_s) is not None]
    usual = round(max(1.0, float(np.median(found))), 1) if found else 5.0
    return usual if body_s is None else min(usual, math.floor(100 * trigger_m / body_s) / 100)


def _usual_interval_s(seen: FramesSeen) -> float | None:
    """The middle time between one photograph of the flight and the next, which the body has kept up; None where no two
    of them follow each other."""
    taken = {one.frame.index: one.tag.utc_ns for one in seen.stations}
    apart = [after - utc_ns for index, utc_ns in taken.items() if (after := taken.get(index + 1, utc_ns)) > utc_ns]
    return float(np.median(apart)) / 1e9 if apart else None


def _parts(holes: NDArray[np.bool_], line_cells: float) -> list[NDArray[np.bool_]]:
    """The holes in groups that lie close to each other."""
    near = max(1, round(_CLOSE * line_cells / 2))
    grown = ndimage.distance_transform_edt(~holes) <= near
    labels, count = ndimage.label(grown)
    return [holes & (labels == number) for number in range(1, count + 1)]


def _lines(part: NDArray[np.bool_], covered: Coverage, trigger_m: float, line_m: float) -> list[tuple[Floats, Floats]]:
    """Lines (begin, end) on the map over one group of holes, along its longer side, back and forth."""
    x, y = covered.grid.axes()
    rows, columns = np.nonzero(part)
    places = np.stack([x[columns], y[rows]], axis=1)
    middle = places.mean(axis=0)
    _, vectors = np.linalg.eigh(np.cov((places - middle).T) if len(places) > 1 else np.eye(2))
    along, aside = vectors[:, 1], vectors[:, 0]
    s, t = (places - middle) @ along, (places - middle) @ aside
    half = covered.grid.step_x  # a cell's own size
    low, high = t.min() - half, t.max() + half
    count = max(1, math.ceil((high - low) / line_m))
    step = (high - low) / count
    found = []
    for number in range(count):
        at = low + (number + 0.5) * step
        mine = np.abs(t - at) <= step / 2 + half
        if not mine.any():
            continue
        begin, end = s[mine].min() - half - trigger_m, s[mine].max() + half + trigger_m
        ends = middle + at * aside + begin * along, middle + at * aside + end * along
        found.append(ends if number % 2 == 0 else ends[::-1])
    return found


def _degrees(seen: FramesSeen, place: Floats) -> tuple[float, float]:
    latitude, longitude = seen.projection.to_geodetic(place[0], place[1])
    return float(latitude), float(longitude)


def qgc_plan(made: Refly) -> dict[str, Any]:
    """The mission as QGroundControl's plan: take-off, the lines with triggering by distance, return."""
    items: list[dict[str, Any]] = []

    def add(command: int, params: Sequence[float | None], *, placed: bool) -> None:
        item: dict[str, Any] = {
            "autoContinue": True,
            "command": command,
            "doJumpId": len(items) + 1,
            "frame": _GLOBAL_RELATIVE if placed else _MISSION,
            "params": list(params),
            "type": "SimpleItem",
        }
        if placed:
            item |= {"AMSLAltAboveTerrain": None, "Altitude": made.altitude_m, "AltitudeMode": _RELATIVE}
        items.append(item)

    def to(command: int, place: tuple[float, float]) -> None:
        add(command, (0, 0, 0, None, *place, made.altitude_m), placed=True)

    latitude, longitude, base = made.home
    to(_TAKEOFF, (latitude, longitude))
    add(_SPEED, (1, made.speed_m_s, -1, 0, 0, 0, 0), placed=False)
    for line in made.lines:
        to(_WAYPOINT, line.begin)
        add(_TRIGGER_DISTANCE, (round(made.trigger_m, 3), 0, 1, 0, 0, 0, 0), placed=False)
        to(_WAYPOINT, line.end)
        add(_TRIGGER_DISTANCE, (0, 0, 0, 0, 0, 0, 0), placed=False)
    add(_RETURN, (0, 0, 0, 0, 0, 0, 0), placed=False)
    return {
        "fileType": "Plan",
        "geoFence": {"circles": [], "polygons": [], "version": 2},
        "groundStation": "QGroundControl",
        "mission": {
            "cruiseSpeed": made.speed_m_s,
            "firmwareType": _ARDUPILOT,
            "globalPlanAltitudeMode": _RELATIVE,
            "hoverSpeed": made.speed_m_s,
            "items": items,
            "plannedHomePosition": [latitude, longitude, base],
            "vehicleType": _QUADROTOR,
            "version": 2,
        },
        "rallyPoints": {"points": [], "version": 2},
        "version": 1,
    }


def write(made: Refly, path: Path) -> None:
    """Write the plan, whole or not at all."""
    write_json(path, qgc_plan(made), indent=4)
