"""Find heights from overlapping frames of one flight, whose baselines are far longer than a single frame's aperture.

A plane sweep over the map. At each height the frames that see a cell are projected on the map, and normalised in a
window around it. Where the height is right they agree: the mean of all pairs' correlations is at its maximum. Pictures
need not be rectified, two frames or more may take part, and the eyes handle tilted cameras and lens distortion.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy import ndimage

from dappled.decode.array_types import Floats, Singles
from dappled.errors import DappledError
from dappled.products.maps.earth import Projection
from dappled.products.maps.eye import Eye
from dappled.products.maps.map_grid import MapGrid, sample, smoothed_to
from dappled.products.maps.photographs import Photograph, pose_blur_m

_PIXEL_SIGMA = 0.12  # of a match, in pixels
_STEP_PX = 0.7  # of parallax between heights, over the whole aperture
_MOST_LEVELS = 400
_LEAST_SCORE = 0.7  # the mean correlation of a cell's frames: lower ones are wrong more often than not
_LEAST_TEXTURE = 1e-3  # standard deviation in a window, of its mean
_TILE = 256  # cells a side that are swept at a time: the scores of all heights are in memory


class HyperstereoError(DappledError):
    """A flight shows no ground twice."""


@dataclass(frozen=True, slots=True, eq=False)
class Surface:
    """Heights float32 (rows, columns) above sea level on a grid, NaN where unknown; `sigma_m` is one standard deviation
    of each by itself, `score` its correlation (−1 to 1). `level_sigma_m` is the common error of the heights around a
    place that comes from uncertain poses."""

    grid: MapGrid
    height_m: Singles
    sigma_m: Singles
    score: Singles
    level_sigma_m: float = 0.0

    @property
    def known(self) -> NDArray[np.bool_]:
        return np.isfinite(self.height_m)


@dataclass(frozen=True, slots=True, eq=False)
class _Frame:
    """A photograph in grey, smoothed for the map's cells: the rows and columns that it may see, and σ of a match and of
    its pose on the ground, m."""

    eye: Eye
    grey: Singles
    reach: tuple[slice, slice]
    match_m: float
    pose_m: float

    @classmethod
    def of(cls, one: Photograph, grid: MapGrid, levels: tuple[float, ...], facts: Mapping[str, Any] | None) -> _Frame:
        middle, gsd_m = levels[1], one.eye.gsd_m(levels[1])
        image = np.asarray(one.image, dtype=np.float32)
        grey = np.ascontiguousarray(image.mean(axis=2) if image.ndim == 3 else image)[..., None]
        reach = _under(one.eye, grid, levels)
        blur_m = pose_blur_m(one, middle, facts)
        return cls(one.eye, smoothed_to(grey, grid.step_y / gsd_m), reach, _PIXEL_SIGMA * gsd_m, blur_m)

    def reaches(self, tile: tuple[slice, slice]) -> bool:
        return all(a.start < b.stop and b.start < a.stop for a, b in zip(self.reach, tile, strict=True))


def surface(
    photographs: Sequence[Photograph],
    grid: MapGrid,
    projection: Projection,
    *,
    lowest_m: float,
    highest_m: float,
    window: int = 9,
    facts: Mapping[str, Mapping[str, Any]] | None = None,
    progress: Callable[[str, int, int], None] = lambda *_: None,
) -> Surface:
    """Find the ground between two heights, where all frames that see it agree.

    `facts` of the survey, by the frames' names, may say what a frame's refinement left. Raises HyperstereoError where
    no cell is seen from two places.
    """
    middle = (lowest_m + highest_m) / 2
    known = facts or {}
    frames = [_Frame.of(one, grid, (lowest_m, middle, highest_m), known.get(one.name)) for one in photographs]
    height, sigma, score, pose = (np.full(grid.shape, np.nan, dtype=np.float32) for _ in range(4))
    tiles = list(_tiles(grid.shape))
    for number, cells in enumerate(tiles):
        progress("hyperstereo", number, len(tiles))
        rows, columns = (slice(k.start - window, k.stop + window) for k in cells)
        some = [one for one in frames if one.reaches((rows, columns))]
        if len(some) < 2:
            continue
        east, north = grid.part(rows, columns).places(projection)
        found = _swept(some, east, north, heights=(lowest_m, middle, highest_m), window=window)
        inner = slice(window, -window)
        for whole, part in zip((height, sigma, score, pose), found, strict=True):
            whole[cells] = part[inner, inner]
    progress("hyperstereo", len(tiles), len(tiles))
    if not np.isfinite(pose).any():
        raise HyperstereoError("no two frames of the flight show the same ground from two places")
    return Surface(grid, height, sigma, score, float(np.nanmedian(pose)))


def _tiles(shape: tuple[int, int]) -> Iterator[tuple[slice, slice]]:
    for top in range(0, shape[0], _TILE):
        for left in range(0, shape[1], _TILE):
            yield slice(top, min(top + _TILE, shape[0])), slice(left, min(left + _TILE, shape[1]))


def _under(eye: Eye, grid: MapGrid, levels: tuple[float, ...]) -> tuple[slice, slice]:
    """The grid's rows and columns that a frame may see at some of these levels."""
    met = np.concatenate([eye.on_plane(eye.border(4), level) for level in levels])
    lines = (grid.north - met[:, 1]) / grid.step_y, (met[:, 0] - grid.west) / grid.step_x
    rows, columns = (slice(max(0, math.floor(line.min())), math.ceil(line.max())) for line in lines)
    return rows, columns


def _swept(
    frames: Sequence[_Frame], east: Floats, north: Floats, *, heights: tuple[float, float, float], window: int
) -> tuple[Singles, Singles, Singles, Singles]:
    """(height, σ of a match, score, σ by poses) of a part of the map; NaN where unknown."""
    match, pose = _height_sigmas(frames, east, north, heights[1])
    unknown = np.full(east.shape, np.nan, dtype=np.float32)
    if not np.isfinite(match).any():
        return unknown, unknown, unknown, unknown
    slope = _PIXEL_SIGMA / float(np.nanmin(match))  # px a metre
    count = int(np.clip(math.ceil((heights[2] - heights[0]) * slope / _STEP_PX), 4, _MOST_LEVELS)) + 1
    levels = np.linspace(heights[0], heights[2], count)
    scores = np.stack([_agreement(frames, _places(east, north, level), east.shape, window) for level in levels])
    height, score = _peaks(scores, levels)
    known = (score >= _LEAST_SCORE) & np.isfinite(match) & np.isfinite(height)
    sigma = match * np.maximum((1 - score) / 0.1, 1)  # larger for a lower score
    made = [np.where(known, one, np.nan).astype(np.float32) for one in (height, sigma, score)]
    return made[0], made[1], made[2], pose.astype(np.float32)


def _places(east: Floats, north: Floats, level: float) -> Floats:
    return np.stack([east.ravel(), north.ravel(), np.full(east.size, level)], axis=1)


def _agreement(frames: Sequence[_Frame], places: Floats, shape: tuple[int, int], window: int) -> Singles:
    """(rows, columns): the mean correlation of all pairs of frames that see a place (n, 3); −1 where fewer than two
    do."""
    total = np.zeros(shape, dtype=np.float32)
    squares, count = np.zeros_like(total), np.zeros_like(total)
    for one in frames:
        normal = _normalised(sample(one.grey, one.eye.shown_at(places).reshape(*shape, 2))[..., 0], window)
        known = np.isfinite(normal)
        normal = np.where(known, normal, 0)
        total += normal
        squares += normal**2
        count += known
    pairs = count * (count - 1)
    agreed = ndimage.uniform_filter(total**2 - squares, window, mode="constant")
    power = ndimage.uniform_filter(squares * np.maximum(count - 1, 0), window, mode="constant")  # what it is at most
    return np.where((pairs > 0) & (power > 0), agreed / np.where(power > 0, power, 1), -1).astype(np.float32)


def _normalised(image: Singles, window: int) -> Singles:
    """Less its mean and over its standard deviation in a window around each cell; NaN where a part is unknown, or
    nothing is to be seen."""
    known = np.isfinite(image)
    values = np.where(known, image, 0)
    whole = ndimage.uniform_filter(known.astype(np.float32), window, mode="constant") > 1 - 1e-4
    mean = ndimage.uniform_filter(values, window, mode="constant")
    spread = np.sqrt(np.maximum(ndimage.uniform_filter(values**2, window, mode="constant") - mean**2, 0))
    textured = whole & (spread > _LEAST_TEXTURE * np.abs(mean))
    return np.where(textured, (values - mean) / np.where(textured, spread, 1), np.nan).astype(np.float32)


def _peaks(scores: Singles, levels: Floats) -> tuple[Floats, Singles]:
    """(height, score) of each cell's best level, between levels by a parabola; NaN at the ends of the search."""
    top = scores.argmax(axis=0)
    inner = np.clip(top, 1, len(levels) - 2)
    before, here, after = (np.take_along_axis(scores, (inner + k)[None], axis=0)[0] for k in (-1, 0, 1))
    bend = before - 2 * here + after
    aside = np.where(bend < 0, np.clip(0.5 * (before - after) / np.where(bend < 0, bend, -1), -0.5, 0.5), 0)
    height = np.where(top == inner, levels[0] + (inner + aside) * (levels[1] - levels[0]), np.nan)
    return height, np.take_along_axis(scores, top[None], axis=0)[0]


def _height_sigmas(frames: Sequence[_Frame], east: Floats, north: Floats, level: float) -> tuple[Floats, Floats]:
    """σ (rows, columns) of a height from a match and from the poses, m; NaN where fewer than two frames see a cell.

    A height error dh moves a cell by dh·a/Z on the ground, a being the camera's place aside of the cell. Least squares
    over k frames, whose common shift is free: σ² = Σ (a − ā)²/Z² s² / (Σ (a − ā)²/Z²)² for errors s on the ground.
    """
    places = _places(east, north, level)
    leans = []
    for one in frames:
        lean = (one.eye.centre[:2] - places[:, :2]) / one.eye.scale / max(float(one.eye.centre[2]) - level, 1e-3)
        leans.append(np.where(np.isfinite(one.eye.shown_at(places)), lean, np.nan))
    lean, known = np.stack(leans), np.isfinite(np.stack(leans)[..., 0])
    mean = np.nansum(lean, axis=0) / np.maximum(known.sum(axis=0), 1)[:, None]
    square = np.where(known, ((np.nan_to_num(lean) - mean) ** 2).sum(axis=-1), 0)
    power = square.sum(axis=0)
    seen = (known.sum(axis=0) >= 2) & (power > 0)

    def of(errors_m: list[float]) -> Floats:
        spread = np.sqrt((square * np.array(errors_m)[:, None] ** 2).sum(axis=0))
        return np.where(seen, spread / np.where(seen, power, 1), np.nan).reshape(east.shape)

    return of([one.match_m for one in frames]), of([one.pose_m for one in frames])
