"""Solve a lens over a flight: bundle adjustment of points, poses and the one lens that took all frames.

The unknowns are the lens (distance to the sensor, principal point, k1, k2, p1, p2; k3 stays), each frame's shift and
turn (`Eye.moved`), and each point's place. What is known beforehand stands beside the sightings: the lens as given, the
poses by telemetry, measured places. So a value that the flight doesn't show keeps the sigma that it was given.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray
from scipy import sparse

from dappled.config.profiles import Lens
from dappled.decode.array_types import Floats
from dappled.products.maps.eye import Eye, distorted, turn

NAMES = ("v_mm", "principal x_mm", "principal y_mm", "k1", "k2", "p1", "p2")
_LENS = len(NAMES)
_STEPS = np.array([1e-5, 1e-5, 1e-5, 1e-4, 1e-3, 1e-5, 1e-5])  # of the lens, relative to v; for derivatives
_SHIFT_M, _TURN_RAD = 1e-3, 1e-6
_ROBUST = 2.0  # sigmas up to which a sighting has its full weight (Huber)
_INLIER = 4.0
_LEAST_PX = 0.02  # no picture is better than that
_FREE_M = 1000.0  # sigma of a place that nothing but its sightings tells
_ROUNDS = 6


@dataclass(frozen=True, slots=True, eq=False)
class Sightings:
    """`pixels` (n, 2) at which frames (n,) show points (n,), to `sigma_px`; `places` (m, 3) of the points on the map,
    known to `place_sigmas_m` (m,), inf where a place is only a first guess."""

    frames: NDArray[np.intp]
    points: NDArray[np.intp]
    pixels: Floats
    places: Floats
    place_sigmas_m: Floats
    sigma_px: float = 0.6


@dataclass(frozen=True, slots=True, eq=False)
class LensSolution:
    """The lens with the sigmas of `NAMES` (7,), the moved eyes, the points' places.

    `inliers` (n,) are the sightings that agree; `sigma_px` is their scatter along an axis, `before_px` the same with
    the lens as given.
    """

    lens: Lens
    sigmas: Floats
    eyes: tuple[Eye, ...]
    places: Floats
    inliers: NDArray[np.bool_]
    sigma_px: float
    before_px: float


@dataclass(frozen=True, slots=True, eq=False)
class _State:
    """`lens` (7,): v relative to the given one, principal point (x, y) as a share of v, then the distortion."""

    lens: Floats
    turns: Floats  # (frames, 3, 3)
    centres: Floats  # (frames, 3)
    places: Floats  # (points, 3)


@dataclass(frozen=True, slots=True, eq=False)
class _Given:
    seen: Sightings
    matrices: Floats  # (frames, 2, 2)
    middles: Floats  # (frames, 2)
    scales: Floats  # (frames, 3)
    k3: float
    used: NDArray[np.bool_]  # (sightings,)

    def pixels(self, lens: Floats, camera: Floats) -> Floats:
        """(n, 2) pixels of points (n, 3) in camera axes."""
        frames = self.seen.frames
        _, x, y, k1, k2, p1, p2 = lens
        bent = distorted(camera[:, :2] / camera[:, 2:], (k1, k2, p1, p2, self.k3)) * lens[0] + (x, y)
        return np.asarray(np.einsum("nij,nj->ni", self.matrices[frames], bent) + self.middles[frames])

    def ahead(self, state: _State) -> tuple[Floats, Floats]:
        """(n, 3) in grid axes, ground metres, and (n, 3) in camera axes."""
        frames = self.seen.frames
        apart = (state.places[self.seen.points] - state.centres[frames]) / self.scales[frames]
        return apart, np.einsum("nj,nji->ni", apart, state.turns[frames])


def solve(
    eyes: Sequence[Eye], lens: Lens, seen: Sightings, *, sigmas: Floats, lens_sigmas: Floats, iterations: int = 15
) -> LensSolution:
    """Solve by Levenberg and Marquardt from the given eyes, whose shifts (m) and turns (rad) have `sigmas` (frames, 6).

    `lens` is the one of all eyes; `lens_sigmas` (7,) are its values' own, as in `NAMES`. The sightings' scatter is
    estimated from their residuals, and sigmas go by it.
    """
    given = _Given(
        seen,
        np.array([eye.matrix[:2, :2] for eye in eyes]),
        np.array([eye.matrix[:2, 2] for eye in eyes]),
        np.array([(eye.scale, eye.scale, 1.0) for eye in eyes]),
        lens.distortion[4],
        np.ones(len(seen.frames), dtype=bool),
    )
    units = np.array([lens.v_mm] * 3 + [1.0] * 4)
    start = _State(
        np.array([1.0, 0.0, 0.0, *lens.distortion[:4]]),
        np.array([eye.rotation for eye in eyes]),
        np.array([eye.centre for eye in eyes]),
        seen.places.copy(),
    )
    prior = _Prior(start, lens_sigmas / units, sigmas, np.minimum(seen.place_sigmas_m, _FREE_M))
    _, before_px = _spread(given, _adjusted(given, start, prior, np.zeros(_LENS, dtype=bool), iterations))
    free = np.ones(_LENS, dtype=bool)
    state, sigma_px, inliers = start, seen.sigma_px, np.ones(len(seen.frames), dtype=bool)
    for _ in range(_ROUNDS):
        best = replace(given, seen=replace(seen, sigma_px=sigma_px), used=inliers)
        state = _adjusted(best, state, prior, free, iterations)
        inliers, found_px = _spread(given, state)
        settled = abs(found_px / sigma_px - 1) < 0.05
        sigma_px = found_px
        if settled:
            break
    best = replace(given, seen=replace(seen, sigma_px=sigma_px), used=inliers)
    variances = _variances(_normal(best, state, prior, free).reduced(0.0)[0])[:_LENS]
    variances = np.where(variances > 0, variances, prior.lens**2)  # where rounding leaves nothing, nothing is learnt
    v, x, y, k1, k2, p1, p2 = state.lens
    solved = Lens(
        lens.focal_length_mm,
        float(lens.v_mm * v),
        (lens.principal_point_mm[0] + float(lens.v_mm * y), lens.principal_point_mm[1] + float(lens.v_mm * x)),
        (float(k1), float(k2), float(p1), float(p2), lens.distortion[4]),
    )
    moved = tuple(_eye(eye, state.lens, solved, state.turns[n], state.centres[n]) for n, eye in enumerate(eyes))
    return LensSolution(solved, np.sqrt(variances) * units, moved, state.places, inliers, sigma_px, before_px)


def _variances(weights: Floats) -> Floats:
    """(q,) diagonal of the inverse of a symmetric (q, q) matrix."""
    units = 1 / np.sqrt(np.diag(weights))  # metres, radians and shares differ by many powers of ten
    return np.asarray(np.diag(np.linalg.inv(weights * np.outer(units, units))) * units**2)


def _eye(eye: Eye, lens: Floats, solved: Lens, rotation: Floats, centre: Floats) -> Eye:
    matrix = eye.matrix.copy()
    matrix[:2, 2] += matrix[:2, :2] @ lens[1:3]
    matrix[:2, :2] *= lens[0]
    return replace(eye, matrix=matrix, distortion=solved.distortion, rotation=rotation, centre=centre)


@dataclass(frozen=True, slots=True, eq=False)
class _Prior:
    start: _State
    lens: Floats  # (7,) sigmas, relative to v
    poses: Floats  # (frames, 6)
    places_m: Floats  # (points,)

    def steps(self, state: _State, scales: Floats) -> tuple[Floats, Floats, Floats]:
        """How far a state is from the start: lens (7,), poses (frames, 6), places (points, 3)."""
        shifts = (state.centres - self.start.centres) / scales
        back = np.einsum("nij,nkj->nik", state.turns, self.start.turns)
        turned = np.stack([back[:, 2, 1] - back[:, 1, 2], back[:, 0, 2] - back[:, 2, 0], back[:, 1, 0] - back[:, 0, 1]])
        poses = np.concatenate([shifts, turned.T / 2], axis=1)
        return state.lens - self.start.lens, poses, state.places - self.start.places


@dataclass(frozen=True, slots=True, eq=False)
class _Normal:
    """Normal equations: `outer` (q, q) of lens and poses, `inner` (points, 3, 3), `mixed` sparse (q, 3·points)."""

    outer: Floats
    inner: Floats
    mixed: sparse.csr_matrix
    outer_slope: Floats
    inner_slope: Floats
    cost: float

    def reduced(self, damping: float) -> tuple[Floats, Floats, sparse.csr_matrix]:
        """The matrix and right side without the points, and what leads from a step of the rest to the points'."""
        count = len(self.inner)
        own = self.inner + damping * self.inner * np.eye(3)
        blocks = sparse.bsr_matrix(
            (np.linalg.inv(own), np.arange(count), np.arange(count + 1)), shape=(3 * count, 3 * count)
        )
        across = (self.mixed @ blocks).tocsr()
        outer = self.outer + damping * np.diag(np.diag(self.outer))
        matrix = outer - np.asarray((across @ self.mixed.T).todense())
        return matrix, self.outer_slope - across @ self.inner_slope.ravel(), across

    def step(self, damping: float) -> tuple[Floats, Floats]:
        """Lens and poses (q,), points (points, 3)."""
        matrix, side, across = self.reduced(damping)
        outer = -np.asarray(np.linalg.solve(matrix, side), dtype=np.float64)
        own = self.inner + damping * self.inner * np.eye(3)
        alone = np.linalg.solve(own, self.inner_slope[..., None])[..., 0]
        return outer, np.asarray(-alone - (across.T @ outer).reshape(-1, 3), dtype=np.float64)


def _adjusted(given: _Given, state: _State, prior: _Prior, free: NDArray[np.bool_], iterations: int) -> _State:
    damping = 1e-4
    normal = _normal(given, state, prior, free)
    for _ in range(iterations):
        outer, inner = normal.step(damping)
        outer[:_LENS][~free] = 0.0
        tried = _moved(given, state, outer, inner)
        after = _normal(given, tried, prior, free)
        if after.cost > normal.cost * (1 + 1e-12):
            damping *= 10
            if damping > 1e6:
                break
            continue
        gained = normal.cost - after.cost
        state, normal, damping = tried, after, max(damping / 10, 1e-12)
        if gained < 1e-7 * max(1.0, normal.cost):
            break
    return state


def _moved(given: _Given, state: _State, outer: Floats, inner: Floats) -> _State:
    poses = outer[_LENS:].reshape(-1, 6)
    turns = np.array([turn(one[3:]) @ rotation for one, rotation in zip(poses, state.turns, strict=True)])
    return _State(state.lens + outer[:_LENS], turns, state.centres + poses[:, :3] * given.scales, state.places + inner)


def _normal(given: _Given, state: _State, prior: _Prior, free: NDArray[np.bool_]) -> _Normal:
    seen = given.seen
    count, frames, points = len(seen.frames), len(state.centres), len(state.places)
    apart, camera = given.ahead(state)
    here = given.pixels(state.lens, camera)
    residual = here - seen.pixels
    length = np.hypot(*residual.T) / seen.sigma_px
    ahead = np.isfinite(length) & (camera[:, 2] > 1e-9)
    usable = ahead & given.used
    length = np.where(usable, length, 0.0)
    weight = np.where(usable, np.minimum(1.0, _ROBUST / np.maximum(length, 1e-9)), 0.0) / seen.sigma_px**2
    jacobian = np.zeros((count, 2, _LENS + 9))
    for k in np.flatnonzero(free).tolist():
        nudged = state.lens.copy()
        nudged[k] += _STEPS[k]
        jacobian[:, :, k] = (given.pixels(nudged, camera) - here) / _STEPS[k]
    for k in range(3):
        step = np.eye(3)[k]
        along = state.turns[seen.frames][:, k, :]  # an axis of the grid in camera axes
        by_place = (given.pixels(state.lens, camera + _SHIFT_M * along) - here) / _SHIFT_M
        jacobian[:, :, _LENS + k] = -by_place
        jacobian[:, :, _LENS + 6 + k] = by_place / given.scales[seen.frames][:, None, k]
        turned = apart @ turn(_TURN_RAD * step)  # the inverse turn of row vectors
        spun = np.einsum("nj,nji->ni", turned, state.turns[seen.frames])
        jacobian[:, :, _LENS + 3 + k] = (given.pixels(state.lens, spun) - here) / _TURN_RAD
    jacobian[~usable] = 0.0
    residual = np.where(usable[:, None], residual, 0.0)
    lens_off, poses_off, places_off = prior.steps(state, given.scales)
    lens_weight = np.where(free, 1 / prior.lens**2, 1e30)
    pose_weight, place_weight = 1 / prior.poses**2, 1 / prior.places_m[:, None] ** 2
    q = _LENS + 6 * frames
    rows = np.repeat(np.arange(2 * count), _LENS + 6)
    at = np.concatenate(
        [np.tile(np.arange(_LENS), (count, 1)), _LENS + 6 * seen.frames[:, None] + np.arange(6)], axis=1
    )
    outer = sparse.csr_matrix(
        (jacobian[:, :, : _LENS + 6].ravel(), (rows, np.repeat(at, 2, axis=0).ravel())), shape=(2 * count, q)
    )
    at = 3 * seen.points[:, None] + np.arange(3)
    inner = sparse.csr_matrix(
        (jacobian[:, :, _LENS + 6 :].ravel(), (np.repeat(np.arange(2 * count), 3), np.repeat(at, 2, axis=0).ravel())),
        shape=(2 * count, 3 * points),
    )
    each = np.repeat(weight, 2)
    weighted = outer.T.multiply(each).tocsr()
    own = np.zeros((points, 3, 3))
    np.add.at(
        own, seen.points, np.einsum("nki,n,nkj->nij", jacobian[:, :, _LENS + 6 :], weight, jacobian[:, :, _LENS + 6 :])
    )
    flat = residual.ravel()
    outer_weight = np.concatenate([lens_weight, pose_weight.ravel()])
    outer_off = np.concatenate([np.where(free, lens_off, 0.0), poses_off.ravel()])
    huber = np.where(length <= _ROBUST, length**2, 2 * _ROBUST * length - _ROBUST**2)
    cost = float(huber[usable].sum() + (outer_weight * outer_off**2).sum() + (place_weight * places_off**2).sum())
    cost += float((given.used & ~ahead).sum()) * _INLIER**2 * 1e3  # a point that went behind a camera
    return _Normal(
        np.asarray((weighted @ outer).todense()) + np.diag(outer_weight),
        own + place_weight[:, :, None] * np.eye(3),
        (weighted @ inner).tocsr(),
        np.asarray(weighted @ flat) + outer_weight * outer_off,
        (inner.T @ (each * flat)).reshape(-1, 3) + place_weight * places_off,
        cost,
    )


def _spread(given: _Given, state: _State) -> tuple[NDArray[np.bool_], float]:
    """Which sightings agree, and their scatter along one axis in pixels, by the redundancy that points leave."""
    _, camera = given.ahead(state)
    away = np.hypot(*(given.pixels(state.lens, camera) - given.seen.pixels).T)
    away = np.where(np.isfinite(away) & (camera[:, 2] > 1e-9), away, np.inf)
    # of a normal scatter of two axes half lies within 1.177 sigmas
    scatter = max(float(np.median(away)) / 1.177, _LEAST_PX)
    good = np.asarray(away < _INLIER * scatter)
    each = np.bincount(given.seen.points[good])
    left = int(np.maximum(2 * each - 3, 0).sum()) - 6 * len(state.centres)  # telemetry and measured places leave more
    square = float((away[good] ** 2).sum())
    return good, max(float(np.sqrt(square / max(left, 1))), _LEAST_PX)
