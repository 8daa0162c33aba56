"""What a window that sees two surfaces adds to the error: nothing on planes, much at seams."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from dappled.decode.depth.depth_map import judged, seams

WINDOW = 13
SHAPE = (60, 80)
ROWS, COLUMNS = np.mgrid[: SHAPE[0], : SHAPE[1]].astype(np.float32)
NOTHING = np.zeros(SHAPE, dtype=np.float32)
INNER = (slice(12, -12), slice(12, -12))


@given(st.floats(-3, 3), st.floats(-0.02, 0.02), st.floats(-0.02, 0.02))
def test_a_plane_has_no_seams_however_it_leans(level: float, down: float, aside: float) -> None:
    plane = np.float32(level) + np.float32(down) * ROWS + np.float32(aside) * COLUMNS
    assert seams(plane, NOTHING, WINDOW)[INNER].max() < 1e-3


def test_noise_that_is_known_is_no_seam() -> None:
    rng = np.random.default_rng(1)
    noisy = (0.5 + 0.01 * rng.standard_normal(SHAPE)).astype(np.float32)
    assert np.median(seams(noisy, np.full_like(noisy, 1e-4), WINDOW)) < 0.003
    assert np.median(seams(noisy, NOTHING, WINDOW)) > 0.008


@pytest.mark.parametrize("jump", [0.05, 0.4])
@pytest.mark.parametrize("holes", [False, True])
def test_a_step_is_a_seam_as_far_as_the_window_reaches(jump: float, holes: bool) -> None:
    step = np.where(COLUMNS < 40, 0.1, 0.1 + jump).astype(np.float32)
    if holes:
        step[::7, ::5] = np.nan
    found = seams(step, NOTHING, WINDOW)
    assert found[30, 38:42] == pytest.approx(0.3 * jump, rel=0.15)
    assert found[30, 34] < found[30, 36] < found[30, 39]
    assert found[:, :28].max() < 0.01 * jump
    assert found[:, 52:].max() < 0.01 * jump


def test_a_small_window_has_small_seams() -> None:
    step = np.where(COLUMNS < 40, 0.0, 0.3).astype(np.float32)
    reach = [int((seams(step, NOTHING, window)[30] > 0.01).sum()) for window in (5, 9, 13, 21)]
    assert reach == sorted(set(reach))
    assert seams(step, NOTHING, 3).max() == 0  # of one pixel


def test_what_lies_at_a_seam_is_known_all_the_same() -> None:
    step = np.where(COLUMNS < 40, 0.0, 2.0).astype(np.float32)
    curvature = np.full(SHAPE, 1e4, dtype=np.float32)
    curvature[:, :5] = 0  # no texture
    made = judged(step, curvature, np.ones(SHAPE, dtype=np.float32), spread=1.0, window=WINDOW, method="contrast")
    assert made.known[:, 5:].all()
    assert not made.known[:, :5].any()
    assert made.sigma[30, 40] > 0.5
    assert made.sigma[30, 20] < 0.02
