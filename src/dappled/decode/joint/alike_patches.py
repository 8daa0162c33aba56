"""Which patches of a frame are alike, and what a model of each group says of them: `AlikePatches`.

Patches of similar texture share a spectrum. Of each group there is a model with each share of a slice's power that no
light field explains; patches of one group, one of these and a kind each are `LookedPatches`.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from dappled.decode.array_types import Complexes, Floats, Singles
from dappled.decode.joint.patch_model import (
    FrameModel,
    Rests,
    TexturePower,
    likely_errors,
    likely_kinds,
    moved_nats,
    parallax_nats,
    rests_in,
    rests_of,
    some_of,
)
from dappled.decode.joint.patches import Patches
from dappled.workers import each

# Chosen by hand where no figure stands beside a number; benchmarks/views.py measures what all of them together make.

_TEXTURES = 3  # groups of patches of similar texture, each with its own spectrum
_FEWEST = 12  # patches in a group
# Of a slice's power, what no light field explains: what edges of opaque things leave, or next to nothing. Each patch
# says which (`likely_errors`): boards that hide each other, SNR 100, have 43.1 dB with the first alone, 42.5 with the
# second and 43.0 so; boards that blend, without noise, 53.4, 58.8 and 58.8; apart, 52.1, 57.1 and 57.1.
_ERRORS = (5e-4, 5e-6)
_RING = 0.06  # of what a slice holds of a scene's mean: the frame's end rings in it, as far as a patch from the edge


@dataclass(frozen=True, slots=True, eq=False)
class LookedPatches:
    """Patches of one group and one error, the `members` (M,) of all: their `frame`, the `rests` of each kind, and which
    `kinds` (M,) with parallax they are likely to be, ascending."""

    members: NDArray[np.intp]
    frame: FrameModel
    rests: Rests
    kinds: NDArray[np.intp]


@dataclass(frozen=True, slots=True, eq=False)
class AlikePatches:
    """Patches of similar texture, the `members` (M,) of all: the `frames` with each of `_ERRORS`, and the `rests` of
    each kind in each."""

    members: NDArray[np.intp]
    frames: Sequence[FrameModel]
    rests: Sequence[Rests]

    @classmethod
    def of(cls, frame: FrameModel, power: Floats, mean: float, members: NDArray[np.intp]) -> AlikePatches:
        """From the mean power (F,) of the first slice and the mean of all patches that look alike."""
        radius = frame.radius(frame.frequencies)
        spectrum = TexturePower.of(np.maximum(power - frame.noise[0], 0), radius)
        frames = [replace(frame, error=error) for error in _ERRORS]
        first = rests_of(frames[0], spectrum, spectrum.at(radius), mean)
        return cls(members, frames, [first, *(rests_in(one, first, mean) for one in frames[1:])])

    def moved(self, spectra: Complexes) -> Floats:
        """(N,) by how many nats parallax is more probable than none in some of them with these `spectra` (F, A, N):
        hardly any where next to nothing is unexplained, as a larger error takes small parallax for its own, or more
        than that, of which `moved_nats` says nothing where it can't be told from folded detail."""
        hardly = moved_nats(self.frames[-1], self.rests[-1], spectra)
        return np.maximum(hardly, parallax_nats(self.frames[0], self.rests[0], spectra))

    def still(self, members: NDArray[np.intp]) -> LookedPatches:
        """Those `members` (N,) without parallax: nothing hides a thing there, and next to nothing is unexplained."""
        return LookedPatches(members, self.frames[-1], self.rests[-1], np.zeros(len(members), dtype=np.intp))

    def looked(self, members: NDArray[np.intp], spectra: Complexes) -> list[tuple[LookedPatches, Complexes]]:
        """Those `members` (N,) of each likely error, with their `spectra` (F, A, N)."""
        if not len(members):
            return []
        kinds = likely_kinds(self.frames[0], self.rests[0], spectra, with_parallax=True)
        likely = likely_errors(self.frames, self.rests, kinds, spectra)
        order = np.argsort(kinds, kind="stable")
        apart = (order[likely[order] == number] for number in range(len(self.frames)))
        return [
            (LookedPatches(members[some], one, rests, kinds[some]), some_of(spectra, some))
            for one, rests, some in zip(self.frames, self.rests, apart, strict=True)
            if len(some)
        ]


def alike_patches(
    frame: FrameModel, patches: Patches, first: tuple[Complexes, Floats], stray: Floats, workers: int = 1
) -> list[AlikePatches]:
    """The groups of a frame's patches, the largest first, by the `first` slice: its patches (1, N, side, side) without
    their means, and these (N,); `stray` (N,) is `astray` of `joint_views`."""
    cut, means = first
    group = _groups(cut[0].real, patches)
    rings = np.concatenate([[0.0], _RING * np.abs(frame.model.common()[1:])])
    # Patches that light goes astray in are apart, but have the spectrum of their group.
    parts = [
        (alike, np.flatnonzero(alike & (stray == share)))
        for alike in (group == number for number in np.unique(group))
        for share in np.unique(stray[alike])
    ]
    parts.sort(key=lambda part: -len(part[1]))  # a large one that is left to the end is waited for
    found: dict[int, AlikePatches] = {}

    def make(part: int) -> None:
        alike, members = parts[part]
        mean = float(np.sqrt(np.mean(means[alike] ** 2)))
        ringing = rings * mean if group[members[0]] == _TEXTURES else np.zeros(len(rings))
        here = replace(frame, noise=frame.noise + ringing**2, astray=float(stray[members[0]]))
        power = (np.abs(patches.spectra(cut[:, alike])[:, 0]) ** 2).mean(axis=1)
        found[part] = AlikePatches.of(here, power, mean, members)

    each(make, range(len(parts)), workers)
    return [found[part] for part in range(len(parts))]


def _groups(images: Singles, patches: Patches) -> NDArray[np.intp]:
    """(N,) which patches (N, side, side) are alike, by how much fine detail they have: `_TEXTURES` for those at the
    edges, fewer for others."""
    rows, columns = np.diff(images, axis=1)[:, :, 1:], np.diff(images, axis=2)[:, 1:, :]
    texture = np.einsum("nyx,yx->n", rows**2 + columns**2, patches.window[1:, 1:])
    count = max(1, min(_TEXTURES, len(images) // _FEWEST))
    group = np.searchsorted(np.quantile(texture, np.arange(1, count) / count), texture)
    return np.asarray(np.where(patches.at_edges, _TEXTURES, group))
