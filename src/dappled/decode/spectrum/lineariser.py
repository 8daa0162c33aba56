"""Make a camera's mosaics linear row by row, so that the whole plane need not lie in memory before its transform.

`lineariser(...)` holds what all frames of a camera share. `Lineariser.apply(mosaic)` finds the frame's own colour gains
in one sweep and returns `LinearRows`, which convert rows when the transform reads them. The result is that of
`plane.to_plane` followed by the local evening of colours, to the rounding of float32.
"""

from __future__ import annotations

import itertools
from collections.abc import Sequence
from dataclasses import dataclass
from functools import lru_cache
from typing import Any, TypeAlias

import numpy as np
from numpy.typing import NDArray

from dappled.decode.errors import DecodeError
from dappled.workers import each, spans

Plane = NDArray[np.float32]
LARGEST_PIXELS = 120_000_000  # 480 MB of float32; a spectrum of it takes as much again
_SMALLEST_SIDE = 16  # pixels
_ROWS = 96  # at a time: with fewer the interpreter's overhead outweighs what the cache gains
_PRODUCT = 250_000  # multiplications in a matrix product: larger ones would start BLAS' own threads beside ours
_STEP = 29  # every so many rows and columns are sampled for the mean: odd, so that all colours are among them
_FOUR_FIT = 1 << 14  # four values below it add up within 16 bits

Between: TypeAlias = tuple[NDArray[np.intp], NDArray[np.float32]]
"""For each row or column: the index of the cell before it, and the share of the next cell, or the shares of both."""


def rows_at_once(period: int) -> int:
    """How many rows to convert at a time, a multiple of the colour pattern's `period`."""
    return period * max(1, _ROWS // period)


@dataclass(frozen=True, slots=True, eq=False)
class ArraySource:
    """Rows of a plane that is already in memory."""

    array: Plane

    @property
    def shape(self) -> tuple[int, int]:
        """Rows and columns."""
        return self.array.shape[0], self.array.shape[1]

    @property
    def level(self) -> float:
        """About the plane's mean."""
        return float(self.array[::_STEP, ::_STEP].mean(dtype=np.float64))

    @property
    def period(self) -> int:
        """1: rows can be read from any row on."""
        return 1

    def rows_into(self, out: NDArray[np.float32], rows: slice) -> None:
        """Copy these rows to `out`."""
        out[...] = self.array[rows]


@dataclass(frozen=True, slots=True, eq=False)
class LinearRows:
    """One mosaic and the factors that make its rows linear. Made by `Lineariser.apply`.

    plane[y, x] = (mosaic[y, x] − black) · factor(y, x) (· flat[y, x]), the factor between `factors` float32
    (a, cells, W) for the a rows of the colour pattern. For each of these rows `down` gives the cell before each of its
    lines and the shares (n, 2) of that cell and the next. `black` holds one float32 (W,) for each row of the pattern;
    a `dark` mosaic is subtracted in its place. `level` is about the plane's mean.
    """

    mosaic: NDArray[Any]
    black: tuple[NDArray[np.float32], ...]
    down: tuple[Between, ...]
    factors: NDArray[np.float32]
    level: float
    dark: NDArray[Any] | None
    flat: Plane | None

    @property
    def shape(self) -> tuple[int, int]:
        """Rows and columns."""
        return self.mosaic.shape[0], self.mosaic.shape[1]

    @property
    def period(self) -> int:
        """Rows of the colour pattern. Runs of rows must start at a multiple of it."""
        return len(self.black)

    def rows_into(self, out: NDArray[np.float32], rows: slice) -> None:
        """Write these rows of the linear plane to `out` float32 (n, W)."""
        for row in range(self.period):
            these = slice(rows.start + row, rows.stop, self.period)
            target, light = out[row :: self.period], self.mosaic[these]
            dark = None if self.dark is None else self.dark[these]
            first = rows.start // self.period
            for lines, cell in self._runs(row, first, len(target)):  # a run stays in the cache
                part = target[lines]
                np.copyto(part, light[lines], casting="unsafe")
                if dark is None:
                    part -= self.black[row]
                else:
                    np.subtract(part, dark[lines], out=part, casting="unsafe")
                if cell is None:
                    part *= self.factors[row, 0]
                    continue
                shares = self.down[row][1][first + lines.start : first + lines.stop]
                for across in spans(self.shape[1], _PRODUCT // (2 * len(part))):
                    part[:, across] *= shares @ self.factors[row, cell : cell + 2, across]
        if self.flat is not None:
            out *= self.flat[rows]

    def _runs(self, row: int, first: int, count: int) -> list[tuple[slice, int | None]]:
        """Split `count` lines of a row of the pattern, from line `first` on, by the cell before them.

        The cell is None where one factor holds for the whole frame.
        """
        if self.factors.shape[1] == 1:
            return [(slice(0, count), None)]
        below = self.down[row][0][first : first + count]
        edges = [0, *(np.flatnonzero(np.diff(below)) + 1).tolist(), count]
        return [(slice(a, b), int(below[a])) for a, b in itertools.pairwise(edges) if a < b]

    def plane(self, workers: int = 1) -> Plane:
        """The whole plane, float32 (H, W)."""
        made = np.empty(self.shape, dtype=np.float32)
        each(lambda rows: self.rows_into(made[rows], rows), spans(self.shape[0], rows_at_once(self.period)), workers)
        return made


@dataclass(frozen=True, slots=True, eq=False)
class Lineariser:
    """Conversion to a linear plane for all mosaics of one camera and shape. Made by `lineariser`.

    `pattern` (a, b) holds colour indices, `black` one float32 (W,) for each row of it. `levels` and
    `scale` = 1/(white − level) are per colour index, `balance` too, or None. All colours are scaled to the local mean
    of the `reference` colours; with none given they are not evened out. A cell is `steps` patterns. `down` (for each
    row of the pattern) and `across` (for each column) say between which cells its lines and pixels lie.
    """

    shape: tuple[int, int]
    pattern: NDArray[np.intp]
    levels: NDArray[np.float64]
    scale: NDArray[np.float64]
    white: float
    balance: NDArray[np.float64] | None
    reference: tuple[int, ...]
    steps: tuple[int, int]
    black: tuple[NDArray[np.float32], ...]
    down: tuple[Between, ...]
    across: tuple[Between, ...]

    @property
    def cells(self) -> tuple[int, int]:
        """Number of whole cells down and across."""
        a, b = self.pattern.shape
        return self.shape[0] // (a * self.steps[0]), self.shape[1] // (b * self.steps[1])

    def apply(self, mosaic: NDArray[Any], *, dark: NDArray[Any] | None = None, flat: Plane | None = None) -> LinearRows:
        """Find the mosaic's own gains; its rows are converted when they are read. `flat` is a `white_gain`.

        Raises DecodeError for a frame that holds no picture: another shape, NaN, constant, black or saturated.
        """
        check_frame(mosaic, self.white, dark=dark, flat=flat)
        if mosaic.shape != self.shape:
            raise DecodeError(f"the frame is {size_text(mosaic.shape)}, these settings are for {size_text(self.shape)}")
        colours = np.unique(self.pattern)
        if len(colours) == 1 or (not self.reference and self.balance is not None):
            gains = np.ones(len(self.levels)) if self.balance is None else self.balance
            factors, level = self._uniform(gains), self._level(mosaic, dark, gains)
        else:
            sums = self._sums(mosaic)
            if dark is not None:
                sums -= self._sums(dark)
            places = self._means(sums, zero=dark is not None)
            gains = colour_gains(self.pattern, places) if self.balance is None else self.balance
            level = self._level(mosaic, dark, gains)
            if self.reference and min(self.cells) > 0:
                factors, level = self._even(sums, gains, zero=dark is not None)
            else:
                factors = self._uniform(gains)
        if flat is not None:
            level *= float(flat[::_STEP, ::_STEP].mean(dtype=np.float64))
        return LinearRows(mosaic, self.black, self.down, factors, level, dark, flat)

    def _uniform(self, gains: NDArray[np.float64]) -> NDArray[np.float32]:
        """Factors (a, 1, W) from one gain for each colour."""
        along = np.resize(np.arange(self.pattern.shape[1]), self.shape[1])
        return (gains * self.scale)[self.pattern][:, None, along].astype(np.float32)

    def _sums(self, mosaic: NDArray[Any]) -> NDArray[np.float32]:
        """(groups, a, W): sums over `steps[0]` rows of each row of the pattern; the last group may be cut short.

        Exact for 16 bits, as float32 counts to 2^24.
        """
        a = self.pattern.shape[0]
        groups = spans(self.shape[0], a * self.steps[0])
        sums = np.zeros((len(groups), a, self.shape[1]), dtype=np.float32)
        lines = np.empty((self.steps[0], a, self.shape[1]), dtype=np.float32)
        fours = np.empty((self.steps[0] // 4, a, self.shape[1]), dtype=np.uint16)
        for index, group in enumerate(groups):
            rows = mosaic[group]
            whole = len(rows) // a
            part: NDArray[Any] = rows[: whole * a].reshape(whole, a, self.shape[1])
            if mosaic.dtype == np.uint16 and whole % 4 == 0 and part.max(initial=0) < _FOUR_FIT:
                part = _in_fours(part, fours[: whole // 4])
            np.copyto(lines[: len(part)], part, casting="unsafe")
            np.add.reduce(lines[: len(part)], axis=0, out=sums[index])
            for place, line in enumerate(rows[whole * a :]):
                sums[index, place] += line
        return sums

    def _means(self, sums: NDArray[np.float32], *, zero: bool) -> NDArray[np.float64]:
        """(a, b) means of the whole frame, black subtracted."""
        a, b = self.pattern.shape
        whole = sums.sum(axis=0, dtype=np.float64)
        means = np.empty((a, b))
        for (row, column), colour in np.ndenumerate(self.pattern):
            count = len(range(row, self.shape[0], a)) * len(range(column, self.shape[1], b))
            means[row, column] = whole[row, column::b].sum() / count - (0.0 if zero else self.levels[colour])
        return means

    def _even(
        self, sums: NDArray[np.float32], gains: NDArray[np.float64], *, zero: bool
    ) -> tuple[NDArray[np.float32], float]:
        """Factors (a, cells, W) that scale every colour to the reference colours' local mean, and the overall mean."""
        a, b = self.pattern.shape
        rows, columns = self.cells
        step = self.steps[1]
        seen = np.empty((a, b, rows, columns))

        for (row, column), colour in np.ndenumerate(self.pattern):
            local = seen[row, column]
            lines = sums[:rows, row, column : column + b * columns * step : b]
            lines.reshape(rows, columns, step).sum(axis=2, dtype=np.float64, out=local)
            local /= self.steps[0] * step
            local -= 0.0 if zero else self.levels[colour]
            local *= self.scale[colour] * gains[colour]
        mean = {int(colour): seen[self.pattern == colour].mean(axis=0) for colour in np.unique(self.pattern)}
        wanted = np.mean([mean[colour] for colour in self.reference], axis=0)
        floor = 1e-3 * max(float(wanted.mean()), 1e-12)
        factors = np.empty((a, rows, self.shape[1]), dtype=np.float32)
        for (row, column), colour in np.ndenumerate(self.pattern):
            own = mean[int(colour)]
            gain = np.where(own > floor, np.clip(wanted / np.maximum(own, floor), 0.1, 10), 1.0)
            gain = (gain * (self.scale[colour] * gains[colour])).astype(np.float32)
            if gain.min() == gain.max():  # as for the reference itself
                factors[row, :, column::b] = gain[0, 0]
                continue
            below, share_above = self.across[column]
            slope = np.diff(gain, axis=1, append=gain[:, -1:])
            line = np.take(slope, below, axis=1)
            line *= share_above
            line += np.take(gain, below, axis=1)
            factors[row, :, column::b] = line
        return factors, float(wanted.mean())

    def _level(self, mosaic: NDArray[Any], dark: NDArray[Any] | None, gains: NDArray[np.float64]) -> float:
        """About the plane's mean, from a sample. Raises DecodeError for a black frame."""
        down, across = (_STEP if side > 16 * _STEP else 1 for side in self.shape)
        some = mosaic[::down, ::across].astype(np.float64)
        rows, columns = (np.arange(count) * step for count, step in zip(some.shape, (down, across), strict=True))
        a, b = self.pattern.shape
        colour = self.pattern[np.ix_(rows % a, columns % b)]
        some -= self.levels[colour] if dark is None else dark[::down, ::across]
        some *= (gains * self.scale)[colour]
        if float(np.mean(some > 1e-3)) < 0.01:
            raise DecodeError("the frame is black: nothing in it is above a thousandth of sensor white")
        return float(some.mean())


def _in_fours(rows: NDArray[np.uint16], out: NDArray[np.uint16]) -> NDArray[np.uint16]:
    """Sums of four rows each: (4n, …) to (n, …), for values below `_FOUR_FIT`."""
    count = len(out)
    np.add(rows[:count], rows[count : 2 * count], out=out)
    for begin in (2 * count, 3 * count):
        out += rows[begin : begin + count]
    return out


def lineariser(
    shape: tuple[int, int],
    *,
    black: float | Sequence[float],
    white: float,
    cfa: NDArray[Any] | None = None,
    balance: Sequence[float] | NDArray[np.float64] | None = None,
    reference: Sequence[int] = (),
    cell_px: int = 48,
) -> Lineariser:
    """The conversion for mosaics of this shape; levels, `cfa` and `balance` as in `plane.to_plane`.

    Every colour is scaled to the `reference` colours' local mean over cells of `cell_px` (several periods of any mask
    or lenslet): a colour cast that varies slowly would modulate the mosaic at the colour pattern's own frequencies, and
    the mask would repeat it around all its carriers. Without a `reference` colours are balanced over the whole frame.
    The last few are kept, as some bodies report another black level with every frame. Raises DecodeError for levels or
    a balance that make no sense.
    """
    pattern = np.zeros((1, 1), dtype=np.intp) if cfa is None else np.asarray(cfa, dtype=np.intp)
    levels, gains = levels_of(pattern, black=black, white=white, balance=balance)
    return _lineariser(
        shape,
        tuple(tuple(row) for row in pattern.tolist()),
        black=tuple(levels.tolist()),
        white=float(white),
        balance=None if gains is None else tuple(gains.tolist()),
        reference=tuple(reference),
        cell_px=cell_px,
    )


@lru_cache(maxsize=4)
def _lineariser(
    shape: tuple[int, int],
    cfa: tuple[tuple[int, ...], ...],
    *,
    black: tuple[float, ...],
    white: float,
    balance: tuple[float, ...] | None,
    reference: tuple[int, ...],
    cell_px: int,
) -> Lineariser:
    pattern, levels = np.array(cfa, dtype=np.intp), np.array(black)
    gains = None if balance is None else np.array(balance)
    a, b = pattern.shape
    steps = max(1, cell_px // a), max(1, cell_px // b)
    cells = shape[0] // (a * steps[0]), shape[1] // (b * steps[1])
    known = tuple(colour for colour in reference if colour in pattern)
    if len(np.unique(pattern)) == 1 or min(cells) == 0:
        known = ()
    down: tuple[Between, ...] = ()
    across: tuple[Between, ...] = ()
    if known:
        lines = (_between(len(range(row, shape[0], a)), cells[0], steps[0]) for row in range(a))
        down = tuple((below, np.stack([1 - share_next, share_next], axis=1)) for below, share_next in lines)
        across = tuple(_between(len(range(column, shape[1], b)), cells[1], steps[1]) for column in range(b))
    blacks = tuple(levels[np.resize(pattern[row], shape[1])].astype(np.float32) for row in range(a))
    return Lineariser(shape, pattern, levels, 1.0 / (white - levels), white, gains, known, steps, blacks, down, across)


def _between(size: int, cells: int, step: int) -> Between:
    """The cell whose middle lies before each place, and the share of the next cell; constant beyond the outer ones."""
    places = np.clip((np.arange(size) + 0.5) / step - 0.5, 0, cells - 1)
    below = np.minimum(np.floor(places), max(cells - 2, 0)).astype(np.intp)
    return below, (places - below).astype(np.float32)


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
        raise DecodeError(f"the white balance needs {colours} positive gains, one per colour, not {balance}")
    return levels, gains


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


_MOST_WHITES = 1e5  # more than a 16-bit frame whose white is taken for 1: such a value is damage, not light


def _check_values(mosaic: NDArray[Any], white: float) -> None:
    if mosaic.dtype.kind not in "uif":
        raise DecodeError(f"the frame holds {mosaic.dtype} values: give integers or floats")
    if mosaic.dtype.kind == "f" and not np.isfinite(mosaic).all():
        raise DecodeError("the frame holds NaN or infinite values")
    if mosaic.dtype.kind == "f" and (most := max(float(mosaic.max()), -float(mosaic.min()))) > _MOST_WHITES * white:
        raise DecodeError(
            f"the frame holds a value of {most:g}, where white is {white:g}: mend it, or give --white-level"
        )
    some = mosaic[:: mosaic.shape[0] // 256 | 1, :: mosaic.shape[1] // 256 | 1]  # odd steps: all colours are among them
    if some.min() == some.max() and mosaic.min() == mosaic.max():
        raise DecodeError(f"the frame is constant: every pixel is {mosaic.flat[0]}")
    if np.mean(some >= 0.995 * white) > 0.5:
        raise DecodeError(f"the frame is saturated: more than half of its pixels are at white ({white:g})")


def size_text(shape: Sequence[int]) -> str:
    """A shape as a person reads it: rows × columns."""
    return "×".join(map(str, shape)) + " px"
