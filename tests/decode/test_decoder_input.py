"""What comes to a decoder's door: frame after frame, from several threads, huge, tiny, or without a picture."""

from __future__ import annotations

import tracemalloc
from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace

import numpy as np
import pytest

from dappled.decode.decoder import MaskDecoder
from dappled.decode.errors import DecodeError
from dappled.decode.lenslets import LensletDecoder
from dappled.decode.optics import MaskedOptics
from dappled.decode.spectrum.lineariser import LinearRows, lineariser
from tests.decode.rays import FOCAL_MM, MASK, SENSOR, STATED_DISTANCE_MM

BAYER = np.array([[0, 1], [1, 2]])
SHAPE = (600, 800)


def _decoder(shape: tuple[int, int], workers: int = 1) -> MaskDecoder:
    return MaskDecoder(
        MaskedOptics(replace(SENSOR, shape=shape), MASK, "geometric", STATED_DISTANCE_MM), workers=workers
    )


def _rows(shape: tuple[int, int], seed: int = 0) -> LinearRows:
    mosaic = np.random.default_rng(seed).integers(300, 3500, shape, dtype=np.uint16)
    made = lineariser(shape, black=256, white=4095, cfa=BAYER, reference=(1,))
    return made.apply(mosaic)


def _slices(decoder: MaskDecoder, seed: int) -> bytes:
    field, _ = decoder.decode_reported(_rows(decoder.optics.sensor.shape, seed), focal_length_mm=FOCAL_MM, views=False)
    return field.slices.tobytes()


def test_a_warm_decoder_gives_what_a_fresh_one_gives() -> None:
    warm = _decoder(SHAPE, workers=2)
    for seed in (1, 2, 1):
        assert _slices(warm, seed) == _slices(_decoder(SHAPE), seed)


def test_one_decoder_serves_several_threads() -> None:
    decoder = _decoder(SHAPE)
    expected = [_slices(_decoder(SHAPE), seed) for seed in range(4)]
    with ThreadPoolExecutor(4) as pool:
        found = list(pool.map(lambda seed: _slices(decoder, seed), range(4)))
    assert found == expected


@pytest.mark.parametrize(
    "shape", [pytest.param((1200, 1600)), pytest.param((8192, 12288), marks=pytest.mark.long, id="100 megapixels")]
)
def test_a_warm_decoder_holds_at_most_six_frames(shape: tuple[int, int]) -> None:
    rows = _rows(shape)
    decoder = _decoder(shape, workers=2)
    tracemalloc.start()
    try:
        for _ in range(2):
            decoder.decode_reported(rows, focal_length_mm=FOCAL_MM, views=False)
        peak = tracemalloc.get_traced_memory()[1]
    finally:
        tracemalloc.stop()
    assert peak < 6 * 4 * shape[0] * shape[1]


def test_more_than_can_be_decoded_is_refused_before_it_is_read() -> None:
    huge = np.lib.stride_tricks.as_strided(np.zeros(1, np.uint16), (12000, 12000), (0, 0))
    with pytest.raises(DecodeError, match="megapixels, cut it first"):
        lineariser((12000, 12000), black=0, white=4095).apply(huge)


@pytest.mark.parametrize("value", [np.nan, np.inf])
def test_a_plane_with_a_pixel_that_is_no_number_is_told(value: float) -> None:
    plane = np.random.default_rng(1).random(SHAPE).astype(np.float32)
    plane[17, 400] = value
    with pytest.raises(DecodeError, match="NaN or infinite"), np.errstate(invalid="ignore"):
        _decoder(SHAPE).decode(plane, focal_length_mm=FOCAL_MM)
    with pytest.raises(DecodeError, match="NaN or infinite"), np.errstate(invalid="ignore"):
        LensletDecoder(SHAPE).decode(plane)


def test_a_damaged_value_is_told_before_it_is_decoded() -> None:
    plane = np.random.default_rng(1).random(SHAPE).astype(np.float32)
    plane[17, 400] = 1e30
    with pytest.raises(DecodeError, match="a value of 1e\\+30, where white is 1"):
        lineariser(SHAPE, black=0, white=1).apply(plane)
    with pytest.raises(DecodeError, match="some of its values are damaged"):
        _decoder(SHAPE).decode(plane, focal_length_mm=FOCAL_MM)


@pytest.mark.parametrize("level", [0.0, 0.4, 1.0], ids=["black", "grey", "saturated"])
def test_a_plane_without_a_picture_has_no_lenslets_and_no_carriers(level: float) -> None:
    plane = np.full(SHAPE, level, dtype=np.float32)
    with pytest.raises(DecodeError, match="no carriers"):
        LensletDecoder(SHAPE).decode(plane)
    field, report = _decoder(SHAPE).decode_reported(plane, focal_length_mm=FOCAL_MM)
    assert report.carriers_from == "predicted"
    assert report.found == 1
    np.testing.assert_allclose(field.slices[0], level, atol=1e-5)
    assert np.abs(field.slices[1:]).max() < 1e-5


@pytest.mark.parametrize("shape", [(1, 1), (2, 3), (15, 400)])
def test_a_tiny_plane_is_refused_in_words(shape: tuple[int, int]) -> None:
    plane = np.random.default_rng(1).random(shape).astype(np.float32)
    with pytest.raises(DecodeError, match="too small"):
        LensletDecoder(shape).decode(plane)
    with pytest.raises(DecodeError, match="too small"):
        _decoder(shape).decode(plane, focal_length_mm=FOCAL_MM)


@pytest.mark.parametrize("shape", [(16, 16), (17, 40)])
def test_the_smallest_plane_has_slices_and_no_lenslets(shape: tuple[int, int]) -> None:
    plane = np.random.default_rng(1).random(shape).astype(np.float32)
    with pytest.raises(DecodeError, match="no carriers"):
        LensletDecoder(shape).decode(plane)
    assert np.isfinite(_decoder(shape).decode(plane, focal_length_mm=FOCAL_MM).slices).all()
