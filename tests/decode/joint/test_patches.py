from __future__ import annotations

import numpy as np
import pytest

from dappled.decode.joint.patches import Patches


@pytest.mark.parametrize("shape", [(40, 53), (24, 24)])
def test_patches_of_an_image_make_the_image_again(shape: tuple[int, int]) -> None:
    image = np.random.default_rng(0).normal(size=(1, *shape)).astype(np.complex64)
    patches = Patches(shape, 24)
    spectra = patches.spectra(patches.cut(image))
    np.testing.assert_allclose(patches.joined(patches.images(spectra)), image.real, atol=1e-5)


def test_an_even_light_is_taken_out_of_every_image_as_each_holds_it() -> None:
    light = np.array([1.0, 0.5j, -0.25], dtype=np.complex128)
    patches = Patches((40, 53), 24)
    even = np.broadcast_to(3 * light[:, None, None], (3, 40, 53)).astype(np.complex64)
    left, means = patches.less_means(patches.cut(even), light)
    np.testing.assert_allclose(means, 3, rtol=1e-6)
    np.testing.assert_allclose(left, 0, atol=1e-6)


@pytest.mark.parametrize("shape", [(40, 53), (24, 24)])
def test_patches_of_one_shade_are_not_apart_at_the_edges_of_their_images_either(shape: tuple[int, int]) -> None:
    patches = Patches(shape, 24)
    alike = np.broadcast_to(3 * patches.window.astype(np.float32), (len(patches.corners), 1, 24, 24))
    np.testing.assert_allclose(patches.apart(alike, patches.joined(alike)), 0, atol=1e-9)


def test_patches_are_apart_by_what_each_has_alone() -> None:
    """White noise of variance 1 in each patch: where four overlap with weights w², each is (1 − w²)² of its own away
    from what they are joined to, and the w⁴ of the others."""
    patches = Patches((60, 72), 24)
    chance = np.random.default_rng(2).normal(size=(len(patches.corners), 100, 24, 24))
    noisy = (chance * patches.window).astype(np.float32)
    apart = patches.apart(noisy, patches.joined(noisy))
    share = patches.window**2
    others = np.roll(share, 12, 0) ** 2 + np.roll(share, 12, 1) ** 2 + np.roll(share, 12, (0, 1)) ** 2
    expected = (share * ((1 - share) ** 2 + others)).sum() / share.sum()
    assert apart[:, ~patches.at_edges].mean() == pytest.approx(expected, rel=0.01)


def test_spectra_keep_the_variance_of_white_noise_and_hold_conjugates_behind() -> None:
    rng = np.random.default_rng(1)
    images = (rng.normal(size=(3, 120, 120)) + 1j * rng.normal(size=(3, 120, 120))).astype(np.complex64)
    patches = Patches((120, 120), 24)
    cut = patches.cut(images)
    spectra = patches.spectra(cut)
    assert spectra.shape == (24 * 13, 5, cut.shape[1])
    inner = np.mean(np.abs(spectra[:, 1]) ** 2)
    assert inner == pytest.approx(2, rel=0.1)
    conjugate = patches.spectra(np.conj(cut[1:2]))
    np.testing.assert_allclose(spectra[:, 3], conjugate[:, 0], atol=1e-4)
