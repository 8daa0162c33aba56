"""Model how mask and aperture turn a light field into slices, and fit the aperture that a frame was taken with.

Light from aperture point θ (mm, at distance v in front of the sensor) reaches sensor point x through mask point
(1−α)x + αθ, α = d/v. With a mask Σ_k M_k e^{2πi k·(f_m R ξ + x0)} and R its rotation the plane is

    I(x) = Σ_k M_k e^{2πi k·(F x + x0)} ∫ L(x, θ) e^{2πi ω_k·θ} dθ,   ω_k = κ k·R,   κ = f_m α A,

θ counted in shares of the aperture's diameter A. So slice_k / T_k, with T_k = M_k e^{2πi k·x0}, is the angular Fourier
coefficient of L at ω_k cycles over the aperture, known up to the frame's noise.

The aperture is fitted because an f-number is rounded: f/7.4 may be 7.46, and f/22 is 22.6 on most lenses. Near the
ideal aperture such a percent moves the views apart or together, and what all views share then leaks into coefficients
which should hold none of it. The mean of slice k over the frame is T_k·A(κ·k) of the plane's mean (A the aperture's
transform); parallax and texture only enter at the frame's edges. So κ is where A agrees with the means.
"""

from __future__ import annotations

import itertools
import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cache
from typing import Literal

import numpy as np
from numpy.polynomial.chebyshev import chebval
from numpy.typing import NDArray

from dappled.decode.optics import Lattice, Order
from dappled.decode.optics.visibility import round_stop
from dappled.findings import FRAME, Code, Finding, finding

Shape = Literal["beams", "filled", "round"]
# Chosen by hand where no figure stands beside a number; benchmarks/views.py measures what all of them together make.

_PARTS = 15  # of a cell's side, where a circle cuts through cells
SEARCHED = 2.3  # times or a fraction of the nominal κ: an f-number told two stops wrong, and a distance of a tenth
_STEP = 5e-4  # relative: of the search
_NOMINAL_SIGMA = 0.02  # relative: the error of an f-number (nominal f/22 is 22.6, f/3.5 is 3.56)
_UNKNOWN_SIGMA = 0.2  # relative: the error of κ where the mask's distance was not fitted
_WRONG, _WRONG_SIGMA = (
    0.05,
    0.3,
)  # how often an f-number is told wrong (an old lens' ring, a step-up ring), and by how much
_FAR_NOMINAL, _FAR_UNKNOWN = 0.08, 0.25  # relative: κ farther from the nominal one is a reason for doubt
_TEXTURE = 1.5e-3  # of the mean: what the scene adds to the mean of a slice
_EVIDENCE = 9.0  # squared deviations: less doesn't tell one shape from another (beams from filled cells never at κ = 1)
SHAPES: tuple[Shape, ...] = ("beams", "filled", "round")
_PRINTED = 0.04  # of a carrier: how well a design says the strength of a print's
_GAINS = np.linspace(0.8, 1.25, 10)  # of all carriers of a print: its film's contrast
_GAIN_SIGMA = 0.1  # relative: of a film's contrast; chosen by hand, as no print was measured
_DRAWN = 0.01  # of the mean: a weaker order of the design says nothing
_MOVES, _COARSER = 48, 10  # of a period: how finely moves are tried, and κ with them in steps
_MOVED = 30.0  # squared deviations: a smaller gain is no move, and no other contrast
FAINTEST, STRONGEST = 0.3, 1.25  # contrast of a shadow over the calibrated one: less may be no mask
_SELDOM_FADED = 16.0  # squared deviations: what another contrast costs where texture tells of it
_TEXTURE_CONTRAST = 0.03  # beside its standard error: of what texture shows of the contrast
_EXPLAINED = 2.0  # mean squared deviation that may be left: what no contrast explains either speaks for none
_FADED = 0.1  # of the contrast: a smaller change is not told, six-bladed stops look like it
_AGREEMENT = 6.0  # times their own error: means further from those of any aperture are not fitted


@dataclass(frozen=True, slots=True)
class Aperture:
    """How light comes through the aperture in the model: N views an axis over its full width, each one cell of it.

    "beams": through the middle of each cell. "filled": through the whole of each cell. "round": through what of each
    cell lies in the circle; a view whose cell lies outside keeps its place, and is estimated from the others.
    """

    views: int
    shape: Shape = "beams"

    def points(self) -> NDArray[np.float64]:
        """(V·U, 2) the cells' middles (v, u) in shares of the full aperture, −0.5 to 0.5, rows first."""
        return _middles(self.views)

    def offsets(self) -> NDArray[np.float64]:
        """(V, U, 2) the views' own points."""
        return self.points().reshape(self.views, self.views, 2)

    def cells(self, angular: NDArray[np.float64]) -> NDArray[np.complex128]:
        """(K, V·U) ∫ e^{2πi ω·θ} dθ over each view's cell for (K, 2) frequencies ω in cycles over the aperture, as a
        share of the whole aperture: at 0 the share of the light that each view has."""
        angular, n = np.asarray(angular), self.views
        if self.shape != "round":
            cells = np.asarray(np.exp(2j * np.pi * angular @ self.points().T) / n**2, dtype=np.complex128)
            if self.shape == "filled":
                cells *= np.sinc(angular / n).prod(axis=1)[:, None]
            return cells
        # A part's phase is a product of one along each axis, so that the parts of a column are summed first.
        fine = n * _PARTS
        axis = (np.arange(fine) - (fine - 1) / 2) / fine
        down, across = (np.exp(2j * np.pi * np.outer(angular[:, i], axis)) for i in (0, 1))
        circle = _in_circle(fine).reshape(n, _PARTS, fine)
        rows = [down[:, v * _PARTS : (v + 1) * _PARTS] @ circle[v] * across for v in range(n)]
        cells = np.stack(rows, axis=1).reshape(-1, n, n, _PARTS).sum(axis=3).reshape(-1, n * n)
        return np.asarray(cells * np.sinc(angular / fine).prod(axis=1)[:, None])

    def transform(self, angular: NDArray[np.float64]) -> NDArray[np.complex128]:
        """(K,) the same over the whole aperture; 1 at 0."""
        if self.shape != "round":
            frequencies = np.asarray(angular)
            # The mean of cos(2πω(j − (N − 1)/2)/N) over the cells j, as a Chebyshev series of cos(πω/N).
            multiples = np.abs(2 * np.arange(self.views) - self.views + 1)
            along = chebval(np.cos(np.pi / self.views * frequencies), np.bincount(multiples) / self.views)
            if self.shape == "filled":
                along *= np.sinc(frequencies / self.views)
            return np.asarray(along.prod(axis=-1), dtype=np.complex128)
        return round_stop(np.asarray(angular)).astype(np.complex128)


def _middles(n: int) -> NDArray[np.float64]:
    """(n², 2) the middles of n × n cells over the full aperture, rows first."""
    axis = (np.arange(n) - (n - 1) / 2) / n
    return np.array(list(itertools.product(axis, axis)), dtype=np.float64)


@cache
def _in_circle(n: int) -> NDArray[np.float64]:
    """(n²,) what each of n × n cells has of the circle, as a share of the circle."""
    fine = 16
    axis = (np.arange(n * fine) - (n * fine - 1) / 2) / (n * fine)
    inside = (np.hypot(axis[:, None], axis[None, :]) <= 0.5).reshape(n, fine, n, fine).sum(axis=(1, 3)).ravel()
    return np.asarray(inside / inside.sum(), dtype=np.float64)


def kappa(frequency_per_mm: float, mask_distance_mm: float, focal_length_mm: float, f_number: float) -> float:
    """κ = f_m · α · A: cycles of the mask's fundamental that the aperture A = v / f-number sweeps over."""
    return frequency_per_mm * mask_distance_mm / focal_length_mm * (focal_length_mm / f_number)


def angular_frequencies(orders: Sequence[Order], kappa_cycles: float, rotation_rad: float) -> NDArray[np.float64]:
    """(K, 2) ω_k = κ k·R in cycles over the aperture, rotated as `Lattice.rotated` rotates the carriers."""
    c, s = math.cos(rotation_rad), math.sin(rotation_rad)
    turn = np.array([[c, s], [-s, c]])
    rotated: NDArray[np.float64] = kappa_cycles * np.asarray(orders, dtype=np.float64).reshape(-1, 2) @ turn
    return rotated


def transfer(
    orders: Sequence[Order], magnitudes: Sequence[float] | NDArray[np.float64], origin: tuple[float, float]
) -> NDArray[np.complex128]:
    """(K,) T_k = M_k e^{2πi k·x0}, lattice-linear phases from one origin x0 (cycles of ky and of kx)."""
    turns = np.asarray(orders, dtype=np.float64).reshape(-1, 2) @ np.asarray(origin)
    transfers: NDArray[np.complex128] = np.asarray(magnitudes) * np.exp(2j * np.pi * turns)
    return transfers


def at_corner(origin: tuple[float, float], lattice: Lattice, shape: tuple[int, int]) -> tuple[float, float]:
    """The origin in cycles at pixel (0, 0) for one at the frame's centre."""
    shift = lattice.matrix() @ ((np.array(shape) - 1) / 2)
    return float(origin[0] - shift[0]), float(origin[1] - shift[1])


def at_centre(origin: tuple[float, float], lattice: Lattice, shape: tuple[int, int]) -> tuple[float, float]:
    """The inverse of `at_corner`, cycles from −0.5 to 0.5."""
    shift = lattice.matrix() @ ((np.array(shape) - 1) / 2)
    return _turn(origin[0] + shift[0]), _turn(origin[1] + shift[1])


def _turn(cycles: float) -> float:
    return float(cycles - round(cycles))


def relative_transfer(slices: NDArray[np.complex64]) -> NDArray[np.complex128]:
    """(K,) least-squares factor of each slice on the first: the carriers' transfer, a scene's texture taken out."""
    dc = slices[0].astype(np.complex128).ravel()
    products = np.array([np.vdot(dc, s.ravel()) for s in slices], dtype=np.complex128)
    factors: NDArray[np.complex128] = products / np.vdot(dc, dc).real
    return factors


def origin_of(orders: Sequence[Order], phases: NDArray[np.complex128]) -> tuple[tuple[float, float], float]:
    """(x0, rms phase residual) for complex transfers (K,) that may be negative: phase_k = 2π k·x0, or that plus π.

    Each weighs by its magnitude. Which of the four origins half a period apart is meant follows from the sign of (0, 1)
    and (1, 0), or else of the innermost orders: those are positive.
    """
    k = np.asarray(orders, dtype=np.float64)
    weights = np.abs(phases) ** 2
    squares = phases**2 / np.maximum(np.abs(phases), 1e-30) ** 2
    best, best_score = np.zeros(2), -math.inf
    steps = np.arange(0, 1, 1 / 48)
    inner = np.argsort(np.hypot(*k.T), kind="stable")
    inner = inner[weights[inner] > 1e-4 * weights.max()][:4]
    for y, x in itertools.product(steps, steps):
        turn = np.exp(-2j * np.pi * (k @ (y, x)))
        score = float((weights * (squares * turn**2).real).sum())
        score += 1e-3 * float((weights[inner] * (phases[inner] / np.abs(phases[inner]) * turn[inner]).real).sum())
        if score > best_score:
            best, best_score = np.array([y, x]), score
    for _ in range(20):  # Gauss–Newton on the doubled phases
        residual = np.angle(squares * np.exp(-4j * np.pi * (k @ best))) / (4 * np.pi)
        root = np.sqrt(weights)[:, None]
        best = best + np.linalg.lstsq(k * root, residual[:, None] * root, rcond=None)[0][:, 0]
    residual = np.angle(squares * np.exp(-4j * np.pi * (k @ best))) / 2
    rms = float(np.sqrt((weights * residual**2).sum() / weights.sum()))
    return (float(best[0]), float(best[1])), rms


def own_transfer(
    slices: NDArray[np.complex64], orders: Sequence[Order], through: NDArray[np.float64], keep: NDArray[np.bool_]
) -> NDArray[np.complex128]:
    """T_k from the frame's own slices, lattice-linear, the aperture divided out."""
    seen = relative_transfer(slices) / np.where(keep, through, 1.0)
    used = keep.copy()
    used[0] = False
    origin, _ = origin_of([order for order, usable in zip(orders, used, strict=True) if usable], seen[used])
    turns = transfer(orders, np.ones(len(orders)), origin)
    return np.where(keep, (seen * np.conj(turns)).real, 0.0) * turns


@dataclass(frozen=True, slots=True)
class UsedAperture:
    """κ in periods of the mask's fundamental, and its standard error; `fitted` False is the f-number's own.

    `aperture` says how light comes through: beams, filled cells, or a round stop. `share` is κ over the nominal one,
    where that is farther off than f-number and distance should be, or where the frame agrees with no aperture (NaN);
    None where there is no such reason for doubt. `unexplained` is the rms of what the means of the slices differ from
    those of this aperture, as a share of the plane's mean: clipped pixels and a stop of another shape leave it.
    `contrast` is that of the mask's shadow over the calibrated one.
    """

    kappa: float
    sigma: float
    fitted: bool
    aperture: Aperture
    share: float | None = None
    unexplained: float = 0.0
    contrast: float = 1.0

    @property
    def fits(self) -> bool:
        """Whether the carriers agree with an aperture, if not with the told one; also where they tell nothing."""
        return self.share is None or not math.isnan(self.share)

    def finding(self, f_number: float) -> Finding | None:
        """What is strange about the aperture of a frame at a told f-number, or its mask's contrast; None where nothing
        is."""
        if self.share is None:
            faded = abs(self.contrast - 1) > _FADED
            return finding(Code.MASK_CONTRAST, FRAME, share=self.contrast) if faded else None
        if not self.fits:
            return finding(Code.APERTURE_UNEXPLAINED, FRAME, told=f_number)
        return finding(Code.APERTURE_DISAGREES, FRAME, shown=f_number / self.share, told=f_number)


@dataclass(frozen=True, slots=True)
class ShownContrast:
    """The contrast of a shadow over the calibrated one that texture shows: through an aperture of `kappa` periods, by
    how much more for each unit of its logarithm, and the standard error."""

    kappa: float
    contrast: float
    sigma: float
    slope: float = 0.0

    def beside(self, kappa: float, contrast: float) -> ShownContrast:
        """It with what texture shows through another aperture."""
        apart = math.log(kappa / self.kappa)
        return replace(self, slope=(contrast - self.contrast) / apart) if abs(apart) > _STEP else self

    @property
    def doubtful(self) -> bool:
        """Whether the calibrated contrast is less probable than others."""
        return abs(self.contrast - 1) > 2 * self.error

    @property
    def error(self) -> float:
        """The standard error, with that of the model."""
        return math.hypot(self.sigma, _TEXTURE_CONTRAST)

    def at(self, kappas: NDArray[np.float64]) -> NDArray[np.float64]:
        """(n,) through each of these."""
        return np.clip(self.contrast + self.slope * np.log(kappas / self.kappa), FAINTEST, STRONGEST)


_Means = tuple[list[Order], NDArray[np.complex128], NDArray[np.float64]]


@dataclass(frozen=True, slots=True, eq=False)
class SlicesThroughStop:
    """Slices complex64 (K, h, w), DC first, of `orders`, with their known transfers T_k (K,), and what is told of the
    stop that they came through: `nominal_kappa` periods of a mask turned by `rotation_rad`."""

    slices: NDArray[np.complex64]
    transfers: NDArray[np.complex128]
    orders: Sequence[Order]
    nominal_kappa: float
    rotation_rad: float
    aperture: Aperture

    def means(self) -> _Means | None:
        """The orders whose transfers are known, their slices' means over those and over the plane's mean, and what a
        scene adds to these; None where there are none."""
        means = mean_of_slices(self.slices)
        known = np.abs(self.transfers) > 1e-3
        known[0] = False
        if not known.any() or not means[0].real > 0:
            return None
        wanted = [order for order, usable in zip(self.orders, known, strict=True) if usable]
        shares = means[known] / means[0].real / self.transfers[known]
        return wanted, shares, _TEXTURE / np.abs(self.transfers[known])


def used_aperture(
    told: SlicesThroughStop,
    *,
    distance_known: bool = True,
    texture: ShownContrast | None = None,
    faded: Sequence[bool] = (False, True),
) -> UsedAperture:
    """The aperture of a frame from its slices: the most probable κ within a factor `SEARCHED` of the nominal one.
    An f-number is near the truth, or now and then
    told wrong altogether; where the mask's distance is only known to some percent (not `distance_known`), so is κ. The
    nominal one where the means carry no information or fit no aperture. Another contrast of the shadow is taken only
    where it explains the means, which are far from those of all apertures with the calibrated one, or where that is
    far from what `texture` shows. `faded` says whether another contrast is tried.
    """
    sigma, far = (_NOMINAL_SIGMA, _FAR_NOMINAL) if distance_known else (_UNKNOWN_SIGMA, _FAR_UNKNOWN)
    nominal = UsedAperture(told.nominal_kappa, sigma * told.nominal_kappa, False, told.aperture)
    if (shown := told.means()) is None:
        return nominal
    off, prior = _kappas(sigma)
    best: UsedAperture | None = None
    least = math.inf
    kappas = told.nominal_kappa * np.exp(off)
    there = _expected(shown[0], kappas, told.rotation_rad, told.aperture.views)
    price = _MOVED if texture is None else _SELDOM_FADED
    for another in faded:
        if another and least <= price:
            break  # another contrast costs as much
        for shape, means in zip(SHAPES, there, strict=True):
            at = Aperture(told.aperture.views, shape)
            cost_before = prior + price * another
            found, cost = _fitted(shown, means, kappas, aperture=at, prior=cost_before, faded=another, texture=texture)
            if found is not None and cost + (_EVIDENCE if best else 0.0) < least:
                best, least = found, cost
    if best is None:
        return replace(nominal, share=math.nan)
    share = best.kappa / told.nominal_kappa
    return replace(best, share=share) if abs(math.log(share)) > far else best


def shift_shown(told: SlicesThroughStop, *, distance_known: bool = True) -> tuple[float, float]:
    """By how many periods (ky, kx; −0.5 to 0.5) the means of slices, as `used_aperture`, show a mask to have moved.

    A move by δ turns mean k by 2πk·δ, and the stop may turn its sign: so move, stop and κ are fitted together.
    (0, 0) where none is sure.
    """
    shown = told.means()
    if shown is None or np.linalg.matrix_rank(shown[0]) < 2:
        return 0.0, 0.0
    wanted, seen, error = shown
    off, prior = _kappas(_NOMINAL_SIGMA if distance_known else _UNKNOWN_SIGMA)
    off, prior = off[::_COARSER], prior[::_COARSER]
    kappas = told.nominal_kappa * np.exp(off)
    there = _expected(wanted, kappas, told.rotation_rad, told.aperture.views).reshape(-1, len(wanted)) / error
    alone = (there**2).sum(axis=1) + np.tile(prior, len(SHAPES)) + float((np.abs(seen / error) ** 2).sum())

    def costs(moves: NDArray[np.float64], some: slice = slice(None)) -> NDArray[np.float64]:
        back = (seen * np.exp(-2j * np.pi * moves @ np.array(wanted, dtype=np.float64).T)).real / error
        return np.asarray(alone[some, None] - 2 * there[some] @ back.T)

    axis = np.arange(-_MOVES // 2, _MOVES // 2) / _MOVES
    tried = np.stack(np.meshgrid(axis, axis, indexing="ij"), axis=-1).reshape(-1, 2)
    found = costs(tried)
    at, best = divmod(int(found.argmin()), len(tried))
    still = float(costs(np.zeros((1, 2))).min())
    deviations = max(1.0, float(found[at, best]) / (2 * len(wanted)))
    if still - float(found[at, best]) < _MOVED * deviations or deviations > _AGREEMENT**2:
        return 0.0, 0.0
    fine = tried[best] + (tried - tried[0]) * (2 / _MOVES) - 1 / _MOVES
    moved = fine[int(costs(fine, slice(at, at + 1)).argmin())]
    return _turn(float(moved[0])), _turn(float(moved[1]))


def _expected(
    orders: Sequence[Order], kappas: NDArray[np.float64], rotation_rad: float, views: int
) -> NDArray[np.float64]:
    """(S, n, K) the means of K slices, over their transfers, behind a stop of each of `SHAPES` and κ."""
    angular = np.concatenate([angular_frequencies(orders, float(kappa), rotation_rad) for kappa in kappas])
    means = [Aperture(views, shape).transform(angular).real for shape in SHAPES]
    return np.reshape(means, (len(SHAPES), len(kappas), -1))


def _kappas(sigma: float) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """The logarithms of the factors of κ that are tried, and what each costs before the frame is seen."""
    steps = round(math.log(SEARCHED) / _STEP)
    off = _STEP * np.arange(-steps, steps + 1)
    wrong = (off / _WRONG_SIGMA) ** 2 + 2 * math.log(_WRONG_SIGMA / sigma / _WRONG)
    return np.asarray(off, dtype=np.float64), np.asarray(np.minimum((off / sigma) ** 2, wrong), dtype=np.float64)


def shown_aperture(
    slices: NDArray[np.complex64],
    designs: Sequence[NDArray[np.float64]],
    orders: Sequence[Order],
    *,
    nominal_kappa: float,
    rotation_rad: float,
    aperture: Aperture,
) -> UsedAperture:
    """`used_aperture` of a frame that shows its carriers, without a calibration: the design says how strong they are.

    `designs` (K,) are strengths of the orders before the stop averages them, more than one where it is not known what
    film, diffraction and pixels take; all may be weaker or stronger by the film's contrast. The nominal κ where the
    orders are all of one size: then contrast and aperture can't be told apart.
    """
    nominal = UsedAperture(nominal_kappa, _NOMINAL_SIGMA * nominal_kappa, False, aperture)
    means = mean_of_slices(slices)
    drawn = np.min(np.abs(designs), axis=0) > _DRAWN
    drawn[0] = False
    wanted = [order for order, usable in zip(orders, drawn, strict=True) if usable]
    sizes = {ky * ky + kx * kx for ky, kx in wanted}
    if len(sizes) < 2 or np.linalg.matrix_rank(wanted) < 2 or not means[0].real > 0:
        return nominal
    relative = means[drawn] / means[0].real
    origin, _ = origin_of(wanted, relative)
    real = (relative * np.conj(transfer(wanted, np.ones(len(wanted)), origin))).real
    off, prior = _kappas(_NOMINAL_SIGMA)
    steps = len(off) // 2
    expected = _expected(wanted, nominal_kappa * np.exp(off), rotation_rad, aperture.views)
    best, least, told = nominal, math.inf, math.inf
    for shape, there in zip(SHAPES, expected, strict=True):
        for design, gain in itertools.product(designs, _GAINS):
            error = np.hypot(_TEXTURE, _PRINTED * np.abs(real))
            deviations = ((gain * design[drawn] * there - real) / error) ** 2
            cost = deviations.sum(axis=1) + prior + (math.log(gain) / _GAIN_SIGMA) ** 2
            told = min(told, float(cost[steps]))
            at = int(np.argmin(cost))
            if cost[at] + (_EVIDENCE if shape != SHAPES[0] else 0.0) >= least or at in (0, len(off) - 1):
                continue
            least = float(cost[at]) + (_EVIDENCE if shape != SHAPES[0] else 0.0)
            agrees = float(deviations[at].mean()) <= _AGREEMENT**2
            kappa = nominal_kappa * math.exp(off[at])
            curvature = max(float(cost[at - 1] - 2 * cost[at] + cost[at + 1]), 1e-9)
            sigma = kappa * _STEP * math.sqrt(2 / curvature)
            best = UsedAperture(kappa, sigma, True, Aperture(aperture.views, shape)) if agrees else nominal
            far = abs(off[at]) > _FAR_UNKNOWN  # a stated distance is part of it
            best = replace(best, share=math.nan if not agrees else math.exp(off[at]) if far else None)
    # Stopped far down, orders differ by film and print alone: then the told aperture is as good.
    return best if told - least > _EVIDENCE or not best.fits else nominal


def _fitted(
    shown: _Means,
    there: NDArray[np.float64],
    kappas: NDArray[np.float64],
    *,
    aperture: Aperture,
    prior: NDArray[np.float64],
    faded: bool,
    texture: ShownContrast | None,
) -> tuple[UsedAperture | None, float]:
    """The most probable of `kappas`, evenly spaced in the logarithm, and its cost; None for no fit.

    `shown` are the means (see `SlicesThroughStop`), `there` those through the aperture (see `_expected`), `prior` is
    what each costs before the frame is seen. `faded`: with the contrast that suits each, and `texture`, best.
    """
    _, means, error = shown
    seen, contrast, agreement = means.real, np.ones(len(kappas)), _AGREEMENT**2
    told, weight = (texture.at(kappas), texture.error**-2) if texture else (contrast, 0.0)
    if faded:
        agreement = agreement if texture else _EXPLAINED
        wanted = (there * seen / error**2).sum(axis=1) + weight * told
        contrast = wanted / np.maximum((there**2 / error**2).sum(axis=1) + weight, 1e-30)
        contrast = np.clip(contrast, FAINTEST, STRONGEST)
        there = there * contrast[:, None]
    cost = prior + weight * (contrast - told) ** 2
    deviations = ((there - seen) / error) ** 2
    cost = deviations.sum(axis=1) + cost
    best = int(np.argmin(cost))
    if best in (0, len(kappas) - 1) or float(deviations[best].mean()) > agreement:
        return None, math.inf
    below, centre, above = (float(c) for c in cost[best - 1 : best + 2])
    curvature = below - 2 * centre + above
    step = math.log(kappas[1] / kappas[0])
    kappa = float(kappas[best]) * math.exp(0.5 * step * (below - above) / curvature)
    left = (there[best] - seen) * _TEXTURE / error
    unexplained = float(np.sqrt(np.mean(left**2)))
    sigma = kappa * step * math.sqrt(2 / curvature)
    return UsedAperture(kappa, sigma, True, aperture, unexplained=unexplained, contrast=float(contrast[best])), centre


def mean_of_slices(slices: NDArray[np.complex64]) -> NDArray[np.complex128]:
    """(K,) means over the frame under a Hann window, which the frame's edges don't reach."""
    height, width = slices.shape[1:]
    y = np.hanning(height + 2)[1:-1]
    x = np.hanning(width + 2)[1:-1]
    weighted = np.asarray(slices @ x.astype(np.float32), dtype=np.complex128) @ y
    return np.asarray(weighted / (y.sum() * x.sum()), dtype=np.complex128)
