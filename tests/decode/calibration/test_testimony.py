"""Frames whose carriers, each too weak to overrule a calibration, contradict it together, summed ray by ray."""

from __future__ import annotations

from dataclasses import replace
from math import radians

import numpy as np
import pytest

from dappled.decode.calibration.calibration import Calibration
from dappled.decode.calibration.fit import CalibrationFrame, calibrate
from dappled.decode.decoder import MaskDecoder
from dappled.decode.optics import MaskedOptics
from dappled.findings import Code, Finding
from tests.decode.rays import FOCAL_MM, FULL_F, MASK, SENSOR, STATED_DISTANCE_MM, STOPPED_F, Camera, Texture

OPTICS = MaskedOptics(SENSOR, MASK, "geometric", STATED_DISTANCE_MM)


@pytest.fixture(scope="module")
def calibrated() -> tuple[Camera, Calibration]:
    camera = Camera.hidden(5)
    plane = camera.expose([(Texture.random(np.random.default_rng(1)), 0.0)], STOPPED_F)
    return camera, calibrate([CalibrationFrame(plane, FOCAL_MM, STOPPED_F)], OPTICS)


def _doubts(camera: Camera, known: Calibration, *, f_number: float) -> list[Finding]:
    """What is told of where the mask is, of a frame of two depths at a raw signal to noise of 50."""
    rng = np.random.default_rng(1)
    layers = [(Texture.random(rng, mean=0.2, rms=0.08, waves=60), shift) for shift in (1.4, -0.6)]
    plane = camera.expose(layers, f_number)
    plane = (plane + rng.normal(0, 0.008, plane.shape)).astype(np.float32)
    _, report = MaskDecoder(OPTICS, known, joint_views=False).decode_reported(
        plane, focal_length_mm=FOCAL_MM, f_number=f_number, views=False
    )
    return [one for one in report.doubts if one.code in (Code.CARRIERS_OFF_CALIBRATION, Code.MASK_TURNED)]


@pytest.mark.parametrize("stop", [1, 2])
def test_a_mask_as_calibrated_is_not_doubted(calibrated: tuple[Camera, Calibration], stop: float) -> None:
    assert _doubts(*calibrated, f_number=stop * FULL_F) == []


@pytest.mark.parametrize(("scale", "turn"), [(1.003, 0), (0.99, 0), (1, 0.7), (1, -3)])
def test_carriers_that_are_displaced_together_contradict_the_calibration(
    calibrated: tuple[Camera, Calibration], scale: float, turn: float
) -> None:
    camera, known = calibrated
    mask = replace(MASK, frequency_per_mm=scale * MASK.frequency_per_mm)
    other = replace(camera, mask=mask, rotation_rad=camera.rotation_rad - radians(turn))
    (told,) = _doubts(other, known, f_number=2 * FULL_F)
    assert told.code is Code.CARRIERS_OFF_CALIBRATION
    assert told.facts["off"] == pytest.approx(scale - 1, abs=4e-4)
    assert told.facts["turn_deg"] == pytest.approx(turn, abs=0.03)
