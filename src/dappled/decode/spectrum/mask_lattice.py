"""Find a mask's lattice in a spectrum by the mask's own geometry: few carriers are enough where they agree.

The orders that should stand out (`optics.visibility`) are looked for around a prediction, as a whole: one peak on one
strong order says how much the print's scale and turn differ from the prediction, and with it where all other orders
must be. A mask is printed square: its two axes are at right angles and equally fine, but for a little that film and
glue may do, so a sheared lattice is never an answer. Each hypothesis is judged against chance: how likely peaks of such
height are so near to all these places in a spectrum with so many peaks, times how many hypotheses there were.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from dappled.decode.array_types import Floats
from dappled.decode.optics import Carrier, Lattice, Order
from dappled.decode.optics.visibility import OrderStrength
from dappled.decode.spectrum.lattice import Candidate, candidates
from dappled.decode.spectrum.peaks import ALONE_NATS, Measured, fit, is_suspect, measure, residual_bins
from dappled.decode.spectrum.transform import Spectrum, hann

# Chosen by hand where no figure stands beside a number; benchmarks/masks.py measures what all of them together make.

SCALES = 0.35  # relative: a print's scale and the mask's distance, together
TURN_RAD = math.radians(8)  # of a mask: what is farther turned is not looked for
SURE_NATS = 8.0  # log odds against chance, 1 : 3000
ABOVE_FLOOR = 12.0  # times the level around: a carrier so strong is seen
_PEAK_NATS = 1.6  # as `peaks.ALONE_NATS`: weaker ones are many
_SPACING_BINS = 11  # between two peaks, the side of the part that the level around is taken from
_SCALE_SIGMA, _TURN_SIGMA = 0.1, math.radians(3)  # of a mask that was mounted by hand
_SKEW = 0.03  # of a step: film, paper and glue stretch no more; on pixels that are not square a turn adds to it
_SEEDS = 6  # strong orders that hypotheses start from
_ALIKE_BINS = 0.35  # rms from their lattice
_MISSED_NATS = 4.0  # what a carrier costs that should stand and does not
_BEST = 40  # hypotheses that are judged in full


@dataclass(frozen=True, slots=True)
class MaskLattice:
    """A mask's lattice as found: carriers at the lattice, their peaks, and the log odds (nats) against chance.

    `scale` and `turn_rad` are how much the print is finer and turned than the prediction.
    """

    lattice: Lattice
    found: tuple[tuple[Carrier, Measured], ...]
    odds_nats: float
    scale: float
    turn_rad: float

    @property
    def sure(self) -> bool:
        """Whether chance is ruled out."""
        return self.odds_nats >= SURE_NATS


@dataclass(frozen=True, slots=True, eq=False)
class PeakList:
    """The peaks of a spectrum, the highest first."""

    spectrum: Spectrum
    places: NDArray[np.float64]
    prominence: NDArray[np.float64]

    @classmethod
    def of(cls, spectrum: Spectrum) -> PeakList:
        """All peaks of a spectrum, both half planes; those at simple fractions of the sampling are left out."""
        half: list[Candidate] = [
            c
            for c in candidates(spectrum, prominence_nats=_PEAK_NATS, spacing_bins=_SPACING_BINS)
            if not is_suspect(c.row / spectrum.padded[0], c.column / spectrum.padded[1], spectrum.shape)
        ]
        places = np.array([(c.row, c.column) for c in half]).reshape(-1, 2)
        prominence = np.array([c.prominence for c in half])
        return cls(spectrum, np.concatenate([places, -places]), np.concatenate([prominence, prominence]))

    def rank_density(self) -> NDArray[np.float64]:
        """Peaks of this height or higher per bin of the spectrum, for each."""
        order = np.argsort(-self.prominence, kind="stable")
        rank = np.empty(len(order))
        rank[order] = np.arange(1, len(order) + 1)
        return rank / (2 * self.spectrum.padded[0] * self.spectrum.columns)


def find_mask_lattice(
    peaks: PeakList, predicted: Lattice, expected: Sequence[OrderStrength], *, scales: float = SCALES
) -> MaskLattice | None:
    """The likeliest lattice of a mask near a prediction; None where no two of its orders agree.

    `expected` are the strengths of the mask's half plane at the prediction. Whether the answer is more than chance
    is `sure`.
    """
    asked = asked_orders(expected)
    if len(asked) < 2 or not len(peaks.places) or np.linalg.matrix_rank([o.order for o in asked]) < 2:
        return None
    hypotheses = _hypotheses(peaks, predicted, asked, scales)
    if not hypotheses:
        return None
    best: MaskLattice | None = None
    for matrix in _likeliest(peaks, predicted, asked, hypotheses):
        judged = _judged(peaks, predicted, asked, matrix, len(hypotheses))
        if judged is not None and (best is None or judged.odds_nats > best.odds_nats):
            best = judged
    return best


def asked_orders(expected: Sequence[OrderStrength]) -> list[OrderStrength]:
    """The orders that may be seen, the strongest first."""
    there = [one for one in expected if one.on_sensor and one.most > 0]
    if not there:
        return []
    strongest = max(one.most for one in there)
    return sorted((one for one in there if one.most > 0.003 * strongest), key=lambda one: -one.most)


def levels(spectrum: Spectrum, expected: Sequence[OrderStrength | Carrier]) -> list[float]:
    """The level of the spectrum around each order, as a share of the mean: the median of 13 × 13 bins."""
    found = []
    pixels = spectrum.shape[0] * spectrum.shape[1]
    for one in expected:
        row, column = spectrum.bins(one.fy, one.fx)
        last = spectrum.columns - 9
        block = spectrum.block(round(row) - 7, max(-last, min(last, round(column) - 7)), 15, 15)
        found.append(4 * float(np.median(np.abs(hann(block)))) / pixels / max(abs(spectrum.mean), 1e-12))
    return found


def should_stand(spectrum: Spectrum, expected: Sequence[OrderStrength]) -> list[OrderStrength]:
    """The orders that must stand well above their surroundings, whatever shape the stop has."""
    there = [one for one in expected if one.on_sensor and one.least > 0]
    return [one for one, level in zip(there, levels(spectrum, there), strict=True) if one.least > ABOVE_FLOOR * level]


def _hypotheses(
    peaks: PeakList, predicted: Lattice, asked: Sequence[OrderStrength], scales: float
) -> list[tuple[float, float]]:
    """(scale, turn) for each pair of a strong order and a peak near enough to it."""
    to_orders = np.linalg.inv(predicted.matrix() * peaks.spectrum.padded)
    there = peaks.places @ to_orders
    size, angle = np.hypot(*there.T), np.arctan2(there[:, 1], there[:, 0])
    found: list[tuple[float, float]] = []
    for one in asked[:_SEEDS]:
        ky, kx = one.order
        scale = size / math.hypot(ky, kx)
        turn = np.angle(np.exp(1j * (angle - math.atan2(kx, ky))))
        near = (np.abs(np.log(scale)) < math.log(1 + scales)) & (np.abs(turn) < TURN_RAD)
        found += zip(scale[near].tolist(), turn[near].tolist(), strict=True)
    return found


def _likeliest(
    peaks: PeakList, predicted: Lattice, asked: Sequence[OrderStrength], hypotheses: Sequence[tuple[float, float]]
) -> list[Floats]:
    """The lattices (2, 2) in bins of the hypotheses that most peaks speak for, refitted to those peaks."""
    tree = _tree(peaks)
    information = -np.log(np.minimum(peaks.rank_density() * math.pi * 9.0, 1.0))
    base = predicted.matrix() * peaks.spectrum.padded
    orders = np.array([one.order for one in asked], dtype=np.float64)
    ranked: list[tuple[float, int, Floats]] = []
    for n, (scale, turn) in enumerate(hypotheses):
        matrix = scale * _turned(turn) @ base
        at = orders @ matrix
        reach = 2.0 + 0.5 * _SKEW * np.hypot(*at.T)
        near = tree.query_ball_point(at, reach)
        gained = [
            max(0.0, max(float(information[i]) for i in some) - math.log(max(r * r / 9.0, 1.0))) if some else 0.0
            for some, r in zip(near, reach, strict=True)
        ]
        total = sum(gained) - 0.5 * (math.log(scale) / _SCALE_SIGMA) ** 2 - 0.5 * (turn / _TURN_SIGMA) ** 2
        ranked.append((-total, n, matrix))
    ranked.sort(key=lambda one: one[:2])
    return [matrix for _, _, matrix in ranked[:_BEST]]


def _tree(peaks: PeakList) -> Any:
    """A k-d tree of the peaks' places. Its library takes a quarter of a start of the daemon, which needs none."""
    from scipy.spatial import cKDTree  # noqa: PLC0415

    return cKDTree(peaks.places)


def _turned(turn_rad: float) -> Floats:
    """Turns orders: (ky, kx) counts from the row axis towards the column axis."""
    c, s = math.cos(turn_rad), math.sin(turn_rad)
    return np.array([[c, s], [-s, c]])


def _judged(
    peaks: PeakList, predicted: Lattice, asked: Sequence[OrderStrength], matrix: Floats, tried: int
) -> MaskLattice | None:
    """A hypothesis with its lattice fitted to its peaks and its odds; None where these lie on no lattice of a mask."""
    spectrum = peaks.spectrum
    bins = np.array(spectrum.padded)
    tree = _tree(peaks)
    orders = np.array([one.order for one in asked], dtype=np.float64)
    for share in (0.5 * _SKEW, 0.25 * _SKEW, 0.0):
        at = orders @ matrix
        picked: list[tuple[int, int]] = []
        for i, place in enumerate(at):
            near = tree.query_ball_point(place, 1.5 + share * math.hypot(*place))
            if near:
                picked.append((i, max(near, key=lambda n: float(peaks.prominence[n]))))
        chosen = [i for i, _ in picked]
        if len(picked) < 2 or np.linalg.matrix_rank(orders[chosen]) < 2:
            return None
        weights = peaks.prominence[[n for _, n in picked], None]
        seen = peaks.places[[n for _, n in picked]]
        matrix = np.asarray(np.linalg.lstsq(orders[chosen] * weights, seen * weights, rcond=None)[0], dtype=np.float64)
    lattice = Lattice.of(matrix / bins)
    scale, turn, skew = _against(predicted, lattice)
    if skew > _SKEW:
        return None
    looked = lattice.carriers([asked[i].order for i in chosen])
    near = measure(spectrum, looked, 1.5, prominence_nats=ALONE_NATS)
    fitted, pairs = _on_lattice(spectrum, [(c, m) for c, m in zip(looked, near, strict=True) if m is not None])
    if fitted is None:
        return None
    lattice = fitted
    kept = {(c.ky, c.kx) for c, _ in pairs}
    picked = [(i, n) for i, n in picked if asked[i].order in kept]
    chosen = [i for i, _ in picked]
    density = peaks.rank_density()[[n for _, n in picked]]
    radius = 1.5 + 0.5 * _SKEW * np.hypot(*(orders[chosen] @ matrix).T)
    information = -np.log(np.minimum(density * math.pi * radius**2, 1.0))
    first = int(np.argmax(information))  # this one set the scale and the turn: it is no evidence but for its height
    odds = float(information.sum() - information[first]) - math.log(max(tried, 1))
    odds -= 0.5 * (math.log(scale) / _SCALE_SIGMA) ** 2 + 0.5 * (turn / _TURN_SIGMA) ** 2
    odds -= _MISSED_NATS * _missed(spectrum, lattice, asked, {asked[i].order: n for i, n in picked}, pairs)
    return MaskLattice(lattice, tuple(pairs), odds + _alike(pairs), scale, turn)


def _on_lattice(
    spectrum: Spectrum, pairs: Sequence[tuple[Carrier, Measured]]
) -> tuple[Lattice | None, list[tuple[Carrier, Measured]]]:
    """The lattice of measured peaks, and those on it: the farthest is left out as long as they don't agree."""
    left = list(pairs)
    while len(left) >= 2 and np.linalg.matrix_rank([(c.ky, c.kx) for c, _ in left]) == 2:
        lattice = fit(left)
        there = lattice.carriers([(c.ky, c.kx) for c, _ in left])
        off = [residual_bins([c], [m], spectrum) for c, (_, m) in zip(there, left, strict=True)]
        if math.sqrt(sum(one * one for one in off) / len(off)) <= _ALIKE_BINS:
            return lattice, [(c, m) for c, (_, m) in zip(there, left, strict=True)]
        del left[int(np.argmax(off))]
    return None, []


def _alike(pairs: Sequence[tuple[Carrier, Measured]]) -> float:
    """What it says for a lattice that orders which mirror each other are equally strong, in nats."""
    strengths: dict[tuple[int, int], list[float]] = {}
    for c, m in pairs:
        low, high = sorted((abs(c.ky), abs(c.kx)))
        strengths.setdefault((low, high), []).append(math.log(m.strength))
    total = 0.0
    for some in strengths.values():
        for one in some[1:]:
            # Normal in the logarithm: σ 0.15 for carriers, 0.7 for peaks of a scene. A polygonal stop is not symmetric.
            total += max(-1.0, math.log(0.7 / 0.15) - 0.5 * (one - some[0]) ** 2 * (0.15**-2 - 0.7**-2))
    return total


def _missed(
    spectrum: Spectrum,
    lattice: Lattice,
    asked: Sequence[OrderStrength],
    picked: dict[Order, int],
    pairs: Sequence[tuple[Carrier, Measured]],
) -> int:
    """How many orders should stand as much above their surroundings as those that do, and don't."""
    most = {one.order: one.most for one in asked}
    gain = float(np.median([m.strength / most[c.ky, c.kx] for c, m in pairs]))
    gone = [one for one in asked if one.order not in picked]
    if not gone:
        return 0
    there = lattice.carriers([one.order for one in gone])
    moved = [replace(one, fy=c.fy, fx=c.fx) for one, c in zip(gone, there, strict=True) if c.on_sensor]
    return sum(
        gain * one.least > ABOVE_FLOOR * level for one, level in zip(moved, levels(spectrum, moved), strict=True)
    )


def _against(predicted: Lattice, lattice: Lattice) -> tuple[float, float, float]:
    """(scale, turn, skew) of a lattice against the prediction, in the mask's own axes; a square print has skew 0."""
    change = lattice.matrix() @ np.linalg.inv(predicted.matrix())  # orders of the prediction for one step each
    scale = math.sqrt(abs(float(np.linalg.det(change))))
    turn = math.atan2(float(change[0, 1] - change[1, 0]), float(change[0, 0] + change[1, 1]))
    rest = change @ np.linalg.inv(scale * _turned(turn))
    return scale, turn, float(np.abs(rest - np.eye(2)).max())
