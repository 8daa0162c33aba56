"""Printed cosine masks: which carriers a mask makes (Eq 10, 11, 20; Fig 14)."""

from __future__ import annotations

import itertools
from dataclasses import dataclass
from typing import Literal

Pattern = Literal["full", "diagonal"]
Harmonics = Literal["linear", "octave"]
Order = tuple[int, int]


@dataclass(frozen=True, slots=True)
class Mask:
    """A mask of cosines.

    `frequency_per_mm` is the fundamental at the mask's own plane. `p` counts harmonics: `linear` ones stand at
    1, 2, 3 … p times the fundamental (Fig 14), `octave` ones at 1, 2, 4, 8 … (the thesis' text; the same for p = 2).
    `full` is the product of Eq 11, (2p+1)² carriers; `diagonal` is Fig 14's sum of cos·cos, 4p+1 carriers.
    """

    frequency_per_mm: float
    p: int
    pattern: Pattern = "full"
    harmonics: Harmonics = "linear"

    @property
    def multiples(self) -> tuple[int, ...]:
        """The harmonics as integer multiples of the fundamental, rising."""
        return tuple(2**q if self.harmonics == "octave" else q + 1 for q in range(self.p))

    @property
    def views_per_axis(self) -> int:
        """N = 2p + 1, the views that the carriers of one axis can separate."""
        return 2 * self.p + 1

    def orders(self) -> list[Order]:
        """All carriers (ky, kx): DC first, then the others in rising order. Integer multiples of the fundamental."""
        axis = sorted({0, *self.multiples, *(-m for m in self.multiples)})
        if self.pattern == "full":
            found = set(itertools.product(axis, axis))
        else:
            found = {(sy * m, sx * m) for m in self.multiples for sy in (-1, 1) for sx in (-1, 1)}
        return [(0, 0), *sorted(found - {(0, 0)})]

    def half_orders(self) -> list[Order]:
        """DC, then the orders lexicographically greater than (0, 0): a frame is real, the others are conjugates."""
        return [order for order in self.orders() if order >= (0, 0)]
