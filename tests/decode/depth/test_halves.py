"""What disparities leave unexplained of noisy slices: nothing but noise at the right one, in the half that sees it."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from scipy import ndimage

from dappled.decode.depth import estimate, halves
from dappled.decode.depth.evidence import Evidence
from dappled.decode.lightfield import ViewStack
from tests.decode.scenes import Board, paint

SIDE = 72
NOISE = 0.001
DISPARITIES = np.linspace(-1.5, 1.5, 13)


def measured(boards: list[Board], noise: float = NOISE, seed: int = 1) -> tuple[Evidence, np.ndarray]:
    """Evidence of 25 sums over the aperture as a mask takes them, orders −2 to 2 both ways, the outer ones fainter,
    each with white noise; and the true disparity. B = K·L, Q = KᵀB/n, W = KᵀK/n, by hand."""
    stack, truth = paint(boards, (SIDE, SIDE), 5)
    place = (np.arange(5) - 2) / 5
    one = np.stack([np.ones(5), *(f(2 * np.pi * k * place) for k in (1, 2) for f in (np.cos, np.sin))])
    strength = np.array([1.0, 0.3, 0.3, 0.2, 0.2])
    kernel = np.kron(strength[:, None] * one, strength[:, None] * one) / 25
    sums = kernel @ stack.views.reshape(25, -1)
    sums += np.random.default_rng(seed).normal(0, noise, sums.shape)
    images = (kernel.T @ sums / noise**2).reshape(stack.views.shape).astype(np.float32)
    blurred = ViewStack(np.zeros_like(stack.views) + stack.views.mean(axis=(0, 1)), stack.row_steps, stack.column_steps)
    return Evidence(blurred, images, kernel.T @ kernel / noise**2, white=True, middle=stack.middle()), truth


def inner(values: np.ndarray) -> np.ndarray:
    return values[..., 12:-12, 12:-12]


def test_the_right_disparity_leaves_noise_alone() -> None:
    evidence, _ = measured([Board(0.5)])
    part = halves.whole(evidence)
    left = inner(halves.unexplained(part, DISPARITIES))
    means = left.mean(axis=(1, 2))
    assert DISPARITIES[means.argmin()] == 0.5
    # A chi-squared of C − 1 has a variance of twice that: half of it scatters by √((C − 1)/2) a pixel.
    expected = np.sqrt((len(part.measured) - 1) / 2)
    assert abs(means.min()) < 0.3
    assert left[means.argmin()].std() == pytest.approx(expected, rel=0.1)


@pytest.mark.parametrize("which", [None, 0, 2])
def test_what_is_left_is_measured_less_the_best_picture(which: int | None) -> None:
    """As the formula says it, view by view, for a whole aperture that isn't square and for halves of both kinds."""
    rng = np.random.default_rng(7)
    steps = np.stack(np.meshgrid([-1.0, 0.0, 1.0], [-2.0, -1.0, 0.0, 1.0, 2.0], indexing="ij"), axis=-1).reshape(-1, 2)
    height, width, pad = 51, 57, halves._PAD  # with the pad odd: no frequency is its own mirror image
    drawn = rng.normal(size=(6, height, width)).astype(np.float32)
    part = halves.Part(drawn, rng.normal(size=(6, 15)), steps, 0.7)
    part = part if which is None else halves.halves(part)[which]
    found = halves.unexplained(part, np.array([0.4, -0.8]))
    spectra = np.fft.fft2(np.pad(part.measured, ((0, 0), (pad, pad), (pad, pad)), mode="symmetric"))
    fy, fx = np.meshgrid(*(np.fft.fftfreq(n + 2 * pad) for n in (height, width)), indexing="ij")
    for disparity, made in zip((0.4, -0.8), found, strict=True):
        turns = np.exp(-2j * np.pi * disparity * (part.steps[:, :1, None] * fy + part.steps[:, 1:, None] * fx))
        gains = np.tensordot(part.matrix, turns, 1)
        picture = (gains.conj() * spectra).sum(axis=0) / ((np.abs(gains) ** 2).sum(axis=0) + 1 / part.variance)
        left = np.fft.ifft2(spectra - gains * picture).real[:, pad:-pad, pad:-pad]
        expected = 0.5 * (left**2).sum(axis=0) - (len(part.measured) - 1) / 2
        np.testing.assert_allclose(made, expected, atol=1e-3 * expected.std())


def test_a_half_does_not_depend_on_what_the_other_views_see() -> None:
    evidence, _ = measured([Board(0.5)], noise=0.0001)
    part = halves.whole(evidence)
    others = part.steps[:, 1] > 0
    light = np.random.default_rng(3).normal(0, 1, (25, *evidence.images.shape[2:]))
    changed = np.tensordot(part.matrix[:, others], light[others], 1).astype(np.float32)
    seen = np.tensordot(part.matrix[:, ~others], light[~others], 1).astype(np.float32)
    half, whole = (
        float(np.std(replace(part, measured=values, variance=1.0).without(others).measured))
        for values in (changed, seen)
    )
    assert half < 0.01 * whole


def test_beside_a_jump_one_half_explains_what_is_behind() -> None:
    evidence, _ = measured([Board(-1.0), Board(1.0, half=(60.0, 12.0))])
    part = halves.whole(evidence)
    found = [
        ndimage.uniform_filter(halves.unexplained(one, np.array([-1.0])), (0, 3, 3))[0] for one in halves.halves(part)
    ]
    all_of_it = ndimage.uniform_filter(halves.unexplained(part, np.array([-1.0])), (0, 3, 3))[0]
    column = SIDE // 2 + 12 + 1  # right of the near board's edge
    beside = np.median(all_of_it[20:-20, column])
    least = np.median(np.min(found, axis=0)[20:-20, column])
    assert least < 0.1 * beside


def test_few_views_are_not_halved() -> None:
    evidence, _ = measured([Board(0.5)])
    part = halves.whole(evidence)
    few = halves.Part(part.measured, part.matrix[:, :2], part.steps[:2], part.variance)
    assert halves.halves(few) == [few]


def test_depth_of_noisy_slices_keeps_its_edges() -> None:
    evidence, truth = measured([Board(-0.8, mean=0.3), Board(0.9, half=(18.0, 14.0), mean=0.6)])
    made = estimate.estimate(evidence, between=(-1.3, 1.4))
    off = inner(np.abs(made.disparity - truth))
    assert np.mean(~(off < 0.1)) < 0.1
    by_contrast = estimate.estimate(evidence, "contrast", between=(-1.3, 1.4))
    assert np.mean(~(off < 0.1)) < 0.5 * np.mean(~(inner(np.abs(by_contrast.disparity - truth)) < 0.1))


def test_noise_alone_is_unknown() -> None:
    evidence, _ = measured([Board(0.5)])
    noise = np.random.default_rng(5).normal(0, 1, (25, SIDE, SIDE))
    values, vectors = np.linalg.eigh(evidence.weights)
    root = (vectors * np.sqrt(np.maximum(values, 0))) @ vectors.T
    images = (root @ noise.reshape(25, -1)).reshape(evidence.images.shape).astype(np.float32)
    made = estimate.estimate(replace(evidence, images=images), between=(-1.3, 1.4))
    assert made.known_share() < 0.1


def test_votes_are_limited() -> None:
    """One pixel's strong detail doesn't decide for its neighbours."""
    cost = np.ones((3, 9, 9), dtype=np.float32)
    cost[1] = 0.0  # most speak for the second
    cost[:, 4, 4] = (0.0, 1000.0, 1000.0)  # one, strongly, for the first
    made = halves.voted(cost, 5)
    assert int(made[:, 4, 6].argmin()) == 1
    assert int(made[:, 4, 4].argmin()) == 0


def test_the_outermost_pixels_are_not_used() -> None:
    """There slices hold the frame's end."""
    evidence, _ = measured([Board(0.5)])
    spoilt = evidence.images.copy()
    for edge in (0, -1):
        spoilt[..., edge, :] *= 100
        spoilt[..., :, edge] *= 100
    changed = replace(evidence, images=spoilt)
    made, known = (halves.whole(e).measured for e in (changed, evidence))
    np.testing.assert_array_equal(made, known)


@pytest.mark.parametrize("shape", [(1, 1), (2, 30)])
def test_slices_of_a_pixel_or_two_are_used_whole(shape: tuple[int, int]) -> None:
    evidence, _ = measured([Board(0.5)])
    part = halves.whole(replace(evidence, images=evidence.images[..., : shape[0], : shape[1]]))
    assert part.measured.shape[1:] == shape


def test_what_is_left_beyond_noise_makes_it_less_sure() -> None:
    """The same measurements with a third of their noise told: three times as far from every disparity's picture."""
    evidence, _ = measured([Board(0.5)])
    bold = replace(evidence, images=9 * evidence.images, weights=9 * evidence.weights)
    honest, misled = (float(np.nanmedian(estimate.estimate(e, between=(-0.5, 1.4)).sigma)) for e in (evidence, bold))
    assert misled > honest
