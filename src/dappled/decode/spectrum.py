"""A frame's spectrum: one real FFT in single precision, padded to a fast length, with every bin at hand."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy import fft

from dappled.decode.errors import DecodeError
from dappled.decode.threads import each, spans

Complex = NDArray[np.complex64]
_ROWS = 96  # transformed at a time: fixed, so that the same rows share a run for any number of workers
_TILE = 34  # bins on a side, one of its edge for the window


def padded_shape(shape: tuple[int, int]) -> tuple[int, int]:
    """The next sides with small prime factors (2776×3688 becomes 2800×3750: three times faster). Both are even."""
    return _next_even(shape[0], real=False), _next_even(shape[1], real=True)  # rows are transformed first


@dataclass(frozen=True, slots=True, eq=False)
class Spectrum:
    """Half of the DFT of a real plane that was padded at its lower and right edge with its mean.

    `half` complex64 (Hp, C), C ≤ Wp/2 + 1: rows in DFT order, columns from DC upwards. The mean was taken off before
    the transform and stands in `mean`, so bin (0, 0) is 0. `shape` is the plane's, `padded` (Hp, Wp) the transform's.
    """

    half: Complex
    shape: tuple[int, int]
    padded: tuple[int, int]
    mean: float

    @classmethod
    def of(cls, plane: NDArray[np.float32], *, workers: int = 1, largest_fx: float = 0.5) -> Spectrum:
        """The spectrum of a float32 (H, W) plane, up to `largest_fx` cycles/pixel along columns."""
        if plane.ndim != 2:
            raise DecodeError(f"a plane has two axes, this array has {plane.ndim}")
        padded = padded_shape((plane.shape[0], plane.shape[1]))
        columns = min(padded[1] // 2 + 1, int(np.ceil(largest_fx * padded[1])) + 2)
        runs = spans(plane.shape[0], _ROWS)
        sums = np.empty(len(runs))

        def add(run: int) -> None:
            sums[run] = plane[runs[run]].sum(axis=1, dtype=np.float32).sum(dtype=np.float64)

        each(add, range(len(runs)), workers)
        mean = float(sums.sum() / plane.size)
        half = np.empty((padded[0], columns), dtype=np.complex64)
        half[plane.shape[0] :] = 0

        def along(rows: slice) -> None:
            half[rows] = fft.rfft(plane[rows] - np.float32(mean), n=padded[1], axis=1)[:, :columns]

        each(along, runs, workers)
        half = fft.fft(half, axis=0, overwrite_x=True, workers=workers)
        return cls(half, (plane.shape[0], plane.shape[1]), padded, mean)

    def bins(self, fy: float, fx: float) -> tuple[float, float]:
        """Cycles/pixel as fractional bins of the padded transform, signed."""
        return fy * self.padded[0], fx * self.padded[1]

    def block(self, row: int, column: int, height: int, width: int, *, wrap: bool = True) -> Complex:
        """The bins row…row+height−1, column…column+width−1 (signed, DC at (0, 0)), complex64 (height, width).

        Bins left of DC are conjugates of those right of it. Beyond the Nyquist frequency the spectrum goes on
        cyclically (`wrap`) or is 0. Raises DecodeError for columns that were not computed.
        """
        out = np.empty((height, width), dtype=np.complex64)
        self.block_into(out, row, column, wrap=wrap)
        return out

    def block_into(self, out: Complex, row: int, column: int, *, wrap: bool = True) -> None:
        """`block` into an array that is at hand."""
        high, wide = self.padded
        height, width = out.shape
        rows = np.arange(row, row + height)
        start = column
        while start < column + width:
            # One run of columns on one side of DC, in the cyclic spectrum.
            place = (start + wide // 2) % wide - wide // 2  # −Wp/2 … Wp/2 − 1
            stop = min(column + width, start + (0 if place < 0 else wide // 2) - place)
            target = out[:, start - column : stop - column]
            count = stop - start
            if place >= 0:
                self._copy(target, rows % high, place, count, conjugate=False)
            else:
                self._copy(target, -rows % high, -place, count, conjugate=True)
            start = stop
        if not wrap:
            columns = np.arange(column, column + width)
            out[np.abs(rows) > high // 2, :] = 0
            out[:, np.abs(columns) > wide // 2] = 0

    def _copy(self, target: Complex, rows: NDArray[np.intp], first: int, count: int, *, conjugate: bool) -> None:
        last = first + count if not conjugate else first + 1
        if last > self.half.shape[1]:
            raise DecodeError(f"column {last - 1} of the spectrum was not computed (it has {self.half.shape[1]})")
        columns = slice(first, first + count) if not conjugate else slice(first, first - count, -1)
        step = 1 if not conjugate else -1
        breaks = np.flatnonzero(np.diff(rows) != step) + 1
        for part in np.split(np.arange(rows.size), breaks):
            top, bottom = int(rows[part[0]]), int(rows[part[-1]])
            taken = slice(top, bottom + 1) if not conjugate else slice(top, bottom - 1 if bottom else None, -1)
            source = self.half[taken, columns]
            if conjugate:
                np.conjugate(source, out=target[part[0] : part[-1] + 1])
            else:
                target[part[0] : part[-1] + 1] = source

    def noise_rms(self) -> float:
        """The plane's white noise (one standard deviation a pixel), from the quietest parts of the spectrum.

        The median power in each of some hundred tiles (under a Hann window: edges of the frame don't leak), then the
        tenth percentile of those: bands, carriers and colour replicas only cover some. An upper bound where every
        tile holds signal.
        """
        tiles = []
        for rows in np.array_split(np.arange(self.half.shape[0]), 16):
            for columns in np.array_split(np.arange(self.half.shape[1]), 8):
                part = hann(self.half[rows[0] : rows[-1] + 1, columns[0] : columns[-1] + 1][:_TILE, :_TILE])
                if part.size:
                    tiles.append(float(np.median(part.real**2 + part.imag**2)))
        power = float(np.quantile(tiles, 0.1)) / math.log(2)  # the median of an exponential is ln 2 of its mean
        power *= (8 / 3) ** 2  # the window's mean square is 3/8 an axis
        return float(np.sqrt(power / (self.shape[0] * self.shape[1])))


def hann(block: Complex) -> Complex:
    """A block of bins as if a Hann window over the padded lengths lay on the plane; one bin less at each edge."""
    half, quarter = np.float32(0.5), np.float32(0.25)
    rows = half * block[1:-1] - quarter * (block[:-2] + block[2:])
    return np.asarray(half * rows[:, 1:-1] - quarter * (rows[:, :-2] + rows[:, 2:]), dtype=np.complex64)


def _next_even(n: int, *, real: bool) -> int:
    size = int(fft.next_fast_len(n, real=real))
    while size % 2:
        size = int(fft.next_fast_len(size + 1, real=real))
    return size
