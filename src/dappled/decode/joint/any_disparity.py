"""Views of patches whose disparities are not known: the most probable ones, averaged over hypotheses.

A hypothesis is one disparity out of a range, or all disparities of the frame at once, with one of several strengths of
texture. It weighs what its likelihood and its share in the whole frame say.

For a hypothesis the band's own detail has few degrees of freedom. With the rest, folded detail and noise, made white
(y = L⁻¹ slices) it is y = H s + n; HᴴH is diagonalised, and the most probable s and the likelihood follow for any
strength a of the texture: s = a/(1 + aλ)·Hᴴy. Each view also has a little alone, which is part of the rest and
estimated from what s leaves of the slices: without noise and folded detail the slices decide, whatever the model.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from dappled.decode.array_types import Complexes, Floats, Singles
from dappled.decode.joint.patch_model import LEAST_NOISE, SIDE, WITHIN, DisparityRange, FrameModel, whitener_of

Doubles = NDArray[np.complex128]
# Chosen by hand where no figure stands beside a number; benchmarks/views.py measures what all of them together make.

# Of a patch's texture, times the mean power of patches like it: chosen by hand, two decades down and one up; measured
# by benchmarks/views.py.
STRENGTHS = np.array([0.01, 0.1, 0.3, 1.0, 3.0, 10.0], dtype=np.float32)
_ALL = 12  # degrees of freedom a frequency where all disparities are there at once
_ROUNDING = 1e-6  # of the strongest degree of freedom: a few of the last places of single precision
_NEGLIGIBLE = 0.01  # of a patch's probability
_ROUNDS = 3  # of how often each disparity occurs; chosen by hand, measured by benchmarks/views.py


@dataclass(frozen=True, slots=True, eq=False)
class PatchBackground:
    """What is not the band's own detail at one disparity: `whitener` L⁻¹ (F, A, A) of its covariance, `unmixed`
    (F, V·U, A) what views have alone, of the slices, and `left` (F, V·U) its variance that is left."""

    whitener: Doubles
    unmixed: Complexes
    left: Floats

    @classmethod
    def of(cls, covariance: Complexes, alone: Complexes, power: Floats) -> PatchBackground:
        """From `alone` (F, A, V·U), how the slices hold what each view has alone, of `power` (F,)."""
        whitener = whitener_of(covariance)
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
        cls,
        seen: Complexes,
        viewed: Complexes,
        white: Doubles,
        background: PatchBackground,
        *,
        weights: Singles,
        most: int,
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
    scaled = STRENGTHS[:, None, None]
    shrunk = weights[:, None] * scaled / (1 + scaled * strength)
    power = (projected.real**2 + projected.imag**2).reshape(-1, projected.shape[2])
    volume = (weights[:, None] * np.log1p(scaled * strength)).sum(axis=(1, 2))
    return np.asarray(shrunk.reshape(len(STRENGTHS), -1) @ power - volume[:, None], dtype=np.float64)


def views_at_any(
    frame: FrameModel, some: DisparityRange, own: Floats, background: PatchBackground, spectra: Complexes
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
    frame: FrameModel, hypotheses: list[_Hypothesis], odds: Floats, background: PatchBackground, spectra: Complexes
) -> tuple[Complexes, Floats]:
    """The views' spectra (F, V·U, N), averaged over hypotheses, and their variance (V·U, N) a pixel, with that between
    hypotheses, but for what each view has alone."""
    count = len(STRENGTHS)
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
        scaled = STRENGTHS[:, None, None]
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
