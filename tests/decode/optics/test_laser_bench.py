"""The laser bench: Tables 4 to 9, propagation, and the verdict on what was measured."""

from __future__ import annotations

import math

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from dappled.decode.errors import DecodeError
from dappled.decode.optics import laser_bench
from dappled.decode.optics.carriers import Mask
from dappled.decode.optics.film import MaskImage, film_of
from tests.decode import thesis_tables as thesis
from tests.decode.optics.equations import near_field, spots

BENCH = (laser_bench.THESIS_WAVELENGTH_NM, laser_bench.THESIS_DISTANCE_M)
PITCH = (1 / 113.8, 1 / 113.8)


def _corners(*rings: float) -> list[tuple[float, float]]:
    return [(a * r, b * r) for r in rings for a in (1, -1) for b in (1, -1)]


@pytest.mark.parametrize(
    ("mask", "frequencies", "places"),
    [
        pytest.param(thesis.MASK_1, thesis.TABLE_4, thesis.TABLE_5, id="tables 4 and 5"),
        pytest.param(thesis.MASK_2, thesis.TABLE_6, thesis.TABLE_7, id="tables 6 and 7"),
        pytest.param(thesis.MASK_4, thesis.TABLE_8, thesis.TABLE_9, id="tables 8 and 9"),
    ],
)
def test_tables_of_the_bench(mask: Mask, frequencies: list[float], places: list[float]) -> None:
    found = laser_bench.impulses(mask)
    assert (found[0].p_per_m, found[0].q_per_m) == (0, 0)
    nearest = sorted(found[1:], key=lambda i: abs(i.p_per_m))[: 4 * len(frequencies)]
    assert {(round(i.p_per_m), round(i.q_per_m)) for i in nearest} == {
        (round(x), round(y)) for x, y in _corners(*frequencies)
    }
    for impulse, place in zip(nearest, np.repeat(places, 4), strict=True):
        x, y = impulse.landing_mm(*BENCH)
        assert abs(x) == pytest.approx(place, abs=0.0101)
        assert abs(y) == pytest.approx(place, abs=0.0101)
        assert impulse.weight == 0.25  # Eq 22


def test_mask_4_has_41_impulses() -> None:
    assert len(laser_bench.impulses(thesis.MASK_4)) == 41


@pytest.mark.parametrize("intensity", [False, True])
def test_a_propagated_mask_lands_its_spots_on_table_7(intensity: bool) -> None:
    """With film as an intensity filter (amplitude its root) there are weaker spots beside, none stronger."""
    image = MaskImage(thesis.MASK_2, film_of(640, 640, 113.8), (10, 10))
    values = image.transmittance(slice(None), slice(None))
    field = (np.sqrt(values) if intensity else values) * laser_bench.beam(values.shape, PITCH, 2.0)
    screen = laser_bench.far_screen(field, PITCH, *BENCH, samples=1024)
    seen = spots(screen, separation_mm=1.5)
    expected = np.array([(0.0, 0.0), *_corners(*thesis.TABLE_7)])
    places = np.array([(s.x_mm, s.y_mm) for s in seen[:9]])
    apart = np.hypot(*(expected[:, None] - places[None]).transpose(2, 0, 1))
    assert apart.min(axis=1).max() < 0.1
    if not intensity:
        assert len(seen) == 9


@given(distance=st.floats(0.3, 3), width=st.floats(0.3, 1.0))
def test_a_gaussian_beam_spreads_as_it_should(distance: float, width: float) -> None:
    """1/e² diameter w·sqrt(1 + (z/z_R)²), z_R = πw²/λ, against the wall's second moment."""
    shape, pitch = (256, 256), (0.012, 0.012)
    screen = laser_bench.far_screen(laser_bench.beam(shape, pitch, width), pitch, 532, distance, samples=512)
    x = (np.arange(screen.intensity.shape[1]) - screen.intensity.shape[1] // 2) * screen.pitch_mm[1]
    profile = screen.intensity.sum(axis=0)
    diameter = 4 * math.sqrt(float((profile * x**2).sum() / profile.sum()))
    rayleigh_mm = math.pi * (width / 2) ** 2 / 532e-6
    assert diameter == pytest.approx(width * math.hypot(1, distance * 1e3 / rayleigh_mm), rel=0.02)
    power = screen.intensity.sum() * math.prod(screen.pitch_mm)
    assert power == pytest.approx((laser_bench.beam(shape, pitch, width) ** 2).sum() * math.prod(pitch), rel=1e-9)


def test_near_field_leaves_the_contrast_that_eq_30_says() -> None:
    n, pitch, periods = 512, 0.004, 24
    frequency = periods / (n * pitch)
    wave = 1 + 0.2 * np.cos(2 * np.pi * periods * np.arange(n) / n)
    field = np.repeat(wave[None], n, axis=0)
    behind = np.abs(near_field(field, (pitch, pitch), 550, 1.01e-3)) ** 2
    kept = np.abs(np.fft.fft(behind[0]))[periods] / np.abs(np.fft.fft(wave**2))[periods]
    assert kept == pytest.approx(abs(math.cos(math.pi * 550e-6 * 1.01 * frequency**2)), rel=1e-3)


def test_sampling_conditions_are_checked() -> None:
    with pytest.raises(DecodeError, match=r"too wide for 0\.01 m"):
        laser_bench.far_screen(np.ones((600, 600)), PITCH, 532, 0.01)
    with pytest.raises(DecodeError, match="too far for 64 samples"):
        near_field(np.ones((64, 64)), PITCH, 532, 0.5)


@pytest.mark.parametrize(
    ("mask", "seen", "kind"),
    [
        pytest.param(thesis.MASK_1, _corners(3, 7), "scaled", id="mask 1, table 5"),
        pytest.param(thesis.MASK_2, _corners(3, 7), "as designed", id="mask 2, table 7"),
        pytest.param(thesis.MASK_4, _corners(1.8, 3.6, 7.1), "as designed", id="mask 4, table 9"),
        pytest.param(Mask(5.69, 5, "diagonal", "octave"), _corners(7), "not this mask", id="mask 5"),
        pytest.param(thesis.MASK_2, _corners(3.5, 5.3), "not this mask", id="a third of a period"),
        pytest.param(thesis.MASK_2, [(3.5, 0), (0, 3.5), (-3.5, 0), (0, -3.5)], "not this mask", id="a cross"),
    ],
)
def test_verdicts(mask: Mask, seen: list[tuple[float, float]], kind: str) -> None:
    verdict = laser_bench.judge(mask, [(0.0, 0.0), *seen])
    assert verdict.kind == kind
    if kind == "scaled":
        assert "printed 2 times as large as designed, or another mask" in verdict.text
        assert "periods on film are 2.0" in verdict.text
        assert verdict.frequency_scale == pytest.approx(0.5, abs=0.03)


@given(scale=st.floats(0.3, 3), seed=st.integers(0, 1000))
def test_a_scaled_print_is_told_whatever_its_scale(scale: float, seed: int) -> None:
    rng = np.random.default_rng(seed)
    seen = np.array(_corners(*(p * scale for p in thesis.TABLE_7))) + rng.normal(0, 0.02, (8, 2))
    verdict = laser_bench.judge(thesis.MASK_2, [(float(x), float(y)) for x, y in seen], tolerance_mm=0.1)
    assert verdict.frequency_scale == pytest.approx(scale, abs=0.02)
    assert verdict.kind == "as designed" or abs(scale - 1) > 0.005


def test_nothing_measured_is_said() -> None:
    with pytest.raises(DecodeError, match="no spot beside the centre"):
        laser_bench.judge(thesis.MASK_2, [(0.0, 0.1)])
    with pytest.raises(DecodeError, match="not a number"):
        laser_bench.judge(thesis.MASK_2, [(math.nan, 1)])
