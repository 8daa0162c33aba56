"""Read a raster of heights: one that a flight made, or anybody's, with what is known of its errors."""

from __future__ import annotations

import math
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from dappled.bounds import claims
from dappled.decode.array_types import Singles
from dappled.errors import CallError, DappledError
from dappled.products.extras import need
from dappled.products.maps.earth import Projection
from dappled.products.maps.map_grid import MapGrid
from dappled.products.maps.rasters import opened

_SIGMA = "sigma of a height"  # as the name of the band begins


@dataclass(frozen=True, slots=True, eq=False)
class HeightRaster:
    """Heights float32 (rows, columns) on a map's grid, NaN where unknown.

    `sigma_m` is one standard deviation of each by itself, None where the raster has none; within `correlated_m` errors
    are alike. `level_sigma_m` is the error that all heights have in common, None where it is unknown.
    """

    name: str
    grid: MapGrid
    projection: Projection
    height_m: Singles
    sigma_m: Singles | None = None
    correlated_m: float = 0.0
    level_sigma_m: float | None = None


def read(path: Path) -> HeightRaster:
    """Read the heights of a file, or those that `georeference --as terrain` wrote into a flight's folder.

    Raises CallError where they can't be read, or don't lie north-up on a projection in metres.
    """
    file = path / "maps" / "terrain.tif" if path.is_dir() else path
    if not file.is_file():
        raise CallError(f"{path} has no maps/terrain.tif: make it with dappled georeference {path} --as terrain")
    try:
        with opened(file, "the heights") as source:
            return _read(source, file)
    except DappledError as error:
        raise CallError(str(error)) from error


def resampled(values: Singles, source: MapGrid, target: MapGrid) -> Singles:
    """Values (rows, columns) of one grid on another of the same projection, bilinear; NaN where unknown."""
    warp = need("rasterio.warp")
    made = np.full(target.shape, np.nan, dtype=np.float32)
    warp.reproject(
        np.asarray(values, np.float32),
        made,
        src_transform=source.affine,
        dst_transform=target.affine,
        src_crs=source.crs,
        dst_crs=target.crs,
        src_nodata=np.nan,
        dst_nodata=np.nan,
        resampling=warp.Resampling.bilinear,
    )
    return made


def _read(source: Any, file: Path) -> HeightRaster:
    """The heights of an open dataset. Raises DappledError, ClaimError and what GDAL raises."""
    turn = source.transform
    if turn.b or turn.d or turn.a <= 0 or turn.e >= 0:
        raise CallError(f"{file} does not lie north-up on its map: gdalwarp makes it so")
    if source.dtypes[0] == "uint8":
        raise CallError(f"{file} is a picture: give heights, as georeference --as terrain makes them")
    rows, columns = source.shape
    claims.check_size(8 * rows * columns, file.stat().st_size, f"{rows} × {columns} heights")
    projection = Projection(source.crs.to_string())

    def band(number: int) -> Singles:
        values = source.read(number, out_dtype="float32", masked=True).filled(np.nan)
        return np.where(np.isfinite(values), values, np.float32(np.nan))

    named = [number for number, name in enumerate(source.descriptions, 1) if (name or "").startswith(_SIGMA)]
    height = band(1)
    if not np.isfinite(height).any():
        raise CallError(f"{file} holds no known height")
    return HeightRaster(
        str(file),
        MapGrid(projection.name, turn.c, turn.f, turn.a, -turn.e, (rows, columns)),
        projection,
        height,
        band(named[0]) if named else None,
        _told(source, "DAPPLED_CORRELATED_M") or 0.0,
        _told(source, "DAPPLED_LEVEL_SIGMA_M"),
    )


def _told(source: Any, tag: str) -> float | None:
    """The number of a tag; None where there is none. Raises ValueError."""
    if (text := source.tags().get(tag)) is None:
        return None
    if not (math.isfinite(value := float(text)) and value >= 0):
        raise ValueError(f"its tag {tag} is {text!r}, not a number from 0")
    return value
