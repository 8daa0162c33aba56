from __future__ import annotations

import numpy as np
import pytest

from dappled.decode.errors import DecodeError
from dappled.decode.optics.carriers import Carrier, Sensor
from dappled.decode.spectrum import plane
from dappled.decode.spectrum.lineariser import check_frame
from dappled.decode.spectrum.peaks import measure
from dappled.decode.spectrum.plane import find_defects, mended, spread
from dappled.decode.spectrum.transform import transform

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
        check_frame(_mosaic((40, 40)), 4095, flat=np.ones((30, 30), np.float32))


def _dark() -> np.ndarray:
    rng = np.random.default_rng(0)
    dark = rng.normal(1024, 4, (60, 80)).round().astype(np.uint16)
    dark[::2, ::2] += 50  # one colour's own black level
    return dark


def test_pixels_that_glow_are_found_each_colour_by_itself() -> None:
    dark = _dark()
    dark[10, 20], dark[0, 0], dark[59, 79] = 5000, 1300, 0
    rows, columns = find_defects(dark, (2, 2))
    assert list(zip(rows.tolist(), columns.tolist(), strict=True)) == [(0, 0), (10, 20), (59, 79)]


def test_a_pattern_of_many_pixels_is_no_defect() -> None:
    pattern = np.full((60, 80), 1024, dtype=np.uint16)
    pattern[::7, ::5] += 300
    rows, _ = find_defects(pattern)
    assert len(rows) == 0


def test_defects_are_filled_from_sound_neighbours_of_their_colour() -> None:
    rows, columns = np.mgrid[0:60, 0:80]
    light = (1000 + 10 * rows + 20 * columns).astype(np.uint16)
    light[::2, ::2] *= 3
    bad = np.array([10, 10, 0]), np.array([20, 22, 0])
    seen = light.copy()
    seen[bad] = 65535
    found = mended(seen, bad, (2, 2))
    assert found.dtype == np.uint16
    assert found[10, 20] == pytest.approx(light[10, 20], abs=50)
    assert found[0, 0] == (int(light[2, 0]) + int(light[0, 2])) // 2
    untouched = np.ones(light.shape, dtype=bool)
    untouched[bad] = False
    np.testing.assert_array_equal(found[untouched], light[untouched])
    assert seen[10, 20] == 65535  # raw bytes are left alone


def test_without_defects_nothing_is_copied() -> None:
    light = np.zeros((4, 4), dtype=np.uint16)
    assert mended(light, (np.array([], dtype=np.intp), np.array([], dtype=np.intp))) is light


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
