from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from dappled.decode.errors import DecodeError
from dappled.decode.spectrum.lineariser import ArraySource, lineariser
from dappled.decode.spectrum.transform import SpectrumBuffers, hann, noise_rms, padded_shape, transform
from tests.decode.spectrum.equations import padded_plane

MOSAIC = np.random.default_rng(7).integers(200, 3500, (197, 251), dtype=np.uint16)
BAYER = np.array([[0, 1], [1, 2]])


@pytest.mark.parametrize("largest_fx", [0.05, 0.2, 0.5])
def test_developing_while_transforming_is_developing_first(largest_fx: float) -> None:
    linear = lineariser(MOSAIC.shape, black=100, white=4095, cfa=BAYER, reference=(1,)).apply(MOSAIC)
    plane = linear.plane()
    for source in (linear, plane):
        spectrum = transform(source, largest_fx=largest_fx)
        whole = np.fft.rfft2(padded_plane(plane, spectrum.level))[:, : spectrum.columns]
        off = np.abs(spectrum.half - whole)
        off[0, 0] = 0  # the mean: below
        assert off.max() < 1e-5 * np.abs(whole).max()
        assert spectrum.columns == min(whole.shape[1], int(np.ceil(largest_fx * spectrum.padded[1])) + 2)
        assert spectrum.mean == pytest.approx(float(plane.mean(dtype=np.float64)), rel=1e-5)


def test_a_used_buffer_leaves_nothing_behind() -> None:
    plane = np.random.default_rng(1).random((90, 130)).astype(np.float32)
    with SpectrumBuffers().lend((90, 130)) as used:
        transform(plane * 5, tiles=used)
        transform(plane, tiles=used, largest_fx=0.1)
        again = transform(plane, tiles=used).half
    assert again.tobytes() == transform(plane, workers=3).half.tobytes()


@pytest.mark.parametrize("value", [np.nan, np.inf, -np.inf])
def test_one_pixel_that_is_no_number_is_told(value: float) -> None:
    plane = np.random.default_rng(1).random((90, 130)).astype(np.float32)
    plane[71, 33] = value
    with pytest.raises(DecodeError, match="NaN or infinite"), np.errstate(invalid="ignore"):
        transform(plane)


def test_an_array_with_three_axes_is_refused() -> None:
    with pytest.raises(DecodeError, match="two axes"):
        transform(np.zeros((90, 131, 3), dtype=np.float32))


PLANE = np.random.default_rng(3).random((37, 45)).astype(np.float32)


def _whole(plane: np.ndarray) -> np.ndarray:
    return np.fft.fft2(plane - ArraySource(plane).level, padded_shape((plane.shape[0], plane.shape[1])))


@given(row=st.integers(-60, 60), column=st.integers(-70, 70), height=st.integers(1, 38), width=st.integers(1, 40))
def test_every_block_is_the_full_transforms(row: int, column: int, height: int, width: int) -> None:
    spectrum = transform(PLANE)
    whole = _whole(PLANE)
    rows, columns = np.arange(row, row + height), np.arange(column, column + width)
    expected = whole[np.ix_(rows % whole.shape[0], columns % whole.shape[1])]
    np.testing.assert_allclose(spectrum.block(row, column, height, width), expected, atol=1e-3)


def test_beyond_nyquist_is_nothing_when_not_wrapped() -> None:
    spectrum = transform(PLANE)
    high = spectrum.padded[0]
    block = spectrum.block(high // 2 - 2, 0, 6, 3, wrap=False)
    assert np.all(block[3:] == 0)
    assert np.all(block[:3] != 0)


def test_columns_that_were_not_computed_are_refused() -> None:
    spectrum = transform(PLANE, largest_fx=0.2)
    assert spectrum.half.shape[1] < spectrum.padded[1] // 2
    with pytest.raises(DecodeError, match="not computed"):
        spectrum.block(0, 0, 4, spectrum.padded[1] // 2)


def test_reference_shape_is_padded_to_the_fast_one() -> None:
    assert padded_shape((2776, 3688)) == (2800, 3750)


def test_the_same_bytes_for_any_number_of_workers() -> None:
    plane = np.random.default_rng(4).random((331, 457)).astype(np.float32)
    one, three = transform(plane, workers=1), transform(plane, workers=3)
    assert one.half.tobytes() == three.half.tobytes()


def test_hann_is_the_window_in_the_pixels() -> None:
    size = 40
    plane = np.random.default_rng(5).random((size, size)).astype(np.float32)
    spectrum = transform(plane)
    assert spectrum.padded == (size, size)
    window = 0.5 - 0.5 * np.cos(2 * np.pi * np.arange(size) / size)
    expected = np.fft.fft2((plane - ArraySource(plane).level) * np.outer(window, window))
    np.testing.assert_allclose(hann(spectrum.block(4, 4, 7, 7)), expected[5:10, 5:10], atol=1e-3)


@pytest.mark.parametrize("sigma", [0.001, 0.02])
def test_noise_is_measured_beside_a_picture(sigma: float) -> None:
    rng = np.random.default_rng(6)
    y, x = np.mgrid[0:300, 0:400]
    picture = 0.5 + 0.3 * np.sin(2 * np.pi * (0.013 * y + 0.031 * x)) + 0.1 * np.cos(2 * np.pi * 0.16 * x)
    plane = (picture + rng.normal(0, sigma, picture.shape)).astype(np.float32)
    assert noise_rms(transform(plane)) == pytest.approx(sigma, rel=0.1)


def test_a_buffer_is_lent_to_one_frame_at_a_time() -> None:
    buffers = SpectrumBuffers()
    with buffers.lend((90, 130)) as one, buffers.lend((90, 130)) as other:
        assert one is not other
    with buffers.lend((90, 130)) as again:
        assert again is one or again is other


def test_a_buffer_that_failed_half_way_is_not_lent_again() -> None:
    buffers = SpectrumBuffers()
    lent: list[np.ndarray] = []

    def fail() -> None:
        with buffers.lend((90, 130)) as tiles:
            lent.append(tiles)
            raise ValueError("half way")

    with pytest.raises(ValueError, match="half way"):
        fail()
    with buffers.lend((90, 130)) as fresh:
        assert fresh is not lent[0]
