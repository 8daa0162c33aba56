from __future__ import annotations

import numpy as np
import pytest

from dappled.decode.spectrum.plane import find_defects, mended


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
