"""Thin lens and geometry: Eq 2 to 5, Tables 2 and 10."""

from __future__ import annotations

import math
from collections.abc import Callable

import pytest
from hypothesis import assume, given
from hypothesis import strategies as st

from dappled.decode.errors import DecodeError
from dappled.decode.optics import lenses
from dappled.decode.optics.film import FILMS
from tests.decode.optics.equations import conjugate_distance_mm, object_distance
from tests.decode.thesis_tables import TABLE_2


@pytest.mark.parametrize(("name", "pixels", "lengths", "rates"), TABLE_2)
def test_table_2(name: str, pixels: tuple[int, int], lengths: tuple[float, float], rates: tuple[float, float]) -> None:
    for count, length, rate in zip(pixels, lengths, rates, strict=True):
        assert lenses.Sampling(count, length).px_per_mm == pytest.approx(rate, abs=0.1)
    if name != "sensor":
        assert FILMS[name].shape == pixels[::-1]
        assert FILMS[name].px_per_mm == pytest.approx(rates[::-1], abs=0.1)


def test_table_10() -> None:
    assert round(lenses.Sampling(3688, 5.76).px_per_mm) == 640
    assert round(lenses.Sampling(2776, 4.29).px_per_mm) == 647


@given(f=st.floats(1, 500), d=st.floats(0.6, 1e4))
def test_eq_3_and_its_symmetry(f: float, d: float) -> None:
    g = lenses.image_distance_mm(f, d)
    assert 1 / f == pytest.approx(1 / (d * 1e3) + 1 / g)
    assert lenses.image_distance_mm(f, math.inf) == f


@given(f=st.floats(2, 200), d=st.floats(1, 1000), v=st.floats(0.1, 20), focus=st.floats(1, 1000))
def test_eq_5_finds_the_object_that_eq_3_and_similar_triangles_place(
    f: float, d: float, v: float, focus: float
) -> None:
    sensor = lenses.image_distance_mm(f, focus)
    g = lenses.image_distance_mm(f, d)
    h = v * (1 - sensor / g)  # the ray from v on the lens to the real image, cut at the sensor
    assert conjugate_distance_mm(sensor, h, v) == pytest.approx(g)
    assume(d * 1e3 / f < 1e5)  # beyond, h differs from v in its last digits only
    assert object_distance(f, sensor, h, v).distance_m == pytest.approx(d, rel=1e-6)


@given(d=st.floats(1, 50), sigma=st.floats(1e-7, 1e-5))
def test_eq_5_s_error_is_its_own_derivative(d: float, sigma: float) -> None:
    f, v = 33.0, 2.0
    h = v * (1 - f / lenses.image_distance_mm(f, d))
    there = object_distance(f, f, h, v, sigma)
    moved = object_distance(f, f, h - sigma, v)
    assert abs(moved.distance_m - there.distance_m) == pytest.approx(there.sigma_m, rel=0.05)


@pytest.mark.parametrize(("d", "sigma"), [(5, 0.06), (10, 0.24), (30, 2.2)])
def test_depth_limit_of_a_33_mm_lens(d: float, sigma: float) -> None:
    """33 mm at f/3.5, four steps over the aperture, 0.02 of a slice pixel of 6 × 1.56 µm."""
    found = lenses.depth_sigma_m(d, 33, 33 / 3.5 / 4, 0.02 * 6 * 1.56e-3)
    assert found == pytest.approx(sigma, rel=0.03)


def test_geometry_over_ground() -> None:
    assert lenses.ground_sample_m(0.01, 50, 100) == pytest.approx(0.02, rel=1e-3)


@pytest.mark.parametrize(
    ("call", "said"),
    [
        (lambda: lenses.image_distance_mm(0.033, 10), "focal length = 0.033 mm must lie between 0.5.*millimetres"),
        (lambda: lenses.image_distance_mm(math.nan, 10), "nan"),
        (lambda: lenses.image_distance_mm(33, -1), "distance = -1 m"),
        (lambda: lenses.image_distance_mm(33, 0.03), "no real image"),
        (lambda: lenses.Sampling(0, 5), "pixels along an axis = 0"),
        (lambda: lenses.depth_sigma_m(10, 33, 0, 1e-3), "baseline = 0"),
    ],
)
def test_nonsense_is_answered(call: Callable[[], object], said: str) -> None:
    with pytest.raises(DecodeError, match=said):
        call()
