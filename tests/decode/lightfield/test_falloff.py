"""Light lost towards the corners: found in scenes whose loss is known, and not where the scene alone is uneven."""

from __future__ import annotations

import numpy as np
import pytest
from scipy import fft

from dappled.decode.array_types import Floats
from dappled.decode.lightfield.falloff import falloff
from dappled.findings import Code

SHAPE = 150, 200
EVEN = np.ones(SHAPE)


def texture(seed: int, exponent: float = 1.3, contrast: float = 0.2) -> Floats:
    """Amplitudes that fall as frequency^-exponent, mean 1."""
    rng = np.random.default_rng([seed, 3])
    radius = np.hypot((fft.fftfreq(SHAPE[0]) * SHAPE[0])[:, None], fft.rfftfreq(SHAPE[1]) * SHAPE[1])
    radius[0, 0] = np.inf
    waves = rng.standard_normal(radius.shape) + 1j * rng.standard_normal(radius.shape)
    made = fft.irfft2(radius**-exponent * waves, s=SHAPE)
    return np.asarray(np.maximum(1 + contrast * made / made.std(), 0.05))


def boards(seed: int) -> Floats:
    """A textured backdrop, and before it up to three boards of other shades."""
    rng = np.random.default_rng([seed, 4])
    scene = 0.42 * texture(7 * seed)
    for number in range(int(rng.integers(0, 4))):
        top, left, high, wide = rng.uniform((0, 0, 0.25, 0.25), (0.5, 0.5, 0.55, 0.55))
        part = tuple(
            slice(int(a * side), int((a + b) * side)) for a, b, side in ((top, high, SHAPE[0]), (left, wide, SHAPE[1]))
        )
        scene[part] = rng.uniform(0.2, 0.7) * texture(7 * seed + number + 1)[part]
    return scene


def darker(scene: Floats, share: float) -> Floats:
    """The scene less a share of its light at the corners, as RayCamera's falloff takes it."""
    y, x = (np.arange(side) + 0.5 - side / 2 for side in SHAPE)
    return scene * (1 - share * (y[:, None] ** 2 + x**2) / (SHAPE[0] ** 2 + SHAPE[1] ** 2) * 4)


@pytest.mark.parametrize("share", [0.3, 0.4, 0.5])
def test_the_loss_before_an_even_scene_is_measured_and_doubted(share: float) -> None:
    found = falloff(darker(EVEN, share))
    assert found is not None
    assert found.lost == pytest.approx(share, abs=0.05)
    doubt = found.finding()
    assert doubt is not None
    assert (doubt.code, doubt.facts["lost"]) == (Code.FRAME_VIGNETTED, found.lost)


@pytest.mark.parametrize("scenes", [25, pytest.param(100, marks=pytest.mark.slow)])
def test_no_scene_without_a_loss_is_doubted(scenes: int) -> None:
    found = [falloff(boards(seed)) for seed in range(scenes)]
    assert [one.finding() for one in found if one is not None] == [None] * scenes


def test_a_loss_before_gentle_textures_is_found_within_its_error() -> None:
    found = [falloff(darker(texture(seed, contrast=0.05), 0.4)) for seed in range(20)]
    off = [abs(one.lost - 0.38) / one.sigma for one in found if one is not None]
    assert len(off) == 20
    assert np.sum(np.array(off) < 2) >= 18
    assert sum(one is not None and one.finding() is not None for one in found) >= 18


def test_a_slope_across_the_frame_and_edges_are_no_loss() -> None:
    sloped = texture(5, contrast=0.05) * np.exp(np.linspace(-0.5, 0.5, SHAPE[1]))
    sloped[40:110, 60:140] *= 3  # a bright thing in the middle
    found = falloff(sloped)
    assert found is not None
    assert abs(found.lost) < 2 * found.sigma
    assert found.finding() is None


def test_a_lamp_in_the_middle_is_more_than_a_lens_loses() -> None:
    y, x = (np.linspace(-1, 1, side) for side in SHAPE)
    found = falloff(np.exp(-2 * (y[:, None] ** 2 + x**2)))
    assert found is not None
    assert found.lost > 0.9
    assert found.finding() is None


def test_brightness_across_one_axis_alone_is_no_loss() -> None:
    """A path between dark hedges is darker at two sides, not at all four."""
    found = falloff(texture(2, contrast=0.05) * np.exp(-1.2 * np.linspace(-1, 1, SHAPE[1]) ** 2))
    assert found is not None
    assert found.lost > 0.22
    assert found.finding() is None


def test_where_nothing_can_be_told_nothing_is() -> None:
    assert falloff(np.zeros(SHAPE)) is None
    assert falloff(np.ones((27, 200))) is None
    assert falloff(np.ones((28, 200))) is not None
    assert falloff(np.full(SHAPE, np.inf)) is None


def test_a_narrow_upright_picture_is_measured_as_a_lying_one() -> None:
    lying = darker(texture(4, contrast=0.02), 0.4)[: 2 * SHAPE[0] // 3]
    found, turned = falloff(lying), falloff(np.ascontiguousarray(lying.T))
    assert found is not None
    assert turned is not None
    assert turned.lost == pytest.approx(found.lost, abs=0.02)
    assert falloff(np.ones((2000, 28))) is not None


def test_darker_sides_count_as_a_loss_only_where_the_other_strips_agree() -> None:
    left_only = texture(3, contrast=0.02)
    left_only[:, :50] = darker(left_only, 0.6)[:, :50]
    found = falloff(left_only)
    assert found is not None
    assert found.finding() is None
