from __future__ import annotations

import sys

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from dappled.decode.depth import estimate, evidence, stereo
from dappled.decode.depth.depth_map import DepthMap, Search, peaked, windowed
from dappled.decode.errors import DecodeError
from dappled.decode.lightfield.light_field import ViewStack, centred
from tests.decode.scenes import Board, boards, paint

METHODS = ["contrast", "stereo", "combined"]


def bad_share(found: DepthMap, truth: np.ndarray, limit: float = 0.07, border: int = 15) -> float:
    """BadPix: the share of pixels off by more than `limit` or unknown, `border` px left out (HCI's measure)."""
    cut = (slice(border, -border),) * 2
    error = np.abs(found.disparity - truth)[cut]
    return float(1 - np.mean(error <= limit))


def noisy(stack: ViewStack, rms: float) -> ViewStack:
    noise = np.random.default_rng(4).normal(size=stack.views.shape).astype(np.float32)
    return ViewStack(stack.views + np.float32(rms) * noise, stack.row_steps, stack.column_steps)


@pytest.fixture(scope="module")
def leaning() -> tuple[ViewStack, np.ndarray]:
    """5 × 5 views of one leaning board, disparities −0.3 to 0.5."""
    return paint([Board(0.1, slope=(0.004, 0.003))], (120, 120), 5)


@pytest.mark.parametrize(("method", "most"), [("contrast", 0.01), ("stereo", 0.1), ("combined", 0.01)])
def test_every_method_finds_a_leaning_board(leaning: tuple[ViewStack, np.ndarray], method: str, most: float) -> None:
    if method == "stereo":
        pytest.importorskip("cv2", reason="stereo needs OpenCV, an extra")
    stack, truth = leaning
    found = estimate.estimate(evidence.of_views(stack), method)
    assert found.method == method
    assert found.known_share() > 0.9
    assert bad_share(found, truth) < most
    sigma = np.nanmedian(found.sigma)
    assert 0 < sigma < 0.07


@pytest.mark.parametrize("method", ["contrast", "combined"])
def test_the_same_map_for_any_number_of_workers(leaning: tuple[ViewStack, np.ndarray], method: str) -> None:
    stack, _ = leaning
    told = evidence.of_views(stack)
    one, two = (estimate.estimate(told, method, between=(-0.5, 0.7), workers=w) for w in (1, 2))
    np.testing.assert_array_equal(one.disparity, two.disparity)


@pytest.mark.slow
def test_nine_by_nine_views_with_occlusions_and_three_pixels_a_view() -> None:
    """BadPix 0.07 below 15 % on clean views; the scene shows 12 boards before each other."""
    stack, truth = paint(boards(1, 256, 3.0), (256, 256), 9, seed=1)
    found = estimate.estimate(evidence.of_views(stack), workers=2)
    share = bad_share(found, truth)
    line = f"BadPix 0.07 on 9 × 9 clean views, ±3 px/view: {share:.1%}, {found.known_share():.0%} known"
    print(line)  # noqa: T201  a figure for people who run with -s
    assert truth.min() < -2
    assert truth.max() > 2
    assert share < 0.15


@pytest.mark.parametrize("method", ["contrast", "stereo", "combined"])
def test_the_window_counts_for_every_method(leaning: tuple[ViewStack, np.ndarray], method: str) -> None:
    if method == "stereo":
        pytest.importorskip("cv2", reason="stereo needs OpenCV, an extra")
    stack, _ = leaning
    part = ViewStack(np.ascontiguousarray(stack.views[:, :, :60, :80]), stack.row_steps, stack.column_steps)
    told = evidence.of_views(part)
    narrow, wide = (estimate.estimate(told, method, between=(-0.5, 0.7), window=w) for w in (7, 15))
    assert not np.array_equal(narrow.disparity, wide.disparity, equal_nan=True)


def test_noise_makes_it_less_sure_not_wrong() -> None:
    stack, truth = paint(boards(2, 160, 1.0, 4), (160, 160), 5)
    told = [evidence.of_views(noisy(stack, rms)) for rms in (0.01, 0.04)]
    maps = [estimate.estimate(e, "contrast", between=(-1.2, 1.2)) for e in told]
    assert np.nanmedian(maps[1].sigma) > np.nanmedian(maps[0].sigma)
    assert bad_share(maps[0], truth) < 0.12
    for found in maps:
        known = found.known[15:-15, 15:-15]
        error = np.abs(found.disparity - truth)[15:-15, 15:-15][known]
        assert np.mean(error > 0.25) < 0.05


@pytest.mark.parametrize("rms", [0.04, 0.08])
def test_the_error_of_noisy_views_has_what_contrast_enlarges(rms: float) -> None:
    """Boards before each other: the part around a jump that is as near as what stands beside it is not left out."""
    stack, truth = paint(boards(2, 160, 1.5, 6), (160, 160), 5)
    found = estimate.estimate(evidence.of_views(noisy(stack, rms)))
    error = np.abs(found.disparity - truth)[found.known] / found.sigma[found.known]
    assert found.known_share() > 0.9
    assert np.mean(error < 1) > 0.57
    assert np.mean(error < 2) > 0.82
    assert np.mean(error < 3) > 0.93


def test_what_is_too_faint_for_one_window_is_told_by_several() -> None:
    """The right half has a fifth of the detail, not much more than noise: it is known, and right."""
    stack, truth = paint([Board(0.6)], (100, 100), 9)
    views, mean = stack.views.copy(), stack.views.mean()
    views[..., 50:] = mean + 0.2 * (views[..., 50:] - mean)
    faint = noisy(ViewStack(views, stack.row_steps, stack.column_steps), 0.01)
    found = estimate.estimate(evidence.of_views(faint), between=(-1, 1))
    part = (slice(10, -10), slice(60, -10))
    known = found.known[part]
    assert known.mean() > 0.7
    assert np.mean(np.abs(found.disparity - truth)[part][known] > 0.07) < 0.01


@pytest.mark.parametrize("method", METHODS)
def test_a_flat_scene_is_unknown_not_zero(method: str) -> None:
    if method == "stereo":
        pytest.importorskip("cv2", reason="stereo needs OpenCV, an extra")
    steps = centred(5)
    flat = ViewStack(np.full((5, 5, 60, 64), 0.4, dtype=np.float32), steps, steps)
    found = estimate.estimate(evidence.of_views(flat), method, between=(-1, 1))
    assert found.known_share() == 0
    assert np.isnan(found.disparity).all()
    assert np.isnan(found.sigma).all()


@pytest.mark.parametrize("method", ["contrast", "combined"])
def test_noise_alone_is_unknown(method: str) -> None:
    steps = centred(5)
    flat = ViewStack(np.full((5, 5, 80, 80), 0.4, dtype=np.float32), steps, steps)
    found = estimate.estimate(evidence.of_views(noisy(flat, 0.02)), method, between=(-1, 1))
    assert found.known_share() < 0.02


def test_half_a_flat_scene_is_unknown() -> None:
    stack, truth = paint([Board(0.3)], (80, 120), 5)
    stack.views[..., 60:] = 0.4
    found = estimate.estimate(evidence.of_views(stack), "contrast", between=(-1, 1))
    assert found.known[:, :45].mean() > 0.99
    assert found.known[:, 80:].mean() < 0.01
    assert np.nanmedian(np.abs(found.disparity - truth)[:, :45]) < 0.01


@pytest.mark.parametrize(("low", "high"), [(-0.2, 0.3), (1.0, 2.5), (-3.0, -2.0)])
def test_the_range_is_found(low: float, high: float) -> None:
    side = 160
    stack, truth = paint([Board((low + high) / 2, slope=(0.0, (high - low) / side))], (side, side), 5)
    found = estimate.disparity_range(evidence.of_views(stack))
    assert found[0] < truth.min() + 0.1
    assert found[1] > truth.max() - 0.1
    assert found[1] - found[0] < high - low + 2.5


@pytest.mark.parametrize("rms", [0.0, 0.02, 0.1])
def test_noise_leaves_the_range_as_it_is(rms: float) -> None:
    stack, truth = paint(boards(2, 160, 1.0, 4), (160, 160), 5)
    low, high = estimate.disparity_range(evidence.of_views(noisy(stack, rms)))
    assert low < truth.min()
    assert high > truth.max()
    assert high - low < np.ptp(truth) + 0.8


def fence(side: int) -> ViewStack:
    """9 × 9 views of upright bars, 4 of every 28 px wide, at a disparity of 1 before a fine, fainter ground at −1."""
    rng = np.random.default_rng(5)
    ground, bars = (rng.normal(size=(side, side)).astype(np.float32) for _ in range(2))
    covered = np.broadcast_to(np.arange(side) % 28 < 4, (side, side))
    steps = centred(9)
    views = np.empty((9, 9, side, side), dtype=np.float32)
    for v, sy in enumerate(steps.astype(int)):
        for u, sx in enumerate(steps.astype(int)):
            near, there = (np.roll(a, (sy, sx), axis=(0, 1)) for a in (bars, covered))
            behind = np.roll(ground, (-sy, -sx), axis=(0, 1))
            views[v, u] = np.where(there, 0.2 + 0.2 * near, 0.5 + 0.06 * behind)
    return ViewStack(views, steps, steps)


@pytest.mark.parametrize("rms", [0.0, 0.005])
def test_the_ground_between_strong_bars_counts(rms: float) -> None:
    """In pictures made smaller until contrast can be asked, the bars are all that is left."""
    low, high = estimate.disparity_range(evidence.of_views(noisy(fence(420), rms)))
    assert -1.8 < low < -1
    assert 1 < high < 1.8


def test_a_wall_without_detail_does_not_widen_the_range() -> None:
    """Contrast finds some disparity on it, far from all others."""
    stack, truth = paint([Board(0.3, slope=(0.002, 0.0))], (160, 160), 9)
    y = np.mgrid[:160, :160][0]
    stack.views[..., 90:] = (0.4 + 0.002 * y[:, 90:] / 160).astype(np.float32)
    low, high = estimate.disparity_range(evidence.of_views(stack))
    assert low < truth.min()
    assert high > truth.max()
    assert high - low < np.ptp(truth) + 1.2


@given(st.floats(-0.9, 0.9), st.floats(0.05, 0.2))
def test_a_peak_is_read_off_between_samples(where: float, width: float) -> None:
    grid = np.linspace(-1.5, 1.5, 61)
    likelihood = np.exp(-(((grid - where) / (4 * width)) ** 2)).astype(np.float32)[:, None, None]
    found, curvature = peaked(likelihood, grid, likelihood.argmax(axis=0))
    assert found[0, 0] == pytest.approx(where, abs=0.004)
    assert curvature[0, 0] == pytest.approx(2 / (4 * width) ** 2, rel=0.1)


def test_windows_sum_and_tell_their_variance() -> None:
    rng = np.random.default_rng(3)
    noise = rng.normal(size=(1, 400, 400)).astype(np.float32)
    made, spread = windowed(noise, 13)
    weight = windowed(np.ones((1, 40, 40), np.float32), 13)[0][0, 20, 20]
    # The variance of the weighted mean is `spread` times one sample's over the sum of weights.
    assert np.var(made[0, 20:-20, 20:-20] / weight) == pytest.approx(spread / weight, rel=0.15)


def test_the_picture_of_each_view_has_moved_by_its_step() -> None:
    pytest.importorskip("cv2", reason="OpenCV is an extra")
    stack, _ = paint([Board(1.0)], (96, 96), 3)
    moved = stereo.shifts_from_middle(stack)
    assert np.all(moved[1, 1] == 0)
    for (v, u), length in (((1, 2), 1.0), ((2, 1), 1.0), ((0, 0), 2**0.5)):
        assert np.median(moved[v, u]) == pytest.approx(length, abs=0.1)


@pytest.mark.parametrize(
    ("act", "words"),
    [
        (lambda e: estimate.estimate(e, "guess"), "unknown depth method 'guess'"),
        (lambda e: estimate.estimate(e, "gradient"), "gradient was removed: choose combined"),
        (lambda e: estimate.estimate(e, between=(1, 1)), "are not a range"),
        (lambda e: estimate.estimate(e, between=(0, float("nan"))), "are not a range"),
        (lambda e: estimate.estimate(e, window=4, between=(0, 1)), "a window of 4 px"),
        (lambda e: Search(0, 1, 1e-4), "too many"),
        (lambda e: estimate.estimate(e, "stereo", between=(-40, 40)), "narrow the range"),
    ],
)
def test_wrong_calls_are_told(act, words: str) -> None:  # type: ignore[no-untyped-def]  # several signatures
    steps = centred(3)
    told = evidence.of_views(ViewStack(np.random.default_rng(0).random((3, 3, 32, 32), np.float32), steps, steps))
    with pytest.raises(DecodeError, match=words):
        act(told)


@pytest.mark.parametrize("grid", [(1, 2), (2, 2), (4, 4), (2, 5)])
@pytest.mark.parametrize("between", [(0.0, 8.0), (-10.0, 0.0)])
def test_an_even_number_of_views_is_looked_at_over_any_range(
    grid: tuple[int, int], between: tuple[float, float]
) -> None:
    stack, _ = paint([Board(0.4)], (40, 44), 5)
    rows, columns = (centred(n) for n in grid)
    views = ViewStack(stack.views[: grid[0], : grid[1]], rows, columns)
    assert estimate.estimate(evidence.of_views(views), between=between).disparity.shape == (40, 44)


@pytest.mark.filterwarnings("error")
def test_views_of_a_few_pixels_have_a_map() -> None:
    views = np.random.default_rng(2).normal(0.4, 0.1, (5, 5, 2, 2)).astype(np.float32)
    stack = ViewStack(views, centred(5), centred(5))
    assert estimate.estimate(evidence.of_views(stack), between=(-1.0, 1.0)).disparity.shape == (2, 2)


def test_one_view_and_views_that_are_no_numbers_are_told() -> None:
    with pytest.raises(DecodeError, match="depth needs views from several places"):
        evidence.of_views(ViewStack(np.ones((1, 1, 9, 9), np.float32), np.zeros(1), np.zeros(1)))
    with pytest.raises(DecodeError, match="not numbers"):
        evidence.of_views(ViewStack(np.full((3, 3, 9, 9), np.nan, np.float32), centred(3), centred(3)))


def test_without_opencv_the_extra_is_named(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "cv2", None)
    with pytest.raises(DecodeError, match=r"pip install 'dappled\[ground\]'"):
        stereo.opencv()
