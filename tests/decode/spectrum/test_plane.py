from __future__ import annotations

import numpy as np
import pytest

from dappled.decode.errors import DecodeError
from dappled.decode.spectrum import plane

BAYER = np.array([[0, 1], [1, 2]])


def _mosaic(shape: tuple[int, int] = (40, 52)) -> np.ndarray:
    return np.random.default_rng(1).integers(300, 3000, shape, dtype=np.uint16)


def test_levels_gains_and_colours_land_on_their_pixels() -> None:
    mosaic = _mosaic()
    black, gains = np.array([100.0, 110.0, 120.0]), np.array([1.5, 1.0, 2.0])
    found = plane.to_plane(mosaic, black=tuple(black), white=4095, cfa=BAYER, balance=tuple(gains))
    colour = np.tile(BAYER, (20, 26))
    expected = (mosaic - black[colour]) / (4095 - black[colour]) * gains[colour]
    assert found.dtype == np.float32
    np.testing.assert_allclose(found, expected, rtol=1e-5, atol=1e-6)


def test_estimated_balance_gives_all_colours_one_mean_and_leaves_the_commonest() -> None:
    mosaic = _mosaic((60, 60))
    mosaic[0::2, 0::2] //= 2
    found = plane.to_plane(mosaic, black=100, white=4095, cfa=BAYER)
    means = [found[0::2, 0::2].mean(), found[0::2, 1::2].mean(), found[1::2, 0::2].mean(), found[1::2, 1::2].mean()]
    assert means[0] == pytest.approx((means[1] + means[2]) / 2, rel=1e-4)
    assert means[3] == pytest.approx((means[1] + means[2]) / 2, rel=1e-4)
    np.testing.assert_allclose(found[0::2, 1::2], (mosaic[0::2, 1::2] - 100) / 3995, rtol=1e-5)


def test_dark_frame_takes_the_place_of_black() -> None:
    mosaic = _mosaic()
    dark = np.full(mosaic.shape, 90, np.uint16)
    dark[3, 4] = 300
    found = plane.to_plane(mosaic, black=0, white=4095, dark=dark)
    assert found[3, 4] == pytest.approx((int(mosaic[3, 4]) - 300) / 4095, abs=1e-6)


def test_white_gain_takes_vignetting_and_leaves_the_carriers() -> None:
    y, x = np.mgrid[0:200, 0:240]
    vignette = 1 - 0.5 * ((y - 100) ** 2 + (x - 120) ** 2) / 25000
    white = (vignette * (1 + 0.8 * np.cos(2 * np.pi * x / 10))).astype(np.float32)
    flat = white * plane.white_gain(white, 10)
    bare = 1 + 0.8 * np.cos(2 * np.pi * x / 10)
    inner = (slice(30, -30), slice(30, -30))
    assert np.abs(flat[inner] / bare[inner] - 1).max() < 0.05


def _changed(**changes: object) -> dict[str, object]:
    return {"mosaic": _mosaic(), "black": 100, "white": 4095, **changes}


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        (_changed(mosaic=np.full((40, 40), 800, np.uint16)), "constant"),
        (_changed(mosaic=np.where(np.eye(40) > 0, np.nan, 0.5)), "NaN"),
        (_changed(mosaic=_mosaic() // 1000 + 100), "black"),
        (_changed(mosaic=_mosaic() * 0 + 4095 - np.arange(52, dtype=np.uint16) % 2), "saturated"),
        (_changed(mosaic=_mosaic((8, 200))), "too small"),
        (_changed(mosaic=np.zeros((40, 40, 3))), "two axes"),
        (_changed(mosaic=np.lib.stride_tricks.as_strided(_mosaic(), (20000, 20000), (0, 0))), "megapixels"),
        (_changed(dark=_mosaic((20, 20))), "dark frame is 20×20"),
        (_changed(white=50), "white level"),
        (_changed(balance=(1.0, -2.0)), "gains"),
        (_changed(mosaic=np.full((40, 40), "a")), "holds"),
    ],
)
def test_bad_input_is_refused_in_words(arguments: dict[str, object], words: str) -> None:
    with pytest.raises(DecodeError, match=words):
        plane.to_plane(**arguments)  # type: ignore[arg-type]  # wrong on purpose


def test_a_white_frame_of_another_size_is_refused() -> None:
    with pytest.raises(DecodeError, match="white frame is 30×30"):
        plane.check_frame(_mosaic((40, 40)), 4095, flat=np.ones((30, 30), np.float32))
