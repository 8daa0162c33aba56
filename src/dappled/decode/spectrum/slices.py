"""Cut slices: the band around each carrier, brought to baseband and transformed back (Eq 12, fractional carriers).

Bringing the band to baseband, the fraction of a bin and the scale are one factor along each axis.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import lru_cache

import numpy as np
from numpy.typing import NDArray
from scipy import fft

from dappled.decode.errors import DecodeError
from dappled.decode.optics import Carrier, Lattice
from dappled.decode.optics.carriers import Window
from dappled.decode.spectrum.transform import TILE, BinRun, Complex, Spectrum, column_runs, in_runs, row_runs
from dappled.workers import share

_LAYOUTS = 4  # kept: focal lengths that a zoom goes back to


@dataclass(frozen=True, slots=True, eq=False)
class Slices:
    """`values` complex64 (K, h, w), one slice a carrier; `grid` float64 (2, 3), from (y, x, 1) to sensor (row, column).

    `band` is the share of the plane's white noise power that one slice takes up: variance of a slice pixel over
    variance of a plane pixel.
    """

    values: Complex
    carriers: tuple[Carrier, ...]
    grid: NDArray[np.float64]
    band: float


@dataclass(frozen=True, slots=True)
class BandShape:
    """The band that a slice is cut from.

    `size` is (height, width) in bins, by default `lattice.slice_size`; otherwise the lattice is only needed for the
    window "cell". With `wrap` a band continues cyclically past the edge of the spectrum (sampled lenslet arrays);
    otherwise values beyond Nyquist are 0. `taper` is the share of the band, 0 to 1, that falls off towards its edges as
    a raised cosine (Tukey's window; 1 is Hann's): less ringing, less detail.
    """

    size: tuple[int, int] | None = None
    lattice: Lattice | None = None
    window: Window = "box"
    taper: float = 0.0
    wrap: bool = False


def extract(spectrum: Spectrum, carriers: Sequence[Carrier], form: BandShape, workers: int = 1) -> Slices:
    """The slices of these carriers.

    The scale makes the DC slice the plane's local mean. Phases are those at pixel (0, 0), with the fraction of a bin
    compensated exactly. The slices end where the frame ends. Raises DecodeError for a size, a taper or columns out of
    range.
    """
    bands = _bands(spectrum.shape, spectrum.padded, tuple(carriers), form)
    for band in bands:
        spectrum.require(band.across)
    values = np.empty((len(bands), *bands[0].samples), dtype=np.complex64)

    def start() -> Callable[[int], None]:
        block = np.empty(bands[0].size, dtype=np.complex64)

        def cut(k: int) -> None:
            bands[k].gather(spectrum, block)
            bands[k].transform(spectrum, block, values[k])

        return cut

    share(start, range(len(bands)), workers)
    (high, wide), (height, width) = spectrum.padded, bands[0].size
    grid = np.array([[high / height, 0.0, 0.0], [0.0, wide / width, 0.0]])
    return Slices(values, tuple(carriers), grid, bands[0].noise_share)


@dataclass(frozen=True, slots=True)
class _Piece:
    """Columns of a band that lie in one tile: `count` from `begin` on; `at` is their place in the band.

    A `mirrored` piece holds negative frequencies: it runs backwards, conjugate.
    """

    tile: int
    begin: int
    count: int
    at: int
    mirrored: bool


@dataclass(frozen=True, slots=True, eq=False)
class Band:
    """Where the band of one carrier lies in spectra of one shape, and how it becomes a slice.

    `size` (h, w) in bins; `samples` (rows, columns) of the slice that lie on the frame; `weights` float32 (h, w) of
    the bins, None for 1; `noise_share` as `Slices.band`. Columns are in `pieces` (`across` as they lie in the
    spectrum, `beyond` those past Nyquist), rows in runs for plain and for mirrored pieces. `turn_down` (rows,) and
    `turn_across` (columns,) are e^{−2πi place n/size}, the place counted from the band's first bin, which is the
    carrier's nearest less half of the size; `turn_across` includes the scale.
    """

    size: tuple[int, int]
    samples: tuple[int, int]
    weights: NDArray[np.float32] | None
    noise_share: float
    pieces: tuple[_Piece, ...]
    across: tuple[BinRun, ...]
    beyond: tuple[slice, ...]
    rows: tuple[tuple[BinRun, ...], tuple[BinRun, ...]]
    turn_down: Complex
    turn_across: Complex
    is_mean: bool

    def gather(self, spectrum: Spectrum, block: Complex) -> None:
        """Copy the band's bins to `block` (h, w)."""
        if sum(run.count for run in self.rows[0]) < self.size[0]:
            block[...] = 0
        for beyond in self.beyond:
            block[:, beyond] = 0
        for piece in self.pieces:
            tile = spectrum.tiles[piece.tile, :, piece.begin : piece.begin + piece.count]
            target = block[:, piece.at : piece.at + piece.count]
            if piece.mirrored:
                target = target[::-1, ::-1]
                for run in self.rows[1]:
                    np.conjugate(tile[run.source : run.source + run.count], out=target[run.at : run.at + run.count])
            else:
                lines, found = in_runs(target, piece.count), in_runs(tile, piece.count)
                for run in self.rows[0]:
                    lines[run.at : run.at + run.count] = found[run.source : run.source + run.count]
        if self.weights is not None:
            block *= self.weights

    def transform(self, spectrum: Spectrum, block: Complex, out: Complex) -> None:
        """Transform the block back into `out`; one axis after the other, so that a turn finds it in the cache."""
        rows, columns = self.samples
        made = fft.ifft(block, axis=0, norm="forward", overwrite_x=True)[:rows]
        made *= self.turn_down[:, None]
        made = fft.ifft(made, axis=1, norm="forward", overwrite_x=True)
        np.multiply(made[:, :columns], self.turn_across, out=out)
        if self.is_mean:
            out += np.float32(spectrum.level)


@lru_cache(maxsize=_LAYOUTS)
def _bands(
    shape: tuple[int, int], padded: tuple[int, int], carriers: tuple[Carrier, ...], form: BandShape
) -> tuple[Band, ...]:
    """The bands of `extract` for all frames of `shape`, transformed over `padded`."""
    if not carriers:
        raise DecodeError("no carriers to cut slices at")
    size, lattice, taper, wrap = form.size, form.lattice, form.taper, form.wrap
    if size is None or form.window == "cell":
        if lattice is None:
            raise DecodeError("slices need a size, or a lattice to take it from")
        size = size or lattice.slice_size(padded, form.window)
    height, width = size
    if not (2 <= height <= padded[0] and 2 <= width <= padded[1]):
        raise DecodeError(f"a slice of {height}×{width} bins doesn't fit a spectrum of {padded}")
    if not 0 <= taper <= 1:
        raise DecodeError(f"the taper is {taper:g}: it must be a share of the band, from 0 to 1")
    noise_share = height * width / (padded[0] * padded[1])
    weights = None
    if form.window == "cell" and lattice is not None:
        weights = _cell_weights(lattice, padded, size)
    if taper:
        weights = _taper_weights(size, taper) * (1 if weights is None else weights)
    if weights is not None:
        noise_share *= float(np.mean(weights**2))
    samples = _samples(shape[0], padded[0], height), _samples(shape[1], padded[1], width)
    made = []
    for carrier in carriers:
        row, column = carrier.fy * padded[0], carrier.fx * padded[1]
        top, left = round(row) - height // 2, round(column) - width // 2
        bottom = -(top + height - 1)  # the first row of the mirrored band
        plain, mirrored = column_runs(left, width, padded[1], wrap=wrap)
        scaled = 1 / (padded[0] * padded[1]) * _turn(column - left, samples[1], width)
        made.append(
            Band(
                size,
                samples,
                weights,
                noise_share,
                pieces=(*_pieces(plain, mirrored=False), *_pieces(mirrored, mirrored=True)),
                across=(*plain, *mirrored),
                beyond=_uncovered([*plain, *mirrored], width),
                rows=(
                    tuple(row_runs(top, height, padded[0], wrap=wrap)),
                    tuple(row_runs(bottom, height, padded[0], wrap=wrap)),
                ),
                turn_down=_turn(row - top, samples[0], height).astype(np.complex64),
                turn_across=scaled.astype(np.complex64),
                is_mean=carrier.ky == 0 and carrier.kx == 0,
            )
        )
    return tuple(made)


def _uncovered(across: Sequence[BinRun], width: int) -> tuple[slice, ...]:
    """The parts of 0…width that no run covers."""
    runs = sorted(across, key=lambda run: run.at)
    edges = [0, *(edge for run in runs for edge in (run.at, run.at + run.count)), width]
    gaps = (slice(stop, start) for stop, start in zip(edges[::2], edges[1::2], strict=True))
    return tuple(gap for gap in gaps if gap.start < gap.stop)


def _turn(place: float, count: int, size: int) -> NDArray[np.complex128]:
    """e^{−2πi place n/size} for n < count, which brings a sinusoid at a fractional bin to frequency 0."""
    turned: NDArray[np.complex128] = np.exp(-2j * np.pi * place * np.arange(count) / size)
    return turned


def _pieces(across: Sequence[BinRun], *, mirrored: bool) -> list[_Piece]:
    """Runs of columns, tile by tile. The last bin of a mirrored run comes first."""
    found = []
    for run in across:
        done = 0
        while done < run.count:
            tile, begin = divmod(run.source + done, TILE)
            count = min(TILE - begin, run.count - done)
            at = run.at + (run.count - done - count if mirrored else done)
            found.append(_Piece(tile, begin, count, at, mirrored))
            done += count
    return found


def _taper_weights(size: tuple[int, int], taper: float) -> NDArray[np.float32]:
    """Tukey's window over a band, float32 (h, w): 1 at DC (h//2, w//2), to 0 at the edges."""
    rows, columns = (_tukey(np.abs(np.arange(side) - side // 2) / (side / 2), taper) for side in size)
    return np.outer(rows, columns).astype(np.float32)


def _tukey(out: NDArray[np.float64], taper: float) -> NDArray[np.float64]:
    """Tukey's window at `out`, 0 in the middle and 1 at the edge."""
    falling = np.clip((out - (1 - taper)) / taper, 0, 1)
    weights: NDArray[np.float64] = 0.5 * (1 + np.cos(np.pi * falling))
    return weights


def _samples(side: int, padded: int, size: int) -> int:
    """How many samples of a transform of `size` over `padded` pixels lie on the frame's own `side` pixels."""
    return min(size, (side - 1) * size // padded + 1)


def _cell_weights(lattice: Lattice, padded: tuple[int, int], size: tuple[int, int]) -> NDArray[np.float32]:
    """(h, w), DC at h//2, w//2: 1 where a bin is nearest to the middle carrier, 0 nearer to another, ½ between two."""
    y = (np.arange(size[0]) - size[0] // 2)[:, None] / padded[0]
    x = (np.arange(size[1]) - size[1] // 2)[None, :] / padded[1]
    bin_width = 1 / min(padded)
    weights = np.ones(size)
    for vector in lattice.neighbours():
        length = math.hypot(*vector)
        beyond = (y * vector[0] + x * vector[1]) / length - length / 2  # distance past the bisector, cycles/pixel
        weights *= np.clip(0.5 - beyond / bin_width, 0, 1)
    return weights.astype(np.float32)
