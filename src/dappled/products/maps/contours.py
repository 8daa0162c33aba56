"""Draw the lines of equal height of a raster, and write them as GeoJSON (RFC 7946)."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from scipy import ndimage

from dappled.decode.array_types import Floats
from dappled.errors import CallError
from dappled.products.extras import need
from dappled.products.maps.earth import Projection, geojson_collection, geojson_feature, geojson_line
from dappled.products.maps.heights import HeightRaster
from dappled.products.whole_files import write_json

MOST_HEIGHTS = 5000
_HEIGHTS = 20.0  # over the relief, where no interval is asked for
_APART_SIGMAS = 2.0  # of a height: lines nearer to each other show its errors
_MAJOR = 5  # each fifth line


@dataclass(frozen=True, slots=True, eq=False)
class Contour:
    """A line (n, 2) of one height, east and north on the map; closed where the first point is the last."""

    height_m: float
    line: Floats

    @property
    def length_m(self) -> float:
        """On the map."""
        return float(np.hypot(*np.diff(self.line, axis=0).T).sum())


def interval_of(raster: HeightRaster) -> float:
    """An interval of 1, 2 or 5 times a power of ten: about twenty over the relief, and none below 2 σ of a height."""
    least = float(np.nanmax(raster.height_m) - np.nanmin(raster.height_m)) / _HEIGHTS
    if raster.sigma_m is not None and np.isfinite(raster.sigma_m).any():
        least = max(least, _APART_SIGMAS * float(np.nanmedian(raster.sigma_m)))
    power = 10.0 ** math.floor(math.log10(max(least, 1e-3)))
    return next(step * power for step in (1, 2, 5, 10) if step * power >= least * (1 - 1e-9))


def smoothed(raster: HeightRaster, reach_m: float) -> Floats:
    """Heights (rows, columns) under a Gaussian of so many metres, of known ones alone; unknown cells stay so."""
    known = np.isfinite(raster.height_m)
    reach = reach_m / raster.grid.step_y, reach_m / raster.grid.step_x
    level = float(np.nanmean(raster.height_m))
    above = np.where(known, raster.height_m.astype(np.float64) - level, 0.0)
    total, weight = (ndimage.gaussian_filter(one, reach, mode="constant") for one in (above, known.astype(np.float64)))
    return np.where(known, level + total / np.maximum(weight, 1e-9), np.nan)


def of(raster: HeightRaster, interval_m: float, *, smooth_m: float = 0.0) -> list[Contour]:
    """The lines at whole multiples of an interval, through the cells' centres; they end where heights are unknown.

    Raises CallError where there would be too many.
    """
    heights = smoothed(raster, smooth_m) if smooth_m else raster.height_m.astype(np.float64)
    first = math.ceil(float(np.nanmin(heights)) / interval_m)
    last = math.floor(float(np.nanmax(heights)) / interval_m)
    if last - first >= MOST_HEIGHTS:
        raise CallError(f"{raster.name} has {last - first + 1} heights {interval_m:g} m apart: give a larger interval")
    if min(heights.shape) < 2:
        raise CallError(f"{raster.name} has one row or column of heights, which shows no lines")
    x, y = raster.grid.axes()
    generator = need("contourpy").contour_generator(x, y, heights, line_type="Separate")
    return [
        Contour(round(number * interval_m, 9), np.asarray(line, np.float64))
        for number in range(first, last + 1)
        for line in generator.lines(number * interval_m)
    ]


def write(contours: Sequence[Contour], projection: Projection, interval_m: float, path: Path) -> None:
    """Write lines with `height_m`, and `major` for each fifth; what crosses 180° is cut there."""
    east, north = np.concatenate([np.empty((0, 2)), *(one.line for one in contours)]).T
    latitude, longitude = projection.to_geodetic(east, north)
    places = np.round(np.stack([longitude, latitude], axis=1), 8)
    lines = np.split(places, np.cumsum([len(one.line) for one in contours])[:-1]) if contours else []
    features = []
    for one, line in zip(contours, lines, strict=True):
        major = round(one.height_m / interval_m) % _MAJOR == 0
        features.append(geojson_feature(geojson_line(line.tolist()), height_m=one.height_m, major=major))
    write_json(path, geojson_collection(features), indent=None)
