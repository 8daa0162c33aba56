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


def check_shape(mosaic: NDArray[Any]) -> None:
    """Raises DecodeError for what isn't a single plane of a size that can be decoded."""
    if mosaic.ndim != 2:
        raise DecodeError(f"a raw mosaic has two axes, this array has {mosaic.ndim}: give one plane")
    check_sides((mosaic.shape[0], mosaic.shape[1]))


def check_sides(shape: tuple[int, int]) -> None:
    """Raises DecodeError for frames that are too small to hold carriers, or too large for memory."""
    size = size_text(shape)
    if min(shape) < _SMALLEST_SIDE:
        raise DecodeError(f"the frame is {size}: too small to hold carriers")
    if shape[0] * shape[1] > LARGEST_PIXELS:
        raise DecodeError(f"the frame is {size}: more than {LARGEST_PIXELS // 10**6} megapixels, cut it first")


def check_frame(
    mosaic: NDArray[Any], white: float, *, dark: NDArray[Any] | None = None, flat: Plane | None = None
) -> None:
    """Raises DecodeError for a frame that holds no picture, or a dark or white frame of another size."""
    check_shape(mosaic)
    for name, other in (("dark", dark), ("white", flat)):
        if other is not None and other.shape != mosaic.shape:
            its, ours = size_text(other.shape), size_text(mosaic.shape)
            raise DecodeError(f"the {name} frame is {its}, the frame {ours}: take a {name} frame of its size")
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


def size_text(shape: Sequence[int]) -> str:
    """A shape as a person reads it: rows × columns."""
    return "×".join(map(str, shape)) + " px"
