from __future__ import annotations

from typing import get_args

import numpy as np
import pytest

from dappled.decode.optics.carriers import Lattice
from dappled.decode.spectrum.peaks import measure
from dappled.decode.spectrum.pictures import Look, around, spectrum_boxes
from dappled.decode.spectrum.transform import transform


def _wave(shape: tuple[int, int], fy: float, fx: float, phase: float = 0.0) -> np.ndarray:
    y, x = np.mgrid[0 : shape[0], 0 : shape[1]]
    noise = np.random.default_rng(0).normal(0, 0.01, shape)
    wave = 0.5 + 0.3 * np.cos(2 * np.pi * (fy * y + fx * x) + phase) + noise
    return np.asarray(wave, dtype=np.float32)


@pytest.mark.parametrize("shape", [(200, 260), (151, 171)])
def test_boxes_and_markers_stand_on_the_carriers(shape: tuple[int, int]) -> None:
    y, x = np.mgrid[0 : shape[0], 0 : shape[1]]
    plane = (0.5 + 0.3 * np.cos(2 * np.pi * (0.2 * y + 0.1 * x))).astype(np.float32)
    carriers = Lattice((0.2, 0.1), (0.0, 0.2)).carriers([(1, 0)])
    measured = measure(transform(plane), carriers, 2.0)
    bare = spectrum_boxes(plane, [], (0.1, 0.1))
    row, column = round(0.7 * shape[0]), round(0.6 * shape[1])
    brightest = np.unravel_index(np.argmax(bare[shape[0] // 2 + 2 :, :, 0]), bare[shape[0] // 2 + 2 :, :, 0].shape)
    assert abs(brightest[0] + shape[0] // 2 + 2 - row) <= 1
    assert abs(brightest[1] - column) <= 1
    picture = spectrum_boxes(plane, carriers, (0.1, 0.1), measured=measured)
    assert tuple(picture[row, column]) == (250, 220, 40)
    assert tuple(picture[round(0.65 * shape[0]), column]) == (230, 30, 30)
    assert tuple(picture[row - 5, column]) == (60, 220, 60)
    small = spectrum_boxes(plane, carriers, (0.1, 0.1), longest_side=90)
    assert max(small.shape) <= 90


@pytest.mark.parametrize("look", get_args(Look))
def test_a_carrier_is_the_brightest_in_every_look(look: Look) -> None:
    picture = spectrum_boxes(_wave((200, 260), 0.2, 0.1), [], (0.1, 0.1), look=look).max(axis=2)
    assert min(picture[140, 156], picture[60, 104]) > 200
    assert np.mean(picture) < 150


def test_phases_are_yellow_at_0_and_red_at_pi() -> None:
    yellow = spectrum_boxes(_wave((200, 260), 0.2, 0.1), [], (0.1, 0.1), look="phase")[140, 156]
    red = spectrum_boxes(_wave((200, 260), 0.2, 0.1, np.pi), [], (0.1, 0.1), look="phase")[140, 156]
    assert (yellow[0] > 200, yellow[1] > 200, yellow[2]) == (True, True, 0)
    assert (red[0] > 200, red[1] < 30) == (True, True)


def test_the_four_bins_around_a_carrier_between_bins_show_the_thesis_s_pattern() -> None:
    """Figs 34, 35: each bin's colour is like its diagonal neighbour's, and unlike its side neighbours'."""
    shape = (200, 260)
    at = 40.5 / shape[0], 26.5 / shape[1]
    centre = -np.pi * (40.5 + 26.5)  # the wave's phase at the frame's centre: 0
    wave = _wave(shape, *at, centre)
    strength = around(wave, at, bins=8, longest_side=80, look="magnitude")[5::10, 5::10, 0].astype(int)
    rows, columns = np.unravel_index(np.argsort(strength.ravel())[-4:], strength.shape)
    top, left = int(rows.min()), int(columns.min())
    assert (int(rows.max()) - top, int(columns.max()) - left) == (1, 1)
    green = around(wave, at, bins=8, longest_side=80)[5::10, 5::10, 1].astype(int)[top : top + 2, left : left + 2]
    assert abs(green[0, 0] - green[1, 1]) < 40
    assert abs(green[0, 1] - green[1, 0]) < 40
    assert abs(green[0, 0] - green[0, 1]) > 100
