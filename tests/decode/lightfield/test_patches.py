from __future__ import annotations

import numpy as np
import pytest

from dappled.decode.lightfield.patches import Patches


@pytest.mark.parametrize("shape", [(40, 53), (24, 24)])
def test_patches_of_an_image_make_the_image_again(shape: tuple[int, int]) -> None:
    image = np.random.default_rng(0).normal(size=(1, *shape)).astype(np.complex64)
    patches = Patches(shape, 24)
    spectra = patches.spectra(patches.cut(image))
    np.testing.assert_allclose(patches.joined(patches.images(spectra)), image.real, atol=1e-5)


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
