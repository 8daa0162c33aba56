"""Sums and differences of views that lie opposite each other in the aperture.

The stop has a centre of symmetry, and views are real: what views v and v′ on its two sides hold of a wave is conjugate.
So (v + v′)/√2 and (v − v′)/(√2 i) are real multiples of it. Views are kept as these pairs while they are computed: the
sum in the place of the view that comes first, the difference in that of its opposite; a view in the middle is its own.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from dappled.decode.array_types import Complexes, Floats

_ROOT = np.float32(np.sqrt(0.5))


def paired(views: NDArray[Any]) -> NDArray[Any]:
    """(…, V·U) real, the pairs of what views hold, complex (…, V·U), conjugate in opposite ones."""
    half = views.shape[-1] // 2
    made = views.real.copy()
    made[..., :half] *= np.sqrt(2)
    made[..., ::-1][..., :half] = np.sqrt(2) * views.imag[..., :half]
    return made


def views_of(pairs: Complexes) -> Complexes:
    """The spectra (F, V·U, N) of views from those of their pairs."""
    half = pairs.shape[1] // 2
    sums, differences = pairs[:, :half] * _ROOT, pairs[:, ::-1][:, :half] * (1j * _ROOT)
    made = pairs.copy()
    made[:, :half] = sums + differences
    made[:, ::-1][:, :half] = sums - differences
    return made


def variance_of_views(variance: Floats) -> Floats:
    """The variances (V·U, …) of views from those of their pairs: opposite views have the same."""
    return np.asarray((variance + variance[::-1]) / 2)
