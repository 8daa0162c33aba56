"""Find heights from overlapping frames of one flight, whose baseline is far longer than a single frame's aperture.

This is a plane sweep over the map. Each cell is tried at a series of heights; at the right one the frames that see it
agree, by normalised correlation over a window of the map. Pictures need not be rectified, any number of frames may take
part, and tilted cameras and lens distortion are handled by the eyes.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy import ndimage

from dappled.decode.array_types import Floats, Singles
from dappled.errors import DappledError
from dappled.products.maps.earth import Projection
from dappled.products.maps.map_grid import MapGrid, sample
from dappled.products.maps.photographs import Photograph

WINDOW = 9  # cells on a side, of a match: heights nearer to each other have their errors in common
LEAST_OVERLAP = 0.2  # of a frame, for a pair
FORESEEN = 0.5  # of the least overlap: where poses alone tell less, no picture will have enough
_PIXEL_SIGMA = 0.12  # of a match, in pixels
_STEP_PX = 0.7  # of parallax between heights
_LEAST_SCORE = 0.88  # lower scores come from edges and false matches: wrong more often than not
_MOST_PARTNERS = 3
_APART = "no two frames of the flight overlap by a fifth: heights need ground that was seen twice"
_BULGE = 0.05  # of a frame: its border may bend out of the box around some of its points


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


def surface(
    photographs: Sequence[Photograph],
    grid: MapGrid,
    projection: Projection,
    *,
    lowest_m: float,
    highest_m: float,
    window: int = WINDOW,
    progress: Callable[[str, int, int], None] = lambda *_: None,
) -> Surface:
    """Find the ground between two heights, from every frame against those that overlap it.

    Where several pairs give a cell a height, the one with the best score is kept. Raises HyperstereoError where no two
    frames overlap.
    """
    middle = (lowest_m + highest_m) / 2
    height = np.full(grid.shape, np.nan, dtype=np.float32)
    sigma = np.full(grid.shape, np.nan, dtype=np.float32)
    best = np.full(grid.shape, -1.0, dtype=np.float32)
    levels: list[float] = []
    boxes = _boxes(photographs, middle)
    for number, one in enumerate(photographs):
        progress("hyperstereo", number, len(photographs))
        partners = _partners(number, photographs, boxes, middle)
        if not partners:
            continue
        levels.append(_level_sigma(one, partners[0], middle))
        met = [one.eye.on_plane(one.eye.border(4), level) for level in (lowest_m, middle, highest_m)]
        cells = grid.reached(*np.concatenate(met).T)
        if any(line.start >= line.stop for line in cells):
            continue
        part = grid.part(*cells)
        found = _sweep(one, partners, part, projection=projection, heights=(lowest_m, highest_m), window=window)
        better = found.known & (found.score > best[cells])
        for mine, theirs in ((height, found.height_m), (sigma, found.sigma_m), (best, found.score)):
            mine[cells][better] = theirs[better]
    if not levels:
        raise HyperstereoError(_APART)
    score = np.where(np.isfinite(height), best, np.nan).astype(np.float32)
    return Surface(grid, height, sigma, score, float(np.median(levels)))


def _level_sigma(one: Photograph, two: Photograph, level_m: float) -> float:
    """σ of height from σ of position and attitude at both ends of the baseline: (Z/b)·√2·hypot(σ_p, Z·σ_a)."""
    above = float(one.eye.centre[2]) - level_m
    baseline = float(np.linalg.norm(two.eye.centre[:2] - one.eye.centre[:2])) / one.eye.scale
    return above / max(baseline, 1e-6) * math.sqrt(2) * math.hypot(one.position_sigma_m, above * one.attitude_sigma_rad)


def check_overlap(photographs: Sequence[Photograph], level_m: float) -> None:
    """Raise HyperstereoError where the poses tell, without a picture, that no two frames will overlap enough."""
    boxes, least = _boxes(photographs, level_m), FORESEEN * LEAST_OVERLAP
    if not any(_partners(number, photographs, boxes, level_m, least) for number in range(len(photographs))):
        raise HyperstereoError(_APART)


def meet(photographs: Sequence[Photograph], level_m: float) -> bool:
    """Whether any two frames may show the same ground at a level."""
    boxes = _boxes(photographs, level_m)
    return any(_near(number, boxes).size for number in range(len(photographs)))


def _boxes(photographs: Sequence[Photograph], level_m: float) -> Floats:
    """(n, 2, 2): the lowest and highest east and north that each frame shows at a level, and a little more."""
    rings = [one.eye.on_plane(one.eye.border(4), level_m) for one in photographs]
    boxes = np.array([(ring.min(axis=0), ring.max(axis=0)) for ring in rings])
    more = _BULGE * (boxes[:, 1] - boxes[:, 0])
    return np.stack([boxes[:, 0] - more, boxes[:, 1] + more], axis=1)


def _near(number: int, boxes: Floats) -> NDArray[np.intp]:
    """The other frames whose boxes meet that of one."""
    apart = (boxes[:, 0] > boxes[number, 1]) | (boxes[:, 1] < boxes[number, 0])
    return np.setdiff1d(np.flatnonzero(~apart.any(axis=1)), number)


def _partners(
    number: int, photographs: Sequence[Photograph], boxes: Floats, level_m: float, least: float = LEAST_OVERLAP
) -> list[Photograph]:
    """The frames with the longest baselines that still share enough ground with this one."""
    one = photographs[number]
    ring = one.eye.on_plane(one.eye.border(4), level_m)
    low, high = ring.min(axis=0), ring.max(axis=0)
    axis = np.linspace(0.02, 0.98, 12)
    east, north = np.meshgrid(low[0] + axis * (high[0] - low[0]), low[1] + axis * (high[1] - low[1]))
    places = np.stack([east.ravel(), north.ravel(), np.full(east.size, level_m)], axis=1)
    mine = one.eye.shows(places)
    shared = []
    for other in _near(number, boxes):
        two = photographs[other]
        share = float(np.sum(mine & two.eye.shows(places))) / max(1, int(mine.sum()))
        if share >= least:
            baseline = float(np.linalg.norm(two.eye.centre[:2] - one.eye.centre[:2]))
            shared.append((baseline * math.sqrt(share), int(other)))
    return [photographs[other] for _, other in sorted(shared, reverse=True)[:_MOST_PARTNERS]]


def _sweep(
    one: Photograph,
    partners: Sequence[Photograph],
    part: MapGrid,
    *,
    projection: Projection,
    heights: tuple[float, float],
    window: int,
) -> Surface:
    east, north = part.places(projection)
    slope = max(_parallax(one, two, east, north, sum(heights) / 2) for two in partners)  # px a metre
    count = int(np.clip(math.ceil((heights[1] - heights[0]) * slope / _STEP_PX), 3, 400)) + 1
    levels = np.linspace(*heights, count)
    grey = [photo.grey for photo in (one, *partners)]
    scores = np.full((count, *part.shape), -1.0, dtype=np.float32)
    for number, level in enumerate(levels):
        mine = _seen(one, grey[0], east, north, level)
        total = np.zeros(part.shape, dtype=np.float32)
        votes = np.zeros(part.shape, dtype=np.float32)
        for two, theirs in zip(partners, grey[1:], strict=True):
            alike = _correlation(mine, _seen(two, theirs, east, north, level), window)
            seen = np.isfinite(alike)
            total += np.where(seen, alike, 0)
            votes += seen
        scores[number] = np.where(votes > 0, total / np.maximum(votes, 1), -1.0)
    height, score = peaks(scores, levels)
    known = (score >= _LEAST_SCORE) & np.isfinite(height)
    height = np.where(known, height, np.nan)
    sigma = _PIXEL_SIGMA / slope * np.maximum((1 - score) / 0.02, 1)  # larger for a lower score
    return Surface(part, height.astype(np.float32), np.where(known, sigma, np.nan).astype(np.float32), score)


def peaks(scores: Singles, levels: Floats) -> tuple[Floats, Singles]:
    """(height, score) of each cell's best level, between levels by a parabola; NaN at the ends of the search."""
    top = scores.argmax(axis=0)
    inner = np.clip(top, 1, len(levels) - 2)
    before, here, after = (np.take_along_axis(scores, (inner + k)[None], axis=0)[0] for k in (-1, 0, 1))
    bend = before - 2 * here + after
    aside = np.where(bend < 0, np.clip(0.5 * (before - after) / np.where(bend < 0, bend, -1), -0.5, 0.5), 0)
    height = np.where(top == inner, levels[0] + (inner + aside) * (levels[1] - levels[0]), np.nan)
    return height, np.take_along_axis(scores, top[None], axis=0)[0]


def _parallax(one: Photograph, two: Photograph, east: Floats, north: Floats, level: float) -> float:
    """Parallax in the second frame, in pixels per metre of height, in the middle of the part."""
    place = np.array([[float(east.mean()), float(north.mean()), level]])
    moved = one.eye.on_plane(one.eye.project(place), level + 1.0)
    raised = two.eye.project(np.concatenate([moved, [[level + 1.0]]], axis=1))
    return max(float(np.linalg.norm(raised - two.eye.project(place))), 1e-3)


def _seen(one: Photograph, grey: Singles, east: Floats, north: Floats, level: float) -> Singles:
    """The frame projected on a plane at a level; NaN outside of it."""
    points = np.stack([east.ravel(), north.ravel(), np.full(east.size, level)], axis=1)
    return sample(grey, one.eye.shown_at(points).reshape(*east.shape, 2))[..., 0]


def _correlation(a: Singles, b: Singles, window: int) -> Singles:
    """Normalised correlation in a window around each cell; NaN where either is unknown in a part of it."""
    known = np.isfinite(a) & np.isfinite(b)
    a, b = np.where(known, a, 0), np.where(known, b, 0)

    def mean(values: Singles) -> Singles:
        return np.asarray(ndimage.uniform_filter(values, window, mode="constant"), np.float32)

    whole = mean(known.astype(np.float32)) > 1 - 1e-4
    mean_a, mean_b = mean(a), mean(b)
    var_a, var_b = mean(a * a) - mean_a**2, mean(b * b) - mean_b**2
    floor = 1e-6 * np.maximum(mean_a * mean_b, 1e-12)
    score = (mean(a * b) - mean_a * mean_b) / np.sqrt(np.maximum(var_a, floor) * np.maximum(var_b, floor))
    return np.where(whole, np.clip(score, -1, 1), np.nan).astype(np.float32)
