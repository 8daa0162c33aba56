"""Views of patches whose disparities are told, against light fields drawn from the model by hand."""

from __future__ import annotations

import numpy as np
import pytest
from numpy.typing import NDArray

from dappled.decode.array_types import Complexes, Floats
from dappled.decode.joint.any_disparity import PatchBackground
from dappled.decode.joint.patch_model import KINDS, SIDE, USUAL, USUAL_KINDS, FrameModel, TexturePower, rests_of
from dappled.decode.joint.patches import Patches
from dappled.decode.joint.slice_model import SliceModel
from dappled.decode.joint.told_disparity import at_rest, shares_of, views_told
from dappled.decode.lightfield.aperture import Aperture, angular_frequencies
from tests.decode.joint.ray_sums import MASK

LEVELS = np.arange(-4.0, 5.0)
N = 40  # patches that are drawn


def _only(level: float) -> Floats:
    return np.where(level == LEVELS, 1.0, 0.0)


def _shares(disparity: Floats) -> Floats:
    return shares_of(disparity, LEVELS, Patches((disparity.shape[0], disparity.shape[1]), SIDE))


def test_a_plane_is_one_level_and_a_step_in_the_middle_of_a_patch_two_halves() -> None:
    np.testing.assert_array_equal(_shares(np.full((48, 48), 0.9)), [_only(1)] * 25)
    step = np.where(np.arange(72) < 36, -2.1, 1.4)[None, :] * np.ones((48, 1))
    found = _shares(step).reshape(5, 7, -1)
    np.testing.assert_array_equal(found[2, 1], _only(-2))  # samples 0 to 23
    np.testing.assert_array_equal(found[2, 2], _only(-2))  # 12 to 35
    np.testing.assert_allclose(found[2, 3], (_only(-2) + _only(1)) / 2, atol=1e-12)  # 24 to 47
    # The window is sin², of whose period the first quarter has 1/4 − 1/(2π) ≈ 9 %.
    quarter = _shares(np.roll(step, -6, axis=1)).reshape(5, 7, -1)[2, 3]
    np.testing.assert_allclose(quarter, 0.0908 * _only(-2) + 0.9092 * _only(1), atol=0.001)


def test_what_is_unknown_or_beyond_the_levels_tells_nothing() -> None:
    for strange in (np.nan, 5.1, -5.1):
        half = np.where(np.arange(48) < 24, 1.0, strange)[None, :] * np.ones((48, 1))
        found = _shares(half).reshape(5, 5, -1)
        np.testing.assert_array_equal(found[:, 0], [_only(1)] * 5)
        assert not found[:, 4].any()
    single = np.ones((48, 48))
    single[20, 20] = np.nan
    np.testing.assert_array_equal(_shares(single), [_only(1)] * 25)


def _at_rest(disparity: Floats) -> NDArray[np.bool_]:
    patches = Patches((disparity.shape[0], disparity.shape[1]), SIDE)
    return at_rest(disparity, 1.0, patches).reshape(patches.grid)


def test_a_patch_is_at_rest_where_none_of_it_moves_and_in_a_frame_at_rest_where_little_of_it_moves_far() -> None:
    half = np.where(np.arange(96) < 48, 0.8, 1.2)[None, :] * np.ones((96, 1))
    np.testing.assert_array_equal(_at_rest(half), np.broadcast_to(np.arange(9) < 4, (9, 9)))
    np.testing.assert_array_equal(_at_rest(-half), _at_rest(half))
    small = np.zeros((96, 96))
    small[30:54, 30:54] = 2.5  # 6 % of the frame, as folded edges of terrain have it
    assert _at_rest(small).all()
    small[30:54, 30:54] = 3.5  # a thing nearer than the rest
    assert not _at_rest(small)[3, 3]  # samples 24 to 47
    assert _at_rest(small)[:, 6:].all()
    small[:, 40:] = np.nan
    assert _at_rest(small)[:2].all()
    assert not _at_rest(np.full((96, 96), np.nan)).any()


def test_samples_that_are_unknown_here_and_there_move_no_level() -> None:
    chance = np.random.default_rng(2)
    disparity = np.where(np.arange(48) < 24, -3.0, 3.0)[None, :] * np.ones((48, 1))
    disparity[chance.uniform(size=disparity.shape) < 0.4] = np.nan
    one, mirrored = _shares(disparity), _shares(-disparity)[:, ::-1]
    np.testing.assert_array_equal(one, mirrored)
    middle = one.reshape(5, 5, -1)[2, 2]
    assert middle[LEVELS == 3] == pytest.approx(0.5, abs=0.06)
    assert middle[np.abs(LEVELS) == 3].sum() == pytest.approx(1)


def test_a_patch_has_no_more_than_eight_disparities() -> None:
    levels = np.linspace(-10, 10, 21)
    for wide in (1.0, 0.7, 0.45):
        slope = np.broadcast_to(np.linspace(-10, 10, 48) * wide, (48, 48)).copy()
        found = shares_of(slope, levels, Patches((48, 48), SIDE))
        assert (np.count_nonzero(found, axis=1) <= 8).all()
        np.testing.assert_allclose(found.sum(axis=1), 1)


def _frame(noise: float) -> FrameModel:
    orders = MASK.half_orders()
    aperture = Aperture(5)
    angular = angular_frequencies(orders, 1.0, 0.0)
    transfers = np.array([0.6 ** (abs(ky) + abs(kx)) for ky, kx in orders], dtype=np.complex128)
    carriers = np.array([(0.155 * ky, 0.155 * kx) for ky, kx in orders])
    model = SliceModel.of_half(orders, transfers, angular, carriers, aperture)
    return FrameModel.of(Patches((96, 96), SIDE), model, (6.5, 6.5), np.full(2 * len(orders) - 1, noise), reach=32.0)


def _complex_normal(chance: np.random.Generator, shape: tuple[int, ...]) -> Complexes:
    made = chance.normal(size=shape) + 1j * chance.normal(size=shape)
    return np.asarray(made / np.sqrt(2), dtype=np.complex64)


@pytest.mark.parametrize("kind", [USUAL_KINDS[1], pytest.param(USUAL_KINDS[3], marks=pytest.mark.slow)])
def test_errors_of_views_are_those_of_the_model_that_the_patches_were_drawn_from(kind: int) -> None:
    chance = np.random.default_rng(5)
    frame = _frame(1e-5)
    radius = frame.radius(frame.frequencies)
    spectrum = TexturePower.of(1 / (1 + radius**2.6), radius)
    own = spectrum.at(radius)
    rests = rests_of(frame, spectrum, own, 0.0)
    usual = frame.ranges[USUAL]
    seen, viewed = (part.reshape(len(own), -1, part.shape[3]) for part in (usual.seen, usual.viewed))
    shares = np.zeros((N, seen.shape[1]))
    shares[:, 40], shares[:, 12] = 0.6, 0.4
    detail = _complex_normal(chance, (len(own), seen.shape[1], N)) * np.sqrt(own[:, None, None] * shares.T)
    lonely = _complex_normal(chance, (len(own), viewed.shape[2], N)) * np.sqrt(KINDS[kind].alone * own)[:, None, None]
    own_rest = np.float32(KINDS[kind].alone) * (frame.alone @ frame.alone.conj().T) * own[:, None, None]
    lower = np.linalg.cholesky(rests.of(kind).astype(np.complex128) - own_rest + 1e-9 * np.eye(rests.of(kind).shape[1]))
    slices = (
        seen.transpose(0, 2, 1) @ detail + frame.alone @ lonely + lower @ _complex_normal(chance, (*lower.shape[:2], N))
    )
    views = viewed.transpose(0, 2, 1) @ detail + lonely
    found = views_told(frame, rests, slices.astype(np.complex64), shares)
    assert (found.kinds == kind).mean() > 0.9
    squares = np.einsum("fvn,f->vn", np.abs(found.spectra - views) ** 2, frame.multiplicity) / SIDE**2
    background = PatchBackground.of(rests.of(kind), frame.alone, KINDS[kind].alone * own)
    alone = frame.multiplicity @ background.left / SIDE**2
    np.testing.assert_allclose(squares.mean(axis=1), alone + found.rest.mean(axis=1), rtol=0.15)
    # Told other disparities the views are worse: this test can fail.
    other = np.zeros_like(shares)
    other[:, 26] = 1
    wrong = views_told(frame, rests, slices.astype(np.complex64), other)
    worse = np.einsum("fvn,f->vn", np.abs(wrong.spectra - views) ** 2, frame.multiplicity) / SIDE**2
    assert worse.mean() > 2 * squares.mean()
