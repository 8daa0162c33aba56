"""A base map to compare frames with: any raster picture that says where it lies."""

from __future__ import annotations

import math
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from dappled.errors import DappledError
from dappled.products.extras import need
from dappled.products.maps.earth import Projection, touch
from dappled.products.maps.map_grid import MapGrid, around

Floats = NDArray[np.float64]


class BaseMapError(DappledError):
    """A base map that can't be used; one sentence."""


@dataclass(frozen=True, slots=True)
class BaseMap:
    """A raster picture, read where frames are looked for. `gsd_m` is the frames' own: finer is not needed."""

    path: Path
    projection: Projection
    gsd_m: float

    def check(self, points: Floats) -> None:
        """Raises BaseMapError where the map can't be read, doesn't say where it lies, or lies elsewhere than the
        points (n, 2) of the flight."""
        rasterio, warp = need("rasterio"), need("rasterio.warp")
        with self._open() as source:
            box = (*points.min(axis=0), *points.max(axis=0))
            try:
                there = warp.transform_bounds(self.projection.crs.to_wkt(), source.crs, *box)
            except rasterio.errors.RasterioError as error:
                raise BaseMapError(f"the base map {self.path} and the flight have no common system: {error}") from None
            b = source.bounds
            if not touch(there, b, degrees=source.crs.is_geographic):
                raise BaseMapError(
                    f"the base map {self.path} lies elsewhere on Earth: it covers {b.left:.6g} … {b.right:.6g} by "
                    f"{b.bottom:.6g} … {b.top:.6g}, the flight is at {there[0]:.6g}, {there[1]:.6g}"
                )

    def window(self, points: Floats, margin: float) -> tuple[NDArray[np.float32], MapGrid] | None:
        """The picture float32 (rows, columns) around points (n, 2), NaN where it has nothing, and its grid; None where
        it has nothing there at all."""
        rasterio, warp = need("rasterio"), need("rasterio.warp")
        with self._open() as source:
            step = max(self.gsd_m, self._step(source, points))
            corners = np.concatenate([points - margin, points + margin])
            grid = around(corners, self.projection.name, step, step)
            bands = [1, 2, 3] if source.count >= 3 else [1]
            picture = np.full((len(bands), *grid.shape), np.nan, dtype=np.float32)
            known = np.zeros(grid.shape, dtype=np.uint8)
            place = {
                "dst_transform": rasterio.Affine(step, 0, grid.west, 0, -step, grid.north),
                "dst_crs": self.projection.crs.to_wkt(),
            }
            warp.reproject(
                rasterio.band(source, bands), picture, dst_nodata=np.nan, resampling=warp.Resampling.cubic, **place
            )
            warp.reproject(
                source.dataset_mask(),
                known,
                src_transform=source.transform,
                src_crs=source.crs,
                resampling=warp.Resampling.nearest,
                **place,
            )
        grey = np.where(known > 0, picture.mean(axis=0), np.nan).astype(np.float32)
        return (grey, grid) if np.isfinite(grey).any() else None

    def _open(self) -> Any:
        rasterio = need("rasterio")
        try:
            source = rasterio.open(self.path)
        except rasterio.errors.RasterioError as error:
            raise BaseMapError(f"the base map {self.path} can't be read: {error}") from None
        if source.crs is None or source.transform.is_identity:
            source.close()
            raise BaseMapError(f"the base map {self.path} doesn't say where it lies: give a GeoTIFF or the like")
        return source

    def _step(self, source: Any, points: Floats) -> float:
        """The map's own cell in metres, near the points."""
        if source.crs.is_geographic:
            latitude, _ = self.projection.to_geodetic(*points.mean(axis=0))
            metres = math.radians(1) * 6378137.0
            return float(
                min(abs(source.transform.a) * math.cos(math.radians(float(latitude))), abs(source.transform.e)) * metres
            )
        return float(min(abs(source.transform.a), abs(source.transform.e)) * source.crs.linear_units_factor[1])
