"""Standard errors of views near clipped pixels: unknown, and elsewhere as they were."""

from __future__ import annotations

import numpy as np
import pytest

from dappled.decode.lightfield import LightField
from dappled.decode.lightfield.clipping import clipped_shares, unknown_where_clipped

SHAPE, SIZE, STEP = (600, 720), (100, 120), 6.0  # of the frame, of a view, pixels a sample
PATCHES = 10, 11


def field(*, told: bool = True) -> LightField:
    sigma = np.full((5, 5, *PATCHES), 0.01, dtype=np.float32)
    return LightField(
        np.zeros((1, *SIZE), dtype=np.complex64),
        np.zeros((1, 4)),
        np.zeros((5, 5, *SIZE), dtype=np.float32),
        np.zeros((5, 5, 2)),
        np.array([[STEP, 0.0, 0.0], [0.0, STEP, 0.0]]),
        {"view_sigma": [[0.01] * 5] * 5},
        sigma if told else None,
    )


def test_patches_that_hold_a_clipped_spot_are_unknown_and_no_others() -> None:
    """A spot of 20 × 20 pixels around (300, 200), sample (50, 33): patches are 24 samples wide around 12·i − 0.5."""
    clipped = np.zeros(SHAPE, dtype=np.float32)
    clipped[290:310, 190:210] = 1
    made = unknown_where_clipped(field(), clipped, 0.01)
    assert made.view_sigma is not None
    unknown = np.isnan(made.view_sigma).all(axis=(0, 1))
    np.testing.assert_array_equal(
        np.argwhere(unknown), [[4, 2], [4, 3], [5, 2], [5, 3]]
    )  # the spot is 1.9 % of a patch
    assert np.isnan(made.view_sigma).sum() == 25 * 4
    assert made.attributes["view_sigma"] == pytest.approx(np.full((5, 5), 0.01))


def test_a_little_is_no_doubt() -> None:
    clipped = np.zeros(SHAPE, dtype=np.float32)
    clipped[290:310, 190:200] = 1
    given = field()
    assert unknown_where_clipped(given, clipped, 0.01) is given


def test_nothing_is_told_of_a_frame_that_is_clipped_all_over() -> None:
    made = unknown_where_clipped(field(), np.ones(SHAPE, dtype=np.float32), 0.01)
    assert made.view_sigma is not None
    assert np.isnan(made.view_sigma).all()
    assert made.attributes["view_sigma"] is None


def test_without_standard_errors_there_is_nothing_to_take_back() -> None:
    given = field(told=False)
    assert unknown_where_clipped(given, np.ones(SHAPE, dtype=np.float32), 0.01) is given


def test_the_share_of_each_patch_that_is_clipped() -> None:
    """A spot of 20 × 20 pixels is 400 of the 144 × 144 of a patch."""
    clipped = np.zeros(SHAPE, dtype=np.float32)
    clipped[290:310, 190:210] = 1
    shares = clipped_shares(clipped, SIZE, field().grid)
    assert shares.shape == PATCHES
    assert shares.max() == pytest.approx(400 / 144**2)
    np.testing.assert_array_equal(np.argwhere(shares > 0), [[4, 2], [4, 3], [5, 2], [5, 3]])
