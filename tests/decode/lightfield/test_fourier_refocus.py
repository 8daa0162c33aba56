from __future__ import annotations

import math

import numpy as np
import pytest

from dappled.decode.errors import DecodeError
from dappled.decode.lightfield.fourier_refocus import Spectrum4D, difference
from dappled.decode.lightfield.light_field import ViewStack, centred
from dappled.decode.lightfield.refocus import shift_and_add
from tests.decode.scenes import Board, boards, paint


def by_the_sum(stack: ViewStack, disparity: float) -> np.ndarray:
    """The picture by exact phases, view for view: what the slice resamples."""
    v, u, h, w = stack.views.shape
    pad = 24
    spectra = np.fft.rfft2(np.pad(stack.views, ((0, 0), (0, 0), (pad, pad), (pad, pad)), mode="symmetric"))
    fy, fx = np.fft.fftfreq(h + 2 * pad)[:, None], np.fft.rfftfreq(w + 2 * pad)[None]
    total = np.zeros(spectra.shape[2:], np.complex128)
    for i, sy in enumerate(stack.row_steps):
        for j, sx in enumerate(stack.column_steps):
            total += spectra[i, j] * np.exp(2j * np.pi * disparity * (fy * sy + fx * sx))
    return np.asarray(np.fft.irfft2(total, s=(h + 2 * pad, w + 2 * pad))[pad:-pad, pad:-pad] / (v * u))


@pytest.mark.parametrize("n", [3, 4, 5])
@pytest.mark.parametrize("disparity", [0.0, 0.37, -1.4])
def test_the_slice_is_the_sum_over_views(n: int, disparity: float) -> None:
    stack, _ = paint(boards(1, 64, 0.8, 3), (64, 72), n)
    made = Spectrum4D.of(stack, most_disparity=1.4).refocused(disparity)
    off = difference(by_the_sum(stack, disparity).astype(np.float32), made, 6)
    assert off.psnr_db > 55
    assert off.largest < 0.005


def test_it_agrees_with_shift_and_add() -> None:
    stack, _ = paint(boards(1, 96, 0.8, 3), (96, 96), 5)
    spectrum = Spectrum4D.of(stack, most_disparity=1)
    for disparity in (-0.6, 0.25, 0.8):
        off = difference(shift_and_add(stack, disparity), spectrum.refocused(disparity), 6)
        assert off.psnr_db > 45


def test_shift_and_add_keeps_the_detail_of_the_views() -> None:
    """Views with detail up to 0.7 of Nyquist: cubic convolution is 25 dB from the sum by exact phases."""
    chance = np.random.default_rng(4)
    spectrum = np.fft.rfft2(chance.normal(size=(3, 3, 80, 80)))
    fy, fx = np.fft.fftfreq(80)[:, None], np.fft.rfftfreq(80)[None]
    views = np.fft.irfft2(spectrum * (np.hypot(fy, fx) < 0.35), s=(80, 80)).astype(np.float32)
    stack = ViewStack(views, centred(3), centred(3))
    off = difference(by_the_sum(stack, 0.4).astype(np.float32), shift_and_add(stack, 0.4), 16)
    assert off.psnr_db > 55


def test_a_difference_of_nothing_is_infinite() -> None:
    flat = np.zeros((20, 20), np.float32)
    assert difference(flat, flat, 2).psnr_db == math.inf
    with pytest.raises(DecodeError, match="leaves nothing"):
        difference(flat, flat, 10)


def test_what_it_cannot_do_is_told() -> None:
    stack, _ = paint([Board(0.2)], (32, 32), 3)
    uneven = ViewStack(stack.views, stack.row_steps, np.array([-1.0, 0.2, 1.0]))
    with pytest.raises(DecodeError, match="evenly spaced"):
        Spectrum4D.of(uneven, most_disparity=1)
    huge = ViewStack(np.broadcast_to(np.float32(0), (15, 15, 1200, 1200)), centred(15), centred(15))
    with pytest.raises(DecodeError, match=r"would take .* GB"):
        Spectrum4D.of(huge, most_disparity=1)
    with pytest.raises(DecodeError, match="several places"):
        Spectrum4D.of(ViewStack(stack.views[:1, :1], np.zeros(1), np.zeros(1)), most_disparity=1)
