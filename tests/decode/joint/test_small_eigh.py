"""Eigenvalues of small matrices against LAPACK's."""

from __future__ import annotations

import numpy as np
import pytest

from dappled.decode.joint.small_eigh import eigh


@pytest.mark.parametrize("size", [1, 2, 3, 4])
def test_matrices_are_diagonalised_as_by_lapack(size: int) -> None:
    chance = np.random.default_rng(size)
    alike, own = chance.normal(size=(2, 40, 7, size, 6))
    rows = [
        alike,
        alike[..., :1, :] + 1e-6 * own,
        np.zeros_like(alike),
        alike * 10.0 ** -(np.arange(size)[:, None] ** 2),
    ]
    matrices = np.stack([one @ one.swapaxes(2, 3) for one in rows])
    matrices[2, 0] = np.eye(size)
    values, vectors = eigh(matrices)
    largest = np.abs(matrices).max(axis=(3, 4))[..., None] + 1e-300
    assert (np.diff(values, axis=-1) >= 0).all()
    assert (np.abs(values - np.linalg.eigvalsh(matrices)) / largest).max() < 1e-14
    again = (vectors * values[..., None, :]) @ vectors.swapaxes(3, 4)
    assert (np.abs(again - matrices) / largest[..., None]).max() < 1e-14
    assert np.abs(vectors.swapaxes(3, 4) @ vectors - np.eye(size)).max() < 1e-14
