"""A plane read row by row: one that lies in memory, or a mosaic that is developed while it is read.

The plane itself is never laid out when an exposure goes straight into a transform.
"""

from __future__ import annotations

import itertools
from dataclasses import dataclass
from typing import Any, TypeAlias

import numpy as np
from numpy.typing import NDArray

from dappled.decode.spectrum.plane import Plane
from dappled.decode.threads import each, spans

_ROWS = 96  # at a time: fewer cost more for Python than the cache gives
_PRODUCT = 250_000  # multiplications in a matrix product: more would wake BLAS' own threads, beside ours
STEP = 29  # every so many rows and columns tell the mean: odd, so that all colours are among them

Between: TypeAlias = tuple[NDArray[np.intp], NDArray[np.float32]]
"""For each line or pixel the cell before it, and the share of the next one, or the shares of both."""


def rows_at_once(period: int) -> int:
    """How many rows to develop or transform at a time."""
    return period * max(1, _ROWS // period)


@dataclass(frozen=True, slots=True, eq=False)
class Laid:
    """A plane in memory, as a row source."""

    array: Plane

    @property
    def shape(self) -> tuple[int, int]:
        """Rows and columns."""
        return self.array.shape[0], self.array.shape[1]

    @property
    def level(self) -> float:
        """About the plane's mean."""
        return float(self.array[::STEP, ::STEP].mean(dtype=np.float64))

    @property
    def period(self) -> int:
        """Rows may be asked for from anywhere."""
        return 1

    def rows_into(self, out: NDArray[np.float32], rows: slice) -> None:
        """Copy these rows to `out`."""
        out[...] = self.array[rows]


@dataclass(frozen=True, slots=True, eq=False)
class Exposure:
    """One mosaic and the factors that make it linear; a row source. A `Developer` makes it.

    plane[y, x] = (mosaic[y, x] − black) · factor(y, x) (· flat[y, x]), the factor between `factors` float32
    (a, cells, W) for the a rows of the colour pattern: `down` says for each of these rows which cell lies before each
    of its lines, with the shares (n, 2) of that one and the next. `black` holds one float32 (W,) a row of the pattern;
    `dark`, a mosaic, takes its place.
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
        """Rows of the colour pattern; rows are asked for from a multiple of it on."""
        return len(self.black)

    def rows_into(self, out: NDArray[np.float32], rows: slice) -> None:
        """Develop these rows into `out` float32 (n, W)."""
        for row in range(self.period):
            these = slice(rows.start + row, rows.stop, self.period)
            target, light = out[row :: self.period], self.mosaic[these]
            dark = None if self.dark is None else self.dark[these]
            first = rows.start // self.period
            for lines, cell in self._runs(row, first, len(target)):  # each stays in the cache
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
        """The lines 0…count of a row of the pattern, from its line `first` on, by the cell before them; None where one
        factor holds for the whole frame."""
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
