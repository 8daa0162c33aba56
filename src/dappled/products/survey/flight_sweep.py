"""Find heights from all frames of a flight at once: a plane sweep over one wide aperture, by the frames' poses and σ.

At each height every frame is projected on the map, and normalised in a window around each cell. Where the height is
right the frames agree: the mean of all pairs' correlations is at its maximum. Pairs of frames (`maps.hyperstereo`) need
fewer frames; here all of them count, and each frame's pose σ is part of a height's.
"""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np
from scipy import ndimage

from dappled.decode.array_types import Floats, Singles
from dappled.products.maps import hyperstereo, map_grid, terrain
from dappled.products.maps.georeference import Progress, Survey
from dappled.products.maps.hyperstereo import WINDOW, HyperstereoError, Surface, peaks
from dappled.products.maps.map_grid import sample
from dappled.products.maps.photographs import Photograph
from dappled.products.maps.terrain import CELL
from dappled.products.survey.synthetic_aperture import pose_blur_m

_STEP_PX = 0.7  # of parallax between heights, over the whole aperture
_MOST_LEVELS = 200
_PIXEL_SIGMA = 0.12  # of a match, in pixels
_LEAST_SCORE = 0.7  # the mean correlation of a cell's frames: lower ones are wrong more often than not
_LEAST_TEXTURE = 1e-3  # standard deviation in a window, of its mean
_APART = "no two frames of the flight show the same ground from two places"


def check(made: Survey) -> None:
    """Raise HyperstereoError where poses alone tell that no cell will be seen twice; `made` needs no pictures."""
    lowest = min(float(map_grid.footprint(one.eye, made.ground)[:, 2].min()) for one in made.photographs)
    if not hyperstereo.meet(made.photographs, lowest - terrain.SEARCH_M[0]):
        raise HyperstereoError(_APART)


def surface(
    made: Survey,
    progress: Progress,
    *,
    between: tuple[float, float] | None = None,
    cell_m: float | None = None,
    window: int = WINDOW,
) -> Surface:
    """The heights above sea level where all frames agree, searched `between` two (None: around the given ground).

    σ of a height is that of a match and of each frame's pose, over the frames' baselines. Raises HyperstereoError
    where no cell is seen twice.
    """
    made = made.coarse()
    photos = made.photographs
    grid = map_grid.grid_of(photos, made.ground, made.projection, cell_m or CELL * made.gsd_m)
    east, north = grid.places(made.projection)
    low, high = terrain.searched(made, made.ground.heights(east, north), *(between or (None, None)))
    middle = (low + high) / 2
    sigmas = _height_sigmas(made, east, north, middle)
    if not np.isfinite(sigmas).any():
        raise HyperstereoError(_APART)
    px_per_m = _PIXEL_SIGMA / np.nanmin(sigmas[0]) if np.isfinite(sigmas[0]).any() else 1.0
    levels = np.linspace(low, high, int(np.clip(math.ceil((high - low) * px_per_m / _STEP_PX), 4, _MOST_LEVELS)) + 1)
    seen_by = [(one, _grey(one, grid.step_y, middle)) for one in photos]
    scores = np.full((len(levels), *grid.shape), -1.0, dtype=np.float32)
    for number, level in enumerate(levels):
        progress("sweep", number, len(levels))
        places = np.stack([east.ravel(), north.ravel(), np.full(east.size, level)], axis=1)
        scores[number] = _agreement(seen_by, places, grid.shape, window)
    progress("sweep", len(levels), len(levels))
    height, score = peaks(scores, levels)
    known = (score >= _LEAST_SCORE) & np.isfinite(sigmas[0]) & np.isfinite(height)
    match = sigmas[0] * np.maximum((1 - score) / 0.1, 1)  # larger for a lower score
    sigma = np.where(known, np.hypot(match, sigmas[1]), np.nan)
    return Surface(
        grid, np.where(known, height, np.nan).astype(np.float32), sigma.astype(np.float32),
        np.where(known, score, np.nan).astype(np.float32),
        float(np.median([one.position_sigma_m for one in photos])),
    )  # fmt: skip


def _agreement(
    seen_by: Sequence[tuple[Photograph, Singles]], places: Floats, shape: tuple[int, int], window: int
) -> Singles:
    """(rows, columns): the mean correlation of all pairs of frames that see a place (n, 3); −1 where fewer than two
    do."""
    total = np.zeros(shape, dtype=np.float32)
    squares, count = np.zeros_like(total), np.zeros_like(total)
    for one, image in seen_by:
        at = one.eye.shown_at(places)
        if not np.isfinite(at).any():
            continue
        seen = sample(image, at.reshape(*shape, 2))[..., 0]
        normal = _normalised(seen, window)
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


def _height_sigmas(made: Survey, east: Floats, north: Floats, level: float) -> Floats:
    """(2, rows, columns) σ of a height from a match and from the poses, m; NaN where fewer than two frames see a cell.

    A height error dh moves a cell by dh·a/Z on the ground, a being the camera's place aside of the cell. Least squares
    over k frames, whose common shift is free: σ² = Σ (a − ā)²/Z² s² / (Σ (a − ā)²/Z²)² for errors s on the ground.
    """
    places = np.stack([east.ravel(), north.ravel(), np.full(east.size, level)], axis=1)
    leans, errors, poses = [], [], []
    for one in made.photographs:
        away = float(one.eye.centre[2]) - level
        lean = (one.eye.centre[:2] - places[:, :2]) / one.eye.scale / max(away, 1e-3)
        leans.append(np.where(np.isfinite(one.eye.shown_at(places)), lean, np.nan))
        errors.append(_PIXEL_SIGMA * one.eye.gsd_m(level))
        poses.append(pose_blur_m(one, level, made.facts.get(one.name)))
    lean, known = np.stack(leans), np.isfinite(np.stack(leans)[..., 0])
    count = np.maximum(known.sum(axis=0), 1)
    mean = np.nansum(lean, axis=0) / count[:, None]
    square = np.where(known, ((np.nan_to_num(lean) - mean) ** 2).sum(axis=-1), 0)
    power = square.sum(axis=0)
    seen = (known.sum(axis=0) >= 2) & (power > 0)
    found = [
        np.sqrt((square * np.array(of)[:, None] ** 2).sum(axis=0)) / np.where(seen, power, 1) for of in (errors, poses)
    ]
    return np.stack([np.where(seen, sigma, np.nan).reshape(east.shape) for sigma in found])


def _grey(one: Photograph, cell_m: float, level: float) -> Singles:
    """The frame in grey, smoothed for the map's cells."""
    return map_grid.smoothed_to(one.grey, cell_m / one.eye.gsd_m(level))
