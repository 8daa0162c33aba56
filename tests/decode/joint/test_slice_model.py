"""The model against integrals over the stop, point by point."""

from __future__ import annotations

import itertools

import numpy as np
import pytest

from dappled.decode.joint.slice_model import SliceModel, folded
from dappled.decode.lightfield.aperture import SHAPES, Aperture, Shape, angular_frequencies, transfer
from dappled.decode.optics.carriers import Mask

ORDERS = Mask(15.5, 2).half_orders()
TRANSFERS = transfer(ORDERS, [1.0, *[0.36] * 6, *[0.18] * 6], (0.31, -0.12))
STEP = 0.1535  # cycles/pixel from carrier to carrier


def _model(shape: Shape, kappa: float) -> SliceModel:
    angular = angular_frequencies(ORDERS, kappa, 0.01)
    return SliceModel.of_half(ORDERS, TRANSFERS, angular, angular / kappa * STEP, Aperture(5, shape))


def _stop(shape: Shape, parts: int = 20) -> tuple[np.ndarray, np.ndarray]:
    """(points (J, 2), the view of each)."""
    n = 5 if shape == "beams" else 5 * parts
    indices = np.array(list(itertools.product(range(n), repeat=2)))
    places = (indices + 0.5) / n - 0.5
    inside = np.hypot(*places.T) <= 0.5 if shape == "round" else np.ones(len(places), bool)
    cells = indices // (n // 5)
    return places[inside], (cells[:, 0] * 5 + cells[:, 1])[inside]


@pytest.mark.parametrize("shape", SHAPES)
def test_slices_and_views_of_a_wave_are_its_integrals_over_the_stop(shape: Shape) -> None:
    model, (points, view) = _model(shape, 0.9), _stop(shape)
    frequencies, disparity = np.array([[0.03, -0.05], [0.0, 0.07]]), 23.0
    seen, viewed = (part(frequencies, np.array([disparity]))[0] for part in (model.seen, model.viewed))
    for f, in_slices, in_views in zip(frequencies, seen, viewed, strict=True):
        light = np.exp(-2j * np.pi * disparity * points @ f)
        kernel = np.exp(2j * np.pi * points @ model.angular.T)
        np.testing.assert_allclose(in_slices, model.transfers * (light[:, None] * kernel).mean(axis=0), atol=2e-3)
        means = [light[view == v].mean() for v in range(25)]
        np.testing.assert_allclose(in_views, means, atol=0.02 if shape == "round" else 2e-3)


def test_detail_beyond_the_band_folds_into_the_slices_that_the_mask_sends_it_to() -> None:
    model, (points, _) = _model("filled", 1.0), _stop("filled", 8)
    frequencies, disparity, power = np.array([[0.02, 0.01]]), 2.0, 3.0
    found = folded(
        (folds := model.folds(frequencies, np.array([disparity]))),
        [np.full(1, power) for _ in folds],
        len(model.orders),
    )[0]
    wanted = np.zeros_like(found)
    orders = [tuple(order) for order in model.orders.tolist()]
    lattice = np.linalg.lstsq(model.orders.astype(float), model.carriers, rcond=None)[0]
    for m in itertools.product(range(-4, 5), repeat=2):
        if m == (0, 0):
            continue
        light = np.exp(-2j * np.pi * disparity * points @ (frequencies[0] + np.array(m) @ lattice))
        one = np.zeros(len(orders), complex)
        for n, (ky, kx) in enumerate(orders):
            if (ky - m[0], kx - m[1]) in orders:
                other = orders.index((ky - m[0], kx - m[1]))
                one[n] = model.transfers[other] * np.mean(light * np.exp(2j * np.pi * points @ model.angular[other]))
        wanted += power * np.outer(one, one.conj())
    np.testing.assert_allclose(found, wanted, atol=2e-3)
    assert np.abs(wanted).max() > 0.1


def test_what_a_wrong_aperture_leaves_in_the_means_is_told_from_parallax() -> None:
    model, chance = _model("round", 0.95), np.random.default_rng(3)
    f = np.hypot(np.fft.fftfreq(80)[:, None], np.fft.rfftfreq(96)[None])
    scene = np.fft.irfft2(np.fft.rfft2(chance.normal(size=(80, 96))) / np.maximum(f, 1 / 96) ** 1.2, s=(80, 96))
    scene = 0.35 * (1 + 0.2 * scene / scene.std())
    away = 0.02 * np.array([0, *((-1) ** n for n in range(len(ORDERS) - 1))]) * TRANSFERS
    parallax = 0.3 * TRANSFERS[:, None, None] * np.gradient(scene, axis=1)
    parallax[0] = 0
    right = model.common()[: len(ORDERS), None, None] * scene + parallax
    for off in (np.zeros_like(away), away):
        found, rms = model.unlike((right + off[:, None, None] * scene).astype(np.complex64))
        assert np.abs(found - off).max() < 0.25 * np.abs(away).max()
        assert rms < 0.005
    assert model.unlike(np.zeros((len(ORDERS), 80, 96), np.complex64))[1] == 0
