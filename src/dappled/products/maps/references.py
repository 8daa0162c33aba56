"""Read what poses are refined against: a base map, and measured ground control points."""

from __future__ import annotations

import math
from collections.abc import Sequence
from contextlib import AbstractContextManager
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from dappled.decode.array_types import Floats
from dappled.errors import DappledError
from dappled.findings import Code, Finding, Subject, finding
from dappled.products import csv_tables
from dappled.products.extras import need
from dappled.products.maps.earth import Projection, touch
from dappled.products.maps.map_grid import MapGrid, around
from dappled.products.maps.photographs import Photograph
from dappled.products.maps.rasters import opened, step_m

_MOST_MASK = 256_000_000  # cells


class BaseMapError(DappledError):
    """A base map can't be used."""


@dataclass(frozen=True, slots=True)
class BaseMap:
    """A georeferenced raster picture, read in windows. `gsd_m` is the frames' own; nothing finer is read."""

    path: Path
    projection: Projection
    gsd_m: float

    def check(self, points: Floats) -> None:
        """Raises BaseMapError where the map can't be read, is not georeferenced, or does not overlap the points (n, 2)
        of the flight."""
        warp = need("rasterio.warp")
        with self._open() as source:
            box = (*points.min(axis=0), *points.max(axis=0))
            there = warp.transform_bounds(self.projection.crs.to_wkt(), source.crs, *box)
            b = source.bounds
            if not touch(there, b, degrees=source.crs.is_geographic):
                raise BaseMapError(
                    f"the base map {self.path} lies elsewhere on Earth: it covers {b.left:.6g} … {b.right:.6g} by "
                    f"{b.bottom:.6g} … {b.top:.6g}, the flight is at {there[0]:.6g}, {there[1]:.6g}"
                )

    def window(self, points: Floats, margin: float) -> tuple[NDArray[np.float32], MapGrid] | None:
        """The picture float32 (rows, columns) around points (n, 2), NaN where it is empty, and its grid; None where all
        of it is empty."""
        rasterio, warp = need("rasterio"), need("rasterio.warp")
        with self._open() as source:
            step = max(self.gsd_m, step_m(source, self.projection, *points.mean(axis=0).tolist()))
            corners = np.concatenate([points - margin, points + margin])
            grid = around(corners, self.projection.name, step, step)
            bands = [1, 2, 3] if source.count >= 3 else [1]
            picture = np.full((len(bands), *grid.shape), np.nan, dtype=np.float32)
            known = np.zeros(grid.shape, dtype=np.uint8)
            place = {
                "dst_transform": grid.affine,
                "dst_crs": self.projection.crs.to_wkt(),
            }
            warp.reproject(
                rasterio.band(source, bands), picture, dst_nodata=np.nan, resampling=warp.Resampling.cubic, **place
            )
            mask, mask_transform = self._mask(source, grid)
            warp.reproject(
                mask,
                known,
                src_transform=mask_transform,
                src_crs=source.crs,
                resampling=warp.Resampling.nearest,
                **place,
            )
        grey = np.where(known > 0, picture.mean(axis=0), np.nan).astype(np.float32)
        return (grey, grid) if np.isfinite(grey).any() else None

    def _mask(self, source: Any, grid: MapGrid) -> tuple[NDArray[np.uint8], Any]:
        """Read which of the map's own cells under a grid are known, and their transform. Base maps can be far larger
        than memory, so only this part is read, and no finer than half a cell of the grid."""
        rasterio, warp, windows = need("rasterio"), need("rasterio.warp"), need("rasterio.windows")
        west, south, east, north = warp.transform_bounds(self.projection.crs.to_wkt(), source.crs, *grid.bounds)
        columns = 2 * grid.shape[1]
        if source.crs.is_geographic and not source.bounds.left <= west <= east <= source.bounds.right:
            # Longitudes go on over the antimeridian, and some maps count them to 360: take all of these rows.
            west, east, columns = source.bounds.left, source.bounds.right, _MOST_MASK // (2 * grid.shape[0])
        there, back = source.transform, ~source.transform
        x, y = np.array([west, east, west, east]), np.array([south, south, north, north])
        across, down = back.a * x + back.b * y + back.c, back.d * x + back.e * y + back.f
        left, right = (int(edge) for edge in np.clip([across.min() - 1, across.max() + 2], 0, source.width))
        top, bottom = (int(edge) for edge in np.clip([down.min() - 1, down.max() + 2], 0, source.height))
        if left == right or top == bottom:
            return np.zeros((1, 1), dtype=np.uint8), there
        shape = min(bottom - top, 2 * grid.shape[0]), min(right - left, columns)
        high, wide = (bottom - top) / shape[0], (right - left) / shape[1]
        corner = there.a * left + there.b * top + there.c, there.d * left + there.e * top + there.f
        transform = rasterio.Affine(
            there.a * wide, there.b * high, corner[0], there.d * wide, there.e * high, corner[1]
        )
        window = windows.Window(left, top, right - left, bottom - top)
        return source.dataset_mask(window=window, out_shape=shape), transform

    def _open(self) -> AbstractContextManager[Any]:
        return opened(self.path, "the base map", BaseMapError)


@dataclass(frozen=True, slots=True, eq=False)
class ControlPoint:
    """A measured place (east, north, height on the map) and the sensor pixel (column, row) of a frame that shows it."""

    name: str
    frame: str
    pixel: tuple[float, float]
    place: tuple[float, float, float]


def read_control_points(path: Path, projection: Projection) -> list[ControlPoint]:
    """Control points from CSV with the columns name, frame, column, row, latitude, longitude, altitude: pixels of the
    frame as the camera made it, degrees, metres above sea level. Raises DappledError naming the line."""
    wanted = ("name", "frame", "column", "row", "latitude", "longitude", "altitude")
    found = []
    for number, row in csv_tables.rows(path, wanted):
        try:
            column, line, latitude, longitude, altitude = (float(row[name]) for name in wanted[2:])
        except ValueError:
            raise DappledError(f"{path}, line {number}: a number is missing or invalid") from None
        if not (abs(latitude) <= 90 and math.isfinite(longitude + altitude + column + line)):
            raise DappledError(f"{path}, line {number}: {latitude}, {longitude} is not a place on Earth")
        east, north = projection.to_map(latitude, longitude)
        place = (float(east), float(north), altitude)
        found.append(ControlPoint(row["name"], Path(row["frame"]).stem, (column, line), place))
    return found


def control_of(
    path: Path | None, projection: Projection, photographs: Sequence[Photograph]
) -> tuple[list[ControlPoint], list[Finding]]:
    """The points of a file on these frames, and which others are left out.

    Raises DappledError where none is left, and as `read_control_points`."""
    points = [] if path is None else read_control_points(path, projection)
    frames = {one.name for one in photographs}
    kept = [point for point in points if point.frame in frames]
    if points and not kept:
        raise DappledError(
            f"no control point is on a frame that is mapped: the first, {points[0].name}, names frame {points[0].frame}"
        )
    others = [point for point in points if point.frame not in frames]
    return kept, [finding(Code.CONTROL_UNMAPPED, Subject("control point", one.name), frame=one.frame) for one in others]
