from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from dappled import codec
from dappled.decode.depth.depth_map import DepthMap
from dappled.decode.depth.ranging import Ranging, Target, fit_targets, target_shift
from dappled.decode.errors import DecodeError
from dappled.decode.lightfield.light_field import ViewStack, centred
from dappled.decode.optics import lenses
from tests.decode.optics.equations import object_distance

STACK = ViewStack(np.zeros((5, 5, 8, 10), np.float32), centred(5), centred(5), sensor_px_per_disparity=32.0)
LENS = Ranging.of_lens(50.0, 7.4, 0.01)


def depth_map(disparity: float, sigma: float = 0.01, shape: tuple[int, int] = (8, 10)) -> DepthMap:
    one = np.ones(shape, np.float32)
    return DepthMap(np.float32(disparity) * one, np.float32(sigma) * one, one, "")


@given(st.floats(1, 100), st.floats(5, 1e6))
@settings(deadline=None)
def test_it_is_equation_5(distance_m: float, focus_m: float) -> None:
    ranging = Ranging.of_lens(50.0, 7.4, 0.01, focus_m)
    shift_mm = (ranging.gain_px_m / distance_m + ranging.offset_px) * 0.01
    sensor_mm = lenses.image_distance_mm(50.0, focus_m)
    found = object_distance(50.0, sensor_mm, shift_mm, 50.0 / 7.4, sigma_h_mm=1e-6)
    assert found.distance_m == pytest.approx(distance_m, rel=1e-6)
    exact = replace(ranging, gain_sigma_share=0.0)
    made = exact.distances(depth_map(ranging.disparity(distance_m, STACK), 1e-4 / 32), STACK)
    assert made.distance_m[0, 0] == pytest.approx(distance_m, rel=1e-2)
    assert made.sigma_m[0, 0] == pytest.approx(found.sigma_m, rel=2e-2)
    nominal = ranging.distances(depth_map(ranging.disparity(distance_m, STACK), 1e-4 / 32), STACK)
    assert nominal.sigma_m[0, 0] == pytest.approx(np.hypot(found.sigma_m, 0.02 * distance_m), rel=2e-2)


def test_what_cannot_be_told_from_infinity_is_unknown() -> None:
    near, far = LENS.disparity(10, STACK), LENS.disparity(200, STACK)
    assert np.isfinite(LENS.distances(depth_map(near, 0.01), STACK).distance_m).all()
    assert np.isnan(LENS.distances(depth_map(far, 0.01), STACK).distance_m).all()
    assert np.isnan(LENS.distances(depth_map(-near, 0.01), STACK).distance_m).all()
    assert LENS.disparity(math.inf, STACK) == 0


def test_stopping_down_shrinks_the_shift() -> None:
    assert LENS.at(14.8, 50.0).gain_px_m == pytest.approx(LENS.gain_px_m / 2)
    assert LENS.at(None, 50.0) == LENS


def test_another_f_number_is_as_sure_as_f_numbers_are() -> None:
    """Both are nominal: a shift is off by 2 %, so what is in focus stays where it was."""
    exact = Ranging(32.0, -16.0, 4.0, focal_length_mm=50.0)
    other = exact.at(8.0, 50.0)
    assert (other.gain_px_m, other.offset_px) == (16.0, -8.0)
    assert other.sigma_m(2.0) == pytest.approx(0.0, abs=1e-9)
    assert other.sigma_m(6.0) == pytest.approx(0.02 * 6.0 * (6.0 / 2.0 - 1))  # Z = g/(g/F + S), S off by 2 %


def test_a_calibration_is_for_one_focal_length() -> None:
    """Gain grows as the focal length's square: half a millimetre may be rounding, and is told."""
    wide = fit_targets([Target(2.0, 9.0), Target(6.0, 3.0)], f_number=2.8, focal_length_mm=12.8)
    assert Ranging.from_dict(codec.plain(wide)) == wide
    assert wide.at(2.8, 12.8) == wide
    assert wide.at(2.8, 13.0).gain_sigma_share == pytest.approx(2 * 0.2 / 12.8)
    for other in (32.7, 13.4, None):
        with pytest.raises(DecodeError, match=r"calibrated at a focal length of 12\.8 mm"):
            wide.at(2.8, other)
    unknown = replace(wide, focal_length_mm=None)
    assert unknown.at(2.8, None) == unknown
    with pytest.raises(DecodeError, match=r"an unknown focal length, the frame's is 12\.8"):
        unknown.at(2.8, 12.8)


def test_targets_tell_gain_and_offset() -> None:
    true = Ranging(33.8, -2.0, 7.4)
    targets = [Target(z, true.gain_px_m / z + true.offset_px) for z in (3.0, 5.0, 12.0)]
    found = fit_targets(targets, f_number=7.4)
    assert found.gain_px_m == pytest.approx(33.8)
    assert found.offset_px == pytest.approx(-2.0)
    alone = fit_targets(targets[:1], f_number=7.4, lens=Ranging(33.8, 0.0))
    assert alone.offset_px == pytest.approx(-2.0)
    assert Ranging.from_dict(codec.plain(found)) == found


def seen(true: Ranging, sigma: float, metres: tuple[float, ...], rng: np.random.Generator) -> list[Target]:
    shifts = [true.gain_px_m / z + true.offset_px + sigma * rng.standard_normal() for z in metres]
    return [Target(z, s, sigma) for z, s in zip(metres, shifts, strict=True)]


@pytest.mark.parametrize("metres", [(3.0, 12.0), (1.0, 4.0), (2.0, 2.5, 9.0), (4.0,)])
def test_distances_are_as_sure_as_the_targets(metres: tuple[float, ...]) -> None:
    """Against many draws of the errors of targets, of the thing itself, and of a lens by which one target tells all."""
    true, sigma = Ranging(33.8, -16.9, 7.4), 0.02
    rng = np.random.default_rng(1)
    for distance in (1.2, 2.6, 6.0):
        z, gains = [], []
        for _ in range(400):
            lens = Ranging(true.gain_px_m * (1 + 0.005 * rng.standard_normal()), 0.0, gain_sigma_share=0.005)
            made = fit_targets(seen(true, sigma, metres, rng), f_number=7.4, lens=lens)
            told = made.gain_px_m / (
                true.disparity(distance, STACK) * 32 + sigma * rng.standard_normal() - made.offset_px
            )
            z.append((told - distance) / made.sigma_m(told, sigma))
            gains.append((made.gain_px_m / true.gain_px_m - 1) / made.gain_sigma_share)
        # of three targets the fit takes their misfit where it is larger: a little too unsure
        wide = 0.6 if len(metres) > 2 else 0.9
        assert wide < np.sqrt(np.mean(np.square(z))) < 1.1
        assert wide < np.sqrt(np.mean(np.square(gains))) < 1.1


def test_targets_on_no_line_make_all_unsure() -> None:
    bent = fit_targets([Target(2.0, 10.0), Target(4.0, 6.0), Target(8.0, 2.5)], f_number=7.4)
    assert bent.gain_sigma_share > 0.05
    assert bent.sigma_m(4.0) > 0.05


def test_the_focus_is_where_nothing_shifts() -> None:
    """It is not better known than the shift of all targets together, 0.0075 px from view to view."""
    found = Ranging(33.8, -16.9).focus(STACK)
    assert found == pytest.approx((2.0, 2.0**2 * 0.0075 * 32 / 33.8))
    assert LENS.focus(STACK) is None


def test_the_target_is_what_fills_the_middle() -> None:
    made = depth_map(0.2, shape=(40, 40))
    made.disparity[:8] = 3.0
    shift, sigma = target_shift(made, STACK, window=5)
    assert shift == pytest.approx(0.2 * 32)
    four = math.sqrt(math.pi / 2 / 4) * 0.01  # windows of 5 px in 10 × 10 px
    assert sigma == pytest.approx(math.hypot(four, 0.0017) * 32)
    with pytest.raises(DecodeError, match="too little texture"):
        target_shift(depth_map(float("nan")), STACK)


def test_a_targets_shift_is_as_sure_as_its_blocks_agree() -> None:
    """Whatever the map says of itself: here that it is ten times as good as its windows are."""
    rng = np.random.default_rng(2)
    z = []
    for _ in range(200):
        made = depth_map(0.2, sigma=0.005, shape=(80, 160))
        errors = np.kron(0.05 * rng.standard_normal((16, 32)), np.ones((5, 5)))
        made = replace(made, disparity=made.disparity + errors.astype(np.float32))
        shift, sigma = target_shift(made, STACK, window=5)
        z.append((shift / 32 - 0.2) / (sigma / 32))
    assert 0.85 < np.sqrt(np.mean(np.square(z))) < 1.4


@pytest.mark.parametrize(
    ("act", "words"),
    [
        (lambda: Ranging(0, 1), "no lens"),
        (lambda: Ranging.of_lens(50, 7.4, 0.01, 0.02), "no camera"),
        (lambda: LENS.disparity(0, STACK), "must be above 0"),
        (lambda: fit_targets([], f_number=None), "no target"),
        (lambda: fit_targets([Target(5, 1)], f_number=None), "single distance"),
        (lambda: fit_targets([Target(5, 1), Target(10, 2)], f_number=None), "smaller shifts"),
        (lambda: fit_targets([Target(-5, 1)], f_number=None), "above 0 m"),
        (lambda: Ranging.from_dict({}), "incomplete"),
        (lambda: LENS.disparity(1, ViewStack(STACK.views, centred(5), centred(5))), "no sensor"),
    ],
)
def test_nonsense_is_told(act, words: str) -> None:  # type: ignore[no-untyped-def]  # several signatures
    with pytest.raises(DecodeError, match=words):
        act()
