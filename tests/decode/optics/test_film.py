"""Film: sizes, step wedges, density curves."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from dappled.decode.errors import DecodeError
from dappled.decode.optics.film import FILMS, density_curve, film_of, wedge


def test_a_mask_wider_than_the_film_is_refused_with_both_sizes() -> None:
    assert FILMS["4k"].cut_to(12, 18).shape == (1366, 2048)
    with pytest.raises(DecodeError, match="40 mm wide does not fit film 4k: it has 36 mm"):
        FILMS["4k"].cut_to(20, 40)
    with pytest.raises(DecodeError, match="film density = -5"):
        film_of(10, 10, -5)


@given(gamma=st.floats(0.4, 3), top=st.floats(0.5, 3), falling=st.booleans(), wanted=st.floats(0, 1))
def test_a_curve_is_inverted(gamma: float, top: float, falling: bool, wanted: float) -> None:
    levels = np.linspace(0, 255, 33)
    share = (levels / 255) ** gamma
    curve = density_curve(list(levels), list(top * (share if falling else 1 - share)))
    low, high = curve.range
    made = curve.develop(curve.level(np.array([wanted])))
    assert (made[0] - low) / (high - low) == pytest.approx(wanted, abs=1e-9)


@pytest.mark.parametrize(
    ("levels", "densities", "said"),
    [
        ([0, 255], [0, 2], "3 steps or more"),
        ([0, 100, 255], [0, 1.5, 1.0], "turns back by 0.50 at level 255"),
        ([0, 100, 255], [1, 1, 1.01], "density only changes by 0.01"),
        ([0, 100, 300], [0, 1, 2], "level = 300"),
        ([0, 100, 255], [0, 1, float("nan")], "density = nan"),
        ([90, 100, 255], [0, 1, 2], "measure it from 0 to 255"),
        ([0, 0, 255], [0, 1, 2], "stands in it twice"),
    ],
)
def test_a_bad_curve_is_answered(levels: list[float], densities: list[float], said: str) -> None:
    with pytest.raises(DecodeError, match=said):
        density_curve(levels, densities)


def test_a_wedge_has_all_its_steps() -> None:
    made = wedge((3, 2100), 21)
    assert made.shape == (3, 2100)
    centres = made[1, 50::100]
    np.testing.assert_allclose(centres, np.linspace(0, 1, 21))
    with pytest.raises(DecodeError, match="needs 84 columns"):
        wedge((3, 50), 21)
