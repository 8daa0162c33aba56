"""What a frame tells of the mask's shadow, by least squares.

With L the frame's local mean over a period, frame − L is regressed on L · e^{2πi k·F x}. Blocks weigh by what they
leave unexplained, clipped and defective pixels by nothing, each colour has coefficients of its own. These vary over the
frame as polynomials, and orders that only diffraction makes are among them, where that explains blocks held out.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property, lru_cache

import numpy as np
from numpy.typing import NDArray
from scipy import ndimage

from dappled.decode.array_types import Floats, Singles
from dappled.decode.optics import Lattice, Order
from dappled.decode.picture.blocks import MosaicPlane, PatternPlace, block_sums, kept_by_mean, local_mean, wave_sums
from dappled.decode.picture.lattice_search import searched
from dappled.decode.picture.shadow import (
    UNLIKE,
    Coefficients,
    Fit,
    OwnShadow,
    Shadow,
    ShadowEvidence,
    ShadowFrom,
    lattice_bins,
    lattice_of_bins,
    period_of,
    terms_at,
)

_Blocks = NDArray[np.bool_] | slice
_EVERY = slice(None)
# Chosen by hand where no figure stands beside a number; tests/decode/picture measures what all of them together make.

_BLOCK_PX, _BLOCK_PERIODS = 64, 4  # a block's side is at least both
_RIDGE = 1e-6  # of the mean of the diagonal: orders that fall together on a coarse pattern share what they explain
_DEGREES = (0, 2)  # of the polynomials that are tried
_FOR_A_TERM = 2  # blocks for each of a polynomial's terms, of either half that the other is held out for
_SEARCH_SIDE = 2048  # pixels of the frame's middle that the lattice is searched in
_FOUND_BINS = 0.5  # standard error of the lattice after the search
_DEEP = 0.2  # standard deviation of W from which on local means are taken again with the shadow known
_KEPT = 0.02  # of a carrier in local means: from which on it counts that it is missing beside them
_STEPS = 3  # of Gauss and Newton, at most
_ENOUGH = 0.1  # of the frame
_SHEARED = 5e-4  # of a print on its way: longer along one axis, or at no right angle
_STILL_BINS = 3e-3  # of a frame: a lattice so near is kept
_LEAST = 1e-3  # of the frame's mean: darker local means tell nothing of the shadow
_UNPULLED = 0.2  # where a few blocks make the whole fit, their scatter tells next to nothing


@dataclass(frozen=True, slots=True)
class ExpectedShadow:
    """Where carriers are expected, and which: the pattern's orders of the half plane, without the mean, and those that
    only diffraction can have `made` beside them. The search for the lattice allows for a turn (radians) and for a
    print's scale (a share of the period) to either side."""

    lattice: Lattice
    orders: Sequence[Order]
    made: Sequence[Order]
    turned: float = 0.0
    scaled: float = 0.0


def shadow_of(
    mosaic: MosaicPlane,
    expected: ExpectedShadow,
    others: Sequence[Shadow] = (),
    beside: Sequence[ShadowEvidence] = (),
) -> Shadow:
    """The shadow that explains a frame best: its own, one of `others` (a white frame's, a calibration's), or none.
    What frames `beside` it tell, of the same mask, lens, stop and orders, is averaged with its own, those left out
    whose shadow is another. What a shadow explains is counted on blocks that it was not fitted to.
    """
    if beside:
        if (own := _as_beside(mosaic, beside, others)) is not None:
            return own.shadow(others, beside)
        bins = np.median([lattice_bins(mosaic.shape, one.lattice) for one in beside], axis=0)
        expected = replace(expected, lattice=lattice_of_bins(mosaic.shape, bins))
    return told_by(mosaic, expected, others).shadow(others, beside)


def told_by(mosaic: MosaicPlane, expected: ExpectedShadow, others: Sequence[Shadow] = ()) -> OwnShadow:
    """What one frame tells of its shadow, and of `others`, see `shadow_of`."""
    drawn = tuple(order for order in expected.orders if order != (0, 0))
    every = (*drawn, *(order for order in expected.made if order not in drawn))
    told = _told(*_equations_of(mosaic, expected, _Sought(every, len(drawn), len(drawn))), others)
    if told.seen or every == drawn:
        return told
    # A stop may leave less of the pattern's orders than diffraction makes of others.
    by_all = _told(*_equations_of(mosaic, expected, _Sought(every, len(drawn), len(every))), others)
    return by_all if by_all.seen else told


def _as_beside(mosaic: MosaicPlane, beside: Sequence[ShadowEvidence], others: Sequence[Shadow]) -> OwnShadow | None:
    """What a frame tells where frames beside it have told its lattice and its shadow about; None where its shadow is
    another, and is to be searched for."""
    every = beside[0].with_those([one for one in beside[1:] if one.unlike(beside[0]) < UNLIKE])
    if (known := every.shadow(ShadowFrom.FLIGHT)) is None:
        return None
    mosaic = _unclipped(mosaic, period_of(known.lattice))
    means = _Means.of(mosaic, period_of(known.lattice), known)
    sought = _Sought(every.orders, len(every.drawn), len(known.orders))
    equations = _Equations.of(means, known.lattice, sought)
    if (finer := equations.lattice()) is not None:
        equations = equations.at_finer(finer, means)
    made = _told(equations, means, others)
    return made if made.seen and made.evidence.unlike(every) < UNLIKE else None


def _told(equations: _Equations, means: _Means, others: Sequence[Shadow]) -> OwnShadow:
    at: dict[tuple[Lattice, tuple[Order, ...]], _Equations] = {}
    own = {each.sought.orders: each for each in equations.nested}
    gains = []
    for one in others:
        if (where := (one.lattice, one.orders)) not in at:
            near = one.orders in own and equations.at_rest(one.lattice)
            alone = _Sought(one.orders, len(one.orders), len(one.orders))
            at[where] = own[one.orders].moved(one.lattice) if near else _Equations.of(means, one.lattice, alone)
        gains.append(at[where].explained(one, equations.weights) - equations.unexplained)
    return OwnShadow(equations.evidence(), tuple(gains))


def _equations_of(mosaic: MosaicPlane, expected: ExpectedShadow, sought: _Sought) -> tuple[_Equations, _Means]:
    """The equations of a frame's own shadow, at its own lattice; and the local means that they are of."""
    lattice, leading = expected.lattice, sought.leading
    mosaic = _unclipped(mosaic, period_of(lattice))
    means = _Means.of(mosaic, period_of(lattice))
    found = lattice
    if expected.turned or expected.scaled:
        found = searched(means.quotient(), lattice, leading.orders, turned=expected.turned, scaled=expected.scaled)
    equations = _Equations.of(means, found, leading)
    for _ in range(_STEPS):
        if (finer := equations.lattice()) is None:
            break
        # Where pixels are left out, a block's middle is not where its samples are.
        equations = equations.moved(finer) if mosaic.valid is None else equations.at_finer(finer, means)
    first = equations.evidence((0,)).shadow(ShadowFrom.FRAME, degree=0)
    assert first is not None
    frequencies = np.asarray(first.orders, dtype=np.float64) @ equations.at.matrix()
    kept = kept_by_mean(frequencies, means.period, mosaic.pattern.shape)
    lost = bool(np.any(np.abs(kept) > _KEPT))
    if lost:
        first = replace(
            first, coefficients=first.coefficients / np.where(np.abs(1 - kept) > 0.1, 1 - kept, 0.1)[:, None]
        )
    if known := first.depth > _DEEP or mosaic.valid is not None or lost:
        means = _Means.of(mosaic, means.period, first)  # where the light was is known better behind a known shadow
    if known or equations.at != found or leading != sought:
        equations = _Equations.of(means, equations.at, sought, found)
    if mosaic.valid is None and equations.at != found and (finer := equations.lattice()) is not None:
        equations = equations.at_finer(finer, means)
    return equations, means


def _unclipped(mosaic: MosaicPlane, period: float) -> MosaicPlane:
    """Without what lies within a period of a clipped pixel, where enough is left: of pixels as bright as a bright part
    of the mask makes them, only those of dark places of the scene are not clipped."""
    if mosaic.valid is None:
        return mosaic
    here = mosaic.there
    sound = ndimage.minimum_filter(mosaic.valid | ~here, 2 * math.ceil(period / 2) + 1) & here
    return replace(mosaic, valid=sound) if float(sound.sum()) > _ENOUGH * float(here.sum()) else mosaic


@dataclass(frozen=True, slots=True, eq=False)
class _Means:
    """A mosaic with the local means of each place's samples."""

    mosaic: MosaicPlane
    period: float
    means: tuple[tuple[PatternPlace, Singles, Singles | None], ...]

    @classmethod
    def of(cls, mosaic: MosaicPlane, period: float, shadow: Shadow | None = None) -> _Means:
        made = []
        for place in mosaic.places():
            values = np.ascontiguousarray(mosaic.plane[place.cut])
            good = None if mosaic.valid is None else mosaic.valid[place.cut].astype(np.float32)
            weights = good
            if shadow is not None:  # least squares: Σ frame·W / Σ W²
                values, weights = values * (known := shadow.at(place)), known * known
                if good is not None:
                    weights *= good
            mean = local_mean(values if good is None else values * good, period, place.step, weights)
            made.append((place, mean, good))
        return cls(mosaic, period, tuple(made))

    def floor(self) -> float:
        return _LEAST * max(float(np.mean([mean[::7, ::7].mean() for _, mean, _ in self.means])), 1e-9)

    def quotient(self) -> Singles:
        """(frame − local mean) / local mean in the frame's middle."""
        shape, floor = self.mosaic.shape, self.floor()
        made = np.zeros(shape, dtype=np.float32)
        for place, mean, good in self.means:
            part = self.mosaic.plane[place.cut] / np.maximum(mean, floor) - 1
            made[place.cut] = np.clip(part if good is None else part * good, -2, 4)
        start = [max(0, (side - _SEARCH_SIDE) // 2) for side in shape]
        return made[start[0] : start[0] + _SEARCH_SIDE, start[1] : start[1] + _SEARCH_SIDE]


@dataclass(frozen=True, slots=True)
class _Sought:
    """Orders that a frame is asked for. The first `drawn` are the pattern's, by which blocks weigh; the first `led`,
    these or all, tell the lattice."""

    orders: tuple[Order, ...]
    drawn: int
    led: int

    @property
    def pattern(self) -> _Sought:
        """The pattern's alone."""
        return _Sought(self.orders[: self.drawn], self.drawn, self.drawn)

    @property
    def leading(self) -> _Sought:
        """Those alone that tell the lattice."""
        return _Sought(self.orders[: self.led], self.drawn, self.led)


@dataclass(frozen=True, slots=True, eq=False)
class _Pairs:
    """The mean and the orders: `half` (h, 2); and the differences of each of them and each of the mean, the orders and
    their opposites (n), but for the sign: `apart` (m, 2), which of these each is by `index` (h, n), and where it is
    `turned`."""

    half: NDArray[np.intp]
    apart: NDArray[np.intp]
    index: NDArray[np.intp]
    turned: NDArray[np.bool_]


@lru_cache(maxsize=8)
def _pairs(orders: tuple[Order, ...]) -> _Pairs:
    every = np.array([(0, 0), *orders, *((-ky, -kx) for ky, kx in orders)], dtype=np.intp)
    half = every[: len(orders) + 1]
    apart = half[:, None] - every[None, :]
    turned = (apart[..., 0] < 0) | ((apart[..., 0] == 0) & (apart[..., 1] < 0))
    unique, index = np.unique(np.where(turned[..., None], -apart, apart).reshape(-1, 2), axis=0, return_inverse=True)
    return _Pairs(half, unique, index.reshape(turned.shape), turned)


def _real(values: NDArray[np.complexfloating]) -> Floats:
    """(…, n) of the mean and orders (…, half): the mean's real part, real and imaginary parts of the others, times √2,
    with which products are those of all orders and their opposites."""
    parts = values[..., :1].real, math.sqrt(2) * values[..., 1:].real, math.sqrt(2) * values[..., 1:].imag
    return np.concatenate(parts, axis=-1).astype(np.float64)


def _complex(values: Floats) -> Coefficients:
    """Coefficients (half, terms) of what `_real` makes of them (n, terms)."""
    half = len(values) // 2 + 1
    return np.concatenate([values[:1] + 0j, (values[1:half] + 1j * values[half:]) / math.sqrt(2)])


def _products(one: NDArray[np.complexfloating], other: NDArray[np.complexfloating]) -> Floats:
    """(blocks,) of two (blocks, half), over all orders and their opposites."""
    each = (one.conj() * other).real
    return np.asarray(2 * each.sum(axis=1) - each[:, 0])


@dataclass(frozen=True, slots=True, eq=False)
class _Normal:
    """Normal equations of least squares: `matrix` (n, n), `right` (n,)."""

    matrix: Floats
    right: Floats

    def ridged(self) -> Floats:
        """The matrix with a little on its diagonal."""
        count = len(self.matrix)
        return np.asarray(self.matrix + np.eye(count) * max(_RIDGE * float(np.trace(self.matrix)) / count, 1e-30))

    def solution(self) -> Floats:
        """(n,)."""
        return np.asarray(np.linalg.solve(self.ridged(), self.right), dtype=np.float64)

    def gain(self, values: Floats) -> float:
        """The sum of squares that these values (n,) explain."""
        return float(values @ (2 * self.right - self.matrix @ values))


@dataclass(frozen=True, eq=False)
class _Equations:
    """Normal equations of the coefficients, block by block: `sums` (colours, blocks, differences) of L² over waves of
    the differences of orders, which make the matrix, and `right` (colours, blocks, half) of the mean and the `sought`
    orders, as all coefficients `c` are: those of their opposites are the conjugates. `energy` and `count` are of each
    block's frame − L."""

    shape: tuple[int, int]
    at: Lattice
    like: Lattice  # but for a turn and a scale, about as it is
    sought: _Sought
    centres: Floats
    sums: NDArray[np.complex64]
    right: NDArray[np.complex64]
    energy: Floats
    count: Floats
    odd: NDArray[np.bool_]
    sound: float  # share of the samples that aren't left out

    @classmethod
    def of(
        cls,
        means: _Means,
        lattice: Lattice,
        sought: _Sought,
        like: Lattice | None = None,
        sums: NDArray[np.complex64] | None = None,
    ) -> _Equations:
        """Those of a frame; `sums` that are known already aren't taken again."""
        mosaic, floor = means.mosaic, means.floor()
        pairs = _pairs(sought.orders)
        side = max(_BLOCK_PX, math.ceil(_BLOCK_PERIODS * means.period))
        steps = mosaic.pattern.shape
        across = [math.ceil(side / step) * step for step in steps]
        blocks = [max(1, whole // one) for whole, one in zip(mosaic.shape, across, strict=True)]
        shape = (mosaic.colours, blocks[0] * blocks[1])
        every = np.zeros((*shape, len(pairs.apart)), dtype=np.complex64) if sums is None else sums
        right = np.zeros((*shape, len(pairs.half)), dtype=np.complex64)
        energy, count = np.zeros(shape), np.zeros(shape)
        matrix = lattice.matrix()
        for place, mean, good in means.means:
            rows, columns = place.at(mosaic.shape)
            high = mosaic.plane[place.cut] - mean
            known = mean > floor
            keep = known.astype(np.float32) if good is None else good * known
            high *= keep
            weight = mean * keep
            edges = tuple(
                np.arange(number) * (one // step) for number, one, step in zip(blocks, across, steps, strict=True)
            )
            waves = wave_sums(weight * high, rows, columns, pairs.half @ matrix, (edges[0], edges[1]))
            right[place.colour] += waves.reshape(shape[1], -1)
            if sums is None:
                waves = wave_sums(weight * mean, rows, columns, pairs.apart @ matrix, (edges[0], edges[1]))
                every[place.colour] += waves.reshape(shape[1], -1)
            for values, into in ((high * high, energy), (keep, count)):
                into[place.colour] += block_sums(values, edges[0], edges[1]).ravel()
        middles = []
        for number, one, full in zip(blocks, across, mosaic.shape, strict=True):
            ends = np.append(np.arange(number) * one, full)  # the last is longer
            middles.append((ends[1:] + ends[:-1]) / 2 - full / 2)
        y, x = np.meshgrid(*middles, indexing="ij")
        odd = np.add.outer(np.arange(blocks[0]), np.arange(blocks[1])).ravel() % 2 == 1
        centres = np.column_stack([y.ravel(), x.ravel()])
        sound = float(np.mean([1 if good is None else good.mean() for _, _, good in means.means]))
        return cls(mosaic.shape, lattice, like or lattice, sought, centres, every, right, energy, count, odd, sound)

    @cached_property
    def nested(self) -> tuple[_Equations, ...]:
        """Those of the pattern's orders alone, and of all."""
        fewer = self.sought.pattern
        if fewer.orders == self.sought.orders:
            return (self,)
        number = {tuple(apart): at for at, apart in enumerate(_pairs(self.sought.orders).apart.tolist())}
        sums = np.take(self.sums, [number[tuple(one)] for one in _pairs(fewer.orders).apart.tolist()], axis=-1)
        return replace(self, sought=fewer, sums=sums, right=self.right[..., : fewer.drawn + 1]), self

    def moved(self, lattice: Lattice) -> _Equations:
        """About the same at a lattice so near that waves turn little within a block."""
        pairs, move = _pairs(self.sought.orders), lattice.matrix() - self.at.matrix()
        of_sums, of_right = (
            np.exp(-2j * np.pi * (self.centres @ (some @ move).T)).astype(np.complex64)
            for some in (pairs.apart, pairs.half)
        )
        return replace(self, at=lattice, sums=self.sums * of_sums, right=self.right * of_right)

    def at_finer(self, lattice: Lattice, means: _Means) -> _Equations:
        """Those of the frame's means at a lattice next to this one: L², which is even, hardly turns."""
        sums = self.moved(lattice).sums if means.mosaic.valid is None else None
        return _Equations.of(means, lattice, self.sought, self.like, sums)

    def _image(self, colour: int, c: Coefficients, terms: Floats) -> Coefficients:
        """(blocks, half) each block's matrix times its coefficients, of c (half, terms)."""
        pairs, own = _pairs(self.sought.orders), self.sums[colour]
        every = np.concatenate([c, c[1:].conj()]).T
        made = np.zeros((len(own), len(c)), dtype=np.complex128)
        ahead, behind = np.zeros((2, len(every), len(pairs.apart), len(c)), dtype=np.complex64)
        rows = np.broadcast_to(np.arange(len(c))[:, None], pairs.index.shape)
        for into, chosen in ((ahead, ~pairs.turned), (behind, pairs.turned)):
            values = np.broadcast_to(every[:, None], (len(every), *chosen.shape))
            into[:, pairs.index[chosen], rows[chosen]] = values[:, chosen]
        other = own.conj()
        for term, first, second in zip(terms.T, ahead, behind, strict=True):
            made += term[:, None] * (own @ first + other @ second)
        return made

    @cached_property
    def weights(self) -> Floats:
        """(colours, blocks): one over what a block leaves unexplained, per pixel."""
        if (first := self.nested[0]) is not self:
            return first.weights
        made = []
        for colour in range(len(self.right)):
            plain = np.where(self.count[colour] > 0, 1.0, 0.0)
            flat = self._terms(0)
            c = self._solved(colour, plain, flat)
            gains = _products(flat @ c.T, 2 * self.right[colour] - self._image(colour, c, flat))
            left = self.energy[colour] - gains
            spread = np.maximum(left, 0) / np.maximum(self.count[colour], 1)
            usual = float(np.median(spread[self.count[colour] > 0])) if plain.any() else 1.0
            made.append(plain / np.maximum(spread + 0.05 * usual, 1e-12))
        return np.array(made)

    @property
    def _lights(self) -> Floats:
        """(colours, blocks) the sums of L²."""
        return np.asarray(self.sums[..., _pairs(self.sought.orders).index[0, 0]].real)

    def _terms(self, degree: int) -> Floats:
        return terms_at(self.centres, self.shape, degree)

    def _solved(self, colour: int, weights: Floats, terms: Floats) -> Coefficients:
        """Coefficients (half, terms)."""
        return _complex(self._normal(colour, weights, terms).solution().reshape(-1, terms.shape[1]))

    def _normal(self, colour: int, weights: Floats, terms: Floats, blocks: _Blocks = _EVERY) -> _Normal:
        """The normal equations of `_real` coefficients (n, terms), of some blocks."""
        known, h = _pairs(self.sought.orders), self.right.shape[2]
        terms, weights = terms[blocks], weights[blocks]
        count, n = terms.shape[1], 2 * h - 1
        first, second = np.triu_indices(count)
        pairs = weights[:, None] * terms[:, first] * terms[:, second]
        parts = self.sums[colour][blocks].view(np.float32).astype(np.float64)
        every = (pairs.T @ parts).view(np.complex128)[:, known.index]
        np.conjugate(every, out=every, where=known.turned)
        less, more = every[..., :h], every[..., [0, *range(h, n)]]  # of an order and another, of it and the opposite
        each = np.empty((len(pairs.T), n, n))
        each[:, :h, :h] = (less + more).real
        each[:, :h, h:] = (more - less)[..., 1:].imag
        each[:, h:, :h] = (more + less)[:, 1:].imag
        each[:, h:, h:] = (less - more)[:, 1:, 1:].real
        each[:, 0] /= math.sqrt(2)
        each[:, :, 0] /= math.sqrt(2)
        gram = np.empty((count, count, n, n))
        gram[first, second] = gram[second, first] = each
        whole = gram.transpose(2, 0, 3, 1).reshape(n * count, n * count)
        right = _real(self.right[colour][blocks]).T @ (weights[:, None] * terms)
        return _Normal(whole, right.reshape(n * count))

    @cached_property
    def unexplained(self) -> float:
        """`explained` without a shadow."""
        return self.explained(None)

    def explained(self, other: Shadow | None, weights_of_blocks: Floats | None = None) -> float:
        """Log likelihood that local means, brighter or darker all over, gain behind another frame's shadow, or none.
        (Those of several shadows compare where blocks weigh the same.)"""
        total, half = 0.0, self.right.shape[2]
        terms = self._terms(0 if other is None else other.degree)
        for colour, weights in enumerate(self.weights if weights_of_blocks is None else weights_of_blocks):
            c = np.zeros((half, terms.shape[1]), dtype=np.complex128)
            c[0, 0] = 1
            if other is not None:
                c[1:] = other.coefficients[min(colour, len(other.coefficients) - 1)]
            values, known = _real(c.T).T.ravel(), self._normal(colour, weights, terms)
            image = known.matrix @ values
            values *= float(values @ known.right + image[0]) / max(float(values @ image), 1e-30)
            values[0] -= 1
            total += known.gain(values) / 2
        return total

    def evidence(self, degrees: Sequence[int] = _DEGREES) -> ShadowEvidence:
        """What the frame tells, with polynomials of these degrees."""
        sure = np.asarray(np.linalg.inv(self._lattice_step[1] + 1e-8 * np.eye(4)))
        fewest = min(int(self.odd.sum()), int((~self.odd).sum()))
        known = [one for one in degrees if one == 0 or _FOR_A_TERM * self._terms(one).shape[1] <= fewest]
        fits = tuple(each._fitted(degree) for each in self.nested for degree in known)
        return ShadowEvidence(self.shape, self.at, self.sought.orders, sure, fits)

    def _unpulled(self, colour: int, weights: Floats, terms: Floats) -> Floats:
        """(blocks,) 1 − how far a block draws the fit towards itself, by which its residual is too small."""
        sure = weights * self._lights[colour]
        whole = np.einsum("bi,b,bj->ij", terms, sure, terms)
        whole += np.eye(len(whole)) * max(_RIDGE * float(np.trace(whole)), 1e-30)
        pull = sure * np.einsum("bi,ij,bj->b", terms, np.linalg.inv(whole), terms)
        return np.asarray(np.maximum(1 - pull, _UNPULLED))

    def _fitted(self, degree: int) -> Fit:
        """Coefficients, their errors by the scatter between blocks, and the log likelihood that they gain over the mean
        alone on the half of the blocks that they were not fitted to."""
        found, spread, held = [], [], -self.unexplained
        terms = self._terms(degree)
        for colour, weights in enumerate(self.weights):
            one, other = (self._normal(colour, weights, terms, fold) for fold in (self.odd, ~self.odd))
            if self.odd.any() and not self.odd.all():
                held += (one.gain(other.solution()) + other.gain(one.solution())) / 2
            whole = _Normal(one.matrix + other.matrix, one.right + other.right)
            inverse = np.linalg.inv(whole.ridged())
            c = _complex((inverse @ whole.right).reshape(-1, terms.shape[1]))
            left = weights[:, None] * _real(self.right[colour] - self._image(colour, c, terms))
            scores = (left[:, :, None] * terms[:, None, :]).reshape(len(terms), -1)
            errors = scores @ inverse / self._unpulled(colour, weights, terms)[:, None]
            both = (errors**2).sum(axis=0).reshape(-1, terms.shape[1])[1:] / 2  # real and imaginary parts
            # Where pixels are clipped dark places alone are left, which err alike.
            spread.append(both.reshape(2, len(c) - 1, -1).sum(axis=0) / max(self.sound, _LEAST) ** 2)
            found.append(c[1:] / (1 + c[0, 0].real))  # S·L over L·L, where S is finer than L
        return Fit(degree, np.array(found), np.array(spread), held)

    def lattice(self) -> Lattice | None:
        """The lattice that the phases of the blocks agree on best, by one Gauss–Newton step; None where it is so near
        that nothing changes."""
        step, _ = self._lattice_step
        finer = lattice_of_bins(self.shape, lattice_bins(self.shape, self.at) + step)
        return None if self.at_rest(finer) else finer

    def at_rest(self, lattice: Lattice) -> bool:
        """Whether a lattice is so near that nothing changes."""
        off = lattice_bins(self.shape, lattice) - lattice_bins(self.shape, self.at)
        return float(np.abs(off).max()) < _STILL_BINS

    @cached_property
    def _lattice_step(self) -> tuple[Floats, Floats]:
        """(4,) how far the lattice lies off, in bins of rows of ky and kx, of columns of ky and kx; and (4, 4) the
        covariance of its error, by the scatter between blocks."""
        if self.sought != self.sought.leading:
            return self.nested[0]._lattice_step
        half, count = np.array(self.sought.orders, dtype=np.float64), len(self.sought.orders)
        normal, scores = np.zeros((4 + count, 4 + count)), np.zeros((len(self.centres), 4 + count))
        levers = 2 * np.pi * np.einsum("bd,kj,d->bkdj", self.centres, half, 1 / np.array(self.shape))
        levers = levers.reshape(len(self.centres), count, 4)
        parts = []
        for colour, weights in enumerate(self.weights):
            c = self._solved(colour, weights, self._terms(0))[1:, 0]
            turned = weights[:, None] * (c.conj() * self.right[colour][:, 1:]).imag
            sure = (weights * self._lights[colour])[:, None] * np.abs(c) ** 2
            parts.append(sure)
            normal[:4, :4] += np.einsum("bki,bk,bkj->ij", levers, sure, levers)
            normal[:4, 4:] += np.einsum("bki,bk->ik", levers, sure)
            normal[4:, 4:] += np.diag(sure.sum(axis=0))
            scores[:, :4] += np.einsum("bki,bk->bi", levers, turned)
            scores[:, 4:] += turned
        normal[4:, :4] = normal[:4, 4:].T
        normal += np.diag([*[1 / _FOUND_BINS**2] * 4, *[1e-9] * count])
        total = scores.sum(axis=0)
        back, bins = np.linalg.inv(self.like.matrix()), 1 / np.array(self.shape)
        moves = np.einsum("ak,jb,j->jkab", back, np.eye(2), bins).reshape(4, 2, 2)
        now = back @ self.at.matrix()
        for unlike, pull in (
            (moves[:, 0, 0] - moves[:, 1, 1], now[0, 0] - now[1, 1]),
            (moves[:, 0, 1] + moves[:, 1, 0], now[0, 1] + now[1, 0]),
        ):
            normal[:4, :4] += np.outer(unlike, unlike) / _SHEARED**2
            total[:4] -= unlike * pull / _SHEARED**2
        inverse = np.linalg.inv(normal)
        step = inverse @ total
        sure = np.sum(parts, axis=0)
        explained = sure * (levers @ step[:4] + step[4:])
        scores[:, :4] -= np.einsum("bki,bk->bi", levers, explained)
        scores[:, 4:] -= explained
        errors = scores @ inverse[:, :4]
        return step[:4], np.asarray(errors.T @ errors)
