"""Views of patches whose disparities are not known: the most probable ones, averaged over hypotheses.

A hypothesis is one disparity out of a range, or all disparities of the frame at once, with one of several strengths of
texture. It weighs what its likelihood and its share in the whole frame say.

For a hypothesis the band's own detail has few degrees of freedom. With the rest, folded detail and noise, made white
(y = L⁻¹ slices) it is y = H s + n; HᴴH is diagonalised, and the most probable s and the likelihood follow for any
strength a of the texture: s = a/(1 + aλ)·Hᴴy. Each view also has a little alone, which is part of the rest and
estimated from what s leaves of the slices: without noise and folded detail the slices decide, whatever the model.

All hypotheses of a range together span few directions of the slices: patches are projected on these once. Every fourth
frequency tells which hypotheses a patch may be of; only those are looked at by all.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from dappled.decode.array_types import Complexes, Floats, Singles
from dappled.decode.joint.patch_model import (
    AT_A_TIME,
    LEAST_NOISE,
    SIDE,
    WITHIN,
    DisparityRange,
    Doubles,
    FrameModel,
    some_of,
    summed,
    times,
    whitener_of,
)
from dappled.decode.joint.slice_model import Terms, single
from dappled.decode.joint.small_eigh import eigh
from dappled.workers import spans

# Chosen by hand where no figure stands beside a number; benchmarks/views.py measures what all of them together make.

# Of a patch's texture, times the mean power of patches like it: chosen by hand, two decades down and one up; measured
# by benchmarks/views.py.
STRENGTHS = np.array([0.01, 0.1, 0.3, 1.0, 3.0, 10.0], dtype=np.float32)
_ALL = 12  # degrees of freedom a frequency where all disparities are there at once
_ROUNDING = 1e-6  # of the strongest degree of freedom: a few of the last places of single precision
_NEGLIGIBLE = 0.01  # of a patch's probability
_UNSEEN = 1e-5  # of the noise: weaker detail tells nothing, whatever the texture's strength
_TRIED = 4  # of so many frequencies one is looked at to find the likely hypotheses
_LIKELY_NATS = 25.0  # by those frequencies alone
_FEW_PAIRS = 9  # of degrees of freedom: fewer than views
_ROUNDS = 3  # of how often each disparity occurs; chosen by hand, measured by benchmarks/views.py


@dataclass(frozen=True, slots=True, eq=False)
class PatchBackground:
    """What is not the band's own detail at one disparity: `whitener` L⁻¹ (F, A, A) of its covariance, `unmixed`
    (F, V·U, A) what views have alone, of the slices, and `left` (F, V·U) its variance that is left; views in pairs."""

    whitener: Doubles
    unmixed: Terms
    left: Floats

    @classmethod
    def of(cls, covariance: Terms, alone: Terms, power: Floats) -> PatchBackground:
        """From `alone` (A, V·U), how the slices hold what each view has alone, of `power` (F,)."""
        whitener = whitener_of(covariance)
        white = whitener @ alone
        unmixed = single(white.conj().transpose(0, 2, 1) @ whitener * power[:, None, None])
        explained = power[:, None] * (np.abs(white) ** 2).sum(axis=1)
        return cls(whitener, unmixed, power[:, None] * np.maximum(1 - explained, 0))


@dataclass(frozen=True, slots=True, eq=False)
class _Directions:
    """What slices show of detail in a range: `projector` (F, r, A) takes them to the r directions that have all of it,
    white, and `rows` (F, D, R, r) are the range's own spectra there."""

    rows: Doubles
    projector: Terms

    @classmethod
    def of(cls, some: DisparityRange, own: Floats, whitener: Doubles) -> _Directions:
        """Of a range, for texture of power `own` (F,)."""
        size = np.sqrt(own / len(WITHIN))[:, None, None]
        turn, reduced = np.linalg.qr(whitener @ (some.basis * size).swapaxes(1, 2))
        rows = some.within.reshape(len(own), -1, some.within.shape[3]) @ reduced.swapaxes(1, 2)
        projector = single(turn.conj().swapaxes(1, 2) @ whitener)
        return cls(rows.reshape(some.within.shape), projector)


@dataclass(frozen=True, slots=True, eq=False)
class _Hypothesis:
    """The band's own detail under a hypothesis, diagonalised: `strength` λ (F, R), `rows` (F, q, r) that make Hᴴy of
    the q degrees of freedom that slices show of projected patches, and `viewed` (F, R, V·U) of each degree of freedom,
    less what the slices' view alone would hold of it, views in pairs; the strongest come last."""

    strength: Floats
    rows: Terms
    viewed: Terms

    def gains(self, low: Complexes, weights: Singles) -> Floats:
        """(strengths, N) log likelihoods of projected patches (F, r, N) over that of no detail at all, by frequencies'
        `weights` (F,)."""
        strength = self.strength[:, -self.rows.shape[1] :]
        scaled = STRENGTHS[:, None, None].astype(np.float64)
        shrunk = (weights[:, None] * scaled / (1 + scaled * strength)).reshape(len(STRENGTHS), -1)
        volume = (weights[:, None] * np.log1p(scaled * strength)).sum(axis=(1, 2))
        power = np.square(times(self.rows, low).view(np.float32)).reshape(shrunk.shape[1], -1)
        return np.asarray(summed(shrunk @ power) - volume[:, None], dtype=np.float64)


def _each_of(rows: Doubles, beside: Terms) -> list[_Hypothesis]:
    """One of each disparity, from `rows` (F, D, R, r) and `beside` (F, D, R, V·U)."""
    strength, turn = eigh(rows.conj() @ rows.swapaxes(2, 3))
    strength = np.maximum(strength, 0)
    turned = turn.swapaxes(2, 3)
    shown = max(1, int((strength > _UNSEEN).any(axis=(0, 1)).sum()))
    made = single((turned[:, :, -shown:] @ rows).conj())
    viewed = single(turned) @ beside
    return [
        _Hypothesis(*(np.ascontiguousarray(part[:, d]) for part in (strength, made, viewed)))
        for d in range(rows.shape[1])
    ]


def _together(each: Doubles, beside: Terms, share: Floats) -> _Hypothesis:
    """All disparities at once, in shares (D,) of the texture, from rows of `each` (F, D, R, r)."""
    scale = np.sqrt(share)[None, :, None, None]
    rows = (each * scale).reshape(len(beside), -1, each.shape[3])
    strength, left = np.linalg.eigh(rows.swapaxes(1, 2) @ rows.conj())
    strength, left = strength[:, -_ALL:], left[:, :, -_ALL:]
    # What few slices don't see is rounding, not a direction.
    strength = np.where(strength > _ROUNDING * strength[:, -1:], strength, 0)
    inverse = np.where(strength > 0, 1 / np.sqrt(np.maximum(strength, LEAST_NOISE)), 0)
    turn = rows.conj() @ left * inverse[:, None, :]
    viewed = single(turn.swapaxes(1, 2)) @ (beside * scale.astype(np.float32)).reshape(len(beside), rows.shape[1], -1)
    made = np.sqrt(strength)[:, :, None] * left.conj().swapaxes(1, 2)
    return _Hypothesis(strength, single(made), viewed)


def views_at_any(
    frame: FrameModel, some: DisparityRange, own: Floats, background: PatchBackground, spectra: Complexes
) -> Iterator[tuple[slice, Complexes, Floats]]:
    """The views' spectra (F, V·U, n), and their variance (V·U, n) a pixel but for what each has alone, views in pairs,
    of patches (F, A, N) in a range and before a background, a few patches at a time."""
    size = np.sqrt(own / len(WITHIN)).astype(np.float32)[:, None, None, None]
    seen = some.seen * size
    alone = seen.reshape(len(seen), -1, seen.shape[3]) @ background.unmixed.swapaxes(1, 2)
    beside = some.viewed * size - alone.reshape(some.viewed.shape)
    directions = _Directions.of(some, own, background.whitener)
    low = times(directions.projector, spectra)
    hypotheses, gains, prior = _hypotheses(directions.rows, beside, low, frame.weights)
    odds, _ = _weighed(gains, prior)
    for few in spans(spectra.shape[2], AT_A_TIME):
        moved, variance = _expected(frame, hypotheses, odds[:, few], low[:, :, few])
        moved += times(background.unmixed, spectra[:, :, few])
        yield few, moved, variance


def flat_nats(seen: Terms, whitener: Doubles, white: Complexes, weights: Singles) -> Floats:
    """(N,) log likelihoods, but for a constant, of patches at one disparity each, or at all of them, before a
    background that the `whitener` (F, A, A) makes white, as it made the patches `white` (F, A, N). `seen` (F, D, A) is
    what slices hold of their texture at each disparity."""
    rows = (seen @ whitener.transpose(0, 2, 1))[:, :, None]
    no_views = np.zeros((*rows.shape[:3], 0), dtype=np.float32)
    _, gains, prior = _hypotheses(rows, no_views, white, weights)
    total = gains + np.log(_weighed(gains, prior)[1])[:, None]
    return np.asarray(np.logaddexp.reduce(total, axis=0))


def _hypotheses(
    rows: Doubles, beside: Terms, low: Complexes, weights: Singles
) -> tuple[list[_Hypothesis], Floats, Floats]:
    """What projected patches (F, r, N) may be, by a range's `rows` (F, D, R, r) and what views hold `beside`
    (F, D, R, V·U) the slices' own; `gains` of each at each strength (C, N), and the prior (C,) to begin with."""
    likely = _likely(rows, low, weights)
    looked = np.flatnonzero(likely.any(axis=1))
    each = _each_of(rows[:, looked], beside[:, looked])
    gains = _gains(each, likely[looked], low, weights)
    _, prior = _weighed(gains, np.full(len(gains), 1 / len(gains)))
    histogram = np.zeros(len(likely))
    histogram[looked] = prior.reshape(len(each), -1).sum(axis=1)
    together = _together(rows, beside, 0.98 * histogram + 0.02 / len(histogram))
    gains = np.concatenate([gains, together.gains(low, weights)])
    count = len(STRENGTHS)
    return [*each, together], gains, np.concatenate([0.8 * prior, np.full(count, 0.2 / count)])


def _likely(each: Doubles, low: Complexes, weights: Singles) -> NDArray[np.bool_]:
    """(D, N) which disparities projected patches (F, r, N) may have, by a few frequencies of `each`'s rows
    (F, D, R, r)."""
    few = slice(None, None, _TRIED)
    rows = each[few]
    no_views = np.zeros((*rows.shape[:3], 0), dtype=np.float32)
    best = np.stack([one.gains(low[few], weights[few]).max(axis=0) for one in _each_of(rows, no_views)])
    return np.asarray(best >= best.max(axis=0) - _LIKELY_NATS)


def _gains(hypotheses: list[_Hypothesis], likely: NDArray[np.bool_], low: Complexes, weights: Singles) -> Floats:
    """(C, N) `gains` of projected patches (F, r, N), −inf where a hypothesis is not `likely` (D, N)."""
    gains = np.full((len(hypotheses), len(STRENGTHS), low.shape[2]), -np.inf)
    for one, members, found in zip(hypotheses, likely, gains, strict=True):
        found[:, members] = one.gains(some_of(low, members), weights)
    return gains.reshape(-1, low.shape[2])


def _weighed(gains: Floats, prior: Floats) -> tuple[Floats, Floats]:
    """(odds (C, N), prior (C,)) of hypotheses with log likelihoods (C, N): the prior that explains all patches best.

    The prior of a few patches counts their likelihood more than once, and is the better for it: tied to the prior (C,)
    that it starts from by the weight of 2, 5 or 20 patches, views of boards lose 1.2 to 3.1 dB."""
    for _ in range(_ROUNDS):
        total = gains + np.log(prior)[:, None]
        odds = np.exp(total - total.max(axis=0))
        odds /= odds.sum(axis=0)
        prior = odds.mean(axis=1) + 1e-5
        prior /= prior.sum()
    return odds, prior


def _expected(
    frame: FrameModel, hypotheses: list[_Hypothesis], odds: Floats, low: Complexes
) -> tuple[Complexes, Floats]:
    """What is added to the views' spectra (F, V·U, N) that each has alone, averaged over hypotheses, and their variance
    (V·U, N) a pixel, with that between hypotheses, but for what each view has alone; of projected patches."""
    count = len(STRENGTHS)
    patches = odds.shape[1]
    probable = odds.reshape(len(hypotheses), count, patches)
    probable = np.where(probable.sum(axis=1, keepdims=True) > _NEGLIGIBLE, probable, 0)
    probable /= probable.sum(axis=(0, 1))
    # One hypothesis has no variance between hypotheses.
    several = np.count_nonzero(probable.any(axis=1), axis=0) > 1
    multiplicity = frame.multiplicity.astype(np.float32)
    variance = np.zeros((frame.alone.shape[1], patches))
    ends = np.cumsum([one.rows.shape[1] for one in hypotheses])
    freedom = np.zeros((len(low), ends[-1], patches), dtype=np.complex64)  # of patches, in all hypotheses
    for one, odd, end in zip(hypotheses, probable, ends, strict=True):
        used = np.flatnonzero(odd.sum(axis=0))
        if not len(used):
            continue
        scaled = STRENGTHS[:, None, None]
        shares = scaled / (1 + scaled * one.strength)  # (strengths, F, R)
        shown = one.rows.shape[1]
        shrunk = np.tensordot(shares[:, :, -shown:], odd[:, used], axes=(0, 0)).astype(np.float32)
        found = shrunk * times(one.rows, some_of(low, used))
        freedom[:, end - shown : end, used] = found
        viewed = one.viewed[:, -shown:]
        between = several[used]
        if between.any():
            squares = _squares(viewed, some_of(found, between), multiplicity)
            variance[:, used[between]] += squares / odd[:, used[between]].sum(axis=0)
        weighted = (np.abs(one.viewed) ** 2 * multiplicity[:, None, None]).reshape(-1, len(variance))
        variance += (shares.reshape(count, -1) @ weighted).T @ odd
    viewed = np.concatenate([one.viewed[:, -one.rows.shape[1] :] for one in hypotheses], axis=1)
    moved = times(viewed.transpose(0, 2, 1), freedom)
    if several.any():
        some = moved[:, :, several]
        variance[:, several] -= np.einsum("fvn,f->vn", some.real**2 + some.imag**2, multiplicity)
    return moved, np.maximum(variance, 0) / SIDE**2


def _squares(viewed: Terms, found: Complexes, multiplicity: Singles) -> Singles:
    """(V·U, n) sums over all frequencies of |views|², `viewed` (F, q, V·U) times what is `found` (F, q, n)."""
    count = viewed.shape[1]
    if count**2 > _FEW_PAIRS:
        views = times(viewed.transpose(0, 2, 1), found)
        return np.asarray(np.einsum("fvn,f->vn", views.real**2 + views.imag**2, multiplicity))
    both = (viewed[:, :, None] * viewed[:, None].conj() * multiplicity[:, None, None, None]).reshape(
        -1, viewed.shape[2]
    )
    together = (found[:, :, None] * found[:, None].conj()).reshape(-1, found.shape[2])
    return np.asarray((both.T @ together.real) if np.isrealobj(both) else (both.T @ together).real)
