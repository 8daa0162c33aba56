"""Refine poses against a base map, neighbouring frames, and measured control points.

Each frame is judged by itself. A frame with too little agreement keeps its recorded pose, and the report says why.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from dappled import codec
from dappled.decode.array_types import Floats
from dappled.errors import DappledError
from dappled.findings import FRAME, Code, Finding, finding
from dappled.products.maps import matching
from dappled.products.maps.adjust import Marks, Solution, Ties, adjust
from dappled.products.maps.eye import Eye
from dappled.products.maps.ground import Ground
from dappled.products.maps.map_grid import between, footprint, sample, smoothed_to
from dappled.products.maps.matching import Features
from dappled.products.maps.photographs import Photograph, pose_sigmas
from dappled.products.maps.references import BaseMap, ControlPoint

LEAST_INLIERS = 15
LEAST_SHARE = 0.25  # of the matches
_PLANE_PX = 6.0  # generous, as houses rise above the plane of the homography
_SIFT_PX = 0.6
_PATCH_PX = 0.4
_NODE = 3  # pixels between rays
_CLICK_PX = 0.5  # of a view: a control point that was marked by eye in the frame
_LEAST_SIGMA_M, _LEAST_SIGMA_RAD = 1.0, math.radians(0.5)  # a base map may overrule overconfident telemetry
_FARTHEST = 5.0  # sigmas


@dataclass(frozen=True, slots=True)
class Refinement:
    """The result for one frame: `why` it kept its recorded pose, or None; the sigma is that of the refined position."""

    matches: int
    inliers: int
    residual_px: float | None
    shift_m: float
    turn_deg: float
    position_sigma_m: float | None
    why: Finding | None

    def facts(self) -> dict[str, Any]:
        """The values for reports."""
        return {"refined": self.why is None, **codec.plain(self)}


@dataclass(frozen=True, slots=True)
class RefinedBy:
    """What poses are refined against. `search_m` is the distance over which the base map is searched; `sigmas` (m, rad)
    replace the recorded ones."""

    base: BaseMap | None = None
    neighbours: bool = False
    control: Sequence[ControlPoint] = ()
    search_m: float = 5.0
    sigmas: tuple[float, float] | None = None


def refine(
    photographs: Sequence[Photograph],
    ground: Ground,
    by: RefinedBy,
    progress: Callable[[str, int, int], None] = lambda *_: None,
) -> tuple[list[Photograph], list[Refinement]]:
    """Refine the photographs' eyes; returns the photographs and the result for each."""
    base = by.base
    doubts = _doubts(photographs, by.sigmas, loose=base is not None or bool(by.control))
    found = matching.of_all([one.image for one in photographs], progress)
    groups: list[Marks | Ties] = []
    tried = np.zeros(len(photographs), dtype=int)
    if base is not None:
        for number, (one, seen) in enumerate(zip(photographs, found, strict=True)):
            progress("match base map", number, len(photographs))
            marks, matches = _to_base(number, one, seen, base=base, ground=ground, search_m=by.search_m)
            tried[number] += matches
            groups += [] if marks is None else [marks]
    if by.neighbours:
        for pair in matching.neighbours(len(photographs), progress):
            ties, matches = _to_neighbour(pair, photographs, found, ground, float(np.max(doubts[[*pair], :3])))
            tried[[*pair]] += matches
            groups += [] if ties is None else [ties]
    groups += _to_control(photographs, by.control)
    eyes = [one.eye for one in photographs]
    solution = adjust(eyes, groups, ground, sigmas=doubts)
    if base is not None:
        groups = _closer(photographs, groups, solution, base, ground)
        solution = adjust(eyes, groups, ground, sigmas=doubts)
    judged = [_judge(number, groups, solution, tried=int(tried[number]), doubts=doubts) for number in range(len(eyes))]
    better = [
        replace(one, eye=eye) if said.why is None else one
        for one, eye, said in zip(photographs, solution.eyes, judged, strict=True)
    ]
    return better, judged


def _to_base(
    number: int, one: Photograph, seen: Features, *, base: BaseMap, ground: Ground, search_m: float
) -> tuple[Marks | None, int]:
    met = footprint(one.eye, ground)
    window = base.window(met[:, :2], search_m * one.eye.scale)
    if window is None:
        return None, 0
    picture, grid = window
    there = matching.features(picture)
    pairs = matching.matched(seen, there)
    if not len(pairs):
        return None, 0
    pixels = seen.pixels[pairs[:, 0]]
    at = there.pixels[pairs[:, 1]]
    east = grid.west + (at[:, 0] + 0.5) * grid.step_x
    north = grid.north - (at[:, 1] + 0.5) * grid.step_y
    places = np.stack([east, north, ground.heights(east, north)], axis=1)
    predicted = one.eye.on_plane(pixels, np.nanmedian(met[:, 2]))
    near = np.hypot(*(predicted - places[:, :2]).T) < 2 * search_m * one.eye.scale
    near &= np.isfinite(places).all(axis=1)
    good = np.flatnonzero(near)
    good = good[matching.on_one_plane(pixels[good], at[good], _PLANE_PX)]
    if not len(good):
        return None, len(pairs)
    coarse = max(1.0, grid.step_x / one.eye.scale / one.eye.gsd_m(float(np.nanmedian(met[:, 2]))))
    return (
        Marks(number, pixels[good], places[good], _SIFT_PX * coarse, ground.sigma_m, ground.sigma_m),
        int(near.sum()),
    )


def _closer(
    photographs: Sequence[Photograph],
    groups: Sequence[Marks | Ties],
    solution: Solution,
    base: BaseMap,
    ground: Ground,
) -> list[Marks | Ties]:
    """Replace each group of features on the base map that stayed consistent with many patches of the frame, which are
    found in the base map as the adjusted eye would see it."""
    made: list[Marks | Ties] = []
    for group, inside in zip(groups, solution.inliers, strict=True):
        if isinstance(group, Ties) or group.by_hand or int(inside.sum()) < LEAST_INLIERS:
            made.append(group)
            continue
        one, eye = photographs[group.frame], solution.eyes[group.frame]
        marks = _patches(group, one, eye, base, ground)
        made.append(group if marks is None else marks)
    return made


def _patches(group: Marks, one: Photograph, eye: Eye, base: BaseMap, ground: Ground) -> Marks | None:
    rows, columns = eye.shape
    # Rays at every few pixels, and linear interpolation between them; the patches' own hits below are exact.
    at_x, at_y = (np.linspace(0, side - 1, max(2, side // _NODE)) for side in (columns, rows))
    met = ground.meet(eye, np.stack(np.meshgrid(at_x, at_y), axis=-1).reshape(-1, 2))
    if not np.isfinite(met).all():
        return None
    window = base.window(met[:, :2], 1.0)
    if window is None:
        return None
    picture, grid = window
    nodes = (met[:, 0] - grid.west) / grid.step_x - 0.5, (grid.north - met[:, 1]) / grid.step_y - 0.5
    down, aside = between(np.arange(rows, dtype=float), at_y), between(np.arange(columns, dtype=float), at_x)
    at = np.stack([down @ node.reshape(len(at_y), len(at_x)) @ aside.T for node in nodes], axis=-1)
    picture = smoothed_to(np.nan_to_num(picture), eye.gsd_m(float(np.median(met[:, 2]))) * eye.scale / grid.step_x)
    seen = sample(picture[..., None], at)[..., 0]
    places, shifts = matching.nudges(one.image, seen)
    if len(places) < 2 * LEAST_INLIERS:
        return None
    # the frame's patch at `places` shows what the adjusted eye expects at places + shifts
    hit = ground.meet(eye, places + shifts)
    good = np.isfinite(hit).all(axis=1)
    return Marks(group.frame, places[good], hit[good], _PATCH_PX, group.height_sigma_m, group.level_sigma_m)


def _to_neighbour(
    which: tuple[int, int],
    photographs: Sequence[Photograph],
    found: Sequence[Features],
    ground: Ground,
    position_sigma_m: float,
) -> tuple[Ties | None, int]:
    number, other = which
    a, b = photographs[number], photographs[other]
    first, second = footprint(a.eye, ground)[:, :2], footprint(b.eye, ground)[:, :2]
    spare = 0.2 * float(np.ptp(first, axis=0).max())
    if (first.max(axis=0) + spare < second.min(axis=0)).any() or (second.max(axis=0) + spare < first.min(axis=0)).any():
        return None, 0
    pairs = matching.matched(found[number], found[other])
    here, there = found[number].pixels[pairs[:, 0]], found[other].pixels[pairs[:, 1]]
    good = matching.on_one_plane(here, there, 2 * _PLANE_PX)
    if int(good.sum()) < LEAST_INLIERS:
        return None, len(pairs)
    rough = math.hypot(ground.sigma_m, _roughness_m(ground, first, position_sigma_m))
    return Ties(number, other, here[good], there[good], _SIFT_PX, rough, rough), len(pairs)


def _roughness_m(ground: Ground, places: Floats, aside_m: float) -> float:
    """The rms change of the ground model's height at a distance `aside_m`: the uncertainty of a frame's ground that
    follows from the frame's uncertain position."""
    axis = np.linspace(0, 1, 12)
    low, high = places.min(axis=0), places.max(axis=0)
    east, north = np.meshgrid(low[0] + axis * (high[0] - low[0]), low[1] + axis * (high[1] - low[1]))
    here = ground.heights(east, north)
    steps = [
        ground.heights(east + e * aside_m, north + n * aside_m) - here for e, n in ((1, 0), (-1, 0), (0, 1), (0, -1))
    ]
    known = np.concatenate([step[np.isfinite(step)] for step in steps])
    return float(np.sqrt(np.mean(known**2))) if len(known) else 0.0


def _to_control(photographs: Sequence[Photograph], control: Sequence[ControlPoint]) -> list[Marks | Ties]:
    numbers = {one.name: number for number, one in enumerate(photographs)}
    for point in control:
        if point.frame not in numbers:
            raise DappledError(f"control point {point.name} names frame {point.frame}, which is not among those mapped")
    groups: list[Marks | Ties] = []
    for name, number in numbers.items():
        mine = [point for point in control if point.frame == name]
        if mine:
            pixels = photographs[number].at(np.array([point.pixel for point in mine]))
            places = np.array([point.place for point in mine])
            groups.append(Marks(number, pixels, places, _CLICK_PX, 0.02, 1e-6, by_hand=True))
    return groups


def _doubts(photographs: Sequence[Photograph], sigmas: tuple[float, float] | None, *, loose: bool) -> Floats:
    both = pose_sigmas(photographs, sigmas)
    if loose and sigmas is None:
        both = np.maximum(both, (_LEAST_SIGMA_M, _LEAST_SIGMA_RAD))
    return np.repeat(np.maximum(both, (1e-3, 1e-5)), 3, axis=1)


def _judge(
    number: int, groups: Sequence[Marks | Ties], solution: Solution, *, tried: int, doubts: Floats
) -> Refinement:
    inliers, given, residuals, clicked = 0, 0, [], False
    for group, inside, residual in zip(groups, solution.inliers, solution.residuals_px, strict=True):
        which = (group.frame,) if isinstance(group, Marks) else (group.first, group.second)
        if number in which:
            inliers, given = inliers + int(inside.sum()), given + len(inside)
            residuals += [] if residual is None else [residual]
            clicked |= isinstance(group, Marks) and group.by_hand
    change = solution.changes[number]
    shift, turned = float(np.linalg.norm(change[:3])), math.degrees(float(np.linalg.norm(change[3:])))
    sigma = None if solution.sigmas is None else float(np.linalg.norm(solution.sigmas[number, :2]))
    residual = max(residuals) if residuals else None
    why = None
    if not given:
        why = finding(Code.POSE_UNMATCHED if tried else Code.POSE_NO_OVERLAP, FRAME)
    elif not clicked and inliers < LEAST_INLIERS:
        why = finding(Code.POSE_FEW_POINTS, FRAME, inliers=inliers, needed=LEAST_INLIERS)
    elif not clicked and inliers < LEAST_SHARE * given:
        why = finding(Code.POSE_POINTS_DISAGREE, FRAME, inliers=inliers, given=given)
    elif (np.abs(change) > _FARTHEST * doubts[number]).any():
        why = finding(Code.POSE_RULED_OUT, FRAME, shift_m=shift, turn_deg=turned)
    return Refinement(tried, inliers, residual, shift, turned, sigma, why)
