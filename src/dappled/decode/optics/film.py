"""Print a mask on film: formats (Table 2), density curve and compensation, the picture (Eq 11, Eq 13, Fig 14)."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from dappled.decode.errors import DecodeError
from dappled.decode.optics.carriers import Mask, Order
from dappled.decode.optics.lenses import Sampling, within

_NOISE_DENSITY = 0.03  # a densitometer's: reversals smaller than this are read as flat


@dataclass(frozen=True, slots=True)
class Film:
    """A printer's image on film: pixels and millimetres along each axis."""

    name: str
    vertical: Sampling
    horizontal: Sampling

    @property
    def shape(self) -> tuple[int, int]:
        """(rows, columns) in pixels."""
        return self.vertical.count, self.horizontal.count

    @property
    def px_per_mm(self) -> tuple[float, float]:
        """(vertical, horizontal) pixels a mm."""
        return self.vertical.px_per_mm, self.horizontal.px_per_mm

    @property
    def nyquist_per_mm(self) -> float:
        """The highest frequency that both axes can draw, cycles/mm: two pixels a period."""
        return min(self.vertical.nyquist_per_mm, self.horizontal.nyquist_per_mm)

    def cut_to(self, height_mm: float, width_mm: float) -> Film:
        """The middle of this film, for a smaller mask. Raises DecodeError for a mask wider than the film."""
        for name, wanted, axis in (("high", height_mm, self.vertical), ("wide", width_mm, self.horizontal)):
            if not 0 < wanted <= axis.length_mm * (1 + 1e-9):
                raise DecodeError(
                    f"a mask {wanted:g} mm {name} does not fit film {self.name}: it has {axis.length_mm:g} mm"
                )
        rows = max(1, round(height_mm * self.vertical.px_per_mm))
        columns = max(1, round(width_mm * self.horizontal.px_per_mm))
        return Film(
            self.name,
            Sampling(rows, rows / self.vertical.px_per_mm),
            Sampling(columns, columns / self.horizontal.px_per_mm),
        )


FILMS: dict[str, Film] = {
    "4k": Film("4k", Sampling(2732, 24.0), Sampling(4096, 36.0)),
    "8k": Film("8k", Sampling(6144, 24.0), Sampling(8192, 36.0)),
    "16k": Film("16k", Sampling(12288, 24.0), Sampling(16384, 36.0)),
}
"""The formats of Table 2, on full-frame 35 mm film."""


def film_of(width_px: int, height_px: int, px_per_mm: float) -> Film:
    """Film of any size and density, the same on both axes."""
    within("film density", px_per_mm, "px/mm", 0.1, 10_000)
    for count in (width_px, height_px):
        within("film size", count, "px", 1, 200_000)
    return Film(
        f"{width_px}x{height_px}",
        Sampling(height_px, height_px / px_per_mm),
        Sampling(width_px, width_px / px_per_mm),
    )


@dataclass(frozen=True, slots=True, eq=False)
class DensityCurve:
    """What a printed level does on the developed film: `levels` (n,) from 0 to 1, rising, and `transmittance` (n,).

    Transmittance is monotone: rising for a reversal film, falling for a negative one.
    """

    levels: NDArray[np.float64]
    transmittance: NDArray[np.float64]

    @property
    def range(self) -> tuple[float, float]:
        """The darkest and the clearest transmittance that the film reaches."""
        return float(self.transmittance.min()), float(self.transmittance.max())

    def level(self, wanted: NDArray[np.floating]) -> NDArray[np.float64]:
        """The levels (0 to 1) to print for `wanted` (0 to 1), the share of the way from darkest to clearest."""
        low, high = self.range
        rising = self.transmittance[-1] >= self.transmittance[0]
        t, levels = (self.transmittance, self.levels) if rising else (self.transmittance[::-1], self.levels[::-1])
        t, first = np.unique(t, return_index=True)
        result: NDArray[np.float64] = np.interp(low + np.asarray(wanted) * (high - low), t, levels[first])
        return result


def density_curve(levels: Sequence[float], densities: Sequence[float], *, top_level: float = 255) -> DensityCurve:
    """The curve of a step wedge: printed levels (0 to `top_level`) and the optical densities measured on the film.

    Transmittance is 10^−D. Raises DecodeError for fewer than 3 steps, levels or densities out of range, or a curve
    that turns back by more than 0.03 in density.
    """
    if len(levels) != len(densities) or len(levels) < 3:
        raise DecodeError(f"a density curve needs 3 steps or more with a density each, this one has {len(levels)}")
    order = np.argsort(np.asarray(levels, dtype=np.float64))
    x = np.asarray(levels, dtype=np.float64)[order]
    d = np.asarray(densities, dtype=np.float64)[order]
    for level, density in zip(x, d, strict=True):
        within("level", float(level), "", 0, top_level)
        within("density", float(density), "", -0.05, 6)
    if np.any(np.diff(x) <= 0):
        raise DecodeError("a density curve has one density per level: one level is in it twice")
    if x[0] > 0.1 * top_level or x[-1] < 0.9 * top_level:
        raise DecodeError(f"the wedge's levels go from {x[0]:g} to {x[-1]:g}: measure it from 0 to {top_level:g}")
    sign = 1.0 if d[-1] >= d[0] else -1.0
    smooth = np.maximum.accumulate(sign * d)
    back = smooth - sign * d
    if back.max() > _NOISE_DENSITY:
        raise DecodeError(f"the density reverses by {back.max():.2f} at level {x[int(back.argmax())]:g}: measure again")
    if smooth[-1] - smooth[0] < 0.05:
        raise DecodeError(
            f"the film's density only changes by {smooth[-1] - smooth[0]:.2f}: no mask can be printed on it"
        )
    return DensityCurve(x / top_level, 10 ** (-sign * smooth))


def wedge_levels(steps: int) -> NDArray[np.float64]:
    """(steps,) levels of a step wedge, from 0 to 1."""
    within("steps", steps, "", 3, 256)
    return np.linspace(0.0, 1.0, steps)


def wedge(shape: tuple[int, int], steps: int = 21) -> NDArray[np.float64]:
    """(rows, columns) levels 0 to 1: steps of equal width from 0 at the left to 1 at the right.

    A thin line of the opposite level separates the steps, so that they can be counted on the film.
    """
    rows, columns = shape
    if columns < 4 * steps:
        raise DecodeError(f"a wedge of {steps} steps needs {4 * steps} columns, this film has {columns}")
    step = np.minimum(np.arange(columns) * steps // columns, steps - 1)
    line = wedge_levels(steps)[step]
    edges = np.flatnonzero(np.diff(step)) + 1
    line[edges] = np.where(line[edges] > 0.5, 0.0, 1.0)
    return np.repeat(line[None], rows, axis=0)


@dataclass(frozen=True, slots=True)
class Harmonic:
    """One cosine of a mask as a printer sees it: `multiple` of the fundamental, and its period in printer's pixels.

    `period_px` is the shorter of the two axes'. A period under two pixels can't be drawn: sampled, it appears as
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
    film needs (Eq 13); with a `curve` of that film the levels follow from a wedge printed on it, and `negative` is not
    used. `drawable_only` leaves out harmonics finer than two pixels, which Fig 14 draws as other frequencies.
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
        """One sentence for each property that will differ from the design."""
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
        """(h, w) uint8 or uint16 of one tile, as in the file."""
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
        """Every order of the picture and its position in the DFT, (fy, fx) in cycles/pixel, −0.5 to 0.5.

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
            raise DecodeError("this mask prints as one even grey: its periods all fold to zero; choose finer film")
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
