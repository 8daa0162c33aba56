"""Ground control points: places that somebody measured, and where frames show them."""

from __future__ import annotations

import csv
import math
from collections.abc import Collection, Sequence
from dataclasses import dataclass
from pathlib import Path

from dappled.errors import DappledError
from dappled.products.maps.earth import Projection


class ControlError(DappledError):
    """Control points that can't be used; one sentence with the file and line."""


@dataclass(frozen=True, slots=True, eq=False)
class ControlPoint:
    """A measured place (east, north, height on the map) and the sensor pixel (column, row) of a frame that shows it."""

    name: str
    frame: str
    pixel: tuple[float, float]
    place: tuple[float, float, float]


def read(path: Path, projection: Projection) -> list[ControlPoint]:
    """Control points from CSV with the columns name, frame, column, row, latitude, longitude, altitude: pixels of the
    frame as the camera made it, degrees, metres above sea level. Raises ControlError naming the line."""
    wanted = ("name", "frame", "column", "row", "latitude", "longitude", "altitude")
    try:
        with path.open(newline="", encoding="utf-8-sig") as file:
            rows = csv.DictReader(file, skipinitialspace=True)
            missing = [name for name in wanted if name not in (rows.fieldnames or ())]
            if missing:
                raise ControlError(f"{path} lacks the column {missing[0]}: its first line names {', '.join(wanted)}")
            found = []
            for row in rows:
                try:
                    column, line, latitude, longitude, altitude = (float(row[name]) for name in wanted[2:])
                except (TypeError, ValueError):
                    raise ControlError(f"{path}, line {rows.line_num}: a number is missing or is none") from None
                if not (abs(latitude) <= 90 and math.isfinite(longitude + altitude + column + line)):
                    raise ControlError(f"{path}, line {rows.line_num}: {latitude}, {longitude} is no place on Earth")
                east, north = projection.to_map(latitude, longitude)
                place = (float(east), float(north), altitude)
                found.append(ControlPoint(row["name"], Path(row["frame"]).stem, (column, line), place))
    except OSError as error:
        raise ControlError(f"the control points {path} can't be read: {error.strerror}") from None
    except UnicodeDecodeError:
        raise ControlError(f"the control points {path} are no text in UTF-8") from None
    return found


def sighted(points: Sequence[ControlPoint], frames: Collection[str]) -> tuple[list[ControlPoint], list[str]]:
    """The points that these frames show, and a sentence for each other. Raises ControlError where none is left."""
    kept = [point for point in points if point.frame in frames]
    if points and not kept:
        raise ControlError(
            f"no control point is on a frame that is mapped: the first, {points[0].name}, names frame {points[0].frame}"
        )
    others = [point for point in points if point.frame not in frames]
    return kept, [f"control point {one.name} is left out: frame {one.frame} is not on the map" for one in others]
