"""How wide the lens really stood open: κ from the frame itself, as an f-number is only a rounded word for it.

f/7.4 may be 7.46, and f/22 is 22.6 on most lenses. Near the ideal aperture such a percent decides: it moves the views
apart or together, and what all views share then leaks into the carriers' coefficients, which should hold none of it.
The mean of slice k over the frame is T_k·A(κ·k) of the plane's mean (A the aperture's transform, see `views`); parallax
and texture have no part in it but by the frame's edges. So κ is where A agrees with the means.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from dappled.decode.lightfield.views import Aperture, Shape, angular_frequencies
from dappled.decode.optics.carriers import Order

ROUNDING = 0.05  # relative: f-numbers are off by no more (nominal f/22 is 22.6, f/3.5 is 3.56)
_NOMINAL_SIGMA = 0.02  # relative: how far an f-number is believed
_TEXTURE = 1.5e-3  # of the mean: what the scene adds to the mean of a slice
_EVIDENCE = 9.0  # squared deviations: less doesn't tell one shape from another (beams from filled cells never at κ = 1)
SHAPES: tuple[Shape, ...] = ("beams", "filled", "round")
_AGREEMENT = 6.0  # times their own error: means further from any aperture's are some other aperture's


@dataclass(frozen=True, slots=True)
class UsedAperture:
    """κ in periods of the mask's fundamental, and its standard error; `fitted` False is the f-number's own.

    `aperture` says how light comes through: beams, filled cells, or a round stop.
    """

    kappa: float
    sigma: float
    fitted: bool
    aperture: Aperture


def used_aperture(
    slices: NDArray[np.complex64],
    transfers: NDArray[np.complex128],
    orders: Sequence[Order],
    *,
    nominal_kappa: float,
    rotation_rad: float,
    aperture: Aperture,
) -> UsedAperture:
    """The aperture of a frame from its slices complex64 (K, h, w), DC first, and their known transfers T_k (K,).

    The most probable κ near `nominal_kappa`. The nominal one where the means tell nothing or fit no aperture.
    """
    nominal = UsedAperture(nominal_kappa, _NOMINAL_SIGMA * nominal_kappa, False, aperture)
    means = mean_of_slices(slices)
    known = np.abs(transfers) > 1e-3
    known[0] = False
    if not known.any() or not means[0].real > 0:
        return nominal
    seen = (means[known] / means[0].real / transfers[known]).real
    error = _TEXTURE / np.abs(transfers[known])
    wanted = [order for order, usable in zip(orders, known, strict=True) if usable]

    shares = 1 + ROUNDING * np.linspace(-1, 1, 201)
    best: UsedAperture | None = None
    least = math.inf
    for shape in SHAPES:
        found, cost = _fitted(
            seen,
            error,
            wanted,
            nominal_kappa * shares,
            rotation_rad=rotation_rad,
            aperture=Aperture(aperture.views, shape),
        )
        if found is not None and cost + (_EVIDENCE if best else 0.0) < least:
            best, least = found, cost
    return best or nominal


def _fitted(
    seen: NDArray[np.float64],
    error: NDArray[np.float64],
    orders: Sequence[Order],
    kappas: NDArray[np.float64],
    *,
    rotation_rad: float,
    aperture: Aperture,
) -> tuple[UsedAperture | None, float]:
    """The most probable of evenly spaced `kappas` (the nominal one in the middle), and its cost; None for no fit."""
    nominal = float(kappas[len(kappas) // 2])
    angular = [angular_frequencies(orders, float(kappa), rotation_rad) for kappa in kappas]
    there = np.array([aperture.transform(a).real for a in angular])
    deviations = ((there - seen) / error) ** 2
    cost = deviations.sum(axis=1) + ((kappas / nominal - 1) / _NOMINAL_SIGMA) ** 2
    best = int(np.argmin(cost))
    if best in (0, len(kappas) - 1) or float(deviations[best].mean()) > _AGREEMENT**2:
        return None, math.inf
    below, centre, above = (float(c) for c in cost[best - 1 : best + 2])
    curvature = below - 2 * centre + above
    step = float(kappas[1] - kappas[0])
    kappa = float(kappas[best]) + 0.5 * step * (below - above) / curvature
    return UsedAperture(kappa, step * math.sqrt(2 / curvature), True, aperture), centre


def mean_of_slices(slices: NDArray[np.complex64]) -> NDArray[np.complex128]:
    """(K,) means over the frame under a Hann window, which the frame's edges don't reach."""
    height, width = slices.shape[1:]
    y = np.hanning(height + 2)[1:-1]
    x = np.hanning(width + 2)[1:-1]
    weighted = np.asarray(slices @ x.astype(np.float32), dtype=np.complex128) @ y
    return np.asarray(weighted / (y.sum() * x.sum()), dtype=np.complex128)
