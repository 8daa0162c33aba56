"""Find an unknown lattice of carriers in a frame: printed masks and lenslet arrays, square or hexagonal, rotated."""

from __future__ import annotations

import itertools
import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy import ndimage

from dappled.decode.errors import DecodeError
from dappled.decode.optics import Carrier, Lattice, Order
from dappled.decode.spectrum.peaks import Measured, fit, is_suspect, measure, residual_bins
from dappled.decode.spectrum.transform import Spectrum

_SMALLEST_VERIFIED = 6  # carriers in one half plane, DC left out
_CANDIDATES = 30  # the strongest: pairs of them are bases to try
_MOST_POINTS = 4000
_TOLERANCE_BINS = 1.5  # of a multiple of the basis: an order stands so near; chosen by hand


@dataclass(frozen=True, slots=True)
class FoundLattice:
    """A lattice and what of it was seen.

    `carriers` are the verified ones of one half plane ((0, 0) left out) at the fitted lattice, `measured` their own
    peaks. `residual_bins` is the rms distance between the two in bins of the padded transform. `predicted` counts the
    lattice points of the half plane that were looked at.
    """

    lattice: Lattice
    carriers: tuple[Carrier, ...]
    measured: tuple[Measured, ...]
    residual_bins: float
    predicted: int

    @property
    def spacing_px(self) -> tuple[float, float]:
        """Lengths of the two shortest steps from a lenslet's centre to the next, in pixels, by rows first.

        On a square lattice the distances between rows of lenslets, on a hexagonal one 2/√3 times as much.
        """
        lengths = np.hypot(*np.linalg.inv(self.lattice.matrix()))
        return float(lengths[0]), float(lengths[1])

    @property
    def rotation_rad(self) -> float:
        """The turn of the vector (0, 1) away from the column axis, as `Lattice.rotated` counts."""
        return math.atan2(-self.lattice.kx[0], self.lattice.kx[1])

    @property
    def orders(self) -> tuple[Order, ...]:
        """The verified orders, (0, 0) left out."""
        return tuple((carrier.ky, carrier.kx) for carrier in self.carriers)


@dataclass(frozen=True, slots=True)
class Candidate:
    """A bin that exceeds its surroundings: its position in bins (sub-bin), and by how many nats it does."""

    row: float
    column: float
    prominence: float


def find_lattice(spectrum: Spectrum) -> FoundLattice:
    """Find the lattice of carriers in a whole spectrum without a prediction. Raises DecodeError where there is none."""
    found = candidates(spectrum)
    strongest = [c for c in found if not _artefact(c, spectrum)][:_CANDIDATES]
    if len(strongest) < 3:
        raise DecodeError(
            f"no carriers: {len(strongest)} peaks stand out of this spectrum, a lattice needs more. "
            "Is this a frame from behind a mask or lenslets?"
        )
    points = np.array([(c.row, c.column) for c in strongest])
    weights = np.array([c.prominence for c in strongest])
    basis = _vote(points, weights, spectrum)
    for _ in range(3):
        basis = reduced(_refit(basis, points, weights))
    lattice = Lattice.of(basis / np.array(spectrum.padded))
    verified: list[tuple[Carrier, Measured]] = []
    predicted = 0
    for radius in (2.0, 1.5, 1.5):
        looked = _half_plane(lattice)
        predicted = len(looked)
        peaks = measure(spectrum, looked, radius, prominence_nats=1.6)
        verified = [(c, m) for c, m in zip(looked, peaks, strict=True) if m is not None and not m.suspect]
        orders = np.array([(c.ky, c.kx) for c, _ in verified])
        if len(verified) < _SMALLEST_VERIFIED or np.linalg.matrix_rank(orders) < 2:
            raise DecodeError(
                f"no carriers: of {predicted} points of the likeliest lattice only {len(verified)} show a peak. "
                "Is this a frame from behind a mask or lenslets?"
            )
        lattice = fit(verified)
    if not _believable(verified, predicted):
        raise DecodeError(
            f"no carriers: the likeliest lattice explains {len(verified)} of its {predicted} points, "
            "no more than chance does. Is this a frame from behind a mask or lenslets?"
        )
    lattice, renamed = _named(lattice, verified)
    carriers = lattice.carriers([order for order, _ in renamed])
    measured = [m for _, m in renamed]
    return FoundLattice(
        lattice, tuple(carriers), tuple(measured), residual_bins(carriers, measured, spectrum), predicted
    )


def candidates(spectrum: Spectrum, *, prominence_nats: float = 2.0, spacing_bins: int = 21) -> list[Candidate]:
    """Local maxima of log magnitude less its local mean, in the half plane of the spectrum, strongest first."""
    half = spectrum.half
    rows = 0.5 * half - 0.25 * (np.roll(half, 1, axis=0) + np.roll(half, -1, axis=0))
    windowed = 0.5 * rows
    windowed[:, 1:-1] -= 0.25 * (rows[:, 2:] + rows[:, :-2])
    mirrored = -np.arange(half.shape[0]) % half.shape[0]
    windowed[:, 0] -= 0.25 * (rows[:, 1] + np.conj(rows[mirrored, 1]))  # column −1 is the conjugate of column 1
    log = np.log(np.abs(windowed) + np.float32(1e-12))
    prominence = log - ndimage.uniform_filter(log, spacing_bins, mode=("wrap", "reflect"))
    top = ndimage.maximum_filter(prominence, spacing_bins, mode=("wrap", "reflect"))
    peak = (prominence == top) & (prominence > prominence_nats)
    peak[:, -1] = False
    found = []
    for row, column in np.argwhere(peak):
        signed = row - half.shape[0] if row > half.shape[0] // 2 else row
        if math.hypot(signed, column) < spacing_bins / 2 or (column == 0 and signed < 0):
            continue
        dy = _parabola(log[row - 1, column], log[row, column], log[(row + 1) % half.shape[0], column])
        left = log[row, column - 1] if column else log[-row, 1]  # column −1 is the conjugate of column 1
        dx = _parabola(left, log[row, column], log[row, column + 1])
        found.append(Candidate(signed + dy, column + dx, float(prominence[row, column])))
    return sorted(found, key=lambda c: -c.prominence)


def reduced(basis: NDArray[np.float64]) -> NDArray[np.float64]:
    """Gauss reduction of a (2, 2) basis (rows): the two shortest vectors of the same lattice, the shorter first."""
    a, b = basis
    while True:
        if a @ a > b @ b:
            a, b = b, a
        step = round(float(a @ b) / float(a @ a))
        if step == 0:
            return np.array([a, b])
        b = b - step * a


def _vote(points: NDArray[np.float64], weights: NDArray[np.float64], spectrum: Spectrum) -> NDArray[np.float64]:
    """The pair of peaks whose lattice explains the others best, relative to chance for a lattice of its density."""
    stretch = np.array([1.0, spectrum.padded[0] / spectrum.padded[1]])  # bins to one scale on both axes
    best, best_score = None, 0.0
    # Differences belong to the lattice too, and find it where its shortest vectors are hidden.
    vectors = [*points, *(a - b for a, b in itertools.combinations(points[:10], 2))]
    for a, b in itertools.combinations(vectors, 2):
        basis = np.array([a, b])
        area = abs(float(np.linalg.det(basis)))
        if area < 0.05 * math.hypot(*(a * stretch)) * math.hypot(*(b * stretch)) or area < 100 * _TOLERANCE_BINS**2:
            continue
        orders = points @ np.linalg.inv(basis)
        whole = np.round(orders)
        distance = np.hypot(*((orders - whole) @ basis).T)
        size = 1 + 0.15 * np.abs(whole).sum(axis=1)  # the pair's own error grows with the order
        near = (distance < _TOLERANCE_BINS * size) & np.any(whole != 0, axis=1)
        chance = np.minimum(np.pi * (_TOLERANCE_BINS * size[near]) ** 2 / area, 1.0)
        score = float((weights[near] * -np.log(chance)).sum())
        if score > best_score:
            best, best_score = basis, score
    if best is None:
        raise DecodeError("no carriers: the peaks of this spectrum lie on no lattice together")
    return reduced(best)


def _refit(
    basis: NDArray[np.float64], points: NDArray[np.float64], weights: NDArray[np.float64]
) -> NDArray[np.float64]:
    orders = points @ np.linalg.inv(basis)
    whole = np.round(orders)
    near = np.hypot(*((orders - whole) @ basis).T) < 2 * _TOLERANCE_BINS
    near &= np.any(whole != 0, axis=1)
    if near.sum() < 3 or np.linalg.matrix_rank(whole[near]) < 2:
        return basis
    weighted = weights[near, None]
    fitted: NDArray[np.float64] = np.linalg.lstsq(whole[near] * weighted, points[near] * weighted, rcond=None)[0]
    return fitted


def _half_plane(lattice: Lattice) -> list[Carrier]:
    """All lattice points below Nyquist with (ky, kx) above (0, 0)."""
    inverse = np.abs(np.linalg.inv(lattice.matrix()))
    reach = [min(math.ceil(0.5 * float(inverse[:, axis].sum())), 200) for axis in (0, 1)]
    orders = [(ky, kx) for ky in range(reach[0] + 1) for kx in range(-reach[1], reach[1] + 1) if (ky, kx) > (0, 0)]
    points = [c for c in lattice.carriers(orders) if abs(c.fy) < 0.5 and abs(c.fx) < 0.5]
    return sorted(points, key=lambda c: math.hypot(c.fy, c.fx))[:_MOST_POINTS]


def _believable(verified: list[tuple[Carrier, Measured]], predicted: int) -> bool:
    """Whether more than chance: nearly all of the innermost points must show a peak, or a good share of all points."""
    inner = [c for c, _ in verified if abs(c.ky) <= 2 and abs(c.kx) <= 2]
    return len(inner) >= 6 or len(verified) > 0.25 * predicted + 3


def _named(lattice: Lattice, verified: list[tuple[Carrier, Measured]]) -> tuple[Lattice, list[tuple[Order, Measured]]]:
    """Orders by contract: (0, 1) and (1, 0) the two shortest vectors, (0, 1) the one more along columns."""
    short = reduced(lattice.matrix())
    if abs(short[0, 1]) * abs(short[1, 0]) < abs(short[1, 1]) * abs(short[0, 0]):
        short = short[::-1]
    along_columns, along_rows = short
    along_columns = along_columns * (1 if along_columns[1] >= 0 else -1)
    along_rows = along_rows * (1 if along_rows[0] >= 0 else -1)
    matrix = np.array([along_rows, along_columns])
    renamed = []
    for carrier, measured in verified:
        order = np.round(np.array([carrier.fy, carrier.fx]) @ np.linalg.inv(matrix)).astype(int)
        ky, kx = int(order[0]), int(order[1])
        if (ky, kx) < (0, 0):
            renamed.append(((-ky, -kx), measured.twin()))
        else:
            renamed.append(((ky, kx), measured))
    return Lattice.of(matrix), sorted(renamed, key=lambda pair: pair[0])


def _artefact(candidate: Candidate, spectrum: Spectrum) -> bool:
    return is_suspect(candidate.row / spectrum.padded[0], candidate.column / spectrum.padded[1], spectrum.shape)


def _parabola(below: float, centre: float, above: float) -> float:
    curve = float(below) - 2 * float(centre) + float(above)
    return 0.0 if curve >= 0 else max(-0.5, min(0.5, 0.5 * (float(below) - float(above)) / curve))
