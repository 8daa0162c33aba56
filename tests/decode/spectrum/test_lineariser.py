from __future__ import annotations

from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from dappled.decode.errors import DecodeError
from dappled.decode.spectrum import plane as planes
from dappled.decode.spectrum.lineariser import ArraySource, lineariser
from tests.decode.spectrum.equations import even_colours

BAYER = np.array([[0, 1], [1, 2]])
SUPER_CCD = np.array([[0, 1, 2, 1], [1, 1, 1, 1], [2, 1, 0, 1], [1, 1, 1, 1]])
ROWS = np.array([[0, 1, 2]])


def _mosaic(shape: tuple[int, int], cfa: np.ndarray, seed: int = 2) -> np.ndarray:
    """A picture with a colour cast that changes over the frame, and noise."""
    rng = np.random.default_rng(seed)
    y, x = np.mgrid[0 : shape[0], 0 : shape[1]]
    colour = np.tile(cfa, (shape[0] // cfa.shape[0] + 1, shape[1] // cfa.shape[1] + 1))[: shape[0], : shape[1]]
    gain = np.stack([0.4 + 0.3 * x / shape[1], np.ones(shape), 0.9 - 0.5 * y / shape[0]])
    light = 900 + 500 * np.sin(y / 17) * np.cos(x / 23)
    made = 100 + np.take_along_axis(gain, colour[None], 0)[0] * light + rng.normal(0, 20, shape)
    return np.asarray(made, dtype=np.uint16)


@pytest.mark.parametrize("cfa", [BAYER, SUPER_CCD, ROWS], ids=["bayer", "super ccd", "stripes"])
@pytest.mark.parametrize("shape", [(201, 251), (47, 300), (16, 16), (96, 96)])
@pytest.mark.parametrize("reference", [(1,), (0, 1, 2), ()])
@pytest.mark.parametrize("balance", [None, (1.3, 1.0, 0.7)])
def test_linear_rows_are_the_plane_with_its_colours_evened(
    cfa: np.ndarray, shape: tuple[int, int], reference: tuple[int, ...], balance: tuple[float, ...] | None
) -> None:
    mosaic = _mosaic(shape, cfa)
    levels: dict[str, Any] = {"black": (100, 90, 110), "white": 4095, "cfa": cfa, "balance": balance}
    expected = planes.to_plane(mosaic, **levels)
    if reference:
        even_colours(expected, cfa, reference)
    linear = lineariser(shape, **levels, reference=reference).apply(mosaic)
    np.testing.assert_allclose(linear.plane(), expected, rtol=2e-5, atol=1e-6)
    assert linear.level == pytest.approx(float(expected.mean()), rel=0.1)


def test_dark_and_white_frames_are_taken_off_while_it_is_read() -> None:
    mosaic = _mosaic((120, 150), BAYER)
    rng = np.random.default_rng(3)
    dark = rng.integers(80, 120, mosaic.shape, dtype=np.uint16)
    flat = rng.uniform(1, 2, mosaic.shape).astype(np.float32)
    levels: dict[str, Any] = {"black": 0, "white": 4095, "cfa": BAYER, "balance": (1.0, 1.0, 1.0)}
    expected = planes.to_plane(mosaic, dark=dark, **levels) * flat
    found = lineariser(mosaic.shape, **levels).apply(mosaic, dark=dark, flat=flat).plane()
    np.testing.assert_allclose(found, expected, rtol=2e-5, atol=1e-6)


def test_a_lineariser_serves_frame_after_frame() -> None:
    made = lineariser((120, 150), black=100, white=4095, cfa=BAYER, reference=(1,))
    first = made.apply(_mosaic((120, 150), BAYER, 1)).plane()
    made.apply(_mosaic((120, 150), BAYER, 5))
    again = made.apply(_mosaic((120, 150), BAYER, 1)).plane(workers=3)
    assert first.tobytes() == again.tobytes()


@given(first=st.integers(0, 9), count=st.integers(1, 60))
def test_rows_can_be_read_from_any_period_on(first: int, count: int) -> None:
    mosaic = _mosaic((120, 90), BAYER)
    linear = lineariser((120, 90), black=100, white=4095, cfa=BAYER, reference=(1,)).apply(mosaic)
    rows = slice(first * linear.period, min(120, first * linear.period + count))
    out = np.empty((rows.stop - rows.start, 90), dtype=np.float32)
    linear.rows_into(out, rows)
    np.testing.assert_allclose(out, linear.plane()[rows], rtol=1e-6)


def test_a_plane_in_memory_is_read_as_it_is() -> None:
    plane = np.random.default_rng(4).random((70, 80)).astype(np.float32)
    source = ArraySource(plane)
    out = np.empty((10, 80), dtype=np.float32)
    source.rows_into(out, slice(5, 15))
    assert np.array_equal(out, plane[5:15])
    assert source.shape == (70, 80)


@pytest.mark.parametrize(
    ("mosaic", "words"),
    [
        (np.full((64, 64), 800, np.uint16), "constant"),
        (np.where(np.eye(64) > 0, np.nan, 0.5), "NaN"),
        (_mosaic((64, 64), BAYER) // 4000 + np.eye(64, dtype=np.uint16), "black"),
        (np.full((64, 64), 4095, np.uint16) - np.arange(64, dtype=np.uint16) % 2, "saturated"),
        (np.zeros((8, 64), np.uint16), "too small"),
        (np.zeros((64, 64, 3), np.uint16), "two axes"),
        (_mosaic((80, 64), BAYER), "settings are for"),
    ],
)
def test_a_frame_without_a_picture_is_refused_in_words(mosaic: np.ndarray, words: str) -> None:
    with pytest.raises(DecodeError, match=words):
        lineariser((64, 64), black=0, white=4095, cfa=BAYER, reference=(1,)).apply(mosaic)
