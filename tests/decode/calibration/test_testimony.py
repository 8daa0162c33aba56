"""Frames whose carriers, each too weak to overrule a calibration, contradict it together, summed ray by ray."""

from __future__ import annotations

from dataclasses import replace
from math import radians

import numpy as np
import pytest
from numpy.typing import NDArray

from dappled.decode.calibration.calibration import Calibration
from dappled.decode.calibration.fit import CalibrationFrame, calibrate
from dappled.decode.decoder import DecodeReport, MaskDecoder
from dappled.decode.lightfield.light_field import LightField
from dappled.decode.optics import MaskedOptics
from tests.decode.rays import FOCAL_MM, FULL_F, MASK, SENSOR, STATED_DISTANCE_MM, STOPPED_F, Camera, Texture, psnr

Views = NDArray[np.float64]
OPTICS = MaskedOptics(SENSOR, MASK, "geometric", STATED_DISTANCE_MM)


@pytest.fixture(scope="module")
def calibrated() -> tuple[Camera, Calibration]:
    camera = Camera.hidden(5)
    plane = camera.expose([(Texture.random(np.random.default_rng(1)), 0.0)], STOPPED_F)
    return camera, calibrate([CalibrationFrame(plane, FOCAL_MM, STOPPED_F)], OPTICS)


def _decoded(camera: Camera, known: Calibration, *, f_number: float) -> tuple[LightField, DecodeReport, Views]:
    """A frame of two depths at a raw signal to noise of 100, and its true views."""
    rng = np.random.default_rng(1)
    layers = [(Texture.random(rng, mean=0.2, rms=0.08, waves=60), shift) for shift in (1.4, -0.6)]
    plane = camera.expose(layers, f_number)
    plane = (plane + rng.normal(0, 0.004, plane.shape)).astype(np.float32)
    decoder = MaskDecoder(OPTICS, known, joint_views=False)
    field, report = decoder.decode_reported(plane, focal_length_mm=FOCAL_MM, f_number=f_number)
    return field, report, camera.truth(layers, field.grid, (field.views.shape[2], field.views.shape[3]), f_number)


@pytest.mark.parametrize("stop", [1, 2])
def test_a_mask_as_calibrated_stays_where_it_was(calibrated: tuple[Camera, Calibration], stop: float) -> None:
    _, report, _ = _decoded(*calibrated, f_number=stop * FULL_F)
    assert (report.carriers_from, report.doubts) == ("calibrated", ())


@pytest.mark.parametrize(("scale", "turn"), [(1.003, 0), (0.99, 0), (1, 0.7), (1, -3)])
def test_slices_are_cut_where_weak_carriers_stand_together(
    calibrated: tuple[Camera, Calibration], scale: float, turn: float
) -> None:
    camera, known = calibrated
    mask = replace(MASK, frequency_per_mm=scale * MASK.frequency_per_mm)
    other = replace(camera, mask=mask, rotation_rad=camera.rotation_rad - radians(turn))
    field, report, truth = _decoded(other, known, f_number=2 * FULL_F)
    assert (report.carriers_from, report.doubts) == ("measured", ())
    assert psnr(field.views, truth) > psnr(np.broadcast_to(truth.mean(axis=(0, 1)), truth.shape), truth) + 3
    true = other.lattice.carriers([(c.ky, c.kx) for c in report.used])
    off = [
        np.hypot((a.fy - b.fy) * SENSOR.shape[0], (a.fx - b.fx) * SENSOR.shape[1])
        for a, b in zip(report.used, true, strict=True)
    ]
    assert max(off) < 0.1
