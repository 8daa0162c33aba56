"""Which masked frames' depth comes from their views: those without noise that were plainly inverted."""

from __future__ import annotations

import numpy as np
import pytest

from dappled.decode.depth import estimate, evidence
from dappled.decode.lightfield import LightField, ViewStack
from dappled.decode.lightfield.light_field import centred
from tests.decode.scenes import Board, paint


def field(noise_rms: float, model: str) -> LightField:
    """A masked frame of two orders and the views of two boards."""
    stack, _ = paint([Board(-0.6, mean=0.25), Board(1.0, half=(14.0, 14.0), mean=0.75)], (64, 64), 3)
    carriers = np.array([[0, 0, 0, 0], [0, 1, 0, 0.1], [1, 0, 0.1, 0]], dtype=np.float64)
    places = (np.arange(3) - 1) / 3
    offsets = np.stack(np.meshgrid(places, places, indexing="ij"), axis=-1)
    transfers = [[0.0, 0.0, 1.0, 0.0], [0.0, 1.0, 0.3, 0.0], [1.0, 0.0, 0.3, 0.0]]
    attributes = {"transfers": transfers, "noise_rms": noise_rms, "views_model": model, "shape": [640, 640]}
    grid = np.array([[10.0, 0.0, 0.0], [0.0, 10.0, 0.0]])
    slices = np.zeros((3, 64, 64), dtype=np.complex64)
    return LightField(slices, carriers, stack.views, offsets, grid, attributes)


def test_views_count_only_without_noise_and_without_the_joint_model() -> None:
    clean = evidence.of_light_field(field(1e-7, "independent"))
    assert clean.made is not None
    assert evidence.of_light_field(field(0.1, "independent")).made is None
    assert evidence.of_light_field(field(1e-7, "joint")).made is None
    by_views = estimate.estimate(evidence.of_views(clean.made), between=(-1, 1.5))
    made = estimate.estimate(clean, between=(-1, 1.5))
    np.testing.assert_array_equal(made.disparity, by_views.disparity)
    shared = evidence.of_made(clean.made).shared / clean.made.reach
    assert shared > 0
    np.testing.assert_allclose(made.sigma, np.hypot(by_views.sigma, shared), rtol=1e-5)  # NaN where unknown
    assert estimate.estimate(clean, "contrast", between=(-1, 1.5)).known_share() == 0  # its slices are empty


@pytest.mark.parametrize(("shape", "kept"), [((9, 9), (5, 5)), ((5, 5), (5, 5)), ((1, 9), (1, 5)), ((8, 7), (8, 4))])
def test_every_second_of_many_views_is_left_and_the_outermost_ones_stay(
    shape: tuple[int, int], kept: tuple[int, int]
) -> None:
    rng = np.random.default_rng(1)
    views = rng.random((*shape, 12, 14), dtype=np.float32)
    whole = evidence.of_views(ViewStack(views, centred(shape[0]), centred(shape[1])), 0.1)
    fewer = evidence.thinned(whole)
    assert fewer.stack.views.shape[:2] == kept
    assert fewer.stack.reach == whole.stack.reach
    np.testing.assert_allclose(fewer.images, fewer.stack.views * fewer.weights[0, 0], rtol=1e-5)
    assert fewer.weights.shape == (kept[0] * kept[1],) * 2
    np.testing.assert_array_equal(fewer.stack.views[0, 0], views[0, 0])
    np.testing.assert_array_equal(fewer.stack.views[-1, -1], views[-1, -1])
