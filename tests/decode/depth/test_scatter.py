"""What neighbours tell of each other's errors: nothing on planes, all of what is independent, little at jumps."""

from __future__ import annotations

import numpy as np
import pytest

from dappled.decode.depth.scatter import scattered

ROWS, COLUMNS = np.mgrid[:80, :90].astype(np.float32)
PLANE = 0.4 + 0.01 * ROWS - 0.02 * COLUMNS


def told(disparity: np.ndarray, most: float = 1.0) -> np.ndarray:
    return scattered(disparity.astype(np.float32), apart=3, most=most, reach=2.0)


def test_a_plane_does_not_scatter_however_it_is_tilted() -> None:
    assert told(PLANE)[8:-8, 8:-8].max() < 1e-5


@pytest.mark.parametrize("sigma", [0.01, 0.04])
def test_independent_errors_are_told_as_they_are(sigma: float) -> None:
    errors = np.random.default_rng(6).normal(size=PLANE.shape) * sigma
    assert np.sqrt(np.mean(told(PLANE + errors)[8:-8, 8:-8] ** 2)) == pytest.approx(sigma, rel=0.05)


def test_a_jump_counts_up_to_a_limit_and_only_nearby() -> None:
    made = told(PLANE + np.where(COLUMNS < 45, 0, 2), most=0.03)
    assert 0.01 < made[40, 44] <= 0.03
    assert made[8:-8, 8:30].max() < 1e-4


def test_what_is_unknown_tells_nothing_of_its_neighbours() -> None:
    holed = PLANE.copy()
    holed[30:50, 30:60] = np.nan
    made = told(holed)
    assert np.isnan(made[40, 45])
    assert made[8:28, 8:-8].max() < 1e-4
    assert np.isnan(told(np.full_like(PLANE, np.nan))).all()
