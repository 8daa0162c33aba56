"""From a raw mosaic to the linear plane that is decoded: black, white, dark frame, colour gains; or why not."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy import ndimage

from dappled.decode.errors import DecodeError
from dappled.decode.threads import each, spans

Plane = NDArray[np.float32]
LARGEST_PIXELS = 120_000_000  # 480 MB of float32; a spectrum of it takes as much again
_SMALLEST_SIDE = 16
_ROWS = 96  # at a time: a run of them stays in the cache


def to_plane(
    mosaic: NDArray[Any],
    *,
    black: float | Sequence[float],
    white: float,
    cfa: NDArray[Any] | None = None,
    balance: Sequence[float] | NDArray[np.float64] | None = None,
    dark: NDArray[Any] | None = None,
    workers: int = 1,
) -> Plane:
    """The mosaic as float32 (H, W), linear, 0 = black, 1.0 = sensor white.

    `cfa` is an (a, b) array of colour indices repeating over the mosaic, None for a monochrome sensor. `black` is one
    level or one per colour index, `white` the level of a full pixel, `dark` a mosaic of the same shape that is taken
    off in place of `black`. `balance` holds gains per colour index (`estimate_balance` makes them); None gives all
    colours of this frame the same mean, with gain 1 for the commonest colour. Raises DecodeError for a frame that
    holds no picture: wrong shape, NaN, constant, black or saturated.
    """
    pattern = np.zeros((1, 1), dtype=np.intp) if cfa is None else np.asarray(cfa, dtype=np.intp)
    levels, known = levels_of(pattern, black=black, white=white, balance=balance)
    check_frame(mosaic, white, dark=dark)
    scale = 1.0 / (white - levels)
    gains = estimate_balance(mosaic, black=black, cfa=pattern, workers=workers) if known is None else known
    plane = np.empty(mosaic.shape, dtype=np.float32)
    period = pattern.shape[0]
    factors, offsets = [], []
    for row in range(period):
        along = _repeat(pattern[row], mosaic.shape[1])
        factors.append((gains * scale)[along].astype(np.float32))
        offsets.append((levels[along] * factors[-1]).astype(np.float32))

    def develop(rows: slice) -> None:
        for row in range(period):
            lines = slice(rows.start + row, rows.stop, period)
            if dark is None:
                np.multiply(mosaic[lines], factors[row], out=plane[lines], casting="unsafe")
                plane[lines] -= offsets[row]
            else:
                np.subtract(mosaic[lines], dark[lines], out=plane[lines], dtype=np.float32, casting="unsafe")
                plane[lines] *= factors[row]

    each(develop, spans(mosaic.shape[0], period * max(1, _ROWS // period)), workers)
    if float(np.mean(plane[::7, ::7] > 1e-3)) < 0.01:
        raise DecodeError("the frame is black: nothing in it is above a thousandth of sensor white")
    return plane


def estimate_balance(
    mosaic: NDArray[Any], *, black: float | Sequence[float], cfa: NDArray[Any], workers: int = 1
) -> NDArray[np.float64]:
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

    def add(row: int) -> None:
        for lines in spans(mosaic.shape[0], a * _ROWS):  # 32 bits hold the sum of so few
            part = mosaic[lines.start + row : lines.stop : a]
            along[row] += part.sum(axis=0, dtype=np.uint32 if whole is np.uint64 else whole)

    each(add, range(a), workers)
    means = np.empty((a, b))
    for (row, column), colour in np.ndenumerate(pattern):
        count = len(range(row, mosaic.shape[0], a)) * len(range(column, mosaic.shape[1], b))
        means[row, column] = along[row, column::b].sum() / count - levels[colour]
    return colour_gains(pattern, means)


def colour_gains(pattern: NDArray[np.intp], means: NDArray[np.float64]) -> NDArray[np.float64]:
    """Gains per colour index that give all colours the mean of the commonest one, from the means (a, b) of the
    pattern's places. 1.0 for a colour without light."""
    counts = np.bincount(pattern.ravel())
    colours = np.bincount(pattern.ravel(), weights=means.ravel()) / np.maximum(counts, 1)
    reference = colours[int(np.argmax(counts))]
    lit = colours > 1e-3 * max(reference, 1e-12)
    return np.where(lit, reference / np.where(lit, colours, 1.0), 1.0)


def levels_of(
    pattern: NDArray[np.intp],
    *,
    black: float | Sequence[float],
    white: float,
    balance: Sequence[float] | NDArray[np.float64] | None,
) -> tuple[NDArray[np.float64], NDArray[np.float64] | None]:
    """Black levels and gains per colour index; None where none are given. Raises DecodeError for impossible ones."""
    colours = int(pattern.max()) + 1
    levels = np.broadcast_to(np.asarray(black, dtype=np.float64), (colours,))
    if not np.all(levels < white):
        raise DecodeError(f"the white level {white:g} is not above the black level {levels.max():g}")
    if balance is None:
        return levels, None
    gains = np.asarray(balance, dtype=np.float64)
    if gains.shape != (colours,) or not np.all(np.isfinite(gains) & (gains > 0)):
        raise DecodeError(f"the white balance needs {colours} positive gains, one per colour, and is {balance}")
    return levels, gains


def even_colours(
    plane: Plane, cfa: NDArray[Any], reference: Sequence[int], *, cell_px: int = 48, workers: int = 1
) -> Plane:
    """The plane with every colour brought to the reference colours' local mean, changed in place.

    `cfa` (a, b) colour indices as in `to_plane`, `reference` the indices of green (of all colours
    for their plain mean). A colour cast that varies slowly
    modulates the mosaic at the colour pattern's own frequencies, and the mask repeats it around all its carriers: into
    other carriers' bands. Local means are taken over `cell_px`, several periods of any mask or lenslet.
    """
    pattern = np.asarray(cfa, dtype=np.intp)
    a, b = pattern.shape
    steps = max(1, cell_px // a), max(1, cell_px // b)
    if plane.shape[0] < a * steps[0] or plane.shape[1] < b * steps[1]:
        return plane
    places: dict[int, list[tuple[int, int]]] = {}
    for (row, column), colour in np.ndenumerate(pattern):
        places.setdefault(int(colour), []).append((row, column))
    sums = _cell_means(plane, (a, b), steps, workers)
    means = {c: np.mean([sums[place] for place in at], axis=0) for c, at in places.items()}
    known = [means[colour] for colour in reference if colour in means]
    if not known:
        return plane
    wanted = np.mean(known, axis=0)
    floor = 1e-3 * max(float(wanted.mean()), 1e-12)
    # One gain image for each row of the pattern: every pixel's own colour, between the cells' middles.
    lines: list[tuple[NDArray[np.float32], NDArray[np.float32]]] = []
    for row in range(a):
        blocks = wanted.shape
        along = np.zeros((blocks[0], plane.shape[1]), dtype=np.float32)
        for column in range(b):
            mean = means[int(pattern[row, column])]
            gain = np.where(mean > floor, np.clip(wanted / np.maximum(mean, floor), 0.1, 10), 1.0).astype(np.float32)
            width = len(range(column, plane.shape[1], b))
            along[:, column::b] = gain @ _between(width, blocks[1], steps[1]).T
        lines.append((_between(len(range(row, plane.shape[0], a)), blocks[0], steps[0]), along))

    def even(rows: slice) -> None:
        for row, (down, along) in enumerate(lines):
            part = plane[rows.start + row : rows.stop : a]
            weights = down[rows.start // a : rows.start // a + len(part)]
            near = np.flatnonzero(weights.any(axis=0))  # the few cells that these rows lie between
            part *= weights[:, near] @ along[near]

    each(even, spans(plane.shape[0], a * max(1, _ROWS // a)), workers)
    return plane


def _cell_means(
    plane: Plane, period: tuple[int, int], steps: tuple[int, int], workers: int
) -> dict[tuple[int, int], NDArray[np.float64]]:
    """The mean of each cell for each place (row, column) of the colour pattern; a cell is `steps` patterns."""
    (a, b), (down, across) = period, steps
    rows, columns = plane.shape[0] // (a * down), plane.shape[1] // (b * across)
    width = columns * across * b
    sums = np.empty((a, rows, width), dtype=np.float32)

    def add(row: int) -> None:
        for place in range(a):
            first = row * down * a + place
            plane[first : first + down * a : a, :width].sum(axis=0, out=sums[place, row])

    each(add, range(rows), workers)
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
    cells = _cell_means(plane, (a, b), steps, 1)
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
    down = between(np.arange(height) * grid[0, 0] / shape[0] * colours.shape[1], colours.shape[1])
    along = between(np.arange(width) * grid[1, 1] / shape[1] * colours.shape[2], colours.shape[2])
    places = np.ascontiguousarray(np.moveaxis(down @ colours @ along.T, 0, -1))
    made = np.empty((*views.shape, len(colours)), dtype=np.float32)
    np.multiply(views[..., None], places, out=made)
    return made


def _between(size: int, blocks: int, step: int) -> NDArray[np.float32]:
    return between((np.arange(size) + 0.5) / step, blocks)


def between(places: NDArray[np.floating], blocks: int) -> NDArray[np.float32]:
    """(n, blocks): linear interpolation at n places, counted in blocks from the first one's edge.

    Between the blocks' middles; constant beyond the outer ones.
    """
    at = np.clip(places - 0.5, 0, blocks - 1)
    weights: NDArray[np.float32] = np.maximum(0, 1 - np.abs(at[:, None] - np.arange(blocks))).astype(np.float32)
    return weights


def white_gain(white_plane: Plane, cell_px: float) -> Plane:
    """What a frame is multiplied by to take off the lens' smooth vignetting: float32 (H, W), 1.0 at the brightest.

    The white frame is averaged over `cell_px` pixels (the mask's or the lenslets' period, or more), so that the
    carriers, which are modulation of the same white frame, stay.
    """
    side = max(3, 2 * round(cell_px / 2) + 1)
    smooth = ndimage.uniform_filter(ndimage.uniform_filter(white_plane, side, mode="nearest"), side, mode="nearest")
    top = float(smooth.max())
    if not top > 0:
        raise DecodeError("the white frame is black")
    return np.asarray(top / np.maximum(smooth, 0.02 * top), dtype=np.float32)


def divide(plane: Plane, gain: Plane) -> Plane:
    """The plane times a `white_gain` of the same shape. Raises DecodeError for another shape."""
    if gain.shape != plane.shape:
        raise DecodeError(f"the white frame is {_size(gain)}, the frame {_size(plane)}: take a white frame of its size")
    return plane * gain


def check_shape(mosaic: NDArray[Any]) -> None:
    """Raises DecodeError for what isn't a single plane of a size that can be decoded."""
    if mosaic.ndim != 2:
        raise DecodeError(f"a raw mosaic has two axes, this array has {mosaic.ndim}: give one plane")
    check_sides((mosaic.shape[0], mosaic.shape[1]))


def check_sides(shape: tuple[int, int]) -> None:
    """Raises DecodeError for frames that are too small to hold carriers, or too large for memory."""
    size = f"{shape[0]}×{shape[1]} px"
    if min(shape) < _SMALLEST_SIDE:
        raise DecodeError(f"the frame is {size}: too small to hold carriers")
    if shape[0] * shape[1] > LARGEST_PIXELS:
        raise DecodeError(f"the frame is {size}: more than {LARGEST_PIXELS // 10**6} megapixels, cut it first")


def check_frame(
    mosaic: NDArray[Any], white: float, *, dark: NDArray[Any] | None = None, flat: Plane | None = None
) -> None:
    """Raises DecodeError for a frame that holds no picture, or a dark or white frame of another size."""
    check_shape(mosaic)
    if dark is not None and dark.shape != mosaic.shape:
        raise DecodeError(f"the dark frame is {_size(dark)}, the frame {_size(mosaic)}: take a dark frame of its size")
    if flat is not None and flat.shape != mosaic.shape:
        raise DecodeError(
            f"the white frame is {_size(flat)}, the frame {_size(mosaic)}: take a white frame of its size"
        )
    _check_values(mosaic, white)


def _check_values(mosaic: NDArray[Any], white: float) -> None:
    if mosaic.dtype.kind not in "uif":
        raise DecodeError(f"the frame holds {mosaic.dtype} values: give integers or floats")
    if mosaic.dtype.kind == "f" and not np.isfinite(mosaic).all():
        raise DecodeError("the frame holds NaN or infinite values")
    some = mosaic[:: mosaic.shape[0] // 256 | 1, :: mosaic.shape[1] // 256 | 1]  # odd steps: all colours are among them
    if some.min() == some.max() and mosaic.min() == mosaic.max():
        raise DecodeError(f"the frame is constant: every pixel is {mosaic.flat[0]}")
    if np.mean(some >= 0.995 * white) > 0.5:
        raise DecodeError(f"the frame is saturated: more than half of its pixels are at white ({white:g})")


def _repeat(pattern_row: NDArray[np.intp], width: int) -> NDArray[np.intp]:
    return np.resize(pattern_row, width)


def _size(array: NDArray[Any]) -> str:
    return "×".join(str(side) for side in array.shape) + " px"
