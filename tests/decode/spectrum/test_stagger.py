from __future__ import annotations

import numpy as np
import pytest

from dappled.decode.optics.carriers import Carrier, Sensor
from dappled.decode.spectrum.peaks import measure
from dappled.decode.spectrum.plane import spread
from dappled.decode.spectrum.transform import transform


def _sampled(fy: float, fx: float, shape: tuple[int, int]) -> np.ndarray:
    """A wave of amplitude 0.1 around 0.5 at the staggered samples, frequencies in rows and half columns."""
    row, column = np.mgrid[0 : shape[0], 0 : shape[1]]
    return np.asarray(0.5 + 0.1 * np.cos(2 * np.pi * (fy * row + fx * (2 * column + row % 2))), dtype=np.float32)


def test_samples_go_where_they_were_taken_and_the_mean_stays() -> None:
    plane = np.arange(12, dtype=np.float32).reshape(4, 3)
    wide = spread(plane)
    assert wide.shape == (4, 6)
    np.testing.assert_array_equal(wide[0], [0, 0, 2, 0, 4, 0])
    np.testing.assert_array_equal(wide[1], [0, 6, 0, 8, 0, 10])
    assert wide.mean() == plane.mean()


def test_a_wave_has_one_peak_and_its_repetition_beyond_the_diamond() -> None:
    fy, fx, shape = 0.11, 0.153, (240, 150)
    rough = transform(_sampled(fy, fx, shape))
    fine = transform(spread(_sampled(fy, fx, shape)))
    near, mirrored = Carrier(1, 1, fy, fx), Carrier(1, 1, 0.5 - fy, 0.5 - fx)
    for carrier in (near, mirrored):
        (found,) = measure(fine, [Carrier(1, 1, carrier.fy, carrier.fx)], 2.0)
        assert found is not None
        assert found.strength == pytest.approx(0.1, rel=0.05)
    # Read as a rectangle the wave keeps a share of its strength, and its twin stands half the rows' spectrum away.
    (kept,) = measure(rough, [Carrier(1, 1, fy, 2 * fx)], 2.0)
    (twin,) = measure(rough, [Carrier(1, 1, fy - 0.5, 2 * fx)], 2.0)
    assert kept is not None
    assert twin is not None
    assert twin.strength > 0.04
    inner = [Carrier(1, 1, fy - 0.5, fx)]
    assert measure(fine, inner, 2.0) == [None]


def test_the_sensor_of_a_spread_plane_has_half_columns() -> None:
    wide = Sensor((2918, 1852), (0.0015, 0.0), (0.0, 0.003)).spread()
    assert wide == Sensor((2918, 3704), (0.0015, 0.0), (0.0, 0.0015))
