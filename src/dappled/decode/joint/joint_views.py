"""Make views from slices by one model of the light field: its parts have disparities, and its texture a spectrum.

Views of a scene are not independent of each other at a spatial frequency f: where disparities are spread as p(D), views
i and j covary as S(f)·∫ p(D) exp(−2πi D f·(θ_i − θ_j)) dD. Here p(D) is estimated patch by patch. Slices are linear
measurements of the light field (`slice_model`): the band's own detail, detail that folds in from beyond the band, and
noise. In each patch and at each frequency the views are the most probable ones (Wiener). Patches of similar texture
share a spectrum. Likelihood decides in each patch how much detail there is beyond the band, whether disparities lie in
the usual range or farther, and whether views have more alone than in common: a thing out of all ranges, or an edge.

Patches are looked at twice: at first any disparity may be there (`any_disparity`); a depth map of these first views
tells which patches have hardly any parallax, and the disparities of the others, and views are made again
(`told_disparity`). In a calm frame, one of which a few patches from all over say that it has no parallax, as from the
air, most patches are made without any at once, and only those that say otherwise are looked at so.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from dappled.decode.array_types import Complexes, Floats, Singles
from dappled.decode.depth.estimate import estimate
from dappled.decode.depth.evidence import of_views
from dappled.decode.joint.alike_patches import AlikePatches, LookedPatches, alike_patches
from dappled.decode.joint.any_disparity import PatchBackground, views_at_any
from dappled.decode.joint.patch_model import (
    AT_A_TIME,
    BEYOND,
    CALM_NATS,
    KINDS,
    MOTIONLESS_RANGE,
    MOVES_NATS,
    SIDE,
    STILL,
    USUAL,
    USUAL_KINDS,
    FrameModel,
    is_calm,
    is_motionless,
    likely_kinds,
    moved_nats,
    some_of,
    usual_nats,
)
from dappled.decode.joint.patches import Patches
from dappled.decode.joint.slice_model import SliceModel
from dappled.decode.joint.told_disparity import MOST_STILL, at_rest, shares_of, views_told
from dappled.decode.joint.told_patches import ToldPatches, likely_told, write_variance
from dappled.decode.joint.view_pairs import variance_of_views, views_of
from dappled.decode.lightfield import ViewStack
from dappled.decode.lightfield.aperture import Aperture
from dappled.workers import each, spans

# Chosen by hand where no figure stands beside a number; benchmarks/views.py measures what all of them together make.

_FEWEST_VIEWS = 3  # along an axis: depth compares them with the middle one
# Of views whose patches a depth map tells their disparities; the rest are their first views. With all of it, views of
# boards with hard edges gain 0.1 to 0.3 dB more, and those of boards that blend lose 0.4 dB instead of 0.2.
_TRUST = np.float32(0.75)
_UNLIKE = 1e-4  # of the light, times a transfer: what a slice's mean doesn't tell of a wrong aperture
_SAMPLE = 128  # patches, at least: so many say whether a frame is calm
# Of a patch's mean square difference to the views that it and its neighbours were joined to, of the model's variance of
# what views have alone, and of all else of it, for each kind: 68 % of errors are within the root of the sum. Fitted by
# hand to frames of benchmarks/views.py; docs/decoding.md has what share of errors is within on which family.
_TOLD = (
    *((0.16, 0.47, 0.14), *((1.2, 0.85, 0.35),) * 4),
    *((1.6, 0.04, 0.3), *((1.8, 0.01, 0.15),) * 2, *((0.25, 0.05, 1.2),) * 3, (0.45, 0.05, 0.4)),
    *((1.0, 0.9, 1.0),) * 6,
)
_TOLD_MOTIONLESS = (0.7, 0.86, 2.65)  # the same, of patches at rest that are as good as motionless


@dataclass(frozen=True, slots=True, eq=False)
class JointViews:
    """`views` float32 (V, U, h, w), and their standard errors `sigma` float32 (V, U, m, n), one for each patch: in the
    view's samples patch (i, j) lies around (S·i − 0.5, S·j − 0.5), S = SIDE / 2.

    `shares` of its patches say how views were made.
    """

    views: Singles
    sigma: Singles
    shares: PatchShares


@dataclass(frozen=True, slots=True)
class PatchShares:
    """Shares of a frame's patches: with disparities `told` by a depth map, `at_rest`, and of the rest those whose
    disparity is `beyond` `FARTHEST` times the reach, where views are smeared, and those in which slices `contradict`
    the depth map, as where things shine through each other. `in_band` are patches that have hardly any detail beyond
    the band."""

    told: float
    at_rest: float
    beyond: float
    contradict: float
    in_band: float


def joint_views(
    slices: Complexes,
    model: SliceModel,
    *,
    samples_px: tuple[float, float],
    noise: Floats,
    reach: float,
    astray: Floats | None = None,
    workers: int = 1,
) -> JointViews:
    """The views of slices complex64 (K, h, w), the half plane of `model`, DC first.

    `samples_px` are the rows and columns of a slice's sample in sensor columns, `noise` (K,) the variances of slice
    pixels, `reach` the largest usual disparity in sensor columns over the aperture, `astray` (patches,) the share of
    a patch's light that gets into each slice but the first, whatever its transfer, row by row of `sigma`; None: none.
    """
    patches = Patches((slices.shape[1], slices.shape[2]), SIDE)
    off, unlike = model.unlike(slices)
    model = model.upright()
    back = model.turns[: len(slices)].conj()
    common = model.common()[: len(slices)] + (off * back).real
    first = patches.less_means(patches.cut(slices[:1]), common[:1])  # which is real as it is
    frame = FrameModel.of(patches, model, samples_px, np.concatenate([noise, noise[1:]]), reach, workers=workers)
    frame = replace(frame, unlike=math.hypot(unlike, _UNLIKE))
    means = first[1]
    groups = alike_patches(frame, patches, first, np.zeros(len(means)) if astray is None else astray, workers)
    spectra_of = _PatchSpectra(patches, slices, back.astype(np.complex64), common)
    made = _PatchViews.empty(patches, means, model.aperture.views)
    deep = model.aperture.views >= _FEWEST_VIEWS
    # By how many nats patches moved: known of those of a calm frame.
    moved = np.full(len(means), np.nan) if deep and _is_calm(groups, spectra_of, workers) else None
    found: dict[int, list[LookedPatches]] = {}

    def look(number: int) -> None:
        found[number] = made.look(groups[number], spectra_of, moved)

    each(look, range(len(groups)), workers)
    looked = [one for number in range(len(groups)) for one in found[number]]
    still = likely = np.zeros(len(means), dtype=bool)
    told: list[ToldPatches] = []
    if deep:
        depths = _depths(made.views(), model.aperture, samples_px, workers)
        still = at_rest(depths, STILL * reach, patches)
        made.solve_at_rest(looked, still, spectra_of, moved, workers)
        if moved is not None:
            still |= moved < CALM_NATS
        shares = shares_of(depths, frame.ranges[USUAL].disparities, patches)
        shares[still] = 0
        each(lambda one: told.extend(made.told(one, shares, spectra_of)), looked, workers)
        likely = likely_told(told, patches)
    apart = made.apart()
    variance = made.variance + made.of_apart * apart
    made.take(told, likely)
    write_variance(variance, apart, told, likely)
    sigma = np.sqrt(variance).astype(np.float32)
    shape = model.aperture.views, model.aperture.views
    views = made.views().reshape(*shape, *slices.shape[1:])
    tried = sum(len(part.members) for part in told) / len(means)
    how = PatchShares(
        told=float(likely.mean()),
        at_rest=float(still.mean()),
        beyond=float(made.beyond.mean()),
        contradict=tried - float(likely.mean()),
        in_band=sum(np.count_nonzero(part.in_band) for part in told) / len(means),
    )
    return JointViews(views, sigma.reshape(*shape, *patches.grid), how)


@dataclass(frozen=True, slots=True, eq=False)
class _PatchSpectra:
    """The spectra of patches of `slices` (K, h, w), which are turned by `back` (K,) and taken what they have in
    `common` (K,) with the first. They are computed when they are asked for: those of all patches would take four times
    the memory of the slices."""

    patches: Patches
    slices: Complexes
    back: Complexes
    common: NDArray[Any]

    def __call__(self, members: NDArray[np.intp]) -> Complexes:
        """(F, A, M)"""
        bins, orders = len(self.patches.multiplicity), 2 * len(self.slices) - 1
        spectra = np.empty((bins, orders, len(members)), dtype=np.complex64)
        for some in spans(len(members), AT_A_TIME):
            cut = self.patches.cut(self.slices, members[some]) * self.back[:, None, None, None]
            spectra[:, :, some] = self.patches.spectra(self.patches.less_means(cut, self.common)[0])
        return spectra


@dataclass(frozen=True, slots=True, eq=False)
class _PatchViews:
    """The views of all patches while they are made: `windowed` (N, V·U, side, side) with `lit` (N, 1, side, side) of
    their means, their `variance` (V·U, N) a pixel by the model, how much `of_apart` (N,) from the patches around is
    added to it, and which patches are `beyond` (N,). What solves a part writes its patches."""

    patches: Patches
    lit: Singles
    windowed: Singles
    variance: Floats
    of_apart: Floats
    beyond: NDArray[np.bool_]

    @classmethod
    def empty(cls, patches: Patches, means: Floats, count: int) -> _PatchViews:
        """Of patches with these means, for `count` views an axis."""
        lit = (means[:, None, None] * patches.window).astype(np.float32)[:, None]
        windowed = np.empty((len(means), count * count, SIDE, SIDE), dtype=np.float32)
        variance, of_apart = np.empty((count * count, len(means))), np.empty(len(means))
        return cls(patches, lit, windowed, variance, of_apart, np.zeros(len(means), dtype=bool))

    def look(self, group: AlikePatches, spectra_of: _PatchSpectra, moved: Floats | None) -> list[LookedPatches]:
        """A group with any disparity: which of it were looked at so. In a calm frame those that hardly `moved` (N,),
        which is written, are made without parallax."""
        members, spectra = group.members, spectra_of(group.members)
        if moved is not None:
            moved[members] = group.moved(spectra)
            still = moved[members] < CALM_NATS
            self._rest(group.still(members[still]), some_of(spectra, still), moved)
            members, spectra = members[~still], some_of(spectra, ~still)
        looked = group.looked(members, spectra)
        for one, part in looked:
            self._solve(one, part, one.kinds, np.ones(len(one.members), dtype=bool))
        return [one for one, _ in looked]

    def solve_at_rest(
        self,
        looked: Sequence[LookedPatches],
        still: NDArray[np.bool_],
        spectra_of: _PatchSpectra,
        known: Floats | None,
        workers: int,
    ) -> None:
        """With hardly any parallax where patches are `still` (N,), and with none that a patch could tell where the
        frame is motionless: a calm one, of which it is `known` (N,) by how many nats patches moved."""
        resting = [replace(one, members=one.members[still[one.members]]) for one in looked if still[one.members].any()]
        taken: dict[int, Complexes] = {}
        moved = np.full(len(still), np.inf) if known is None else known

        def ask(number: int) -> None:
            one = resting[number]
            taken[number] = spectra_of(one.members)
            if known is None and still.mean() > MOST_STILL:
                moved[one.members] = moved_nats(one.frame, one.rests, taken[number])

        each(ask, range(len(resting)), workers)
        if known is None and not (still.any() and is_motionless(moved[still])):
            moved[:] = np.inf
        each(lambda number: self._rest(resting[number], taken.pop(number), moved), range(len(resting)), workers)

    def _rest(self, one: LookedPatches, spectra: Complexes, moved: Floats) -> None:
        """Patches with these `spectra` (F, A, M) at rest, and motionless where they hardly `moved` (N,)."""
        kinds = likely_kinds(one.frame, one.rests, spectra, with_parallax=False)
        self._solve(one, spectra, kinds, moved[one.members] >= MOVES_NATS)

    def _solve(
        self,
        one: LookedPatches,
        spectra: Complexes,
        kinds: NDArray[np.intp],
        moved: NDArray[np.bool_],
    ) -> None:
        """Solve patches with these `spectra` (F, A, M), of these `kinds` (M,); those at rest that have not `moved` (M,)
        have no parallax that a patch could tell."""
        frame, own = one.frame, one.rests.own
        for number in np.unique(kinds):
            kind = KINDS[number]
            background = PatchBackground.of(one.rests.of(number), frame.alone, kind.alone * own)
            left = variance_of_views(frame.multiplicity @ background.left)[:, None] / SIDE**2
            for still in (False, True):
                chosen = np.flatnonzero((kinds == number) & (moved != still))
                if not len(chosen):
                    continue
                some = frame.ranges[MOTIONLESS_RANGE if still else kind.range]
                members = one.members[chosen]
                self.of_apart[members], of_alone, of_rest = _TOLD_MOTIONLESS if still else _TOLD[number]
                self.beyond[members] = kind.range == BEYOND
                for few, made, found in views_at_any(frame, some, own, background, some_of(spectra, chosen)):
                    self.windowed[members[few]] = self.patches.images(views_of(made), self.lit[members[few]])
                    self.variance[:, members[few]] = of_alone * left + of_rest * variance_of_views(found)

    def told(self, one: LookedPatches, shares: Floats, spectra_of: _PatchSpectra) -> list[ToldPatches]:
        """Those of a part that have `shares` (N, D) of disparities: none where all are 0."""
        here = np.isin(one.kinds, USUAL_KINDS) & shares[one.members].any(axis=1)
        if not here.any():
            return []
        members = one.members[here]
        spectra, kinds = spectra_of(members), one.kinds[here]
        found = views_told(one.frame, one.rests, spectra, shares[members])
        gained = found.nats - usual_nats(one.frame, one.rests, kinds, spectra)
        windowed = self.patches.images(views_of(found.spectra), self.lit[members])
        windowed *= _TRUST
        windowed += (1 - _TRUST) * self.windowed[members]
        return [ToldPatches(members, windowed, found.kinds, variance_of_views(found.rest), gained)]

    def take(self, told: list[ToldPatches], likely: NDArray[np.bool_]) -> None:
        """Take the views of patches as told, where those are `likely` (N,)."""
        for part in told:
            kept = likely[part.members]
            self.windowed[part.members[kept]] = part.windowed[kept]

    def views(self) -> Singles:
        """(V·U, h, w)"""
        return self.patches.joined(self.windowed)

    def apart(self) -> Floats:
        """(V·U, N), see `Patches.apart`."""
        return self.patches.apart(self.windowed, self.views())


def _is_calm(groups: Sequence[AlikePatches], spectra_of: _PatchSpectra, workers: int) -> bool:
    """Whether nearly nothing of a frame has parallax, by some patches of each group."""
    apart = max(1, sum(len(one.members) for one in groups) // _SAMPLE)
    moved: list[Floats] = []
    each(lambda one: moved.append(one.moved(spectra_of(one.members[::apart]))), groups, workers)
    return is_calm(np.concatenate(moved))


def _depths(views: Singles, aperture: Aperture, samples_px: tuple[float, float], workers: int) -> Floats:
    """(h, w) disparities in sensor columns over the aperture, by views (V·U, h, w); NaN where unknown."""
    count, (rows_px, columns_px) = aperture.views, samples_px
    steps = count * np.unique(aperture.points()[:, 0])
    stack = ViewStack(views.reshape(count, count, *views.shape[1:]), steps * columns_px / rows_px, steps)
    return estimate(of_views(stack), workers=workers).disparity.astype(np.float64) * (count * columns_px)
