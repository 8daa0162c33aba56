"""A strip of frames as one map, tile by tile: memory is bounded by a tile and the frames' own pictures."""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence

import numpy as np
from numpy.typing import NDArray

from dappled.products.maps.earth import GEODETIC, Projection
from dappled.products.maps.ground import Ground
from dappled.products.maps.map_grid import (
    Image,
    MapGrid,
    around,
    degree_steps,
    footprint,
    sample,
    seen_at,
    smoothed,
    unwrapped,
)
from dappled.products.maps.photographs import Photograph

SHARPNESS = 8  # a frame's say falls off as its distance from the rim to this power: one frame shows at each place
_TILE = 1024
_MARGIN = 8  # cells: the rim's points are joined by straight lines


def grid_of(
    photographs: Sequence[Photograph], ground: Ground, projection: Projection, gsd_m: float, *, degrees: bool = False
) -> MapGrid:
    """The map that all frames fit into, on the projection or in degrees. Raises MapError."""
    met = np.concatenate([footprint(one.eye, ground) for one in photographs])
    if not degrees:
        return around(met[:, :2], projection.name, gsd_m, gsd_m)
    latitude, longitude = projection.to_geodetic(met[:, 0], met[:, 1])
    step_x, step_y = degree_steps(projection, float(met[0, 0]), float(met[0, 1]), gsd_m)
    points = np.stack([unwrapped(longitude, float(longitude[0])), latitude], axis=1)
    return around(points, GEODETIC, step_x, step_y)


def pieces(
    photographs: Sequence[Photograph],
    grid: MapGrid,
    ground: Ground,
    projection: Projection,
    focus_m: float = math.inf,
) -> Iterator[tuple[slice, slice, Image]]:
    """(rows, columns, float32 (h, w, c)) tiles that cover the grid; NaN where no frame looks.

    Every frame's say at a place grows with the distance from its own rim, so that each place is shown by the frame that
    sees it best, with soft seams.
    """
    colours = max((1 if one.image.ndim == 2 else one.image.shape[2]) for one in photographs)
    boxes = [_cells(one, grid, ground, projection) for one in photographs]
    for top in range(0, grid.shape[0], _TILE):
        for left in range(0, grid.shape[1], _TILE):
            rows = slice(top, min(top + _TILE, grid.shape[0]))
            columns = slice(left, min(left + _TILE, grid.shape[1]))
            shape = rows.stop - rows.start, columns.stop - columns.start
            total = np.zeros((*shape, colours), dtype=np.float32)
            weight = np.zeros((*shape, 1), dtype=np.float32)
            for one, box in zip(photographs, boxes, strict=True):
                near = (
                    slice(max(box[0], top), min(box[1], rows.stop)),
                    slice(max(box[2], left), min(box[3], columns.stop)),
                )
                if near[0].start >= near[0].stop or near[1].start >= near[1].stop:
                    continue
                inner = slice(near[0].start - top, near[0].stop - top), slice(near[1].start - left, near[1].stop - left)
                layers = one.layers(focus_m)
                for image, eye in layers:
                    at = seen_at(eye, grid.part(*near), ground, projection)
                    seen = sample(smoothed(image, eye, grid, ground), at)
                    say = np.where(np.isfinite(seen[..., :1]), _say(at, eye.shape), 0) / len(layers)
                    total[inner] += np.where(say > 0, seen * say, 0)
                    weight[inner] += say
            with np.errstate(invalid="ignore"):
                yield rows, columns, np.where(weight > 0, total / weight, np.nan).astype(np.float32)


def _say(at: NDArray[np.float64], shape: tuple[int, int]) -> Image:
    """(rows, columns, 1): the weight of a view of this shape where its pixels (rows, columns, 2) are looked up."""
    share = (at + 0.5) / (shape[1], shape[0])
    inward = np.minimum(share, 1 - share).min(axis=-1)
    return np.asarray((2 * np.clip(np.nan_to_num(inward), 0, 0.5) + 1e-3) ** SHARPNESS, np.float32)[..., None]


def _cells(one: Photograph, grid: MapGrid, ground: Ground, projection: Projection) -> tuple[int, int, int, int]:
    """First and last row, first and last column that a frame may reach."""
    met = footprint(one.eye, ground)
    x, y = met[:, 0], met[:, 1]
    if grid.crs == GEODETIC:
        y, x = projection.to_geodetic(x, y)
        x = unwrapped(x, (grid.bounds[0] + grid.bounds[2]) / 2)
    columns, rows = (x - grid.west) / grid.step_x, (grid.north - y) / grid.step_y
    return (
        int(np.floor(rows.min())) - _MARGIN,
        int(np.ceil(rows.max())) + _MARGIN,
        int(np.floor(columns.min())) - _MARGIN,
        int(np.ceil(columns.max())) + _MARGIN,
    )
