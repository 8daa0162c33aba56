"""Find how far a mask lies from its calibrated place by the likelihood of a frame's slices.

A mask moved by δ periods turns slice k by 2πk·δ, one turned by φ makes that phase run across the frame. The model of
the light field (`patch_model`) gives the slices' covariance C(f) in a patch, so the log likelihood of its spectra y is

    −Σ_f w_f Σ_ab conj(y_a) C⁻¹_ab y_b exp(2πi (k_a − k_b)·δ) = Re Σ_m c_m exp(2πi m·δ):

a polynomial of few terms, m the differences of orders. Parallax tells δ even where the stop averages all carriers away
(an even square stop at the mask's ideal aperture): slices of a shifted mask are those of views that change places.

Without a mask a slice is detail of the scene alone, whose phases are as random as the places of its edges: each patch
places the mask somewhere, with L(δ) over its mean over all δ as sharply as with a mask. So the odds of one place for
all patches but an unknown share, against a place for each, say whether there is a mask, whatever the likelihood's
scale: without a mask they are 1 on average. A scene without parallax, behind an even square stop at the ideal aperture,
holds no trace of a mask, and tells none from its absence.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray
from scipy import fft

from dappled.decode.array_types import Complexes, Floats, Singles
from dappled.decode.joint.patch_model import (
    AT_REST,
    KINDS,
    SIDE,
    USUAL,
    FrameModel,
    TexturePower,
    detail_of,
    likelihoods,
    rests_of,
    wholes_of,
)
from dappled.decode.joint.patches import Patches
from dappled.decode.joint.slice_model import SliceModel
from dappled.decode.mask_odds import SEEN_NATS
from dappled.decode.optics import Lattice, Order, Sensor
from dappled.workers import each, spans

# Chosen by hand where no figure stands beside a number; benchmarks/views.py measures what all of them together make.

_MOST_PATCHES = 400  # those with the most texture
_WITNESSES = 60  # patches that tell in flight whether there is a mask
_FEWEST = 12  # patches, for an answer at all
_AT_A_TIME = 50  # patches
_FAINT = 0.3  # of the mean texture: fainter patches are not scaled up to it, noise and all
_TRIED = 3  # of so many frequencies one is looked at to choose the kind of witnesses
_STEPS = 48  # of a period: how finely moves are tried, up to half a period
_MOST_TURN, _TURNS = 0.007, 81  # radians to either side, and how many are tried
_ROUNDS = 8  # of Newton's method, from the best that was tried
_LEAST_PERIODS, _LEAST_TURN = 0.03, 6e-4  # clean frames reach 0.017 periods and 3e-4 radians
_SURE = 3.0  # standard deviations: patches that are more probable with the move, beyond half of all
_LEAST_NATS = 3.0  # that the median patch must gain
_LIKELY, _MANY_NATS = 2.0, 30.0  # or both of these: clean frames gain 14 nats at most, moved ones 33 and more
_AT_EDGE = 0.95  # of the farthest turn: beyond it the best is elsewhere
# Of the patches may lie in anything that places no mask, edges between depths or no parallax: any share is as probable.
_ASTRAY = (np.arange(32) + 0.5) / 32
_SEEN_ELSEWHERE = 1.5  # nats of each patch: turned and moved masks have 3 to 5, one 0.3 % off in scale 0.7
_OVERLAP = 2.0  # patches that count as one measurement: they overlap by half


@dataclass(frozen=True, slots=True)
class MaskPlace:
    """Where a frame's own slices place the mask, from where its calibration has it: `periods` (ky, kx) at the frame's
    middle and `turn_rad`, 0 where the calibration's place explains the frame as well; and their standard errors.
    `nats` are the log odds of a mask there against none, by `patches`."""

    periods: tuple[float, float]
    periods_sigma: tuple[float, float]
    turn_rad: float
    turn_sigma_rad: float
    nats: float
    patches: int

    @property
    def moved(self) -> bool:
        """Whether it is anywhere else."""
        return bool(any(self.periods) or self.turn_rad)

    @property
    def at_edge(self) -> bool:
        """Whether the turn is as far as was searched: it may be farther."""
        return abs(self.turn_rad) > _AT_EDGE * _MOST_TURN

    @property
    def seen(self) -> bool:
        """Whether the patches agree on this place: else there is no mask, or nothing has parallax or texture."""
        return self.nats > SEEN_NATS

    def beyond(self, periods: tuple[float, float], *, alone: bool = False) -> MaskPlace:
        """The place by slices of a mask that had moved by so many periods before; `alone`: nothing but that."""
        rest, turn = ((0.0, 0.0), 0.0) if alone else (self.periods, self.turn_rad)
        y, x = (one + other - round(one + other) for one, other in zip(rest, periods, strict=True))
        return replace(self, periods=(float(y), float(x)), turn_rad=turn)

    def nowhere(self, nats: float) -> MaskPlace:
        """It without any move, and with these odds: a turn at the search's edge that led nowhere."""
        return replace(self, periods=(0.0, 0.0), turn_rad=0.0, nats=nats)

    def undone(
        self, slices: Complexes, orders: Sequence[Order], turned: Floats, steps_px: tuple[float, float]
    ) -> Complexes:
        """Slices as a mask without the turn would make them; `turned` and `steps_px` as in `mask_place`."""
        if not self.turn_rad:
            return slices
        cycles = self.turn_rad * np.array(orders, dtype=np.float64) @ turned  # (K, 2) for each sensor pixel
        down, across = (
            np.exp(-2j * np.pi * np.outer(along, (np.arange(side) - (side - 1) / 2) * px)).astype(np.complex64)
            for along, side, px in zip(cycles.T, slices.shape[1:], steps_px, strict=True)
        )
        return np.asarray(slices * down[:, :, None] * across[:, None, :])


def cycles_per_radian(lattice: Lattice, sensor: Sensor) -> Floats:
    """(2, 2) by how many cycles per sensor pixel (rows ky and kx) carriers move as the mask turns by a small angle."""
    to_sensor = np.array([sensor.row_mm, sensor.column_mm])
    quarter = np.array([[0.0, 1.0], [-1.0, 0.0]])
    return np.asarray(lattice.matrix() @ np.linalg.inv(to_sensor).T @ quarter @ to_sensor.T)


def mask_place(
    slices: Complexes,
    model: SliceModel,
    *,
    samples_px: tuple[float, float],
    noise: Floats,
    reach: float,
    turned: Floats,
    steps_px: tuple[float, float],
    workers: int = 1,
) -> MaskPlace | None:
    """The mask's place by slices complex64 (K, h, w), the half plane of `model`, DC first; None for too small ones.

    `samples_px`, `noise` and `reach` as for `joint_views`. `turned` (2, 2) is by how many cycles per sensor pixel (rows
    ky and kx) the carriers move for each radian of turn, `steps_px` by how many rows and columns of it a sample steps.
    """
    shape = (slices.shape[1], slices.shape[2])
    witness = MaskWitness.of(shape, model, samples_px=samples_px, reach=reach, workers=workers)
    if witness is None:
        return None
    seen, patches = _Textured.of(witness, slices, noise, _MOST_PATCHES), witness.patches
    frame, spectra = seen.frame, seen.spectra
    corners = np.array(patches.corners)[seen.patches] - SIDE
    middles = corners + SIDE / 2 - np.array(shape) / 2
    place: MaskPlace | None = None
    likely = -np.inf
    for some in (USUAL, AT_REST):  # at rest only where it matters: it costs half as much again
        if some not in frame.ranges:
            more = FrameModel.of(patches, model, samples_px, frame.noise, reach, ranges=(some,), workers=workers)
            frame = replace(frame, ranges={**frame.ranges, **more.ranges}, folds={**frame.folds, **more.folds})
        kinds = [kind for kind in KINDS if kind.range == some]
        rests = rests_of(frame, seen.spectrum, seen.own, seen.mean, kinds)
        wholes = list(wholes_of(frame, rests, range(len(kinds))))
        found = likelihoods(wholes, spectra, frame.weights, workers).sum(axis=1)
        if found.max() <= likely:
            break
        likely = float(found.max())
        differences, terms = _terms(model.orders, wholes[int(found.argmax())], frame.weights, spectra, workers)
        place = _Likelihood(differences, terms, (middles * np.array(steps_px)) @ turned.T).place()
        if place.seen:
            break
    return place


@dataclass(frozen=True, slots=True, eq=False)
class MaskWitness:
    """Tells at little cost whether slices taken through one lens show the mask where it was calibrated."""

    patches: Patches
    frame: FrameModel

    @classmethod
    def of(
        cls,
        shape: tuple[int, int],
        model: SliceModel,
        *,
        samples_px: tuple[float, float],
        reach: float,
        workers: int = 1,
    ) -> MaskWitness | None:
        """For slices (h, w) of this shape, as `mask_place`; None for too small ones."""
        patches = Patches(shape, SIDE)
        if np.count_nonzero(~patches.at_edges) < _FEWEST:
            return None
        silent = np.zeros(len(model.orders))
        return cls(patches, FrameModel.of(patches, model, samples_px, silent, reach, ranges=(USUAL,), workers=workers))

    def nats(self, slices: Complexes, noise: Floats, workers: int = 1) -> float:
        """The log odds of a mask in its place against none, by a frame with this `noise` (K,)."""
        seen = _Textured.of(self, slices, noise, _WITNESSES)
        frame, spectra = seen.frame, seen.spectra
        kinds = [kind for kind in KINDS if kind.range == USUAL]
        rests = rests_of(frame, seen.spectrum, seen.own, seen.mean, kinds)
        few, detail = slice(None, None, _TRIED), detail_of(frame.ranges[USUAL].seen, seen.own)
        wholes = [rests.whole(number, detail[few], few) for number in range(len(kinds))]
        found = likelihoods(wholes, spectra[few], frame.weights[few], workers).sum(axis=1)
        whole = rests.whole(int(found.argmax()), detail)
        differences, terms = _terms(frame.model.orders, whole, frame.weights, spectra, workers)
        return _Likelihood(differences, terms, np.zeros((len(terms), 2))).nats(np.zeros(3))


@dataclass(frozen=True, slots=True, eq=False)
class _Textured:
    """The `patches` (N,) of a frame with the most texture: its model, the power of their texture, `own` (F,) at their
    frequencies, the root of their mean square `mean`, and their `spectra` (F, A, N), so that none outvotes the others.
    """

    patches: NDArray[np.intp]
    frame: FrameModel
    spectrum: TexturePower
    own: Floats
    mean: float
    spectra: Complexes

    @classmethod
    def of(cls, witness: MaskWitness, slices: Complexes, noise: Floats, most: int) -> _Textured:
        """Of slices (K, h, w) with this `noise` (K,), so many patches at most."""
        patches = witness.patches
        inner = np.flatnonzero(~patches.at_edges)
        best = inner[np.sort(np.argsort(-patches.contrasts(slices[0].real, inner), kind="stable")[:most])]
        cut, means = patches.less_means(patches.cut(slices, best), witness.frame.model.common()[: len(slices)])
        spectra = patches.spectra(cut)
        frame = replace(witness.frame, noise=np.concatenate([noise, noise[1:]]))
        radius = frame.radius(frame.frequencies)
        power = np.abs(spectra[:, 0]) ** 2
        spectrum = TexturePower.of(np.maximum(power.mean(axis=1) - frame.noise[0], 0), radius)
        own = spectrum.at(radius)
        strength = (power[1:] / (own + frame.noise[0])[1:, None]).mean(axis=0)
        spectra /= np.asarray(np.sqrt(np.maximum(strength, _FAINT)), dtype=np.float32)
        return cls(best, frame, spectrum, own, float(np.sqrt(np.mean(means**2))), spectra)


def _terms(
    orders: NDArray[np.int64], whole: Complexes, weights: Singles, spectra: Complexes, workers: int
) -> tuple[NDArray[np.int64], NDArray[np.complex128]]:
    """The differences m (M, 2) of `orders` (A, 2) in a half plane, without 0, which tells nothing, and the terms c
    (N, M), twice as large for it, of each patch (F, A, N) whose covariance is the `whole` (F, A, A), by frequencies'
    `weights` (F,)."""
    inverse = (np.linalg.inv(whole.astype(np.complex128)) * (-2 * weights[:, None, None])).astype(np.complex64)
    apart = orders[:, None] - orders[None, :]
    ahead = (apart[..., 0] > 0) | ((apart[..., 0] == 0) & (apart[..., 1] > 0))
    differences, found = np.unique(apart[ahead], axis=0, return_inverse=True)
    place = np.zeros(ahead.shape, dtype=np.intp)
    place[ahead] = found.ravel()
    terms = np.zeros((spectra.shape[2], len(differences)), dtype=np.complex128)

    def add(some: slice) -> None:
        here = np.ascontiguousarray(spectra[:, :, some].transpose(1, 0, 2))
        conjugate = here.conj()
        for b, with_b in enumerate(ahead.T):
            column = inverse[:, with_b, b].T[:, None]
            products = (column @ (conjugate[with_b] * here[b]))[:, 0]
            terms[some, place[with_b, b]] += products.T  # for one b every a has a difference of its own

    each(add, spans(len(terms), _AT_A_TIME), workers)
    return differences, terms


def _tried() -> Floats:
    """(S², 2) the moves that are tried, evenly over a period."""
    axis = np.arange(_STEPS) / _STEPS - 0.5
    return np.stack(np.meshgrid(axis, axis, indexing="ij"), axis=-1).reshape(-1, 2)


@dataclass(frozen=True, slots=True, eq=False)
class _Likelihood:
    """Log likelihood of N patches over moves: `terms` (N, M) at `differences` (M, 2), and by how many periods `turned`
    (N, 2) a turn of one radian moves the mask at each patch."""

    differences: NDArray[np.int64]
    terms: NDArray[np.complex128]
    turned: Floats

    def place(self) -> MaskPlace:
        """The most probable place; what is not sure, or small, is 0."""
        still = self._best(turns=np.zeros(1))
        both = self._best(turns=np.linspace(-_MOST_TURN, _MOST_TURN, _TURNS))
        found = still
        if abs(both[2]) >= _LEAST_TURN and self._sure(both, still):
            found = both
            apart = np.array([0.0, 0.0, found[2]])
        else:
            apart = np.zeros(3)
        if np.hypot(*found[:2]) < _LEAST_PERIODS or not self._sure(found, apart):
            found = apart
        nats = self.nats(found)
        if (
            found.any() and nats <= _SEEN_ELSEWHERE * len(self.terms) / _OVERLAP
        ):  # patches that gain, each for a reason of its own
            found = np.zeros(3)
            nats = self.nats(found)
        sigma = self._sigma(found)
        return MaskPlace(
            (float(found[0]), float(found[1])),
            (float(sigma[0]), float(sigma[1])),
            float(found[2]),
            float(sigma[2]),
            nats,
            len(self.terms),
        )

    def nats(self, move: Floats) -> float:
        """The log odds of a mask there, against a place for each patch."""
        waves = np.zeros((len(self.terms), _STEPS, _STEPS), dtype=np.complex64)
        waves[:, *(self.differences.T % _STEPS)] = self.terms
        anywhere = (fft.ifft2(waves, norm="forward").real).reshape(len(waves), -1)
        most = anywhere.max(axis=1)
        mean = most + np.log(np.exp(anywhere - most[:, None]).mean(axis=1))
        here = self.patches(move)
        placed, astray = np.log1p(-_ASTRAY)[:, None], np.log(_ASTRAY)[:, None]
        shares = np.logaddexp(placed + here - mean, astray).sum(axis=1) / _OVERLAP
        return float(np.logaddexp.reduce(shares) - np.log(len(shares)))

    def patches(self, move: Floats) -> Floats:
        """(N,) log likelihoods at (ky, kx, radians)."""
        return np.asarray(self._waves(move).real.sum(axis=1))

    def _waves(self, move: Floats) -> NDArray[np.complex128]:
        at = move[:2] + move[2] * self.turned
        return np.asarray(self.terms * np.exp(2j * np.pi * at @ self.differences.T))

    def _best(self, turns: Floats) -> Floats:
        """The most probable move with one of these turns, or near it: (ky, kx, radians)."""
        tried = _tried()
        sums = np.stack([self._waves(np.array([0.0, 0.0, turn])).sum(axis=0) for turn in turns], axis=1)
        found = (np.exp(2j * np.pi * tried @ self.differences.T) @ sums).real
        shift, turn = np.unravel_index(int(found.argmax()), found.shape)
        move = np.array([*tried[shift], turns[turn]])
        free = slice(0, 3 if len(turns) > 1 else 2)
        for _ in range(_ROUNDS):
            gradient, curvature = self._slopes(move)
            step = np.linalg.lstsq(curvature[free, free], gradient.sum(axis=0)[free], rcond=None)[0]
            new = move.copy()
            new[free] += step
            if self.patches(new).sum() <= self.patches(move).sum():
                break
            move = new
        return move

    def _slopes(self, move: Floats) -> tuple[Floats, Floats]:
        """(N, 3) gradients of the patches, and (3, 3) the sum's curvature, its sign turned."""
        waves = self._waves(move)
        along = np.stack(
            [*np.broadcast_to(self.differences.T[:, None], (2, *waves.shape)), self.turned @ self.differences.T]
        )
        gradient = (2j * np.pi * waves * along).sum(axis=2).real.T
        curvature = np.einsum("anm,bnm,nm->ab", along, along, waves.real) * (2 * np.pi) ** 2
        return gradient, np.asarray(curvature)

    def _sure(self, one: Floats, other: Floats) -> bool:
        """Whether so many patches are more probable with one move than with another that it is no chance."""
        gains = self.patches(one) - self.patches(other)
        count = len(gains) / _OVERLAP
        chance = (2 * float(np.mean(gains > 0)) - 1) * np.sqrt(count)
        gain = float(np.median(gains))
        return bool((chance > _SURE and gain > _LEAST_NATS) or (chance > _LIKELY and gain > _MANY_NATS))

    def _sigma(self, move: Floats) -> Floats:
        """(3,) standard errors, from the scatter of the patches' own gradients: whatever a likelihood's scale."""
        gradient, curvature = self._slopes(move)
        back = np.linalg.pinv(curvature)
        return np.asarray(np.sqrt(np.maximum(np.diag(back @ (gradient.T @ gradient) @ back) * _OVERLAP, 0)))
