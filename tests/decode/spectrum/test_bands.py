from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from dappled.decode.errors import DecodeError
from dappled.decode.optics.carriers import Carrier
from dappled.decode.spectrum.equations import slice_at
from dappled.decode.spectrum.padded import Spectrum
from dappled.decode.spectrum.slices import extract

PLANE = np.random.default_rng(8).random((151, 203)).astype(np.float32)


@settings(max_examples=60, deadline=None)
@given(
    fy=st.floats(-0.49, 0.49),
    fx=st.floats(-0.49, 0.49),
    height=st.integers(2, 80),
    width=st.integers(2, 90),
    wrap=st.booleans(),
    mean=st.booleans(),
)
def test_slices_are_those_of_the_equation(
    *, fy: float, fx: float, height: int, width: int, wrap: bool, mean: bool
) -> None:
    spectrum = Spectrum.of(PLANE)
    carrier = Carrier(0, 0, 0.0, 0.0) if mean else Carrier(1, 2, fy, fx)
    found = extract(spectrum, [carrier], (height, width), wrap=wrap).values[0]
    expected = slice_at(PLANE, carrier, (height, width), level=spectrum.level, wrap=wrap)
    expected = expected[: found.shape[0], : found.shape[1]]
    assert np.abs(found - expected).max() < 1e-5 * max(np.abs(expected).max(), 1e-2)


@pytest.mark.parametrize("count", [1, 2, 3, 7])
@pytest.mark.parametrize("workers", [2, 3])
def test_any_number_of_workers_and_carriers_gives_the_same_bytes(count: int, workers: int) -> None:
    spectrum = Spectrum.of(PLANE)
    carriers = [Carrier(1, k, 0.03 * k, 0.21 - 0.06 * k) for k in range(count)]
    one, many = (extract(spectrum, carriers, (40, 60), workers=w).values for w in (1, workers))
    assert one.tobytes() == many.tobytes()


def test_columns_that_were_not_transformed_are_refused_before_anything_is_cut() -> None:
    spectrum = Spectrum.of(PLANE, largest_fx=0.2)
    with pytest.raises(DecodeError, match="not computed"):
        extract(spectrum, [Carrier(0, 0, 0.0, 0.0), Carrier(0, 1, 0.0, 0.3)], (20, 20))
