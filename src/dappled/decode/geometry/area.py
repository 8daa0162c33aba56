"""Read the area of a survey: polygons from GeoJSON, KML, or the surveys of a QGroundControl plan."""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Protocol
from xml.etree import ElementTree

import numpy as np
from numpy.typing import NDArray

from dappled.bounds import parsing
from dappled.decode.array_types import Floats
from dappled.errors import DappledError, counted, first_line

MOST_CORNERS = 2000  # a drawn field has fewer; a ring is compared with itself, side by side
Ring = tuple[tuple[float, float], ...]  # (latitude, longitude) in degrees, the first corner not repeated


class MapProjection(Protocol):
    """Whatever leads from degrees to metres on a map."""

    def to_map(self, latitude_deg: Floats, longitude_deg: Floats) -> tuple[Floats, Floats]:
        """East and north."""


class AreaError(DappledError):
    """A planned area can't be used; one sentence."""


@dataclass(frozen=True, slots=True)
class PlannedArea:
    """Polygons, each of rings. A place is inside a polygon where it lies in an odd number of its rings (an inner ring
    is a gap), and inside the area where it is in any polygon. `left` names what of the file is no part of it."""

    name: str
    polygons: tuple[tuple[Ring, ...], ...]
    left: tuple[str, ...] = ()

    @property
    def rings(self) -> tuple[Ring, ...]:
        """Those of all polygons."""
        return tuple(ring for polygon in self.polygons for ring in polygon)

    def on_map(self, projection: MapProjection) -> list[Floats]:
        """Each ring (n, 2), east and north on the map."""
        return [np.stack(projection.to_map(*np.array(ring).T), axis=1) for ring in self.rings]

    def inside(self, projection: MapProjection, east: Floats, north: Floats) -> NDArray[np.bool_]:
        """Whether places of any shape on the map lie in the area."""
        found = np.zeros(np.shape(east), dtype=bool)
        rings = iter(self.on_map(projection))
        for polygon in self.polygons:
            found |= within([next(rings) for _ in polygon], east, north)
        return found


def within(rings: Sequence[Floats], east: Floats, north: Floats) -> NDArray[np.bool_]:
    """Whether places of any shape lie in an odd number of rings, (n, 2) each, east and north."""
    found = np.zeros(np.shape(east), dtype=bool)
    for ring in rings:
        for (x, y), (next_x, next_y) in zip(ring, np.roll(ring, -1, axis=0), strict=True):
            crosses = (y > north) != (next_y > north)
            if crosses.any():
                found ^= crosses & (east < x + (north - y) / (next_y - y) * (next_x - x))
    return found


def read(path: Path) -> PlannedArea:
    """Read an area by the file's extension: .geojson or .json, .kml, .plan.

    Raises AreaError where the file can't be read, has no polygon, or a polygon crosses itself.
    """
    kind = path.suffix.lower()
    readers = {".geojson": _geojson, ".json": _geojson, ".kml": _kml, ".plan": _plan}
    if kind not in readers:
        raise AreaError(f"{path}: an area is a .geojson, a .kml or a QGroundControl .plan")
    try:
        data = parsing.read_bytes(path)
        polygons = tuple(tuple(_ring(path, ring) for ring in polygon) for polygon in readers[kind](data))
    except (DappledError, OSError) as error:
        said = error.strerror if isinstance(error, OSError) else error
        raise AreaError(str(error) if isinstance(error, AreaError) else f"{path} can't be read: {said}") from None
    except (
        ValueError,
        TypeError,
        KeyError,
        IndexError,
        AttributeError,
        RecursionError,
        ElementTree.ParseError,
    ) as error:
        raise AreaError(f"{path} can't be read as an area: {first_line(error)}") from None
    if not polygons:
        what = "no survey with a polygon" if kind == ".plan" else "no polygon"
        raise AreaError(f"{path} has {what}: draw the area as one")
    return PlannedArea(path.name, polygons, _left_of_plan(data) if kind == ".plan" else ())


def _ring(path: Path, corners: Sequence[tuple[float, float]]) -> Ring:
    """A ring, checked. Raises AreaError."""
    ring = [(float(latitude), float(longitude)) for latitude, longitude in corners]
    if len(ring) > 1 and ring[0] == ring[-1]:
        ring.pop()
    if not 3 <= len(ring) <= MOST_CORNERS:
        raise AreaError(f"{path}: a polygon has {len(ring)} corners; an area needs 3 to {MOST_CORNERS}")
    for latitude, longitude in ring:
        if not (math.isfinite(latitude) and math.isfinite(longitude) and abs(latitude) <= 90 and abs(longitude) <= 360):
            raise AreaError(f"{path}: {latitude}, {longitude} is not a latitude and a longitude in degrees")
    crossing = _crossing(np.array(ring))
    if crossing is not None:
        a, b = crossing
        raise AreaError(
            f"{path}: the area crosses itself (the sides from corner {a + 1} and from corner {b + 1}): draw it so that "
            "no side crosses another"
        )
    return tuple(ring)


def _crossing(ring: Floats) -> tuple[int, int] | None:
    """The first two sides of a ring (n, 2) that cross, or None. Sides that only touch do not."""
    ends = np.roll(ring, -1, axis=0)
    for at in range(len(ring) - 1):
        others = np.arange(at + 1, len(ring))
        begin, end = ring[others], ends[others]
        apart = _turn(ring[at], ends[at], begin) * _turn(ring[at], ends[at], end) < 0
        across = _turn(begin, end, ring[at]) * _turn(begin, end, ends[at]) < 0
        if (both := others[apart & across]).size:
            return at, int(both[0])
    return None


def _turn(a: Floats, b: Floats, c: Floats) -> Floats:
    """Twice the signed area of the triangles a, b, c (…, 2)."""
    return np.asarray(
        (b[..., 0] - a[..., 0]) * (c[..., 1] - a[..., 1]) - (b[..., 1] - a[..., 1]) * (c[..., 0] - a[..., 0])
    )


def _geojson(data: bytes) -> Iterator[list[list[tuple[float, float]]]]:
    for polygon in _polygons(parsing.parse_json(data)):
        yield [[(place[1], place[0]) for place in ring] for ring in polygon]


def _polygons(value: Mapping[str, Any]) -> Iterator[Any]:
    match value["type"]:
        case "FeatureCollection":
            for feature in value["features"]:
                yield from _polygons(feature)
        case "Feature":
            if value["geometry"] is not None:
                yield from _polygons(value["geometry"])
        case "GeometryCollection":
            for geometry in value["geometries"]:
                yield from _polygons(geometry)
        case "Polygon":
            yield value["coordinates"]
        case "MultiPolygon":
            yield from value["coordinates"]


def _kml(data: bytes) -> Iterator[list[list[tuple[float, float]]]]:
    if b"<!DOCTYPE" in data or b"<!ENTITY" in data:
        raise ValueError("it declares entities, which no area needs")
    if b"\0" in data:
        raise ValueError("it is not UTF-8: save it as such")
    for polygon in ElementTree.fromstring(data).iter():  # noqa: S314  # without entities, and of a limited size
        if polygon.tag.rpartition("}")[2] == "Polygon":
            texts = [one.text or "" for one in polygon.iter() if one.tag.rpartition("}")[2] == "coordinates"]
            rings = [[place.split(",") for place in text.split()] for text in texts]
            if any(len(place) not in (2, 3) or not all(place) for ring in rings for place in ring):
                raise ValueError("its coordinates are not longitude,latitude without blanks between them")
            yield [[(float(place[1]), float(place[0])) for place in ring] for ring in rings]


def _plan(data: bytes) -> Iterator[list[list[tuple[float, float]]]]:
    plan = parsing.parse_json(data)
    if plan["fileType"] != "Plan":
        raise ValueError(f"its fileType is {plan['fileType']!r}, not 'Plan'")
    for item in plan["mission"]["items"]:
        if item.get("complexItemType") == "survey":
            yield [[(place[0], place[1]) for place in item["polygon"]]]


def _left_of_plan(data: bytes) -> tuple[str, ...]:
    """The kinds of a plan's complex items that are no surveys, with their numbers."""
    kinds = [item.get("complexItemType") for item in parsing.parse_json(data)["mission"]["items"]]
    return tuple(counted(number, str(kind)) for kind, number in Counter(kinds).items() if kind not in (None, "survey"))
