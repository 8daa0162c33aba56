"""Film: sizes, step wedges, density curves."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from numpy.typing import NDArray

from dappled.decode.errors import DecodeError
from dappled.decode.optics.carriers import Harmonics, Mask, Pattern
from dappled.decode.optics.film import FILMS, DensityCurve, MaskImage, density_curve, film_of, period_on, wedge


def develop(curve: DensityCurve, levels: NDArray[np.float64]) -> NDArray[np.float64]:
    """The transmittance that printed levels (0 to 1) get on a film of this curve."""
    return np.interp(levels, curve.levels, curve.transmittance)


def test_a_mask_wider_than_the_film_is_refused_with_both_sizes() -> None:
    assert FILMS["4k"].cut_to(12, 18).shape == (1366, 2048)
    with pytest.raises(DecodeError, match="40 mm wide does not fit film 4k: it has 36 mm"):
        FILMS["4k"].cut_to(20, 40)
    with pytest.raises(DecodeError, match="film density = -5"):
        film_of(10, 10, -5)


@given(gamma=st.floats(0.4, 3), top=st.floats(0.5, 3), falling=st.booleans(), wanted=st.floats(0, 1))
def test_a_curve_is_inverted(gamma: float, top: float, falling: bool, wanted: float) -> None:
    levels = np.linspace(0, 255, 33)
    share = (levels / 255) ** gamma
    curve = density_curve(list(levels), list(top * (share if falling else 1 - share)))
    low, high = curve.range
    made = develop(curve, curve.level(np.array([wanted])))
    assert (made[0] - low) / (high - low) == pytest.approx(wanted, abs=1e-9)


@pytest.mark.parametrize(
    ("levels", "densities", "said"),
    [
        ([0, 255], [0, 2], "3 steps or more"),
        ([0, 100, 255], [0, 1.5, 1.0], "reverses by 0.50 at level 255"),
        ([0, 100, 255], [1, 1, 1.01], "density only changes by 0.01"),
        ([0, 100, 300], [0, 1, 2], "level = 300"),
        ([0, 100, 255], [0, 1, float("nan")], "density = nan"),
        ([90, 100, 255], [0, 1, 2], "measure it from 0 to 255"),
        ([0, 0, 255], [0, 1, 2], "is in it twice"),
    ],
)
def test_a_bad_curve_is_answered(levels: list[float], densities: list[float], said: str) -> None:
    with pytest.raises(DecodeError, match=said):
        density_curve(levels, densities)


def test_a_wedge_has_all_its_steps() -> None:
    made = wedge((3, 2100), 21)
    assert made.shape == (3, 2100)
    centres = made[1, 50::100]
    np.testing.assert_allclose(centres, np.linspace(0, 1, 21))
    with pytest.raises(DecodeError, match="needs 84 columns"):
        wedge((3, 50), 21)


ALL = slice(None)


def _image(period: int, p: int, pattern: Pattern, harmonics: Harmonics, periods: int = 6) -> MaskImage:
    film = film_of(period * periods, period * (periods + 1), 113.8)
    return MaskImage(Mask(113.8 / period, p, pattern, harmonics), film, (period, period))


@pytest.mark.parametrize("pattern", ["full", "diagonal"])
@pytest.mark.parametrize("harmonics", ["linear", "octave"])
@pytest.mark.parametrize(
    ("period", "p"),
    [
        pytest.param(5, 2, id="mask 1"),
        pytest.param(10, 2, id="mask 2"),
        pytest.param(10, 4, id="mask 3, folding"),
        pytest.param(20, 5, id="mask 5, folding"),
        pytest.param(40, 4, id="coarse"),
    ],
)
def test_the_dft_shows_exactly_the_predicted_orders(
    period: int, p: int, pattern: Pattern, harmonics: Harmonics
) -> None:
    image = _image(period, p, pattern, harmonics)
    values = image.transmittance(ALL, ALL)
    assert values.min() == pytest.approx(0)
    assert values.max() == pytest.approx(1)
    spectrum = np.abs(np.fft.fft2(values)) / values.size
    height, width = values.shape
    predicted = {(round(fy * height) % height, round(fx * width) % width) for fy, fx in image.orders_drawn().values()}
    seen = {(int(y), int(x)) for y, x in np.argwhere(spectrum > 1e-9)}
    assert seen == predicted


@pytest.mark.parametrize(("bits", "floor"), [(8, 1 / 255), (16, 1 / 65535)])
def test_whole_levels_add_less_than_half_a_level_of_anything_else(bits: int, floor: float) -> None:
    image = replace(_image(10, 2, "full", "linear"), bits=bits)
    levels = image.levels(ALL, ALL)
    assert levels.dtype == (np.uint8 if bits == 8 else np.uint16)
    assert (int(levels.min()), int(levels.max())) == (0, 2**bits - 1)
    spectrum = np.abs(np.fft.fft2(levels / (2**bits - 1))) / levels.size
    height, width = levels.shape
    for fy, fx in image.orders_drawn().values():
        row, column = round(fy * height) % height, round(fx * width) % width
        assert spectrum[row, column] > 5 * floor
        spectrum[row, column] = 0
    assert spectrum.max() < floor / 2


def test_it_is_fig_14_s_picture() -> None:
    """`makemask(h, w, s, p)` line by line, scaled to 255."""
    h, w, s, p = 40, 60, 10, 2
    i, j = np.mgrid[1 : h + 1, 1 : w + 1]
    fs = 2 * np.pi / s
    mask = 4 + np.cos(fs * i) * np.cos(fs * j)
    for q in range(2, p + 1):
        mask = mask + np.cos(fs * q * i) * np.cos(fs * q * j)
    mask = mask - mask.min()
    mask = mask * (255 / mask.max())
    image = MaskImage(Mask(11.38, p, "diagonal"), film_of(w, h, 113.8), (s, s))
    np.testing.assert_allclose(image.transmittance(ALL, ALL) * 255, mask, atol=1e-9)


@given(top=st.integers(0, 60), left=st.integers(0, 50), height=st.integers(1, 30), width=st.integers(1, 30))
def test_tiles_are_the_picture_and_negatives_add_up_to_255(top: int, left: int, height: int, width: int) -> None:
    image = MaskImage(Mask(7.7, 3, "full"), film_of(70, 80, 100.0), (12.9, 12.9))
    rows, columns = slice(top, top + height), slice(left, left + width)
    tile = image.levels(rows, columns)
    np.testing.assert_array_equal(tile, image.levels(ALL, ALL)[rows, columns])
    negative = replace(image, negative=True).levels(rows, columns)
    np.testing.assert_array_equal(tile.astype(int) + negative, 255)  # Eq 13


def test_mask_4_s_upper_harmonics_are_warned_of_and_can_be_left_out() -> None:
    image = MaskImage(Mask(5.69, 10, "diagonal", "octave"), film_of(200, 200, 113.8), (20, 20))
    warned = image.warnings()
    assert len(warned) == 6  # periods 1.25, 0.625, … px
    assert "harmonic 16 (91.04/mm) has a period of 1.25 px" in warned[0]
    assert "less than a pixel: drawn as another frequency" in warned[1]
    clean = replace(image, drawable_only=True)
    assert clean.multiples == (1, 2, 4, 8)
    assert "left out" in clean.warnings()[0]
    assert len(clean.orders_drawn()) == 17


def test_on_film_with_unlike_axes_the_period_is_the_same_in_millimetres() -> None:
    vertical, horizontal = period_on(FILMS["8k"], Mask(11.38, 2))
    assert vertical / horizontal == pytest.approx(256 / 227.56, rel=1e-4)


def test_a_curve_makes_the_film_s_transmittance_the_pattern() -> None:
    levels = np.linspace(0, 255, 18)
    curve = density_curve(list(levels), list(2.0 * (1 - (levels / 255) ** 1.7)))
    image = _image(20, 2, "full", "linear")
    printed = replace(image, curve=curve, bits=16).levels(ALL, ALL) / 65535
    low, high = curve.range
    developed = (develop(curve, printed) - low) / (high - low)
    np.testing.assert_allclose(developed, image.transmittance(ALL, ALL), atol=1e-3)
    plain = (develop(curve, image.transmittance(ALL, ALL)) - low) / (high - low)
    assert np.abs(plain - image.transmittance(ALL, ALL)).max() > 0.2  # what it corrects


@pytest.mark.parametrize(
    ("changed", "said"),
    [
        ({"bits": 12}, "8 or 16 bits, not 12"),
        ({"period_px": (0.0, 10.0)}, "longest period = 0 px"),
        ({"period_px": (float("nan"), 10.0)}, "nan"),
        ({"period_px": (1.5, 1.5), "drawable_only": True}, "every harmonic is finer than two pixels"),
    ],
)
def test_nonsense_is_answered(changed: dict[str, object], said: str) -> None:
    with pytest.raises(DecodeError, match=said):
        replace(_image(10, 2, "full", "linear"), **changed)  # type: ignore[arg-type]  # wrong on purpose


def test_a_mask_that_folds_to_an_even_grey_is_refused() -> None:
    image = MaskImage(Mask(113.8, 2), film_of(50, 50, 113.8), (1.0, 1.0))
    with pytest.raises(DecodeError, match="one even grey"):
        image.levels(ALL, ALL)
