"""Find a survey's heights from single frames, each from its own light field, fused over the flight by their σ.

The views of one frame lie within its lens, millimetres apart: Eq 5's σ of a height grows with the square of the
distance. So heights are unknown where all frames together can't tell them from infinity, and each has its σ.

A cell of the map at height h lies at 1/Z(h) of each frame that sees it. The height is where these agree best with the
inverse distances that the frames measured; it is found by iteration: the pixel that shows a cell depends on h too.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
from scipy import ndimage

from dappled.decode.array_types import Floats, Singles
from dappled.decode.depth.depth_map import CONTRAST_WINDOW
from dappled.errors import DappledError
from dappled.findings import Code, Finding, Subject, finding
from dappled.products.maps import map_grid
from dappled.products.maps.georeference import Progress, Survey
from dappled.products.maps.ground import Flat, level_shown
from dappled.products.maps.map_grid import MapGrid
from dappled.products.maps.photographs import Photograph
from dappled.products.maps.terrain import write_bands
from dappled.products.survey.frame_depths import InverseDepth

CELL = CONTRAST_WINDOW / 2  # of a map's cells, in samples: a depth map has no finer detail than its windows
_FARTHEST_SIGMAS = 2.0  # an inverse distance that is not clear of 0 by so many σ has no height
_NEAREST, _FARTHEST = 0.2, 5.0  # of a camera's distance to the given ground: where heights are searched
_ROUNDS = 8
_HUBER = 1.5  # σ: frames that are farther off count less
_TILE = 2_000_000  # samples of all frames that are in memory at a time
_FIELD = 5  # samples a side of a frame, for the error that its attitude makes
_LEVEL_SIGMAS = 3.0  # heights that are farther from the given ground, as a whole, are doubted


class FrameTerrainError(DappledError):
    """Single frames give no heights."""


@dataclass(frozen=True, slots=True, eq=False)
class FrameTerrain:
    """Heights float32 (rows, columns) above sea level on a grid, NaN where unknown.

    `sigma_m` is one standard deviation of each by itself, `single_sigma_m` that of the best single frame there (Eq 5),
    `frames` how many frames told the height, `difference_m` the height above the given terrain (None without one).
    `level_sigma_m` is the error that all heights have in common, from poses and the scale of distances. `level_m` is
    how far they lie above the given ground as a whole (median), `focus_m` the focus that would put them on it. Heights
    within `window_m` have their errors in common.
    """

    grid: MapGrid
    height_m: Singles
    sigma_m: Singles
    single_sigma_m: Singles
    frames: Singles
    difference_m: Singles | None
    level_sigma_m: float
    level_m: float
    focus_m: float
    source: str
    window_m: float


def of(
    made: Survey, depths: dict[str, InverseDepth], progress: Progress, *, cell_m: float | None = None
) -> FrameTerrain:
    """Fuse the frames' own heights on a grid of `cell_m` (None: half a window of the depth maps).

    Raises FrameTerrainError where no frame has inverse distances or no height is known, MapError for a grid too large.
    """
    seen = [(_sampled(one, depths[one.name]), depths[one.name]) for one in made.photographs if one.name in depths]
    if not seen:
        raise FrameTerrainError("no frame has distances of its own, so single frames give no heights")
    photos = [one for one, _ in seen]
    gsd_m = min(one.eye.gsd_m(level_shown(made.ground, one.eye)) for one in photos)
    grid = map_grid.grid_of(photos, made.ground, made.projection, cell_m or CELL * gsd_m)
    found = np.full((4, *grid.shape), np.nan, dtype=np.float32)
    given = np.full(grid.shape, np.nan)
    shift = np.full(grid.shape, np.nan)
    rows = max(1, _TILE // (len(seen) * grid.shape[1]))
    smooth = {one.name: _smoothed(one, depth, grid, level_shown(made.ground, one.eye)) for one, depth in seen}
    for top in range(0, grid.shape[0], rows):
        progress("terrain of single frames", top, grid.shape[0])
        tile = slice(top, min(top + rows, grid.shape[0]))
        east, north = grid.part(tile, slice(0, grid.shape[1])).places(made.projection)
        given[tile] = made.ground.heights(east, north)
        cells = np.stack([east, north, given[tile]], axis=-1)
        found[:, tile], shift[tile] = _solved(cells, [(one, smooth[one.name]) for one in photos])
    progress("terrain of single frames", grid.shape[0], grid.shape[0])
    height, sigma, single, frames = found
    known = np.isfinite(height)
    if not known.any():
        raise FrameTerrainError(
            "single frames give no heights here: their parallax can't be told from that of infinity (Eq 5); fly lower, "
            "or use pairs of frames"
        )
    above = (height - given).astype(np.float32)
    told = 1 / made.focus_m
    focus = told + float(np.nanmedian(shift[known])) if np.isfinite(shift[known]).any() else told
    return FrameTerrain(
        grid, height, sigma, single, frames, None if isinstance(made.ground, Flat) else above,
        float(np.median([_level_sigma(one, depth, level_shown(made.ground, one.eye)) for one, depth in seen])),
        float(np.nanmedian(above)), 1 / focus if focus > 0 else math.inf, seen[0][1].ranging.source,
        CONTRAST_WINDOW * gsd_m,
    )  # fmt: skip


def _sampled(one: Photograph, depth: InverseDepth) -> Photograph:
    """The photograph, its eye that of the depth map's pixels."""
    rows, columns = depth.inverse_per_m.shape
    return replace(one, eye=one.eye_on(depth.grid, (rows, columns)), grid=depth.grid)


def write_raster(made: Survey, terrain: FrameTerrain, path: Path) -> Path:
    """Write a COG with the bands height, σ, σ of one frame (Eq 5), frames and, where terrain was given, difference;
    metres, NaN where unknown."""
    bands = {
        "height above sea level, m": terrain.height_m, "sigma of a height by itself, m": terrain.sigma_m,
        "sigma of one frame (Eq 5), m": terrain.single_sigma_m, "frames that told the height": terrain.frames,
    }  # fmt: skip
    tags = {
        **made.tags(), "DAPPLED_LEVEL_SIGMA_M": f"{terrain.level_sigma_m:.3f}", "DAPPLED_DISTANCES": terrain.source,
        "DAPPLED_CORRELATED_M": f"{terrain.window_m:.4g}",
    }  # fmt: skip
    return write_bands(path, terrain.grid, bands, terrain.difference_m, tags)


def summary(made: Survey, terrain: FrameTerrain) -> dict[str, Any]:
    """What the heights are worth, in numbers: medians over the known cells."""
    known = np.isfinite(terrain.height_m)

    def middle(band: Singles) -> float:
        return float(np.median(band[known]))

    return {
        "above_ground_m": float(
            np.median([one.eye.centre[2] - level_shown(made.ground, one.eye) for one in made.photographs])
        ),
        "known": float(known.mean()),
        "frames": middle(terrain.frames),
        "sigma_m": middle(terrain.sigma_m),
        "single_sigma_m": middle(terrain.single_sigma_m),
        "level_sigma_m": terrain.level_sigma_m,
        "above_given_m": terrain.level_m,
        "distances_from": terrain.source,
    }


def told(made: Survey, terrain: FrameTerrain) -> list[Finding]:
    """What the heights are worth by Eq 5, and a doubt where their level can't be right."""
    facts, about = summary(made, terrain), Subject("heights")
    worth = facts | {"frames": round(facts["frames"]), "relief_m": 3 * facts["single_sigma_m"]}
    said = [finding(Code.HEIGHTS_OF_FRAMES, about, **worth)]
    if abs(terrain.level_m) > _LEVEL_SIGMAS * math.hypot(terrain.level_sigma_m, made.ground.sigma_m, facts["sigma_m"]):
        source, focus_m = terrain.source, terrain.focus_m
        said.append(finding(Code.HEIGHTS_OFF, about, off_m=terrain.level_m, distances_from=source, focus_m=focus_m))
    return said


def fuse(steps: Floats, sigmas: Floats, *, first: bool = False) -> tuple[Floats, Floats]:
    """(step, σ) (rows, columns): what k frames (k, rows, columns) together say, each by its σ; NaN where none does.

    Frames that are off by more than 1.5 σ count less (Huber); `first` takes the median, to begin with. σ is larger
    where the frames disagree by more than their own.
    """
    seen = np.isfinite(steps) & np.isfinite(sigmas)
    weights = np.where(seen, 1 / np.where(seen, sigmas, 1) ** 2, 0)
    values = np.where(seen, steps, 0)
    count = seen.sum(axis=0)
    none = count == 0
    middle = _weighted_median(values, weights)
    away = np.abs(values - middle) / np.where(seen, sigmas, 1)
    weights = weights * np.minimum(1, _HUBER / np.maximum(away, _HUBER))
    total = np.where(none, 1, weights.sum(axis=0))
    mean = (weights * values).sum(axis=0) / total
    scatter = (weights * (values - mean) ** 2).sum(axis=0) / np.maximum(count - 1, 1)
    sigma = np.sqrt(np.maximum(scatter, 1) / total)
    return np.where(none, np.nan, middle if first else mean), np.where(none, np.nan, sigma)


def _weighted_median(values: Floats, weights: Floats) -> Floats:
    """(rows, columns) of (k, rows, columns): half of the weight lies on each side; the mean of two equal middles."""
    order = np.argsort(np.where(weights > 0, values, np.inf), axis=0)
    ranked, share = (np.take_along_axis(a, order, axis=0) for a in (values, weights))
    below = np.cumsum(share, axis=0)
    half = below[-1] / 2
    picks = [np.argmax(below >= half * side, axis=0)[None] for side in (1 - 1e-9, 1 + 1e-9)]
    return np.asarray(np.mean([np.take_along_axis(ranked, pick, axis=0)[0] for pick in picks], axis=0))


def _solved(cells: Floats, seen: Sequence[tuple[Photograph, tuple[Floats, Floats]]]) -> tuple[Floats, Floats]:
    """((4, rows, columns): height, σ, σ of one frame, frames; (rows, columns): inverse distance of the given ground
    less the measured one) of the cells (rows, columns, 3) of given ground."""
    given = cells[..., 2]
    height, shift = given.copy(), np.full(given.shape, np.nan)
    eyes = np.array([float(one.eye.centre[2]) for one, _ in seen])
    deepest, highest = _limits(given, eyes)
    moved, sigma = np.full(given.shape, np.nan), np.full(given.shape, np.nan)
    single, frames = sigma.copy(), sigma.copy()
    for number in range(_ROUNDS):
        at = np.concatenate([cells[..., :2], height[..., None]], axis=-1)
        looked = [_looked(one, values, at) for one, values in seen]
        steps, sigmas = (np.stack(parts) for parts in zip(*((step, error) for step, error, _ in looked), strict=True))
        if number == 0:
            shift = _median_of(np.stack([off for _, _, off in looked]))
        step, sigma = fuse(steps, sigmas, first=number < 2)
        single = np.where(np.isfinite(sigmas), sigmas, np.inf).min(axis=0)
        frames = np.isfinite(steps).sum(axis=0).astype(np.float64)
        away = eyes.mean() - height
        bent = np.nan_to_num(step / np.maximum(1 + step / away, _NEAREST))  # exact for one frame: 1/Z is no line
        made = np.clip(height + bent, deepest, highest)
        moved, height = np.abs(made - height), made
    sigma = np.hypot(sigma, moved)  # what still moves is not known better than that
    known = np.isfinite(sigma) & (height > deepest) & (height < highest)
    known &= _FARTHEST_SIGMAS * sigma < eyes.min() - height
    bands = [np.where(known, band, np.nan) for band in (height, sigma, single, frames)]
    return np.stack(bands).astype(np.float32), shift


def _median_of(values: Floats) -> Floats:
    """The median over frames; NaN where none is known."""
    known = np.isfinite(values)
    middle = _weighted_median(np.where(known, values, 0), known.astype(np.float64))
    return np.where(known.any(axis=0), middle, np.nan)


def _limits(given: Floats, eyes: Floats) -> tuple[Floats, Floats]:
    """The lowest and the highest height that are searched at each cell."""
    away = np.maximum(eyes.min() - given, 1e-3)
    return given - (_FARTHEST - 1) * away, given + (1 - _NEAREST) * away


def _looked(one: Photograph, values: tuple[Floats, Floats], at: Floats) -> tuple[Floats, Floats, Floats]:
    """(step in height, its σ, 1/Z less the measured one) that a frame says of places (rows, columns, 3)."""
    eye = one.eye
    flat = at.reshape(-1, 3)
    pixels = eye.shown_at(flat)
    axis = eye.rotation[:, 2]
    distance = ((flat - eye.centre) / (eye.scale, eye.scale, 1.0)) @ axis
    inside = np.isfinite(pixels[:, 0]) & (distance > 0)
    pick = np.where(inside[:, None], pixels, 0)[:, ::-1].T
    inverse, sigma = (
        np.where(inside, ndimage.map_coordinates(v, pick, order=1, mode="nearest"), np.nan) for v in values
    )
    off = inverse - 1 / np.where(inside, distance, 1)
    per_step = -(distance**2) / min(float(axis[2]), -0.05)  # metres of height for 1/m
    shape = at.shape[:2]
    return (off * per_step).reshape(shape), (sigma * per_step).reshape(shape), -off.reshape(shape)


def _smoothed(one: Photograph, depth: InverseDepth, grid: MapGrid, level_m: float) -> tuple[Floats, Floats]:
    """A frame's inverse distances and σ for cells of the grid: means over a cell, by weight; NaN where unknown.

    σ falls only where a cell holds more than one window of the depth map, whose pixels have their errors in common.
    """
    inverse, sigma = np.asarray(depth.inverse_per_m, np.float64), np.asarray(depth.sigma_per_m, np.float64)
    side = grid.step_y / one.eye.gsd_m(level_m)
    width = max(1, round(side))
    known = np.isfinite(inverse) & np.isfinite(sigma)
    weight = np.where(known, 1 / np.where(known, sigma, 1) ** 2, 0)
    mean = (ndimage.uniform_filter(v, width, mode="constant") for v in (weight, np.where(known, inverse, 0) * weight))
    share = ndimage.uniform_filter(known.astype(np.float64), width, mode="constant")
    total, summed = mean
    enough = share >= 0.5
    free = np.maximum(1.0, share * (width / CONTRAST_WINDOW) ** 2)
    with np.errstate(invalid="ignore", divide="ignore"):
        return np.where(enough, summed / total, np.nan), np.where(enough, np.sqrt(share / total / free), np.nan)


def _level_sigma(one: Photograph, depth: InverseDepth, level_m: float) -> float:
    """The error that a frame's heights have in common: position, attitude (by the distance aside), scale."""
    away = float(one.eye.centre[2]) - level_m
    rows, columns = one.eye.shape
    pixels = np.array([(x, y) for x in np.linspace(0, columns - 1, _FIELD) for y in np.linspace(0, rows - 1, _FIELD)])
    aside = (one.eye.on_plane(pixels, level_m) - one.eye.centre[:2]) / one.eye.scale
    turn = float(np.sqrt(np.mean(aside**2))) * one.attitude_sigma_rad
    return math.hypot(one.position_sigma_m, turn, depth.ranging.sigma_m(away))
