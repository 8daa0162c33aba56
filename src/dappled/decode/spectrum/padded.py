"""A frame's spectrum: one real FFT in single precision, padded to a fast length, with every bin at hand."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy import fft

from dappled.decode.errors import DecodeError

Complex = NDArray[np.complex64]
TILE = 24  # columns that lie together in memory: a tile of them stays in the cache while it is transformed


def padded_shape(shape: tuple[int, int]) -> tuple[int, int]:
    """The next sides with small prime factors (2776×3688 becomes 2800×3750: three times faster). Both are even."""
    return _next_even(shape[0], real=False), _next_even(shape[1], real=True)  # rows are transformed first


@dataclass(frozen=True, slots=True)
class Run:
    """`count` bins of one axis that stand together: from `at` in a block, from `source` on in the spectrum."""

    at: int
    count: int
    source: int


def row_runs(first: int, count: int, side: int, *, wrap: bool = True) -> list[Run]:
    """Rows first…first+count−1 (signed) of a spectrum of `side` rows in DFT order, cyclic.

    Without `wrap` those up to the Nyquist frequency only.
    """
    at, end = 0, count
    if not wrap:
        at, end = max(0, -(side // 2) - first), min(count, side // 2 + 1 - first)
    found = []
    while at < end:
        source = (first + at) % side
        length = min(end - at, side - source)
        found.append(Run(at, length, source))
        at += length
    return found


def column_runs(first: int, count: int, side: int, *, wrap: bool = True) -> tuple[list[Run], list[Run]]:
    """Columns first…first+count−1 (signed) in the half of a spectrum of `side` columns: as they are, and mirrored.

    A mirrored run stands left of DC: its bins are the conjugates of `source`… backwards, at the negative row.
    """
    at, end = 0, count
    if not wrap:
        at, end = max(0, -(side // 2) - first), min(count, side // 2 + 1 - first)
    plain, mirrored = [], []
    while at < end:
        frequency = (first + at + side // 2) % side - side // 2  # −side/2 … side/2 − 1
        length = min(end - at, (0 if frequency < 0 else side // 2) - frequency)
        if frequency >= 0:
            plain.append(Run(at, length, frequency))
        else:
            mirrored.append(Run(at, length, -(frequency + length - 1)))
        at += length
    return plain, mirrored


@dataclass(frozen=True, slots=True, eq=False)
class Spectrum:
    """Half of the DFT of a real plane that was padded at its lower and right edge with `level`, about its mean.

    `tiles` complex64 (n, Hp, TILE): rows in DFT order, columns from DC upwards, TILE of them in a tile; the first
    `columns` ≤ Wp/2 + 1 of them are the spectrum's. The level was taken off before the transform, so bin (0, 0) only
    holds what the mean has beside it. `shape` is the plane's, `padded` (Hp, Wp) the transform's.
    """

    tiles: Complex
    columns: int
    shape: tuple[int, int]
    padded: tuple[int, int]
    level: float

    @classmethod
    def of(cls, plane: NDArray[np.float32], *, workers: int = 1, largest_fx: float = 0.5) -> Spectrum:
        """The spectrum of a float32 (H, W) plane, up to `largest_fx` cycles/pixel along columns."""
        from dappled.decode.spectrum.transform import Transform  # noqa: PLC0415  # it makes spectra, and so imports this module

        if plane.ndim != 2:
            raise DecodeError(f"a plane has two axes, this array has {plane.ndim}")
        return Transform((plane.shape[0], plane.shape[1])).apply(plane, workers=workers, largest_fx=largest_fx)

    @property
    def mean(self) -> float:
        """The plane's mean."""
        return self.level + float(self.tiles[0, 0, 0].real) / (self.shape[0] * self.shape[1])

    @property
    def half(self) -> Complex:
        """complex64 (Hp, columns), laid out anew: rows in DFT order, columns from DC upwards."""
        return self.block(0, 0, self.padded[0], self.columns)

    def bins(self, fy: float, fx: float) -> tuple[float, float]:
        """Cycles/pixel as fractional bins of the padded transform, signed."""
        return fy * self.padded[0], fx * self.padded[1]

    def block(self, row: int, column: int, height: int, width: int, *, wrap: bool = True) -> Complex:
        """The bins row…row+height−1, column…column+width−1 (signed, DC at (0, 0)), complex64 (height, width).

        Bins left of DC are conjugates of those right of it. Beyond the Nyquist frequency the spectrum goes on
        cyclically (`wrap`) or is 0. Raises DecodeError for columns that were not computed.
        """
        out = np.zeros((height, width), dtype=np.complex64)
        plain, mirrored = column_runs(column, width, self.padded[1], wrap=wrap)
        self.require([*plain, *mirrored])
        for run in plain:
            for down in row_runs(row, height, self.padded[0], wrap=wrap):
                target = out[down.at : down.at + down.count, run.at : run.at + run.count]
                self._take(target, down.source, run.source)
        for run in mirrored:
            backwards = out[::-1, run.at : run.at + run.count][:, ::-1]
            for down in row_runs(-row - height + 1, height, self.padded[0], wrap=wrap):
                target = backwards[down.at : down.at + down.count]
                self._take(target, down.source, run.source)
                np.conjugate(target, out=target)
        return out

    def require(self, across: Sequence[Run]) -> None:
        """Raises DecodeError where one of these runs of columns was not computed."""
        last = max((run.source + run.count for run in across), default=0)
        if last > self.columns:
            raise DecodeError(f"column {last - 1} of the spectrum was not computed (it has {self.columns})")

    def _take(self, target: Complex, row: int, column: int) -> None:
        """Bins as they lie in the tiles, from (row, column) on: a tile's end, whole tiles, a tile's beginning."""
        height, width = target.shape
        lines = slice(row, row + height)
        head = min(width, -column % TILE)
        if head:
            begin = column % TILE
            target[:, :head] = self.tiles[column // TILE, lines, begin : begin + head]
        whole, tail = divmod(width - head, TILE)
        tile = -(-column // TILE)
        if whole:
            between = self.tiles[tile : tile + whole, lines].transpose(1, 0, 2)
            target[:, head : head + whole * TILE].reshape(height, whole, TILE)[...] = between
        if tail:
            target[:, width - tail :] = self.tiles[tile + whole, lines, :tail]


def in_runs(block: Complex, count: int) -> NDArray[np.void]:
    """(…, w/count) the same memory as runs of `count` bins each: NumPy copies a run at once, but bins one by one."""
    return block.view(np.dtype((np.void, count * block.itemsize)))


def hann(block: Complex) -> Complex:
    """Bins (…, h, w) as if a Hann window over the padded lengths lay on the plane; one less at each edge."""
    half, quarter = np.float32(0.5), np.float32(0.25)
    rows = half * block[..., 1:-1, :] - quarter * (block[..., :-2, :] + block[..., 2:, :])
    return np.asarray(half * rows[..., 1:-1] - quarter * (rows[..., :-2] + rows[..., 2:]), dtype=np.complex64)


def _next_even(n: int, *, real: bool) -> int:
    size = int(fft.next_fast_len(n, real=real))
    while size % 2:
        size = int(fft.next_fast_len(size + 1, real=real))
    return size
