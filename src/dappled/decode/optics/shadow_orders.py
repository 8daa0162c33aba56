"""Which orders a mask's shadow has, those among them that diffraction makes.

A film's amplitude is the root of its transmittance, and has orders that this has not. On the way to the sensor they are
shifted against each other, so that their products don't cancel there: c_m = Σ t_k t*_{k−m} e^{−2πi λ d (k − m/2)·m f²}.
Orders beyond the sensor's Nyquist frequency darken pixels too: their waves fold.
"""

from __future__ import annotations

from functools import lru_cache

import numpy as np

from dappled.decode.optics.carriers import Lattice, Mask, MaskedOptics, Order
from dappled.decode.optics.visibility import COLOURS_MM, amplitude_orders, order_strengths, pattern_amplitudes

_WEAK = 2e-4  # of the mean: orders of the pattern that are never stronger cast no shadow that is worth its error
_MADE = 1e-3  # of the mean: likewise of those that diffraction makes
_HIGHEST = 32
_BEYOND = 2  # orders beyond the pattern's that are looked at


def shadow_orders(optics: MaskedOptics, lattice: Lattice, f_number: float | None) -> tuple[list[Order], list[Order]]:
    """The half plane's orders that may be seen, by what pattern, film, diffraction, stop and pixels leave of them; and
    those beside them that only diffraction makes, or that lie beyond the sensor's Nyquist frequency and fold."""
    drawn = [one for one in order_strengths(optics, lattice, f_number) if one.on_sensor]
    orders = [one.order for one in drawn if one.most > _WEAK] or [one.order for one in drawn]
    strengths = _made(optics.mask, optics.distance_mm)
    beside = order_strengths(optics, lattice, f_number, [order for order in strengths if order not in orders])
    made = [one.order for one in beside if strengths[one.order] * one.stop * one.pixels > _MADE]
    return orders, made


@lru_cache(maxsize=16)
def _made(mask: Mask, distance_mm: float) -> dict[Order, float]:
    """How strong each order of the half plane is behind a small stop, as a share of the mean; none of a mask whose
    harmonics are so high that no sensor tells what lies beyond them."""
    highest = max(abs(one) for order in pattern_amplitudes(mask) for one in order)
    if highest > _HIGHEST:
        return {}
    reach, size = highest + _BEYOND, 2 * highest + 2 * _BEYOND
    waves = amplitude_orders(mask, 16 * highest + 4 * _BEYOND)
    k = np.arange(-size, size + 1)
    t = waves[np.ix_(k, k)]
    found = {}
    for my in range(reach + 1):
        for mx in range(-reach, reach + 1):
            if (my, mx) > (0, 0):
                pairs = t * waves[np.ix_(k - my, k - mx)]
                turns = np.add.outer((k - my / 2) * my, (k - mx / 2) * mx) * mask.frequency_per_mm**2
                each = [(pairs * np.exp(-2j * np.pi * one * distance_mm * turns)).sum() for one in COLOURS_MM]
                found[my, mx] = float(abs(np.mean(each)) / (t * t).sum())
    return found
