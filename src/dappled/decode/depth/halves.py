"""What each disparity leaves unexplained of a noisy masked frame, in the half of the aperture that it explains best.

Beside a near object's edge part of the aperture sees that object, and another part what is behind it. A slice is a sum
over the whole aperture, so views of one part can't be picked from slices, and inverting them into views multiplies
their noise. But views of the other part can be taken as unknown: with y = A·L + noise of variance 1 (A² = W of
`evidence`), and views of the other half white with the picture's variance s², the noise of y is 1 + s²·A₂A₂ᵀ. Whitened,
y tells of the half H alone.

With φ_j = exp(−2πi D f·step_j) the picture that fits best is I = Σ_c (A_H φ)_c* y_c / (Σ_c |A_H φ|_c² + 1/s²), and
y − A_H φ I is unexplained. Energy that is left over, unlike energy that is explained, stays at its pixel when pictures
are sheared by a wrong disparity: strong detail speaks for no disparity of the faint detail beside it.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray
from scipy import fft, ndimage

from dappled.decode.array_types import Complexes, Floats, Singles
from dappled.decode.depth.depth_map import Volume
from dappled.decode.depth.evidence import CELLS, Evidence
from dappled.decode.lightfield.light_field import centred
from dappled.workers import each, spans

# Chosen by hand where no figure stands beside a number; benchmarks/depth.py measures what all of them together make.

_WINDOW = 3  # px
_MOST_VOTE, _VOTES = 0.5, 100.0  # measured on the masked frames of benchmarks/depth.py, seeds 1 and 2
_PAD = 12  # px
_ROWS = 16  # at a time: what is worked on stays in the processor's cache
_MEASURED = 1e-5  # of the weight of what was measured best
_OTHERS = 0.02  # of a direction's information: what is left of it without the other half
# px at the edges, where slices hold what their band leaves of the frame's end, at 3 to 260 times the noise. Without
# them 1 to 2 % fewer pixels are wrong (benchmarks/depth.py --masked, seeds 1 and 2), near the edges.
_CUT_OFF = 1
_LEAST_VIEWS = 3  # along an axis, to be halved


@dataclass(frozen=True, slots=True, eq=False)
class Part:
    """What is known of a grid of aperture points: `measured` y (C, h, w) with noise of variance 1, `matrix` A (C, J),
    `steps` (J, 2), row by row, the `variance` of the picture, and the steps (J, 2) of the `views` that the points
    belong to (None: each is a view)."""

    measured: Singles
    matrix: Floats
    steps: Floats
    variance: float
    views: Floats | None = None

    @property
    def of_noise(self) -> float:
        """What noise alone leaves of a pixel at a disparity, in `unexplained`'s unit."""
        return (len(self.measured) - 1) / 2

    def of_views(self) -> Floats:
        """(J, 2) the step of each point's view."""
        return self.steps if self.views is None else self.views

    def without(self, others: NDArray[np.bool_]) -> Part:
        """What it tells of the other points, whatever the views of these (J,) see."""
        _, number = np.unique(self.of_views()[others], axis=0, return_inverse=True)
        beside = self.matrix[:, others] @ np.eye(number.max() + 1)[number.ravel()]
        noise = np.eye(len(beside)) + self.variance * beside @ beside.T
        values, vectors = np.linalg.eigh(noise)
        kept = values < 1 / _OTHERS
        whitened = (vectors[:, kept] / np.sqrt(values[kept])).T
        flat = whitened.astype(np.float32) @ self.measured.reshape(len(beside), -1)
        shape = (len(whitened), *self.measured.shape[1:])
        matrix, views = whitened @ self.matrix[:, ~others], self.of_views()[~others]
        return Part(flat.reshape(shape), matrix, self.steps[~others], self.variance, views)


def whole(evidence: Evidence) -> Part:
    """All points of the evidence's aperture: y = A⁻¹Q where something was measured, A = W^½."""
    values, vectors = np.linalg.eigh(evidence.weights)
    kept = values > _MEASURED * values[-1]
    root, vectors = np.sqrt(values[kept]), vectors[:, kept]
    shape = evidence.images.shape
    measured = (vectors / root).T.astype(np.float32) @ evidence.images.reshape(shape[0] * shape[1], -1)
    axes = evidence.stack.row_steps, evidence.stack.column_steps
    matrix, views = root[:, None] * vectors.T, _grid(*axes)
    variance = max(float(np.var(evidence.picture())), 1e-9)
    measured = measured.reshape(-1, *shape[2:])
    if min(shape[2:]) > 2 * _CUT_OFF:
        inside = slice(_CUT_OFF, -_CUT_OFF)
        measured = np.pad(measured[:, inside, inside], ((0, 0), (_CUT_OFF,) * 2, (_CUT_OFF,) * 2), mode="edge")
    if evidence.filled is None:
        return Part(measured, matrix, views, variance)
    within = centred(CELLS) / CELLS
    cells = [(axis[:, None] + within * abs(axis[1] - axis[0] if len(axis) > 1 else 0)).ravel() for axis in axes]
    return Part(
        measured, matrix @ evidence.filled, _grid(*cells), variance, _grid(*(np.repeat(a, CELLS) for a in axes))
    )


def _grid(rows: Floats, columns: Floats) -> Floats:
    """(R·C, 2) both of each point, row by row."""
    return np.stack(np.meshgrid(rows, columns, indexing="ij"), axis=-1).reshape(-1, 2)


def likelier(evidence: Evidence, disparities: NDArray[np.float64], *, workers: int = 1) -> Evidence:
    """The evidence, its aperture filled or points, whichever leaves less unexplained at each pixel's best disparity.

    The means of slices, which the aperture is fitted to, can be the same for both. But light through a cell spreads
    over as much as neighbouring views differ by, so that coarse detail moves less from slice to slice. Taken for
    points, a filled aperture draws faint walls of benchmarks/depth_masked.py 0.04 px/view towards disparity 0.
    """
    if evidence.filled is None:
        return evidence
    both = evidence, replace(evidence, filled=None)
    left = []
    for one in both:
        found = unexplained(whole(one), disparities, workers=workers)
        left.append(float(ndimage.uniform_filter(found, (0, _WINDOW, _WINDOW), mode="nearest").min(axis=0).mean()))
    return both[int(left[1] <= left[0])]


def halves(part: Part) -> list[Part]:
    """The left, right, upper and lower half of the aperture, each with the middle line; the whole where there are too
    few views for that."""
    found = []
    for along in part.of_views().T:
        if len(np.unique(along)) < _LEAST_VIEWS:
            continue
        found += [part.without(others) for others in (along > 1e-9, along < -1e-9)]
    return found or [part]


def unexplained(part: Part, disparities: NDArray[np.float64], *, workers: int = 1) -> Volume:
    """float32 (D, h, w): half of what each disparity leaves unexplained at a pixel, in squared noise sigmas, less what
    noise alone leaves: minus a log-likelihood, but for a constant."""
    height, width = part.measured.shape[1:]
    shape = fft.next_fast_len(height + 2 * _PAD), fft.next_fast_len(width + 2 * _PAD, real=True)
    margins = ((0, 0), (_PAD, shape[0] - height - _PAD), (_PAD, shape[1] - width - _PAD))
    padded = np.pad(part.measured, margins, mode="symmetric").transpose(1, 0, 2)
    spectra = np.ascontiguousarray(fft.rfft2(padded, axes=(0, 2), workers=workers))  # (fy, c, fx)
    expected = np.float32(part.of_noise)
    out = np.empty((len(disparities), height, width), dtype=np.float32)

    def one(number: int) -> None:
        by_row, columns = _turned(part, disparities[number], shape)
        left = np.empty_like(spectra)
        for rows in spans(shape[0], _ROWS):
            _residual(by_row[rows], columns, spectra[rows], 1 / part.variance, left[rows])
        seen = fft.ifft(left, axis=0, overwrite_x=True)[_PAD : _PAD + height]
        for rows in spans(height, _ROWS):
            lines = fft.irfft(seen[rows], n=shape[1], axis=2)[:, :, _PAD : _PAD + width]
            np.einsum("ycx,ycx->yx", lines, lines, out=out[number, rows])
        out[number] *= 0.5
        out[number] -= expected

    each(one, range(len(disparities)), workers)
    return out


def _turned(part: Part, disparity: float, shape: tuple[int, int]) -> tuple[Complexes, Complexes]:
    """(fy, c, U) A's columns summed over the rows of views, each with its phase at a disparity; (U, fx) the phases of
    the columns of views. Their product is Aφ. `shape` is that of the pictures."""
    across = len(np.unique(part.steps[:, 1]))
    row_steps, column_steps = part.steps[::across, 0], part.steps[:across, 1]
    turns = -2j * np.pi * disparity
    rows = np.exp(turns * np.outer(fft.fftfreq(shape[0]), row_steps)).astype(np.complex64)
    columns = np.exp(turns * np.outer(column_steps, fft.rfftfreq(shape[1]))).astype(np.complex64)
    matrix = part.matrix.reshape(len(part.matrix), len(row_steps), across).transpose(1, 0, 2)
    by_row = rows @ matrix.reshape(len(row_steps), -1).astype(np.complex64)
    return by_row.reshape(shape[0], len(part.matrix), across), columns


def _residual(by_row: Complexes, columns: Complexes, measured: Complexes, floor: float, out: Complexes) -> None:
    """(n, c, fx) y − AφI at some rows of frequencies, from `_turned` and `measured` y."""
    # Products of a row each: too small for BLAS to start threads of its own.
    gains = np.matmul(by_row, columns, out=out)
    weight = ((by_row.conj().transpose(0, 2, 1) @ by_row @ columns) * columns.conj()).sum(axis=1).real
    picture = (gains.conj() * measured).sum(axis=1)  # faster than einsum
    picture /= -(weight + np.float32(floor))
    gains *= picture[:, None]
    gains += measured


def best_half(part: Part, disparities: NDArray[np.float64], *, workers: int = 1) -> Volume:
    """`unexplained` (D, h, w) of the half that is explained best, each as the mean over 3 × 3 pixels."""
    best: Volume | None = None
    for half in halves(part):
        found = unexplained(half, disparities, workers=workers)
        found = ndimage.uniform_filter(found, (0, _WINDOW, _WINDOW), mode="nearest")
        best = found if best is None else np.minimum(best, found, out=best)
    assert best is not None
    return best


def voted(cost: Volume, window: int) -> Volume:
    """The costs (D, h, w) with the votes of the pixels in a window: each speaks against a disparity by a limited
    amount, so that a window holds the disparity of most of its pixels, not that of its strongest detail."""
    votes = np.minimum(cost - cost.min(axis=0), np.float32(_MOST_VOTE))
    votes = ndimage.uniform_filter(votes, (0, window, window), mode="nearest")
    votes *= np.float32(_VOTES)
    made: Volume = votes + cost
    return made
