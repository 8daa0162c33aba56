from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from dappled.decode.optics.carriers import Carrier
from dappled.decode.spectrum.peaks import is_suspect, measure
from dappled.decode.spectrum.transform import Spectrum, transform

SHAPE = (150, 190)


def _wave(fy: float, fx: float, amplitude: float, phase: float, noise: float = 0.0) -> Spectrum:
    y, x = np.mgrid[0 : SHAPE[0], 0 : SHAPE[1]]
    plane = 0.5 + 2 * amplitude * np.cos(2 * np.pi * (fy * y + fx * x) + phase)
    plane += np.random.default_rng(0).normal(0, noise, SHAPE)
    return transform(plane.astype(np.float32))


@settings(max_examples=60, deadline=None)
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
