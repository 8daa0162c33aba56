"""A stereo pair of two frames of a flight, whose baseline is far longer than between two eyes: what stands up is seen.

Both frames are mapped on the given ground, with the baseline to the right, so that the ground has no parallax and what
rises above it moves sideways only.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from dappled.decode.array_types import Floats, Singles
from dappled.decode.lightfield.refocus import StereoPair
from dappled.errors import DappledError
from dappled.products.maps import map_grid
from dappled.products.maps.georeference import Survey
from dappled.products.maps.hyperstereo import FORESEEN
from dappled.products.maps.photographs import Photograph

_STEEPEST = 0.3  # baseline over distance: more is hard to look at
_LEAST_OVERLAP = 0.3
_APART = (
    f"no two frames share {_LEAST_OVERLAP:.0%} of their ground from places far enough apart: a stereo pair needs "
    "frames that overlap"
)
_PROBES = 12  # places a side, to see what two frames share
_LARGEST = 4000  # px a side


@dataclass(frozen=True, slots=True, eq=False)
class FlightPair:
    """The pictures for both eyes on one ground, the frames that they are, their baseline and its share of the distance
    to the ground."""

    eyes: StereoPair
    names: tuple[str, str]
    baseline_m: float
    share: float


def check(made: Survey) -> None:
    """Raise DappledError where poses alone tell that there will be no pair; `made` needs no pictures."""
    photos = made.photographs
    if not any(
        _worth(made, one, two, FORESEEN * _LEAST_OVERLAP)
        for number, one in enumerate(photos)
        for two in photos[number + 1 :]
    ):
        raise DappledError(_APART)


def pair(made: Survey, cell_m: float | None = None) -> FlightPair:
    """The two frames with the longest baseline that can be looked at, much of whose ground is the same.

    Raises DappledError where there are none.
    """
    best: tuple[float, Photograph, Photograph] | None = None
    for number, one in enumerate(made.photographs):
        for two in made.photographs[number + 1 :]:
            score = _worth(made, one, two)
            if score > 0 and (best is None or score > best[0]):
                best = score, one, two
    if best is None:
        raise DappledError(_APART)
    left, right = sorted(best[1:], key=lambda photo: float(photo.eye.centre[0]))
    step = (right.eye.centre - left.eye.centre)[:2]
    along = step / float(np.linalg.norm(step))
    axes = np.array([along, [-along[1], along[0]]])  # to the right, and up
    rims = [map_grid.footprint(one.eye, made.ground)[:, :2] @ axes.T for one in (left, right)]
    low = np.max([rim.min(axis=0) for rim in rims], axis=0)
    high = np.min([rim.max(axis=0) for rim in rims], axis=0)
    size = (cell_m or made.gsd_m) * left.eye.scale
    size = max(size, float((high - low).max()) / _LARGEST)
    x, y = np.arange(low[0], high[0], size), np.arange(high[1], low[1], -size)
    places = np.stack(np.meshgrid(x, y), axis=-1) @ axes
    pictures = [_mapped(made, one, places, size) for one in (left, right)]
    lone = ~np.isfinite(pictures[0] + pictures[1])  # one eye alone sees it
    for picture in pictures:
        picture[lone] = np.nan
    baseline = float(np.linalg.norm(step)) / left.eye.scale
    return FlightPair(
        StereoPair(*pictures), (left.name, right.name), baseline, baseline / _above(made, left)
    )  # fmt: skip


def _worth(made: Survey, one: Photograph, two: Photograph, least: float = _LEAST_OVERLAP) -> float:
    """The baseline over the distance times the share of common ground; 0 for what can't be looked at."""
    steep = float(np.linalg.norm((two.eye.centre - one.eye.centre)[:2])) / one.eye.scale / _above(made, one)
    if not 0.005 < steep <= _STEEPEST:
        return 0.0
    rim = map_grid.footprint(one.eye, made.ground)
    low, high = rim[:, :2].min(axis=0), rim[:, :2].max(axis=0)
    share = np.linspace(0, 1, _PROBES)
    east, north = np.meshgrid(*(low[k] + share * (high[k] - low[k]) for k in (0, 1)))
    places = np.stack([east, north, made.ground.heights(east, north)], axis=-1).reshape(-1, 3)
    mine, theirs = one.eye.shows(places), two.eye.shows(places)
    common = float((mine & theirs).sum()) / max(1, int(mine.sum()))
    return steep * common if common >= least else 0.0


def _mapped(made: Survey, one: Photograph, places: Floats, size: float) -> Singles:
    """A frame on the ground at places (rows, columns, 2); NaN where it doesn't look."""
    height = made.ground.heights(places[..., 0], places[..., 1])
    at = one.eye.shown_at(np.concatenate([places, height[..., None]], axis=-1).reshape(-1, 3))
    image = np.asarray(one.image, np.float32)
    image = image[..., None] if image.ndim == 2 else image
    level = float(np.nanmedian(height))
    smooth = map_grid.smoothed_to(image, size / one.eye.scale / one.eye.gsd_m(level))
    seen = map_grid.sample(smooth, at.reshape(*places.shape[:2], 2))
    return seen[..., 0] if seen.shape[2] == 1 else seen


def _above(made: Survey, one: Photograph) -> float:
    centre = one.eye.centre
    below = float(made.ground.heights(np.array(centre[0]), np.array(centre[1])))
    return max(float(centre[2]) - below, 1e-3) if np.isfinite(below) else float(centre[2])
