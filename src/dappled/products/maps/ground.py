"""Intersect rays with the ground: flat at one height, or a terrain raster (DTED, GeoTIFF …).

Heights are above sea level. `sigma_m` is the uncertainty of the ground's height; refinement weights points by it.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Protocol

import numpy as np
from numpy.typing import NDArray
from scipy import ndimage

from dappled.bounds import claims
from dappled.decode.array_types import Floats
from dappled.errors import DappledError
from dappled.products.extras import need
from dappled.products.maps.earth import Geoid, Projection, touch
from dappled.products.maps.eye import Eye
from dappled.products.maps.rasters import opened, step_m

FLAT_SIGMA_M = 1.5  # from grass to roofs, where nothing better is known
_WHAT = "the terrain"
_STEPS = 400  # at most, along a ray through a raster


class Ground(Protocol):
    """The surface that an `Eye`'s rays meet."""

    @property
    def sigma_m(self) -> float: ...

    @property
    def name(self) -> str:
        """Its name in outputs."""

    def heights(self, east: Floats, north: Floats) -> Floats:
        """Heights at places of any shape; NaN where unknown."""

    def meet(self, eye: Eye, pixels: Floats) -> Floats:
        """(n, 3): where the rays of pixels (n, 2) first meet the ground; NaN where they miss it."""

    def sees(self, eye: Eye, east: Floats, north: Floats, height: Floats) -> NDArray[np.bool_]:
        """Whether places of any shape are visible, not hidden by the ground."""


def level_shown(ground: Ground, eye: Eye) -> float:
    """The height of the ground in the middle of a view; NaN where it misses it."""
    return float(ground.meet(eye, eye.middle)[0, 2])


@dataclass(frozen=True, slots=True)
class Flat:
    """Level ground."""

    height_m: float
    sigma_m: float = FLAT_SIGMA_M

    @property
    def name(self) -> str:
        return f"flat at {self.height_m:.2f} m"

    def heights(self, east: Floats, north: Floats) -> Floats:
        return np.full(np.broadcast(east, north).shape, self.height_m)

    def meet(self, eye: Eye, pixels: Floats) -> Floats:
        places = eye.on_plane(pixels, self.height_m)
        height = np.where(np.isnan(places[:, 0]), np.nan, self.height_m)
        return np.concatenate([places, height[:, None]], axis=1)

    def sees(self, eye: Eye, east: Floats, north: Floats, height: Floats) -> NDArray[np.bool_]:
        return np.ones(np.broadcast(east, north).shape, dtype=bool)


@dataclass(frozen=True, slots=True, eq=False)
class Raster:
    """Terrain on the map's own grid: `values` (rows, columns) with NaN where unknown, node (row, column) at
    (west + column · step, north − row · step)."""

    values: Floats
    west: float
    north: float
    step_m: float
    sigma_m: float
    name: str

    def heights(self, east: Floats, north: Floats) -> Floats:
        """Bilinear between the nodes."""
        row, column = np.broadcast_arrays((self.north - north) / self.step_m, (east - self.west) / self.step_m)
        at = np.stack([row.ravel(), column.ravel()])
        at[~np.isfinite(at)] = -1.0  # outside
        return np.asarray(ndimage.map_coordinates(self.values, at, order=1, cval=np.nan)).reshape(row.shape)

    def meet(self, eye: Eye, pixels: Floats) -> Floats:
        rays = eye.rays(pixels)
        low, high = float(np.nanmin(self.values)), float(np.nanmax(self.values))
        dips = np.where(rays[:, 2] < -1e-9, rays[:, 2], np.nan)
        first = np.maximum((high + 0.01 - eye.centre[2]) / dips, 0.0)
        last = (low - 0.01 - eye.centre[2]) / dips
        span = float(np.nanmax((last - first) * np.hypot(rays[:, 0], rays[:, 1]), initial=0.0))
        steps = int(np.clip(math.ceil(2 * span / self.step_m), 2, _STEPS))

        def above(depth: Floats) -> Floats:
            at = eye.centre + rays * depth[:, None]
            return np.asarray(at[:, 2] - self.heights(at[:, 0], at[:, 1]))

        near, far = first, np.full(len(rays), np.nan)
        for count in range(1, steps + 1):
            depth = first + (last - first) * (count / steps)
            under = np.isnan(far) & (above(depth) <= 0)
            far = np.where(under, depth, far)
            near = np.where(np.isnan(far), depth, near)
        for _ in range(40):
            middle = (near + far) / 2
            under = above(middle) <= 0
            far, near = np.where(under, middle, far), np.where(under, near, middle)
        return np.asarray(eye.centre + rays * far[:, None])

    def sees(self, eye: Eye, east: Floats, north: Floats, height: Floats) -> NDArray[np.bool_]:
        aside = np.hypot(east - eye.centre[0], north - eye.centre[1])
        top = float(np.nanmax(self.values))
        rise = np.maximum(eye.centre[2] - height, 1e-6)
        reach = np.clip((top - height) / rise, 0.0, 1.0)  # beyond this share of the way nothing is higher
        steps = int(np.clip(math.ceil(float(np.nanmax(aside * reach, initial=0.0)) / self.step_m), 1, _STEPS))
        clear = np.ones(np.shape(height), dtype=bool)
        for count in range(1, steps + 1):
            share = reach * (count / steps)
            level = height + share * (eye.centre[2] - height)
            under = self.heights(east + share * (eye.centre[0] - east), north + share * (eye.centre[1] - north))
            clear &= ~(under > level + 0.1 * self.step_m + 0.05)
        return clear


def load(
    path: Path,
    projection: Projection,
    bounds: tuple[float, float, float, float],
    *,
    geoid: Geoid | None = None,
    sigma_m: float | None = None,
) -> Raster:
    """Read a terrain raster within `bounds` (west, south, east, north on the map), on the map's grid.

    Heights are taken as above sea level (DTED's are); with a `geoid` they are taken as ellipsoidal and converted.
    Raises DappledError where the file can't be read, is not georeferenced, or does not overlap.
    """
    with opened(path, _WHAT) as source:
        values, west, north, step = _posts(source, path, projection, bounds)
    if np.isnan(values).all():
        raise DappledError(f"the terrain {path} has no heights under the flight: give one that covers it")
    if geoid is not None:
        latitude, longitude = projection.to_geodetic((bounds[0] + bounds[2]) / 2, (bounds[1] + bounds[3]) / 2)
        values -= geoid.undulation_m(float(latitude), float(longitude))
    return Raster(values, west, north, step, 0.05 * step if sigma_m is None else sigma_m, path.name)


def check(path: Path) -> None:
    """Raise DappledError where a terrain raster can't be read or is not georeferenced."""
    with opened(path, _WHAT):
        pass


def _posts(
    source: Any, path: Path, projection: Projection, bounds: tuple[float, float, float, float]
) -> tuple[Floats, float, float, float]:
    """The heights under the flight, the west and north of the first post, and the step. Raises DappledError, ClaimError
    and what GDAL raises."""
    rasterio, warp = need("rasterio"), need("rasterio.warp")
    target = projection.crs.to_wkt()
    step = step_m(source, projection, (bounds[0] + bounds[2]) / 2, (bounds[1] + bounds[3]) / 2)
    margin = 4 * step
    west, south = bounds[0] - margin, bounds[1] - margin
    columns = math.ceil((bounds[2] + margin - west) / step) + 1
    rows = math.ceil((bounds[3] + margin - south) / step) + 1
    if rows * columns > 100_000_000:
        raise DappledError(f"the terrain {path} has {rows} × {columns} posts under the flight: give a coarser one")
    north = south + (rows - 1) * step
    box = warp.transform_bounds(target, source.crs, west, south, west + (columns - 1) * step, north)
    if not touch(box, source.bounds, degrees=source.crs.is_geographic):
        raise DappledError(
            f"the terrain {path} lies elsewhere: it covers {_words(source.bounds)}, the flight {_words(box)}"
        )
    claims.check_size(rows * columns * 8, rows * columns * 8, f"{rows} × {columns} posts under the flight")
    values = np.full((rows, columns), np.nan)
    # nodes are pixel centres: the affine's corner lies half a step out
    affine = rasterio.Affine(step, 0, west - step / 2, 0, -step, north + step / 2)
    warp.reproject(
        rasterio.band(source, 1),
        values,
        dst_transform=affine,
        dst_crs=target,
        dst_nodata=np.nan,
        resampling=warp.Resampling.bilinear,
    )
    return values, west, north, step


def _words(box: tuple[float, ...]) -> str:
    return f"{box[0]:.5g} … {box[2]:.5g} by {box[1]:.5g} … {box[3]:.5g}"
