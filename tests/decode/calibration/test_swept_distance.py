"""Distance and print scale of a mask from several f-numbers, on frames by rays (`ray_frames`)."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
import pytest

from dappled.decode.calibration import Calibration, report
from dappled.decode.calibration.fit import CalibrationFrame, from_lattices, lattice_of
from dappled.decode.calibration.lattice_fit import FrameLattice
from dappled.decode.calibration.law_choice import LawFit
from dappled.decode.calibration.swept_distance import swept_distance
from dappled.decode.optics import MaskedOptics
from dappled.decode.optics.carriers import Mask, Sensor
from tests.decode.ray_frames import CANON, MASKS, Body, Shot, Stop

SMALL = Body((357, 536), CANON.pitch_mm, "450D, an eighth of its sides")
SENSOR = Sensor(SMALL.shape, (SMALL.pitch_mm[0], 0.0), (0.0, SMALL.pitch_mm[1]))
FILM = MASKS["mask-2-full"]
MASK = Mask(FILM.frequency_per_mm, FILM.p, FILM.pattern, FILM.harmonics, FILM.px_per_mm)
STATED_MM = 1.01
STOPS = (11.0, 22.0, 32.0)


def _seen(shot: Shot, length_mm: float, f_number: float, sigma_mm: float = 0.0) -> FrameLattice:
    """What a frame shows whose EXIF says that length and f-number."""
    frame = CalibrationFrame(shot.frame(), length_mm, f_number, sigma_mm)
    return lattice_of(frame, MaskedOptics(SENSOR, MASK, "geometric", STATED_MM))


def _geometric(found: Calibration) -> LawFit:
    return next(fit for fit in report.law_fits(found, STATED_MM) if fit.law == "geometric")


def _calibrated(seen: Sequence[FrameLattice]) -> Calibration:
    found = from_lattices(seen, MaskedOptics(SENSOR, MASK, "fd", STATED_MM), choose_law=True)
    assert Calibration.from_dict(found.to_dict()) == found
    return found


@pytest.fixture(scope="module")
def one_length() -> list[FrameLattice]:
    """A print 0.5 % too coarse, 0.93 mm before the sensor, behind a hexagonal stop."""
    film = replace(FILM, scale=0.995)
    stop = Stop("polygon", blades=6)
    shots = [Shot(film, SMALL, 50.0, n, distance_mm=0.93, turn_deg=1.3, stop=stop, finer=2) for n in STOPS]
    return [_seen(shot, 50.0, shot.f_number) for shot in shots]


def test_one_focal_length_at_several_stops_tells_scale_and_distance_apart(one_length: list[FrameLattice]) -> None:
    found = _calibrated(one_length)
    fit = _geometric(found)
    assert fit.distance_sigma_mm is not None
    assert fit.print_scale_sigma is not None
    assert fit.distance_sigma_mm < 0.08
    assert fit.print_scale_sigma < 0.002
    assert abs(fit.mask_distance_mm - 0.93) < 2 * fit.distance_sigma_mm
    assert abs(fit.print_scale - 0.995) < 2 * fit.print_scale_sigma
    assert {one.print_scale for one in found.fits} == {fit.print_scale if found.fits[0].distance_fitted else 1.0}
    assert found.law == "geometric"
    assert found.verdict is not None
    assert found.verdict.facts["apart"] == "the laws"
    assert "the f-numbers alone say" in str(found.verdict.facts["fits"])


def test_one_stop_tells_no_distance(one_length: list[FrameLattice]) -> None:
    alone = one_length[1:2]
    assert swept_distance(alone, MaskedOptics(SENSOR, MASK, "geometric", STATED_MM)) is None
    found = _calibrated(alone)
    assert _geometric(found).distance_sigma_mm is None
    assert found.verdict is not None
    assert found.verdict.facts["apart"] == "the laws, or scale and distance,"
    assert found.fits[0].mask_distance_mm == STATED_MM


def test_stops_told_in_the_wrong_order_tell_no_distance(one_length: list[FrameLattice]) -> None:
    told = [replace(one, f_number=n) for one, n in zip(one_length, reversed(STOPS), strict=True)]
    assert swept_distance(told, MaskedOptics(SENSOR, MASK, "geometric", STATED_MM)) is None


def test_focal_lengths_that_contradict_the_stops_leave_large_errors(one_length: list[FrameLattice]) -> None:
    """The lattice of a lens of 30 mm under the name of 60 mm: no distance does for both and for the stops."""
    shot = Shot(FILM, SMALL, 30.0, 22.0, distance_mm=0.93, turn_deg=1.3, finer=2)
    found = _calibrated([*one_length, _seen(shot, 60.0, 22.0)])
    sigma = _geometric(found).distance_sigma_mm
    assert sigma is not None
    assert sigma > 0.2
    assert {fit.mask_distance_mm for fit in found.fits} == {STATED_MM}
    assert not any(fit.distance_fitted for fit in found.fits)


@pytest.mark.long
@pytest.mark.parametrize("lengths", [(50.0,), (28.0, 85.0)])
def test_the_standard_errors_contain_the_truth(lengths: tuple[float, ...]) -> None:
    """Zooms rounded to a millimetre, stops 2 % off and of any shape, an exit pupil at the focal length or beyond."""
    off = []
    for seed in range(6):
        rng = np.random.default_rng([11, seed])
        film, distance = replace(FILM, scale=float(rng.uniform(0.99, 1.01))), float(rng.uniform(0.93, 1.12))
        stop = Stop(str(rng.choice(["round", "square", "polygon"])), int(rng.choice([5, 6, 7])))  # type: ignore[arg-type]  # one of its shapes
        all_stops, pupil = np.exp(rng.normal(0, 0.02)), float(rng.uniform(-8, 25))
        seen = []
        for length in lengths:
            true = length + float(rng.uniform(-0.5, 0.5))
            v = true + (pupil if len(lengths) > 1 else 0.0)
            for n in STOPS:
                shot = Shot(
                    film, SMALL, true, n * float(all_stops), distance_mm=distance, v_mm=v, stop=stop, seed=seed, finer=2
                )
                if n > 12 or length < 60:  # a long lens at f/11 may show nothing
                    seen.append(_seen(shot, length, n, 0.29))
        fit = _geometric(_calibrated(seen))
        assert fit.distance_sigma_mm is not None
        assert fit.print_scale_sigma is not None
        assert fit.distance_sigma_mm < 0.09
        off.append(
            ((fit.mask_distance_mm - distance) / fit.distance_sigma_mm,
             (fit.print_scale - film.scale) / fit.print_scale_sigma)
        )  # fmt: skip
    assert np.abs(off).max() < 3
    assert np.sqrt(np.mean(np.square(off))) < 1.3
