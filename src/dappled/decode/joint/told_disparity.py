"""Views of patches that a depth map tells which disparities they have, and how much of each.

One disparity, or all of the frame at once, explains a patch at an edge badly: it has two or three, in shares of its
own. A map of depth made from first views tells them. What a patch has beyond the band, and how strong its texture is,
is then chosen anew. The shares are not weighed against other hypotheses by their likelihood: more disparities than
there are explain the slices of a patch better, and its views worse.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy import ndimage

from dappled.decode.array_types import Complexes, Floats, Singles
from dappled.decode.depth.depth_map import nearest_known
from dappled.decode.joint.any_disparity import STRENGTHS, PatchBackground
from dappled.decode.joint.patch_model import (
    KINDS,
    SIDE,
    USUAL,
    USUAL_KINDS,
    Doubles,
    FrameModel,
    Rests,
    nats_of,
    some_of,
    times,
)
from dappled.decode.joint.patches import Patches
from dappled.decode.joint.slice_model import Terms, single
from dappled.decode.joint.small_eigh import eigh

# Chosen by hand where no figure stands beside a number; benchmarks/views.py measures what all of them together make.

_SMOOTH_PX = 5  # the window of a median: folded detail scatters the depth of single samples
_LEAST_SHARE = 0.02  # of a patch: less is left out
_MOST = 8  # disparities in a patch
_LEAST_TOLD = 0.5  # of a patch
# Of a frame: terrain from the air has 89 to 98 % of its depth within 1/16 of a sample from view to view, a picture with
# hardly any parallax at half the ideal aperture 66 %.
MOST_STILL = 0.8
_MUCH, _NEARLY_ALL = 0.9, 0.98  # of a patch
_FAR = 3.0  # times that: depth of folded edges at rest is nearer
_AT_A_TIME = 64  # patches: what is worked on stays small
_TRIED = 5  # of so many frequencies one is looked at to choose the kind


def shares_of(disparity: Floats, levels: Floats, patches: Patches) -> Floats:
    """(N, D) the shares of each patch that lie at each of the `levels` (D,), ascending; 0 for all where the `disparity`
    (h, w), in the levels' unit, NaN where unknown, doesn't tell half of a patch."""
    apart = levels[-1] - levels[-2]
    known = (disparity > levels[0] - apart) & (disparity < levels[-1] + apart)
    near = np.searchsorted((levels[1:] + levels[:-1]) / 2, disparity)
    at = patches.cut(_smoothed(near, known)[None])[0]
    weights = np.where(patches.cut(known[None])[0], patches.window**2, 0)
    at += np.arange(len(at))[:, None, None] * len(levels)
    found = np.bincount(at.ravel(), weights=weights.ravel(), minlength=len(at) * len(levels))
    shares = found.reshape(len(at), -1) / (patches.window**2).sum()
    told = shares.sum(axis=1, keepdims=True) >= _LEAST_TOLD
    largest = np.argsort(-shares, axis=1, kind="stable")[:, :_MOST]
    kept = np.zeros(shares.shape, dtype=bool)
    np.put_along_axis(kept, largest, True, axis=1)
    shares = np.where(told & kept & (shares >= _LEAST_SHARE), shares, 0)
    return np.asarray(shares / np.maximum(shares.sum(axis=1, keepdims=True), _LEAST_SHARE))


def at_rest(disparity: Floats, still: float, patches: Patches) -> NDArray[np.bool_]:
    """(N,) which patches have hardly any parallax, by the `disparity` (h, w), NaN where unknown: none beyond `still`.

    Where most of a frame has none, a patch may have any of which less than a tenth is `_FAR` times as large. Where
    nothing is known no patch is at rest.
    """
    known = np.isfinite(disparity)
    size = _smoothed(np.abs(np.where(known, disparity, 0.0)), known)
    if not known.any():
        return np.zeros(len(patches.corners), dtype=bool)
    frame = float((size[known] <= still).mean()) > MOST_STILL
    bound, least = (_FAR * still, _MUCH) if frame else (still, _NEARLY_ALL)
    weights = patches.window**2
    within = np.einsum("nyx,yx->n", patches.cut((size <= bound)[None])[0], weights) / weights.sum()
    return np.asarray(within >= least)


def _smoothed(values: NDArray[Any], known: NDArray[np.bool_]) -> NDArray[Any]:
    """(h, w) the median around each sample, the nearest known one for those that are not."""
    return np.asarray(ndimage.median_filter(nearest_known(values, known), _SMOOTH_PX))


@dataclass(frozen=True, slots=True, eq=False)
class ToldViews:
    """`spectra` (F, V·U, N) of the views of N patches, their variance (V·U, N) a pixel but for what each has alone,
    `rest`, both of views in pairs, the `kinds` (N,) of the patches, and their log likelihoods `nats` (N,)."""

    spectra: Complexes
    rest: Floats
    kinds: NDArray[np.intp]
    nats: Floats


def views_told(frame: FrameModel, rests: Rests, spectra: Complexes, shares: Floats) -> ToldViews:
    """The views of patches (F, A, N) with the `rests_of` their group, which have these `shares` (N, D), of sum 1, of
    the usual range's disparities."""
    usual, own = frame.ranges[USUAL], rests.own
    size = np.sqrt(own).astype(np.float32)[:, None, None]
    seen, viewed = (part.reshape(len(own), -1, part.shape[3]) * size for part in (usual.seen, usual.viewed))
    nats = np.empty((len(USUAL_KINDS), len(shares)))
    few = slice(None, None, _TRIED)
    for number, one in zip(USUAL_KINDS, nats, strict=True):
        background = PatchBackground.of(rests.of(number, few), frame.alone, KINDS[number].alone * own[few])
        there = _Whitened.of(seen[few], background, spectra[few])
        one[:] = frame.weights[few] @ there.without
        for members, mix in _mixes(there, shares):
            one[members] += mix.gains(frame.weights[few]).max(axis=0)
    kinds = np.array(USUAL_KINDS)[nats.argmax(axis=0)]
    made = np.empty((len(own), viewed.shape[2], len(kinds)), dtype=np.complex64)
    rest, likely = np.empty(made.shape[1:]), np.empty(len(kinds))
    for number in np.unique(kinds):
        chosen = np.flatnonzero(kinds == number)
        background = PatchBackground.of(rests.of(number), frame.alone, KINDS[number].alone * own)
        few_spectra = some_of(spectra, chosen)
        there = _Whitened.of(seen, background, few_spectra)
        beside = viewed - seen @ background.unmixed.transpose(0, 2, 1)
        coefficients = np.zeros((len(own), seen.shape[1], len(chosen)), dtype=np.complex64)
        for members, mix in _mixes(there, shares[chosen]):
            gains = mix.gains(frame.weights)
            likely[chosen[members]] = gains.max(axis=0) + frame.weights @ there.without[:, members]
            odds = np.exp(gains - gains.max(axis=0))
            odds /= odds.sum(axis=0)
            coefficients[:, mix.at, members[:, None]] = mix.coefficients(odds)
            rest[:, chosen[members]] = mix.variance(odds, beside, frame.multiplicity) / SIDE**2
        moved = times(beside.transpose(0, 2, 1), coefficients)
        made[:, :, chosen] = times(background.unmixed, few_spectra) + moved
    return ToldViews(made, rest, kinds, likely)


@dataclass(frozen=True, slots=True, eq=False)
class _Whitened:
    """Detail at D disparities before a background, which was made white: `gram` (F, D, D) HᴴH, `projected` (F, D, N)
    Hᴴy of patches, and their log likelihoods `without` (F, N) detail."""

    gram: Doubles
    projected: NDArray[np.complex128]
    without: Floats

    @classmethod
    def of(cls, seen: Terms, background: PatchBackground, spectra: Complexes) -> _Whitened:
        rows = seen @ background.whitener.transpose(0, 2, 1)
        white = times(background.whitener, spectra)
        without = nats_of(background.whitener, white)
        return cls(rows.conj() @ rows.transpose(0, 2, 1), times(rows.conj(), white), without)


@dataclass(frozen=True, slots=True, eq=False)
class _Mix:
    """Detail of n patches that have R disparities each, diagonalised: `at` (n, R) which ones, `sizes` (n, R) of each,
    `strength` λ (F, n, R), `turn` (F, n, R, R) from the degrees of freedom to the disparities, and `projected`
    (F, n, R)."""

    at: NDArray[np.intp]
    sizes: Floats
    strength: Floats
    turn: Doubles
    projected: NDArray[np.complex128]

    def gains(self, weights: Singles) -> Floats:
        """(strengths, n) log likelihoods over that of no detail."""
        power = self.projected.real**2 + self.projected.imag**2
        found = np.empty((len(STRENGTHS), len(self.at)))
        for scale, one in zip(STRENGTHS.astype(np.float64), found, strict=True):
            scaled = 1 + scale * self.strength
            one[:] = np.einsum("f,fnr->n", weights, scale * power / scaled - np.log(scaled))
        return found

    def coefficients(self, odds: Floats) -> NDArray[np.complex128]:
        """(F, n, R) of each disparity, by the odds (strengths, n)."""
        found = self.turn @ (self._shares(odds) * self.projected)[..., None]
        return np.asarray(found[..., 0] * self.sizes)

    def variance(self, odds: Floats, beside: Terms, multiplicity: Floats) -> Floats:
        """(V·U, n) sums over all frequencies of the views `beside` (F, D, V·U) what is known of the detail."""
        shares = self._shares(odds) * multiplicity[:, None, None]
        total = np.zeros((beside.shape[2], len(self.at)))
        turned = single(self.turn * self.sizes[:, :, None]).transpose(0, 1, 3, 2)
        for number, at in enumerate(self.at):
            viewed = turned[:, number] @ beside[:, at]
            total[:, number] = np.einsum("frv,fr->v", viewed.real**2 + viewed.imag**2, shares[:, number])
        return total

    def _shares(self, odds: Floats) -> Floats:
        """(F, n, R) a/(1 + aλ), by the odds of each strength a."""
        scaled = STRENGTHS.astype(np.float64)[:, None, None, None]
        return np.asarray(np.einsum("sn,sfnr->fnr", odds, scaled / (1 + scaled * self.strength)))


def _mixes(there: _Whitened, shares: Floats) -> Iterator[tuple[NDArray[np.intp], _Mix]]:
    """Which patches have one disparity, two …, a few at a time, and their detail."""
    counts = np.count_nonzero(shares, axis=1)
    for count in np.unique(counts):
        alike = np.flatnonzero(counts == count)
        for first in range(0, len(alike), _AT_A_TIME):
            members = alike[first : first + _AT_A_TIME]
            at = np.nonzero(shares[members])[1].reshape(-1, count)
            sizes = np.sqrt(np.take_along_axis(shares[members], at, axis=1))
            few = there.gram[:, at[:, :, None], at[:, None, :]] * (sizes[:, :, None] * sizes[:, None, :])
            strength, turn = eigh(few)
            projected = there.projected[:, at, members[:, None]] * sizes
            projected = (turn.conj().swapaxes(2, 3) @ projected[..., None])[..., 0]
            yield members, _Mix(at, sizes, np.maximum(strength, 0), turn, projected)
