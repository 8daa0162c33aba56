"""The depth benchmark: in its scenes points are where disparity says, and nearer things hide others; halos; .pfm."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from tests.benchmarks import program

scenes, depth = program("depth_scenes"), program("depth")
SIDE = 48


def textures() -> np.ndarray:
    """One texture, cyclic and coarse enough to be compared between views."""
    y, x = np.meshgrid(*(2 * np.pi * np.arange(scenes.TEXTURE_SIDE) / 32,) * 2, indexing="ij")
    return (np.sin(x) + np.sin(y))[None].astype(np.float32)


def rendered(*surfaces: object, count: int = 3):  # type: ignore[no-untyped-def]  # a class of a program's
    return scenes.render(scenes.Scene("one", surfaces, textures()), SIDE, count)


def test_a_view_sees_a_surface_moved_by_its_disparity() -> None:
    made = rendered(scenes.Surface(3.0))
    assert (made.disparity == 3.0).all()
    middle, right, lower = made.views[1, 1], made.views[1, 2], made.views[2, 1]
    np.testing.assert_allclose(right[:, 3:], middle[:, :-3], atol=0.01)
    np.testing.assert_allclose(lower[3:], middle[:-3], atol=0.01)
    assert np.abs(right - middle).max() > 0.05


@pytest.mark.parametrize("order", [1, -1])
def test_the_nearer_surface_hides_the_other_in_whatever_order_they_are_drawn(order: int) -> None:
    near = scenes.Surface(1.0, half=(200.0, 10.0), contrast=0.0, mean=0.7)
    far = scenes.Surface(-1.0, contrast=0.0, mean=0.2)
    made = rendered(*(near, far)[::order])
    assert set(np.unique(made.disparity)) == {-1.0, 1.0}
    bright = [int((view[SIDE // 2] > 0.45).argmax()) for view in made.views[1]]
    assert bright == [13, 14, 15]


def test_a_halo_is_as_wide_as_what_is_wrong_beside_an_edge() -> None:
    truth = np.where(np.arange(40) < 20, 0.0, 2.0) * np.ones((10, 1))
    made = truth.copy()
    assert depth.halo_px(made, truth) == 0
    made[:, 14:20] = 2.0
    assert depth.halo_px(made, truth) == 3.0  # 6 on one side, none on the other
    made[:, 20:24] = np.nan
    assert depth.halo_px(made, truth) == 5.0


def test_a_pfm_is_read_with_its_first_row_on_top(tmp_path: Path) -> None:
    rows = np.array([[1.0, 2.0, 3.0], [4.0, 5.0, 6.0]], dtype="<f4")
    (tmp_path / "gt_disp_lowres.pfm").write_bytes(b"Pf\n3 2\n-1.0\n" + rows[::-1].tobytes())
    np.testing.assert_array_equal(depth.read_pfm(tmp_path / "gt_disp_lowres.pfm"), rows)


def test_a_bare_half_has_no_detail_in_any_view() -> None:
    made = scenes.render(scenes.half_bare(1, SIDE), SIDE, 3)
    assert np.ptp(made.views[..., SIDE // 2 + 4 :]) < 1e-6
    assert np.ptp(made.views[..., : SIDE // 2 - 4]) > 0.1
