"""Compare flights over one place: what has changed between two of them, or over time, as a raster with its σ."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from dappled.decode.array_types import Floats, Singles
from dappled.errors import DappledError
from dappled.products.maps import cog, heights, map_grid
from dappled.products.maps.georeference import Survey
from dappled.products.maps.ground import level_shown
from dappled.products.maps.map_grid import MapGrid
from dappled.products.maps.terrain import TerrainModel

_NORMAL = 1.4826  # standard deviation over median deviation
_LEAST_FLIGHTS = 3
_LEAST_DAYS = 1e-5  # about a second


class DifferenceError(DappledError):
    """Two flights can't be compared."""


@dataclass(frozen=True, slots=True, eq=False)
class MapDifference:
    """`values` float32 (rows, columns), second minus first, and `sigma` of each by itself, NaN where either flight is
    unknown; `share` of the map where both are known. For pictures, values are shares of the first one's mean
    brightness, to which the second's is matched. `level_sigma` is the error that all values have in common.
    """

    grid: MapGrid
    values: Singles
    sigma: Singles
    share: float
    level_sigma: float = 0.0


@dataclass(frozen=True, slots=True, eq=False)
class MapTrend:
    """How a place changed over several flights, float32 (rows, columns), NaN where fewer than three flights know it.

    `rate` per day with its σ, by a straight line through all flights; `step` the largest change between one flight and
    the next, and `step_sigma` its σ. `flights` counts those that know a cell.
    """

    grid: MapGrid
    rate: Singles
    rate_sigma: Singles
    step: Singles
    step_sigma: Singles
    flights: Singles


def of_pictures(first: Survey, second: Survey) -> MapDifference:
    """The change of brightness. The second's is matched to the first's by gain and offset (median and spread) over the
    common ground, so that another time of day does not count.

    σ of a change is what unchanged ground scatters by (the median of all changes), and what the poses of both flights
    make at edges: the brightness' slope times σ of the place. Raises DifferenceError where there is no such ground.
    """
    grid = _common(first, second)
    before, after = (_whole(one, grid) for one in (first, second))
    both = np.isfinite(before) & np.isfinite(after)
    _check(both, first, second)
    spread = [float(np.subtract(*np.percentile(one[both], (75, 25)))) for one in (before, after)]
    gain = spread[0] / spread[1] if spread[1] > 0 else 1.0
    offset = float(np.median(before[both]) - gain * np.median(after[both]))
    white = max(float(before[both].mean()), 1e-9)
    values = np.where(both, gain * after + offset - before, np.nan) / white
    noise = _NORMAL * float(np.median(np.abs(values[both] - np.median(values[both]))))
    slope = np.hypot(*np.gradient(before / white)) / grid.step_y
    placed = math.hypot(_place_sigma_m(first), _place_sigma_m(second))
    sigma = np.where(both, np.hypot(noise, np.where(np.isfinite(slope), slope, 0) * placed), np.nan)
    return MapDifference(grid, values.astype(np.float32), sigma.astype(np.float32), float(both.mean()))


def of_heights(first: TerrainModel, second: TerrainModel) -> MapDifference:
    """The gain in height, m, on the first's grid. Raises DifferenceError where the projections differ, or no height is
    known to both."""
    a, b = first.surface, second.surface
    if a.grid.crs != b.grid.crs:
        raise DifferenceError(f"heights on {a.grid.crs} and {b.grid.crs} can't be compared: give both the same --crs")
    other, theirs = (heights.resampled(one, b.grid, a.grid) for one in (b.height_m, b.sigma_m))
    values = (other - a.height_m).astype(np.float32)
    known = np.isfinite(values)
    if not known.any():
        raise DifferenceError("the flights share no known heights: both need overlapping frames of the same ground")
    sigma = np.where(known, np.hypot(a.sigma_m, theirs), np.nan).astype(np.float32)
    return MapDifference(a.grid, values, sigma, float(known.mean()), math.hypot(a.level_sigma_m, b.level_sigma_m))


def over_time(times_ns: Sequence[int], changes: Sequence[MapDifference]) -> MapTrend:
    """The trend of two or more flights' changes from the first one; `times_ns` are those of all flights, the first's
    before the others'.

    Half of the variance of each change is taken as the first flight's. Raises DifferenceError where the maps don't
    overlap, or the flights were flown at one time.
    """
    days = (np.array(times_ns) - times_ns[0]) / 86_400e9
    if float(np.ptp(days)) < _LEAST_DAYS:
        raise DifferenceError("the flights were flown at the same time: they tell no change over time")
    grid, parts = _shared([one.grid for one in changes])
    values = np.stack([np.zeros(grid.shape), *(one.values[part] for one, part in zip(changes, parts, strict=True))])
    sigmas = np.stack([one.sigma[part] for one, part in zip(changes, parts, strict=True)]).astype(np.float64)
    known = np.isfinite(sigmas)
    least = np.where(known, sigmas, np.inf).min(axis=0, keepdims=True)
    sigmas = np.concatenate([least, np.where(known, sigmas, np.inf)]) / math.sqrt(2)
    order = np.argsort(days, kind="stable")
    days, values, sigmas = days[order], values[order].astype(np.float64), np.maximum(sigmas[order], 1e-9)
    known = np.isfinite(sigmas)
    count = known.sum(axis=0)
    weight = np.where(known, 1 / sigmas**2, 0)
    total = np.maximum(weight.sum(axis=0), 1e-30)
    values = np.where(known, values, 0)
    middle, mean = (weight * days[:, None, None]).sum(axis=0) / total, (weight * values).sum(axis=0) / total
    apart = days[:, None, None] - middle
    power = (weight * apart**2).sum(axis=0)
    told = (count >= _LEAST_FLIGHTS) & (power > 0)
    rate = (weight * apart * (values - mean)).sum(axis=0) / np.where(told, power, 1)
    left = (weight * (values - mean - rate * apart) ** 2).sum(axis=0) / np.maximum(count - 2, 1)
    sigma = np.sqrt(np.maximum(left, 1) / np.where(told, power, 1))  # larger where no line fits
    step, step_sigma = _largest_step(values, sigmas)
    bands = [np.where(told, band, np.nan) for band in (rate, sigma, step, step_sigma, count)]
    return MapTrend(grid, *(band.astype(np.float32) for band in bands))


def write_trend(first: Survey, made: MapTrend, others: Sequence[str], path: Path, unit: str) -> Path:
    """Write the trend as a COG."""
    names = (
        f"change a day, {unit}", f"sigma of it, {unit}", f"largest change from one flight to the next, {unit}",
        f"sigma of it, {unit}", "flights",
    )  # fmt: skip
    bands = np.stack([made.rate, made.rate_sigma, made.step, made.step_sigma, made.flights], axis=-1)
    cog.write(
        path, made.grid, bands, {**first.tags(), "DAPPLED_AGAINST": ",".join(others), "DAPPLED_UNIT": unit}, names
    )
    return path


def write(first: Survey, second: Survey, made: MapDifference, path: Path, unit: str) -> Path:
    """Write the difference and its σ as a COG."""
    tags = {**first.tags(), "DAPPLED_AGAINST": second.flight, "DAPPLED_UNIT": unit}
    tags["DAPPLED_LEVEL_SIGMA"] = f"{made.level_sigma:.3g}"
    names = (f"{second.flight} less {first.flight}, {unit}", f"sigma of a change by itself, {unit}")
    cog.write(path, made.grid, np.stack([made.values, made.sigma], axis=-1), tags, names)
    return path


def time_ns(made: Survey) -> int:
    """The middle of a flight's frames in time."""
    return int(np.median([one.utc_ns for one in made.photographs]))


def _place_sigma_m(made: Survey) -> float:
    """σ of a place on the map: the median of the frames', as refined or by their poses."""
    found = []
    for one in made.photographs:
        facts = made.facts.get(one.name, {})
        refined = facts.get("position_sigma_m") if facts.get("refined") else None
        away = float(one.eye.centre[2]) - level_shown(made.ground, one.eye)
        found.append(math.hypot(one.position_sigma_m, away * one.attitude_sigma_rad) if refined is None else refined)
    return float(np.nanmedian(found))


def _largest_step(values: Floats, sigmas: Floats) -> tuple[Floats, Floats]:
    """(change, σ) of the flight and the one before it, among those that know a cell, that differ by most σ."""
    step, step_sigma = np.zeros(values.shape[1:]), np.ones(values.shape[1:])
    before, error = values[0].copy(), sigmas[0].copy()
    for here, sigma in zip(values[1:], sigmas[1:], strict=True):
        known = np.isfinite(sigma)
        both = known & np.isfinite(error)
        spread = np.hypot(np.where(both, sigma, 1), np.where(both, error, 1))
        larger = both & (np.abs(here - before) / spread > np.abs(step) / step_sigma)
        step, step_sigma = np.where(larger, here - before, step), np.where(larger, spread, step_sigma)
        before, error = np.where(known, here, before), np.where(known, sigma, error)
    return step, step_sigma


def _shared(grids: Sequence[MapGrid]) -> tuple[MapGrid, list[tuple[slice, slice]]]:
    """The grid that all have in common, and its rows and columns in each. Raises DifferenceError."""
    one = grids[0]
    if any(abs(grid.step_x - one.step_x) > 1e-9 * one.step_x for grid in grids):
        raise DifferenceError("the flights have cells of different sizes: give one --gsd")
    parts = map_grid.shared(grids)
    if parts is None:
        raise DifferenceError("the flights have no ground in common")
    return one.part(*parts[0]), parts


def _common(first: Survey, second: Survey) -> MapGrid:
    if first.projection.name != second.projection.name:
        raise DifferenceError(
            f"the flights lie on {first.projection.name} and {second.projection.name}: give one --crs"
        )
    step = max(first.gsd_m, second.gsd_m)
    a, b = (map_grid.grid_of(one.photographs, one.ground, one.projection, step) for one in (first, second))
    parts = map_grid.shared([a, b])
    if parts is None:
        raise DifferenceError(f"{first.flight} and {second.flight} have no ground in common")
    return a.part(*parts[0])


def _whole(made: Survey, grid: MapGrid) -> Singles:
    drawn = np.full(grid.shape, np.nan, dtype=np.float32)
    for rows, columns, values in map_grid.pieces(made.photographs, grid, made.ground, made.projection, made.focus_m):
        drawn[rows, columns] = values.mean(axis=2)
    return drawn


def _check(both: NDArray[np.bool_], first: Survey, second: Survey) -> None:
    if int(both.sum()) < 100:
        raise DifferenceError(f"{first.flight} and {second.flight} have no ground in common")
