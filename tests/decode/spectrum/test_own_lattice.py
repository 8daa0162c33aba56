"""Masks that don't stand where they were said to: found where a frame shows them, and never where there is none."""

from __future__ import annotations

from dataclasses import replace
from functools import cache

import numpy as np
import pytest

from dappled.decode.decoder import MaskDecoder
from dappled.decode.optics.carriers import Carrier, Mask
from dappled.decode.spectrum.peaks import farther_lattice, stretch
from dappled.decode.spectrum.transform import transform
from tests.decode.rays import FOCAL_MM, FULL_F, MASK, SENSOR, STATED_DISTANCE_MM, STOPPED_F, Camera, Plane, Texture

DIAGONAL = Mask(15.5, 2, "diagonal")
TURNED = 0.03


def _told(off: float, mask: Mask = MASK) -> MaskDecoder:
    """A decoder whose prediction lies `off` of a carrier's frequency farther in than the carriers."""
    pitch = 0.01 / (1 + off)
    return MaskDecoder(replace(SENSOR, row_mm=(pitch, 0), column_mm=(0, pitch)), mask, "geometric", STATED_DISTANCE_MM)


@cache
def _frame(mask: Mask = MASK, f_number: float = STOPPED_F) -> tuple[Camera, Plane]:
    rng = np.random.default_rng(3)
    camera = Camera(STATED_DISTANCE_MM, TURNED, (0.01, 0.02), mask=mask)
    plane = camera.expose([(Texture.random(rng), 1.0)], f_number)
    return camera, (plane + rng.normal(0, plane.mean() / 50, plane.shape)).astype(np.float32)


@pytest.mark.parametrize("mask", [MASK, DIAGONAL], ids=["full", "diagonal"])
@pytest.mark.parametrize("off", [-0.1, -0.07, 0.07, 0.1])
def test_a_mask_a_tenth_off_is_found_and_its_place_is_doubted(off: float, mask: Mask) -> None:
    camera, plane = _frame(mask)
    field, report = _told(off, mask).decode_reported(plane, focal_length_mm=FOCAL_MM, f_number=STOPPED_F)
    assert (report.carriers_from, report.views_from) == ("measured", "frame")
    true = camera.lattice.carriers([(c.ky, c.kx) for c in report.used])
    away = (field.carriers[:, 2:] - [(c.fy, c.fx) for c in true]) * SENSOR.shape
    assert np.sqrt((away**2).sum(axis=1).mean()) < 0.1
    assert stretch(report.used, report.predicted) == pytest.approx(off, abs=0.002)
    assert report.doubt is not None
    assert f"{abs(off):.1%} farther {'out' if off > 0 else 'in'} than predicted" in report.doubt


@pytest.mark.parametrize("off", [-0.02, 0.0, 0.02])
def test_a_mask_near_its_place_is_not_doubted(off: float) -> None:
    _, report = _told(off).decode_reported(_frame()[1], focal_length_mm=FOCAL_MM, f_number=STOPPED_F)
    assert (report.carriers_from, report.doubt) == ("measured", None)


@pytest.mark.parametrize("off", [-0.1, 0.0, 0.1])
def test_at_the_ideal_aperture_nothing_is_taken_for_carriers(off: float) -> None:
    _, report = _told(off).decode_reported(_frame(f_number=FULL_F)[1], focal_length_mm=FOCAL_MM, f_number=FULL_F)
    assert (report.carriers_from, report.doubt) == ("predicted", None)


@pytest.mark.parametrize("seed", range(8))
def test_a_scene_without_a_mask_shows_no_lattice_however_regular_its_things_are(seed: int) -> None:
    """Fences, roofs and rows of crops near the carriers' own periods, each its own way, over parts of the frame."""
    rng = np.random.default_rng(seed)
    rows, columns = np.mgrid[: SENSOR.shape[0], : SENSOR.shape[1]].astype(np.float64)
    plane = Texture.random(rng).at(rows[:, 0], columns[0])
    predicted = _told(0.0).predict(FOCAL_MM)
    near: list[Carrier] = [c for c in predicted if max(abs(c.ky), abs(c.kx)) == 1]
    for c in near:
        fy, fx = np.array((c.fy, c.fx)) * rng.uniform(0.9, 1.1) + rng.normal(0, 0.004, 2)
        top, left = rng.integers(0, 150, 2)
        for harmonic in (1, 2):
            wave = np.cos(2 * np.pi * harmonic * (fy * rows + fx * columns))
            plane[top : top + 150, left : left + 200] += (0.1 / harmonic * wave)[top : top + 150, left : left + 200]
    noisy = (plane + rng.normal(0, 0.01, plane.shape)).astype(np.float32)
    assert farther_lattice(transform(noisy), predicted) is None


def test_a_stretch_is_counted_over_the_carriers_that_both_have() -> None:
    def carriers(scale: float) -> list[Carrier]:
        return [Carrier(0, 0, 0.0, 0.0), Carrier(0, 1, 0.0, 0.1 * scale), Carrier(1, 0, 0.2 * scale, 0.0)]

    assert stretch(carriers(1.1), carriers(1.0)) == pytest.approx(0.1)
    assert stretch(carriers(1.1)[:2], carriers(1.0)) == pytest.approx(0.1)
    assert stretch(carriers(1.1)[:1], carriers(1.0)) == 0.0
