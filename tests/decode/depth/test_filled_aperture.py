"""Light through a filled aperture and through points of it: depth takes what explains the slices better."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from dappled.decode.array_types import Singles
from dappled.decode.depth import estimate, halves
from dappled.decode.depth.evidence import CELLS, Evidence, of_light_field
from dappled.decode.lightfield import LightField
from dappled.decode.lightfield.aperture import Aperture
from tests.decode.scenes import noise

SIDE, VIEWS, PARTS = 96, 5, 4
DISPARITY, NOISE_RMS = 0.8, 0.01
ORDERS = np.array([(0, 0), (0, 1), (0, 2), *((ky, kx) for ky in (1, 2) for kx in range(-2, 3))], dtype=np.float64)


def evidence(parts: int, seed: int = 3, coarse: float = 1.8) -> Evidence:
    """A masked frame of a coarsely textured wall, as `parts` × `parts` points of each view's cell show it."""
    fine = VIEWS * parts
    along = (np.arange(fine) - (fine - 1) / 2) / parts
    picture = 0.4 + 0.08 * noise(seed, SIDE, slope=coarse)
    spectrum = np.fft.fft2(picture)
    fy, fx = np.fft.fftfreq(SIDE)[:, None], np.fft.fftfreq(SIDE)[None, :]
    kernel = Aperture(fine).cells(ORDERS).reshape(len(ORDERS), fine, fine)
    rows, columns = (np.exp(-2j * np.pi * DISPARITY * f * along[:, None, None]) for f in (fy, fx))
    sums = np.einsum("kvu,vyi,uix->kyx", kernel, rows, columns, optimize=True)
    strength = 0.5 ** np.abs(ORDERS).sum(axis=1)
    rng = np.random.default_rng(seed)
    spread = NOISE_RMS / 10 / np.sqrt(2)  # a slice's pixel is ten of the frame's
    slices = strength[:, None, None] * np.fft.ifft2(sums * spectrum)
    slices = slices + spread * (rng.normal(size=slices.shape) + 1j * rng.normal(size=slices.shape))
    attributes = {
        "transfers": [[*order, s, 0.0] for order, s in zip(ORDERS, strength, strict=True)],
        "noise_rms": NOISE_RMS,
        "views_model": "joint",
        "shape": [10 * SIDE] * 2,
    }
    grid = np.array([[10.0, 0.0, 0.0], [0.0, 10.0, 0.0]])
    carriers = np.concatenate([ORDERS, ORDERS / 10], axis=1)
    views = np.broadcast_to(picture.astype(np.float32), (VIEWS, VIEWS, SIDE, SIDE)).copy()
    return of_light_field(
        LightField(slices.astype(np.complex64), carriers, views, Aperture(VIEWS).offsets(), grid, attributes)
    )


def disparities(told: Evidence) -> Singles:
    return estimate.estimate(told, between=(-1.3, 1.5)).disparity


def off(made: Singles) -> float:
    return float(np.median(made[16:-16, 16:-16]) - DISPARITY)


def test_a_filled_aperture_does_not_shrink_disparities() -> None:
    told = evidence(PARTS)
    by_points = off(disparities(replace(told, filled=None)))
    assert by_points < -0.02
    assert abs(off(disparities(told))) < 0.4 * abs(by_points)


def test_points_of_the_aperture_are_still_found() -> None:
    told = evidence(1)
    made = disparities(told)
    np.testing.assert_array_equal(made, disparities(replace(told, filled=None)))
    assert abs(off(made)) < 0.01


@pytest.mark.parametrize("parts", [1, PARTS])
def test_the_likelier_aperture_is_the_one_that_leaves_less(parts: int) -> None:
    found = halves.likelier(evidence(parts), np.linspace(-1.0, 1.5, 26))
    assert (found.filled is None) == (parts == 1)


def test_halves_of_a_filled_aperture_keep_the_middle_views() -> None:
    whole = halves.whole(evidence(PARTS))
    assert whole.steps.shape == ((CELLS * VIEWS) ** 2, 2)
    for half in halves.halves(whole):
        assert len(half.steps) == CELLS * VIEWS * CELLS * (VIEWS // 2 + 1)
        np.testing.assert_array_less(np.abs(half.steps - half.of_views()), 0.5)
