"""Changes between flights: σ of a change, and trends over several flights, against what was put in."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from dappled.products.maps import difference
from dappled.products.maps.difference import DifferenceError, MapDifference
from dappled.products.maps.ground import Flat
from dappled.products.maps.hyperstereo import Surface
from dappled.products.maps.map_grid import MapGrid
from dappled.products.maps.terrain import TerrainModel
from tests.products.maps.test_eye import eye_at
from tests.products.maps.test_map_grid import painted, photograph, survey

DAY_NS = 86_400_000_000_000
GRID = MapGrid("EPSG:32615", 600_000.0, 4_600_000.0, 0.5, 0.5, (40, 60))


def change(value: float, sigma: float, grid: MapGrid = GRID, noise: int | None = None) -> MapDifference:
    values = np.full(grid.shape, value)
    if noise is not None:
        values += np.random.default_rng(noise).normal(0, sigma, grid.shape)
    return MapDifference(grid, values.astype(np.float32), np.full(grid.shape, sigma, np.float32), 1.0)


def test_a_straight_change_over_four_flights() -> None:
    made = difference.over_time(
        [0, 2 * DAY_NS, 5 * DAY_NS, 9 * DAY_NS], [change(0.2, 0.1), change(0.5, 0.1), change(0.9, 0.1)]
    )
    assert made.rate == pytest.approx(np.full(GRID.shape, 0.1), abs=1e-6)
    # σ of each flight 0.1/√2 about the days' mean of 4: Σ(t − 4)² = 16 + 4 + 1 + 25
    assert made.rate_sigma == pytest.approx(np.full(GRID.shape, 0.1 / np.sqrt(2) / np.sqrt(46)), rel=1e-5)
    assert made.step == pytest.approx(np.full(GRID.shape, 0.4), abs=1e-6)
    assert made.step_sigma == pytest.approx(np.full(GRID.shape, 0.1), rel=1e-5)
    assert (made.flights == 4).all()


def test_flights_count_in_the_order_of_time() -> None:
    made = difference.over_time([5 * DAY_NS, 9 * DAY_NS, 0], [change(0.4, 0.1), change(-0.5, 0.1)])
    assert made.rate == pytest.approx(np.full(GRID.shape, 0.1), abs=1e-6)
    assert made.step == pytest.approx(np.full(GRID.shape, 0.5), abs=1e-6)


def test_sigma_of_a_trend_holds_and_grows_where_no_line_fits() -> None:
    days = [0, DAY_NS, 2 * DAY_NS, 3 * DAY_NS]
    first = np.random.default_rng(9).normal(0, 0.1, GRID.shape)
    noisy = [
        replace(one, values=(one.values - first).astype(np.float32), sigma=one.sigma * np.float32(np.sqrt(2)))
        for one in (change(0.0, 0.1, noise=k) for k in range(3))
    ]
    made = difference.over_time(days, noisy)
    assert 0.5 < np.mean(np.abs(made.rate) < made.rate_sigma) < 0.85
    bumpy = difference.over_time(days, [change(1.0, 0.1), change(0.0, 0.1), change(1.0, 0.1)])
    plain = difference.over_time(days, [change(0.0, 0.1), change(0.0, 0.1), change(0.0, 0.1)])
    assert np.median(bumpy.rate_sigma) > 5 * np.median(plain.rate_sigma)
    assert np.median(np.abs(bumpy.step)) == pytest.approx(1.0)


def test_what_fewer_than_three_flights_know_is_unknown() -> None:
    gone = change(0.3, 0.1)
    gone.values[:10], gone.sigma[:10] = np.nan, np.nan
    made = difference.over_time([0, DAY_NS, 2 * DAY_NS], [gone, change(0.3, 0.1)])
    for band in (made.rate, made.rate_sigma, made.step, made.step_sigma, made.flights):
        assert np.isnan(band[:10]).all()
        assert np.isfinite(band[10:]).all()


def test_grids_are_cut_to_common_ground_or_refused() -> None:
    aside = replace(GRID, west=GRID.west + 5.0, north=GRID.north - 2.0)
    placed = change(0.4, 0.1, aside)
    placed.values[0, 0] = 7.0
    made = difference.over_time([0, DAY_NS, 2 * DAY_NS], [change(0.2, 0.1), placed])
    assert made.grid == MapGrid(GRID.crs, aside.west, aside.north, 0.5, 0.5, (36, 50))
    assert made.rate[0, 0] > 2
    assert made.rate[1:, 1:] == pytest.approx(np.full((35, 49), 0.2), abs=1e-6)
    for wrong, why in ((replace(GRID, west=GRID.west + 99), "no ground in common"),
                       (replace(GRID, step_x=0.6, step_y=0.6), "give one --gsd")):  # fmt: skip
        with pytest.raises(DifferenceError, match=why):
            difference.over_time([0, DAY_NS, 2 * DAY_NS], [change(0.2, 0.1), change(0.2, 0.1, wrong)])
    with pytest.raises(DifferenceError, match="flown at the same time"):
        difference.over_time([5, 5, 5], [change(0.2, 0.1), change(0.2, 0.1)])


def test_the_change_of_a_height_has_the_sigmas_of_both() -> None:
    def model(height: float, sigma: float, level: float) -> TerrainModel:
        heights, sigmas, scores = (np.full(GRID.shape, value, np.float32) for value in (height, sigma, 1.0))
        return TerrainModel(Surface(GRID, heights, sigmas, scores, level), None)

    made = difference.of_heights(model(200.0, 0.3, 0.6), model(201.0, 0.4, 0.8))
    assert made.values == pytest.approx(np.full(GRID.shape, 1.0))
    assert made.sigma == pytest.approx(np.full(GRID.shape, 0.5))
    assert made.level_sigma == pytest.approx(1.0)


def test_poses_make_the_change_of_brightness_unsure_at_edges() -> None:
    """Two flights over the same ground, the second placed 6 cm wrong: what that makes lies within σ."""
    eye = eye_at(height_m=60.0)
    first = survey(photograph(eye, painted(eye, Flat(0.0))), gsd_m=0.06)
    wrong = photograph(eye.moved(np.array([0.06, 0, 0, 0, 0, 0])), painted(eye, Flat(0.0)))
    second = survey(wrong, gsd_m=0.06)
    made = difference.of_pictures(first, second)
    known = np.isfinite(made.values)
    assert np.array_equal(known, np.isfinite(made.sigma))
    assert np.mean(np.abs(made.values[known]) < 2 * made.sigma[known]) > 0.5
    flat, steep = (np.quantile(made.sigma[known], share) for share in (0.02, 0.98))
    assert steep > 2 * flat
    sure = [replace(one, photographs=tuple(
        replace(photo, position_sigma_m=1e-4, attitude_sigma_rad=0.0) for photo in one.photographs
    )) for one in (first, second)]  # fmt: skip
    assert np.nanmedian(difference.of_pictures(*sure).sigma) < 0.8 * np.median(made.sigma[known])
