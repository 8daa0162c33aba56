"""What the carriers of a frame, each too weak to overrule its calibration, say together of the mask's scale and turn.

Measured carriers of a mask are their predictions times one scale and one turn: peaks of a scene agree on none.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from dappled.decode.optics import Carrier, Lattice
from dappled.decode.spectrum import Spectrum
from dappled.decode.spectrum.peaks import Measured, measure
from dappled.findings import FRAME, Code, Finding, finding

_WEAK = 0.0025  # of the mean: parallax alone leaves up to a thousandth
_FULL_WEIGHT = 0.02  # of the mean: weaker peaks are shifted by what the scene holds around them
_FEWEST = 6  # peaks of a half plane, and half of those predicted
_INNER = 4  # carriers that a mask far off is first looked for by
_FARTHER = 0.055  # of their frequency: 3°, or 5 %
_NEAR_BINS, _ALIKE_BINS = 2.0, 0.35
_LEAST_SCATTER_BINS = 0.04  # of carriers from their lattice, on right frames
_SURE = 5.0  # standard errors
_LEAST_BINS = 0.08  # of the outermost carrier: smaller moves cost no view anything


@dataclass(frozen=True, slots=True)
class LatticeChange:
    """By how much a frame's carriers are farther out than predicted, as a share, and turned; with standard errors."""

    off: float
    off_sigma: float
    turn_rad: float
    turn_sigma_rad: float

    def of(self, lattice: Lattice) -> Lattice:
        """A predicted lattice, changed so."""
        c, s = math.cos(self.turn_rad), math.sin(self.turn_rad)
        return Lattice.of((1 + self.off) * lattice.matrix() @ np.array([[c, -s], [s, c]]))

    @property
    def finding(self) -> Finding:
        """That carriers stand elsewhere than their calibration has them."""
        return finding(
            Code.CARRIERS_OFF_CALIBRATION,
            FRAME,
            off=self.off,
            off_sigma=self.off_sigma,
            turn_deg=math.degrees(self.turn_rad),
            turn_sigma_deg=math.degrees(self.turn_sigma_rad),
        )


def lattice_change(
    spectrum: Spectrum, predicted: Sequence[Carrier], measured: Sequence[Measured | None], lattice_bins: float
) -> LatticeChange | None:
    """How the carriers that a frame shows contradict those predicted of it; None where they agree, or too few are seen.

    `lattice_bins` is the rms by which the calibration's own carriers lie off its lattice.
    """
    outer = [c for c in predicted if (c.ky, c.kx) != (0, 0)]
    if not outer:
        return None
    bins = math.sqrt(spectrum.padded[0] * spectrum.padded[1])
    away = [math.hypot(c.fy, c.fx) * bins for c in outer]
    change = _change(spectrum, predicted, measured, lattice_bins=lattice_bins, share=0.5)
    if change is None:
        inner = [outer[i] for i in np.argsort(away, kind="stable")[:_INNER]]
        reach = [_NEAR_BINS + _FARTHER * math.hypot(c.fy, c.fx) * bins for c in inner]
        seen = dict(zip(inner, measure(spectrum, inner, reach), strict=True))
        change = _change(spectrum, predicted, [seen.get(c) for c in predicted], lattice_bins=lattice_bins, share=2 / 3)
    if change is None:
        return None
    least = _LEAST_BINS / max(away)
    scaled = abs(change.off) > max(_SURE * change.off_sigma, least)
    turned = abs(change.turn_rad) > max(_SURE * change.turn_sigma_rad, least)
    return change if scaled or turned else None


def _change(
    spectrum: Spectrum,
    predicted: Sequence[Carrier],
    measured: Sequence[Measured | None],
    *,
    lattice_bins: float,
    share: float,
) -> LatticeChange | None:
    """The change that explains this `share` of the carriers predicted; None where none does."""
    bins = math.sqrt(spectrum.padded[0] * spectrum.padded[1])
    outer = [c for c in predicted if (c.ky, c.kx) != (0, 0)]
    at = {(c.ky, c.kx): complex(c.fx, c.fy) for c in outer}
    seen = {(c.ky, c.kx): m for c, m in zip(predicted, measured, strict=True) if m is not None}
    for _ in range(3):
        orders = [one for one in at if one in seen and not seen[one].suspect and seen[one].strength >= _WEAK]
        if len(orders) < 2 or np.linalg.matrix_rank(orders) < 2:
            return None
        there = np.array([at[one] for one in orders])
        found = np.array([complex(seen[one].fx, seen[one].fy) for one in orders])
        weights = 1 / (1 + (_FULL_WEIGHT / np.array([seen[one].strength for one in orders])) ** 2)
        away = np.abs(found - _ratio(there, found, weights) * there)
        keep = away <= 3 * np.median(away) + 1e-12
        ratio = _ratio(there[keep], found[keep], weights[keep])
        moved = [Carrier(c.ky, c.kx, (ratio * at[c.ky, c.kx]).imag, (ratio * at[c.ky, c.kx]).real) for c in outer]
        near = measure(spectrum, moved, _NEAR_BINS)
        seen = {(c.ky, c.kx): m for c, m in zip(moved, near, strict=True) if m is not None}
    weights, there, away = weights[keep], there[keep], np.abs(found - ratio * there)[keep] * bins
    if len(there) < max(_FEWEST, share * len(outer)) or math.sqrt(np.average(away**2, weights=weights)) > _ALIKE_BINS:
        return None
    freedom = len(there) - 1  # complex ones, of which the ratio takes one
    variance = max(np.average(away**2, weights=weights) * len(there) / freedom / 2, _LEAST_SCATTER_BINS**2)
    reach = float(np.average(np.abs(there * bins) ** 2, weights=weights)) * len(there)
    sigma = math.sqrt((variance + lattice_bins**2 / 2) / reach)
    return LatticeChange(abs(ratio) - 1, sigma, math.atan2(ratio.imag, ratio.real), sigma)


def _ratio(there: NDArray[np.complex128], found: NDArray[np.complex128], weights: NDArray[np.float64]) -> complex:
    """The scale and turn from some places to others, by weighted least squares."""
    return complex(np.sum(weights * there.conj() * found) / np.sum(weights * np.abs(there) ** 2))
