"""Refocus a flight: its frames, with their poses, are the views of one aperture as wide as the flight is long.

On a plane at a height (or over terrain) all frames show the same ground in the same place, and what stands above it,
such as foliage, in a different place in each. Their mean is sharp on the ground and blurs the rest; their median drops
what hides a cell in fewer than half of the frames.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from dappled.decode.array_types import Floats, Singles
from dappled.errors import DappledError
from dappled.findings import Code, Finding, Subject, finding
from dappled.products.maps import cog, map_grid
from dappled.products.maps.georeference import Progress, Survey
from dappled.products.maps.ground import Flat, Ground, Raster, level_shown
from dappled.products.maps.map_grid import MapGrid
from dappled.products.maps.photographs import Photograph

_TILE = 6_000_000  # values of all frames that are in memory at a time
_BLURRED = 3.0  # cells: poses that blur more make no picture of the ground's detail


@dataclass(frozen=True, slots=True, eq=False)
class RefocusedGround:
    """`picture` float32 (rows, columns, c) on a grid, NaN where no frame looks, and how many frames show each cell.

    `aperture_m` is the largest distance between two cameras, `distance_m` theirs from the surface. `pose_blur_m` is the
    standard deviation of the places at which the frames show one point of it, from their poses' σ.
    """

    grid: MapGrid
    picture: Singles
    frames: Singles
    aperture_m: float
    distance_m: float
    pose_blur_m: float

    @property
    def focused_m(self) -> float:
        """Up to this height above and below the surface things are spread over less than a cell."""
        return self.grid.step_y * self.distance_m / max(self.aperture_m, 1e-9)


def refocus(
    made: Survey, progress: Progress, *, above_m: float = 0.0, way: str = "mean", cell_m: float | None = None
) -> RefocusedGround:
    """Lay all frames over each other on the survey's ground, raised by `above_m`, and take their mean or median.

    A frame weighs less in the mean, the less its pose is known. Raises DappledError for fewer than two frames,
    and where a camera is not above the surface.
    """
    photos = made.photographs
    check(made)
    ground = raised(made.ground, above_m)
    levels = [level_shown(ground, one.eye) for one in photos]
    low = [one.name for one, level in zip(photos, levels, strict=True) if not one.eye.centre[2] - level > 0.1]
    if low:
        raise DappledError(
            f"frame {low[0]} was not taken from above a surface {above_m:g} m above ground: choose a lower one"
        )
    grid = map_grid.grid_of(photos, ground, made.projection, cell_m or made.gsd_m)
    blurs = [pose_blur_m(one, level, made.facts.get(one.name)) for one, level in zip(photos, levels, strict=True)]
    images = [map_grid.smoothed(np.asarray(one.image, np.float32), one.eye, grid, ground) for one in photos]
    colours = max(image.shape[2] for image in images)
    picture = np.full((*grid.shape, colours), np.nan, dtype=np.float32)
    frames = np.zeros(grid.shape, dtype=np.float32)
    shares = 1 / (np.array(blurs) ** 2 + grid.step_y**2)
    for rows in _tiles(grid, len(photos) * colours):
        progress("refocus", rows.start, grid.shape[0])
        part = grid.part(rows, slice(0, grid.shape[1]))
        seen = np.stack(
            [
                map_grid.sample(image, map_grid.seen_at(one.eye, part, ground, made.projection))
                for one, image in zip(photos, images, strict=True)
            ]
        )
        known = np.isfinite(seen[..., 0])
        frames[rows] = known.sum(axis=0)
        picture[rows] = _median(seen) if way == "median" else _mean(seen, known * shares[:, None, None])
    progress("refocus", grid.shape[0], grid.shape[0])
    centres = np.array([one.eye.centre / (one.eye.scale, one.eye.scale, 1) for one in photos])
    aperture = float(np.max(np.linalg.norm(centres[:, None] - centres[None], axis=-1)))
    distance = float(np.median([one.eye.centre[2] - level for one, level in zip(photos, levels, strict=True)]))
    return RefocusedGround(grid, picture, frames, aperture, distance, float(np.median(blurs)))


def check(made: Survey) -> None:
    """Raise DappledError for fewer than two frames; `made` needs no pictures."""
    if len(made.photographs) < 2:
        raise DappledError("a flight of one frame has no aperture of its own: refocus its light field")


def raised(ground: Ground, above_m: float) -> Ground:
    """The ground, moved up."""
    if above_m == 0:
        return ground
    if isinstance(ground, Raster):
        name = f"{ground.name} {above_m:+g} m"
        return Raster(ground.values + above_m, ground.west, ground.north, ground.step_m, ground.sigma_m, name)
    assert isinstance(ground, Flat)
    return Flat(ground.height_m + above_m, ground.sigma_m)


def pose_blur_m(one: Photograph, level_m: float, facts: Mapping[str, Any] | None = None) -> float:
    """σ of the place at which a frame shows a point at a level: its position's, and its attitude's over the distance;
    of a refined frame (`facts` of the survey) what is left of its differences to the others."""
    left = (facts or {}).get("residual_px")
    if left is not None and facts and facts.get("refined"):
        return float(left) * one.eye.gsd_m(level_m)
    return math.hypot(one.position_sigma_m, (float(one.eye.centre[2]) - level_m) * one.attitude_sigma_rad)


def write_raster(made: Survey, found: RefocusedGround, path: Path) -> Path:
    """Write a COG of the linear picture (1.0 = sensor white) and, as its last band, the number of frames."""
    names = ("grey",) if found.picture.shape[2] == 1 else ("red", "green", "blue")
    bands = np.concatenate([found.picture, found.frames[..., None]], axis=-1)
    tags = {**made.tags(), "DAPPLED_POSE_BLUR_M": f"{found.pose_blur_m:.3f}"}
    cog.write(path, found.grid, bands, tags, (*names, "frames"))
    return path


def alike(found: Sequence[RefocusedGround]) -> list[Singles]:
    """The pictures cut to the ground that all of them have, (h, w) or (h, w, 3) each: planes at other heights reach
    farther or less far."""
    parts = map_grid.shared([one.grid for one in found])
    if parts is None:
        raise DappledError("the planes show no ground in common: choose heights nearer to each other")
    cut = [one.picture[part] for one, part in zip(found, parts, strict=True)]
    return [one[..., 0] if one.shape[2] == 1 else one for one in cut]


def summary(found: RefocusedGround) -> dict[str, Any]:
    """The picture in a few numbers."""
    seen = found.frames[found.frames > 0]
    return {
        "aperture_m": found.aperture_m,
        "distance_m": found.distance_m,
        "focused_m": found.focused_m,
        "pose_blur_m": found.pose_blur_m,
        "cell_m": found.grid.step_y,
        "frames": float(np.median(seen)) if seen.size else 0.0,
    }


def told(found: RefocusedGround) -> list[Finding]:
    """What is in focus, and a doubt where the poses blur the picture."""
    facts, about = summary(found), Subject("picture")
    cells = found.pose_blur_m / found.grid.step_y
    said = [finding(Code.REFOCUS_FOCUSED, about, **facts | {"frames": round(facts["frames"]), "blur_cells": cells})]
    if cells > _BLURRED:
        said.append(finding(Code.REFOCUS_BLURRED, about, pose_blur_m=found.pose_blur_m))
    return said


def _tiles(grid: MapGrid, deep: int) -> Iterator[slice]:
    step = max(1, _TILE // (deep * grid.shape[1]))
    for top in range(0, grid.shape[0], step):
        yield slice(top, min(top + step, grid.shape[0]))


def _mean(seen: Singles, weights: Floats) -> Singles:
    """(rows, columns, c) of (k, rows, columns, c) with weights (k, rows, columns); NaN where none counts."""
    total = weights.sum(axis=0)[..., None]
    summed = (np.nan_to_num(seen) * weights[..., None]).sum(axis=0)
    return np.where(total > 0, summed / np.where(total > 0, total, 1), np.nan).astype(np.float32)


def _median(seen: Singles) -> Singles:
    """The median of what is known; NaN where nothing is."""
    known = np.isfinite(seen)
    count = known.sum(axis=0)
    ranked = np.sort(np.where(known, seen, np.inf), axis=0)  # unknown ones last
    low, high = (
        np.take_along_axis(ranked, np.maximum(at, 0)[None], axis=0)[0] for at in ((count - 1) // 2, count // 2)
    )
    return np.where(count > 0, (low + np.where(count > 0, high, low)) / 2, np.nan).astype(np.float32)
