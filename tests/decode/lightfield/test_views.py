from __future__ import annotations

import numpy as np
import pytest

from dappled.decode.lightfield.aperture import SHAPES, Aperture, angular_frequencies, kappa, transfer
from dappled.decode.lightfield.views import combine, finest_detail, from_slices, unmixing
from dappled.decode.optics.carriers import Mask

ORDERS = Mask(15.5, 2).half_orders()


def _slices(views: np.ndarray, angular: np.ndarray, transfers: np.ndarray) -> np.ndarray:
    n = views.shape[0]
    kernel = np.exp(2j * np.pi * angular @ Aperture(n).points().T) / n**2
    return np.asarray((transfers[:, None] * kernel @ views.reshape(n * n, -1)), np.complex64).reshape(
        -1, *views.shape[2:]
    )


def _views(seed: int = 0, spread: float = 0.05) -> np.ndarray:
    rng = np.random.default_rng(seed)
    return 0.4 + 0.1 * rng.normal(size=(1, 1, 12, 14)) + spread * rng.normal(size=(5, 5, 12, 14))


def test_reference_camera_is_at_the_ideal_frequency() -> None:
    assert kappa(15.5, 0.48, 50.0, 50 / 6.7) == pytest.approx(0.997, abs=1e-3)


@pytest.mark.parametrize("cycles", [0.9, 1.0, 1.1])
@pytest.mark.parametrize("rotation", [0.0, 0.035])
def test_views_come_back_from_their_slices(cycles: float, rotation: float) -> None:
    views = _views()
    transfers = transfer(ORDERS, [1.0, *[0.5] * 6, *[-0.25] * 6], (0.31, -0.12))
    angular = angular_frequencies(ORDERS, cycles, rotation)
    found = from_slices(
        _slices(views, angular, transfers),
        angular,
        transfers,
        aperture=Aperture(5),
        noise_variance=0.0,
        model_error=0.0,
    )
    np.testing.assert_allclose(found, views, atol=2e-3)
    np.testing.assert_allclose(Aperture(5).offsets()[0, 4], (-0.4, 0.4))


def test_at_the_ideal_frequency_without_noise_it_is_the_inverse_dft() -> None:
    angular = angular_frequencies(ORDERS, 1.0, 0.0)
    ones = np.ones(len(ORDERS), dtype=np.complex128)
    found = unmixing(angular, ones, Aperture(5), noise_variance=0.0, view_variance=1.0)
    dft = np.exp(-2j * np.pi * Aperture(5).points() @ angular.T) * np.where(np.arange(13) == 0, 1, 2)
    np.testing.assert_allclose(found, dft, atol=1e-4)


def test_noise_turns_weak_carriers_down() -> None:
    angular = angular_frequencies(ORDERS, 1.0, 0.0)
    transfers = np.array([1.0, *[0.5] * 11, 0.01], dtype=np.complex128)
    found = unmixing(angular, transfers, Aperture(5), noise_variance=1e-4, view_variance=1e-2)
    gain = np.abs(found * transfers).max(axis=0)
    power = 1e-2 / 25  # of one angular coefficient
    wiener = power / (power + 1e-4 / np.abs(transfers) ** 2)
    np.testing.assert_allclose(gain[1:], 2 * wiener[1:], rtol=1e-3)


def test_a_stopped_down_frame_gives_its_one_image_not_noise() -> None:
    views = np.broadcast_to(_views(spread=0.0), (5, 5, 12, 14))
    transfers = transfer(ORDERS, [1.0, *[0.5] * 12], (0.1, 0.2))
    angular = angular_frequencies(ORDERS, 0.125, 0.0)
    slices = _slices(views, angular, transfers)
    noise = 1e-3 * np.random.default_rng(1).normal(size=(2, *slices.shape))
    noisy = (slices + noise[0] + 1j * noise[1]).astype(np.complex64)
    found = from_slices(
        noisy,
        angular,
        transfers,
        aperture=Aperture(5),
        noise_variance=2e-6,
    )
    assert np.sqrt(np.mean((found - views) ** 2)) < 5e-3


def test_a_diagonal_mask_leaves_what_it_does_not_sample_at_the_common_image() -> None:
    orders = Mask(15.5, 2, "diagonal").half_orders()
    transfers = np.ones(len(orders), dtype=np.complex128)
    angular = angular_frequencies(orders, 1.0, 0.0)
    v, u = Aperture(5).points().T
    along = 0.4 + 0.1 * np.cos(2 * np.pi * (v + u))  # sampled
    across = 0.4 + 0.1 * np.cos(2 * np.pi * v)  # not sampled
    for light, expected in ((along, along), (across, np.full(25, 0.4))):
        views = np.broadcast_to(light.reshape(5, 5, 1, 1), (5, 5, 6, 6))
        found = from_slices(
            _slices(views, angular, transfers),
            angular,
            transfers,
            aperture=Aperture(5),
            noise_variance=0.0,
        )
        np.testing.assert_allclose(found[..., 0, 0].ravel(), expected, atol=2e-3)


def test_apertures_sum_to_one_and_a_round_one_loses_its_corners() -> None:
    angular = angular_frequencies(ORDERS, 0.97, 0.02)
    for shape in SHAPES:
        aperture = Aperture(5, shape)
        assert aperture.cells(np.zeros((1, 2))).sum() == pytest.approx(1.0)
        assert aperture.transform(np.zeros((1, 2)))[0] == pytest.approx(1.0)
        np.testing.assert_allclose(aperture.cells(angular).sum(axis=1), aperture.transform(angular), atol=5e-4)
    shares = Aperture(5, "round").cells(np.zeros((1, 2)))[0].real.reshape(5, 5)
    assert shares[2, 2] == pytest.approx(4 / (25 * np.pi), rel=1e-3)
    assert shares[0, 0] < 0.4 * shares[2, 2]
    bessel_at_half = 0.7217  # 2 J1(π/2) / (π/2)
    assert Aperture(5, "round").transform(np.array([[0.0, 0.5]]))[0].real == pytest.approx(bessel_at_half, abs=1e-4)


def test_combining_is_the_real_part_of_the_product() -> None:
    rng = np.random.default_rng(0)
    slices = (rng.normal(size=(4, 5, 6)) + 1j * rng.normal(size=(4, 5, 6))).astype(np.complex64)
    g = rng.normal(size=(3, 4)) + 1j * rng.normal(size=(3, 4))
    np.testing.assert_allclose(combine(g, slices), np.einsum("vk,khw->vhw", g, slices).real, atol=1e-5)


def test_the_finest_detail_tells_white_noise_and_is_blind_to_slow_change() -> None:
    rng = np.random.default_rng(5)
    noise = rng.normal(0, 0.3, (200, 220)) + 1j * rng.normal(0, 0.4, (200, 220))
    y, x = np.mgrid[0:200, 0:220] / 220
    assert finest_detail(noise + 5 * y - 3j * x * y) == pytest.approx(0.25, rel=0.03)
    assert finest_detail(np.ones((2, 9), dtype=complex)) == 0.0
