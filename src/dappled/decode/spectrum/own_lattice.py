"""The lattice that a frame shows by itself, where its carriers are strong enough to be believed."""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np

from dappled.decode.optics.carriers import Carrier, Lattice
from dappled.decode.spectrum.lattice import fit, residual_bins
from dappled.decode.spectrum.padded import Spectrum
from dappled.decode.spectrum.peaks import Measured, measure

_ENOUGH = 4  # peaks of a half plane, in both directions, before a frame's own lattice is believed
STRONG = 0.02  # of the mean; at the ideal aperture parallax alone leaves up to a thousandth
STRONGER = 0.1  # what it takes against a calibration: weak peaks are pulled aside by parallax
FARTHER = 0.12  # of a carrier's frequency: 2° of rotation and, under the fd law, 10 % of the mask's distance
_ALIKE_BINS = 0.5  # rms from their lattice
_STRICTLY_ALIKE_BINS = 0.1  # of a lattice that was searched for far and wide


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


def farther_lattice(spectrum: Spectrum, predicted: Sequence[Carrier]) -> Lattice | None:
    """The lattice of a mask that doesn't stand where it was said to, or None.

    The innermost carriers are looked for up to `FARTHER` from their prediction. As such wide searches meet more of the
    scene, the lattice must explain two thirds of the mask's carriers, and these stand closely on it.
    """
    high, wide = spectrum.padded
    others = [c for c in predicted if (c.ky, c.kx) != (0, 0)]
    away = {c: math.hypot(c.fy * high, c.fx * wide) for c in others}
    inner = sorted(others, key=away.__getitem__)[:_ENOUGH]
    seen = dict(zip(inner, measure(spectrum, inner, [FARTHER * away[c] for c in inner]), strict=True))
    lattice = own_lattice(spectrum, predicted, [seen.get(c) for c in predicted], STRONG)
    if lattice is None:
        return None
    looked = lattice.carriers([(c.ky, c.kx) for c in others])
    shown = _believed(looked, measure(spectrum, looked, 2.0), STRONG)
    off = residual_bins([c for c, _ in shown], [m for _, m in shown], spectrum)
    return lattice if 3 * len(shown) >= 2 * len(others) and off < _STRICTLY_ALIKE_BINS else None


def _believed(
    carriers: Sequence[Carrier], measured: Sequence[Measured | None], least: float
) -> list[tuple[Carrier, Measured]]:
    return [
        (c, m)
        for c, m in zip(carriers, measured, strict=True)
        if m is not None and not m.suspect and m.strength >= least and (c.ky, c.kx) != (0, 0)
    ]


def stretch(used: Sequence[Carrier], predicted: Sequence[Carrier]) -> float:
    """How much farther from the middle carriers stand than those of the same orders were predicted, as a share."""
    said = {(c.ky, c.kx): math.hypot(c.fy, c.fx) for c in predicted}
    both = [(math.hypot(c.fy, c.fx), said[c.ky, c.kx]) for c in used if (c.ky, c.kx) in said]
    whole = sum(there for _, there in both)
    return sum(here for here, _ in both) / whole - 1 if whole else 0.0


def turn_between(lattice: Lattice, predicted: Lattice) -> float:
    """The turn from one lattice to another, mean of both vectors', as `Lattice.rotated` counts."""
    turns = []
    for (ay, ax), (by, bx) in zip((lattice.ky, lattice.kx), (predicted.ky, predicted.kx), strict=True):
        turns.append(math.atan2(by * ax - bx * ay, by * ay + bx * ax))
    return sum(turns) / 2
