"""Bundle adjustment of a strip: least squares over the eyes' poses, known places, and the telemetry's sigmas.

The unknowns are each eye's shift and turn (`Eye.moved`) and, for each group of observations, how much higher the ground
is than its model. A residual is in pixels; its covariance is the pixel's own plus the effect of the ground's unknown
height along the ray's shadow in the picture. So flat ground under houses is trusted more across the flight line than
along it, and heights need not be solved for.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy import sparse

from dappled.decode.array_types import Floats
from dappled.products.maps.eye import Eye
from dappled.products.maps.ground import Ground

_ITERATIONS = 20  # at most
_ROBUST = 2.0  # sigmas up to which an observation has its full weight (Huber)
_INLIER = 3.0
_STEPS = np.array([1e-3, 1e-3, 1e-3, 1e-5, 1e-5, 1e-5])  # metres, radians: for derivatives
_DENSE = 3000  # unknowns up to which sigmas are computed


@dataclass(frozen=True, slots=True, eq=False)
class Marks:
    """Known places (n, 3) on the map that frame `frame` shows at `pixels` (n, 2), to `sigma_px`.

    `height_sigma_m` is that of each place's own height, `level_sigma_m` that of the height they have in common.
    `by_hand`: they were measured by hand.
    """

    frame: int
    pixels: Floats
    places: Floats
    sigma_px: float
    height_sigma_m: float
    level_sigma_m: float
    by_hand: bool = False


@dataclass(frozen=True, slots=True, eq=False)
class Ties:
    """Ground that frame `first` shows at `pixels_first` (n, 2) and frame `second` at `pixels_second`."""

    first: int
    second: int
    pixels_first: Floats
    pixels_second: Floats
    sigma_px: float
    height_sigma_m: float
    level_sigma_m: float


@dataclass(frozen=True, slots=True, eq=False)
class Solution:
    """The adjusted eyes. `changes` (n, 6) from the given eyes, as `Eye.moved` takes them; `sigmas` (n, 6) of the
    adjusted poses, None for a strip that is too long. `inliers` and `residuals_px` (rms of the inliers; None without
    any) by group, in the given order."""

    eyes: tuple[Eye, ...]
    changes: Floats
    sigmas: Floats | None
    inliers: tuple[NDArray[np.bool_], ...]
    residuals_px: tuple[float | None, ...]


def adjust(
    eyes: Sequence[Eye],
    groups: Sequence[Marks | Ties],
    ground: Ground,
    *,
    sigmas: Floats,
) -> Solution:
    """Adjust by Gauss-Newton from the given eyes, with `sigmas` (n, 6) of their shifts (m) and turns (rad)."""
    from scipy.sparse.linalg import spsolve  # noqa: PLC0415  # an eighth of the start of verbs that adjust nothing

    given = list(eyes)
    count = len(given)
    changes = np.zeros((count, 6))
    levels = np.zeros(len(groups))
    unknown = 6 * count + len(groups)
    prior = np.concatenate([1 / sigmas.ravel() ** 2, [1 / max(group.level_sigma_m, 1e-6) ** 2 for group in groups]])
    moved = list(given)
    normal = sparse.diags(prior).tocsc()
    for _ in range(_ITERATIONS):
        rows, columns, values = [], [], []
        gradient = prior * np.concatenate([changes.ravel(), levels])
        for number, group in enumerate(groups):
            seen = _seen(group, moved, ground, levels[number])
            if seen is None:
                continue
            residual, jacobian, weight, which = seen
            places = np.concatenate([*(6 * frame + np.arange(6) for frame in which), [6 * count + number]])
            block = np.einsum("nij,nik,nkl->jl", jacobian, weight, jacobian)
            gradient[places] += np.einsum("nij,nik,nk->j", jacobian, weight, residual)
            rows.append(np.repeat(places, len(places)))
            columns.append(np.tile(places, len(places)))
            values.append(block.ravel())
        normal = sparse.diags(prior).tocsc()
        if rows:
            at = np.concatenate(rows), np.concatenate(columns)
            normal = normal + sparse.csc_matrix((np.concatenate(values), at), shape=(unknown, unknown))
        step = -np.asarray(spsolve(normal.tocsc(), gradient)).reshape(-1)
        changes += step[: 6 * count].reshape(count, 6)
        levels += step[6 * count :]
        moved = [eye.moved(change) for eye, change in zip(given, changes, strict=True)]
        if np.abs(step).max(initial=0.0) < 1e-7:
            break
    inside, residuals = [], []
    for number, group in enumerate(groups):
        good, residual_px = _judged(group, moved, ground, levels[number])
        inside.append(good)
        residuals.append(residual_px)
    left = None
    if unknown <= _DENSE:
        left = np.sqrt(np.diag(np.linalg.inv(normal.toarray()))[: 6 * count]).reshape(count, 6)
    return Solution(tuple(moved), changes, left, tuple(inside), tuple(residuals))


def _seen(
    group: Marks | Ties, eyes: Sequence[Eye], ground: Ground, level: float
) -> tuple[Floats, Floats, Floats, tuple[int, ...]] | None:
    """(residuals (n, 2), derivatives (n, 2, 6·frames + 1), weights (n, 2, 2), frames) of the visible observations."""
    residual, slope, heights = _residual(group, eyes, ground, level)
    usable = np.isfinite(residual).all(axis=1) & np.isfinite(slope).all(axis=1)
    if not usable.any():
        return None
    which = (group.frame,) if isinstance(group, Marks) else (group.first, group.second)
    parts = []
    for frame in which:
        for unknown in range(6):
            nudge = np.zeros(6)
            nudge[unknown] = _STEPS[unknown]
            nudged = list(eyes)
            nudged[frame] = eyes[frame].moved(nudge)
            parts.append((_at(group, nudged, heights) - _at(group, eyes, heights)) / _STEPS[unknown])
    jacobian = np.stack([*parts, slope], axis=2)[usable]
    weight = _weights(group, slope[usable])
    distance = np.sqrt(np.einsum("ni,nij,nj->n", residual[usable], weight, residual[usable]))
    weight *= np.minimum(1.0, _ROBUST / np.maximum(distance, 1e-9))[:, None, None]
    return residual[usable], jacobian, weight, which


def _judged(
    group: Marks | Ties, eyes: Sequence[Eye], ground: Ground, level: float
) -> tuple[NDArray[np.bool_], float | None]:
    residual, slope, _ = _residual(group, eyes, ground, level)
    weight = _weights(group, np.nan_to_num(slope))
    distance = np.sqrt(np.einsum("ni,nij,nj->n", residual, weight, residual))
    good = np.asarray(distance < _INLIER)  # NaN is not
    if not good.any():
        return good, None
    own = 1.0 if isinstance(group, Marks) else np.sqrt(2.0)
    return good, float(np.sqrt(np.mean(distance[good] ** 2) / 2) * group.sigma_px * own)


def _residual(group: Marks | Ties, eyes: Sequence[Eye], ground: Ground, level: float) -> tuple[Floats, Floats, Floats]:
    """(residual (n, 2) px, its derivative by the ground's height (n, 2), the heights (n,))."""
    if isinstance(group, Marks):
        heights = group.places[:, 2] + level
    else:
        heights = ground.meet(eyes[group.first], group.pixels_first)[:, 2] + level
    here = _at(group, eyes, heights)
    raised = _at(group, eyes, heights + 0.01)
    wanted = group.pixels if isinstance(group, Marks) else group.pixels_second
    return here - wanted, (raised - here) / 0.01, heights


def _at(group: Marks | Ties, eyes: Sequence[Eye], heights: Floats) -> Floats:
    """(n, 2): where the frame (of ties, the second) shows the group's ground at these heights."""
    if isinstance(group, Marks):
        return eyes[group.frame].project(np.concatenate([group.places[:, :2], heights[:, None]], axis=1))
    places = eyes[group.first].on_plane(group.pixels_first, heights)
    return eyes[group.second].project(np.concatenate([places, heights[:, None]], axis=1))


def _weights(group: Marks | Ties, slope: Floats) -> Floats:
    """(n, 2, 2): the inverse of σ²·1 + σ_h²·g·gᵀ (Sherman and Morrison)."""
    own = group.sigma_px**2 * (1 if isinstance(group, Marks) else 2)
    outer = slope[:, :, None] * slope[:, None, :] * group.height_sigma_m**2
    length = (slope**2).sum(axis=1) * group.height_sigma_m**2
    return np.asarray((np.eye(2) - outer / (own + length)[:, None, None]) / own)
