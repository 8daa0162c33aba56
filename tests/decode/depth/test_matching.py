"""Neighbours along four directions decide where a pixel cannot."""

from __future__ import annotations

import numpy as np
import pytest

from dappled.decode.depth import matching


def test_neighbours_decide_where_a_pixel_cannot() -> None:
    cost = np.zeros((5, 20, 20), np.float32)
    cost[:, :, :] = np.abs(np.arange(5) - 3)[:, None, None]
    cost[:, 10, 10] = 0.1 * np.abs(np.arange(5) - 1)  # a weak opinion of its own
    made = matching.smoothed(cost, small=0.5, large=2.0, workers=2)
    assert (made.argmin(axis=0) == 3).all()
    np.testing.assert_array_equal(made, matching.smoothed(cost, small=0.5, large=2.0))


@pytest.mark.parametrize("shape", [(5, 7, 9), (1, 6, 4), (3, 1, 8), (4, 270, 3)])
def test_it_is_the_mean_of_the_four_paths_costs(shape: tuple[int, int, int]) -> None:
    """Against the formula, pixel by pixel."""
    cost = np.random.default_rng(5).random(shape, dtype=np.float32)
    small, large = 0.3, 0.6
    whole = np.zeros(shape)
    for axis in (1, 2):
        for way in (slice(None), slice(None, None, -1)):
            lines = np.moveaxis(cost, axis, 0)[way].astype(np.float64)
            path = np.zeros_like(lines)
            path[0] = lines[0]
            for i in range(1, len(lines)):
                for d in range(shape[0]):
                    beside = [path[i - 1, k] + small for k in (d - 1, d + 1) if 0 <= k < shape[0]]
                    least = path[i - 1].min(axis=0)
                    path[i, d] = lines[i, d] + np.minimum.reduce([path[i - 1, d], least + large, *beside]) - least
            whole += np.moveaxis(path[way], 0, axis) / 4
    np.testing.assert_allclose(matching.smoothed(cost, small=small, large=large), whole, rtol=1e-4)
