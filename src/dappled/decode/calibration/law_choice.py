"""Choose the law that explains where a mask's carriers lie over focal lengths, and fit its constants; or neither.

Each focal length gives two numbers: the lattice's steps along rows and columns, as lengths on the chip. Each law is
fitted to them by least squares, and judged by its residual over all carriers, in bins of the frame's DFT.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy import optimize

from dappled.decode.optics import LAWS, Lattice, Mask, Sensor

EXPLAINED_BINS = 2.0  # rms: the residual that a law may leave (the thesis' own readings scatter by 0 to 2)
PLAUSIBLE = 0.35  # relative: a mask distance further from the stated one is not believed
_PRINTED = 0.05  # relative: a print's frequency is not further off
_FOR_PUPIL = 3  # focal lengths needed to fit a law's second constant, too


@dataclass(frozen=True, slots=True)
class LawFit:
    """A law as fitted.

    `anisotropy` is rows' scale over columns', less 1. `offset_bins` (rows, columns) is a constant beside `fd`'s 1/f,
    `pupil_mm` the distance of the exit pupil beyond the focal length under `geometric`, v(f) = f + pupil: None where
    there are too few focal lengths to tell. `rms_bins` is the residual of the carriers, `explains` whether that and the
    distance are plausible.
    """

    law: str
    mask_distance_mm: float
    anisotropy: float
    offset_bins: tuple[float, float] | None
    pupil_mm: float | None
    rms_bins: float
    explains: bool


@dataclass(frozen=True, slots=True)
class LawVerdict:
    """All laws as fitted, the one that explains the frames best (None: neither), and that in a sentence."""

    fits: tuple[LawFit, ...]
    law: str | None
    sentence: str


def steps_bins(lattice: Lattice, sensor: Sensor) -> tuple[float, float]:
    """The lengths of a lattice's two steps in bins along rows and along columns, the mask's turn taken out."""
    to_sensor = np.array([sensor.row_mm, sensor.column_mm])
    per_mm = np.hypot(*(lattice.matrix() @ np.linalg.inv(to_sensor).T).T)
    rows = per_mm[0] * math.hypot(*sensor.row_mm) * sensor.shape[0]
    columns = per_mm[1] * math.hypot(*sensor.column_mm) * sensor.shape[1]
    return float(rows), float(columns)


def judge(
    seen: Sequence[tuple[float, tuple[float, float]]],
    *,
    sensor: Sensor,
    mask: Mask,
    stated_mm: float,
    asked: str,
) -> LawVerdict:
    """Fit all laws to focal lengths in mm with `steps_bins`. `asked` is chosen where the frames don't decide."""
    lengths = np.array([length for length, _ in seen])
    steps = np.array([step for _, step in seen])
    fits = tuple(
        how(lengths, steps, sensor=sensor, mask=mask, stated_mm=stated_mm) for how in (_fit_fd, _fit_geometric)
    )
    able = [fit for fit in fits if fit.explains]
    words = "; ".join(
        f"{fit.law} with the mask at {fit.mask_distance_mm:.3f} mm leaves {fit.rms_bins:.2f} bins rms" for fit in fits
    )
    if not able:
        return LawVerdict(fits, None, f"neither law explains these frames ({words}; stated are {stated_mm:g} mm)")
    if len(set(lengths.tolist())) < 2:
        law = asked if asked in {fit.law for fit in able} else able[0].law
        which = f"only {law} would do" if len(able) == 1 else "both would do"
        return LawVerdict(fits, law, f"{which}, as far as one focal length tells the laws apart ({words})")
    best = min(able, key=lambda fit: fit.rms_bins)
    return LawVerdict(fits, best.law, f"{best.law} explains these frames ({words})")


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
        _believed(distance, stated_mm, rms),
    )


def _fit_geometric(
    lengths_mm: NDArray[np.float64], steps: NDArray[np.float64], *, sensor: Sensor, mask: Mask, stated_mm: float
) -> LawFit:
    """step = scale · f_m · (1 − d/(f + pupil)), each axis with its own scale, because printing or gluing may have
    stretched it.

    From too few focal lengths only the axes' ratio is fitted beside the distance.
    """
    full = np.array([steps_bins(LAWS["geometric"](mask, sensor, 0.0, 1.0), sensor)])  # f_m itself
    with_pupil = len(set(lengths_mm.tolist())) >= _FOR_PUPIL
    shortest = float(lengths_mm.min())

    def left(constants: NDArray[np.float64]) -> NDArray[np.float64]:
        distance, rows, columns, pupil = constants if with_pupil else (*constants, 2 - constants[1], 0.0)
        there = full * (1 - distance / (lengths_mm + pupil))[:, None] * np.array([rows, columns])
        return np.asarray((steps - there).ravel())

    count = 4 if with_pupil else 2
    start = [min(stated_mm, 0.98 * shortest), 1.0, 1.0, 0.0][:count]
    lowest = [0.0, 1 - _PRINTED, 1 - _PRINTED, -0.9 * shortest][:count]
    highest = [0.99 * shortest, 1 + _PRINTED, 1 + _PRINTED, 10 * shortest][:count]
    scales = [stated_mm, 1e-3, 1e-3, 1.0][:count]
    found = optimize.least_squares(left, start, bounds=(lowest, highest), x_scale=scales, ftol=1e-14, xtol=1e-14)
    rms = _rms(left(found.x).reshape(steps.shape), mask)
    distance, rows = float(found.x[0]), float(found.x[1])
    columns = float(found.x[2]) if with_pupil else 2 - rows
    return LawFit(
        "geometric",
        distance,
        rows / columns - 1,
        None,
        float(found.x[3]) if with_pupil else None,
        rms,
        _believed(distance, stated_mm, rms),
    )


def _rms(left_bins: NDArray[np.float64], mask: Mask) -> float:
    """Rms distance in bins over all carriers, from the residual of one step along rows and columns."""
    orders = np.array([order for order in mask.half_orders() if order != (0, 0)], dtype=np.float64)
    return float(np.sqrt(np.mean((left_bins[:, None, :] * orders[None]) ** 2) * 2))


def _believed(distance_mm: float, stated_mm: float, rms_bins: float) -> bool:
    return abs(distance_mm / stated_mm - 1) <= PLAUSIBLE and rms_bins <= EXPLAINED_BINS


def _ratio(scale: NDArray[np.float64]) -> float:
    return float(scale[0] / scale[1] - 1) if scale[1] else math.nan
