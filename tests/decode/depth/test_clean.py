"""Clean views: how well they agree, by texture, and surfaces with a highlight that stands still."""

from __future__ import annotations

import numpy as np
import pytest

from dappled.decode.depth import clean, estimate, evidence
from dappled.decode.depth.photo_consistency import Lines
from dappled.decode.lightfield import ViewStack
from tests.decode.scenes import Board, paint

DISPARITIES = np.linspace(-0.6, 1.0, 17)


@pytest.fixture(scope="module")
def board() -> ViewStack:
    stack, _ = paint([Board(0.4, slope=(0.001, 0.001))], (96, 128), 5)
    return stack


def told(stack: ViewStack) -> clean.Agreement:
    return clean.agreement(stack, Lines.of(stack, DISPARITIES), DISPARITIES)


def test_noise_is_found_where_it_is_larger_than_what_interpolation_gets_wrong(board: ViewStack) -> None:
    noise = np.random.default_rng(2).normal(size=board.views.shape).astype(np.float32)
    variances = []
    for rms in (0.02, 0.04):
        found = told(ViewStack(board.views + rms * noise, board.row_steps, board.column_steps))
        assert found.local.min() > 0
        variances.append(found.typical)
    assert variances[1] == pytest.approx(4 * variances[0], rel=0.25)


def test_views_agree_better_where_there_is_less_texture(board: ViewStack) -> None:
    views = board.views.copy()
    views[..., 64:] = 0.4 + 0.1 * (views[..., 64:] - 0.4)
    found = told(ViewStack(views, board.row_steps, board.column_steps))
    assert np.median(found.local[:, 75:]) < 0.7 * np.median(found.local[:, :50])


def test_a_highlight_that_stands_still_moves_no_surface() -> None:
    stack, truth = paint([Board(0.8)], (96, 96), 5)
    y, x = np.mgrid[:96, :96] - 48.0
    stack.views[...] += (0.6 * np.exp(-(y**2 + x**2) / 60)).astype(np.float32)
    found = estimate.estimate(evidence.of_views(stack), between=(-0.4, 1.2))
    inner = np.abs(found.disparity - truth)[36:60, 36:60]
    assert np.mean(inner <= 0.07) > 0.95
