"""Find how far a mask lies from its calibrated place by the likelihood of a frame's slices.

A mask moved by δ periods turns slice k by 2πk·δ; one turned, or of another scale (a lens refocused, a focal length told
wrong, a film that took up water), makes that phase run across the frame. The model of the light field (`patch_model`)
gives the slices' covariance C(f) in a patch, so the log likelihood of its spectra y is, but for what no δ changes,

    −Σ_f w_f Σ_ab conj(y_a) C⁻¹_ab y_b exp(2πi (k_a − k_b)·δ) = Re Σ_m c_m exp(2πi m·δ):

a polynomial of few terms, m the differences of orders. Parallax tells δ even where the stop averages all carriers away
(an even square stop at the mask's ideal aperture): slices of a shifted mask are those of views that change places.
A patch's mean light is much brighter than its texture. In a slice of an unmoved mask it is μ_k, known by the stop, and
y turns with it: y − μ exp(2πi k·δ) is left, which adds terms 2w conj(μ_a) C⁻¹_ab y_b at m = −k_b.

Without a mask a slice is detail of the scene alone, whose phases are as random as the places of its edges: each patch
places the mask somewhere, with L(δ) over its mean over all δ as sharply as with a mask. So the odds of one place for
all patches but an unknown share, against a place for each, say whether there is a mask, whatever the likelihood's
scale: without a mask they are 1 on average. A scene without parallax, behind an even square stop at the ideal aperture,
holds no trace of a mask, and tells none from its absence.

Light whose parts have several disparities and which changes across the frame looks like a mask that moves by a little
more from patch to patch: what a patch's own gradients scatter by does not tell that error, because patches beside each
other share it. It shows where no mask can move so: as a stretch along one axis of the sensor with a squeeze along the
other, e₁, and as a shear, e₂. Such displacements follow the gradient of a smooth thing, u = ∇ψ; where ψ has no
direction, E ψ_xx² = E ψ_yy² = 3a and E ψ_xx ψ_yy = E ψ_xy² = a, so that the scale (ψ_xx + ψ_yy)/2 has the variance 2a,
e₁ = (ψ_xx − ψ_yy)/2 and e₂ = ψ_xy have a each, and a turn has none. So e₁² + e₂², less their own variances, is the
scale's; and a shift is taken to be off by as much as one of them moves the mask at a patch.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray
from scipy import fft

from dappled.decode.array_types import Complexes, Floats
from dappled.decode.calibration.testimony import LatticeChange
from dappled.decode.joint.contrast import even_spectra, shadow_contrast
from dappled.decode.joint.patch_model import (
    AT_REST,
    KINDS,
    SIDE,
    USUAL,
    FrameModel,
    PatchKind,
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
_TRIED = 3  # of so many frequencies one is looked at to choose the kind of all patches together
_STEPS = 48  # of a period: how finely moves are tried, up to half a period
_MOST, _CHANGES = 0.007, 81  # of a turn in radians and of the scale, to either side, and how many are tried
_ROUNDS = 8  # of Newton's method, from the best that was tried
# Turns in radians and changes of scale that a mask is looked for around: to 2.8 degrees and 2.1 %.
_FARTHER = (
    *((side * turn, 0.0) for turn in (0.014, 0.028, 0.042) for side in (-1, 1)),
    *((0.0, side * 0.014) for side in (-1, 1)),
)
_ABOUT_THERE = 10.0  # nats: frames without a mask have up to 0.1, at the most probable place around each of those
_FAR_PERIODS, _FAR = 0.03, 6e-4  # clean frames reach 0.017 periods, and 3e-4 in turn and scale
# Of the patches may lie in anything that places no mask, edges between depths or no parallax: any share is as probable.
_ASTRAY = (np.arange(32) + 0.5) / 32
_SEEN_ELSEWHERE = 1.5  # nats of each patch: turned and moved masks have 3 to 5, one 0.3 % off in scale 0.7
_OVERLAP = 2.0  # patches that count as one measurement: they overlap by half


@dataclass(frozen=True, slots=True)
class MaskPlace:
    """Where a frame's own slices place the mask, from where its calibration has it: `periods` (ky, kx) at the frame's
    middle, `turn_rad`, and `off`, the share by which carriers stand farther out, 0 where the calibration's place
    explains the frame as well; and their standard errors. `nats` are the log odds of a mask there against none, by
    `patches`. `contrast` is that of its shadow over the model's, by texture (see `shadow_contrast`); None where
    nothing tells."""

    periods: tuple[float, float]
    periods_sigma: tuple[float, float]
    turn_rad: float
    turn_sigma_rad: float
    off: float
    off_sigma: float
    nats: float
    patches: int
    contrast: float | None = None
    contrast_sigma: float | None = None

    @classmethod
    def at(cls, periods: tuple[float, float], turn_rad: float = 0.0, off: float = 0.0) -> MaskPlace:
        """A place that no patch has told."""
        return cls(periods, (math.inf, math.inf), turn_rad, math.inf, off, math.inf, -math.inf, 0)

    @property
    def moved(self) -> bool:
        """Whether it is anywhere else."""
        return bool(any(self.periods) or self.turn_rad or self.off)

    @property
    def change(self) -> LatticeChange:
        """Its turn and scale, as carriers would show them: their turn counts the other way."""
        return LatticeChange(self.off, self.off_sigma, -self.turn_rad, self.turn_sigma_rad)

    def far(self) -> MaskPlace:
        """It with what is so far from the calibrated place that frames of a mask in it don't show it."""
        return replace(
            self,
            periods=self.periods if math.hypot(*self.periods) >= _FAR_PERIODS else (0.0, 0.0),
            turn_rad=self.turn_rad if abs(self.turn_rad) >= _FAR else 0.0,
            off=self.off if abs(self.off) >= _FAR else 0.0,
        )

    @property
    def seen(self) -> bool:
        """Whether the patches agree on this place: else there is no mask, or nothing has parallax or texture."""
        return self.nats > SEEN_NATS

    def beyond(self, periods: tuple[float, float], turn_rad: float = 0.0, off: float = 0.0) -> MaskPlace:
        """The place by slices that were turned back to one so far off before."""
        y, x = (one + other - round(one + other) for one, other in zip(self.periods, periods, strict=True))
        return replace(self, periods=(float(y), float(x)), turn_rad=self.turn_rad + turn_rad, off=self.off + off)

    def nowhere(self) -> MaskPlace:
        """It without any move: a search that led nowhere."""
        return replace(self, periods=(0.0, 0.0), turn_rad=0.0, off=0.0)

    def undone(
        self, slices: Complexes, orders: Sequence[Order], changes: Floats, steps_px: tuple[float, float]
    ) -> Complexes:
        """Slices as a mask without turn and scale would make them; `changes` and `steps_px` as in `PlaceSearch`."""
        if not (self.turn_rad or self.off):
            return slices
        turned = math.sin(self.turn_rad) * changes[0] + math.cos(self.turn_rad) * changes[1]
        away = (1 + self.off) * turned - changes[1]
        cycles = np.array(orders, dtype=np.float64) @ away  # (K, 2) for each sensor pixel
        down, across = (
            np.exp(-2j * np.pi * np.outer(along, (np.arange(side) - (side - 1) / 2) * px)).astype(np.complex64)
            for along, side, px in zip(cycles.T, slices.shape[1:], steps_px, strict=True)
        )
        return np.asarray(slices * down[:, :, None] * across[:, None, :])


def carrier_changes(lattice: Lattice, sensor: Sensor) -> Floats:
    """(4, 2, 2) by how many cycles per sensor pixel (rows ky and kx) carriers move for each radian of a small turn of
    the mask, for each unit of its scale, and of what no mask does: a stretch along the sensor's rows with a squeeze
    along its columns, and a shear."""
    to_sensor = np.array([sensor.row_mm, sensor.column_mm])
    ways = np.array([[[0, 1], [-1, 0]], [[1, 0], [0, 1]], [[1, 0], [0, -1]], [[0, 1], [1, 0]]])
    return np.asarray(lattice.matrix() @ np.linalg.inv(to_sensor).T @ ways @ to_sensor.T)


@dataclass(frozen=True, slots=True, eq=False)
class PlaceSearch:
    """Looks for a mask by `slices` complex64 (K, h, w), the half plane of `model`, DC first.

    `samples_px`, `noise` and `reach` as for `joint_views`. `changes` (4, 2, 2) are `carrier_changes`, `steps_px` is by
    how many rows and columns of the sensor a sample steps.
    """

    slices: Complexes
    model: SliceModel
    samples_px: tuple[float, float]
    noise: Floats
    reach: float
    changes: Floats
    steps_px: tuple[float, float]
    workers: int = 1

    def near(self, *, moved: bool = False) -> MaskPlace | None:
        """The mask's place, near the calibrated one; None for too small slices. Those of a mask that has `moved` were
        turned back to where it was found: it lies beside that by what is most probable, however little."""
        witness = self._witness()
        if witness is None:
            return None
        seen, patches, workers = (
            _Textured.of(witness, self.slices, self.noise, _MOST_PATCHES),
            witness.patches,
            self.workers,
        )
        frame, spectra, reach, few = seen.frame, seen.spectra, self.reach, slice(None, None, _TRIED)
        away = self._away(seen)
        place: MaskPlace | None = None
        likely = -np.inf
        for some in (USUAL, AT_REST):  # at rest only where it matters: it costs half as much again
            if some not in frame.ranges:
                more = FrameModel.of(
                    patches, self.model, self.samples_px, frame.noise, reach, ranges=(some,), workers=workers
                )
                frame = replace(frame, ranges={**frame.ranges, **more.ranges}, folds={**frame.folds, **more.folds})
            kinds = [kind for kind in KINDS if kind.range == some]
            rests = rests_of(frame, seen.spectrum, seen.own, seen.mean, kinds)
            tried = wholes_of(frame, rests, range(len(kinds)), few)
            found = likelihoods(tried, spectra[few], frame.weights[few], workers).sum(axis=1)
            if found.max() <= likely:
                break
            likely = float(found.max())
            (whole,) = wholes_of(frame, rests, [int(found.argmax())])
            differences, terms = _terms(seen, whole, workers)
            place = _Likelihood(differences, terms, away).place(moved=moved)
            if some == USUAL and not place.far().moved:
                kind = kinds[int(found.argmax())]
                place = _with_contrast(place, self.slices, seen, kind, away=away, patches=patches, reach=reach)
            if place.seen:
                break
        return place

    def farther(self) -> MaskPlace | None:
        """About where the mask is, by fewer patches, around turns and changes of scale as far as hands and lenses go;
        None where patches agree on no place."""
        witness = self._witness()
        best, most = None, _ABOUT_THERE
        for turn_rad, off in _FARTHER if witness else ():
            assert witness is not None
            start = MaskPlace.at((0.0, 0.0), turn_rad, off)
            turned_back = start.undone(self.slices, self.model.half, self.changes, self.steps_px)
            seen = _Textured.of(witness, turned_back, self.noise, _WITNESSES)
            differences, terms = _terms(seen, witness.likeliest(seen, self.workers), self.workers)
            likely = _Likelihood(differences, terms, self._away(seen))
            move = likely.anywhere()
            if (nats := likely.nats(move)) > most:
                best, most = likely.at(move, nats).beyond(start.periods, turn_rad, off), nats
        return best

    def _witness(self) -> MaskWitness | None:
        shape = (self.slices.shape[1], self.slices.shape[2])
        return MaskWitness.of(shape, self.model, samples_px=self.samples_px, reach=self.reach, workers=self.workers)

    def _away(self, seen: _Textured) -> Floats:
        """(4, N, 2) by how many periods a turn of one radian, a scale twice as large, and such a stretch and shear move
        the mask at patches."""
        middles = seen.corners + SIDE / 2 - np.array(self.slices.shape[1:]) / 2
        return np.asarray((middles * np.array(self.steps_px)) @ self.changes.swapaxes(1, 2))


def _with_contrast(
    place: MaskPlace,
    slices: Complexes,
    seen: _Textured,
    kind: PatchKind,
    *,
    away: Floats,
    patches: Patches,
    reach: float,
) -> MaskPlace:
    """The place with its shadow's contrast, by patches (N,) of this kind; `away` as in `_Likelihood`."""
    some = slice(None, None, -(-len(seen.patches) // _WITNESSES))
    at = place.periods + np.tensordot([place.turn_rad, place.off], away[:2, some], axes=1)
    back = np.exp(-2j * np.pi * seen.frame.model.orders @ at.T).astype(np.complex64)
    spectra = even_spectra(slices, patches, seen.patches[some]) * back
    told = shadow_contrast(seen.frame, seen.spectrum, kind, spectra, mean=seen.mean, reach=reach)
    return place if told is None else replace(place, contrast=told[0], contrast_sigma=told[1] * math.sqrt(_OVERLAP))


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
        """For slices (h, w) of this shape, as `PlaceSearch`; None for too small ones."""
        patches = Patches(shape, SIDE)
        if np.count_nonzero(~patches.at_edges) < _FEWEST:
            return None
        silent = np.zeros(len(model.orders))
        return cls(patches, FrameModel.of(patches, model, samples_px, silent, reach, ranges=(USUAL,), workers=workers))

    def likeliest(self, seen: _Textured, workers: int) -> Complexes:
        """(F, A, A) the covariance of the kind that explains patches best, by a few frequencies."""
        frame, spectra = seen.frame, seen.spectra
        kinds = [kind for kind in KINDS if kind.range == USUAL]
        rests = rests_of(frame, seen.spectrum, seen.own, seen.mean, kinds)
        few, detail = slice(None, None, _TRIED), detail_of(frame.ranges[USUAL].seen, seen.own)
        wholes = [rests.whole(number, detail[few], few) for number in range(len(kinds))]
        found = likelihoods(wholes, spectra[few], frame.weights[few], workers).sum(axis=1)
        return rests.whole(int(found.argmax()), detail)

    def nats(self, slices: Complexes, noise: Floats, workers: int = 1) -> float:
        """The log odds of a mask in its place against none, by a frame with this `noise` (K,)."""
        seen = _Textured.of(self, slices, noise, _WITNESSES)
        whole = self.likeliest(seen, workers)
        # By parallax alone: by its means a mask that has moved by little would be no mask.
        differences, terms = _terms(replace(seen, lit=np.zeros_like(seen.lit)), whole, workers)
        return _Likelihood(differences, terms, np.zeros((4, len(terms), 2))).nats(np.zeros(4))


@dataclass(frozen=True, slots=True, eq=False)
class _Textured:
    """The `patches` (N,) of a frame with the most texture, which begin at `corners` (N, 2): its model, the power of
    their texture, `own` (F,) at their frequencies, the root of their mean square `mean`, and their `spectra` (F, A, N),
    so that none outvotes the others, less those of their means: `lit` (N,) of them in the slice (0, 0) times `flat`
    (F,) and what is common to all.
    """

    patches: NDArray[np.intp]
    corners: NDArray[np.intp]
    frame: FrameModel
    spectrum: TexturePower
    own: Floats
    mean: float
    spectra: Complexes
    lit: Floats
    flat: Complexes

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
        root = np.sqrt(np.maximum(strength, _FAINT))
        spectra /= np.asarray(root, dtype=np.float32)
        flat = patches.spectra(np.ones((1, 1, SIDE, SIDE), dtype=np.complex64))[:, 0, 0]
        corners = np.array(patches.corners)[best] - SIDE
        return cls(best, corners, frame, spectrum, own, float(np.sqrt(np.mean(means**2))), spectra, means / root, flat)


def _terms(seen: _Textured, whole: Complexes, workers: int) -> tuple[NDArray[np.int64], NDArray[np.complex128]]:
    """The differences m (M, 2) of orders in a half plane, without 0, which tells nothing, and the terms c (N, M), twice
    as large for it, of each patch whose covariance is the `whole` (F, A, A)."""
    orders, common = seen.frame.model.orders, seen.frame.model.common().astype(np.complex64)
    inverse = (np.linalg.inv(whole.astype(np.complex128)) * (-2 * seen.frame.weights[:, None, None])).astype(
        np.complex64
    )
    apart = orders[:, None] - orders[None, :]
    ahead = (apart[..., 0] > 0) | ((apart[..., 0] == 0) & (apart[..., 1] > 0))
    differences, found = np.unique(apart[ahead], axis=0, return_inverse=True)
    place = np.zeros(ahead.shape, dtype=np.intp)
    place[ahead] = found.ravel()
    terms = np.zeros((seen.spectra.shape[2], len(differences)), dtype=np.complex128)
    common[0] = 0  # the mean of the slice (0, 0) stays where it is, and was taken out
    of_means = seen.flat.conj()[:, None] * np.einsum("a,fab->fb", common.conj(), inverse)
    first = ahead[:, 0]  # the half plane's orders, whose conjugates hold the same

    def add(some: slice) -> None:
        means = seen.flat[:, None, None] * common[:, None] * seen.lit[some].astype(np.float32)
        here = np.ascontiguousarray((seen.spectra[:, :, some] + means).transpose(1, 0, 2))
        conjugate = here.conj()
        for b, with_b in enumerate(ahead.T):
            column = inverse[:, with_b, b].T[:, None]
            products = (column @ (conjugate[with_b] * here[b]))[:, 0]
            terms[some, place[with_b, b]] += products.T  # for one b every a has a difference of its own
        alone = seen.lit[some, None] * np.einsum("fb,bfn->nb", of_means, here)
        terms[some, place[first, 0]] -= alone[:, first].conj()
        terms[some, place[0, ahead[0]]] -= alone[:, ahead[0]]

    each(add, spans(len(terms), _AT_A_TIME), workers)
    return differences, terms


def _tried() -> Floats:
    """(S², 2) the moves that are tried, evenly over a period."""
    axis = np.arange(_STEPS) / _STEPS - 0.5
    return np.stack(np.meshgrid(axis, axis, indexing="ij"), axis=-1).reshape(-1, 2)


@dataclass(frozen=True, slots=True, eq=False)
class _Likelihood:
    """Log likelihood of N patches over moves (ky, kx, radians, scale): `terms` (N, M) at `differences` (M, 2), and by
    how many periods a turn of one radian, a scale twice as large, and what no mask does move it at each patch,
    `changed` (4, N, 2).
    """

    differences: NDArray[np.int64]
    terms: NDArray[np.complex128]
    changed: Floats

    def place(self, *, moved: bool) -> MaskPlace:
        """The most probable place: the calibrated one where no other is surer, unless the mask has `moved`."""
        found, nats = np.zeros(4), self.nats(np.zeros(4))
        still = self._best(np.zeros((1, 1, 4)))
        for one in (still, self.anywhere()):
            if (more := self.nats(one)) > nats + SEEN_NATS:
                found, nats = one, more
        if found.any() and nats <= _SEEN_ELSEWHERE * len(self.terms) / _OVERLAP:
            found = np.zeros(4)  # patches that gain, each for a reason of its own
            nats = self.nats(found)
        if found.any() and not moved and self._explained(found):
            found = np.zeros(4)  # patches that gain for a reason that they share
            nats = self.nats(found)
        if nats > SEEN_NATS and (moved or found.any()):  # else off by what is not sure enough to be another place
            found = self._risen(found, np.arange(4))
        return self.at(found, nats)

    def at(self, move: Floats, nats: float) -> MaskPlace:
        """A move (4,) as a place."""
        periods, sigma = move.tolist(), self._sigma(move).tolist()
        return MaskPlace(
            (periods[0], periods[1]),
            (sigma[0], sigma[1]),
            periods[2],
            sigma[2],
            periods[3],
            sigma[3],
            nats,
            len(self.terms),
        )

    def nats(self, move: Floats) -> float:
        """The log odds of a mask there, against a place for each patch."""
        waves = np.zeros((len(self.terms), _STEPS, _STEPS), dtype=np.complex64)
        waves[:, *(self.differences.T % _STEPS)] = self.terms
        everywhere = (fft.ifft2(waves, norm="forward").real).reshape(len(waves), -1)
        most = everywhere.max(axis=1)
        mean = most + np.log(np.exp(everywhere - most[:, None]).mean(axis=1))
        here = self.patches(move)
        placed, astray = np.log1p(-_ASTRAY)[:, None], np.log(_ASTRAY)[:, None]
        shares = np.logaddexp(placed + here - mean, astray).sum(axis=1) / _OVERLAP
        return float(np.logaddexp.reduce(shares) - np.log(len(shares)))

    def patches(self, move: Floats) -> Floats:
        """(N,) log likelihoods at a move (4,)."""
        return np.asarray(self._waves(move).real.sum(axis=1))

    def _waves(self, move: Floats) -> NDArray[np.complex128]:
        return np.asarray(self.terms * self._turned(move))

    def _turned(self, move: Floats) -> NDArray[np.complex128]:
        at = move[:2] + np.tensordot(move[2:], self.changed[:2], axes=1)
        return np.asarray(np.exp(2j * np.pi * at @ self.differences.T))

    def anywhere(self) -> Floats:
        """The most probable move with a turn and another scale."""
        along = np.linspace(-_MOST, _MOST, _CHANGES)[:, None]
        turns, scales = along * np.eye(4)[2], along * np.eye(4)[3]
        first = self._best(np.stack([turns, scales]))
        scaled = abs(first[3]) > abs(first[2])
        return self._best((turns + first * (0, 0, 0, 1) if scaled else scales + first * (0, 0, 1, 0))[None])

    def _best(self, lines: Floats) -> Floats:
        """The most probable move (4,) with one of the turns and scales of lines (L, T, 4), evenly spaced along each, or
        near it; where one of these is 0 in all, it stays so."""
        tried, sums = _tried(), []
        for line in lines * (0, 0, 1, 1):
            waves, further = self._waves(line[0]), self._turned(np.diff(line[:2], axis=0).sum(axis=0))
            for _ in line:  # a product takes a thirtieth of an exponential's time
                sums.append(waves.sum(axis=0))
                waves *= further
        found = (np.exp(2j * np.pi * tried @ self.differences.T) @ np.stack(sums, axis=1)).real
        changes = lines.reshape(-1, 4)
        shift, change = np.unravel_index(int(found.argmax()), found.shape)
        move = np.array([*tried[shift], *changes[change, 2:]])
        return self._risen(move, np.flatnonzero(np.append([True, True], changes[:, 2:].any(axis=0))))

    def _risen(self, move: Floats, free: NDArray[np.intp]) -> Floats:
        """The most probable move (4,) near one, by what of it is `free`."""
        for _ in range(_ROUNDS):
            gradient, curvature = self._slopes(move)
            step = np.linalg.lstsq(curvature[np.ix_(free, free)], gradient.sum(axis=0)[free], rcond=None)[0]
            new = move.copy()
            new[free] += step
            if self.patches(new).sum() <= self.patches(move).sum():
                break
            move = new
        return move

    def _slopes(self, move: Floats) -> tuple[Floats, Floats]:
        """(N, 6) gradients of the patches, by the move and what no mask does, and (6, 6) the sum's curvature, its sign
        turned."""
        waves = self._waves(move)
        along = np.stack(
            [*np.broadcast_to(self.differences.T[:, None], (2, *waves.shape)), *(self.changed @ self.differences.T)]
        )
        gradient = (2j * np.pi * waves * along).sum(axis=2).real.T
        curvature = np.einsum("anm,bnm,nm->ab", along, along, waves.real) * (2 * np.pi) ** 2
        return gradient, np.asarray(curvature)

    def _covariance(self, move: Floats) -> Floats:
        """(4, 4) of a move's errors: by the scatter of the patches' own gradients, whatever a likelihood's scale, and
        by what all patches show that no mask does."""
        gradient, curvature = self._slopes(move)
        back, own = np.linalg.pinv(curvature), np.linalg.pinv(curvature[:4, :4])
        scattered = _OVERLAP * gradient.T @ gradient
        strains = (back @ gradient.sum(axis=0))[4:]
        smooth = max(0.0, float(strains @ strains - np.trace((back @ scattered @ back)[4:, 4:])))
        shifts = smooth / 2 * float((self.changed[1] ** 2).mean())
        return np.asarray(own @ scattered[:4, :4] @ own + np.diag([shifts, shifts, 0.0, smooth]))

    def _sigma(self, move: Floats) -> Floats:
        """(4,) standard errors."""
        return np.asarray(np.sqrt(np.maximum(np.diag(self._covariance(move)), 0)))

    def _explained(self, move: Floats) -> bool:
        """Whether its errors explain a move as well as a mask elsewhere does."""
        return float(move @ np.linalg.pinv(self._covariance(move)) @ move) / 2 <= SEEN_NATS
