"""Jumps of disparity move to the picture's edges, and only what looks alike fills what is unknown."""

from __future__ import annotations

import numpy as np

from dappled.decode.depth.edges import levelled, sharpened

SHAPE = (24, 40)
COLUMNS = np.mgrid[: SHAPE[0], : SHAPE[1]][1]
PICTURE = np.where(COLUMNS < 20, 0.2, 0.6).astype(np.float32)
TRUE = np.where(COLUMNS < 20, 1.0, 0.0).astype(np.float32)
SIGMA = np.full(SHAPE, 0.01, dtype=np.float32)


def test_a_jump_moves_to_the_edge_of_the_picture() -> None:
    enlarged = np.where(COLUMNS < 22, 1.0, 0.0).astype(np.float32)
    made, sigma = sharpened(enlarged, SIGMA, PICTURE)
    np.testing.assert_array_equal(made, TRUE)
    assert sigma[:, 5].max() < 0.011


def test_at_a_jump_without_an_edge_in_the_picture_sigma_tells_of_both_sides() -> None:
    _, sigma = sharpened(TRUE, SIGMA, np.full(SHAPE, 0.4, dtype=np.float32))
    assert sigma[12, 19] > 0.3
    assert sigma[12, 5] < 0.011


def test_small_holes_close_and_large_ones_stay_unknown() -> None:
    holed, error = TRUE.copy(), SIGMA.copy()
    for hole in ((slice(5, 6), slice(10, 12)), (slice(8, 22), slice(24, 38))):
        holed[hole] = error[hole] = np.nan
    made, sigma = sharpened(holed, error, PICTURE)
    assert made[5, 10] == made[5, 11] == 1.0
    assert np.isnan(made[11:19, 27:35]).all()
    np.testing.assert_array_equal(np.isnan(made), np.isnan(sigma))


def test_nothing_known_stays_so() -> None:
    nothing = np.full(SHAPE, np.nan, dtype=np.float32)
    assert np.isnan(sharpened(nothing, nothing, PICTURE)[0]).all()


def test_steps_between_disparities_go_and_jumps_stay() -> None:
    slope = (COLUMNS * 0.01).astype(np.float32)
    stepped = (np.round(slope / 0.1) * 0.1).astype(np.float32)
    stepped[:, 20:] += 1.0
    stepped[3:5, 8] = np.nan
    made = levelled(stepped)
    true = slope + np.where(COLUMNS < 20, 0, 1)
    assert np.nanmax(np.abs(made - true)[:, 7:14]) < 0.02
    assert np.nanmax(np.abs(made - true)) < 0.06
    np.testing.assert_array_equal(np.isnan(made), np.isnan(stepped))
