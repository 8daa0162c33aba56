"""Transform a frame: one real FFT in single precision, padded to a fast length, with access to every bin.

Rows are transformed while they are made linear, then columns. The result lies in tiles that fit the cache.
"""

from __future__ import annotations

import math
import threading
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from typing import TypeAlias

import numpy as np
from numpy.typing import NDArray
from scipy import fft

from dappled.decode.errors import DecodeError
from dappled.decode.spectrum.lineariser import ArraySource, LinearRows, Plane, check_sides, rows_at_once
from dappled.workers import each, share, spans

Source: TypeAlias = "Plane | LinearRows"
Complex = NDArray[np.complex64]
TILE = 24  # columns that lie together in memory: a tile of them stays in the cache while it is transformed
_MOST_MEAN = 1e9  # times white: no light, and squares of it soon overflow
_TILES = 4  # transformed at a time
_NOISE_SIDE = 34  # bins of a part that noise is measured in, one at each edge for the window
_NOISE_PARTS = (8, 8)  # rows and columns of parts
_NOISE_AT_ONCE = 8  # parts: what is worked on stays small


def padded_shape(shape: tuple[int, int]) -> tuple[int, int]:
    """The next even sides with small prime factors (2776×3688 becomes 2800×3750, which is three times faster)."""
    return _next_even(shape[0], real=False), _next_even(shape[1], real=True)  # along rows the input is real


@dataclass(frozen=True, slots=True)
class BinRun:
    """`count` adjacent bins of one axis, from `at` on in a block, from `source` on in the spectrum."""

    at: int
    count: int
    source: int


def row_runs(first: int, count: int, side: int, *, wrap: bool = True) -> list[BinRun]:
    """Rows first…first+count−1 (signed) of a spectrum of `side` rows in DFT order.

    Cyclic with `wrap`, else only up to the Nyquist frequency.
    """
    at, end = 0, count
    if not wrap:
        at, end = max(0, -(side // 2) - first), min(count, side // 2 + 1 - first)
    found = []
    while at < end:
        source = (first + at) % side
        length = min(end - at, side - source)
        found.append(BinRun(at, length, source))
        at += length
    return found


def column_runs(first: int, count: int, side: int, *, wrap: bool = True) -> tuple[list[BinRun], list[BinRun]]:
    """(plain, mirrored) runs of columns first…first+count−1 (signed) in half of a spectrum of `side` columns.

    A mirrored run lies left of DC. Its bins are the conjugates of `source`… backwards, at the negative row.
    """
    at, end = 0, count
    if not wrap:
        at, end = max(0, -(side // 2) - first), min(count, side // 2 + 1 - first)
    plain, mirrored = [], []
    while at < end:
        frequency = (first + at + side // 2) % side - side // 2  # −side/2 … side/2 − 1
        length = min(end - at, (0 if frequency < 0 else side // 2) - frequency)
        if frequency >= 0:
            plain.append(BinRun(at, length, frequency))
        else:
            mirrored.append(BinRun(at, length, -(frequency + length - 1)))
        at += length
    return plain, mirrored


@dataclass(frozen=True, slots=True, eq=False)
class Spectrum:
    """Half of the DFT of a real plane, padded at its lower and right edge with `level`, about its mean.

    `tiles` complex64 (n, Hp, TILE): rows in DFT order, columns from DC upwards, TILE of them in a tile; the first
    `columns` ≤ Wp/2 + 1 of them were computed. The level was subtracted before the transform, so bin (0, 0) only
    holds the difference of the mean from it. `shape` is the plane's, `padded` (Hp, Wp) the transform's.
    """

    tiles: Complex
    columns: int
    shape: tuple[int, int]
    padded: tuple[int, int]
    level: float

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

    def require(self, across: Sequence[BinRun]) -> None:
        """Raises DecodeError where one of these runs of columns was not computed."""
        last = max((run.source + run.count for run in across), default=0)
        if last > self.columns:
            raise DecodeError(f"column {last - 1} of the spectrum was not computed (it has {self.columns})")

    def _take(self, target: Complex, row: int, column: int) -> None:
        """Copy bins from (row, column) on: the end of a tile, whole tiles, the beginning of a tile."""
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
    """(…, w/count) view of the same memory in runs of `count` bins, which NumPy copies whole instead of bin by bin."""
    return block.view(np.dtype((np.void, count * block.itemsize)))


def hann(block: Complex) -> Complex:
    """Bins (…, h−2, w−2) with a Hann window over the padded plane applied, from bins (…, h, w) without one."""
    half, quarter = np.float32(0.5), np.float32(0.25)
    rows = half * block[..., 1:-1, :] - quarter * (block[..., :-2, :] + block[..., 2:, :])
    return np.asarray(half * rows[..., 1:-1] - quarter * (rows[..., :-2] + rows[..., 2:]), dtype=np.complex64)


def noise_rms(spectrum: Spectrum) -> float:
    """The plane's white noise, one standard deviation of a pixel.

    The tenth percentile of median powers over parts of the spectrum: bands, carriers and colour replicas only cover
    some parts. An upper bound where every part holds signal.
    """
    sides = spectrum.padded[0], spectrum.columns
    counts = [max(1, min(most, side // 4)) for most, side in zip(_NOISE_PARTS, sides, strict=True)]
    edges = [np.array_split(np.arange(side), count) for side, count in zip(sides, counts, strict=True)]
    high, wide = (min(_NOISE_SIDE, *(part.size for part in parts)) for parts in edges)
    corners = [(int(rows[0]), int(columns[0])) for rows in edges[0] for columns in edges[1]]
    medians = np.empty(len(corners))
    for some in spans(len(corners), _NOISE_AT_ONCE):
        quiet = hann(np.array([spectrum.block(*corner, high, wide) for corner in corners[some]]))
        power = (quiet.real**2 + quiet.imag**2).reshape(len(quiet), -1)
        middle = power.shape[1] // 2
        medians[some] = np.partition(power, middle, axis=1)[:, middle]
    mean = float(np.quantile(medians, 0.1)) / math.log(2)  # the median of an exponential is ln 2 of its mean
    mean *= (8 / 3) ** 2  # the mean square of the window is 3/8 along each axis
    return math.sqrt(mean / (spectrum.shape[0] * spectrum.shape[1]))


class SpectrumBuffers:
    """Memory for spectra, reused from frame to frame and lent to one frame at a time.

    Decoders keep one, so that they stay values which several threads may use. The pages of a buffer are only touched
    as far as columns are asked for.
    """

    def __init__(self) -> None:
        self._lock = threading.Lock()
        self._free: dict[tuple[int, int], list[Complex]] = {}

    @contextmanager
    def lend(self, shape: tuple[int, int]) -> Iterator[Complex]:
        """Tiles for `transform` that no other frame uses meanwhile. Raises DecodeError for a shape out of range."""
        with self._lock:
            free = self._free.setdefault(shape, [])
            tiles = free.pop() if free else None
        tiles = _tiles_for(shape) if tiles is None else tiles
        yield tiles  # tiles of a frame that failed half way are not lent again
        with self._lock:
            free.append(tiles)


def transform(source: Source, *, tiles: Complex | None = None, workers: int = 1, largest_fx: float = 0.5) -> Spectrum:
    """The spectrum of a plane up to `largest_fx` cycles/pixel along columns; the same bytes for any number of workers.

    It lies in `tiles`, as `SpectrumBuffers` lends them, and is valid until they are used again; None: in new memory.
    Raises DecodeError for a shape out of range, and for values that are not finite.
    """
    if len(source.shape) != 2:
        raise DecodeError(f"a plane has two axes, this array has {len(source.shape)}")
    height, width = source.shape
    tiles = _tiles_for((height, width)) if tiles is None else tiles
    rows = source if isinstance(source, LinearRows) else ArraySource(source)
    padded = padded_shape((height, width))
    columns = min(padded[1] // 2 + 1, int(np.ceil(largest_fx * padded[1])) + 2)
    tiles = tiles[: -(-columns // TILE)]
    level = rows.level
    step = rows_at_once(rows.period)

    def start() -> Callable[[slice], None]:
        lines = np.full((step, padded[1]), level, dtype=np.float32)

        def along(these: slice) -> None:
            part = lines[: these.stop - these.start]
            rows.rows_into(part[:, :width], these)
            _into_tiles(fft.rfft(part, axis=1), tiles[:, these])

        return along

    share(start, spans(height, step), workers)

    tiles[:, height:] = 0
    tiles[0, height:, 0] = level * padded[1]  # the transform of a padding row, which holds nothing but the level

    def down(these: slice) -> None:
        made = fft.fft(tiles[these], axis=1, overwrite_x=True)
        if not np.may_share_memory(made, tiles):
            tiles[these] = made

    each(down, spans(len(tiles), _TILES), workers)
    tiles[0, 0, 0] -= level * padded[0] * padded[1]
    spectrum = Spectrum(tiles, columns, (height, width), padded, level)
    if not math.isfinite(spectrum.mean):  # every pixel is part of the mean
        raise DecodeError("the frame holds NaN or infinite values")
    if abs(spectrum.mean) > _MOST_MEAN:
        raise DecodeError(f"the mean of the frame is {spectrum.mean:g}: some of its values are damaged")
    return spectrum


def _tiles_for(shape: tuple[int, int]) -> Complex:
    check_sides(shape)
    high, wide = padded_shape(shape)
    return np.empty((-(-(wide // 2 + 1) // TILE), high, TILE), dtype=np.complex64)


def _into_tiles(lines: Complex, tiles: Complex) -> None:
    """Rows (n, C) to tiles (k, n, TILE); what lies beyond C is 0."""
    count = len(tiles)
    whole = min(count, lines.shape[1] // TILE)
    in_runs(tiles[:whole], TILE)[..., 0] = in_runs(lines[:, : whole * TILE], TILE).T
    if whole < count:
        rest = lines[:, whole * TILE :]
        tiles[whole, :, : rest.shape[1]] = rest
        tiles[whole, :, rest.shape[1] :] = 0


def _next_even(n: int, *, real: bool) -> int:
    size = int(fft.next_fast_len(n, real=real))
    while size % 2:
        size = int(fft.next_fast_len(size + 1, real=real))
    return size
