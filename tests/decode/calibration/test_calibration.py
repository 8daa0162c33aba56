"""A mask that moved or turned since its calibration, on frames summed ray by ray (`rays`)."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from dappled.decode.calibration.calibration import Calibration, _shift
from dappled.decode.calibration.fit import CalibrationFrame, calibrate
from dappled.decode.decoder import DecodeReport, MaskDecoder
from dappled.decode.optics import MaskedOptics
from dappled.findings import Code, Finding
from tests.decode.rays import FOCAL_MM, FULL_F, MASK, SENSOR, STATED_DISTANCE_MM, STOPPED_F, Camera, Texture

FLOWN_F = 1.15 * FULL_F


@pytest.fixture(scope="module")
def calibrated() -> tuple[Camera, Calibration]:
    camera = Camera.hidden(5)
    plane = camera.expose([(Texture.random(np.random.default_rng(1)), 0.0)], STOPPED_F)
    found = calibrate(
        [CalibrationFrame(plane, FOCAL_MM, STOPPED_F)],
        MaskedOptics(SENSOR, MASK, "geometric", STATED_DISTANCE_MM),
    )
    return camera, found


def _reported(camera: Camera, known: Calibration, seed: int = 7, f_number: float = FLOWN_F) -> DecodeReport:
    rng = np.random.default_rng(seed)
    layers = [(Texture.random(rng, waves=60), 1.4), (Texture.random(rng, waves=60), -0.6)]
    plane = camera.expose(layers, f_number)
    plane = (plane + rng.normal(0, 0.008, plane.shape)).astype(np.float32)
    decoder = MaskDecoder(
        MaskedOptics(SENSOR, MASK, "geometric", STATED_DISTANCE_MM), calibration=known, joint_views=False
    )
    return decoder.decode_reported(plane, focal_length_mm=FOCAL_MM, f_number=f_number)[1]


def _doubt(camera: Camera, known: Calibration, seed: int = 7, f_number: float = FLOWN_F) -> list[Finding]:
    report = _reported(camera, known, seed, f_number)
    return [one for one in report.doubts if one.code in (Code.MASK_SHIFTED, Code.MASK_TURNED, Code.MASK_TURNED_FARTHER)]


@pytest.mark.parametrize("seed", [7, 8])
def test_a_mask_in_its_place_is_not_doubted(calibrated: tuple[Camera, Calibration], seed: int) -> None:
    assert _doubt(*calibrated, seed) == []


def test_a_mask_that_moved_is_doubted_with_its_distance(calibrated: tuple[Camera, Calibration]) -> None:
    camera, known = calibrated
    y, x = camera.shift_mm
    told, *_ = _doubt(replace(camera, shift_mm=(y + 0.010, x - 0.0125)), known)
    assert told.code is Code.MASK_SHIFTED
    assert told.facts["by_um"] == pytest.approx(16, abs=1.5)


def test_a_turn_at_the_edge_of_the_search_is_told_as_the_least(calibrated: tuple[Camera, Calibration]) -> None:
    camera, known = calibrated
    (told,) = _doubt(replace(camera, rotation_rad=camera.rotation_rad + np.radians(0.6)), known)
    assert told.code is Code.MASK_TURNED_FARTHER
    assert told.facts["by_deg"] == pytest.approx(0.4, abs=0.02)


@pytest.mark.parametrize("turned_deg", [0.2, 0.3])
def test_a_mask_that_turned_is_decoded_where_its_carriers_stand(
    calibrated: tuple[Camera, Calibration], turned_deg: float
) -> None:
    camera, known = calibrated
    still, turned = (
        _reported(replace(camera, rotation_rad=camera.rotation_rad + np.radians(deg)), known) for deg in (0, turned_deg)
    )
    assert (still.carriers_from, turned.carriers_from) == ("calibrated", "measured")
    assert turned.doubts == ()
    order = next(k for k, one in enumerate(still.used) if (one.ky, one.kx) == (0, 1))
    angles = [np.degrees(np.arctan2(one.used[order].fy, one.used[order].fx)) for one in (still, turned)]
    assert angles[0] - angles[1] == pytest.approx(turned_deg, abs=0.015)


@pytest.mark.parametrize("moved", [(0.05, 0.05), (0.06, 0.03), (-0.05, 0.1)])
@pytest.mark.parametrize("seed", range(5))
def test_of_the_moves_that_look_alike_on_a_diagonal_mask_the_least_is_told(
    moved: tuple[float, float], seed: int
) -> None:
    assert _shift_of(moved, seed) == pytest.approx(moved, abs=0.02)


@pytest.mark.parametrize("seed", range(5))
def test_a_diagonal_mask_that_hardly_moved_is_not_a_quarter_of_a_period_off(seed: int) -> None:
    assert _shift_of((0.014, 0.010), seed) == (0.0, 0.0)


def _shift_of(moved: tuple[float, float], seed: int) -> tuple[float, float]:
    """What 48 blocks of a frame with little noise say of a diagonal mask's move."""
    k = np.array([(1, 1), (1, -1), (2, 2), (2, -2)], dtype=np.float64)
    noise = np.random.default_rng(seed).normal(0, 1e-4, (48, len(k), 2)) @ (1, 1j)
    return _shift(np.exp(2j * np.pi * k @ moved) / 48 + noise, np.full((48, 1), 1 / 48), k, np.full(len(k), 1e-6))


def test_where_the_stop_averages_all_carriers_away_nothing_is_said(calibrated: tuple[Camera, Calibration]) -> None:
    """Beams an exact period of the mask apart: the only light that is left around a carrier is parallax."""
    camera, known = calibrated
    y, x = camera.shift_mm
    ideal = MASK.frequency_per_mm * camera.distance_mm  # the f-number at which κ is 1
    assert _doubt(replace(camera, shift_mm=(y + 0.010, x - 0.0125)), known, f_number=ideal) == []
