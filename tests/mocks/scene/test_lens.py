"""The mask's pattern, the aperture, and the sign and size of parallax."""

from __future__ import annotations

import math

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from dappled.decode.optics.carriers import Harmonics, Mask, Pattern, Sensor
from dappled.mocks.scene import lens
from dappled.mocks.scene.lens import Installation, Optics
from tests.mocks.scene import oracles

REFERENCE = Optics(50.0, 7.4, 6.7, Mask(15.5, 2), 0.48)


@given(
    p=st.integers(1, 4),
    pattern=st.sampled_from(["full", "diagonal"]),
    harmonics=st.sampled_from(["linear", "octave"]),
)
def test_modulation_is_the_spectrum_of_the_printed_mask(p: int, pattern: Pattern, harmonics: Harmonics) -> None:
    mask = Mask(1.0, p, pattern, harmonics)
    side = 64
    axis = np.arange(side) / side
    values = oracles.mask_values(mask, axis[:, None], axis[None, :])
    assert -1e-3 < values.min() < 0.02
    assert 0.98 < values.max() <= 1 + 1e-9
    spectrum = np.fft.fft2(values) / side**2
    rebuilt = np.zeros_like(spectrum)
    for (ky, kx), weight in lens.modulation(mask).items():
        rebuilt[ky, kx] = rebuilt[-ky, -kx] = weight * spectrum[0, 0]
    np.testing.assert_allclose(spectrum, rebuilt, atol=2e-4)


def test_parallax_of_three_pixels_comes_from_the_depth_that_says_so() -> None:
    depth = REFERENCE.depth_m(3 * 0.01, 5)
    assert depth == pytest.approx(6.7 / 5 * 50 / 0.03 * 1e-3)
    shift = REFERENCE.disparity_mm_per_mm(np.array([depth])) * 6.7 / 5
    assert shift[0] == pytest.approx(0.03)


def test_parallax_changes_its_sign_at_the_focus() -> None:
    focused = Optics(50.0, 7.4, 6.7, Mask(15.5, 2), 0.48, focus_m=3.0)
    nearer, at, farther = focused.disparity_mm_per_mm(np.array([2.0, 3.0, 4.0]))
    assert nearer > 0
    assert at == 0
    assert farther < 0


def test_parallax_agrees_with_the_thin_lens() -> None:
    focus_mm, z_mm, f_mm, theta = 3000.0, 1200.0, 50.0, 2.0
    v = 1 / (1 / f_mm - 1 / focus_mm)
    image = 1 / (1 / f_mm - 1 / z_mm)  # where the point on the axis becomes sharp
    expected = theta * (1 - v / image)  # the ray from θ to that image, where it passes the sensor
    optics = Optics(v, v / 6.7, 6.7, Mask(15.5, 2), 0.48, focus_m=focus_mm * 1e-3)
    assert theta * optics.disparity_mm_per_mm(np.array([z_mm * 1e-3]))[0] == pytest.approx(expected)


def test_a_depth_behind_infinity_is_refused() -> None:
    with pytest.raises(ValueError, match="no depth"):
        REFERENCE.depth_m(-0.01, 5)


def test_stopping_down_shrinks_the_aperture_and_opening_further_is_refused() -> None:
    open_side = np.ptp(REFERENCE.aperture_points_mm(7.4)[..., 0])
    assert open_side == pytest.approx(6.7 * 4 / 5)
    assert np.ptp(REFERENCE.aperture_points_mm(14.8)[..., 1]) == pytest.approx(open_side / 2)
    with pytest.raises(ValueError, match="wider"):
        REFERENCE.aperture_points_mm(4.0)


def test_the_lattice_is_the_gradient_of_the_mask_crossing() -> None:
    installation = Installation(math.radians(1.7), (0.01, -0.02), 0.5)
    sensor = Sensor((400, 600), (0.01, 0.0), (0.0, 0.01))
    alpha = 0.5 / 50
    crossing_per_px = (1 - alpha) * installation.rotation() * 0.01  # mask mm for a step of (row, column)
    np.testing.assert_allclose(
        lens.carrier_lattice(REFERENCE, installation, sensor).matrix(), 15.5 * crossing_per_px, rtol=1e-12
    )


def test_an_installation_belongs_to_its_seed_and_stays_in_its_bounds() -> None:
    drawn = [Installation.drawn(seed, REFERENCE) for seed in range(50)]
    assert drawn[7] == Installation.drawn(7, REFERENCE)
    assert len({i.rotation_rad for i in drawn}) == 50
    assert all(abs(i.rotation_rad) <= math.radians(2) for i in drawn)
    assert all(0.9 * 0.48 <= i.distance_mm <= 1.1 * 0.48 for i in drawn)


def test_an_ideal_aperture_averages_the_mask_away_and_a_small_one_does_not() -> None:
    ideal = Optics(50.0, 7.4, 1 / (15.5 * 0.0096), Mask(15.5, 2), 0.48)
    installation = Installation(0.0, (0.0, 0.0), 0.48)
    full = lens.peak_over_mean(ideal, installation, ideal.aperture_points_mm(7.4).reshape(-1, 2))
    small = lens.peak_over_mean(ideal, installation, ideal.aperture_points_mm(8 * 7.4).reshape(-1, 2))
    assert full == pytest.approx(1, abs=1e-9)
    assert small > 5
