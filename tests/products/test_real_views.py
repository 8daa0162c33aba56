"""A real Lytro photograph: what depth calls near and far comes into focus there."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from scipy import ndimage

import dappled
from dappled.products import opened


@pytest.mark.slow
def test_near_and_far_come_into_focus_where_depth_says(shared_data: Path) -> None:
    field = opened.light_field(shared_data / "views" / "lytro_2067")
    assert field.views.shape == (5, 5, 383, 552, 3)
    depth = field.depth()
    assert depth.known_share() > 0.6
    low, high = (float(x) for x in np.nanquantile(depth.disparity, [0.1, 0.9]))
    assert high - low > 0.5

    def sharpness(disparity: float) -> np.ndarray:
        picture = np.log(np.nan_to_num(field.refocus(disparity=disparity).mean(axis=2)) + 0.02)
        energy: np.ndarray = ndimage.gaussian_filter(ndimage.laplace(picture) ** 2, 2)
        return energy

    far_sharp, near_sharp = sharpness(low), sharpness(high)
    inner = np.zeros(depth.disparity.shape, dtype=bool)
    inner[40:-40, 60:-60] = True
    near = inner & (np.abs(depth.disparity - high) < 0.1)
    far = inner & (np.abs(depth.disparity - low) < 0.05)
    assert near.sum() > 1000
    assert far.sum() > 1000
    assert np.mean(near_sharp[near] > far_sharp[near]) > 0.9
    assert np.mean(far_sharp[far] > near_sharp[far]) > 0.9


def test_the_head_is_nearer_than_the_fence(shared_data: Path) -> None:
    depth = opened.light_field(shared_data / "views" / "lytro_2067").depth("contrast")
    head, fence = depth.disparity[190:230, 60:140], depth.disparity[60:120, 60:180]
    assert np.nanmedian(head) > np.nanmedian(fence) + 0.8


@pytest.mark.long
def test_under_lenslets_nearer_is_larger_too(shared_data: Path) -> None:
    """A lenslet turns the aperture's picture round; the bust of this made raw stands before its wall all the same."""
    folder = shared_data / "lenslet" / "lytro_like"
    frame = dappled.open(
        folder / "raw.png", mask="lenslet", white=str(folder / "white.png"), cfa="BGGR", black=168, white_level=4095
    )
    assert isinstance(frame, opened.OpenedFrame)
    depth = frame.depth("contrast")
    assert frame.views.shape[:2] == (9, 9)
    head, wall = depth.disparity[60:120, 180:280], depth.disparity[100:200, 350:430]
    assert np.nanmedian(head) > 0.5
    assert np.nanmedian(wall) < -0.5
