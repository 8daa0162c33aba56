"""Make views from slices by one model of the light field: its parts have disparities, and its texture a spectrum.

Views of a scene are not independent of each other at a spatial frequency f: where disparities are spread as p(D), views
i and j covary as S(f)·∫ p(D) exp(−2πi D f·(θ_i − θ_j)) dD. Here p(D) is estimated patch by patch. Slices are linear
measurements of the light field (`slice_model`): the band's own detail, detail that folds in from beyond the band, and
noise. In each patch and at each frequency the views are the most probable ones (Wiener), averaged over hypotheses of
the patch: one disparity out of a range, or all disparities of the frame at once, with one of several strengths of
texture. A hypothesis weighs what its likelihood and its share in the whole frame say. Patches of similar texture share
a spectrum; how much detail there is beyond the band is decided by likelihood, too.

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
from dappled.decode.lightfield.patches import Patches
from dappled.decode.lightfield.slice_model import Fold, SliceModel, folded

SIDE = 24  # samples: a patch is wide against parallax, and small against things at one disparity
_HYPOTHESES = 17  # disparities over the range
_WITHIN = (-0.4, 0.0, 0.4)  # of the step from one to the next: a patch is not flat
_ALL = 12  # degrees of freedom a frequency where all disparities are there at once
_STRENGTHS = np.array([0.01, 0.1, 0.3, 1.0, 3.0, 10.0], dtype=np.float32)
_TEXTURES = 3  # groups of patches of similar texture, each with its own spectrum
_FEWEST = 12  # patches in a group
# Detail beyond the band, times the spectrum continued as a power law, and what a view has alone (things hidden from
# others, parallax within a patch), of its power. A frame with all its detail in the band can be trusted further.
_BACKGROUNDS = ((0.0, 0.03), (0.1, 0.01), (1.0, 0.01), (4.0, 0.01))
_BEYOND_DISPARITIES = 5
_INDEPENDENT = 0.5  # of a patch's samples are measurements of their own: patches overlap, windows correlate
_ERROR = 5e-4  # of a slice's power: what no light field explains
_MEAN_ERROR = 1e-3  # of a patch's mean: what a wrong aperture leaves in each slice
_RING = 0.06  # of what a slice holds of a scene's mean: the frame's end rings in it, as far as a patch from the edge
_LEAST_NOISE = 1e-12
_ROUNDING = 1e-6  # of the strongest degree of freedom: a few of the last places of single precision
_NEGLIGIBLE = 0.01  # of a patch's probability
_ROUNDS = 3


@dataclass(frozen=True, slots=True, eq=False)
class JointViews:
    """`views` float32 (V, U, h, w), and their standard errors `sigma` (V, U) (root mean square over the frame).

    `disparities` (D,) in sensor columns over the aperture, `histogram` (D,) the frame's share of each, and
    `log_likelihood` of the frame, good for comparing models of the same slices.
    """

    views: Singles
    sigma: Floats
    disparities: Floats
    histogram: Floats
    log_likelihood: float

    @property
    def at_the_ends(self) -> float:
        """The share of the frame whose disparity is at an end of the range, so that it may be beyond; patches without
        texture, which have each disparity alike, don't count."""
        return float(self.histogram[[0, -1]].sum() - 2 * np.median(self.histogram))


def joint_views(
    slices: Complexes, model: SliceModel, *, samples_px: tuple[float, float], noise: Floats, reach: float
) -> JointViews:
    """The views of slices complex64 (K, h, w), the half plane of `model`, DC first.

    `samples_px` are the rows and columns of a slice's sample in sensor columns, `noise` (K,) the variances of slice
    pixels, `reach` the largest disparity in sensor columns over the aperture.
    """
    patches = Patches((slices.shape[1], slices.shape[2]), SIDE)
    cut = patches.cut(slices)
    weights = patches.window**2
    means = np.einsum("nyx,yx->n", cut[0].real, weights) / weights.sum()
    cut -= (model.common()[: len(slices), None] * means).astype(np.complex64)[:, :, None, None]
    disparities = np.linspace(-reach, reach, _HYPOTHESES)
    frame = _Frame.of(patches, model, samples_px, np.concatenate([noise, noise[1:]]), disparities)
    texture = _texture(cut[0].real, patches.window)
    groups = max(1, min(_TEXTURES, len(means) // _FEWEST))
    group = np.searchsorted(np.quantile(texture, np.arange(1, groups) / groups), texture)
    group[patches.at_edges] = groups
    rings = _RING * np.abs(model.common())
    rings[0] = 0
    count = model.aperture.views
    windowed = np.empty((len(means), count * count, SIDE, SIDE), dtype=np.float32)
    variance, histogram, likelihood = np.zeros(count * count), np.zeros(_HYPOTHESES), 0.0
    for number in np.unique(group):
        members = np.flatnonzero(group == number)
        mean = float(np.sqrt(np.mean(means[members] ** 2)))
        here = replace(frame, noise=frame.noise + (rings * mean) ** 2) if number == groups else frame
        found = _solve(here, patches.spectra(cut[:, members]), mean)
        windowed[members] = patches.images(found.spectra)
        variance += found.variance * len(members) / len(means)
        histogram += found.histogram * len(members) / len(means)
        likelihood += found.log_likelihood
    windowed += (means[:, None, None] * patches.window).astype(np.float32)[:, None]
    views = patches.joined(windowed).reshape(count, count, *slices.shape[1:])
    return JointViews(views, np.sqrt(variance).reshape(count, count), disparities, histogram, likelihood)


def _texture(images: Singles, window: Floats) -> Floats:
    """(N,) how much fine detail each patch (N, side, side) has."""
    rows, columns = np.diff(images, axis=1)[:, :, 1:], np.diff(images, axis=2)[:, 1:, :]
    return np.asarray(np.einsum("nyx,yx->n", rows**2 + columns**2, window[1:, 1:]), dtype=np.float64)


@dataclass(frozen=True, slots=True, eq=False)
class _Frame:
    """What all groups of patches share. `frequencies` (F, 2) in cycles per sensor column; `radius` (F,) in bins of a
    patch; `weights` (F,) of a frequency in likelihoods; `seen` (F, D, R, A) and `viewed` (F, D, R, V·U) of unit
    spectrum, R disparities within each step; `folds` from beyond the band;
    `alone` (A, V·U), how the slices hold what each view has alone; `noise` (A,)."""

    model: SliceModel
    frequencies: Floats
    per_bin: float
    weights: Singles
    multiplicity: Floats
    lowest: NDArray[np.bool_]
    seen: Complexes
    viewed: Complexes
    folds: list[Fold]
    alone: Complexes
    noise: Floats
    disparities: Floats

    @classmethod
    def of(
        cls,
        patches: Patches,
        model: SliceModel,
        samples_px: tuple[float, float],
        noise: Floats,
        disparities: Floats,
    ) -> _Frame:
        bins = patches.bins
        frequencies = bins / np.array(samples_px)
        within = (disparities[:, None] + np.array(_WITHIN) * (disparities[1] - disparities[0])).ravel()
        shape = (len(disparities), len(_WITHIN), len(bins), -1)
        weights = _INDEPENDENT * patches.multiplicity / 2
        weights[0] = 0  # the patch's mean was taken out
        return cls(
            model=model,
            frequencies=frequencies,
            per_bin=float(np.sqrt(samples_px[0] * samples_px[1])) * patches.side,
            weights=weights.astype(np.float32),
            multiplicity=patches.multiplicity,
            lowest=np.abs(bins * patches.side).max(axis=1) < 1.5,
            seen=np.ascontiguousarray(model.seen(frequencies, within).reshape(shape).transpose(2, 0, 1, 3)),
            viewed=np.ascontiguousarray(model.viewed(frequencies, within).reshape(shape).transpose(2, 0, 1, 3)),
            folds=model.folds(frequencies, np.linspace(-0.6, 0.6, _BEYOND_DISPARITIES) * disparities[-1]),
            alone=model.alone(),
            noise=noise,
            disparities=disparities,
        )

    def radius(self, frequencies: Floats) -> Floats:
        """|f| in bins of a patch, of frequencies (..., 2)."""
        return np.asarray(np.hypot(frequencies[..., 0], frequencies[..., 1]) * self.per_bin)


@dataclass(frozen=True, slots=True, eq=False)
class _Spectrum:
    """The power of texture over |f| in bins: `power` at 0, 1, 2 …, beyond the band a power law of `slope`."""

    power: Floats
    edge: int
    slope: float

    @classmethod
    def of(cls, measured: Floats, radius: Floats) -> _Spectrum:
        """From the DC slice's mean power (F,), noise taken off."""
        at = np.rint(radius).astype(int)
        power = np.bincount(at, weights=measured) / np.maximum(np.bincount(at), 1)
        power[0] = power[1]
        power = np.maximum(power, power.max() * 1e-9 + _LEAST_NOISE)
        edge = SIDE // 2 - 1
        inside = np.arange(2, edge + 1)
        slope = float(np.polyfit(np.log(inside), np.log(power[inside]), 1)[0])
        return cls(power, edge, min(slope, -1.0))

    def at(self, radius: Floats) -> Floats:
        """The power at |f| in bins."""
        inside = np.interp(np.minimum(radius, self.edge), np.arange(len(self.power)), np.log(self.power))
        return np.asarray(np.exp(inside) * (np.maximum(radius, self.edge) / self.edge) ** self.slope)


@dataclass(frozen=True, slots=True, eq=False)
class _Background:
    """What is not the band's own detail at one disparity: `whitener` L⁻¹ (F, A, A) of its covariance, `log_det` (F,) of
    that, `unmixed` (F, V·U, A) what views have alone, of the slices, and `left` (F, V·U) its variance that is left."""

    whitener: Complexes
    log_det: Floats
    unmixed: Complexes
    left: Floats

    @classmethod
    def of(cls, covariance: Complexes, alone: Complexes, power: Floats) -> _Background:
        """From `alone` (F, A, V·U), how the slices hold what each view has alone, of `power` (F,)."""
        lower = np.linalg.cholesky(covariance)
        diagonal = np.abs(np.diagonal(lower, axis1=1, axis2=2))
        whitener = np.linalg.inv(lower).astype(np.complex64)
        white = whitener @ alone
        unmixed = (white.conj().transpose(0, 2, 1) @ whitener * power[:, None, None]).astype(np.complex64)
        explained = power[:, None] * (np.abs(white) ** 2).sum(axis=1)
        return cls(whitener, 2 * np.log(diagonal).sum(axis=1), unmixed, power[:, None] * np.maximum(1 - explained, 0))


@dataclass(frozen=True, slots=True, eq=False)
class _Hypothesis:
    """The band's own detail under a hypothesis, diagonalised: `strength` λ (F, R), `viewed` (F, R, V·U) of each degree
    of freedom, less what the slices' view alone would hold of it, and `projected` Hᴴy (F, R, N)."""

    strength: Singles
    viewed: Complexes
    projected: Complexes

    @classmethod
    def of(
        cls, seen: Complexes, viewed: Complexes, white: Complexes, background: _Background, most: int
    ) -> _Hypothesis:
        """From `seen` (F, R, A) and `viewed`, for whitened spectra (F, A, N); at most `most` degrees of freedom."""
        rows = seen @ background.whitener.transpose(0, 2, 1)
        if rows.shape[1] <= most:
            strength, turn = np.linalg.eigh(rows.conj() @ rows.transpose(0, 2, 1))
        else:
            strength, left = np.linalg.eigh(rows.transpose(0, 2, 1) @ rows.conj())
            strength, left = strength[:, -most:], left[:, :, -most:]
            seen_well = (
                strength > _ROUNDING * strength[:, -1:]
            )  # what few slices don't see is rounding, not a direction
            strength = np.where(seen_well, strength, 0)
            scale = np.where(seen_well, 1 / np.sqrt(np.maximum(strength, _LEAST_NOISE)), 0)
            turn = rows.conj() @ left * scale[:, None, :].astype(np.float32)
        turned = turn.transpose(0, 2, 1)
        beside = viewed - seen @ background.unmixed.transpose(0, 2, 1)
        return cls(np.maximum(strength, 0).astype(np.float32), turned @ beside, (turned @ rows).conj() @ white)

    def log_likelihood(self, weights: Singles) -> Floats:
        """(strengths, N) over that of no detail at all."""
        scaled = _STRENGTHS[:, None, None]
        shrunk = weights[:, None] * scaled / (1 + scaled * self.strength)
        power = (self.projected.real**2 + self.projected.imag**2).reshape(-1, self.projected.shape[2])
        volume = (weights[:, None] * np.log1p(scaled * self.strength)).sum(axis=(1, 2))
        return np.asarray(shrunk.reshape(len(_STRENGTHS), -1) @ power - volume[:, None], dtype=np.float64)


@dataclass(frozen=True, slots=True, eq=False)
class _Solved:
    """`spectra` (F, V·U, N) of the views, their `variance` (V·U,) a pixel, `histogram` (D,), `log_likelihood`."""

    spectra: Complexes
    variance: Floats
    histogram: Floats
    log_likelihood: float


def _solve(frame: _Frame, spectra: Complexes, mean: float) -> _Solved:
    """The views of patches of similar texture from their spectra (F, A, N)."""
    power = np.maximum((np.abs(spectra[:, 0]) ** 2).mean(axis=1) - frame.noise[0], 0)
    spectrum = _Spectrum.of(power, frame.radius(frame.frequencies))
    own = spectrum.at(frame.radius(frame.frequencies))
    size = np.sqrt(own / len(_WITHIN)).astype(np.float32)[:, None, None, None]
    seen, viewed = frame.seen * size, frame.viewed * size
    # All disparities at once: at first each is as probable as any other.
    anywhere = np.full(len(frame.disparities), 1 / len(frame.disparities))
    background, white = _background(frame, spectra, spectrum, own, mean)
    single = [
        _Hypothesis.of(seen[:, d], viewed[:, d], white, background, len(_WITHIN)) for d in range(len(frame.disparities))
    ]
    gains = np.concatenate([one.log_likelihood(frame.weights) for one in single])
    prior = np.full(len(gains), 1 / len(gains))
    _, prior = _weighed(gains, prior)
    histogram = prior.reshape(len(single), -1).sum(axis=1)
    together = _together(seen, viewed, 0.98 * histogram + 0.02 * anywhere, white, background)
    hypotheses = [*single, together]
    last = together.log_likelihood(frame.weights)
    gains = np.concatenate([gains, last])
    odds, prior = _weighed(gains, np.concatenate([0.8 * prior, np.full(len(last), 0.2 / len(last))]))
    none = -float((frame.weights[:, None] * (np.abs(white) ** 2).sum(axis=1)).sum())
    none -= spectra.shape[2] * float((frame.weights * background.log_det).sum())
    return _Solved(
        *_expected(frame, hypotheses, odds, background, spectra),
        histogram=_histogram(prior, histogram),
        log_likelihood=none + float(np.log(prior @ np.exp(gains - gains.max(axis=0))).sum() + gains.max(axis=0).sum()),
    )


def _histogram(prior: Floats, histogram: Floats) -> Floats:
    count = len(_STRENGTHS)
    single = prior[:-count].reshape(len(histogram), count).sum(axis=1)
    return np.asarray(single + prior[-count:].sum() * histogram)


def _together(
    seen: Complexes, viewed: Complexes, histogram: Floats, white: Complexes, background: _Background
) -> _Hypothesis:
    share = np.sqrt(histogram).astype(np.float32)[None, :, None, None]
    flat = [(part * share).reshape(len(part), -1, part.shape[-1]) for part in (seen, viewed)]
    return _Hypothesis.of(flat[0], flat[1], white, background, _ALL)


def _background(
    frame: _Frame, spectra: Complexes, spectrum: _Spectrum, own: Floats, mean: float
) -> tuple[_Background, Complexes]:
    """The most probable background, over the amounts of detail beyond the band, and the whitened spectra."""
    size = len(frame.noise)
    through = (np.abs(frame.seen) ** 2).mean(axis=(1, 2, 3)) * own
    plain = np.zeros((len(own), size, size), dtype=np.complex64)
    each = frame.noise + _LEAST_NOISE + _ERROR * through[:, None]
    each = each + frame.lowest[:, None] * (_MEAN_ERROR * mean * SIDE) ** 2 * np.abs(frame.model.transfers) ** 2
    plain[:, range(size), range(size)] = each
    from_beyond = folded(frame.folds, [spectrum.at(frame.radius(fold.beyond)) for fold in frame.folds], size)
    lonely = (frame.alone @ frame.alone.conj().T).astype(np.complex64) * own.astype(np.float32)[:, None, None]
    inside = np.sqrt(own / (frame.seen.shape[1] * frame.seen.shape[2])).astype(np.float32)[:, None, None]
    waves = frame.seen.reshape(len(own), -1, size).transpose(0, 2, 1) * inside
    detail = plain + waves @ waves.conj().transpose(0, 2, 1)
    sampled = spectra @ spectra.conj().transpose(0, 2, 1) / spectra.shape[2]
    costs = []
    for beyond, alone in _BACKGROUNDS:
        whole = detail + np.float32(beyond) * from_beyond + np.float32(alone) * lonely
        explained = np.trace(np.linalg.solve(whole, sampled), axis1=1, axis2=2).real
        costs.append(float((frame.weights * (np.linalg.slogdet(whole)[1] + explained)).sum()))
    beyond, alone = _BACKGROUNDS[int(np.argmin(costs))]
    rest = plain + np.float32(beyond) * from_beyond + np.float32(alone) * lonely
    background = _Background.of(rest, frame.alone, alone * own)
    return background, background.whitener @ spectra


def _weighed(gains: Floats, prior: Floats) -> tuple[Floats, Floats]:
    """(odds (C, N), prior (C,)) of hypotheses with log likelihoods (C, N): the prior that explains all patches best."""
    for _ in range(_ROUNDS):
        total = gains + np.log(prior)[:, None]
        odds = np.exp(total - total.max(axis=0))
        odds /= odds.sum(axis=0)
        prior = odds.mean(axis=1) + 1e-5
        prior /= prior.sum()
    return odds, prior


def _expected(
    frame: _Frame, hypotheses: list[_Hypothesis], odds: Floats, background: _Background, spectra: Complexes
) -> tuple[Complexes, Floats]:
    """The views' spectra (F, V·U, N), averaged over hypotheses, and their mean variance (V·U,) a pixel."""
    count = len(_STRENGTHS)
    patches = odds.shape[1]
    probable = odds.reshape(len(hypotheses), count, patches)
    probable = np.where(probable.sum(axis=1, keepdims=True) > _NEGLIGIBLE, probable, 0)
    probable /= probable.sum(axis=(0, 1))
    made = background.unmixed @ spectra
    variance = frame.multiplicity @ background.left
    for one, some in zip(hypotheses, probable, strict=True):
        odd = some.astype(np.float32)
        used = np.flatnonzero(odd.sum(axis=0))
        if not len(used):
            continue
        scaled = _STRENGTHS[:, None, None]
        shares = scaled / (1 + scaled * one.strength)  # (strengths, F, R)
        shrunk = np.tensordot(shares, odd[:, used], axes=(0, 0))
        made[:, :, used] += one.viewed.transpose(0, 2, 1) @ (shrunk * one.projected[:, :, used])
        mean = np.tensordot(odd.sum(axis=1) / patches, shares, axes=1)
        variance += np.einsum("f,frv,fr->v", frame.multiplicity, np.abs(one.viewed) ** 2, mean)
    return made, variance / SIDE**2
