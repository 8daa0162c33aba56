"""Model the spectra of patches of slices: the band's own detail over a range of disparities, and what else is there.

What else: detail that folds in from beyond the band, what one view has alone, noise, and errors of the model itself.
All are covariances of the slices at one spatial frequency, and the patches of a group share them.
"""

from __future__ import annotations

from collections.abc import Collection, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from dappled.decode.array_types import Complexes, Floats, Singles
from dappled.decode.joint.patches import Patches
from dappled.decode.joint.slice_model import Fold, SliceModel, Terms, folded, single
from dappled.decode.joint.view_pairs import paired
from dappled.workers import each, spans

Doubles = NDArray[Any]
# Chosen by hand where no figure stands beside a number; benchmarks/views.py measures what all of them together make.

SIDE = 24  # samples: a patch is wide against parallax, and small against things at one disparity
FARTHEST = 2.0  # times the reach: nothing that moves farther is told from other things
STILL = 1 / 16  # of the reach: hardly any parallax
MOTIONLESS = STILL / 4  # of the reach: what a patch by itself can't tell from none
# Of |disparity|, in reaches: hardly any, the usual ones, far ones, what is beyond all, and none that can be told.
RANGES = ((0.0, STILL), (0.0, 1.0), (1.0, FARTHEST), (FARTHEST, 4.0), (0.0, MOTIONLESS))
AT_REST, USUAL, FAR, BEYOND, MOTIONLESS_RANGE = range(len(RANGES))


@dataclass(frozen=True, slots=True)
class PatchKind:
    """What a patch may be: its disparities in one of `RANGES`; its detail beyond the band, times the spectrum continued
    as a power law; what a view has alone (things hidden from others, parallax within a patch), of its power; and by how
    many `nats` it must be more probable than others."""

    range: int
    beyond: float
    alone: float
    nats: float = 0.0


# Chosen by hand, each four to ten times the last: a hard edge has far more folded detail than its texture continued
# (one amount for all patches cost views at edges 3 dB); measured by benchmarks/views.py.
_BEYOND = (0.1, 1.0, 4.0, 16.0, 64.0)
_FAR_NATS = 12.0  # few things are beyond a range; chosen by hand, measured by benchmarks/views.py
# Of detail that folds in where nothing moves: usual amounts, and those of few frequencies. Chosen by hand, measured by
# benchmarks/views.py (terrain, and boards before a background at rest).
_USUAL_AMOUNTS, _MORE, _SELDOM = (0.01, 1.0), (8.0, 64.0, 512.0), 0.05
# Of the median patch: terrain from the air has less than 1, boards with parallax of 0.3 px and more 6 to 27.
_MOVED_NATS = 2.0
# Of one patch: straight edges at rest have up to 13, things that move by 0.9 px from view to view 24 and more.
MOVES_NATS = 16.0
# Of a patch of a calm frame, four fifths of whose patches have less than `_MOVED_NATS`, of any parallax. Of terrain
# from the air nine tenths have less, by hundreds of nats; half of smooth boards 2.4 px from the focus have more. A
# frame of which a third moves by 0.9 px from view to view is not calm.
CALM_NATS, _CALM_SHARE = 4.0, 0.8
# Edges between depths look like it, too. Chosen by hand: a thing 18 px from view to view before a board at 0.5 px has
# 32.8 dB with this kind, 28.1 without.
_ALONE_NATS = 500.0
# A patch with all its detail in the band, or without parallax, can be trusted further. The shares that views have alone
# (1e-4, 0.01, 0.03, 1) are chosen by hand, measured by benchmarks/views.py.
KINDS: Sequence[PatchKind] = (
    *(PatchKind(AT_REST, beyond, 1e-4) for beyond in (0.0, 1.0, 4.0, 16.0, 64.0)),
    PatchKind(USUAL, 0.0, 0.03),
    *(PatchKind(USUAL, beyond, 0.01) for beyond in _BEYOND),
    PatchKind(USUAL, 1.0, 1.0, _ALONE_NATS),
    *(PatchKind(far, beyond, 0.01, (far - USUAL) * _FAR_NATS) for far in (FAR, BEYOND) for beyond in (0.1, 1.0, 4.0)),
)
USUAL_KINDS = [number for number, kind in enumerate(KINDS) if (kind.range, kind.nats) == (USUAL, 0)]
LEAST_NOISE = 1e-12  # variance: what a slice without noise counts as, so that its inverse is finite in double precision
WITHIN = (-0.4, 0.0, 0.4)  # of the step from one disparity to the next: a patch is not flat
AT_A_TIME = 256  # patches: what is worked on stays small
_FEW_AT_A_TIME = 64  # where little is done to each number, so that what is worked on stays near the processor
_TRIED = 3  # of so many frequencies one is looked at to choose the kind
_UNSURE_NATS = 300.0  # by those: less is no choice
_HYPOTHESES = 17  # disparities over a range, an eighth of the reach apart
_AT_REST, _MOTIONLESS = 5, 3  # over one next to 0: slices tell no more of them
# In reaches: disparities of what folds in from beyond the band.
_FOLDED = {AT_REST: np.linspace(-STILL, STILL, 3), USUAL: np.linspace(-0.6, 0.6, 5)}
_INDEPENDENT = 0.5  # of a patch's samples are measurements of their own: patches overlap, windows correlate
_ROUNDING = 1e-9  # of the strongest direction's power: far below what is not explained
_SINGLE = 5e-6  # of a covariance's diagonal: some fifty of single precision's last places, summed up
_ERROR = 5e-4  # of a slice's power: what no light field explains, where nothing is measured
# Waves over a patch, of those that say what a patch's error is: boards that hide each other, SNR 100, have 43.0 dB by
# these, 42.5 where all decide together.
_SHORT = 3.2
_SMALL_NATS = 4.6  # odds of 100: where noise hides which error it is, the larger one costs nothing
_UNLIKE = 1e-3  # of the light, times a transfer: what a wrong aperture leaves in each slice, where nothing is measured


@dataclass(frozen=True, slots=True, eq=False)
class DisparityRange:
    """Disparities that a patch may have, `disparities` (D·R,) in sensor columns over the aperture, ascending: `seen`
    (F, D, R, A) and `viewed` (F, D, R, V·U) of unit spectrum, views in pairs, R of them within each of D steps. What is
    seen lies in few directions: it is `within` (F, D, R, r) times a `basis` (F, r, A)."""

    disparities: Floats
    seen: Terms
    viewed: Singles
    within: Doubles
    basis: Doubles

    @classmethod
    def of(
        cls, model: SliceModel, frequencies: Floats, nearest: float, farthest: float, count: int = _HYPOTHESES
    ) -> DisparityRange:
        """From |disparity| `nearest` to `farthest`, in sensor columns over the aperture, `count` of them."""
        disparities = np.linspace(-farthest, farthest, count)
        if nearest:
            one = np.linspace(nearest, farthest, count // 2 + 1)[1:]
            disparities = np.concatenate([-one[::-1], one])
        step = disparities[1] - disparities[0]
        within = (disparities[:, None] + np.array(WITHIN) * step).ravel()
        shape = (len(disparities), len(WITHIN), len(frequencies), -1)
        seen, viewed = (
            np.ascontiguousarray(part(frequencies, within).reshape(shape).transpose(2, 0, 1, 3))
            for part in (model.seen, lambda *at: paired(model.viewed(*at)))
        )
        rows = _double(seen.reshape(len(frequencies), -1, seen.shape[3]))
        strength, vectors = np.linalg.eigh(rows.swapaxes(1, 2) @ rows.conj())
        count = int((strength > _ROUNDING * strength[:, -1:]).sum(axis=1).max())
        vectors = vectors[:, :, -count:]
        coefficients = (rows @ vectors.conj()).reshape(*seen.shape[:3], count)
        return cls(within, seen, viewed, coefficients, vectors.swapaxes(1, 2))


@dataclass(frozen=True, slots=True, eq=False)
class FrameModel:
    """What all groups of patches share. `frequencies` (F, 2) in cycles per sensor column; `per_bin` of a patch;
    `weights` (F,) of a frequency in likelihoods; `ranges` of disparities, by their place in `RANGES`; `folds` from
    beyond the band, at rest and in the usual range; `alone` (A, V·U), how the slices hold what each view has alone,
    the views in pairs;
    `noise` (A,); `astray`, the share of the scene's light that gets into each slice but the first, whatever its
    transfer, `unlike` the same, times its transfer, by a wrong aperture; `error`, the share of a slice's power that no
    light field explains."""

    model: SliceModel
    frequencies: Floats
    per_bin: float
    weights: Singles
    multiplicity: Floats
    lowest: NDArray[np.bool_]
    ranges: Mapping[int, DisparityRange]
    folds: Mapping[int, list[Fold]]
    alone: Terms
    noise: Floats
    astray: float = 0.0
    unlike: float = _UNLIKE
    error: float = _ERROR

    @classmethod
    def of(
        cls,
        patches: Patches,
        model: SliceModel,
        samples_px: tuple[float, float],
        noise: Floats,
        reach: float,
        *,
        ranges: Collection[int] = range(len(RANGES)),
        workers: int = 1,
    ) -> FrameModel:
        """For patches whose disparities are in these `ranges`; `rests_of` needs the usual one in any case."""
        bins = patches.bins
        frequencies = bins / np.array(samples_px)
        weights = _INDEPENDENT * patches.multiplicity / 2
        weights[0] = 0  # the patch's mean was taken out
        found: dict[int, DisparityRange] = {}
        folds: dict[int, list[Fold]] = {}

        def make(number: int) -> None:
            near, far = RANGES[number]
            count = {AT_REST: _AT_REST, MOTIONLESS_RANGE: _MOTIONLESS}.get(number, _HYPOTHESES)
            found[number] = DisparityRange.of(model, frequencies, near * reach, far * reach, count)
            if number in _FOLDED:
                folds[number] = model.folds(frequencies, _FOLDED[number] * reach)

        each(make, ranges, workers)
        return cls(
            model=model,
            frequencies=frequencies,
            per_bin=float(np.sqrt(samples_px[0] * samples_px[1])) * patches.side,
            weights=weights.astype(np.float32),
            multiplicity=patches.multiplicity,
            lowest=np.abs(bins * patches.side).max(axis=1) < 1.5,
            ranges=found,
            folds=folds,
            alone=model.alone(),
            noise=noise,
        )

    def radius(self, frequencies: Floats) -> Floats:
        """|f| in bins of a patch, of frequencies (..., 2)."""
        return np.asarray(np.hypot(frequencies[..., 0], frequencies[..., 1]) * self.per_bin)


@dataclass(frozen=True, slots=True, eq=False)
class TexturePower:
    """The power of texture over |f| in bins: `power` at 0, 1, 2 …, beyond the band a power law of `slope`."""

    power: Floats
    edge: int
    slope: float

    @classmethod
    def of(cls, measured: Floats, radius: Floats) -> TexturePower:
        """From the DC slice's mean power (F,), noise taken off."""
        at = np.rint(radius).astype(int)
        power = np.bincount(at, weights=measured) / np.maximum(np.bincount(at), 1)
        power[0] = power[1]
        power = np.maximum(power, power.max() * 1e-9 + LEAST_NOISE)
        edge = SIDE // 2 - 1
        inside = np.arange(2, edge + 1)
        slope = float(np.polyfit(np.log(inside), np.log(power[inside]), 1)[0])
        return cls(power, edge, min(slope, -1.0))

    def at(self, radius: Floats) -> Floats:
        """The power at |f| in bins."""
        inside = np.interp(np.minimum(radius, self.edge), np.arange(len(self.power)), np.log(self.power))
        return np.asarray(np.exp(inside) * (np.maximum(radius, self.edge) / self.edge) ** self.slope)


@dataclass(frozen=True, slots=True, eq=False)
class Rests:
    """What is not the band's own detail in patches of some `kinds`: `plain` (F, A) variances of noise, covariances
    (F, A, A) `from_beyond` the band, by range, and `lonely` (A, A) of what views have alone, over the power `own`
    (F,)."""

    kinds: Sequence[PatchKind]
    plain: Floats
    from_beyond: Mapping[int, Terms]
    lonely: Terms
    own: Floats

    def of(self, number: int, some: slice = slice(None)) -> Terms:
        """The covariances (F, A, A) of a kind, at some frequencies."""
        kind = self.kinds[number]
        made = np.float32(kind.beyond) * self.from_beyond[min(kind.range, USUAL)][some]
        made += np.float32(kind.alone) * self.own[some].astype(np.float32)[:, None, None] * self.lonely
        diagonal = range(self.plain.shape[1])
        made[:, diagonal, diagonal] += self.plain[some]
        return made

    def whole(self, number: int, detail: Terms, some: slice = slice(None)) -> Terms:
        """The same with the `detail` (F, A, A) of the band itself."""
        # More detail beyond the band than usual: there is as much more in it.
        return self.of(number, some) + np.float32(max(1.0, self.kinds[number].beyond)) * detail

    def variances(self, number: int) -> Floats:
        """(F, A) of a kind: the diagonals of `of`."""
        return np.asarray(np.einsum("faa->fa", self.of(number).real))


def rests_of(
    frame: FrameModel, spectrum: TexturePower, own: Floats, mean: float, kinds: Sequence[PatchKind] = KINDS
) -> Rests:
    """What is not the band's own detail, of each kind of patch."""
    from_beyond = {
        number: folded(some, [spectrum.at(frame.radius(one.beyond)) for one in some], len(frame.noise))
        for number, some in frame.folds.items()
    }
    plain = _plain(frame, own, mean)
    return Rests(kinds, plain, from_beyond, frame.alone @ frame.alone.conj().T, own)


def _plain(frame: FrameModel, own: Floats, mean: float) -> Floats:
    """(F, A) variances of noise, of what no light field explains, and of light that is where it should not be."""
    through = (np.abs(frame.ranges[USUAL].seen) ** 2).mean(axis=(1, 2, 3)) * own
    own_noise = frame.noise + LEAST_NOISE + frame.error * through[:, None]
    light = own + frame.lowest * (mean * SIDE) ** 2
    lost = frame.astray**2 + (frame.unlike * np.abs(frame.model.transfers[1:])) ** 2
    own_noise[:, 1:] += light[:, None] * lost
    return np.asarray(own_noise)


def rests_in(frame: FrameModel, rests: Rests, mean: float) -> Rests:
    """The same of a frame that differs by its `error` alone."""
    return replace(rests, plain=_plain(frame, rests.own, mean))


def detail_of(seen: Terms, own: Floats) -> Terms:
    """(F, A, A) covariance of the band's own detail, of all disparities of a range at once, `seen` (F, D, R, A)."""
    flat = seen.reshape(len(own), -1, seen.shape[3]).transpose(0, 2, 1)
    waves = flat * np.sqrt(own / flat.shape[2]).astype(np.float32)[:, None, None]
    return np.asarray(waves @ waves.conj().transpose(0, 2, 1))


def wholes_of(frame: FrameModel, rests: Rests, numbers: Iterable[int], some: slice = slice(None)) -> Iterator[Terms]:
    """Covariances (F, A, A) of slices at some frequencies, one of each of these kinds of patch."""
    details: dict[int, Terms] = {}
    for number in numbers:
        place = rests.kinds[number].range
        if place not in details:
            details[place] = detail_of(frame.ranges[place].seen[some], rests.own[some])
        yield rests.whole(number, details[place], some)


def usual_nats(
    frame: FrameModel, rests: Rests, kinds: NDArray[np.intp], spectra: Complexes, *, any_strength: bool = False
) -> Floats:
    """(N,) log likelihoods of patches (F, A, N) that are of these `kinds` (N,), all of the usual range; at
    `any_strength` of all that is in them, the likeliest."""
    detail, found = detail_of(frame.ranges[USUAL].seen, rests.own), np.empty(len(kinds))
    measured = spectra.shape[1] * float(frame.weights.sum())
    for number in map(int, np.unique(kinds)):
        here = kinds == number
        volume, squares = _fit(rests.whole(number, detail), some_of(spectra, here), frame.weights)
        if any_strength:
            squares = measured * np.log(np.maximum(squares / measured, LEAST_NOISE)) + measured
        found[here] = volume - squares
    return found


def likely_errors(
    frames: Sequence[FrameModel], rests: Sequence[Rests], kinds: NDArray[np.intp], spectra: Complexes
) -> NDArray[np.intp]:
    """(N,) which of two frames, that of the larger `error` first, patches (F, A, N) of these `kinds` (N,) are of, by
    the `rests_of` their group in each: of the second where short waves say so with odds of 100. Long ones say so
    beside edges of opaque things, too. A patch is asked at its own strength: one that is stronger than its group has
    more of everything, which at the group's strength only a larger error explains."""
    usual, radius = np.isin(kinds, USUAL_KINDS), frames[0].radius(frames[0].frequencies)
    short = frames[0].weights * (radius >= _SHORT).astype(np.float32)
    large, small = (
        usual_nats(replace(one, weights=short), rest, kinds[usual], some_of(spectra, usual), any_strength=True)
        for one, rest in zip(frames, rests, strict=True)
    )
    found = np.zeros(len(kinds), dtype=np.intp)
    found[usual] = small > large + _SMALL_NATS
    return found


def _double(values: NDArray[Any]) -> Doubles:
    return values.astype(np.result_type(values, np.float64))


def some_of(spectra: Complexes, which: NDArray[np.bool_] | NDArray[np.intp]) -> Complexes:
    """Those of `which` patches, of (F, A, N), no copy where they are one after the other; by an index NumPy would leave
    them with the patches apart in memory."""
    places = np.flatnonzero(which) if which.dtype == np.bool_ else which
    if len(places) and (np.diff(places) == 1).all():
        return spectra[:, :, places[0] : places[-1] + 1]
    return np.asarray(spectra.take(places, axis=2))


def times(matrix: NDArray[Any], spectra: NDArray[Any]) -> NDArray[Any]:
    """`matrix` (F, a, b) times complex `spectra` (F, b, N): of a real one a half of the products, as their real and
    imaginary parts are 2 N columns of numbers."""
    if np.iscomplexobj(matrix):
        return np.asarray(matrix @ spectra)
    made = matrix @ np.ascontiguousarray(spectra).view(spectra.real.dtype)
    return np.asarray(made.view(np.result_type(made, np.complex64)))


def whitener_of(covariance: Terms) -> Doubles:
    """L⁻¹ (F, A, A) of covariances LLᴴ (F, A, A): what has a covariance is white behind it."""
    # In double precision: odds of hypotheses are exponentials of numbers in the thousands.
    exact, diagonal = _double(covariance), range(covariance.shape[1])
    exact[:, diagonal, diagonal] *= 1 + _SINGLE
    lower = np.linalg.cholesky(exact)
    # Row by row for all F at once: faster than LU of each.
    found = np.zeros_like(lower)
    for row in range(lower.shape[1]):
        own = 1 / lower[:, row, row, None]
        found[:, row, row] = own[:, 0]
        found[:, row, :row] = -own * (lower[:, row, None, :row] @ found[:, :row, :row])[:, 0]
    return found


def nats_of(whitener: Doubles, white: NDArray[Any]) -> Floats:
    """(F, N) log likelihoods, but for a constant, of patches that the `whitener` (F, A, A) made `white` (F, A, N)."""
    return np.asarray(_volume(whitener)[:, None] - summed(_squares(white)))


def _volume(whitener: Doubles) -> Floats:
    """(F,)"""
    return np.asarray(2 * np.log(np.abs(np.diagonal(whitener, axis1=1, axis2=2))).sum(axis=1))


def _squares(white: NDArray[Any]) -> NDArray[Any]:
    """(F, 2 N) sums of the squares of the real parts of (F, A, N), and of the imaginary ones, in turns."""
    parts = white.view(white.real.dtype)
    return np.asarray(np.einsum("fan,fan->fn", parts, parts))


def summed(parts: NDArray[Any]) -> NDArray[Any]:
    """(…, N) what real and imaginary parts have together, of (…, 2 N) in turns."""
    return np.asarray(parts[..., ::2] + parts[..., 1::2])


def likelihoods(wholes: Iterable[Terms], spectra: Complexes, weights: Singles, workers: int = 1) -> Floats:
    """(B, N) log likelihoods of patches (F, A, N) whose slices have these covariances (F, A, A), by frequencies'
    `weights` (F,)."""
    listed = list(wholes)
    found = np.empty((len(listed), spectra.shape[2]))

    def one(number: int) -> None:
        volume, squares = _fit(listed[number], spectra, weights)
        found[number] = volume - squares

    each(one, range(len(listed)), workers)
    return found


def _fit(whole: Terms, spectra: Complexes, weights: Singles) -> tuple[float, Floats]:
    """The two parts of the log likelihoods of patches (F, A, N): a volume less their squares (N,) behind the whitener
    of their covariance (F, A, A)."""
    exact = whitener_of(whole)
    whitener, squares = single(exact), np.empty(spectra.shape[2])
    for some in spans(spectra.shape[2], AT_A_TIME):
        squares[some] = summed(weights @ _squares(times(whitener, spectra[:, :, some])).astype(np.float64))
    return float(weights @ _volume(exact)), squares


def likely_kinds(frame: FrameModel, rests: Rests, spectra: Complexes, *, with_parallax: bool) -> NDArray[np.intp]:
    """(N,) the most probable kinds of patches (F, A, N) with these `rests_of` their group, of those `with_parallax` or
    those at rest. Which of the two a patch is of, likelihoods tell badly: small parallax, too, is explained better by
    folded detail in free amounts."""
    numbers = [number for number, kind in enumerate(KINDS) if (kind.range != AT_REST) == with_parallax]
    tried = _tried(frame, rests, numbers, spectra)
    return np.array(numbers)[_most_likely(frame, rests, numbers, spectra, tried)]


def parallax_nats(frame: FrameModel, rests: Rests, spectra: Complexes) -> Floats:
    """(N,) by how many nats the likeliest kind with parallax is more probable than the likeliest at rest, of patches
    (F, A, N). What is less than 0 may be small parallax nevertheless (`likely_kinds`); large parallax is far more."""
    tried = _tried(frame, rests, range(len(KINDS)), spectra)
    moving = np.array([kind.range != AT_REST for kind in KINDS])
    return np.asarray(tried[moving].max(axis=0) - tried[~moving].max(axis=0))


def _tried(frame: FrameModel, rests: Rests, numbers: Sequence[int], spectra: Complexes) -> Floats:
    """(B, N) log likelihoods of these kinds by a few frequencies of patches (F, A, N), as if by all."""
    few = slice(None, None, _TRIED)
    weights = frame.weights[few] * (frame.weights.sum() / frame.weights[few].sum())
    tried = likelihoods(wholes_of(frame, rests, numbers, few), spectra[few], weights)
    tried -= np.array([[KINDS[number].nats] for number in numbers])
    return tried


def _most_likely(
    frame: FrameModel, rests: Rests, numbers: Sequence[int], spectra: Complexes, tried: Floats
) -> NDArray[np.intp]:
    """(N,) places in `numbers` (B,) of the most probable kinds of patches (F, A, N), by the log likelihoods (B, N) of a
    few frequencies where these are sure of it, else of all."""
    likely = tried >= tried.max(axis=0) - _UNSURE_NATS
    likely &= np.count_nonzero(likely, axis=0) > 1
    nats = tried.copy()
    details: dict[int, Terms] = {}
    for place in map(int, np.flatnonzero(likely.any(axis=1))):
        number, here = numbers[place], likely[place]
        kind = rests.kinds[number]
        if kind.range not in details:
            details[kind.range] = detail_of(frame.ranges[kind.range].seen, rests.own)
        whole = rests.whole(number, details[kind.range])
        nats[place, here] = likelihoods([whole], some_of(spectra, here), frame.weights)[0] - kind.nats
    unsure = likely.any(axis=0)
    return np.asarray(np.where(unsure, np.where(likely, nats, -np.inf).argmax(axis=0), tried.argmax(axis=0)))


def moved_nats(frame: FrameModel, rests: Rests, spectra: Complexes) -> Floats:
    """(N,) by how many nats hardly any parallax is more probable than none in patches (F, A, N)."""
    ranges = [frame.ranges[number] for number in (AT_REST, MOTIONLESS_RANGE)]
    hardly, not_at_all = _at_rest_nats(frame, ranges, rests, spectra)
    return hardly - not_at_all


def is_motionless(moved: Floats) -> bool:
    """Whether a frame without parallax has none that any patch could tell: by `moved_nats` of its patches."""
    return float(np.median(moved)) < _MOVED_NATS


def is_calm(moved: Floats) -> bool:
    """Whether nearly nothing of a frame has parallax that a patch could tell, by `AlikePatches.moved` of patches
    anywhere."""
    return float(np.quantile(moved, _CALM_SHARE)) < _MOVED_NATS


def _at_rest_nats(
    frame: FrameModel, ranges: Sequence[DisparityRange], rests: Rests, spectra: Complexes
) -> list[Floats]:
    """(N,) log likelihoods of patches (F, A, N) whose disparities are in each of these ranges next to 0.

    Each slice then holds what is common to all views, and detail that folds in, in an amount of its own at each
    frequency: a straight edge has far more in one direction than in others, and looks like parallax where one amount
    is for all.
    """
    common, own = frame.model.common(), rests.own
    base, once = (rests.variances(number) for number in (0, 1))  # without detail beyond the band, and with it
    amounts = np.array((*_USUAL_AMOUNTS, *_MORE))[:, None, None, None]
    sizes = []  # (amounts, F, A, 1) variances
    for some in ranges:
        seen = some.seen
        moved = (np.abs(seen - single(common) * seen[..., :1]) ** 2).mean(axis=(1, 2)) * own[:, None]
        moved[:, 0] = own
        sizes.append(base[..., None] + amounts * (once - base + moved)[..., None])
    terms = [(np.log(size).astype(np.float32), (-1 / size).astype(np.float32)) for size in sizes]
    found = [np.zeros((len(_USUAL_AMOUNTS), spectra.shape[2])) for _ in ranges]
    for some_patches in spans(spectra.shape[2], _FEW_AT_A_TIME):
        for number, turn in enumerate(common):
            left = spectra[:, number, some_patches]
            if number:
                left = left - np.complex64(turn) * spectra[:, 0, some_patches]
            power = left.real**2 + left.imag**2
            for (volume, shrunk), total in zip(terms, found, strict=True):
                nats = shrunk[:, :, number] * power
                nats -= volume[:, :, number]
                total[:, some_patches] += frame.weights @ _means_of_odds(nats)
    return [np.asarray(total.max(axis=0)) for total in found]


def _means_of_odds(nats: Singles) -> Singles:
    """(usual, F, N) log likelihoods where each frequency has any of these amounts (B, F, N), which are overwritten:
    mostly one of the usual ones, which come first."""
    usual = len(_USUAL_AMOUNTS)
    top = nats.max(axis=0)
    nats -= top
    odds = np.exp(nats, out=nats)
    seldom = np.float32(_SELDOM / len(_MORE)) * odds[usual:].sum(axis=0)
    made = odds[:usual]
    made *= np.float32(1 - _SELDOM)
    made += seldom
    return np.asarray(top + np.log(made, out=made))
