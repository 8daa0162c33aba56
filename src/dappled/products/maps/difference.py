"""Compare two flights over one place: what has changed between them, as a raster."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from dappled.decode.array_types import Singles
from dappled.errors import DappledError
from dappled.products.maps import cog, map_grid
from dappled.products.maps.georeference import Survey
from dappled.products.maps.map_grid import MapGrid
from dappled.products.maps.terrain import TerrainModel


class DifferenceError(DappledError):
    """Two flights can't be compared."""


@dataclass(frozen=True, slots=True, eq=False)
class MapDifference:
    """`values` float32 (rows, columns), second minus first, NaN where either is unknown; `share` of the map where both
    are known. For pictures, values are shares of the first one's mean brightness, to which the second's is matched.
    """

    grid: MapGrid
    values: Singles
    share: float


def of_pictures(first: Survey, second: Survey) -> MapDifference:
    """The change of brightness. The second's is matched to the first's by gain and offset (median and spread) over the
    common ground, so that another time of day does not count. Raises DifferenceError where there is no such ground."""
    grid = _common(first, second)
    before, after = (_whole(one, grid) for one in (first, second))
    both = np.isfinite(before) & np.isfinite(after)
    _check(both, first, second)
    spread = [float(np.subtract(*np.percentile(one[both], (75, 25)))) for one in (before, after)]
    gain = spread[0] / spread[1] if spread[1] > 0 else 1.0
    offset = float(np.median(before[both]) - gain * np.median(after[both]))
    values = np.where(both, gain * after + offset - before, np.nan) / max(float(before[both].mean()), 1e-9)
    return MapDifference(grid, values.astype(np.float32), float(both.mean()))


def of_heights(first: TerrainModel, second: TerrainModel) -> MapDifference:
    """The gain in height, m, on the first's grid. Raises DifferenceError where the projections differ, or no height is
    known to both."""
    a, b = first.surface, second.surface
    if a.grid.crs != b.grid.crs:
        raise DifferenceError(f"heights on {a.grid.crs} and {b.grid.crs} can't be compared: give both the same --crs")
    x, y = a.grid.axes()
    columns = np.round((x - b.grid.west) / b.grid.step_x - 0.5).astype(np.intp)
    rows = np.round((b.grid.north - y) / b.grid.step_y - 0.5).astype(np.intp)
    inside_c, inside_r = (columns >= 0) & (columns < b.grid.shape[1]), (rows >= 0) & (rows < b.grid.shape[0])
    other = np.full(a.grid.shape, np.nan, dtype=np.float32)
    other[np.ix_(inside_r, inside_c)] = b.height_m[np.ix_(rows[inside_r], columns[inside_c])]
    values = (other - a.height_m).astype(np.float32)
    known = np.isfinite(values)
    if not known.any():
        raise DifferenceError("the flights share no known heights: both need overlapping frames of the same ground")
    return MapDifference(a.grid, values, float(known.mean()))


def write(first: Survey, second: Survey, made: MapDifference, path: Path, unit: str) -> Path:
    """Write the difference as a COG."""
    tags = {**first.tags(), "DAPPLED_AGAINST": second.flight, "DAPPLED_UNIT": unit}
    cog.write(path, made.grid, made.values[..., None], tags, (f"{second.flight} less {first.flight}, {unit}",))
    return path


def _common(first: Survey, second: Survey) -> MapGrid:
    if first.projection.name != second.projection.name:
        raise DifferenceError(
            f"the flights lie on {first.projection.name} and {second.projection.name}: give one --crs"
        )
    step = max(first.gsd_m, second.gsd_m)
    a, b = (map_grid.grid_of(one.photographs, one.ground, one.projection, step) for one in (first, second))
    top, left = max(0, round((a.north - b.north) / step)), max(0, round((b.west - a.west) / step))
    bottom = min(a.shape[0], round((a.north - b.bounds[1]) / step))
    right = min(a.shape[1], round((b.bounds[2] - a.west) / step))
    if top >= bottom or left >= right:
        raise DifferenceError(f"{first.flight} and {second.flight} have no ground in common")
    return a.part(slice(top, bottom), slice(left, right))


def _whole(made: Survey, grid: MapGrid) -> Singles:
    drawn = np.full(grid.shape, np.nan, dtype=np.float32)
    for rows, columns, values in map_grid.pieces(made.photographs, grid, made.ground, made.projection, made.focus_m):
        drawn[rows, columns] = values.mean(axis=2)
    return drawn


def _check(both: NDArray[np.bool_], first: Survey, second: Survey) -> None:
    if int(both.sum()) < 100:
        raise DifferenceError(f"{first.flight} and {second.flight} have no ground in common")
