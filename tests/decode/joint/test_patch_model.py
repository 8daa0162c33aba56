"""What a patch's slices say of how much of them no light field explains."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from dappled.decode.joint.patch_model import (
    SIDE,
    USUAL,
    USUAL_KINDS,
    FrameModel,
    TexturePower,
    detail_of,
    likely_errors,
    rests_of,
)
from dappled.decode.joint.patches import Patches
from dappled.decode.joint.slice_model import SliceModel
from dappled.decode.lightfield.aperture import Aperture, angular_frequencies
from tests.decode.joint.ray_sums import MASK

ERRORS = (5e-4, 5e-6)
SHORT = 3.2  # waves over a patch


def test_a_patch_says_how_much_of_it_no_light_field_explains() -> None:
    """Patches of one scene: where edges of opaque things leave something, where nothing is left, and where long waves
    are explained and short ones are not, as beside an edge, which are not to be trusted as the second are; and where
    nothing is left of light that has ten times the power of its group."""
    orders = MASK.half_orders()
    transfers = np.array([0.5 ** ((ky != 0) + (kx != 0)) for ky, kx in orders], dtype=np.complex128)
    angular = angular_frequencies(orders, 1.0, 0.0)
    model = SliceModel.of_half(orders, transfers, angular, 0.15 * np.array(orders, dtype=np.float64), Aperture(5))
    whole = FrameModel.of(Patches((48, 60), SIDE), model, (6.6, 6.6), np.full(25, 1e-8), 33.0, ranges=(USUAL,))
    radius = whole.radius(whole.frequencies)
    texture = TexturePower.of(np.maximum(radius, 1) ** -4.0, radius)
    own, kind = texture.at(radius), USUAL_KINDS[1]
    frames = [replace(whole, error=error) for error in ERRORS]
    rests = [rests_of(frame, texture, own, 0.3) for frame in frames]
    large, small = (
        np.linalg.cholesky(rest.whole(kind, detail_of(frame.ranges[USUAL].seen, own)).astype(np.complex128))
        for frame, rest in zip(frames, rests, strict=True)
    )
    chance = np.random.default_rng(4)
    drawn = []
    beside_edge = np.where((radius < SHORT)[:, None, None], small, large)
    for roots in (large, small, beside_edge, np.sqrt(10) * small):
        white = chance.normal(size=(2, len(radius), 25, 12)) / np.sqrt(2)
        drawn.append(roots @ (white[0] + 1j * white[1]))
    spectra, second = np.concatenate(drawn, axis=2).astype(np.complex64), np.repeat([0, 1, 0, 1], 12)
    found = likely_errors(frames, rests, np.full(48, kind), spectra)
    assert np.count_nonzero(found == second) >= 46, found
    assert not likely_errors(frames, rests, np.zeros(48, dtype=np.intp), spectra).any()  # at rest: not asked
