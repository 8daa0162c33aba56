from __future__ import annotations

import numpy as np
import pytest

from dappled.decode.calibration.law_choice import LawVerdict, judge, steps_bins
from dappled.decode.optics import MaskedOptics
from dappled.decode.optics.carriers import LAWS, Lattice, Mask, Sensor
from dappled.findings import Code
from tests.decode.thesis_tables import MASK_2, S5200

CHIP = Sensor((2776, 3688), (0.01, 0.0), (0.0, 0.01))
MASK = Mask(15.5, 2)
LENGTHS = (35.0, 50.0, 70.0, 100.0)
Seen = list[tuple[float, tuple[float, float]]]


def _seen(law: str, distance_mm: float, *, pupil_mm: float = 0.0, stretch: float = 0.0, turned: float = 0.0) -> Seen:
    found = []
    for length in LENGTHS:
        lattice = LAWS[law](MASK, CHIP, distance_mm, length + pupil_mm).rotated(turned)
        rows, columns = steps_bins(lattice, CHIP)
        found.append((length, (rows * (1 + stretch), columns)))
    return found


def _judged(seen: Seen, asked: str = "fd") -> LawVerdict:
    return judge(seen, MaskedOptics(CHIP, MASK, asked, 0.48))


@pytest.mark.parametrize("law", ["fd", "geometric"])
@pytest.mark.parametrize("asked", ["fd", "geometric"])
def test_the_law_that_made_the_carriers_is_found(law: str, asked: str) -> None:
    verdict = _judged(_seen(law, 0.45, turned=0.02), asked)
    assert verdict.law == law
    fit = next(one for one in verdict.fits if one.law == law)
    assert fit.mask_distance_mm == pytest.approx(0.45, rel=1e-4)
    assert fit.rms_bins < 0.01
    assert (verdict.finding.code, verdict.finding.facts["law"]) == (Code.LAW_EXPLAINS, law)


def test_the_exit_pupil_and_the_anisotropy_are_found() -> None:
    (_, fit) = _judged(_seen("geometric", 0.5, pupil_mm=12.0, stretch=0.004)).fits
    assert fit.pupil_mm == pytest.approx(12.0, abs=0.2)
    assert fit.mask_distance_mm == pytest.approx(0.5, rel=0.01)
    assert fit.anisotropy == pytest.approx(0.004, abs=1e-4)


def test_a_constant_beside_the_1_over_f_is_found() -> None:
    seen = [(length, (rows + 5.0, columns - 3.0)) for length, (rows, columns) in _seen("fd", 0.45)]
    (fit, _) = _judged(seen).fits
    assert fit.offset_bins == pytest.approx((5.0, -3.0), abs=1e-6)
    assert fit.mask_distance_mm == pytest.approx(0.45, rel=1e-6)


def test_carriers_of_neither_law_are_called_so() -> None:
    seen = [(length, (4000 / length**0.5, 5000 / length**0.5)) for length in LENGTHS]
    verdict = _judged(seen)
    assert verdict.law is None
    assert verdict.finding.code is Code.LAW_NEITHER


def test_the_thesis_s_own_readings_fit_neither_law_together() -> None:
    """Tables 12 (12 mm) and 13 (33 mm), as measured: the steps of mask 2."""
    seen = [(12.0, (653.0, 613.0)), (33.0, (183.5, 184.0))]
    verdict = judge(seen, MaskedOptics(S5200, MASK_2, "fd", 1.01))
    assert verdict.law is None
    fd, _ = verdict.fits
    assert fd.rms_bins > 20


def test_one_focal_length_is_not_much() -> None:
    verdict = _judged(_seen("geometric", 0.48)[:1], "geometric")
    assert verdict.law == "geometric"
    assert verdict.finding.code in (Code.LAW_ONLY, Code.LAW_BOTH)


def test_steps_are_lengths_whatever_the_turn() -> None:
    lattice = Lattice((0.1, 0.0), (0.0, 0.12))
    assert steps_bins(lattice, CHIP) == pytest.approx((277.6, 442.56))
    assert np.hypot(*lattice.rotated(0.3).ky) == pytest.approx(0.1)
    assert steps_bins(lattice.rotated(0.3), CHIP) == pytest.approx((277.6, 442.56))


def test_the_distance_scatters_as_told_where_exif_rounds_focal_lengths() -> None:
    """Whole millimetres: each focal length's error moves its steps along rows and columns together."""
    chance = np.random.default_rng(0)
    distances, sigmas = [], []
    for _ in range(100):
        seen = []
        for length in (18.0, 55.0):
            lattice = LAWS["geometric"](MASK, CHIP, 1.0, length + chance.uniform(-0.5, 0.5))
            rows, columns = np.array(steps_bins(lattice, CHIP)) + chance.normal(0, 0.02, 2)
            seen.append((length, (float(rows), float(columns))))
        verdict = judge(seen, MaskedOptics(CHIP, MASK, "geometric", 1.0), focal_sigma_mm=0.5 / 3**0.5)
        (_, fit) = verdict.fits
        assert fit.distance_sigma_mm is not None
        distances.append(fit.mask_distance_mm)
        sigmas.append(fit.distance_sigma_mm)
    assert 0.8 < np.std(distances) / np.median(sigmas) < 1.25
