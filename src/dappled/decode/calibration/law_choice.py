"""Choose the law that explains where a mask's carriers lie over focal lengths, and fit its constants; or neither.

Each focal length gives two numbers: the lattice's steps along rows and columns, as lengths on the chip. Each law is
fitted to them by least squares, and judged by its residual over all carriers, in bins of the frame's DFT. What several
f-numbers say of the distance (`swept_distance`) is one more number for `geometric`.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from dappled.decode.calibration.calibration import SweptDistance
from dappled.decode.optics import LAWS, Lattice, Mask, MaskedOptics, Sensor
from dappled.findings import Code, Finding, Subject, finding

# Chosen by hand where no figure stands beside a number; benchmarks/masks.py measures what all of them together make.

CALIBRATION = Subject("calibration")
EXPLAINED_BINS = 2.0  # rms: the residual that a law may leave (the thesis' own readings scatter by 0 to 2)
PLAUSIBLE = 0.35  # relative: a mask distance further from the stated one is not believed
_PRINTED = 0.05  # relative: a print's frequency is not further off
_PRINT_SIGMA = 0.01  # relative: what printers make of a size
_DISTANCE_SIGMA = 0.1  # relative: how well a mask's distance is known before it was fitted
_ANISOTROPY = 0.03  # of a print: more is another mask, or another law
_DECISIVE = 0.5  # nats: a law asked for yields to a likelier one only beyond this
_STEP_BINS = 0.02  # a lattice's step is known no better
_CONTRADICTED = 4.0  # standard errors between the distance by focal lengths and that by f-numbers
_FOR_PUPIL = 3  # focal lengths needed to fit a law's second constant, too


@dataclass(frozen=True, slots=True)
class LawFit:
    """A law as fitted.

    `anisotropy` is rows' scale over columns', less 1. `offset_bins` (rows, columns) is a constant beside `fd`'s 1/f,
    `pupil_mm` the distance of the exit pupil beyond the focal length under `geometric`, v(f) = f + pupil: None where
    there are too few focal lengths, and no several f-numbers, to tell. `rms_bins` is the residual of the carriers,
    `explains` whether that, the distance and the print are plausible. `print_scale` is the print's frequency over its
    design's. With one focal length and one f-number it is fitted for the stated distance, as the two can't be
    separated, and `print_scale_sigma` and `distance_sigma_mm` are None. `deviation` is that of the print or the
    distance, in standard deviations.
    """

    law: str
    mask_distance_mm: float
    anisotropy: float
    offset_bins: tuple[float, float] | None
    pupil_mm: float | None
    rms_bins: float
    explains: bool
    print_scale: float = 1.0
    print_scale_sigma: float | None = None
    distance_sigma_mm: float | None = None
    deviation: float = 0.0

    @property
    def nats(self) -> float:
        """The log likelihood of what the law asks of print and distance."""
        return -0.5 * self.deviation**2


@dataclass(frozen=True, slots=True)
class LawVerdict:
    """All laws as fitted, the one that explains the frames best (None: neither), and that as a finding."""

    fits: tuple[LawFit, ...]
    law: str | None
    finding: Finding


def steps_bins(lattice: Lattice, sensor: Sensor) -> tuple[float, float]:
    """The lengths of a lattice's two steps in bins along rows and along columns, the mask's turn taken out."""
    to_sensor = np.array([sensor.row_mm, sensor.column_mm])
    per_mm = np.hypot(*(lattice.matrix() @ np.linalg.inv(to_sensor).T).T)
    rows = per_mm[0] * math.hypot(*sensor.row_mm) * sensor.shape[0]
    columns = per_mm[1] * math.hypot(*sensor.column_mm) * sensor.shape[1]
    return float(rows), float(columns)


def judge(
    seen: Sequence[tuple[float, tuple[float, float]]],
    optics: MaskedOptics,
    *,
    swept: SweptDistance | None = None,
    focal_sigma_mm: float = 0.0,
) -> LawVerdict:
    """Fit all laws to focal lengths in mm with `steps_bins`; that of `optics` is chosen where the frames don't decide.

    `swept` is what several f-numbers say of the distance, `focal_sigma_mm` the standard error of the focal lengths.
    """
    sensor, mask, asked, stated_mm = optics.sensor, optics.mask, optics.law, optics.distance_mm
    lengths = np.array([length for length, _ in seen])
    steps = np.array([step for _, step in seen])
    fits = (
        _fit_fd(lengths, steps, sensor=sensor, mask=mask, stated_mm=stated_mm),
        _fit_geometric(
            lengths, steps, sensor=sensor, mask=mask, stated_mm=stated_mm, swept=swept, focal_sigma_mm=focal_sigma_mm
        ),
    )
    able = [fit for fit in fits if fit.explains]
    words = "; ".join(_words(fit) for fit in fits)
    if swept is not None:
        words += f"; the f-numbers alone say {swept.scaled_mm:.3f} ± {swept.sigma_mm:.3f} mm"
    if not able:
        return LawVerdict(fits, None, finding(Code.LAW_NEITHER, CALIBRATION, fits=words, stated_mm=stated_mm))
    if len(set(lengths.tolist())) < 2:
        best = max(able, key=lambda fit: (fit.nats + (_DECISIVE if fit.law == asked else 0.0), fit.law == asked))
        code = Code.LAW_ONLY if len(able) == 1 else Code.LAW_BOTH
        apart = "the laws" if best.distance_sigma_mm is not None else "the laws, or scale and distance,"
        return LawVerdict(fits, best.law, finding(code, CALIBRATION, law=best.law, apart=apart, fits=words))
    best = min(able, key=lambda fit: fit.rms_bins)
    return LawVerdict(fits, best.law, finding(Code.LAW_EXPLAINS, CALIBRATION, law=best.law, fits=words))


def _words(fit: LawFit) -> str:
    """A fit in words: what it takes for distance and print, with its errors, and what it leaves."""
    sigma = "" if fit.distance_sigma_mm is None else f" ± {fit.distance_sigma_mm:.3f}"
    printed = ""
    if fit.law == "geometric":
        error = "" if fit.print_scale_sigma is None else f" ± {fit.print_scale_sigma:.4f}"
        printed = f" and a print of {fit.print_scale:.4f}{error} times its design"
    return (
        f"{fit.law} with the mask at {fit.mask_distance_mm:.3f}{sigma} mm{printed} leaves {fit.rms_bins:.2f} bins rms"
    )


def _fit_fd(
    lengths_mm: NDArray[np.float64], steps: NDArray[np.float64], *, sensor: Sensor, mask: Mask, stated_mm: float
) -> LawFit:
    """Along each axis step = distance · (the law's step at 1 mm) + offset: linear."""
    scale, offset = np.empty(2), np.zeros(2)
    left = np.empty_like(steps)
    with_offset = len(set(lengths_mm.tolist())) >= _FOR_PUPIL
    for axis in (0, 1):
        unit = np.array([steps_bins(LAWS["fd"](mask, sensor, 1.0, f), sensor)[axis] for f in lengths_mm])
        design = np.column_stack([unit, np.ones_like(unit)] if with_offset else [unit])
        found = np.linalg.lstsq(design, steps[:, axis], rcond=None)[0]
        scale[axis], offset[axis] = found[0], found[1] if with_offset else 0.0
        left[:, axis] = steps[:, axis] - design @ found
    distance = math.sqrt(max(scale[0] * scale[1], 0.0))
    rms = _rms(left, mask)
    return LawFit(
        "fd",
        distance,
        _ratio(scale),
        (float(offset[0]), float(offset[1])) if with_offset else None,
        None,
        rms,
        _believed(distance, stated_mm, rms, _ratio(scale)),
        deviation=(distance / stated_mm - 1) / _DISTANCE_SIGMA,
    )


def _fit_geometric(
    lengths_mm: NDArray[np.float64],
    steps: NDArray[np.float64],
    *,
    sensor: Sensor,
    mask: Mask,
    stated_mm: float,
    swept: SweptDistance | None,
    focal_sigma_mm: float,
) -> LawFit:
    """step = scale · f_m · (1 − d/(f + pupil)), each axis with its own scale, because printing or gluing may have
    stretched it.

    At one focal length and one f-number scale and distance can't be told apart: the distance is the stated one, and the
    print's scale takes up the rest. Two focal lengths give the distance, three the pupil too; `swept`, which needs no
    pupil, stands for one more. Residuals are in standard errors, with each focal length's own, which moves the steps
    along rows and columns together, taken apart from each step's.
    """
    full = np.array([steps_bins(LAWS["geometric"](mask, sensor, 0.0, 1.0), sensor)])  # f_m itself
    several = len(set(lengths_mm.tolist()))
    tell = several + (swept is not None)
    shortest = float(lengths_mm.min())
    with_pupil = several > 1 and tell >= _FOR_PUPIL
    free = [0, 1, *([2] if tell > 1 else []), *([3] if with_pupil else [])]  # rows, columns, d, pupil
    base = np.array([1.0, 1.0, min(stated_mm, 0.98 * shortest), 0.0])
    together = full * (stated_mm / lengths_mm**2 * focal_sigma_mm)[:, None]  # (focal lengths, axes), in bins
    covariance = _STEP_BINS**2 * np.eye(2) + together[:, :, None] * together[:, None, :]
    whitener = np.linalg.inv(np.linalg.cholesky(covariance))

    def off_bins(constants: NDArray[np.float64]) -> NDArray[np.float64]:
        rows, columns, distance, pupil = _with(base, free, constants)
        there = full * (1 - distance / (lengths_mm + pupil))[:, None] * np.array([rows, columns])
        return np.asarray(steps - there)

    def left(constants: NDArray[np.float64]) -> NDArray[np.float64]:
        off = np.einsum("nij,nj->ni", whitener, off_bins(constants)).ravel()
        if swept is None:
            return np.asarray(off)
        rows, columns, distance, _ = _with(base, free, constants)
        scaled = distance * math.sqrt(rows * columns)
        return np.append(off, (scaled - swept.scaled_mm) / swept.sigma_mm)

    lowest = np.array([0.5, 0.5, 0.0, -0.9 * shortest])[free]
    highest = np.array([2.0, 2.0, 0.99 * shortest, 10 * shortest])[free]
    scales = np.array([1e-3, 1e-3, stated_mm, 1.0])[free]
    from scipy import optimize  # noqa: PLC0415  # a third of the start of verbs that fit no law

    found = optimize.least_squares(
        left, base[free], bounds=(lowest, highest), x_scale=scales, ftol=1e-14, xtol=1e-14, gtol=1e-14
    )
    rows, columns, distance, pupil = (float(value) for value in _with(base, free, found.x))
    residual = left(found.x)
    rms = _rms(off_bins(found.x), mask)
    sigma = _sigmas(found.jac, residual, free)
    scale = math.sqrt(rows * columns)
    printed = abs(scale - 1) <= _PRINTED
    return LawFit(
        law="geometric",
        mask_distance_mm=distance,
        anisotropy=rows / columns - 1,
        offset_bins=None,
        pupil_mm=pupil if with_pupil else None,
        rms_bins=rms,
        explains=printed
        and _believed(distance, stated_mm, rms, rows / columns - 1, sigma[2] if tell > 1 else 0.0)
        and (swept is None or abs(float(residual[-1])) <= _CONTRADICTED),
        print_scale=scale,
        print_scale_sigma=sigma[0] if tell > 1 else None,
        distance_sigma_mm=sigma[2] if tell > 1 else None,
        deviation=(scale - 1) / _PRINT_SIGMA if tell == 1 else (distance / stated_mm - 1) / _DISTANCE_SIGMA,
    )


def _with(base: NDArray[np.float64], free: Sequence[int], values: NDArray[np.float64]) -> NDArray[np.float64]:
    whole = base.copy()
    whole[list(free)] = values
    return whole


def _sigmas(jacobian: NDArray[np.float64], residual: NDArray[np.float64], free: Sequence[int]) -> list[float]:
    """Standard errors of (rows, columns, d, pupil), NaN where not free; larger where residuals are than expected."""
    freedom = max(1, residual.size - len(free))
    variance = max(1.0, float((residual**2).sum()) / freedom)
    covariance = np.linalg.pinv(jacobian.T @ jacobian) * variance
    found = [math.nan] * 4
    for at, which in enumerate(free):
        found[which] = math.sqrt(float(covariance[at, at]))
    return found


def _rms(left_bins: NDArray[np.float64], mask: Mask) -> float:
    """Rms distance in bins over all carriers, from the residual of one step along rows and columns."""
    orders = np.array([order for order in mask.half_orders() if order != (0, 0)], dtype=np.float64)
    return float(np.sqrt(np.mean((left_bins[:, None, :] * orders[None]) ** 2) * 2))


def _believed(distance_mm: float, stated_mm: float, rms_bins: float, anisotropy: float, sigma_mm: float = 0.0) -> bool:
    """Whether all that is plausible; a distance by up to two standard errors (as far as it can be known at all)."""
    off = abs(distance_mm - stated_mm) - 2 * min(sigma_mm, stated_mm)
    believable = off <= PLAUSIBLE * stated_mm and abs(anisotropy) <= _ANISOTROPY
    return believable and rms_bins <= EXPLAINED_BINS


def _ratio(scale: NDArray[np.float64]) -> float:
    return float(scale[0] / scale[1] - 1) if scale[1] else math.nan
