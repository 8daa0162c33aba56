"""What clipped pixels would hold; standard errors of views near them: unknown, and elsewhere as they were."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from dappled.decode.lightfield import LightField
from dappled.decode.lightfield.clipping import clipped_shares, unknown_where_clipped
from tests.decode.lightfield.ray_sums import FOCAL_MM, MASK, RaySum, on_slices, psnr

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


@pytest.mark.parametrize("seed", [0, 1])
def test_what_clipped_between_the_masks_dark_places_is_told_by_the_pixels_around(seed: int) -> None:
    """Half the ideal aperture, one pixel in a hundred at white. Views are nearly those of a sensor without a white."""
    band = 0.4 * MASK.frequency_per_mm * 0.01
    scene = RaySum(finest=band, snr=100, kappa=0.5, seed=seed, apart=True)
    plane, true = scene.expose()
    white = np.quantile(plane, 0.99)
    clipped = (plane >= white).astype(np.float32)
    decoder = scene.decoder(joint_views=True)
    whole, lost, told = (
        each.decode(seen, focal_length_mm=FOCAL_MM, f_number=scene.f_number)
        for each, seen in (
            (decoder, plane),
            (decoder, np.minimum(plane, white)),
            (replace(decoder, clipped=clipped), np.minimum(plane, white)),
        )
    )
    truth = on_slices(true, whole.grid, whole.slices.shape[1:])
    best, without, made = (psnr(field.views, truth) for field in (whole, lost, told))
    assert made > without + 4, (best, without, made)
    assert made > best - 2, (best, without, made)
    np.testing.assert_array_equal(told.slices, lost.slices)  # they are the file's


def test_a_highlight_that_clipped_as_a_whole_is_not_made_up() -> None:
    """At the ideal aperture the mask lets the same light through to all pixels of an even scene."""
    scene = RaySum(boards=(0.0,), exponent=2.0, finest=0.02, kappa=1.0, points=3)
    plane, _ = scene.expose()
    white = np.quantile(plane, 0.97)
    cut = np.minimum(plane, white)
    decoder = scene.decoder(joint_views=True)
    clipped = (plane >= white).astype(np.float32)
    plain = decoder.decode(cut, focal_length_mm=FOCAL_MM, f_number=scene.f_number)
    told = replace(decoder, clipped=clipped).decode(cut, focal_length_mm=FOCAL_MM, f_number=scene.f_number)
    highlight = on_slices(clipped, told.grid, told.slices.shape[1:]) > 0.9
    assert highlight.any()
    assert np.abs(told.views - plain.views)[:, :, highlight].max() < 0.02 * white
