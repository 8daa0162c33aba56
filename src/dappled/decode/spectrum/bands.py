"""Many slices at once: where each band lies in a spectrum, worked out once, then transformed back and turned.

The same numbers as `equations.slice_at`. Bringing the band to baseband, the fraction of a bin and the scale are one
factor along each axis.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy import fft

from dappled.decode.optics.carriers import Carrier
from dappled.decode.spectrum.padded import TILE, Complex, Run, Spectrum, column_runs, in_runs, row_runs
from dappled.decode.threads import share


@dataclass(frozen=True, slots=True)
class Piece:
    """Columns of a band that stand in one tile: `count` from `begin` on; `at` is their place in the band.

    A `mirrored` piece holds the negative frequencies: it runs backwards, conjugate.
    """

    tile: int
    begin: int
    count: int
    at: int
    mirrored: bool


@dataclass(frozen=True, slots=True, eq=False)
class Band:
    """One slice's place: its columns in pieces (`across` as they stand in the spectrum, `beyond` those past Nyquist),
    its rows in runs, those of plain pieces and those of mirrored ones.

    `turn_down` (rows,) and `turn_across` (columns,) are e^{−2πi place n/size}, the place counted from the band's first
    bin; the second with the scale.
    """

    pieces: tuple[Piece, ...]
    across: tuple[Run, ...]
    beyond: tuple[slice, ...]
    rows: tuple[tuple[Run, ...], tuple[Run, ...]]
    turn_down: Complex
    turn_across: Complex
    is_mean: bool


@dataclass(frozen=True, slots=True, eq=False)
class Bands:
    """The bands of all slices of one size, for spectra of one shape.

    `size` (h, w) in bins, `samples` (rows, columns) of a slice that stand on the frame; `cell` float32 (h, w) weights
    of the bins, None for 1.
    """

    bands: tuple[Band, ...]
    size: tuple[int, int]
    samples: tuple[int, int]
    cell: NDArray[np.float32] | None

    def cut(
        self, spectrum: Spectrum, out: Complex, *, workers: int = 1, beside: Sequence[Callable[[], None]] = ()
    ) -> None:
        """All slices into `out` complex64 (K, rows, columns), and other work that fills the workers' waiting.

        Raises DecodeError for columns that aren't there.
        """
        for band in self.bands:
            spectrum.require(band.across)

        def start() -> Callable[[int | Callable[[], None]], None]:
            block = np.empty(self.size, dtype=np.complex64)

            def work(part: int | Callable[[], None]) -> None:
                if callable(part):
                    part()
                else:
                    self._gather(spectrum, part, block)
                    self._transform(spectrum, part, block, out[part])

            return work

        share(start, [*range(len(self.bands)), *beside], workers)

    def _gather(self, spectrum: Spectrum, k: int, block: Complex) -> None:
        """The band's bins (h, w)."""
        band = self.bands[k]
        if sum(run.count for run in band.rows[0]) < self.size[0]:
            block[...] = 0
        for beyond in band.beyond:
            block[:, beyond] = 0
        for piece in band.pieces:
            tile = spectrum.tiles[piece.tile, :, piece.begin : piece.begin + piece.count]
            target = block[:, piece.at : piece.at + piece.count]
            if piece.mirrored:
                target = target[::-1, ::-1]
                for run in band.rows[1]:
                    np.conjugate(tile[run.source : run.source + run.count], out=target[run.at : run.at + run.count])
            else:
                lines, found = in_runs(target, piece.count), in_runs(tile, piece.count)
                for run in band.rows[0]:
                    lines[run.at : run.at + run.count] = found[run.source : run.source + run.count]
        if self.cell is not None:
            block *= self.cell

    def _transform(self, spectrum: Spectrum, k: int, block: Complex, out: Complex) -> None:
        """The band transformed back and turned; one axis after the other, so that a turn finds it in the cache."""
        band = self.bands[k]
        rows, columns = self.samples
        made = fft.ifft(block, axis=0, norm="forward", overwrite_x=True)[:rows]
        made *= band.turn_down[:, None]
        made = fft.ifft(made, axis=1, norm="forward", overwrite_x=True)
        np.multiply(made[:, :columns], band.turn_across, out=out)
        if band.is_mean:
            out += np.float32(spectrum.level)


def lay_out(
    padded: tuple[int, int],
    carriers: Sequence[Carrier],
    size: tuple[int, int],
    samples: tuple[int, int],
    *,
    wrap: bool = False,
    cell: NDArray[np.float32] | None = None,
) -> Bands:
    """Where the bands of these carriers lie in a spectrum of `padded`, and how they are turned.

    The band's first bin is the carrier's nearest less half of the size.
    """
    return Bands(tuple(_band(padded, c, size, samples, wrap=wrap) for c in carriers), size, samples, cell)


def _band(
    padded: tuple[int, int], carrier: Carrier, size: tuple[int, int], samples: tuple[int, int], *, wrap: bool
) -> Band:
    scale = 1 / (padded[0] * padded[1])
    row, column = carrier.fy * padded[0], carrier.fx * padded[1]
    top, left = round(row) - size[0] // 2, round(column) - size[1] // 2
    bottom = -(top + size[0] - 1)  # the first row of the mirrored band
    plain, mirrored = column_runs(left, size[1], padded[1], wrap=wrap)
    return Band(
        pieces=(*_pieces(plain, mirrored=False), *_pieces(mirrored, mirrored=True)),
        across=(*plain, *mirrored),
        beyond=_between([*plain, *mirrored], size[1]),
        rows=(
            tuple(row_runs(top, size[0], padded[0], wrap=wrap)),
            tuple(row_runs(bottom, size[0], padded[0], wrap=wrap)),
        ),
        turn_down=_turn(row - top, samples[0], size[0]).astype(np.complex64),
        turn_across=(scale * _turn(column - left, samples[1], size[1])).astype(np.complex64),
        is_mean=carrier.ky == 0 and carrier.kx == 0,
    )


def _between(across: Sequence[Run], width: int) -> tuple[slice, ...]:
    """The parts of 0…width that no run covers."""
    edges = [
        0,
        *(edge for run in sorted(across, key=lambda run: run.at) for edge in (run.at, run.at + run.count)),
        width,
    ]
    gaps = (slice(stop, start) for stop, start in zip(edges[::2], edges[1::2], strict=True))
    return tuple(gap for gap in gaps if gap.start < gap.stop)


def _turn(place: float, count: int, size: int) -> NDArray[np.complex128]:
    """e^{−2πi place n/size} for n < count: what a sinusoid at a fractional bin is brought to 0 by."""
    turned: NDArray[np.complex128] = np.exp(-2j * np.pi * place * np.arange(count) / size)
    return turned


def _pieces(across: Sequence[Run], *, mirrored: bool) -> list[Piece]:
    """Runs of columns, tile by tile. A mirrored run's last bin is its first."""
    found = []
    for run in across:
        done = 0
        while done < run.count:
            tile, begin = divmod(run.source + done, TILE)
            count = min(TILE - begin, run.count - done)
            at = run.at + (run.count - done - count if mirrored else done)
            found.append(Piece(tile, begin, count, at, mirrored))
            done += count
    return found
