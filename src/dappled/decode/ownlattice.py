"""The lattice that a frame shows by itself, where its carriers are strong enough to be believed."""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np

from dappled.decode.carriers import Carrier, Lattice
from dappled.decode.lattice import fit, residual_bins
from dappled.decode.peaks import Measured, measure
from dappled.decode.spectrum import Spectrum

_ENOUGH = 4  # peaks of a half plane, in both directions, before a frame's own lattice is believed
STRONG = 0.02  # of the mean; at the ideal aperture parallax alone leaves up to a thousandth
STRONGER = 0.1  # what it takes against a calibration: weak peaks are pulled aside by parallax
_ALIKE_BINS = 0.5  # rms from their lattice


def own_lattice(
    spectrum: Spectrum, predicted: Sequence[Carrier], measured: Sequence[Measured | None], least: float
) -> Lattice | None:
    """The lattice that this frame's own peaks show, or None where they are too few, too weak or not on a lattice."""
    pairs = _believed(predicted, measured, least)
    for radius in (3.0, 2.0):
        if len(pairs) < _ENOUGH or np.linalg.matrix_rank([(c.ky, c.kx) for c, _ in pairs]) < 2:
            return None
        lattice = fit(pairs)
        looked = lattice.carriers([(c.ky, c.kx) for c in predicted])
        pairs = _believed(looked, measure(spectrum, looked, radius), least)
    if len(pairs) < _ENOUGH or np.linalg.matrix_rank([(c.ky, c.kx) for c, _ in pairs]) < 2:
        return None
    lattice = fit(pairs)
    carriers = lattice.carriers([(c.ky, c.kx) for c, _ in pairs])
    if residual_bins(carriers, [m for _, m in pairs], spectrum) > _ALIKE_BINS:
        return None
    return lattice


def _believed(
    carriers: Sequence[Carrier], measured: Sequence[Measured | None], least: float
) -> list[tuple[Carrier, Measured]]:
    return [
        (c, m)
        for c, m in zip(carriers, measured, strict=True)
        if m is not None and not m.suspect and m.strength >= least and (c.ky, c.kx) != (0, 0)
    ]


def turn_between(lattice: Lattice, predicted: Lattice) -> float:
    """The turn from one lattice to another, mean of both vectors', as `Lattice.rotated` counts."""
    turns = []
    for (ay, ax), (by, bx) in zip((lattice.ky, lattice.kx), (predicted.ky, predicted.kx), strict=True):
        turns.append(math.atan2(by * ax - bx * ay, by * ay + bx * ax))
    return sum(turns) / 2
