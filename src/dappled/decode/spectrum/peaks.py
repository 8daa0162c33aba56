"""Measure carriers: peaks near predictions, to a fraction of a bin, and the lattice that a frame's own peaks show."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from dappled.decode.optics import Carrier, Lattice
from dappled.decode.spectrum.transform import Complex, Spectrum, hann
from dappled.findings import FRAME, Code, Finding, finding

# Chosen by hand where no figure stands beside a number; benchmarks/masks.py measures what all of them together make.

PROMINENCE_NATS = 2.5  # of log magnitude above the median around; the highest of 400 bins of noise reaches 1.1
ALONE_NATS = 1.6  # for a peak that is expected within a bin: the highest of 10 bins of noise reaches 0.6
_FEWEST_WITHOUT_OUTLIERS = 6  # peaks that a fit needs once outliers are left out
_ENOUGH = 4  # peaks of a half plane, in both directions, before a frame's own lattice is believed
STRONG = 0.02  # of the mean; at the ideal aperture parallax alone leaves up to a thousandth
STRONGER = 0.1  # needed to override a calibration: parallax shifts weak peaks
FARTHER = 0.12  # of a carrier's frequency: 2° of rotation and, under the fd law, 10 % of the mask's distance
_ALIKE_BINS = 0.5  # rms from their lattice
_STRICTLY_ALIKE_BINS = 0.1  # of a lattice that was searched for far and wide
_DOUBTED = 0.04  # of a carrier's frequency: a mask at its stated place is never so far off
_FRACTIONS = (1 / 2, 1 / 3, 1 / 4, 1 / 6, 1 / 8, 3 / 8)  # colour patterns, interpolation, JPEG blocks


@dataclass(frozen=True, slots=True)
class Measured:
    """A peak in a frame's spectrum.

    Frequency in cycles/pixel, signed. `strength` is the amplitude as a share of the plane's mean, `phase_rad` the
    phase at pixel (0, 0). `phase_pattern` says how well the four bins around the peak agree with what one sinusoid
    between bins does (neighbours all but opposite, diagonals equal): 1 fully, 0 not at all, −1 the contrary.
    `suspect` marks simple fractions of the sampling frequency, where sensor artefacts occur (`is_suspect`).
    """

    fy: float
    fx: float
    strength: float
    phase_rad: float
    phase_pattern: float
    suspect: bool

    def twin(self) -> Measured:
        """The conjugate peak at the negative frequency."""
        return replace(self, fy=-self.fy, fx=-self.fx, phase_rad=-self.phase_rad)


def measure(
    spectrum: Spectrum,
    carriers: Sequence[Carrier],
    radius_bins: float | Sequence[float],
    *,
    prominence_nats: float = PROMINENCE_NATS,
) -> list[Measured | None]:
    """The peak within `radius_bins` (one value, or one per carrier) of each carrier; None where there is none.

    Under a Hann window; the position by the window's own formula, exact for one sinusoid. Bins are the padded
    transform's. The carrier (0, 0) is the mean, which is always found.
    """
    radii = [float(radius_bins)] * len(carriers) if isinstance(radius_bins, int | float) else list(radius_bins)
    found: list[Measured | None] = []
    for carrier, radius in zip(carriers, radii, strict=True):
        fy, fx = carrier.fy, carrier.fx
        if fy == 0.0 and fx == 0.0:
            found.append(Measured(0.0, 0.0, 1.0, 0.0, 1.0, False))
        elif abs(fy) > 0.5 or abs(fx) > 0.5:
            found.append(None)
        elif fx < 0:  # the frame is real: look on the side that was computed
            twin = _measure_one(spectrum, -fy, -fx, radius, prominence_nats)
            found.append(None if twin is None else twin.twin())
        else:
            found.append(_measure_one(spectrum, fy, fx, radius, prominence_nats))
    return found


def _measure_one(spectrum: Spectrum, fy: float, fx: float, radius: float, prominence: float) -> Measured | None:
    row, column = spectrum.bins(fy, fx)
    reach = math.ceil(radius)
    around = max(reach, 6)  # the surroundings that a peak must exceed
    top, left = round(row) - around, round(column) - around
    if left + 2 * around + 2 > spectrum.columns and spectrum.columns < spectrum.padded[1] // 2 + 1:
        return None
    raw = spectrum.block(top - 1, left - 1, 2 * around + 3, 2 * around + 3)
    windowed = hann(raw)
    magnitude = np.abs(windowed)
    floor = float(np.partition(magnitude, magnitude.size // 2, axis=None)[magnitude.size // 2])  # the median
    y, x = np.ogrid[top : top + 2 * around + 1, left : left + 2 * around + 1]
    allowed = (y - row) ** 2 + (x - column) ** 2 <= max(radius, 0.75) ** 2
    allowed &= y * y + x * x > 9  # the frame's mean is not a carrier
    allowed[[0, -1], :] = False
    allowed[:, [0, -1]] = False
    i, j = divmod(int(np.argmax(np.where(allowed, magnitude, -1.0))), magnitude.shape[1])
    peak = float(magnitude[i, j])
    if not (allowed[i, j] and peak > math.exp(prominence) * floor):
        return None
    if peak < magnitude[i - 1 : i + 2, j - 1 : j + 2].max():
        return None  # the flank of something outside of the radius
    dy = _offset(magnitude[i - 1 : i + 2, j])
    dx = _offset(magnitude[i, j - 1 : j + 2])
    high, wide = spectrum.padded
    found_y, found_x = float(top + i + dy), float(left + j + dx)
    pixels = spectrum.shape[0] * spectrum.shape[1]
    amplitude = 4 * peak / pixels / (_lobe(dy) * _lobe(dx))
    centre = math.pi * (dy + dx)  # the window's centre stands at half of the padded sides
    return Measured(
        fy=found_y / high,
        fx=found_x / wide,
        strength=amplitude / max(abs(spectrum.mean), 1e-12),
        phase_rad=float(np.angle(windowed[i, j])) - centre,
        phase_pattern=_phase_pattern(raw, (i + 1, j + 1), (dy, dx), spectrum),
        suspect=is_suspect(found_y / high, found_x / wide, spectrum.shape),
    )


def _offset(three: NDArray[np.floating]) -> float:
    """Sub-bin offset of a sinusoid under a Hann window from the peak's magnitude and its two neighbours'. Exact."""
    below, centre, above = (float(value) for value in three)
    return max(-0.75, min(0.75, 2 * (above - below) / (below + 2 * centre + above)))


def _lobe(offset: float) -> float:
    """The Hann window's transform at a sub-bin offset, 1 at 0."""
    return float(np.sinc(offset)) / (1 - offset * offset)


def _phase_pattern(raw: Complex, at: tuple[int, int], offset: tuple[float, float], spectrum: Spectrum) -> float:
    """Agreement of the four bins around a peak with a sinusoid: adjacent bins differ by π(N − 1)/N (no window)."""
    rows = [at[0], at[0] + (1 if offset[0] >= 0 else -1)]
    columns = [at[1], at[1] + (1 if offset[1] >= 0 else -1)]
    four = raw[np.ix_(sorted(rows), sorted(columns))].astype(np.complex128)
    turn_y = np.exp(1j * np.pi * (spectrum.shape[0] - 1) / spectrum.padded[0])
    turn_x = np.exp(1j * np.pi * (spectrum.shape[1] - 1) / spectrum.padded[1])
    aligned = four * np.array([[1, turn_x], [turn_y, turn_y * turn_x]])
    weight = np.abs(aligned)
    pairs = [((0, 0), (0, 1)), ((1, 0), (1, 1)), ((0, 0), (1, 0)), ((0, 1), (1, 1)), ((0, 0), (1, 1))]
    products = [aligned[a] * np.conj(aligned[b]) for a, b in pairs]
    sizes = [weight[a] * weight[b] for a, b in pairs]
    return float(np.real(sum(products)) / max(sum(sizes), 1e-30))


def is_suspect(fy: float, fx: float, shape: tuple[int, int]) -> bool:
    """Whether both frequencies are 0 or 1/2, 1/3, 1/4, 1/6, 1/8 or 3/8 of the sampling, within 0.6 bins."""

    def simple(frequency: float, side: int) -> bool:
        return any(abs(abs(frequency) - fraction) * side < 0.6 for fraction in (0.0, *_FRACTIONS))

    both_zero = abs(fy) * shape[0] < 0.6 and abs(fx) * shape[1] < 0.6
    return not both_zero and simple(fy, shape[0]) and simple(fx, shape[1])


def fit(pairs: Sequence[tuple[Carrier, Measured]]) -> Lattice:
    """The lattice nearest to measured carriers by least squares, weighted by the logarithm of their strength."""
    orders = np.array([(c.ky, c.kx) for c, _ in pairs], dtype=np.float64)
    seen = np.array([(m.fy, m.fx) for _, m in pairs])
    strength = np.array([m.strength for _, m in pairs])
    weights = np.sqrt(1 + np.log(strength / strength.min()))[:, None]
    matrix = np.linalg.lstsq(orders * weights, seen * weights, rcond=None)[0]
    residual = np.hypot(*(orders @ matrix - seen).T)
    keep = residual <= 3 * max(float(np.median(residual)), 1e-9)  # an outlier is a peak of something else
    if keep.sum() >= _FEWEST_WITHOUT_OUTLIERS and np.linalg.matrix_rank(orders[keep]) == 2:
        matrix = np.linalg.lstsq((orders * weights)[keep], (seen * weights)[keep], rcond=None)[0]
    return Lattice.of(matrix)


def residual_bins(carriers: Sequence[Carrier], measured: Sequence[Measured], spectrum: Spectrum) -> float:
    """The rms distance between carriers and what was measured of them, in bins of the padded transform."""
    if not carriers:
        return math.nan
    squares = [
        ((c.fy - m.fy) * spectrum.padded[0]) ** 2 + ((c.fx - m.fx) * spectrum.padded[1]) ** 2
        for c, m in zip(carriers, measured, strict=True)
    ]
    return math.sqrt(sum(squares) / len(squares))


def own_lattice(
    spectrum: Spectrum, predicted: Sequence[Carrier], measured: Sequence[Measured | None], least: float
) -> Lattice | None:
    """The lattice of this frame's own peaks, or None where they are too few, too weak or not on a lattice."""
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
    """The lattice of a mask that is not at its stated distance, or None.

    The innermost carriers are looked for up to `FARTHER` from their prediction. As such wide searches find more of the
    scene, the lattice must explain two thirds of the mask's carriers, and these must lie closely on it.
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
    """How much farther out carriers lie than predicted ones of the same orders, as a share."""
    said = {(c.ky, c.kx): math.hypot(c.fy, c.fx) for c in predicted}
    both = [(math.hypot(c.fy, c.fx), said[c.ky, c.kx]) for c in used if (c.ky, c.kx) in said]
    whole = sum(there for _, there in both)
    return sum(here for here, _ in both) / whole - 1 if whole else 0.0


def displaced(used: Sequence[Carrier], predicted: Sequence[Carrier]) -> Finding | None:
    """That carriers are too far from their prediction for a mask at its stated place; else None."""
    off = stretch(used, predicted)
    return None if abs(off) <= _DOUBTED else finding(Code.CARRIERS_DISPLACED, FRAME, off=off)


def turn_between(lattice: Lattice, predicted: Lattice) -> float:
    """The turn from one lattice to another, mean of both vectors', as `Lattice.rotated` counts."""
    turns = []
    for (ay, ax), (by, bx) in zip((lattice.ky, lattice.kx), (predicted.ky, predicted.kx), strict=True):
        turns.append(math.atan2(by * ax - bx * ay, by * ay + bx * ax))
    return sum(turns) / 2
