"""The colours of a mosaic place by place: evened out before the decoder, given back to views after it."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy import ndimage

from dappled.decode.spectrum.plane import Plane


def even_colours(plane: Plane, cfa: NDArray[Any], reference: Sequence[int], *, cell_px: int = 48) -> Plane:
    """The plane with every colour brought to the reference colours' local mean, changed in place.

    `cfa` (a, b) colour indices as in `to_plane`, `reference` the indices of green (of all colours for their plain
    mean). A colour cast that varies slowly modulates the mosaic at the colour pattern's own frequencies, and the mask
    repeats it around all its carriers: into other carriers' bands. Local means are taken over `cell_px`, several
    periods of any mask or lenslet. `developer` does the same while the frame is read.
    """
    pattern = np.asarray(cfa, dtype=np.intp)
    a, b = pattern.shape
    steps = max(1, cell_px // a), max(1, cell_px // b)
    if plane.shape[0] < a * steps[0] or plane.shape[1] < b * steps[1]:
        return plane
    cells = _cell_means(plane, (a, b), steps)
    means = {
        int(colour): np.mean([cells[at] for at, c in np.ndenumerate(pattern) if c == colour], axis=0)
        for colour in np.unique(pattern)
    }
    known = [means[colour] for colour in reference if colour in means]
    if not known:
        return plane
    wanted = np.mean(known, axis=0)
    floor = 1e-3 * max(float(wanted.mean()), 1e-12)
    for (row, column), colour in np.ndenumerate(pattern):
        mean = means[int(colour)]
        gain = np.where(mean > floor, np.clip(wanted / np.maximum(mean, floor), 0.1, 10), 1.0)
        pixels = plane[row::a, column::b]
        down, across = (
            _between((np.arange(size) + 0.5) / step, blocks)
            for size, step, blocks in zip(pixels.shape, steps, gain.shape, strict=True)
        )
        pixels *= down @ gain.astype(np.float32) @ across.T
    return plane


def _cell_means(
    plane: Plane, period: tuple[int, int], steps: tuple[int, int]
) -> dict[tuple[int, int], NDArray[np.float64]]:
    """The mean of each cell for each place (row, column) of the colour pattern; a cell is `steps` patterns."""
    (a, b), (down, across) = period, steps
    rows, columns = plane.shape[0] // (a * down), plane.shape[1] // (b * across)
    width = columns * across * b
    sums = np.empty((a, rows, width), dtype=np.float32)
    for row in range(rows):
        for place in range(a):
            first = row * down * a + place
            plane[first : first + down * a : a, :width].sum(axis=0, out=sums[place, row])
    cells = sums.reshape(a, rows, columns, across, b).sum(axis=3, dtype=np.float64) / (down * across)
    return {(row, column): cells[row, :, :, column] for row in range(a) for column in range(b)}


def local_colours(
    plane: Plane, cfa: NDArray[Any], colours: Sequence[int], reference: Sequence[int], *, cell_px: int = 12
) -> NDArray[np.float32]:
    """(len(colours), rows, columns): local means of colours, over the mean of the reference colours', 1 for grey.

    The cells are `cell_px` on a side and stand for the whole frame: a lenslet, or half a mask period. Finer chroma is
    not told apart from other carriers' bands.
    """
    pattern = np.asarray(cfa, dtype=np.intp)
    a, b = pattern.shape
    steps = min(plane.shape[0] // a, max(1, cell_px // a)), min(plane.shape[1] // b, max(1, cell_px // b))
    cells = _cell_means(plane, (a, b), steps)
    smooth = {place: ndimage.uniform_filter(mean, 3, mode="nearest") for place, mean in cells.items()}
    means = {
        int(colour): np.mean([smooth[at] for at, c in np.ndenumerate(pattern) if c == colour], axis=0)
        for colour in np.unique(pattern)
    }
    grey = np.mean([means[colour] for colour in reference], axis=0)
    grey = np.maximum(grey, 1e-3 * max(float(grey.mean()), 1e-12))
    return np.stack([np.clip(means[colour] / grey, 0, 10) for colour in colours]).astype(np.float32)


def coloured(
    views: NDArray[np.float32], grid: NDArray[np.float64], colours: NDArray[np.float32], shape: tuple[int, ...]
) -> NDArray[np.float32]:
    """Views (V, U, h, w, 3): each of (V, U, h, w) times the frame's `local_colours` (3, rows, columns).

    `grid` as in `LightField`, `shape` the frame's. All views share the colours of their place; parallax is in the grey.
    """
    height, width = views.shape[2:]
    down = _between(np.arange(height) * grid[0, 0] / shape[0] * colours.shape[1], colours.shape[1])
    along = _between(np.arange(width) * grid[1, 1] / shape[1] * colours.shape[2], colours.shape[2])
    places = np.ascontiguousarray(np.moveaxis(down @ colours @ along.T, 0, -1))
    made = np.empty((*views.shape, len(colours)), dtype=np.float32)
    np.multiply(views[..., None], places, out=made)
    return made


def _between(places: NDArray[np.floating], blocks: int) -> NDArray[np.float32]:
    """(n, blocks): linear interpolation at n places, counted in blocks from the first one's edge.

    Between the blocks' middles; constant beyond the outer ones.
    """
    at = np.clip(places - 0.5, 0, blocks - 1)
    weights: NDArray[np.float32] = np.maximum(0, 1 - np.abs(at[:, None] - np.arange(blocks))).astype(np.float32)
    return weights
