"""Pairs of views against the views themselves, and slices that are turned back against those that are not."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from dappled.decode.array_types import Complexes
from dappled.decode.joint.any_disparity import PatchBackground, views_at_any
from dappled.decode.joint.patch_model import KINDS, SIDE, USUAL, USUAL_KINDS, FrameModel, TexturePower, rests_of
from dappled.decode.joint.patches import Patches
from dappled.decode.joint.slice_model import SliceModel
from dappled.decode.joint.told_disparity import views_told
from dappled.decode.joint.view_pairs import paired, variance_of_views, views_of
from dappled.decode.lightfield.aperture import Aperture, angular_frequencies, transfer
from tests.decode.joint.ray_sums import MASK

N = 12
ORDERS = MASK.half_orders()


def _model(views: int = 5) -> SliceModel:
    magnitudes = [1.0, *((-1.0) ** (ky + kx) * 0.5 ** (abs(ky) + abs(kx)) for ky, kx in ORDERS[1:])]
    angular = angular_frequencies(ORDERS, 0.93, 0.01)
    placed = transfer(ORDERS, magnitudes, (0.31, -0.12))
    return SliceModel.of_half(ORDERS, placed, angular, angular / 0.93 * 0.155, Aperture(views, "round"))


def _complex_normal(chance: np.random.Generator, *shape: int) -> Complexes:
    return (chance.normal(size=shape) + 1j * chance.normal(size=shape)).astype(np.complex64)


def test_pairs_hold_what_their_views_hold() -> None:
    for count in (4, 5):
        model, chance = _model(count), np.random.default_rng(count)
        pairs = _complex_normal(chance, 1, count**2, 3)
        views = views_of(pairs)
        np.testing.assert_allclose((np.abs(views) ** 2).sum(), (np.abs(pairs) ** 2).sum(), rtol=1e-5)
        # The slices of what views have alone, and the views of a wave.
        cells = model.transfers[:, None] * model.aperture.cells(model.angular)
        np.testing.assert_allclose(model.alone() @ pairs[0], cells @ views[0], atol=1e-5)
        held = model.viewed(np.array([[0.03, -0.05]]), np.array([11.0]))[0]
        again = views_of(paired(held)[:, :, None].astype(np.complex64))[:, :, 0]
        np.testing.assert_allclose(again, held, atol=1e-6)


def test_slices_that_are_turned_back_have_the_same_views_by_real_numbers_alone() -> None:
    chance = np.random.default_rng(3)
    white, kind = _complex_normal(chance, 312, len(_model().orders), N), USUAL_KINDS[2]
    shares = np.zeros((N, 51))
    shares[np.arange(N), chance.integers(0, 25, N)] = 0.6
    shares[np.arange(N), chance.integers(26, 50, N)] = 0.4
    wave, slices, found = _complex_normal(chance, 312, 51, N), None, []
    for model in (_model(), _model().upright()):
        noise = np.full(len(model.orders), 1e-5)
        frame = FrameModel.of(Patches((48, 60), SIDE), model, (6.5, 6.5), noise, 32.0, ranges=(USUAL,))
        frame = replace(frame, folds=dict.fromkeys((USUAL - 1, USUAL), frame.folds[USUAL]))
        radius = frame.radius(frame.frequencies)
        texture = TexturePower.of(1 / (1 + radius**2.6), radius)
        own = texture.at(radius)
        rests = rests_of(frame, texture, own, 0.3)
        if slices is None:
            seen = frame.ranges[USUAL].seen.reshape(len(own), -1, white.shape[1])
            lower = np.linalg.cholesky(rests.of(kind).astype(np.complex128))
            slices = lower @ white + seen.transpose(0, 2, 1) @ (wave * np.sqrt(own[:, None, None] * shares.T))
        turned = (slices * model.turns[:, None].conj()).astype(np.complex64)
        background = PatchBackground.of(rests.of(kind), frame.alone, KINDS[kind].alone * own)
        ((_, any_views, variance),) = views_at_any(frame, frame.ranges[USUAL], own, background, turned)
        told = views_told(frame, rests, turned, shares)
        found.append(
            (
                views_of(any_views),
                variance_of_views(variance),
                views_of(told.spectra),
                variance_of_views(told.rest),
                told.nats,
            )
        )
        terms = frame.alone, rests.of(kind), frame.ranges[USUAL].seen, background.whitener
        assert {np.isrealobj(one) for one in terms} == {model.transfers.dtype == np.float64}
    for one, other in zip(*found, strict=True):
        np.testing.assert_allclose(other, one, atol=1e-5 * np.abs(one).max())
