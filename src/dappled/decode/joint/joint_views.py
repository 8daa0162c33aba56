"""Make views from slices by one model of the light field: its parts have disparities, and its texture a spectrum.

Views of a scene are not independent of each other at a spatial frequency f: where disparities are spread as p(D), views
i and j covary as S(f)·∫ p(D) exp(−2πi D f·(θ_i − θ_j)) dD. Here p(D) is estimated patch by patch. Slices are linear
measurements of the light field (`slice_model`): the band's own detail, detail that folds in from beyond the band, and
noise. In each patch and at each frequency the views are the most probable ones (Wiener), averaged over hypotheses of
the patch: one disparity out of a range, or all disparities of the frame at once, with one of several strengths of
texture. A hypothesis weighs what its likelihood and its share in the whole frame say. Patches of similar texture share
a spectrum. Likelihood decides in each patch, too, how much detail there is beyond the band, whether disparities lie in
the usual range or farther, and whether views have more alone than in common: a thing out of all ranges, or an edge.

For a hypothesis the band's own detail has few degrees of freedom. With the rest, folded detail and noise, made white
(y = L⁻¹ slices) it is y = H s + n; HᴴH is diagonalised, and the most probable s and the likelihood follow for any
strength a of the texture: s = a/(1 + aλ)·Hᴴy. Each view also has a little alone, which is part of the rest and
estimated from what s leaves of the slices: without noise and folded detail the slices decide, whatever the model.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from dappled.decode.array_types import Complexes, Floats, Singles
from dappled.decode.joint.patch_model import (
    KINDS,
    LEAST_NOISE,
    MOVES_NATS,
    RANGES,
    SIDE,
    WITHIN,
    DisparityRange,
    FrameModel,
    LikelyKinds,
    TexturePower,
    is_motionless,
    lean_of,
    rests_of,
)
from dappled.decode.joint.patches import Patches
from dappled.decode.joint.slice_model import SliceModel
from dappled.workers import each

Doubles = NDArray[np.complex128]
_ALL = 12  # degrees of freedom a frequency where all disparities are there at once
_STRENGTHS = np.array([0.01, 0.1, 0.3, 1.0, 3.0, 10.0], dtype=np.float32)
_TEXTURES = 3  # groups of patches of similar texture, each with its own spectrum
_FEWEST = 12  # patches in a group
_RING = 0.06  # of what a slice holds of a scene's mean: the frame's end rings in it, as far as a patch from the edge
_ROUNDING = 1e-6  # of the strongest degree of freedom: a few of the last places of single precision
_NEGLIGIBLE = 0.01  # of a patch's probability
# Of a patch's mean square difference to the views that it and its neighbours were joined to, of the model's variance of
# what views have alone, and of all else of it, for each kind: 68 % of errors are within the root of the sum.
_TOLD = (
    *((0.16, 0.47, 0.14), *((1.2, 0.85, 0.35),) * 4),
    *((1.6, 0.04, 0.3), *((1.8, 0.01, 0.15),) * 2, *((0.25, 0.05, 1.2),) * 3, (0.45, 0.05, 0.4)),
    *((1.0, 0.9, 1.0),) * 6,
)
_TOLD_MOTIONLESS = (0.7, 0.86, 2.65)
_ROUNDS = 3


@dataclass(frozen=True, slots=True, eq=False)
class JointViews:
    """`views` float32 (V, U, h, w), and their standard errors `sigma` float32 (V, U, m, n), one for each patch: in the
    view's samples patch (i, j) lies around (STEP·i − 0.5, STEP·j − 0.5).

    `beyond` is the share of the frame whose disparity is beyond `FARTHEST` times the reach: views are smeared there.
    """

    views: Singles
    sigma: Singles
    beyond: float


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
    cut, means = patches.less_means(patches.cut(slices), model.common()[: len(slices)])
    frame = FrameModel.of(patches, model, samples_px, np.concatenate([noise, noise[1:]]), reach)
    texture = _texture(cut[0].real, patches.window)
    groups = max(1, min(_TEXTURES, len(means) // _FEWEST))
    group = np.searchsorted(np.quantile(texture, np.arange(1, groups) / groups), texture)
    group[patches.at_edges] = groups
    rings = _RING * np.abs(model.common())
    rings[0] = 0
    count = model.aperture.views
    windowed = np.empty((len(means), count * count, SIDE, SIDE), dtype=np.float32)
    shares = np.zeros(len(means)) if astray is None else astray
    # Patches that light goes astray in are apart, but have the spectrum of their group.
    parts = [
        (alike, alike & (shares == share))
        for alike in (group == number for number in np.unique(group))
        for share in np.unique(shares[alike])
    ]
    variance, of_apart = np.empty((count * count, len(means))), np.empty(len(means))
    beyond = np.zeros(len(means), dtype=bool)

    looked: dict[int, _Looked] = {}

    def look(part: int) -> None:
        alike, members = parts[part]
        mean = float(np.sqrt(np.mean(means[alike] ** 2)))
        ringing = rings * mean if group[members][0] == groups else np.zeros(len(rings))
        here = replace(frame, noise=frame.noise + ringing**2, astray=float(shares[members][0]))
        looked[part] = _Looked.of(here, patches.spectra(cut[:, alike]), mean, members[alike])

    def solve(part: int) -> None:
        members = parts[part][1]
        found = _solve(looked[part], lean, motionless, patches.spectra(cut[:, members]))
        windowed[members] = patches.images(found.spectra)
        variance[:, members], of_apart[members], beyond[members] = found.variance, found.of_apart, found.beyond

    each(look, range(len(parts)), workers)
    lean = lean_of(np.concatenate([one.likely.gain for one in looked.values()]))
    motionless = is_motionless(lean, np.concatenate([one.likely.moved for one in looked.values()]))
    each(solve, range(len(parts)), workers)
    windowed += (means[:, None, None] * patches.window).astype(np.float32)[:, None]
    views = patches.joined(windowed)
    variance += of_apart * patches.apart(windowed, views)
    sigma = np.sqrt(variance).astype(np.float32).reshape(count, count, *patches.grid)
    return JointViews(views.reshape(count, count, *slices.shape[1:]), sigma, float(beyond.mean()))


def _texture(images: Singles, window: Floats) -> Floats:
    """(N,) how much fine detail each patch (N, side, side) has."""
    rows, columns = np.diff(images, axis=1)[:, :, 1:], np.diff(images, axis=2)[:, 1:, :]
    return np.asarray(np.einsum("nyx,yx->n", rows**2 + columns**2, window[1:, 1:]), dtype=np.float64)


@dataclass(frozen=True, slots=True, eq=False)
class _Background:
    """What is not the band's own detail at one disparity: `whitener` L⁻¹ (F, A, A) of its covariance, `unmixed`
    (F, V·U, A) what views have alone, of the slices, and `left` (F, V·U) its variance that is left."""

    whitener: Doubles
    unmixed: Complexes
    left: Floats

    @classmethod
    def of(cls, covariance: Complexes, alone: Complexes, power: Floats) -> _Background:
        """From `alone` (F, A, V·U), how the slices hold what each view has alone, of `power` (F,)."""
        # In double precision: odds of hypotheses are exponentials of numbers in the thousands.
        lower = np.linalg.cholesky(covariance.astype(np.complex128))
        whitener = np.asarray(np.linalg.inv(lower), dtype=np.complex128)
        white = whitener @ alone
        unmixed = (white.conj().transpose(0, 2, 1) @ whitener * power[:, None, None]).astype(np.complex64)
        explained = power[:, None] * (np.abs(white) ** 2).sum(axis=1)
        return cls(whitener, unmixed, power[:, None] * np.maximum(1 - explained, 0))


@dataclass(frozen=True, slots=True, eq=False)
class _Hypothesis:
    """The band's own detail under a hypothesis, diagonalised: `strength` λ (F, R), `viewed` (F, R, V·U) of each degree
    of freedom, less what the slices' view alone would hold of it, `projected` Hᴴy (F, R, N), and the log
    likelihoods `gains` (strengths, N) over that of no detail at all."""

    strength: Floats
    viewed: Complexes
    projected: Complexes
    gains: Floats

    @classmethod
    def of(
        cls, seen: Complexes, viewed: Complexes, white: Doubles, background: _Background, *, weights: Singles, most: int
    ) -> _Hypothesis:
        """From `seen` (F, R, A) and `viewed`, for whitened spectra (F, A, N); at most `most` degrees of freedom, and
        `weights` (F,) of frequencies in the likelihood."""
        rows = seen.astype(np.complex128) @ background.whitener.transpose(0, 2, 1)
        if rows.shape[1] <= most:
            strength, turn = np.linalg.eigh(rows.conj() @ rows.transpose(0, 2, 1))
        else:
            strength, left = np.linalg.eigh(rows.transpose(0, 2, 1) @ rows.conj())
            strength, left = strength[:, -most:], left[:, :, -most:]
            # What few slices don't see is rounding, not a direction.
            seen_well = strength > _ROUNDING * strength[:, -1:]
            strength = np.where(seen_well, strength, 0)
            scale = np.where(seen_well, 1 / np.sqrt(np.maximum(strength, LEAST_NOISE)), 0)
            turn = rows.conj() @ left * scale[:, None, :]
        turned = turn.transpose(0, 2, 1)
        beside = viewed - seen @ background.unmixed.transpose(0, 2, 1)
        strength = np.maximum(strength, 0)
        projected = (turned @ rows).conj() @ white  # in double precision for the likelihood, then no more
        gains = _gains(strength, projected, weights)
        return cls(strength, (turned @ beside).astype(np.complex64), projected.astype(np.complex64), gains)


def _gains(strength: Floats, projected: Doubles, weights: Singles) -> Floats:
    """(strengths, N) log likelihoods over that of no detail at all."""
    scaled = _STRENGTHS[:, None, None]
    shrunk = weights[:, None] * scaled / (1 + scaled * strength)
    power = (projected.real**2 + projected.imag**2).reshape(-1, projected.shape[2])
    volume = (weights[:, None] * np.log1p(scaled * strength)).sum(axis=(1, 2))
    return np.asarray(shrunk.reshape(len(_STRENGTHS), -1) @ power - volume[:, None], dtype=np.float64)


@dataclass(frozen=True, slots=True, eq=False)
class _Solved:
    """`spectra` (F, V·U, N) of the views, their `variance` (V·U, N) a pixel by the model, how much `of_apart` (N,) from
    the patches around is added to it, and which patches are `beyond` (N,)."""

    spectra: Complexes
    variance: Floats
    of_apart: Floats
    beyond: NDArray[np.bool_]


@dataclass(frozen=True, slots=True, eq=False)
class _Looked:
    """Patches of similar texture: their `frame`, the power `own` (F,) of their texture, the `rests` of each kind, and
    which kinds they are likely to be."""

    frame: FrameModel
    own: Floats
    rests: list[Complexes]
    likely: LikelyKinds

    @classmethod
    def of(cls, frame: FrameModel, spectra: Complexes, mean: float, members: NDArray[np.bool_]) -> _Looked:
        """From the spectra (F, A, M) and mean of the patches that look like them, and which of these they are (M,)."""
        power = np.maximum((np.abs(spectra[:, 0]) ** 2).mean(axis=1) - frame.noise[0], 0)
        spectrum = TexturePower.of(power, frame.radius(frame.frequencies))
        own = spectrum.at(frame.radius(frame.frequencies))
        rests = rests_of(frame, spectrum, own, mean)
        return cls(frame, own, rests, LikelyKinds.of(frame, own, rests, spectra[:, :, members]))


def _solve(looked: _Looked, lean: float, motionless: bool, spectra: Complexes) -> _Solved:
    """The views of patches from their spectra (F, A, N), each of its most probable kind, in a frame that leans to no
    parallax by some nats, or has none at all."""
    frame, own, rests = looked.frame, looked.own, looked.rests
    chosen = looked.likely.chosen(lean)
    unmoved = motionless & (looked.likely.moved < MOVES_NATS)
    made = np.empty((len(own), frame.alone.shape[1], spectra.shape[2]), dtype=np.complex64)
    variance, of_apart = np.empty(made.shape[1:]), np.empty(made.shape[2])
    for number in np.unique(chosen):
        kind = KINDS[number]
        background = _Background.of(rests[number], frame.alone, kind.alone * own)
        left = (frame.multiplicity @ background.left)[:, None] / SIDE**2
        for still in (False, True):
            members = np.flatnonzero((chosen == number) & ((unmoved & (kind.range == 0)) == still))
            if not len(members):
                continue
            some = frame.motionless if still else frame.ranges[kind.range]
            of_apart[members], of_alone, of_rest = _TOLD_MOTIONLESS if still else _TOLD[number]
            made[:, :, members], found = _views(frame, some, own, background, spectra[:, :, members])
            variance[:, members] = of_alone * left + of_rest * found
    beyond = [number for number, kind in enumerate(KINDS) if kind.range == len(RANGES) - 1]
    return _Solved(made, variance, of_apart, np.isin(chosen, beyond))


def _views(
    frame: FrameModel, some: DisparityRange, own: Floats, background: _Background, spectra: Complexes
) -> tuple[Complexes, Floats]:
    """The views' spectra (F, V·U, N), and their variance (V·U, N) a pixel but for what each has alone, of patches in a
    range and before a background."""
    size = np.sqrt(own / len(WITHIN)).astype(np.float32)[:, None, None, None]
    seen, viewed = some.seen * size, some.viewed * size
    white = background.whitener @ spectra
    single = [
        _Hypothesis.of(seen[:, d], viewed[:, d], white, background, weights=frame.weights, most=len(WITHIN))
        for d in range(seen.shape[1])
    ]
    gains = np.concatenate([one.gains for one in single])
    _, prior = _weighed(gains, np.full(len(gains), 1 / len(gains)))
    histogram = prior.reshape(len(single), -1).sum(axis=1)
    share = np.sqrt(0.98 * histogram + 0.02 / len(histogram)).astype(np.float32)[None, :, None, None]
    flat = [(part * share).reshape(len(part), -1, part.shape[-1]) for part in (seen, viewed)]
    together = _Hypothesis.of(flat[0], flat[1], white, background, weights=frame.weights, most=_ALL)
    del white
    gains = np.concatenate([gains, together.gains])
    count = len(together.gains)
    odds, _ = _weighed(gains, np.concatenate([0.8 * prior, np.full(count, 0.2 / count)]))
    return _expected(frame, [*single, together], odds, background, spectra)


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
    frame: FrameModel, hypotheses: list[_Hypothesis], odds: Floats, background: _Background, spectra: Complexes
) -> tuple[Complexes, Floats]:
    """The views' spectra (F, V·U, N), averaged over hypotheses, and their variance (V·U, N) a pixel, with that between
    hypotheses, but for what each view has alone."""
    count = len(_STRENGTHS)
    patches = odds.shape[1]
    probable = odds.reshape(len(hypotheses), count, patches)
    probable = np.where(probable.sum(axis=1, keepdims=True) > _NEGLIGIBLE, probable, 0)
    probable /= probable.sum(axis=(0, 1))
    multiplicity = frame.multiplicity.astype(np.float32)
    moved = np.zeros((len(spectra), frame.alone.shape[1], patches), dtype=np.complex64)
    variance = np.zeros(moved.shape[1:])
    for one, some in zip(hypotheses, probable, strict=True):
        odd = some.astype(np.float32)
        used = np.flatnonzero(odd.sum(axis=0))
        if not len(used):
            continue
        scaled = _STRENGTHS[:, None, None]
        shares = scaled / (1 + scaled * one.strength)  # (strengths, F, R)
        shrunk = np.tensordot(shares, odd[:, used], axes=(0, 0))
        part = one.viewed.transpose(0, 2, 1) @ (shrunk * one.projected[:, :, used])
        moved[:, :, used] += part
        squares = np.einsum("fvn,f->vn", part.real**2 + part.imag**2, multiplicity)
        variance[:, used] += squares / odd[:, used].sum(axis=0)
        weighted = (np.abs(one.viewed) ** 2 * multiplicity[:, None, None]).reshape(-1, moved.shape[1])
        variance += (shares.reshape(count, -1) @ weighted).T @ odd
    spread = np.einsum("fvn,f->vn", moved.real**2 + moved.imag**2, multiplicity)
    # All hypotheses but one are negligible in most patches: there the two cancel but for rounding.
    return background.unmixed @ spectra + moved, np.maximum(variance - spread, 0) / SIDE**2
