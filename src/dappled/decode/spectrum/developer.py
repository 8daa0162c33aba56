"""What a camera's mosaics need to become planes, and each mosaic's own gains, from one sweep over it.

`Developer.expose(mosaic)` followed by `Exposure.plane()` is `plane.to_plane` followed by `colours.even_colours`, to
float32's rounding.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from dappled.decode.errors import DecodeError
from dappled.decode.spectrum.linear_rows import STEP, Between, Exposure
from dappled.decode.spectrum.plane import Plane, check_frame, colour_gains, levels_of, size_text
from dappled.decode.threads import each, share, spans

_FOUR_FIT = 1 << 14  # four values below it add up within 16 bits


@dataclass(frozen=True, slots=True, eq=False)
class Developer:
    """What all mosaics of one camera share on their way to the plane. Made once by `developer`, then applied.

    `pattern` (a, b) colour indices; `black` one float32 (W,) a row of it; `levels` and `scale` = 1/(white − level) per
    colour index; `balance` per colour index or None; `reference` the colours whose local mean all are brought to; none:
    no evening. A cell is `steps` patterns. `down` for each row of the pattern and `across` for each column say between
    which cells its lines and pixels lie.
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
        """Whole cells down and across; 0 where colours are not evened out."""
        a, b = self.pattern.shape
        return self.shape[0] // (a * self.steps[0]), self.shape[1] // (b * self.steps[1])

    def expose(
        self,
        mosaic: NDArray[Any],
        *,
        dark: NDArray[Any] | None = None,
        flat: Plane | None = None,
        workers: int = 1,
    ) -> Exposure:
        """The mosaic with its own gains. `flat` is a `white_gain`.

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
            sums = self._sums(mosaic, workers)
            if dark is not None:
                sums -= self._sums(dark, workers)
            places = self._means(sums, zero=dark is not None)
            gains = colour_gains(self.pattern, places) if self.balance is None else self.balance
            level = self._level(mosaic, dark, gains)
            if self.reference and min(self.cells) > 0:
                factors, level = self._even(sums, gains, zero=dark is not None, workers=workers)
            else:
                factors = self._uniform(gains)
        if flat is not None:
            level *= float(flat[::STEP, ::STEP].mean(dtype=np.float64))
        return Exposure(mosaic, self.black, self.down, factors, level, dark, flat)

    def _uniform(self, gains: NDArray[np.float64]) -> NDArray[np.float32]:
        """Factors (a, 1, W) of one gain a colour."""
        along = np.resize(np.arange(self.pattern.shape[1]), self.shape[1])
        return (gains * self.scale)[self.pattern][:, None, along].astype(np.float32)

    def _sums(self, mosaic: NDArray[Any], workers: int) -> NDArray[np.float32]:
        """(groups, a, W): sums over `steps[0]` rows of each row of the pattern; the last group may be cut short.

        Exact for 16 bits: float32 counts to 2^24.
        """
        a = self.pattern.shape[0]
        group = a * self.steps[0]
        groups = spans(self.shape[0], group)
        sums = np.zeros((len(groups), a, self.shape[1]), dtype=np.float32)
        small = mosaic.dtype == np.uint16

        def start() -> Any:
            lines = np.empty((self.steps[0], a, self.shape[1]), dtype=np.float32)
            fours = np.empty((self.steps[0] // 4, a, self.shape[1]), dtype=np.uint16)

            def add(index: int) -> None:
                rows = mosaic[groups[index]]
                whole = len(rows) // a
                part: NDArray[Any] = rows[: whole * a].reshape(whole, a, self.shape[1])
                if small and whole % 4 == 0 and part.max(initial=0) < _FOUR_FIT:
                    part = _in_fours(part, fours[: whole // 4])
                np.copyto(lines[: len(part)], part, casting="unsafe")
                np.add.reduce(lines[: len(part)], axis=0, out=sums[index])
                for place, line in enumerate(rows[whole * a :]):
                    sums[index, place] += line

            return add

        share(start, range(len(groups)), workers)
        return sums

    def _means(self, sums: NDArray[np.float32], *, zero: bool) -> NDArray[np.float64]:
        """(a, b) means of the whole frame, black taken off."""
        a, b = self.pattern.shape
        whole = sums.sum(axis=0, dtype=np.float64)
        means = np.empty((a, b))
        for (row, column), colour in np.ndenumerate(self.pattern):
            count = len(range(row, self.shape[0], a)) * len(range(column, self.shape[1], b))
            means[row, column] = whole[row, column::b].sum() / count - (0.0 if zero else self.levels[colour])
        return means

    def _even(
        self, sums: NDArray[np.float32], gains: NDArray[np.float64], *, zero: bool, workers: int
    ) -> tuple[NDArray[np.float32], float]:
        """Factors (a, cells, W) that bring every colour's local mean to the reference colours', and the mean of all."""
        a, b = self.pattern.shape
        rows, columns = self.cells
        step = self.steps[1]
        seen = np.empty((a, b, rows, columns))

        def local(place: tuple[int, int]) -> None:
            row, column = place
            colour = self.pattern[place]
            lines = sums[:rows, row, column : column + b * columns * step : b]
            lines.reshape(rows, columns, step).sum(axis=2, dtype=np.float64, out=seen[place])
            seen[place] /= self.steps[0] * step
            seen[place] -= 0.0 if zero else self.levels[colour]
            seen[place] *= self.scale[colour] * gains[colour]

        each(local, np.ndindex(a, b), workers)
        mean = {int(colour): seen[self.pattern == colour].mean(axis=0) for colour in np.unique(self.pattern)}
        wanted = np.mean([mean[colour] for colour in self.reference], axis=0)
        floor = 1e-3 * max(float(wanted.mean()), 1e-12)
        factors = np.empty((a, rows, self.shape[1]), dtype=np.float32)

        def spread(place: tuple[int, int]) -> None:
            row, column = place
            colour = int(self.pattern[place])
            own = mean[colour]
            gain = np.where(own > floor, np.clip(wanted / np.maximum(own, floor), 0.1, 10), 1.0)
            gain = (gain * (self.scale[colour] * gains[colour])).astype(np.float32)
            if gain.min() == gain.max():  # as for the reference itself
                factors[row, :, column::b] = gain[0, 0]
                return
            below, share_above = self.across[column]
            slope = np.diff(gain, axis=1, append=gain[:, -1:])
            line = np.take(slope, below, axis=1)
            line *= share_above
            line += np.take(gain, below, axis=1)
            factors[row, :, column::b] = line

        each(spread, np.ndindex(a, b), workers)
        return factors, float(wanted.mean())

    def _level(self, mosaic: NDArray[Any], dark: NDArray[Any] | None, gains: NDArray[np.float64]) -> float:
        """About the plane's mean, from a sample. Raises DecodeError where that is black."""
        down, across = (STEP if side > 16 * STEP else 1 for side in self.shape)
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


def developer(
    shape: tuple[int, int],
    *,
    black: float | Sequence[float],
    white: float,
    cfa: NDArray[Any] | None = None,
    balance: Sequence[float] | NDArray[np.float64] | None = None,
    reference: Sequence[int] = (),
    cell_px: int = 48,
) -> Developer:
    """How mosaics of this shape become planes; the arguments as in `plane.to_plane` and `colours.even_colours`.

    Without a `reference` colours are balanced over the frame, not locally. Raises DecodeError for levels or a balance
    that make no sense.
    """
    pattern = np.zeros((1, 1), dtype=np.intp) if cfa is None else np.asarray(cfa, dtype=np.intp)
    levels, gains = levels_of(pattern, black=black, white=white, balance=balance)
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
    return Developer(shape, pattern, levels, 1.0 / (white - levels), white, gains, known, steps, blacks, down, across)


def _between(size: int, cells: int, step: int) -> Between:
    """The cell before each place (its middle), and the share of the next one; constant beyond the outer ones."""
    places = np.clip((np.arange(size) + 0.5) / step - 0.5, 0, cells - 1)
    below = np.minimum(np.floor(places), max(cells - 2, 0)).astype(np.intp)
    return below, (places - below).astype(np.float32)
