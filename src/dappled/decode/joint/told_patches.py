"""Which patches are taken as a depth map tells them, and how well their views are known then."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy import ndimage

from dappled.decode.array_types import Floats, Singles
from dappled.decode.joint.patch_model import KINDS, USUAL_KINDS
from dappled.decode.joint.patches import Patches

# Chosen by hand where no figure stands beside a number; benchmarks/views.py measures what all of them together make.

# Where things shine through each other a sample has two disparities, and a depth map one. All patches around are then
# less probable as told than with all disparities at once, there by 3600 nats in the mean; at edges of opaque things
# single ones are, there by up to 3400, and by 1500 in the mean. Two textures over each other have 34.9 dB as told, and
# 39.8 not told.
_TRANSPARENT_NATS, _AROUND = 2000.0, 5
# Of patches that a depth map tells their disparities, for each kind: 68 % of errors are within the root of so many
# times the geometric mean of two variances, by how much the patch and its neighbours were apart before they were told,
# and what the model leaves to the median patch. The first misses errors that neighbours share, the second the model's.
_TOLD_TWICE = dict(zip(USUAL_KINDS, (1.8, 1.04, 2.76, 1.24, 1.49, 1.51), strict=True))
_IN_BAND = [kind for kind in USUAL_KINDS if KINDS[kind].beyond < 1]  # hardly any detail beyond the band


@dataclass(frozen=True, slots=True, eq=False)
class ToldPatches:
    """Patches, the `members` (M,) of all, as a depth map tells them: `windowed` (M, V·U, side, side), their `kinds`
    (M,), the variance of the `rest` (V·U, M), and by how many nats they are more probable than with all disparities at
    once: `gained` (M,)."""

    members: NDArray[np.intp]
    windowed: Singles
    kinds: NDArray[np.intp]
    rest: Floats
    gained: Floats

    @property
    def in_band(self) -> NDArray[np.bool_]:
        """(M,) which of them have hardly any detail beyond the band."""
        return np.isin(self.kinds, _IN_BAND)


def likely_told(told: list[ToldPatches], patches: Patches) -> NDArray[np.bool_]:
    """(N,) which patches were told disparities, and are not far less probable so, with those around."""
    gained, count = np.zeros((2, len(patches.corners)))
    for part in told:
        gained[part.members], count[part.members] = part.gained, 1
    around, there = (
        ndimage.uniform_filter(values.reshape(patches.grid), _AROUND, mode="constant").ravel()
        for values in (gained, count)
    )
    return np.asarray((count > 0) & (around >= -_TRANSPARENT_NATS * there))


def write_variance(variance: Floats, apart: Floats, told: list[ToldPatches], likely: NDArray[np.bool_]) -> None:
    """Write the `variance` (V·U, N) of patches that are `likely` (N,) as told, from how far patches were `apart`
    (V·U, N) before."""
    if not likely.any():
        return
    typical = np.median(np.concatenate([part.rest[:, likely[part.members]] for part in told], axis=1), axis=1)
    for part in told:
        kept = likely[part.members]
        members = part.members[kept]
        times = np.array([_TOLD_TWICE[kind] for kind in part.kinds[kept]])
        variance[:, members] = times * np.sqrt(apart[:, members] * typical[:, None])
