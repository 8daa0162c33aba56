from __future__ import annotations

import math

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from dappled.decode.optics.carriers import Carrier, Lattice, Mask, Sensor, fd, geometric

S5200 = Sensor((2776, 3688), (4.29 / 2776, 0.0), (0.0, 5.76 / 3688))


def test_geometric_law_puts_the_reference_camera_at_566_bins() -> None:
    sensor = Sensor((2776, 3688), (0.01, 0.0), (0.0, 0.01))
    lattice = geometric(Mask(15.5, 2), sensor, 0.48, 50.0)
    assert lattice.kx[1] * 3688 == pytest.approx(566.15, abs=0.1)
    assert lattice.ky[0] * 2776 == pytest.approx(426.15, abs=0.1)


def test_thesis_law_is_inverse_in_focal_length_and_anisotropic_in_cycles() -> None:
    mask = Mask(113.8 / 20, 2)  # Mask 2
    short, long = fd(mask, S5200, 1.01, 13.0), fd(mask, S5200, 1.01, 26.0)
    assert short.kx[1] == pytest.approx(2 * long.kx[1])
    assert short.kx[1] * 3688 == pytest.approx(113.8 / 20 * 1.01 / 13 * 3688 / 5.76, rel=1e-9)
    assert short.ky[0] * 2776 == pytest.approx(113.8 / 20 * 1.01 / 13 * 2776 / 4.29, rel=1e-9)


@given(angle=st.floats(-0.5, 0.5), ky=st.integers(-4, 4), kx=st.integers(-4, 4))
def test_rotation_keeps_lengths_and_adds_up(angle: float, ky: int, kx: int) -> None:
    lattice = Lattice((0.1, 0.0), (0.0, 0.1))
    (there,) = lattice.rotated(angle).carriers([(ky, kx)])
    assert math.hypot(there.fy, there.fx) == pytest.approx(0.1 * math.hypot(ky, kx), abs=1e-12)
    back = lattice.rotated(angle).rotated(-angle)
    assert back.matrix() == pytest.approx(lattice.matrix(), abs=1e-12)


def test_indices_count_from_the_centre_and_edges_are_off_the_sensor() -> None:
    assert Carrier(1, 1, 0.25, -0.5).index((100, 101)) == (75.0, -0.5)
    assert not Carrier(1, 1, 0.25, -0.5).on_sensor
    assert Carrier(1, 1, 0.25, -0.49).on_sensor


@given(
    p=st.integers(1, 4), harmonics=st.sampled_from(["linear", "octave"]), pattern=st.sampled_from(["full", "diagonal"])
)
def test_half_orders_and_their_conjugates_are_all_orders(p: int, harmonics: str, pattern: str) -> None:
    mask = Mask(1.0, p, pattern, harmonics)  # type: ignore[arg-type]  # the literals, drawn
    half = mask.half_orders()
    assert half[0] == (0, 0)
    both = {*half, *((-ky, -kx) for ky, kx in half)}
    assert both == set(mask.orders())
    assert len(mask.orders()) == ((2 * p + 1) ** 2 if pattern == "full" else 4 * p + 1)
    assert np.all(np.array(half) @ np.array([1000, 1]) >= 0)
