from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from dappled.decode.errors import DecodeError
from dappled.decode.spectrum.linear_rows import Laid
from dappled.decode.spectrum.noise import noise_rms
from dappled.decode.spectrum.padded import Spectrum, hann, padded_shape

PLANE = np.random.default_rng(3).random((37, 45)).astype(np.float32)


def _whole(plane: np.ndarray) -> np.ndarray:
    return np.fft.fft2(plane - Laid(plane).level, padded_shape((plane.shape[0], plane.shape[1])))


@given(row=st.integers(-60, 60), column=st.integers(-70, 70), height=st.integers(1, 38), width=st.integers(1, 40))
def test_every_block_is_the_full_transforms(row: int, column: int, height: int, width: int) -> None:
    spectrum = Spectrum.of(PLANE)
    whole = _whole(PLANE)
    rows, columns = np.arange(row, row + height), np.arange(column, column + width)
    expected = whole[np.ix_(rows % whole.shape[0], columns % whole.shape[1])]
    np.testing.assert_allclose(spectrum.block(row, column, height, width), expected, atol=1e-3)


def test_beyond_nyquist_is_nothing_when_not_wrapped() -> None:
    spectrum = Spectrum.of(PLANE)
    high = spectrum.padded[0]
    block = spectrum.block(high // 2 - 2, 0, 6, 3, wrap=False)
    assert np.all(block[3:] == 0)
    assert np.all(block[:3] != 0)


def test_columns_that_were_not_computed_are_refused() -> None:
    spectrum = Spectrum.of(PLANE, largest_fx=0.2)
    assert spectrum.half.shape[1] < spectrum.padded[1] // 2
    with pytest.raises(DecodeError, match="not computed"):
        spectrum.block(0, 0, 4, spectrum.padded[1] // 2)


def test_reference_shape_is_padded_to_the_fast_one() -> None:
    assert padded_shape((2776, 3688)) == (2800, 3750)


def test_the_same_bytes_for_any_number_of_workers() -> None:
    plane = np.random.default_rng(4).random((331, 457)).astype(np.float32)
    one, three = Spectrum.of(plane, workers=1), Spectrum.of(plane, workers=3)
    assert one.half.tobytes() == three.half.tobytes()


def test_hann_is_the_window_in_the_pixels() -> None:
    size = 40
    plane = np.random.default_rng(5).random((size, size)).astype(np.float32)
    spectrum = Spectrum.of(plane)
    assert spectrum.padded == (size, size)
    window = 0.5 - 0.5 * np.cos(2 * np.pi * np.arange(size) / size)
    expected = np.fft.fft2((plane - Laid(plane).level) * np.outer(window, window))
    np.testing.assert_allclose(hann(spectrum.block(4, 4, 7, 7)), expected[5:10, 5:10], atol=1e-3)


@pytest.mark.parametrize("sigma", [0.001, 0.02])
def test_noise_is_measured_beside_a_picture(sigma: float) -> None:
    rng = np.random.default_rng(6)
    y, x = np.mgrid[0:300, 0:400]
    picture = 0.5 + 0.3 * np.sin(2 * np.pi * (0.013 * y + 0.031 * x)) + 0.1 * np.cos(2 * np.pi * 0.16 * x)
    plane = (picture + rng.normal(0, sigma, picture.shape)).astype(np.float32)
    assert noise_rms(Spectrum.of(plane)) == pytest.approx(sigma, rel=0.1)
