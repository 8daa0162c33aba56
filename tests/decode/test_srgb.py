"""sRGB's curve by table: what files of pictures hold."""

from __future__ import annotations

import numpy as np

from dappled.decode import srgb


def test_sixteen_bits_are_the_curve_s_within_a_level() -> None:
    linear = np.concatenate([np.linspace(0, 0.01, 100_001), np.linspace(0, 1, 100_001)]).astype(np.float32)
    exact = srgb.encoded(linear.astype(np.float64)) * 65535
    assert np.abs(srgb.sixteen(linear) - exact).max() < 1


def test_what_is_no_light_or_too_much_of_it_is_black_or_white() -> None:
    assert srgb.sixteen(np.array([[np.nan, -1.0, -np.inf], [0.0, 2.0, np.inf]])).tolist() == [
        [0, 0, 0],
        [0, 65535, 65535],
    ]


def test_eight_bits_are_the_nearest_of_sixteen() -> None:
    coded = np.arange(65536, dtype=np.uint16)
    assert np.abs(srgb.eight(coded) - coded / 257).max() <= 0.5
