"""The picture of a mask that is printed on film (Eq 11, Eq 13, Fig 14), made tile by tile."""

from __future__ import annotations

import math
from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from dappled.decode.errors import DecodeError
from dappled.decode.optics.carriers import Mask, Order
from dappled.decode.optics.film import DensityCurve, Film
from dappled.decode.optics.lenses import within


@dataclass(frozen=True, slots=True)
class Harmonic:
    """One cosine of a mask as a printer sees it: `multiple` of the fundamental, and its period in printer's pixels.

    `period_px` is the shorter of the two axes'. A period under two pixels can't be drawn: sampled, it comes out as
    another frequency.
    """

    multiple: int
    frequency_per_mm: float
    period_px: float

    @property
    def drawable(self) -> bool:
        """Whether the printer has two pixels or more a period."""
        return self.period_px >= 2 * (1 - 1e-9)


@dataclass(frozen=True)
class MaskImage:
    """What to print. Values run from 0 (opaque) to 1 (clear).

    `period_px` is (vertical, horizontal), of the fundamental. `negative` prints 1 − value, as black-and-white negative
    film needs (Eq 13); with a `curve` of that film the levels follow from what the film did to a wedge, and `negative`
    is not used. `drawable_only` leaves out harmonics finer than two pixels, which Fig 14 draws as other frequencies.
    """

    mask: Mask
    film: Film
    period_px: tuple[float, float]
    negative: bool = False
    bits: int = 8
    curve: DensityCurve | None = None
    drawable_only: bool = False

    def __post_init__(self) -> None:
        """Raises DecodeError for a period, or a depth of bits, that can't be printed."""
        if self.bits not in (8, 16):
            raise DecodeError(f"a mask is written with 8 or 16 bits, not {self.bits}")
        for period in self.period_px:
            within("longest period", period, "px", 1e-3, 1e6)
        if not self.multiples:
            raise DecodeError(f"every harmonic is finer than two pixels of film {self.film.name}: print on finer film")

    def harmonics(self) -> list[Harmonic]:
        """All harmonics of the mask, the lowest first, drawn or not."""
        shortest = min(self.period_px)
        return [Harmonic(m, m * self.mask.frequency_per_mm, shortest / m) for m in self.mask.multiples]

    @property
    def multiples(self) -> tuple[int, ...]:
        """The harmonics that are drawn."""
        return tuple(h.multiple for h in self.harmonics() if h.drawable or not self.drawable_only)

    def warnings(self) -> list[str]:
        """One sentence for each thing that will not come out as designed."""
        found = []
        for h in self.harmonics():
            if not h.drawable:
                fate = "left out" if self.drawable_only else "drawn as another frequency"
                limit = "a pixel" if h.period_px < 1 else "two pixels, the least a period needs"
                found.append(
                    f"harmonic {h.multiple} ({h.frequency_per_mm:.4g}/mm) has a period of {h.period_px:.4g} px on film "
                    f"{self.film.name}, less than {limit}: {fate}"
                )
        return found

    @property
    def dtype(self) -> np.dtype[np.unsignedinteger]:
        """Of the levels: uint8 or uint16."""
        return np.dtype(np.uint8 if self.bits == 8 else np.uint16)

    def transmittance(self, rows: slice, columns: slice) -> NDArray[np.float64]:
        """(h, w) of one tile: 0 where the mask is darkest, 1 where it is clearest."""
        low, high = self._extremes
        return (self._pattern(self._cosines(0)[:, rows], self._cosines(1)[:, columns]) - low) / (high - low)

    def levels(self, rows: slice, columns: slice) -> NDArray[np.unsignedinteger]:
        """(h, w) uint8 or uint16 of one tile, as they stand in the file."""
        values = np.clip(self.transmittance(rows, columns), 0, 1)
        top = 2**self.bits - 1
        if self.curve is not None:
            wanted = self.curve.level(values) * top
        else:
            wanted = np.rint(values * top)
            if self.negative:
                wanted = top - wanted  # Eq 13
        levels: NDArray[np.unsignedinteger] = np.rint(wanted).astype(self.dtype)
        return levels

    def orders_drawn(self) -> dict[Order, tuple[float, float]]:
        """Every order of the picture and where it stands in its DFT, (fy, fx) in cycles/pixel, −0.5 to 0.5.

        What is finer than two pixels appears folded to another frequency.
        """
        kept = {0, *self.multiples}
        return {
            (ky, kx): (_folded(ky / self.period_px[0]), _folded(kx / self.period_px[1]))
            for ky, kx in self.mask.orders()
            if abs(ky) in kept and abs(kx) in kept
        }

    @cached_property
    def _extremes(self) -> tuple[float, float]:
        """The lowest and highest value of the whole picture, in bounded memory."""
        axes = [np.unique(np.round(self._cosines(axis), 12), axis=1) for axis in (0, 1)]
        low, high = math.inf, -math.inf
        for start in range(0, axes[0].shape[1], 256):
            tile = self._pattern(axes[0][:, start : start + 256], axes[1])
            low, high = min(low, float(tile.min())), max(high, float(tile.max()))
        if not high - low > 1e-9:
            raise DecodeError("this mask is one even grey at the printer's pixels: its periods all fold to nothing")
        return low, high

    def _pattern(self, y: NDArray[np.float64], x: NDArray[np.float64]) -> NDArray[np.float64]:
        if self.mask.pattern == "full":
            pattern: NDArray[np.float64] = np.outer(1 + y.sum(axis=0), 1 + x.sum(axis=0))  # Eq 11, without its offset
        else:
            pattern = y.T @ x  # Fig 14, lines 11 and 14, without the constant
        return pattern

    def _cosines(self, axis: int) -> NDArray[np.float64]:
        """(p, n): each harmonic along one axis of the film. Pixels count from 1, as in Fig 14."""
        return self._both_cosines[axis]

    @cached_property
    def _both_cosines(self) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        def along(count: int, period_px: float) -> NDArray[np.float64]:
            cycles = np.outer(self.multiples, np.arange(1, count + 1)) / period_px
            return np.cos(2 * np.pi * (cycles - np.rint(cycles)))

        return along(self.film.shape[0], self.period_px[0]), along(self.film.shape[1], self.period_px[1])


def period_on(film: Film, mask: Mask) -> tuple[float, float]:
    """(vertical, horizontal) pixels a period of the mask's fundamental on this film."""
    within("mask frequency", mask.frequency_per_mm, "cycles/mm", 1e-3, 1e5)
    return film.px_per_mm[0] / mask.frequency_per_mm, film.px_per_mm[1] / mask.frequency_per_mm


def _folded(cycles_per_px: float) -> float:
    folded = cycles_per_px - round(cycles_per_px)
    return -0.5 if math.isclose(folded, 0.5) else folded
