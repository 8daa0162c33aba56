"""Film: its formats (Table 2), and the curve from printed level to density, with the compensation for it."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from dappled.decode.errors import DecodeError
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

    def develop(self, levels: NDArray[np.floating]) -> NDArray[np.float64]:
        """The transmittance of printed levels (0 to 1)."""
        result: NDArray[np.float64] = np.interp(levels, self.levels, self.transmittance)
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
        raise DecodeError("a density curve has one density a level: a level stands in it twice")
    if x[0] > 0.1 * top_level or x[-1] < 0.9 * top_level:
        raise DecodeError(f"the wedge's levels go from {x[0]:g} to {x[-1]:g}: measure it from 0 to {top_level:g}")
    sign = 1.0 if d[-1] >= d[0] else -1.0
    smooth = np.maximum.accumulate(sign * d)
    back = smooth - sign * d
    if back.max() > _NOISE_DENSITY:
        raise DecodeError(
            f"the density turns back by {back.max():.2f} at level {x[int(back.argmax())]:g}: measure again"
        )
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

    A thin line of the opposite level stands between the steps, so that they can be counted on the film.
    """
    rows, columns = shape
    if columns < 4 * steps:
        raise DecodeError(f"a wedge of {steps} steps needs {4 * steps} columns, this film has {columns}")
    step = np.minimum(np.arange(columns) * steps // columns, steps - 1)
    line = wedge_levels(steps)[step]
    edges = np.flatnonzero(np.diff(step)) + 1
    line[edges] = np.where(line[edges] > 0.5, 0.0, 1.0)
    return np.repeat(line[None], rows, axis=0)
