"""Frames without a mask, or without a scene, decoded by a calibration, summed ray by ray."""

from __future__ import annotations

from dataclasses import dataclass, replace
from math import radians

import numpy as np
import pytest
from numpy.typing import NDArray

from dappled.decode.calibration.calibration import Calibration
from dappled.decode.calibration.fit import CalibrationFrame, calibrate
from dappled.decode.decoder import MaskDecoder
from dappled.decode.optics import MaskedOptics
from dappled.decode.optics.carriers import Sensor
from dappled.findings import Code, Finding
from tests.decode.rays import FOCAL_MM, FULL_F, MASK, STATED_DISTANCE_MM, STOPPED_F, Camera, Texture

SENSOR = Sensor((460, 600), (0.01, 0.0), (0.0, 0.01))
OPTICS = MaskedOptics(SENSOR, MASK, "geometric", STATED_DISTANCE_MM)


@dataclass(frozen=True)
class Bare(Camera):
    """The camera without its mask."""

    def _transmission(self, y: NDArray[np.float64], x: NDArray[np.float64]) -> NDArray[np.float64]:
        return np.ones((y.size, x.size))


@pytest.fixture(scope="module")
def calibrated() -> tuple[Camera, Calibration]:
    camera = replace(Camera.hidden(5), sensor=SENSOR)
    plane = camera.expose([(Texture.random(np.random.default_rng(1)), 0.0)], STOPPED_F)
    return camera, calibrate([CalibrationFrame(plane, FOCAL_MM, STOPPED_F)], OPTICS)


def _doubts(camera: Camera, known: Calibration, *, views: bool = True) -> tuple[Finding, ...]:
    rng = np.random.default_rng(3)
    layers = [(Texture.random(rng, mean=0.2, rms=0.08, waves=60), shift) for shift in (1.4, -0.6)]
    plane = camera.expose(layers)
    plane = (plane + rng.normal(0, 0.004, plane.shape)).astype(np.float32)
    decoder = MaskDecoder(OPTICS, known)
    return decoder.decode_reported(plane, focal_length_mm=FOCAL_MM, f_number=FULL_F, views=views)[1].doubts


@pytest.mark.slow
@pytest.mark.parametrize("views", [True, False], ids=["with views", "as in flight"])
def test_a_frame_with_its_mask_is_right_and_one_without_is_in_doubt(
    calibrated: tuple[Camera, Calibration], views: bool
) -> None:
    camera, known = calibrated
    assert _doubts(camera, known, views=views) == ()
    bare = Bare(camera.distance_mm, camera.rotation_rad, camera.shift_mm, sensor=SENSOR)
    (told,) = _doubts(bare, known, views=views)
    assert told.code is Code.MASK_UNSEEN


@pytest.mark.slow
def test_a_turn_is_searched_as_far_as_it_goes(calibrated: tuple[Camera, Calibration]) -> None:
    camera, known = calibrated
    told, *others = _doubts(replace(camera, rotation_rad=camera.rotation_rad + radians(0.6)), known)
    assert told.code is Code.MASK_TURNED
    assert {one.code for one in others} <= {Code.VIEWS_CONTRADICTED}  # they are made where the mask was
    assert told.facts["by_deg"] == pytest.approx(0.6, abs=0.03)


def test_a_frame_of_noise_is_in_doubt(calibrated: tuple[Camera, Calibration]) -> None:
    _, known = calibrated
    plane = np.random.default_rng(0).uniform(0, 1, SENSOR.shape).astype(np.float32)
    decoder = MaskDecoder(OPTICS, known, joint_views=False)
    _, report = decoder.decode_reported(plane, focal_length_mm=FOCAL_MM, f_number=FULL_F)
    assert [one.code for one in report.doubts] == [Code.FRAME_ONLY_NOISE]
