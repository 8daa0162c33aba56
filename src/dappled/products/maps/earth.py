"""Convert between geodetic and map coordinates, true and grid north, mean sea level and ellipsoid.

Positions are geodetic on WGS 84. A flight is mapped in one metric projection, by default the UTM zone (UPS near the
poles) of its first frame. PROJ must be able to carry out every transformation in full; ballpark ones are refused.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from itertools import pairwise
from pathlib import Path
from typing import Any, TypeVar

import numpy as np
import pyproj
from pyproj.datadir import get_data_dir, get_user_data_dir  # type: ignore[attr-defined]  # both are documented
from pyproj.exceptions import CRSError, ProjError

from dappled.decode.array_types import Floats
from dappled.errors import DappledError

GEODETIC = "EPSG:4326"
DEGREE_M = math.radians(1) * 6378137.0  # on the equator of WGS 84
Degrees = TypeVar("Degrees", float, Floats)
_OVERLAP_DEG = 6.0  # how far a projection may be used beyond the area that it was made for
_MOST_M = 120.0  # of sea level above or below the ellipsoid: EGM2008 has -107 to 86
_SYSTEM_GRIDS = Path("/usr/share/proj")
_GEOID_GRIDS = ("egm96_15.gtx", "us_nga_egm96_15.tif", "us_nga_egm08_25.tif", "egm08_25.gtx")


class EarthError(DappledError):
    """A position, a coordinate reference system or a grid can't be used."""


@dataclass(frozen=True, slots=True)
class Geoid:
    """The height of mean sea level above the ellipsoid: a grid file, or one number for the whole flight.

    `name` is written to outputs.
    """

    grid: Path | None = None
    offset_m: float | None = None

    @property
    def name(self) -> str:
        return str(self.grid.name) if self.grid is not None else f"constant {self.offset_m:g} m"

    def undulation_m(self, latitude_deg: float, longitude_deg: float) -> float:
        """Ellipsoidal height of mean sea level. Raises EarthError where the grid doesn't reach."""
        if self.offset_m is not None:
            return self.offset_m
        pipeline = (
            "+proj=pipeline +step +proj=unitconvert +xy_in=deg +xy_out=rad "
            f'+step +proj=vgridshift +grids="{self.grid}" +multiplier=1 '
            "+step +proj=unitconvert +xy_in=rad +xy_out=deg"
        )
        try:
            height = float(
                pyproj.Transformer.from_pipeline(pipeline).transform(wrapped(longitude_deg), latitude_deg, 0.0)[2]
            )
        except ProjError as error:
            raise EarthError(
                f"the geoid grid {self.grid} can't be read ({error}): give another, or metres, with --geoid"
            ) from None
        if not math.isfinite(height):
            raise EarthError(
                f"the geoid grid {self.grid} has no value at {latitude_deg:.4f}, {longitude_deg:.4f}: "
                "give another, or metres, with --geoid"
            )
        return height


def geoid(given: str | None) -> Geoid:
    """The geoid of the option `given`: metres, a grid file, or (None) the first grid in PROJ's folders.

    Raises EarthError that names the missing grid: PROJ alone would leave the geoid out without a word.
    """
    if given is not None:
        try:
            offset_m = float(given)
        except ValueError:
            path = Path(given).expanduser().absolute()
            if not path.is_file():
                raise EarthError(f"there is no geoid grid {given}: give a .gtx or .tif file, or metres") from None
            return Geoid(grid=path)
        if not abs(offset_m) <= _MOST_M:
            raise EarthError(f"sea level is nowhere {given} m above the ellipsoid: give {-_MOST_M:g} to {_MOST_M:g} m")
        return Geoid(offset_m=offset_m)
    folders = [Path(get_data_dir().split(":")[0]), Path(get_user_data_dir())]
    for folder in (*folders, _SYSTEM_GRIDS):
        for name in _GEOID_GRIDS:
            if (folder / name).is_file():
                return Geoid(grid=folder / name)
    raise EarthError(
        f"no geoid grid is on this machine (looked for {', '.join(_GEOID_GRIDS)}): install Debian's proj-data, "
        "or say with --geoid how many metres mean sea level is above the ellipsoid here"
    )


def wrapped(longitude_deg: Degrees) -> Degrees:
    """A longitude, or each of several, from −180 up to, but not including, 180.

    >>> wrapped(180.5), wrapped(-181.0), wrapped(180.0)
    (-179.5, 179.0, -180.0)
    """
    return (longitude_deg + 180) % 360 - 180


def geojson_feature(geometry: dict[str, Any], /, **properties: Any) -> dict[str, Any]:
    """A feature of GeoJSON (RFC 7946)."""
    return {"type": "Feature", "properties": properties, "geometry": geometry}


def geojson_collection(features: Iterable[dict[str, Any]]) -> dict[str, Any]:
    """What a file of GeoJSON holds."""
    return {"type": "FeatureCollection", "features": list(features)}


def geojson_line(line: Sequence[list[float]]) -> dict[str, Any]:
    """The GeoJSON geometry of a line of longitude, latitude (and height), cut at the antimeridian (RFC 7946, 3.1.9)."""
    pieces = [[line[0]]]
    for a, b in pairwise(line):
        if abs(b[0] - a[0]) > 180:
            edge = math.copysign(180.0, a[0])
            span = b[0] + 2 * edge - a[0]
            share = (edge - a[0]) / span if span else 0.0
            between = [round(p + share * (q - p), 9) for p, q in zip(a[1:], b[1:], strict=False)]
            pieces[-1] += [] if a[0] == edge else [[edge, *between]]
            pieces.append([] if b[0] == -edge else [[-edge, *between]])
        pieces[-1].append(b)
    several = [piece if len(piece) > 1 else piece * 2 for piece in pieces]  # a line has two points or more
    if len(several) == 1:
        return {"type": "LineString", "coordinates": several[0]}
    return {"type": "MultiLineString", "coordinates": several}


def touch(a: tuple[float, ...], b: tuple[float, ...], *, degrees: bool) -> bool:
    """Whether two boxes (west, south, east, north) overlap. Boxes in degrees may cross the antimeridian (west above
    east), and may count longitudes to 180° or to 360°.

    >>> touch((179.9, -17, -179.9, -16), (-180, -90, 180, 90), degrees=True)
    True
    """
    if not (a[1] <= b[3] and b[1] <= a[3]):
        return False
    east_a, east_b = (box[2] + 360 * (degrees and box[0] > box[2]) for box in (a, b))
    turns = (-360, 0, 360) if degrees else (0,)
    return any(a[0] + turn <= east_b and b[0] <= east_a + turn for turn in turns)


def utm(latitude_deg: float, longitude_deg: float) -> str:
    """The UTM zone of a place as an EPSG code, or UPS beyond 84° N and 80° S.

    >>> utm(41.6, -91.5), utm(-33.9, 18.4), utm(0.0, 179.9999), utm(85.0, 0.0)
    ('EPSG:32615', 'EPSG:32734', 'EPSG:32660', 'EPSG:32661')
    """
    if latitude_deg >= 84:
        return "EPSG:32661"
    if latitude_deg < -80:
        return "EPSG:32761"
    zone = min(60, int((wrapped(longitude_deg) + 180) // 6) + 1)
    return f"EPSG:{32600 + zone if latitude_deg >= 0 else 32700 + zone}"


class Projection:
    """A metric map projection: geodetic degrees to (east, north) metres and back, and the grid's orientation."""

    def __init__(self, name: str) -> None:
        """Raises EarthError where `name` is not a projected system in metres."""
        self.crs = _metric(name)
        epsg = self.crs.to_epsg()
        self.name = f"EPSG:{epsg}" if epsg else name
        try:
            self._there = pyproj.Transformer.from_crs(GEODETIC, self.crs, always_xy=True, allow_ballpark=False)
            self._back = pyproj.Transformer.from_crs(self.crs, GEODETIC, always_xy=True, allow_ballpark=False)
            self._proj = pyproj.Proj(self.crs)
        except ProjError as error:
            raise EarthError(
                f"PROJ can't transform WGS 84 to {name} in full ({error}): a grid is missing; choose another --crs"
            ) from None

    def to_map(self, latitude_deg: Any, longitude_deg: Any) -> tuple[Floats, Floats]:
        """(east, north) in metres; any shape."""
        east, north = self._there.transform(np.asarray(longitude_deg, float), np.asarray(latitude_deg, float))
        return np.asarray(east, float), np.asarray(north, float)

    def to_geodetic(self, east: Any, north: Any) -> tuple[Floats, Floats]:
        """(latitude, longitude) in degrees; any shape."""
        longitude, latitude = self._back.transform(np.asarray(east, float), np.asarray(north, float))
        return np.asarray(latitude, float), np.asarray(longitude, float)

    def at(self, latitude_deg: float, longitude_deg: float) -> GridAt:
        """The grid at a place. Raises EarthError outside the projection's area."""
        area = self.crs.area_of_use
        if area is not None:
            beyond = max(area.south - latitude_deg, latitude_deg - area.north, 0.0)
            aside = min(abs(wrapped(longitude_deg - edge)) for edge in (area.west, area.east))
            inside = wrapped(longitude_deg - area.west) % 360 <= (area.east - area.west) % 360 or area.west == -180
            if beyond > _OVERLAP_DEG or (not inside and aside > _OVERLAP_DEG):
                raise EarthError(self._too_far(latitude_deg, longitude_deg))
        east, north = self.to_map(latitude_deg, longitude_deg)
        factors = self._proj.get_factors(longitude_deg, latitude_deg)
        values = (float(east), float(north), factors.meridian_convergence, math.sqrt(factors.areal_scale))
        if not all(map(math.isfinite, values)) or not 0.9 < values[3] < 1.1:
            raise EarthError(self._too_far(latitude_deg, longitude_deg))
        return GridAt(values[0], values[1], math.radians(values[2]), values[3])

    def _too_far(self, latitude_deg: float, longitude_deg: float) -> str:
        return (
            f"{self.name} does not cover {latitude_deg:.5f}, {longitude_deg:.5f}: leave --crs out, or name the "
            "projection of that place"
        )


@dataclass(frozen=True, slots=True)
class GridAt:
    """A place on the map. `convergence_rad` is the angle from true north clockwise to grid north, `scale` the map
    metres per metre on the ellipsoid."""

    east: float
    north: float
    convergence_rad: float
    scale: float

    def from_ned(self) -> Floats:
        """(3, 3): true north, east, down to grid east, grid north, up. A true azimuth α is α − γ on the grid."""
        c, s = math.cos(self.convergence_rad), math.sin(self.convergence_rad)
        return np.array([[-s, c, 0.0], [c, s, 0.0], [0.0, 0.0, -1.0]])


def _metric(name: str) -> pyproj.CRS:
    try:
        crs = pyproj.CRS.from_user_input(name)
    except CRSError:
        raise EarthError(f"{name!r} is not a coordinate system that PROJ knows: give one as EPSG:32615") from None
    units = {axis.unit_name for axis in crs.axis_info[:2]}
    if not crs.is_projected or units != {"metre"}:
        raise EarthError(
            f"{name} is not a map projection in metres (its unit: {', '.join(sorted(units))}): give one as EPSG:32615"
        )
    return crs
