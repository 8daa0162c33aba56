"""What neighbours tell of each other's errors, on planes and at jumps, and what the odds of other disparities tell."""

from __future__ import annotations

import numpy as np
import pytest

from dappled.decode.depth.scatter import scattered, undecided

ROWS, COLUMNS = np.mgrid[:80, :90].astype(np.float32)
PLANE = 0.4 + 0.01 * ROWS - 0.02 * COLUMNS


def told(disparity: np.ndarray, most: float = 1.0) -> np.ndarray:
    return scattered(disparity.astype(np.float32), apart=3, most=most, reach=2.0)


def test_a_plane_does_not_scatter_however_it_is_tilted() -> None:
    assert told(PLANE)[8:-8, 8:-8].max() < 1e-5


@pytest.mark.parametrize("sigma", [0.01, 0.04])
def test_independent_errors_are_told_as_they_are(sigma: float) -> None:
    errors = np.random.default_rng(6).normal(size=PLANE.shape) * sigma
    assert np.sqrt(np.mean(told(PLANE + errors)[8:-8, 8:-8] ** 2)) == pytest.approx(sigma, rel=0.05)


def test_a_jump_counts_up_to_a_limit_and_only_nearby() -> None:
    made = told(PLANE + np.where(COLUMNS < 45, 0, 2), most=0.03)
    assert 0.01 < made[40, 44] <= 0.03
    assert made[8:-8, 8:30].max() < 1e-4


def test_what_is_unknown_tells_nothing_of_its_neighbours() -> None:
    holed = PLANE.copy()
    holed[30:50, 30:60] = np.nan
    made = told(holed)
    assert np.isnan(made[40, 45])
    assert made[8:28, 8:-8].max() < 1e-4
    assert np.isnan(told(np.full_like(PLANE, np.nan))).all()


LEVELS = np.linspace(-2, 2, 81)
STEP = 0.05


def likelihood(*peaks: tuple[float, float, float]) -> np.ndarray:
    """(D, 1, 1): the logarithm of a mixture of normal distributions, each (weight, mean, standard deviation)."""
    odds = sum(share / sd * np.exp(-0.5 * ((LEVELS - mean) / sd) ** 2) for share, mean, sd in peaks)
    return np.log(np.maximum(odds, 1e-30)).astype(np.float32)[:, None, None]


def of_odds(volume: np.ndarray, found: float, unit: float = 1.0) -> float:
    return float(undecided(volume, LEVELS, np.full((1, 1), found, np.float32), unit=unit)[0, 0])


def test_a_narrow_peak_is_decided_wherever_it_lies() -> None:
    for mean in (0.3, 0.31, 0.325):
        assert of_odds(likelihood((1, mean, 0.02)), mean) == 0


@pytest.mark.parametrize("unit", [1.0, 4.0])
def test_a_wide_peak_is_as_wide_as_its_odds(unit: float) -> None:
    wide = 0.2 * np.sqrt(unit)
    assert of_odds(likelihood((1, 0.3, 0.2)), 0.3, unit) == pytest.approx(np.sqrt(wide**2 - STEP**2), rel=0.01)


def test_the_other_side_of_a_jump_counts_by_its_odds_and_distance() -> None:
    two = likelihood((0.9, 0.0, 0.06), (0.1, 1.5, 0.06))
    for found, other in ((0.0, 0.1), (1.5, 0.9)):
        expected = np.sqrt(0.06**2 + other * 1.5**2 - STEP**2)
        assert of_odds(two, found) == pytest.approx(expected, rel=0.01)


def test_odds_tell_nothing_of_an_unknown_disparity() -> None:
    assert np.isnan(of_odds(likelihood((1, 0.3, 0.2)), np.nan))
