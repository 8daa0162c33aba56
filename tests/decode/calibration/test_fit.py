from __future__ import annotations

import math
from collections.abc import Callable
from itertools import pairwise

import numpy as np
import pytest

from dappled.decode.calibration.calibration import Calibration
from dappled.decode.calibration.fit import CalibrationFrame, calibrate
from dappled.decode.errors import DecodeError
from dappled.decode.lightfield.aperture import at_centre, at_corner, origin_of, transfer
from dappled.decode.optics import MaskedOptics
from dappled.decode.optics.carriers import Lattice, Mask, Pattern
from dappled.findings import Code
from tests.decode.rays import FOCAL_MM, MASK, SENSOR, STATED_DISTANCE_MM, STOPPED_F, Camera, Texture


def _calibrate(camera: Camera, seed: int = 0, noise: float = 0.0) -> Calibration:
    rng = np.random.default_rng(seed)
    plane = camera.expose([(Texture.random(rng), 1.0)], STOPPED_F)
    plane = (plane + rng.normal(0, noise, plane.shape)).astype(np.float32)
    return calibrate(
        [CalibrationFrame(plane, FOCAL_MM, STOPPED_F)],
        MaskedOptics(SENSOR, MASK, "geometric", STATED_DISTANCE_MM),
    )


@pytest.mark.parametrize("seed", [0, *(pytest.param(seed, marks=pytest.mark.slow) for seed in (1, 2))])
def test_a_stopped_down_frame_tells_all_that_is_hidden(seed: int) -> None:
    camera = Camera.hidden(seed)
    (fit,) = _calibrate(camera, seed, noise=0.4 / 50).fits
    off = (fit.lattice.matrix() - camera.lattice.matrix()) * SENSOR.shape
    orders = np.array(MASK.half_orders())
    assert np.sqrt(np.mean(((orders @ off) ** 2).sum(axis=1))) < 0.05  # bins rms over the carriers
    assert fit.found == 13
    assert not fit.distance_fitted  # at one focal length a print's scale would do as well
    assert fit.rotation_rad == pytest.approx(camera.rotation_rad, abs=2e-4)
    turns = np.array(camera.shift_mm) * MASK.frequency_per_mm - np.array(fit.origin)
    assert np.abs(turns - np.round(turns)).max() < 0.005
    strengths = [1.0 if order == (0, 0) else 0.5 if 0 in order else 0.25 for order in MASK.half_orders()]
    assert fit.transfer == pytest.approx(strengths, abs=0.02)


def test_a_calibration_survives_its_plain_values_and_scales_by_the_law() -> None:
    found = _calibrate(Camera.hidden(1))
    assert Calibration.from_dict(found.to_dict()) == found
    at_fit = found.lattice_at(FOCAL_MM)
    assert at_fit.matrix() == pytest.approx(found.fits[0].lattice.matrix(), abs=1e-12)
    distance = found.fits[0].mask_distance_mm
    longer = found.lattice_at(80.0).matrix() / at_fit.matrix()
    assert longer[1, 1] == pytest.approx((1 - distance / 80) / (1 - distance / FOCAL_MM), rel=1e-9)


def test_several_focal_lengths_are_interpolated() -> None:
    camera = Camera.hidden(2)
    base = _calibrate(camera).fits[0]
    frames = [
        CalibrationFrame(camera.expose([(Texture.random(np.random.default_rng(k)), 0.5)], STOPPED_F), f, STOPPED_F)
        for k, f in enumerate((50.0, 50.0, 60.0))
    ]
    found = calibrate(frames, MaskedOptics(SENSOR, MASK, "geometric", STATED_DISTANCE_MM))
    assert [f.focal_length_mm for f in found.fits] == [50.0, 60.0]
    assert found.fits[0].mask_distance_mm == pytest.approx(base.mask_distance_mm, rel=0.02)
    sizes = [found.lattice_at(f).kx[1] for f in (50.0, 55.0, 60.0)]
    assert all(abs(b / a - 1) < 1e-3 for a, b in pairwise(sizes))


def test_an_origin_is_found_among_negative_transfers() -> None:
    orders = MASK.half_orders()[1:]
    rng = np.random.default_rng(0)
    magnitudes = np.where(np.array([abs(a) + abs(b) for a, b in orders]) > 1, -0.2, 0.5) * rng.uniform(0.5, 1, 12)
    origin, rms = origin_of(orders, transfer(orders, magnitudes, (0.37, 0.81)))
    assert np.exp(2j * np.pi * np.array(origin)) == pytest.approx(np.exp(2j * np.pi * np.array([0.37, 0.81])), abs=1e-6)
    assert rms < 1e-6


def test_the_centre_and_the_corner_tell_the_same_phase() -> None:
    lattice = Lattice((0.15, 0.002), (-0.003, 0.16))
    there = at_centre((0.2, 0.4), lattice, SENSOR.shape)
    back = np.array(at_corner(there, lattice, SENSOR.shape)) - (0.2, 0.4)
    assert back == pytest.approx(np.round(back), abs=1e-9)


def test_bad_frames_and_files_are_refused_in_words() -> None:

    def attempt(*frames: CalibrationFrame, law: str = "geometric") -> None:
        calibrate(frames, MaskedOptics(SENSOR, MASK, law, STATED_DISTANCE_MM))

    noise = np.random.default_rng(0).normal(0.5, 0.1, SENSOR.shape).astype(np.float32)
    with pytest.raises(DecodeError, match=r"should stand out at f/59\.\d+ and no lattice of this mask does"):
        attempt(CalibrationFrame(noise, FOCAL_MM, STOPPED_F))
    with pytest.raises(DecodeError, match="at least one"):
        attempt()
    with pytest.raises(DecodeError, match="known are fd, geometric"):
        attempt(CalibrationFrame(noise, FOCAL_MM, STOPPED_F), law="none")
    with pytest.raises(DecodeError, match="calibration frame is"):
        attempt(CalibrationFrame(noise[:100], FOCAL_MM, STOPPED_F))
    good = _calibrate(Camera.hidden(1)).to_dict()
    for broken, words in (
        ({}, "not a calibration"),
        ({**good, "law": "none"}, "known are"),
        ({**good, "fits": []}, "transfer"),
        ({k: v for k, v in good.items() if k != "mask"}, "incomplete"),
    ):
        with pytest.raises(DecodeError, match=words):
            Calibration.from_dict(broken)


def test_a_mask_printed_at_another_size_keeps_the_stated_distance() -> None:
    camera = Camera(0.48, 0.01, (0.0, 0.0), mask=Mask(15.5 * 1.03, 2))
    (fit,) = _calibrate(camera).fits
    assert not fit.distance_fitted
    assert fit.mask_distance_mm == STATED_DISTANCE_MM
    assert math.hypot(*fit.lattice.kx) == pytest.approx(math.hypot(*camera.lattice.kx), rel=1e-4)


def _of_another_print(pattern: Pattern) -> tuple[Camera, Callable[[], Calibration]]:
    """A camera whose mask has 12.4 lines a millimetre, and a calibration that was told 15.5."""
    camera = Camera(0.48, 0.02, (0.004, 0.007), mask=Mask(12.4, 2, pattern))
    plane = camera.expose([(Texture.random(np.random.default_rng(3)), 1.0)], STOPPED_F)
    return camera, lambda: calibrate(
        [CalibrationFrame(plane, FOCAL_MM, STOPPED_F)],
        MaskedOptics(SENSOR, Mask(15.5, 2, pattern), "geometric", STATED_DISTANCE_MM),
    )


@pytest.mark.parametrize("pattern", ["full", "diagonal"])
def test_a_lattice_that_no_law_foresaw_is_found_and_called_so(pattern: Pattern) -> None:
    camera, calibration = _of_another_print(pattern)
    found = calibration()
    (fit,) = found.fits
    np.testing.assert_allclose(fit.lattice.matrix(), camera.lattice.matrix(), atol=1e-4)
    assert not fit.distance_fitted
    assert found.verdict is not None
    assert found.verdict.code is Code.LAW_NEITHER
    assert len(fit.seen) == len(found.mask.half_orders()) - 1


def test_the_other_law_s_frames_are_found_too() -> None:
    camera = Camera.hidden(4)
    plane = camera.expose([(Texture.random(np.random.default_rng(3)), 1.0)], STOPPED_F)
    for choose, law in ((False, "fd"), (True, "geometric")):
        found = calibrate(
            [CalibrationFrame(plane, FOCAL_MM, STOPPED_F)],
            MaskedOptics(SENSOR, MASK, "fd", STATED_DISTANCE_MM),
            choose_law=choose,
        )
        assert found.law == law
        np.testing.assert_allclose(found.lattice_at(FOCAL_MM).matrix(), camera.lattice.matrix(), atol=2e-5)
