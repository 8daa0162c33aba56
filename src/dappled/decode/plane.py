"""From a raw mosaic to the linear plane that is decoded: black, white, dark frame, colour gains; or why not."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy import ndimage

from dappled.decode.errors import DecodeError

Plane = NDArray[np.float32]
LARGEST_PIXELS = 120_000_000  # 480 MB of float32; a spectrum of it takes as much again
_SMALLEST_SIDE = 16


def to_plane(
    mosaic: NDArray[Any],
    *,
    black: float | Sequence[float],
    white: float,
    cfa: NDArray[Any] | None = None,
    balance: Sequence[float] | None = None,
    dark: NDArray[Any] | None = None,
) -> Plane:
    """The mosaic as float32 (H, W), linear, 0 = black, 1.0 = sensor white.

    `cfa` is an (a, b) array of colour indices repeating over the mosaic, None for a monochrome sensor. `black` is one
    level or one per colour index, `white` the level of a full pixel, `dark` a mosaic of the same shape that is taken
    off in place of `black`. `balance` holds gains per colour index (`estimate_balance` makes them); None gives all
    colours of this frame the same mean, with gain 1 for the commonest colour. Raises DecodeError for a frame that
    holds no picture: wrong shape, NaN, constant, black or saturated.
    """
    check_shape(mosaic)
    if dark is not None and dark.shape != mosaic.shape:
        raise DecodeError(f"the dark frame is {_size(dark)}, the frame {_size(mosaic)}: take a dark frame of its size")
    pattern = np.zeros((1, 1), dtype=np.intp) if cfa is None else np.asarray(cfa, dtype=np.intp)
    colours = int(pattern.max()) + 1
    levels = np.broadcast_to(np.asarray(black, dtype=np.float64), (colours,))
    if not np.all(levels < white):
        raise DecodeError(f"the white level {white:g} is not above the black level {levels.max():g}")
    _check_values(mosaic, white)
    scale = 1.0 / (white - levels)
    if balance is None:
        gains = estimate_balance(mosaic, black=black, cfa=pattern)
    else:
        gains = np.asarray(balance, dtype=np.float64)
        if gains.shape != (colours,) or not np.all(np.isfinite(gains) & (gains > 0)):
            raise DecodeError(f"the white balance needs {colours} positive gains, one per colour, and is {balance}")
    plane = np.empty(mosaic.shape, dtype=np.float32)
    for row in range(pattern.shape[0]):
        along = _repeat(pattern[row], mosaic.shape[1])
        factor = (gains * scale)[along].astype(np.float32)
        if dark is None:
            np.multiply(mosaic[row :: pattern.shape[0]], factor, out=plane[row :: pattern.shape[0]], casting="unsafe")
            plane[row :: pattern.shape[0]] -= (levels[along] * factor).astype(np.float32)
        else:
            part = mosaic[row :: pattern.shape[0]].astype(np.float32) - dark[row :: pattern.shape[0]]
            np.multiply(part, factor, out=plane[row :: pattern.shape[0]])
    if float(np.quantile(plane[::7, ::7], 0.99)) < 1e-3:
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
    sums = np.zeros(colours)
    for (row, column), colour in np.ndenumerate(pattern):
        sums[colour] += mosaic[row :: pattern.shape[0], column :: pattern.shape[1]].mean() - levels[colour]
    means = sums / np.maximum(counts, 1)
    reference = means[int(np.argmax(counts))]
    lit = means > 1e-3 * max(reference, 1e-12)
    return np.where(lit, reference / np.where(lit, means, 1.0), 1.0)


def even_colours(plane: Plane, cfa: NDArray[Any], reference: Sequence[int], *, cell_px: int = 48) -> Plane:
    """The plane with every colour brought to the reference colours' local mean, changed in place.

    `cfa` (a, b) colour indices as in `to_plane`, `reference` the indices of green. A colour cast that varies slowly
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
    means = {c: np.mean([_block_means(plane[r::a, k::b], steps) for r, k in at], axis=0) for c, at in places.items()}
    known = [means[colour] for colour in reference if colour in means]
    if not known:
        return plane
    wanted = np.mean(known, axis=0)
    floor = 1e-3 * max(float(wanted.mean()), 1e-12)
    for colour, at in places.items():
        gain = np.where(means[colour] > floor, np.clip(wanted / np.maximum(means[colour], floor), 0.1, 10), 1.0)
        for row, column in at:
            part = plane[row::a, column::b]
            down, along = (_between(part.shape[i], gain.shape[i], steps[i]) for i in (0, 1))
            part *= down @ gain.astype(np.float32) @ along.T
    return plane


def _block_means(part: Plane, steps: tuple[int, int]) -> NDArray[np.float64]:
    rows, columns = part.shape[0] // steps[0], part.shape[1] // steps[1]
    whole = part[: rows * steps[0], : columns * steps[1]].reshape(rows, steps[0], columns, steps[1])
    return np.asarray(whole.mean(axis=(1, 3), dtype=np.float64))


def _between(size: int, blocks: int, step: int) -> NDArray[np.float32]:
    """(size, blocks): linear interpolation between the blocks' centres, constant beyond the outer ones."""
    at = np.clip((np.arange(size) + 0.5) / step - 0.5, 0, blocks - 1)
    return np.maximum(0, 1 - np.abs(at[:, None] - np.arange(blocks))).astype(np.float32)


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
    if min(mosaic.shape) < _SMALLEST_SIDE:
        raise DecodeError(f"the frame is {_size(mosaic)}: too small to hold carriers")
    if mosaic.size > LARGEST_PIXELS:
        raise DecodeError(f"the frame is {_size(mosaic)}: more than {LARGEST_PIXELS // 10**6} megapixels, cut it first")


def _check_values(mosaic: NDArray[Any], white: float) -> None:
    if mosaic.dtype.kind not in "uif":
        raise DecodeError(f"the frame holds {mosaic.dtype} values: give integers or floats")
    if mosaic.dtype.kind == "f" and not np.isfinite(mosaic).all():
        raise DecodeError("the frame holds NaN or infinite values")
    some = mosaic[:: max(1, mosaic.shape[0] // 256), :: max(1, mosaic.shape[1] // 256)]
    if some.min() == some.max() and mosaic.min() == mosaic.max():
        raise DecodeError(f"the frame is constant: every pixel is {mosaic.flat[0]}")
    if np.mean(some >= 0.995 * white) > 0.5:
        raise DecodeError(f"the frame is saturated: more than half of its pixels are at white ({white:g})")


def _repeat(pattern_row: NDArray[np.intp], width: int) -> NDArray[np.intp]:
    return np.resize(pattern_row, width)


def _size(array: NDArray[Any]) -> str:
    return "×".join(str(side) for side in array.shape) + " px"
