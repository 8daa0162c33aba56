"""A mask as the printer made it: the orders on the film, their amplitudes, and what diffraction leaves of them."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from dappled.decode.optics import Mask, Order

WAVELENGTH_MM = 550e-6


@dataclass(frozen=True, slots=True)
class PrintedOrders:
    """The orders above (0, 0) that a film makes: `orders` (K, 2), their `amplitudes` (K,) as shares of the mean (both
    halves of the plane have them), and where they are on the film, `per_mm` (K, 2) cycles/mm in the sensor's axes."""

    orders: NDArray[np.int64]
    amplitudes: NDArray[np.float64]
    per_mm: NDArray[np.float64]


def printed(
    mask: Mask, *, scale: float = 1.0, anisotropy: float = 0.0, turn_rad: float = 0.0, drawn: bool = True
) -> PrintedOrders:
    """The orders of a printed mask.

    Its frequencies are `scale` times the design's; rows are finer by `anisotropy` than columns. `turn_rad` turns them
    from the row axis to the column axis. Without `drawn` the film's own pixels are left out of account: they keep
    sinc(f/px_per_mm) on each axis, and a harmonic of less than two of them a period is not drawn.
    """
    limit = mask.film_px_per_mm if drawn else None
    multiples = [m for m in mask.multiples if limit is None or m * mask.frequency_per_mm <= limit / 2 * (1 + 1e-9)]
    amplitudes = _amplitudes(mask, multiples)
    orders = np.array(list(amplitudes), dtype=np.int64).reshape(-1, 2)
    f = mask.frequency_per_mm * scale
    straight = orders * (f * (1 + anisotropy / 2), f * (1 - anisotropy / 2))
    values = np.array(list(amplitudes.values()))
    if limit is not None:
        values = values * np.sinc(straight / limit).prod(axis=1)
    c, s = math.cos(turn_rad), math.sin(turn_rad)
    return PrintedOrders(orders, values, straight @ np.array([[c, s], [-s, c]]))


def left_by_diffraction(per_mm: NDArray[np.float64], distance_mm: float) -> NDArray[np.float64]:
    """(K,) contrast of (K, 2) frequencies behind the film: cos(π·λ·d·f²) (Eq 30), negative where it is reversed."""
    return np.asarray(np.cos(np.pi * WAVELENGTH_MM * distance_mm * (per_mm**2).sum(axis=1)))


def _amplitudes(mask: Mask, multiples: list[int]) -> dict[Order, float]:
    """Fourier coefficients of the orders above (0, 0) over the mean, where the pattern's lowest value is black."""
    turns = np.arange(2048) / 2048
    cosines = np.cos(2 * np.pi * np.outer(multiples, turns))
    if mask.pattern == "full":  # Eq 11: a product, so its lowest value is one of the ends of each axis' range
        along = 1 + cosines.sum(axis=0)
        lowest = min(along.min() * along.max(), along.min() ** 2, along.max() ** 2)
        mean = 1.0
    else:  # Fig 14: Σ cos·cos has no mean of its own
        lowest, mean = (cosines[:, ::2].T @ cosines[:, ::2]).min(initial=-1e-9), 0.0
    there = {0, *multiples}
    return {
        (ky, kx): (0.5 if ky else 1.0) * (0.5 if kx else 1.0) / (mean - lowest)
        for ky, kx in mask.half_orders()
        if (ky, kx) != (0, 0) and {abs(ky), abs(kx)} <= there
    }
