"""Make the linear plane that is decoded from a raw mosaic: levels, dark frame, defects, colour gains, staggered rows.

Also the other way: what colours a mosaic has from place to place, for views that were decoded without them.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy import ndimage

from dappled.decode.errors import DecodeError
from dappled.decode.spectrum.lineariser import Plane, check_frame, colour_gains, levels_of
from dappled.workers import spans

Places = tuple[NDArray[np.intp], NDArray[np.intp]]
Period = tuple[int, int]
_ROWS = 96  # at a time: a run of them stays in the cache
_STANDS_OUT = 12.0  # robust standard deviations of the dark frame's own noise
_LEAST_LEVELS = 8.0  # of the raw file: a dark frame without noise of its own has hot pixels above that
_MOST = 0.02  # of all pixels: more than this is a pattern


def to_plane(
    mosaic: NDArray[Any],
    *,
    black: float | Sequence[float],
    white: float,
    cfa: NDArray[Any] | None = None,
    balance: Sequence[float] | NDArray[np.float64] | None = None,
    dark: NDArray[Any] | None = None,
) -> Plane:
    """The mosaic as float32 (H, W), linear, 0 = black, 1.0 = sensor white.

    `cfa` is an (a, b) array of colour indices repeating over the mosaic, None for a monochrome sensor. `black` is one
    level or one per colour index, `white` the level of a full pixel, `dark` a mosaic of the same shape that is
    subtracted in place of `black`. `balance` holds gains per colour index (`estimate_balance` makes them); None gives
    all colours of this frame the same mean, with gain 1 for the commonest colour. Raises DecodeError for a frame that
    holds no picture: wrong shape, NaN, constant, black or saturated.
    """
    pattern = np.zeros((1, 1), dtype=np.intp) if cfa is None else np.asarray(cfa, dtype=np.intp)
    levels, known = levels_of(pattern, black=black, white=white, balance=balance)
    check_frame(mosaic, white, dark=dark)
    scale = 1.0 / (white - levels)
    gains = estimate_balance(mosaic, black=black, cfa=pattern) if known is None else known
    plane = np.empty(mosaic.shape, dtype=np.float32)
    period = pattern.shape[0]
    factors, offsets = [], []
    for row in range(period):
        along = np.resize(pattern[row], mosaic.shape[1])
        factors.append((gains * scale)[along].astype(np.float32))
        offsets.append((levels[along] * factors[-1]).astype(np.float32))

    for rows in spans(mosaic.shape[0], period * max(1, _ROWS // period)):
        for row in range(period):
            lines = slice(rows.start + row, rows.stop, period)
            if dark is None:
                np.multiply(mosaic[lines], factors[row], out=plane[lines], casting="unsafe")
                plane[lines] -= offsets[row]
            else:
                np.subtract(mosaic[lines], dark[lines], out=plane[lines], dtype=np.float32, casting="unsafe")
                plane[lines] *= factors[row]

    if float(np.mean(plane[::7, ::7] > 1e-3)) < 0.01:
        raise DecodeError("the frame is black: nothing in it is above a thousandth of sensor white")
    return plane


def estimate_balance(mosaic: NDArray[Any], *, black: float | Sequence[float], cfa: NDArray[Any]) -> NDArray[np.float64]:
    """Gains per colour index that give all colours the mean of the commonest one (1.0 for a colour without light).

    A mosaic of equal means has no impulse of its colour pattern left in the spectrum.
    """
    pattern = np.asarray(cfa, dtype=np.intp)
    colours = int(pattern.max()) + 1
    levels = np.broadcast_to(np.asarray(black, dtype=np.float64), (colours,))
    counts = np.bincount(pattern.ravel(), minlength=colours)
    if np.count_nonzero(counts) == 1:
        return np.ones(colours)
    a, b = pattern.shape
    along = np.zeros((a, mosaic.shape[1]))
    whole = np.uint64 if mosaic.dtype.kind == "u" else np.float64

    for row in range(a):
        for lines in spans(mosaic.shape[0], a * _ROWS):  # 32 bits hold the sum of so few rows
            part = mosaic[lines.start + row : lines.stop : a]
            along[row] += part.sum(axis=0, dtype=np.uint32 if whole is np.uint64 else whole)
    means = np.empty((a, b))
    for (row, column), colour in np.ndenumerate(pattern):
        count = len(range(row, mosaic.shape[0], a)) * len(range(column, mosaic.shape[1], b))
        means[row, column] = along[row, column::b].sum() / count - levels[colour]
    return colour_gains(pattern, means)


def white_gain(white_plane: Plane, cell_px: float) -> Plane:
    """What a frame is multiplied by to take off the lens' smooth vignetting: float32 (H, W), 1.0 at the brightest.

    The white frame is averaged over `cell_px` pixels (the mask's or the lenslets' period, or more), so that the
    carriers, which are modulation of the same white frame, stay.
    """
    side = max(3, 2 * round(cell_px / 2) + 1)
    smooth = ndimage.uniform_filter(ndimage.uniform_filter(white_plane, side, mode="nearest"), side, mode="nearest")
    top = float(smooth.max())
    if not top > 0:
        raise DecodeError("the white frame is black: take another, of an evenly lit card")
    return np.asarray(top / np.maximum(smooth, 0.02 * top), dtype=np.float32)


def find_defects(dark: NDArray[Any], period: Period = (1, 1)) -> Places:
    """(rows, columns) of pixels that are bright in a dark frame (H, W), judged separately for each place of the colour
    pattern.

    None where more than a fiftieth are: that is a pattern, which subtracting the dark frame removes.
    """
    found = np.zeros(dark.shape, dtype=bool)
    for row in range(period[0]):
        for column in range(period[1]):
            part = dark[row :: period[0], column :: period[1]].astype(np.float32)
            middle = np.median(part)
            spread_out = 1.4826 * float(np.median(np.abs(part - middle)))
            found[row :: period[0], column :: period[1]] = np.abs(part - middle) > max(
                _STANDS_OUT * spread_out, _LEAST_LEVELS
            )
    if float(found.mean()) > _MOST:
        found[:] = False
    rows, columns = np.nonzero(found)
    return rows, columns


def mended(mosaic: NDArray[Any], defects: Places, period: Period = (1, 1)) -> NDArray[Any]:
    """The mosaic with its defects as the mean of their sound neighbours of the same colour; others stay as they are.

    A defect without a sound neighbour keeps its value.
    """
    rows, columns = defects
    if not len(rows):
        return mosaic
    height, width = mosaic.shape
    bad = np.zeros(mosaic.shape, dtype=bool)
    bad[rows, columns] = True
    total, count = np.zeros(len(rows)), np.zeros(len(rows))
    for down, right in ((-1, 0), (1, 0), (0, -1), (0, 1)):
        y, x = rows + down * period[0], columns + right * period[1]
        inside = (y >= 0) & (y < height) & (x >= 0) & (x < width)
        y, x = np.where(inside, y, 0), np.where(inside, x, 0)
        sound = inside & ~bad[y, x]
        total += np.where(sound, mosaic[y, x], 0)
        count += sound
    out = mosaic.copy()
    known = count > 0
    values = total[known] / count[known]
    out[rows[known], columns[known]] = np.rint(values) if mosaic.dtype.kind in "ui" else values
    return out


def spread(plane: Plane) -> Plane:
    """Spread a staggered plane (H, W) out to float32 (H, 2W): sample (r, c) to column 2c + (r mod 2), doubled, rest 0.

    For chips whose every second row sits half a column to the right: the 45° lattice of a Super CCD, as it is stored.
    Read as a rectangle such a frame is sampled unevenly, and each carrier gets a false twin. After spreading, every
    sample is where it was taken, and half of the places are empty. Those repeat the spectrum around (½, ½)
    cycles/pixel, as every 45° lattice does; within |fy| + |fx| < ½ there is no repetition. Local means do not change.
    """
    wide = np.zeros((plane.shape[0], 2 * plane.shape[1]), dtype=np.float32)
    np.multiply(plane[0::2], 2, out=wide[0::2, 0::2])
    np.multiply(plane[1::2], 2, out=wide[1::2, 1::2])
    return wide


def colour_index(shape: tuple[int, int], cfa: NDArray[np.integer]) -> NDArray[np.int8]:
    """int8 (H, W): which colour each pixel of a frame of this shape is, `cfa` (a, b) repeating over it."""
    whole = [-(-n // m) for n, m in zip(shape, cfa.shape, strict=True)]
    return np.tile(cfa.astype(np.int8), whole)[: shape[0], : shape[1]]


def local_colours(
    plane: Plane, cfa: NDArray[Any], colours: Sequence[int], reference: Sequence[int], *, cell_px: int = 12
) -> NDArray[np.float32]:
    """(len(colours), rows, columns): local means of colours, over the mean of the reference colours', 1 for grey.

    The cells are `cell_px` on a side and cover the whole frame: a lenslet, or half a mask period. Finer chroma is
    indistinguishable from other carriers' bands.
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


def _between(places: NDArray[np.floating], blocks: int) -> NDArray[np.float32]:
    """(n, blocks): linear interpolation at n places, counted in blocks from the first one's edge.

    Between the blocks' middles; constant beyond the outer ones.
    """
    at = np.clip(places - 0.5, 0, blocks - 1)
    weights: NDArray[np.float32] = np.maximum(0, 1 - np.abs(at[:, None] - np.arange(blocks))).astype(np.float32)
    return weights
