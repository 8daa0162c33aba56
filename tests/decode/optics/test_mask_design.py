"""Design and flight planning: the rules hold in what is designed, and what can't be done is said."""

from __future__ import annotations

import math
from dataclasses import replace
from typing import Any

import pytest
from hypothesis import given
from hypothesis import strategies as st

from dappled.decode.errors import DecodeError
from dappled.decode.optics import MaskedOptics, lenses
from dappled.decode.optics.carrier_tables import beyond_mask, fresnel_number, lattice_of
from dappled.decode.optics.carriers import Mask, Sensor
from dappled.decode.optics.film import FILMS, film_of
from dappled.decode.optics.mask_design import DESIGNS, FRESNEL_LIMIT, DesignRequirements, buildable
from dappled.findings import Code, text
from tests.decode.thesis_tables import S5200

REFERENCE = Sensor((2776, 3688), (0.01, 0.0), (0.0, 0.01))


def _requirements(**changed: Any) -> DesignRequirements:
    values: dict[str, Any] = {
        "sensor": S5200,
        "focal_length_mm": 13.0,
        "f_number": 3.5,
        "altitude_m": 40.0,
        "film": FILMS["16k"],
    }
    return DesignRequirements(**{**values, **changed})


def test_the_reference_camera_is_what_the_rules_give() -> None:
    """3688 × 2776 px of 10 µm, v = 50 mm, aperture 6.7 mm: d = 0.48 mm and 15.5 periods a mm."""
    wanted = _requirements(
        sensor=REFERENCE, focal_length_mm=50.0, f_number=7.4, film=film_of(8000, 8000, 113.8), altitude_m=1e5
    )
    made = DESIGNS["geometric"](wanted)
    assert made.works
    assert made.mask_distance_mm == pytest.approx(0.48, abs=0.005)
    assert made.mask.frequency_per_mm == pytest.approx(15.5, abs=0.2)
    assert made.view_shape[1] == pytest.approx(566, rel=0.02)


@given(
    focal=st.floats(8, 80),
    stop=st.floats(2, 16),
    altitude=st.floats(3, 200),
    views=st.sampled_from([3, 5, 7]),
    law=st.sampled_from(["fd", "geometric"]),
)
def test_what_works_keeps_every_rule(focal: float, stop: float, altitude: float, views: int, law: str) -> None:
    wanted = _requirements(
        focal_length_mm=focal, f_number=stop, altitude_m=altitude, views=views, largest_distance_mm=5.0
    )
    made = DESIGNS[law](wanted)
    if not made.works:
        assert made.problem is not None
        assert made.problem.code is Code.MASK_UNMAKABLE
        return
    top = made.mask.p * made.mask.frequency_per_mm
    assert made.mask.views_per_axis == views
    assert made.mask_distance_mm <= 5.0
    assert top <= wanted.film.nyquist_per_mm * (1 + 1e-6)
    assert fresnel_number(made.mask_distance_mm, top) <= FRESNEL_LIMIT * (1 + 1e-6)
    lattice = lattice_of(MaskedOptics(S5200, made.mask, law, made.mask_distance_mm), wanted.image_mm)
    assert (made.mask.p + 0.5) * max(lattice.ky[0], lattice.kx[1]) <= 0.5 * (1 + 1e-6)
    assert 0 < made.spectrum_used <= 1 + 1e-9
    if law == "geometric":  # the ideal: f_m = v / (d·A)
        assert made.mask.frequency_per_mm * made.mask_distance_mm * wanted.aperture_mm == pytest.approx(wanted.image_mm)


def test_fd_fills_the_shorter_side_of_the_spectrum() -> None:
    made = DESIGNS["fd"](_requirements())
    lattice = lattice_of(MaskedOptics(S5200, made.mask, "fd", made.mask_distance_mm), 13.0)
    assert 2.5 * lattice.ky[0] == pytest.approx(0.5)


def test_depth_error_follows_eq_5() -> None:
    made = DESIGNS["geometric"](_requirements())
    near, far = (DESIGNS["geometric"](_requirements(altitude_m=h)).depth_sigma_m for h in (10.0, 20.0))
    assert far / near == pytest.approx(4, rel=0.01)
    assert made.baseline_mm == pytest.approx(13 / 3.5 / 5)


@pytest.mark.parametrize(
    ("changed", "said"),
    [
        ({"film": film_of(200, 200, 10.0), "largest_distance_mm": 0.2}, "highest harmonic on film"),
        ({"mask_distance_mm": 1.01}, "views of 18 × 13 px, fewer than 16 per side"),
        ({"mask_distance_mm": 0.3, "least_distance_mm": 1.01}, "it can be mounted: 0.3 of at least 1.01 mm"),
        ({"f_numbers": (4.0, 8.0)}, "f-number as the lens opens: 3.5 of at least 4"),
        ({"f_number": 11.0, "f_numbers": (3.2, 8.0)}, "f-number as the lens stops down: 11 of at most 8"),
        ({"sensor": REFERENCE}, "height of the mask on film: 27.76 of at most 24 mm"),
        ({"mask_distance_mm": 0.01}, "diffraction|Nyquist"),
    ],
)
def test_why_no_mask_does_it(changed: dict[str, Any], said: str) -> None:
    made = DESIGNS["geometric"](_requirements(**changed))
    if made.works:
        pytest.fail(f"{made}")
    assert made.problem is not None
    assert any(word in str(text(made.problem)) for word in said.split("|"))


def test_what_hardware_refuses_is_answered_with_what_can_be_built() -> None:
    """Behind 1.01 mm of glass a view has about width·f-number/d·(1 − d/v) pixels, 42 at f/8."""
    wanted = _requirements(mask_distance_mm=0.109, least_distance_mm=1.01, f_numbers=(3.2, 8.0))
    assert not DESIGNS["geometric"](wanted).works
    made = buildable(wanted, "geometric")
    assert made is not None
    assert made.wanted.f_number == 8
    assert made.mask_distance_mm == pytest.approx(1.01)
    assert made.view_shape == (31, 42)
    assert "views of 42 × 31 px show little" in made.warnings[0]
    assert buildable(_requirements(sensor=REFERENCE), "geometric") is None  # no film is as large


def test_a_law_that_asks_the_mask_for_more_than_it_has_is_warned_of() -> None:
    """Eq 30 at 13 mm: 2·11.38·1.01/13 mm on a DFT of 4.29 mm and 2776 px is 266.7 cycles/mm; the mask has 22.76."""
    mask = Mask(11.38, 2, film_px_per_mm=113.8)
    told = beyond_mask(mask, S5200, lattice_of(MaskedOptics(S5200, mask, "fd", 1.01), 13.0))
    assert told is not None
    assert (
        "×2 at 266.7 cycles/mm on the sensor, but on the mask it has 22.8, and its film draws nothing above 56.9"
        in told
    )
    assert beyond_mask(mask, S5200, lattice_of(MaskedOptics(S5200, mask, "geometric", 1.01), 13.0)) is None
    assert any("no shadow" in warning for warning in DESIGNS["fd"](_requirements()).warnings)


@pytest.mark.parametrize(
    ("changed", "said"),
    [
        ({"focal_length_mm": 0.013}, "is it given in millimetres"),
        ({"f_number": 0.0}, "f-number = 0"),
        ({"altitude_m": -40.0}, "distance = -40 m"),
        ({"altitude_m": math.nan}, "nan"),
        ({"views": 4}, "views = 4 must be odd"),
        ({"wavelength_nm": 0.55}, "wavelength = 0.55 nm"),
        ({"shift_sigma_px": 0.0}, "error of a shift = 0"),
        ({"mask_distance_mm": 13.0}, "mask distance = 13 mm"),
    ],
)
def test_nonsense_is_answered(changed: dict[str, Any], said: str) -> None:
    with pytest.raises(DecodeError, match=said):
        _requirements(**changed)


def test_a_plan_by_hand() -> None:
    """10 µm pixels, 50 mm, 50 m: 1 cm a pixel, 36.88 × 27.76 m; 80 % overlap is 5.55 m, at 5.552 m/s a second."""
    survey = lenses.SurveyFlight(
        focal_length_mm=50,
        altitude_m=50.05,
        speed_m_s=5.552,
        overlap=0.8,
        sidelap=0.6,
        exposure_s=0.002,
        hours=0.5,
        frame_bytes=10_000_000,
    )
    made = survey.plan(REFERENCE, 461)
    assert made.ground_sample_m == pytest.approx(0.01, rel=1e-6)
    assert made.footprint_m == pytest.approx((27.76, 36.88), rel=1e-6)
    assert made.view_sample_m == pytest.approx(0.08, rel=1e-3)
    assert made.interval_s == pytest.approx(1.0, rel=1e-6)
    assert made.blur_px == pytest.approx(1.1104, rel=1e-6)
    assert made.frames in (1800, 1801)
    assert made.disk_bytes == made.frames * 10_000_000
    assert made.longest_exposure_s == pytest.approx(0.01 / 5.552, rel=1e-6)
    assert replace(survey, sideways=True).plan(REFERENCE).footprint_m[0] == pytest.approx(36.88, rel=1e-6)
