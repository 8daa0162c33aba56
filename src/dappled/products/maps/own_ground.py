"""Ground that a flight's own frames show: heights found between them where they overlap, the given ground elsewhere.

Houses don't lean in frames that are laid on it.
"""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray
from scipy import ndimage

from dappled.products.maps.ground import Ground
from dappled.products.maps.hyperstereo import Surface
from dappled.products.maps.map_grid import MapGrid

Floats = NDArray[np.float64]
_MARGIN, _MARGIN_M = 0.25, 5.0  # around the frames, of their extent and in metres: terrain must cover more than they do
_REACH = (1, 2, 4, 8, 16)  # cells: holes are filled from the nearest heights first, and not from farther off
_LEAST_SAY = 0.05  # of a hole's surroundings that must be known
_FADE = 8.0  # cells over which what was found gives way to the given ground


def heights(found: Surface, given: Ground) -> tuple[MapGrid, Floats]:
    """(grid, heights (rows, columns) above sea level) of a surface and, around it, of the given ground.

    Holes between found heights are filled from around them; where the given ground is unknown nothing is known.
    """
    grid = _wider(found.grid)
    inner = _inside(found.grid, grid)
    beneath = given.heights(*np.meshgrid(*grid.axes()))
    above = np.full(grid.shape, np.nan)
    above[inner] = found.height_m
    above -= beneath
    known = np.isfinite(above)
    return grid, beneath + _filled(np.where(known, above, 0.0), known)


def _wider(grid: MapGrid) -> MapGrid:
    """The grid with a margin."""
    rows, columns = grid.shape
    more = math.ceil(_MARGIN * max(rows, columns) + _MARGIN_M / grid.step_x)
    return MapGrid(
        grid.crs,
        grid.west - more * grid.step_x,
        grid.north + more * grid.step_y,
        grid.step_x,
        grid.step_y,
        (rows + 2 * more, columns + 2 * more),
    )


def _inside(inner: MapGrid, outer: MapGrid) -> tuple[slice, slice]:
    more = round((inner.west - outer.west) / outer.step_x)
    return slice(more, more + inner.shape[0]), slice(more, more + inner.shape[1])


def _filled(above: Floats, known: NDArray[np.bool_]) -> Floats:
    """Heights above the given ground (rows, columns) where they are known, and what follows from them elsewhere."""
    made, settled = above.copy(), known.copy()
    for reach in _REACH:
        weight = ndimage.gaussian_filter(known.astype(np.float64), reach, mode="constant", truncate=3.0)
        total = ndimage.gaussian_filter(above, reach, mode="constant", truncate=3.0)
        fresh = ~settled & (weight > _LEAST_SAY)
        made[fresh] = total[fresh] / weight[fresh]
        settled |= fresh
    # Beyond the last heights: those at the rim, ever less of them.
    if settled.any() and not settled.all():
        away, nearest = ndimage.distance_transform_edt(~settled, return_indices=True)
        made = np.where(settled, made, made[tuple(nearest)] * np.exp(-away / _FADE))
    return made
