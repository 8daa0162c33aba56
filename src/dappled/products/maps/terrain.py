"""Find a survey's heights and write them: a GeoTIFF of heights and sigmas, LAS points, and ground to map frames onto.

Raster and points include the difference to the given terrain, where there is one. Frames that are mapped onto their own
heights show houses upright.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import pyproj
from numpy.typing import NDArray
from scipy import ndimage

from dappled import durable
from dappled.decode.array_types import Floats, Singles
from dappled.products.maps import cog, hyperstereo, las_files, map_grid
from dappled.products.maps.earth import Projection
from dappled.products.maps.georeference import Progress, Survey
from dappled.products.maps.ground import Flat, Ground
from dappled.products.maps.hyperstereo import Surface
from dappled.products.maps.map_grid import MapGrid

VERTICAL = "EPSG:5773"  # EGM96 height: what autopilots call mean sea level
CELL = 2.0  # of a map's cells: heights are coarser than pictures
_MARGIN, _MARGIN_M = (
    0.25,
    5.0,
)  # around the frames, of their extent and in metres: terrain must cover more than the frames
_REACH = (1, 2, 4, 8, 16)  # cells: holes are filled from the nearest heights first, and from no farther than the last
_LEAST_KNOWN = 0.05  # share of a hole's surroundings that must be known
_FADE = 8.0  # cells over which found heights fade into the given ground
SEARCH_M = (3.0, 12.0)  # below the lowest and above the highest of the given ground


@dataclass(frozen=True, slots=True, eq=False)
class TerrainModel:
    """A surface, and its height above the given terrain, float32 (rows, columns); None without given terrain."""

    surface: Surface
    difference_m: NDArray[np.float32] | None


def of(
    made: Survey, progress: Progress, *, lowest_m: float | None = None, highest_m: float | None = None
) -> TerrainModel:
    """Find a survey's terrain by hyperstereo, between two heights above sea level. Raises HyperstereoError."""
    made = made.coarse()
    grid = map_grid.grid_of(made.photographs, made.ground, made.projection, CELL * made.gsd_m)
    east, north = grid.places(made.projection)
    low, high = searched(made, made.ground.heights(east, north), lowest_m, highest_m)
    surface = hyperstereo.surface(
        made.photographs, grid, made.projection, lowest_m=low, highest_m=high, progress=progress
    )
    return over(made, surface)


def over(made: Survey, surface: Surface) -> TerrainModel:
    """A surface over the survey's given ground."""
    if isinstance(made.ground, Flat):
        return TerrainModel(surface, None)
    given = made.ground.heights(*surface.grid.places(made.projection))
    return TerrainModel(surface, (surface.height_m - given).astype(np.float32))


def check(made: Survey, *, lowest_m: float | None = None, highest_m: float | None = None) -> None:
    """Raise HyperstereoError where poses alone tell that there will be no heights; `made` needs no pictures."""
    given = np.concatenate([map_grid.footprint(one.eye, made.ground)[:, 2] for one in made.photographs])
    hyperstereo.check_overlap(made.photographs, sum(searched(made, given, lowest_m, highest_m)) / 2)


def searched(made: Survey, given: Floats, lowest_m: float | None, highest_m: float | None) -> tuple[float, float]:
    """The lowest and highest height to look for, around the given ground's."""
    low = float(np.nanmin(given)) - SEARCH_M[0] if lowest_m is None else lowest_m
    high = float(np.nanmax(given)) + SEARCH_M[1] if highest_m is None else highest_m
    lowest_eye = min(float(one.eye.centre[2]) for one in made.photographs)
    return low, min(high, low + 0.8 * (lowest_eye - low))  # nothing nearer to it than a fifth of its height


def write_raster(made: Survey, terrain: TerrainModel, path: Path) -> Path:
    """Write a COG with the bands height, sigma and, where terrain was given, difference; metres, NaN where unknown."""
    surface = terrain.surface
    bands = {"height above sea level, m": surface.height_m, "sigma of a height by itself, m": surface.sigma_m}
    tags = {
        **made.tags(), "DAPPLED_LEVEL_SIGMA_M": f"{surface.level_sigma_m:.3f}",
        "DAPPLED_CORRELATED_M": f"{hyperstereo.WINDOW * surface.grid.step_x:.4g}",
    }  # fmt: skip
    return write_bands(path, surface.grid, bands, terrain.difference_m, tags)


def write_bands(
    path: Path, grid: MapGrid, bands: Mapping[str, Singles], difference_m: Singles | None, tags: Mapping[str, str]
) -> Path:
    """Write a COG of bands by their names and, where terrain was given, the difference to it."""
    named = dict(bands) if difference_m is None else {**bands, "difference to the given terrain, m": difference_m}
    cog.write(path, grid, np.stack(list(named.values()), axis=-1), tags, tuple(named))
    return path


def write_ground(made: Survey, terrain: TerrainModel, path: Path) -> Path:
    """Write the heights as ground to map frames onto: a COG without holes, with the survey's own ground around it."""
    grid, heights = _filled_heights(terrain.surface, made.ground)
    names = ("height above sea level, m: found, between found ones, or given",)
    cog.write(path, grid, heights[..., None].astype(np.float32), made.tags(), names)
    return path


def write_points(made: Survey, terrain: TerrainModel, path: Path) -> Path:
    """Write LAS 1.4 points, on the map's projection with EGM96 heights; `sigma` and, where terrain was given,
    `difference` are extra dimensions in metres."""
    surface, known = terrain.surface, terrain.surface.known
    east, north = surface.grid.places(made.projection)
    points = np.stack([east[known], north[known], surface.height_m[known].astype(np.float64)], axis=1)
    extra = {"sigma": (surface.sigma_m[known], "m, one standard deviation")}
    if terrain.difference_m is not None:
        extra["difference"] = terrain.difference_m[known], "m above the given terrain"
    durable.make_folder(path.parent)
    with durable.replacing(path) as part:
        las_files.write(part, points, extra, crs=compound(made.projection), utc_ns=made.photographs[0].utc_ns)
    return path


def compound(projection: Projection) -> pyproj.CRS:
    """The map's coordinate system with heights above mean sea level (EGM96)."""
    vertical = pyproj.CRS.from_user_input(VERTICAL)
    return pyproj.crs.CompoundCRS(f"{projection.crs.name} + {vertical.name}", [projection.crs, vertical])


def _filled_heights(found: Surface, given: Ground) -> tuple[MapGrid, Floats]:
    """(grid, heights (rows, columns) above sea level) of a surface and, around it, of the given ground.

    Holes between found heights are filled from their surroundings. Where the given ground is unknown, so is the result.
    """
    grid = _wider(found.grid)
    inner = _inside(found.grid, grid)
    beneath = given.heights(*np.meshgrid(*grid.axes()))
    above = np.full(grid.shape, np.nan)
    above[inner] = found.height_m
    above -= beneath
    known = np.isfinite(above)
    return grid, beneath + _filled(np.where(known, above, 0.0), known)


def _wider(grid: MapGrid) -> MapGrid:
    """The grid with a margin."""
    rows, columns = grid.shape
    more = math.ceil(_MARGIN * max(rows, columns) + _MARGIN_M / grid.step_x)
    return MapGrid(
        grid.crs,
        grid.west - more * grid.step_x,
        grid.north + more * grid.step_y,
        grid.step_x,
        grid.step_y,
        (rows + 2 * more, columns + 2 * more),
    )


def _inside(inner: MapGrid, outer: MapGrid) -> tuple[slice, slice]:
    more = round((inner.west - outer.west) / outer.step_x)
    return slice(more, more + inner.shape[0]), slice(more, more + inner.shape[1])


def _filled(above: Floats, known: NDArray[np.bool_]) -> Floats:
    """Heights above the given ground (rows, columns): as they are where `known`, filled or faded elsewhere."""
    made, settled = above.copy(), known.copy()
    for reach in _REACH:
        weight = ndimage.gaussian_filter(known.astype(np.float64), reach, mode="constant", truncate=3.0)
        total = ndimage.gaussian_filter(above, reach, mode="constant", truncate=3.0)
        fresh = ~settled & (weight > _LEAST_KNOWN)
        made[fresh] = total[fresh] / weight[fresh]
        settled |= fresh
    # Beyond the last heights: those at the rim, fading out.
    if settled.any() and not settled.all():
        away, nearest = ndimage.distance_transform_edt(~settled, return_indices=True)
        made = np.where(settled, made, made[tuple(nearest)] * np.exp(-away / _FADE))
    return made
