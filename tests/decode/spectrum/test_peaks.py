from __future__ import annotations

from dataclasses import replace
from functools import cache

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from dappled.decode.decoder import MaskDecoder
from dappled.decode.optics import MaskedOptics
from dappled.decode.optics.carriers import Carrier, Mask
from dappled.decode.spectrum.peaks import farther_lattice, is_suspect, measure, stretch
from dappled.decode.spectrum.transform import Spectrum, transform
from dappled.findings import Code
from tests.decode.rays import FOCAL_MM, FULL_F, MASK, SENSOR, STATED_DISTANCE_MM, STOPPED_F, Camera, Plane, Texture

SHAPE = (150, 190)


def _wave(fy: float, fx: float, amplitude: float, phase: float, noise: float = 0.0) -> Spectrum:
    y, x = np.mgrid[0 : SHAPE[0], 0 : SHAPE[1]]
    plane = 0.5 + 2 * amplitude * np.cos(2 * np.pi * (fy * y + fx * x) + phase)
    plane += np.random.default_rng(0).normal(0, noise, SHAPE)
    return transform(plane.astype(np.float32))


@given(
    fy=st.floats(-0.45, 0.45),
    fx=st.floats(-0.45, 0.45),
    phase=st.floats(-3.1, 3.1),
    amplitude=st.floats(0.02, 0.2),
)
def test_frequency_strength_and_phase_of_a_sinusoid(fy: float, fx: float, phase: float, amplitude: float) -> None:
    if np.hypot(fy * SHAPE[0], fx * SHAPE[1]) < 9 or abs(fx) * SHAPE[1] < 4 or abs(fx) * SHAPE[1] > SHAPE[1] / 2 - 4:
        return  # too near to its own conjugate
    spectrum = _wave(fy, fx, amplitude, phase)
    (found,) = measure(spectrum, [Carrier(1, 1, fy + 1.3 / SHAPE[0], fx - 0.8 / SHAPE[1])], 3.0)
    assert found is not None
    assert found.fy * SHAPE[0] == pytest.approx(fy * SHAPE[0], abs=0.02)
    assert found.fx * SHAPE[1] == pytest.approx(fx * SHAPE[1], abs=0.02)
    assert found.strength == pytest.approx(amplitude / 0.5, rel=0.03)
    assert np.angle(np.exp(1j * (found.phase_rad - phase))) == pytest.approx(0, abs=0.1)


def test_the_phase_pattern_knows_a_sinusoid_between_bins() -> None:
    high, wide = transform(np.random.default_rng(1).random(SHAPE).astype(np.float32)).padded
    fy, fx = 30.4 / high, 41.5 / wide
    (found,) = measure(_wave(fy, fx, 0.1, 1.0), [Carrier(1, 1, fy, fx)], 2.0)
    assert found is not None
    assert found.phase_pattern > 0.95


def test_noise_and_texture_without_a_carrier_are_not_there() -> None:
    rng = np.random.default_rng(2)
    spectrum = transform(rng.normal(0.5, 0.1, SHAPE).astype(np.float32))
    places = [Carrier(k, 1, *rng.uniform(0.05, 0.45, 2)) for k in range(100)]
    assert measure(spectrum, places, 4.0) == [None] * 100


def test_the_mean_is_there_and_off_the_sensor_is_not() -> None:
    spectrum = _wave(0.2, 0.2, 0.1, 0.0)
    mean, off = measure(spectrum, [Carrier(0, 0, 0.0, 0.0), Carrier(5, 5, 0.6, 0.2)], 2.0)
    assert mean is not None
    assert mean.strength == 1.0
    assert off is None


@pytest.mark.parametrize(
    ("fy", "fx", "suspect"),
    [
        (0.0, 1 / 6, True),
        (0.25, 0.0, True),
        (0.5, -1 / 3, True),
        (0.125, 0.125, True),
        (0.0, 0.0, False),
        (0.1, 1 / 3, False),
        (0.0, 1 / 6 + 2 / 3688, False),
    ],
)
def test_simple_fractions_of_the_sampling_are_suspect(fy: float, fx: float, suspect: bool) -> None:
    assert is_suspect(fy, fx, (2776, 3688)) is suspect


DIAGONAL = Mask(15.5, 2, "diagonal")
TURNED = 0.03


def _told(off: float, mask: Mask = MASK) -> MaskDecoder:
    """A decoder whose prediction lies `off` of a carrier's frequency farther in than the carriers."""
    pitch = 0.01 / (1 + off)
    sensor = replace(SENSOR, row_mm=(pitch, 0), column_mm=(0, pitch))
    return MaskDecoder(
        MaskedOptics(sensor, mask, "geometric", STATED_DISTANCE_MM), joint_views=False
    )  # nothing is told of views here


@cache
def _frame(mask: Mask = MASK, f_number: float = STOPPED_F) -> tuple[Camera, Plane]:
    rng = np.random.default_rng(3)
    camera = Camera(STATED_DISTANCE_MM, TURNED, (0.01, 0.02), mask=mask)
    plane = camera.expose([(Texture.random(rng), 1.0)], f_number)
    return camera, (plane + rng.normal(0, plane.mean() / 50, plane.shape)).astype(np.float32)


@pytest.mark.parametrize(("off", "mask"), [(-0.1, MASK), (-0.07, DIAGONAL), (0.07, MASK), (0.1, DIAGONAL)])
def test_a_mask_a_tenth_off_is_found_and_its_place_is_doubted(off: float, mask: Mask) -> None:
    camera, plane = _frame(mask)
    field, report = _told(off, mask).decode_reported(plane, focal_length_mm=FOCAL_MM, f_number=STOPPED_F)
    assert (report.carriers_from, report.views_from) == ("measured", "frame")
    true = camera.lattice.carriers([(c.ky, c.kx) for c in report.used])
    away = (field.carriers[:, 2:] - [(c.fy, c.fx) for c in true]) * SENSOR.shape
    assert np.sqrt((away**2).sum(axis=1).mean()) < 0.1
    assert stretch(report.used, report.predicted) == pytest.approx(off, abs=0.002)
    (doubt,) = report.doubts
    assert doubt.code is Code.CARRIERS_DISPLACED
    assert doubt.facts["off"] == pytest.approx(off, abs=0.002)


@pytest.mark.parametrize("off", [-0.02, 0.0, 0.02])
def test_a_mask_near_its_place_is_not_doubted(off: float) -> None:
    _, report = _told(off).decode_reported(_frame()[1], focal_length_mm=FOCAL_MM, f_number=STOPPED_F)
    assert (report.carriers_from, report.doubts) == ("measured", ())


@pytest.mark.parametrize("off", [-0.1, 0.0, 0.1])
def test_at_the_ideal_aperture_nothing_is_taken_for_carriers(off: float) -> None:
    _, report = _told(off).decode_reported(_frame(f_number=FULL_F)[1], focal_length_mm=FOCAL_MM, f_number=FULL_F)
    assert (report.carriers_from, report.doubts) == ("predicted", ())


@pytest.mark.parametrize("seed", range(8))
def test_a_scene_without_a_mask_shows_no_lattice_however_regular_its_things_are(seed: int) -> None:
    """Fences, roofs and rows of crops near the carriers' own periods, each its own way, over parts of the frame."""
    rng = np.random.default_rng(seed)
    rows, columns = np.mgrid[: SENSOR.shape[0], : SENSOR.shape[1]].astype(np.float64)
    plane = Texture.random(rng).on(rows[:, 0], columns[0])(0.0, 0.0)
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
