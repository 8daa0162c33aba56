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

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy import fft, ndimage

from dappled.decode.array_types import Floats, Singles
from dappled.decode.depth.depth_map import Volume
from dappled.decode.depth.evidence import Evidence
from dappled.workers import each

_WINDOW = 3  # px
_MOST_VOTE, _VOTES = 0.5, 100.0  # measured on the masked frames of benchmarks/depth.py, seeds 1 and 2
_PAD = 12  # px
_MEASURED = 1e-5  # of the weight of what was measured best
_OTHERS = 0.02  # of a direction's information: what is left of it without the other half
_LEAST_VIEWS = 3  # along an axis, to be halved


@dataclass(frozen=True, slots=True, eq=False)
class Part:
    """What is known of some views: `measured` y (C, h, w) with noise of variance 1, `matrix` A (C, J), `steps` (J, 2),
    rows first, and the `variance` of the picture."""

    measured: Singles
    matrix: Floats
    steps: Floats
    variance: float

    def without(self, others: NDArray[np.bool_]) -> Part:
        """What it tells of the other views, whatever these (J,) see."""
        beside = self.matrix[:, others]
        noise = np.eye(len(beside)) + self.variance * beside @ beside.T
        values, vectors = np.linalg.eigh(noise)
        kept = values < 1 / _OTHERS
        whitened = (vectors[:, kept] / np.sqrt(values[kept])).T
        flat = whitened.astype(np.float32) @ self.measured.reshape(len(beside), -1)
        shape = (len(whitened), *self.measured.shape[1:])
        return Part(flat.reshape(shape), whitened @ self.matrix[:, ~others], self.steps[~others], self.variance)


def whole(evidence: Evidence) -> Part:
    """All views of the evidence: y = A⁻¹Q where something was measured, A = W^½."""
    values, vectors = np.linalg.eigh(evidence.weights)
    kept = values > _MEASURED * values[-1]
    root, vectors = np.sqrt(values[kept]), vectors[:, kept]
    shape = evidence.images.shape
    measured = (vectors / root).T.astype(np.float32) @ evidence.images.reshape(shape[0] * shape[1], -1)
    stack = evidence.stack
    steps = np.stack(np.meshgrid(stack.row_steps, stack.column_steps, indexing="ij"), axis=-1).reshape(-1, 2)
    variance = max(float(np.var(evidence.picture())), 1e-9)
    return Part(measured.reshape(-1, *shape[2:]), root[:, None] * vectors.T, steps, variance)


def halves(part: Part) -> list[Part]:
    """The left, right, upper and lower half of the aperture, each with the middle line; the whole where there are too
    few views for that."""
    found = []
    for along in part.steps.T:
        if len(np.unique(along)) < _LEAST_VIEWS:
            continue
        found += [part.without(others) for others in (along > 1e-9, along < -1e-9)]
    return found or [part]


def unexplained(part: Part, disparities: NDArray[np.float64], *, workers: int = 1) -> Volume:
    """float32 (D, h, w): half of what each disparity leaves unexplained at a pixel, in squared noise sigmas, less what
    noise alone leaves: minus a log-likelihood, but for a constant."""
    count, height, width = part.measured.shape
    shape = fft.next_fast_len(height + 2 * _PAD), fft.next_fast_len(width + 2 * _PAD, real=True)
    margins = ((0, 0), (_PAD, shape[0] - height - _PAD), (_PAD, shape[1] - width - _PAD))
    padded = np.pad(part.measured, margins, mode="symmetric").transpose(1, 0, 2)
    spectra = np.ascontiguousarray(fft.rfft2(padded, axes=(0, 2), workers=workers))  # (fy, c, fx)
    fy, fx = fft.fftfreq(shape[0]), fft.rfftfreq(shape[1])
    # For products (c, j) @ (j, fx), one a row: too small for BLAS to start threads of its own.
    matrix = part.matrix.astype(np.complex64)
    floor, expected = np.float32(1 / part.variance), np.float32((count - 1) / 2)
    out = np.empty((len(disparities), height, width), dtype=np.float32)

    def one(number: int) -> None:
        turns = -2j * np.pi * disparities[number]
        rows = np.exp(turns * np.outer(fy, part.steps[:, 0])).astype(np.complex64)
        columns = np.exp(turns * np.outer(part.steps[:, 1], fx)).astype(np.complex64)
        gains = (rows[:, None, :] * matrix) @ columns
        weight = np.einsum("ycx,ycx->yx", gains.view(np.float32), gains.view(np.float32)).reshape(
            *spectra.shape[::2], 2
        )
        picture = np.einsum("ycx,ycx->yx", gains.conj(), spectra) / (weight.sum(axis=2) + floor)
        gains *= -picture[:, None]
        gains += spectra
        left = fft.irfft2(gains, s=shape, axes=(0, 2))[_PAD : _PAD + height, :, _PAD : _PAD + width]
        np.einsum("ycx,ycx->yx", left, left, out=out[number])
        out[number] *= 0.5
        out[number] -= expected

    each(one, range(len(disparities)), workers)
    return out


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
