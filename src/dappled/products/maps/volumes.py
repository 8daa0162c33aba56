"""Compare two rasters of heights: how much was filled and cut between them, each volume with its σ."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from dappled.decode.array_types import Floats, Singles
from dappled.decode.geometry.area import PlannedArea
from dappled.errors import CallError
from dappled.products.maps.heights import HeightRaster, resampled
from dappled.products.maps.map_grid import MapGrid

SURE_SIGMAS = 2.0  # a cell that changed by more has surely changed
_MOST_CELLS = 100_000_000
_LEAST_STABLE = 10  # cells
_NORMAL = 1.4826  # standard deviation over median deviation
_MEDIAN = math.sqrt(math.pi / 2)  # σ of a median over σ of a mean


@dataclass(frozen=True, slots=True)
class Earthwork:
    """A volume, and the area of its cells. σ of the heights' own errors (`cells_sigma_m3`), and of the error that all
    of them have in common; None where it is not known."""

    volume_m3: float
    area_m2: float
    cells_sigma_m3: float | None
    level_sigma_m3: float | None


@dataclass(frozen=True, slots=True)
class VolumeChange:
    """What was filled and what was cut, from 0, and `net`, fill less cut.

    Of unchanged ground, errors of the heights alone would make `noise_m3` of fill, and as much of cut.
    `sure_fill_m3` and `sure_cut_m3` are of cells that changed by more than 2 σ. `levelled_m` was taken off all changes
    by stable ground, and `level_sigma_m` is what is left of a common error. None is unknown.
    """

    fill: Earthwork
    cut: Earthwork
    net: Earthwork
    noise_m3: float | None
    sure_fill_m3: float | None
    sure_cut_m3: float | None
    levelled_m: float
    level_sigma_m: float | None
    cells: int
    unknown_cells: int
    cell_m2: float


@dataclass(frozen=True, slots=True, eq=False)
class _Compared:
    """Changes of height (rows, columns), NaN where unknown; σ of either raster, and how many cells err alike in it."""

    change_m: Floats
    wanted: NDArray[np.bool_]
    sigmas: tuple[Singles, Singles] | None
    patches: tuple[float, float]
    cell_m2: float

    @property
    def known(self) -> NDArray[np.bool_]:
        return self.wanted & np.isfinite(self.change_m)

    @property
    def sigma_m(self) -> Floats | None:
        """Of each change by itself."""
        return None if self.sigmas is None else np.hypot(self.sigmas[0], self.sigmas[1]).astype(np.float64)

    def sum_sigma_m(self, where: NDArray[np.bool_]) -> float | None:
        """σ of the sum of some changes: √(n Σσ²) where n cells err alike, at most Σσ, where all do."""
        if self.sigmas is None:
            return None
        found = []
        for sigma, patch in zip(self.sigmas, self.patches, strict=True):
            own = sigma[where].astype(np.float64)
            found.append(min(math.sqrt(patch * float(np.sum(own**2))), float(np.sum(own))))
        return math.hypot(*found)


def between(
    before: HeightRaster,
    after: HeightRaster,
    *,
    area: PlannedArea | None = None,
    stable: PlannedArea | None = None,
    sigma_m: float | None = None,
    correlated_m: float | None = None,
) -> VolumeChange:
    """The volumes between two rasters of one projection, on the first's grid, in an area or where either knows heights.

    `stable` is ground that has not changed: the median of its changes is taken off. `sigma_m` holds where a raster has
    no σ of its own, `correlated_m` in place of what the rasters say. Raises CallError.
    """
    if before.projection.crs != after.projection.crs:
        raise CallError(
            f"{before.name} lies on {before.projection.name} and {after.name} on {after.projection.name}: "
            "make both with one --crs"
        )
    found = _compared(before, after, area, sigma_m, correlated_m)
    levelled, level_sigma = 0.0, _both(before.level_sigma_m, after.level_sigma_m)
    if stable is not None:
        levelled, level_sigma = _level(_compared(before, after, stable, sigma_m, correlated_m), stable)
    known, change = found.known, found.change_m - levelled

    def work(where: NDArray[np.bool_], sign: int) -> Earthwork:
        area_m2, own = float(where.sum()) * found.cell_m2, found.sum_sigma_m(where)
        return Earthwork(
            sign * float(change[where].sum()) * found.cell_m2 + 0.0,  # no -0
            area_m2,
            None if own is None else own * found.cell_m2,
            None if level_sigma is None else level_sigma * area_m2,
        )

    raised, lowered, sigma = known & (change > 0), known & (change < 0), found.sigma_m
    noise = sure_fill = sure_cut = None
    if sigma is not None:
        noise = float(sigma[known].sum()) / math.sqrt(2 * math.pi) * found.cell_m2  # the mean of max(error, 0)
        sure = np.abs(change) > SURE_SIGMAS * sigma
        sure_fill, sure_cut = work(raised & sure, 1).volume_m3, work(lowered & sure, -1).volume_m3
    return VolumeChange(
        work(raised, 1),
        work(lowered, -1),
        work(known, 1),
        noise,
        sure_fill,
        sure_cut,
        levelled,
        level_sigma,
        int(known.sum()),
        int((found.wanted & ~known).sum()),
        found.cell_m2,
    )


def _compared(
    before: HeightRaster,
    after: HeightRaster,
    area: PlannedArea | None,
    sigma_m: float | None,
    correlated_m: float | None,
) -> _Compared:
    """The change in an area, or everywhere. Raises CallError where no height is known to both."""
    grid = before.grid if area is None else _grid_over(before, area)
    first, second = (resampled(one.height_m, one.grid, grid) for one in (before, after))
    wanted = np.isfinite(first) | np.isfinite(second)
    if area is not None:
        wanted = area.inside(before.projection, *grid.places(before.projection))
    change = second.astype(np.float64) - first
    known = wanted & np.isfinite(change)
    if not known.any():
        where = "" if area is None else f" in {area.name}"
        raise CallError(f"{before.name} and {after.name} share no known height{where}: they need common ground")
    first_sigma, second_sigma = (_sigma(one, grid, known, sigma_m) for one in (before, after))
    sigmas = None if first_sigma is None or second_sigma is None else (first_sigma, second_sigma)
    cell = grid.step_x * grid.step_y

    def patch(one: HeightRaster) -> float:
        reach = one.correlated_m if correlated_m is None else correlated_m
        return max(1.0, max(reach**2, one.grid.step_x * one.grid.step_y) / cell)

    west, south, east, north = grid.bounds
    place = before.projection.to_geodetic((west + east) / 2, (south + north) / 2)
    scale = before.projection.at(*map(float, place)).scale  # metres of the map for one on the ground
    return _Compared(change, wanted, sigmas, (patch(before), patch(after)), cell / scale**2)


def _grid_over(before: HeightRaster, area: PlannedArea) -> MapGrid:
    """The raster's grid, cut or widened to an area. Raises CallError where the area lies elsewhere."""
    grid = before.grid
    corners = np.concatenate(area.on_map(before.projection))
    (west, south), (east, north) = corners.min(axis=0), corners.max(axis=0)
    box = grid.bounds
    if not (west < box[2] and box[0] < east and south < box[3] and box[1] < north):  # also where one is not finite
        raise CallError(f"{area.name} lies elsewhere than {before.name}")
    left, right = math.floor((west - grid.west) / grid.step_x), math.ceil((east - grid.west) / grid.step_x)
    top, bottom = math.floor((grid.north - north) / grid.step_y), math.ceil((grid.north - south) / grid.step_y)
    if (right - left) * (bottom - top) > _MOST_CELLS:
        raise CallError(f"{area.name} has {bottom - top} × {right - left} cells: draw a smaller area")
    return grid.part(slice(top, bottom), slice(left, right))


def _sigma(one: HeightRaster, grid: MapGrid, known: NDArray[np.bool_], otherwise_m: float | None) -> Singles | None:
    """σ of a raster's heights on a grid; None where that of a known height is unknown."""
    if one.sigma_m is None:
        return None if otherwise_m is None else np.full(grid.shape, otherwise_m, np.float32)
    sigma = resampled(one.sigma_m, one.grid, grid)
    if otherwise_m is not None:
        sigma = np.where(np.isfinite(sigma), sigma, np.float32(otherwise_m))
    return sigma if np.isfinite(sigma[known]).all() else None


def _level(still: _Compared, stable: PlannedArea) -> tuple[float, float]:
    """(median change of ground that has not changed, its σ by what it scatters, or by σ of its heights if larger)."""
    values = still.change_m[still.known]
    if len(values) < _LEAST_STABLE:
        raise CallError(f"{stable.name} has {len(values)} known cells: stable ground needs {_LEAST_STABLE} or more")
    middle = float(np.median(values))
    scatter = _NORMAL * float(np.median(np.abs(values - middle)))
    alike = min(1.0, math.sqrt(max(still.patches) / len(values)))
    own = still.sum_sigma_m(still.known)
    return middle, _MEDIAN * max(scatter * alike, 0.0 if own is None else own / len(values))


def _both(one: float | None, other: float | None) -> float | None:
    return None if one is None or other is None else math.hypot(one, other)
