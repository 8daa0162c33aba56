"""Eigenvalues and eigenvectors of very many very small matrices.

LAPACK takes some microseconds for each, whatever its size. Jacobi's rotations do the same to all of them at once.
"""

from __future__ import annotations

from itertools import combinations

import numpy as np

from dappled.decode.array_types import Floats
from dappled.decode.joint.patch_model import Doubles

_SMALL = 3  # rows: beyond, LAPACK is faster
_SWEEPS = 12  # at most; each one squares what is left beside the diagonal, once it is small


def eigh(matrices: Doubles) -> tuple[Floats, Doubles]:
    """Eigenvalues (…, R), ascending, and eigenvectors (…, R, R), in columns, of symmetric matrices (…, R, R)."""
    size = matrices.shape[-1]
    if size > _SMALL or np.iscomplexobj(matrices):
        values, vectors = np.linalg.eigh(matrices)
        return values, vectors
    rows = matrices.reshape(-1, size, size)
    a = [[np.ascontiguousarray(rows[:, i, j]) for j in range(size)] for i in range(size)]
    turn = [[np.full(len(rows), float(i == j)) for j in range(size)] for i in range(size)]
    least = np.finfo(np.float64).eps * sum(np.abs(a[i][i]) for i in range(size))
    for _ in range(_SWEEPS if size > 1 else 0):
        for p, q in combinations(range(size), 2):
            _rotate(a, turn, p, q)
        if all((np.abs(a[p][q]) <= least).all() for p, q in combinations(range(size), 2)):
            break
    values = np.stack([a[i][i] for i in range(size)], axis=-1)
    vectors = np.stack([np.stack(row, axis=-1) for row in turn], axis=-2)
    order = np.argsort(values, axis=-1)
    values = np.take_along_axis(values, order, axis=-1)
    vectors = np.take_along_axis(vectors, order[:, None], axis=-1)
    return values.reshape(matrices.shape[:-1]), vectors.reshape(matrices.shape)


def _rotate(a: list[list[Floats]], turn: list[list[Floats]], p: int, q: int) -> None:
    """Turn rows and columns p and q so that what stands at both is 0, and `turn` with them."""
    off, apart = a[p][q], (a[q][q] - a[p][p]) / 2
    far = apart + np.copysign(np.sqrt(off * off + apart * apart), apart)
    tangent = np.divide(off, far, out=np.zeros_like(off), where=far != 0)
    cosine = 1 / np.sqrt(1 + tangent * tangent)
    sine = tangent * cosine
    moved = tangent * off
    a[p][p] = a[p][p] - moved
    a[q][q] = a[q][q] + moved
    a[p][q] = a[q][p] = np.zeros_like(off)
    for r in range(len(a)):
        if r not in (p, q):
            left, right = a[r][p], a[r][q]
            a[r][p] = a[p][r] = cosine * left - sine * right
            a[r][q] = a[q][r] = sine * left + cosine * right
    for row in turn:
        left, right = row[p], row[q]
        row[p] = cosine * left - sine * right
        row[q] = sine * left + cosine * right
