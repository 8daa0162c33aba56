"""The real FFT of a plane in tiles that fit the cache: rows while they are developed, then columns tile by tile."""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import TypeAlias

import numpy as np
from scipy import fft

from dappled.decode.errors import DecodeError
from dappled.decode.spectrum.linear_rows import Exposure, Laid, rows_at_once
from dappled.decode.spectrum.padded import TILE, Complex, Spectrum, in_runs, padded_shape
from dappled.decode.spectrum.plane import Plane, check_sides, size_text
from dappled.decode.threads import each, share, spans

_TILES = 4  # transformed at a time

Source: TypeAlias = "Plane | Exposure"


class Transform:
    """Transforms frames of one shape into one buffer: a spectrum is valid until the next one is made.

    The buffer's pages are only used as far as columns were asked for.
    """

    def __init__(self, shape: tuple[int, int]) -> None:
        """Raises DecodeError for a shape that can't be decoded."""
        check_sides(shape)
        self.shape = shape
        self.padded = padded_shape(shape)
        count = -(-(self.padded[1] // 2 + 1) // TILE)
        self._tiles: Complex = np.empty((count, self.padded[0], TILE), dtype=np.complex64)

    def apply(self, source: Source, *, workers: int = 1, largest_fx: float = 0.5) -> Spectrum:
        """The spectrum up to `largest_fx` cycles/pixel along columns; the same bytes for any number of workers."""
        if source.shape != self.shape:
            raise DecodeError(f"the frame is {size_text(source.shape)}, this transform is for {size_text(self.shape)}")
        rows = source if isinstance(source, Exposure) else Laid(source)
        columns = min(self.padded[1] // 2 + 1, int(np.ceil(largest_fx * self.padded[1])) + 2)
        tiles = self._tiles[: -(-columns // TILE)]
        level = rows.level
        step = rows_at_once(rows.period)

        def start() -> Callable[[slice], None]:
            lines = np.full((step, self.padded[1]), level, dtype=np.float32)

            def along(these: slice) -> None:
                part = lines[: these.stop - these.start]
                rows.rows_into(part[:, : self.shape[1]], these)
                _into_tiles(fft.rfft(part, axis=1), tiles[:, these])

            return along

        share(start, spans(self.shape[0], step), workers)

        tiles[:, self.shape[0] :] = 0
        tiles[0, self.shape[0] :, 0] = level * self.padded[1]  # the transform of a row of nothing but the level

        def down(these: slice) -> None:
            made = fft.fft(tiles[these], axis=1, overwrite_x=True)
            if not np.may_share_memory(made, tiles):
                tiles[these] = made

        each(down, spans(len(tiles), _TILES), workers)
        tiles[0, 0, 0] -= level * self.padded[0] * self.padded[1]
        spectrum = Spectrum(tiles, columns, self.shape, self.padded, level)
        if not math.isfinite(spectrum.mean):  # the mean has seen every pixel
            raise DecodeError("the frame holds NaN or infinite values")
        return spectrum


def _into_tiles(lines: Complex, tiles: Complex) -> None:
    """Rows (n, C) to tiles (k, n, TILE); what lies beyond C is 0."""
    count = len(tiles)
    whole = min(count, lines.shape[1] // TILE)
    in_runs(tiles[:whole], TILE)[..., 0] = in_runs(lines[:, : whole * TILE], TILE).T
    if whole < count:
        rest = lines[:, whole * TILE :]
        tiles[whole, :, : rest.shape[1]] = rest
        tiles[whole, :, rest.shape[1] :] = 0
