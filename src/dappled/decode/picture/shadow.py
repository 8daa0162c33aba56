"""The mask's shadow W in a frame: what the film lets through at each pixel of a scene in focus, 1 in the mean.

In focus all light of a point meets in one pixel, so pixel = scene · W, and W is a trigonometric polynomial on the
carriers' lattice, 1 + Σ c_k e^{2πi k·F x}. `shadow_fit` finds the coefficients that a frame tells.

In one scene, detail at a carrier's own frequency can't be told from the shadow. Frames behind the same mask, lens and
stop have one shadow and several scenes: what each tells by itself, its `ShadowEvidence`, is averaged by how sure it is.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from enum import StrEnum

import numpy as np
from numpy.polynomial.legendre import legvander
from numpy.typing import NDArray

from dappled.decode.array_types import Floats, Singles
from dappled.decode.optics import Lattice, Order
from dappled.decode.picture.blocks import PatternPlace, plane_waves

Coefficients = NDArray[np.complex128]
# Chosen by hand where no figure stands beside a number; tests/decode/picture measures what all of them together make.

_SURE = 4.0  # log likelihood by which held-out blocks must prefer the more complicated one
_COMMON = 0.5  # of a frame's standard error: what the next one's scene doesn't cure
UNLIKE = 6.0  # times the mean square of their errors: what differs by more is not one shadow


class ShadowFrom(StrEnum):
    """What a shadow's coefficients are from."""

    FRAME = "frame"
    FLIGHT = "flight"
    WHITE = "white"
    CALIBRATION = "calibration"
    NONE = "none"


@dataclass(frozen=True, slots=True, eq=False)
class Shadow:
    """`coefficients` complex (colours, K, terms) of the half plane's `orders`, at the frame's centre, their terms those
    of a polynomial of `degree` over the frame; `sigma` (colours,) the standard error of W, rms over the frame.
    `alike` frames beside it had this shadow, `unlike` another."""

    shape: tuple[int, int]
    lattice: Lattice
    orders: tuple[Order, ...]
    coefficients: Coefficients
    degree: int
    source: ShadowFrom
    sigma: Floats
    alike: int = 0
    unlike: int = 0

    @property
    def depth(self) -> float:
        """The standard deviation of W over the frame: 0 where the mask casts no shadow."""
        return float(np.sqrt(2 * (np.abs(self.coefficients[:, :, 0]) ** 2).sum(axis=1).mean()))

    def at(self, place: PatternPlace) -> Singles:
        """W at the samples of one place of the colour pattern, not below a hundredth."""
        frequencies = np.asarray(self.orders, dtype=np.float64).reshape(-1, 2) @ self.lattice.matrix()
        return shadow_at(place, self.shape, frequencies, self.coefficients[place.colour], self.degree)


def shadow_at(
    place: PatternPlace, shape: tuple[int, int], frequencies: Floats, coefficients: Coefficients, degree: int = 0
) -> Singles:
    """W at the samples of one place of the colour pattern, not below a hundredth; of the frequencies (K, 2) in cycles a
    pixel, with coefficients (K,) or (K, terms)."""
    rows, columns = place.at(shape)
    terms = coefficients.reshape(len(frequencies), -1)
    down, across = 2 * plane_waves(rows, -frequencies[:, 0]), plane_waves(columns, -frequencies[:, 1])
    y, x = (legvander(at / (side / 2), degree) for at, side in zip((rows, columns), shape, strict=True))
    made = np.ones((len(rows), len(columns)), dtype=np.float32)
    powers = _powers(degree)
    for b in range(degree + 1):
        wave = np.zeros(down.shape, dtype=np.complex128)
        for term, (a, other) in enumerate(powers):
            if other == b:
                wave += down * terms[:, term] * y[:, a, None]
        side = across * x[:, b, None]
        left = np.concatenate([wave.real, -wave.imag], axis=1).astype(np.float32)
        right = np.concatenate([side.real, side.imag], axis=1).astype(np.float32)
        made += left @ right.T
    return np.maximum(made, np.float32(0.01))


@dataclass(frozen=True, slots=True, eq=False)
class Fit:
    """Coefficients complex (colours, K, terms) of the first K orders as least squares give them, with their variances;
    `held` is the log likelihood that they gain on blocks that were held out."""

    degree: int
    found: Coefficients
    variance: Floats
    held: float

    def like(self, other: Fit) -> bool:
        """Whether it is of as many orders and of the same degree."""
        return (self.degree, self.found.shape[1]) == (other.degree, other.found.shape[1])


@dataclass(frozen=True, slots=True, eq=False)
class ShadowEvidence:
    """What one frame, or several together, tell of the shadow: `fits`, the simplest first, are of the pattern's orders,
    or of all. `sure` (4, 4) is one over the covariance of the lattice's error in bins (see `_Equations`)."""

    shape: tuple[int, int]
    lattice: Lattice
    orders: tuple[Order, ...]
    sure: Floats
    fits: tuple[Fit, ...]

    @property
    def drawn(self) -> tuple[Order, ...]:
        """The pattern's orders."""
        return self.orders[: self.fits[0].found.shape[1]]

    @property
    def held(self) -> float:
        """The log likelihood that the shadow gains; 0 where none is seen."""
        gain = 0.0
        for fit in self.fits:
            gain = fit.held if fit.held > gain + _SURE else gain
        return gain

    def unlike(self, other: ShadowEvidence) -> float:
        """The mean square of what two frames' shadows differ by, over that of their errors: about 1 where they are
        one."""
        step = lattice_bins(self.shape, other.lattice) - lattice_bins(self.shape, self.lattice)
        mine, its = self.fits[0], other.fits[0]
        apart = (np.abs(mine.found - its.found) ** 2).sum() + _displaced(
            self.drawn, mine.found, np.outer(step, step)
        ).sum()
        both = sum(
            one.fits[0].variance.sum() + _displaced(one.drawn, one.fits[0].found, np.linalg.inv(one.sure)).sum()
            for one in (self, other)
        )
        return float(apart / max(both, 1e-30))

    def with_those(self, others: Sequence[ShadowEvidence]) -> ShadowEvidence:
        """Together with frames that tell the same."""
        every = [self, *others]
        sure = np.sum([one.sure for one in every], axis=0)
        first = lattice_bins(self.shape, self.lattice)
        steps = [one.sure @ (lattice_bins(self.shape, one.lattice) - first) for one in every]
        lattice = lattice_of_bins(self.shape, first + np.linalg.solve(sure, np.sum(steps, axis=0)))
        alike = [[one for each in every for one in each.fits if one.like(fit)] for fit in self.fits]
        fits = tuple(_averaged(those) for those in alike if len(those) == len(every))
        return ShadowEvidence(self.shape, lattice, self.orders, sure, fits)

    def shadow(self, source: ShadowFrom, degree: int | None = None) -> Shadow | None:
        """Each coefficient is trusted as far as it stands above its error. None where no mask is seen; `degree`: that
        one, in any case."""
        told = self.held
        best = next((one for one in self.fits if one.degree == degree or (degree is None and one.held == told)), None)
        if best is None:
            return None
        own, variance = _alike(best.found, best.variance)
        orders = self.orders[: own.shape[1]]
        trust = np.clip(1 - variance / np.maximum(np.abs(own) ** 2, 1e-30), 0, 1)
        # What is not trusted may be there all the same. Squares of terms are averaged over the frame.
        squares = (terms_at(_raster(self.shape), self.shape, best.degree) ** 2).mean(axis=0)
        lost = 2 * ((np.maximum(trust, 0.5) * variance) @ squares).sum(axis=1)
        lost += 2 * _displaced(orders, own * trust, np.linalg.inv(self.sure))
        return Shadow(self.shape, self.lattice, orders, own * trust, best.degree, source, np.sqrt(lost))


def _displaced(orders: Sequence[Order], coefficients: Coefficients, step: NDArray[np.floating]) -> Floats:
    """(colours,) half of the mean square over the frame of what W changes by where the lattice lies off, by the mean
    (4, 4) of the squares of that in bins."""
    half = np.array(orders, dtype=np.float64)
    turns = np.einsum("ki,ij,kj->k", half, step[:2, :2] + step[2:, 2:], half) * (2 * np.pi) ** 2 / 12
    return np.asarray(np.abs(coefficients[:, :, 0]) ** 2 @ np.minimum(turns, 1))


def _averaged(fits: Sequence[Fit]) -> Fit:
    """By one over their variances. What they differ by more than these adds to what is left, and what errs alike in
    each of them stays."""
    weights = np.array([1 / np.maximum(one.variance, 1e-30) for one in fits])
    found, whole = np.array([one.found for one in fits]), weights.sum(axis=0)
    mean = (weights * found).sum(axis=0) / whole
    apart = float((weights * np.abs(found - mean) ** 2).sum(axis=0).mean()) / max(len(fits) - 1, 1)
    variance = (max(apart, 1.0) + _COMMON**2 * len(fits)) / whole
    return Fit(fits[0].degree, mean, variance, sum(one.held for one in fits))


def _raster(shape: tuple[int, int]) -> Floats:
    """(n, 2) places evenly over a frame, from its centre."""
    y, x = (((np.arange(9) + 0.5) / 9 - 0.5) * side for side in shape)
    return np.stack(np.meshgrid(y, x, indexing="ij"), axis=-1).reshape(-1, 2)


def lattice_bins(shape: tuple[int, int], lattice: Lattice) -> Floats:
    """(4,) a lattice in bins: rows of ky and kx, columns of ky and kx."""
    return np.asarray((lattice.matrix() * shape).T.ravel())


def lattice_of_bins(shape: tuple[int, int], bins: Floats) -> Lattice:
    return Lattice.of((bins.reshape(2, 2) / np.array(shape)[:, None]).T)


def _no_shadow(told: ShadowEvidence) -> Shadow:
    """W = 1, known as well as a shadow is weak that a frame doesn't show."""
    found = told.fits[0].found
    sigma = np.sqrt(2 * (np.abs(found[:, :, 0]) ** 2).sum(axis=1))
    return Shadow(told.shape, told.lattice, told.drawn, 0 * found, 0, ShadowFrom.NONE, sigma)


@dataclass(frozen=True, slots=True, eq=False)
class OwnShadow:
    """What a frame tells of its shadow, its `evidence`; `gains` are the log likelihoods by which each of other shadows
    explains it better than none."""

    evidence: ShadowEvidence
    gains: tuple[float, ...]

    @property
    def seen(self) -> bool:
        """Whether the frame shows a shadow."""
        return self.evidence.shadow(ShadowFrom.FRAME) is not None

    def shadow(self, others: Sequence[Shadow], beside: Sequence[ShadowEvidence]) -> Shadow:
        """The best shadow, see `shadow_fit.shadow_of`; `others` are those that the gains are of."""
        evidence = self.evidence
        own = evidence.shadow(ShadowFrom.FRAME)
        best, gain = own or _no_shadow(evidence), evidence.held
        if own is None and beside:
            evidence = beside[0]
        same = [one for one in beside if one.unlike(evidence) < UNLIKE]
        others_tell = [one for one in same if one is not evidence]
        if others_tell:
            best = evidence.with_those(others_tell).shadow(ShadowFrom.FLIGHT) or best
        best = replace(best, alike=len(same), unlike=len(beside) - len(same))
        for one, its in zip(others, self.gains, strict=True):
            if its > gain:
                best, gain = one, its
        return best


def period_of(lattice: Lattice) -> float:
    """The longest period of the carriers, in pixels."""
    return 1 / min(math.hypot(*step) for step in lattice.neighbours())


def _powers(degree: int) -> list[tuple[int, int]]:
    """Exponents of rows and columns of a polynomial's terms, the constant first."""
    return [(whole - b, b) for whole in range(degree + 1) for b in range(whole + 1)]


def terms_at(places: Floats, shape: tuple[int, int], degree: int) -> Floats:
    """(n, terms) of the polynomial at places (n, 2) from the frame's centre."""
    y, x = (legvander(at, degree) for at in (places / (np.array(shape) / 2)).T)
    return np.stack([y[:, a] * x[:, b] for a, b in _powers(degree)], axis=1)


def _alike(found: Coefficients, variance: Floats) -> tuple[Coefficients, Floats]:
    """Coefficients (colours, K, terms), drawn towards the mean of the colours as far as they differ by no more than
    their errors; and their variances. What the colours have in common of the scene errs in all of them alike."""
    sure = 1 / np.maximum(variance, 1e-30)
    whole = sure.sum(axis=0)
    mean = (sure * found).sum(axis=0) / whole
    apart = (sure * np.abs(found - mean) ** 2).sum(axis=0) - (len(found) - 1)
    differing = np.maximum(apart, 0) / np.maximum(whole - (sure**2).sum(axis=0) / whole, 1e-30)
    own = differing / (differing + np.maximum(variance, 1e-30))
    together = (np.sqrt(sure).sum(axis=0) / whole) ** 2
    return mean + own * (found - mean), np.minimum(together + own * variance, variance)
