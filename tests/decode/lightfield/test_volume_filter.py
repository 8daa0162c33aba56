"""A volume in focus: what lies in the range stays sharp, what lies outside is weaker, and noise is averaged."""

from __future__ import annotations

import numpy as np
import pytest
from numpy.typing import NDArray
from scipy import fft

from dappled.decode.errors import DecodeError
from dappled.decode.lightfield import ViewStack
from dappled.decode.lightfield.refocus import shift_and_add
from dappled.decode.lightfield.volume_filter import within

SIDE, STEPS = 64, np.arange(5.0) - 2
INNER = np.s_[12:-12, 12:-12]
FY, FX = fft.fftfreq(SIDE)[:, None], fft.rfftfreq(SIDE)[None, :]


def texture(seed: int) -> NDArray[np.float64]:
    """Natural: amplitudes fall as 1/f."""
    spectrum = fft.rfft2(np.random.default_rng(seed).normal(size=(SIDE, SIDE))) / np.maximum(np.hypot(FY, FX), 0.03)
    spectrum[0, 0] = 0
    made = fft.irfft2(spectrum, s=(SIDE, SIDE))
    return np.asarray(made / made.std())


def at(picture: NDArray[np.float64], disparity: float) -> ViewStack:
    """A picture at one disparity, seen by 5 × 5 views."""
    spectrum = fft.rfft2(picture)
    views = [
        [fft.irfft2(spectrum * np.exp(-2j * np.pi * disparity * (v * FY + u * FX)), s=(SIDE, SIDE)) for u in STEPS]
        for v in STEPS
    ]
    return ViewStack(np.array(views, dtype=np.float32), STEPS, STEPS)


def off(found: NDArray[np.floating], truth: NDArray[np.floating]) -> float:
    """The root mean square of a difference, away from the edges."""
    return float(np.sqrt(np.mean((found - truth)[INNER] ** 2)))


def test_a_plane_alone_is_the_refocused_picture() -> None:
    stack = at(texture(1), 0.4)
    assert off(within(stack, 0.4, 0.4), texture(1)) < 0.05
    assert off(within(stack, 0.1, 0.1), shift_and_add(stack, 0.1)) < 0.05


@pytest.mark.parametrize("disparity", [0.0, 0.3, 0.6])
def test_all_of_the_range_is_sharp_where_a_plane_is_not(disparity: float) -> None:
    stack = at(texture(2), disparity)
    assert off(within(stack, 0.0, 0.6), texture(2)) < 0.06
    if disparity != 0.3:
        assert off(within(stack, 0.3, 0.3), texture(2)) > 0.15


def test_snow_before_the_scene_is_weakened_and_noise_averaged() -> None:
    scene = at(texture(3), 0.2)
    flakes = np.zeros((SIDE, SIDE))
    flakes.flat[np.random.default_rng(4).choice(SIDE * SIDE, 80, replace=False)] = 1.0
    snow = at(flakes, 2.5)
    left = within(snow, 0.0, 0.4)
    assert off(left, left.mean()) < 0.45 * off(snow.middle(), flakes.mean())
    noise = np.random.default_rng(5).normal(0, 0.3, scene.views.shape).astype(np.float32)
    found = within(ViewStack(scene.views + noise, STEPS, STEPS), 0.0, 0.4)
    assert off(found, texture(3)) < 0.4 * 0.3  # more than 8 dB


def test_colours_are_filtered_alike_and_any_number_of_workers_gives_the_same() -> None:
    stack = at(texture(6), 0.3)
    grey = within(stack, 0.0, 0.5)
    colour = within(ViewStack(np.stack([stack.views] * 3, axis=-1), STEPS, STEPS), 0.0, 0.5, workers=2)
    assert np.array_equal(colour[..., 1], grey)


def test_nonsense_is_told() -> None:
    with pytest.raises(DecodeError, match="has no end"):
        within(at(texture(1), 0.0), 0.0, float("inf"))
    with pytest.raises(DecodeError, match="needs views from several places"):
        within(ViewStack(np.ones((1, 1, 8, 8), np.float32), np.zeros(1), np.zeros(1)), 0.0, 1.0)
