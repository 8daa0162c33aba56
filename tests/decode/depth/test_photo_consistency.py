"""Views are compared with the middle one in the directions that see the same thing."""

from __future__ import annotations

import numpy as np
import pytest

from dappled.decode.depth.photo_consistency import STRIP, Lines, compared, differences, strips
from dappled.decode.lightfield import ViewStack
from dappled.decode.lightfield.light_field import centred
from tests.decode.scenes import Board, paint

DISPARITIES = np.linspace(-1, 1, 9)


@pytest.mark.parametrize("shape", [(5, 5), (1, 2), (2, 1), (1, 5), (3, 2), (2, 2)])
def test_views_differ_least_at_the_true_disparity(shape: tuple[int, int]) -> None:
    stack, _ = paint([Board(0.5)], (48, 70), 5)
    rows, columns = (slice((5 - n) // 2, (5 - n) // 2 + n) for n in shape)
    views = np.ascontiguousarray(stack.views[rows, columns])
    part = ViewStack(views, stack.row_steps[rows], stack.column_steps[columns])
    cost = differences(Lines.of(part, DISPARITIES), DISPARITIES, limit=np.inf)
    assert np.mean(DISPARITIES[cost.argmin(axis=0)][6:-6, 6:-6] == 0.5) > 0.9
    assert compared(part) > 0


def test_tiles_and_workers_make_no_difference() -> None:
    stack, _ = paint([Board(0.3)], (70, 50), 3)
    whole = differences(Lines.of(stack, DISPARITIES), DISPARITIES, limit=0.1)
    np.testing.assert_array_equal(whole, differences(Lines.of(stack, DISPARITIES), DISPARITIES, limit=0.1, workers=2))
    lower = ViewStack(np.ascontiguousarray(stack.views[:, :, 11:]), stack.row_steps, stack.column_steps)
    np.testing.assert_allclose(
        whole[:, 20:], differences(Lines.of(lower, DISPARITIES), DISPARITIES, limit=0.1)[:, 9:], atol=1e-6
    )


def test_the_better_half_of_the_arms_counts() -> None:
    """What one side alone sees otherwise does no harm, and each view counts up to the limit."""
    picture = np.random.default_rng(3).random((40, 40)).astype(np.float32)
    stack = ViewStack(np.broadcast_to(picture, (3, 3, 40, 40)).copy(), centred(3), centred(3))
    stack.views[1, 2] = 0
    stack.views[0, 1] = 0
    assert differences(Lines.of(stack, np.zeros(1)), np.zeros(1), limit=1.0).max() < 1e-9
    stack.views[1, 0] = 5
    assert differences(Lines.of(stack, np.zeros(1)), np.zeros(1), limit=0.25).max() == pytest.approx(0.25, rel=1e-4)
    assert compared(stack) == 2


@pytest.mark.parametrize("every", [1, 2, 3, 9])
@pytest.mark.parametrize("height", [STRIP - 5, 3 * STRIP, 5 * STRIP + 7])
def test_some_strips_are_those_of_the_whole(height: int, every: int) -> None:
    stack, _ = paint([Board(0.3)], (height, 40), 3)
    whole = differences(Lines.of(stack, DISPARITIES), DISPARITIES, limit=np.inf)
    some = differences(Lines.of(stack, DISPARITIES), DISPARITIES, limit=np.inf, every=every)
    tops = strips(height, every)
    assert 0 <= tops[0] < every * STRIP
    np.testing.assert_array_equal(some, np.concatenate([whole[:, top : top + STRIP] for top in tops], axis=1))


@pytest.mark.parametrize("window", [3, 5])
def test_a_part_is_that_of_the_whole(window: int) -> None:
    stack, _ = paint([Board(0.3)], (3 * STRIP, 60), 3)
    lines = Lines.of(stack, DISPARITIES, window=window)
    limit = np.random.default_rng(1).uniform(0.001, 0.1, (3 * STRIP, 60)).astype(np.float32)
    part = slice(7, 2 * STRIP), slice(11, 50)
    some = differences(lines, DISPARITIES, limit=limit, window=window, within=part)
    whole = differences(lines, DISPARITIES, limit=limit, window=window)
    np.testing.assert_allclose(some, whole[:, *part], rtol=1e-5, atol=1e-9)


def test_what_is_coarse_is_taken_from_the_views() -> None:
    """Views that differ by a slope of brightness look the same without what is coarse in them."""
    picture = np.random.default_rng(3).random((40, 40)).astype(np.float32)
    views = np.broadcast_to(picture, (3, 3, 40, 40)).copy()
    views += np.linspace(0, 1, 3, dtype=np.float32)[:, None, None, None] * np.linspace(0, 1, 40, dtype=np.float32)
    stack = ViewStack(views, centred(3), centred(3))
    plain, apart = (Lines.of(stack, np.zeros(1), shade=shade) for shade in (0.0, 1.5))
    left = [differences(lines, np.zeros(1), limit=np.inf)[0, 8:-8, 8:-8].max() for lines in (plain, apart)]
    assert left[0] < 1e-9  # the better arms are those along the rows
    views[:, 0] += 0.1
    views[:, 2] -= 0.1
    plain, apart = (Lines.of(stack, np.zeros(1), shade=shade) for shade in (0.0, 1.5))
    left = [differences(lines, np.zeros(1), limit=np.inf)[0, 8:-8, 8:-8].min() for lines in (plain, apart)]
    assert left[1] < 1e-4 * left[0]
