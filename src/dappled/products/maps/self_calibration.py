"""Find the lens of a flight from its own frames: points that several frames show, control points, telemetry."""

from __future__ import annotations

import math
from collections import defaultdict
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from dappled import codec
from dappled.config.profiles import Lens
from dappled.decode.array_types import Floats
from dappled.errors import DappledError, counted
from dappled.findings import Code, Finding, Subject, finding
from dappled.products.maps import hyperstereo, lens_solution, map_grid, matching
from dappled.products.maps.ground import Ground
from dappled.products.maps.lens_solution import NAMES, LensSolution, Sightings
from dappled.products.maps.photographs import Photograph, pose_sigmas
from dappled.products.maps.references import ControlPoint

_PLANE_PX = 12.0  # generous, as houses rise above the plane of the homography
_LEAST_FRAMES, _LEAST_POINTS, _LEAST_MATCHES = 2, 60, 15
_V_SHARE, _POINT_SHARE = 0.05, 0.02  # sigmas of the lens as given, as a share of v
_BENT = 0.02  # of the way to a view's corner: the most that distortion is expected to move it there
_CONTROL_SIGMA_M = 0.02
_LEAST_SIGMA_M = 1e-3
_MOUNT_SIGMA_RAD = math.radians(
    1
)  # an error of the mount is common to all frames, so telemetry's own sigma is not enough
_KNOWN = 0.5  # a value is told by the flight where its sigma is less than this share of the one before
_FARTHEST = 4.0  # sigmas of the lens as given


@dataclass(frozen=True, slots=True, eq=False)
class FlightLens:
    """The lens of a flight; `told` (7,) says which of `lens_solution.NAMES` the flight told,
    `doubts` which it did not."""

    before: Lens
    solution: LensSolution
    points: int
    sightings: int
    control: int
    doubts: tuple[Finding, ...]

    @property
    def lens(self) -> Lens:
        """The lens as the flight told it."""
        return self.solution.lens

    def words(self) -> list[str]:
        """Lines for a person."""
        said, value, sigma = self.solution, _values(self.lens), self.solution.sigmas
        seen = f"{counted(self.points, 'point')} in {counted(self.sightings, 'sighting')}"
        seen += f", {counted(self.control, 'control point')}" if self.control else ""
        middle = f"{value[2]:+.3f} ± {sigma[2]:.3f}, {value[1]:+.3f} ± {sigma[1]:.3f} mm"
        return [
            f"lens by {seen}: they agree to {said.sigma_px:.2f} px (with the lens as given: {said.before_px:.2f} px)",
            f"v = {value[0]:.3f} ± {sigma[0]:.3f} mm at {self.lens.focal_length_mm:g} mm, principal point {middle}",
            "k1, k2, p1, p2 = " + ", ".join(f"{value[n]:.3g} ± {sigma[n]:.1g}" for n in range(3, 7)),
        ]

    def facts(self) -> dict[str, Any]:
        """The values for reports."""
        found, before = _values(self.lens), _values(self.before)
        return {
            "focal_length_mm": self.lens.focal_length_mm,
            "values": {
                name: {"value": float(found[n]), "sigma": float(self.solution.sigmas[n]), "before": float(before[n])}
                for n, name in enumerate(NAMES)
            },
            "points": self.points,
            "sightings": self.sightings,
            "control_points": self.control,
            "scatter_px": self.solution.sigma_px,
            "scatter_before_px": self.solution.before_px,
            "doubts": codec.plain(self.doubts),
        }


def find(
    photographs: Sequence[Photograph],
    ground: Ground,
    *,
    control: Sequence[ControlPoint] = (),
    sigmas: tuple[float, float] | None = None,
    progress: Callable[[str, int, int], None] = lambda *_: None,
) -> FlightLens:
    """The lens that took all photographs. `sigmas` (m, rad) replace those of the recorded poses.

    Raises DappledError where the frames are of several focal lengths, show too little in common, or don't tell
    the lens' distance.
    """
    lens = _one_lens(photographs)
    seen = sightings(photographs, ground, control, progress)
    corner = max(float(np.hypot(*_flat(one).T).max()) for one in photographs)
    bent = _BENT / corner**2
    lens_sigmas = np.array(
        [_V_SHARE * lens.v_mm, *2 * [_POINT_SHARE * lens.v_mm], bent, bent / corner**2, *2 * [_BENT / corner / 3]]
    )
    solution = lens_solution.solve(
        [one.eye for one in photographs], lens, seen, sigmas=_pose_sigmas(photographs, sigmas), lens_sigmas=lens_sigmas
    )
    told = solution.sigmas < _KNOWN * lens_sigmas
    if not told[0]:
        raise DappledError(
            f"the flight doesn't tell the lens' distance (± {solution.sigmas[0]:.2g} mm): it needs control points, "
            "frames from several heights, or tilted ones"
        )
    change = np.abs(_values(solution.lens) - _values(lens)) / lens_sigmas
    if (change > _FARTHEST).any():
        name = NAMES[int(np.argmax(change))]
        raise DappledError(
            f"the flight's frames and the lens disagree by more than a lens can be wrong ({name}): are mount, "
            "--focal-length and the telemetry's σ right?"
        )
    doubts = [finding(Code.LENS_UNTOLD, Subject("lens"), name=name) for name, known in zip(NAMES, told, strict=True)
              if not known]  # fmt: skip
    good = solution.inliers
    points = len(np.unique(seen.points[good]))
    named = len({point.name for point in control})
    return FlightLens(lens, solution, points, int(good.sum()), named, tuple(doubts))


def with_lens(photographs: Sequence[Photograph], found: FlightLens) -> list[Photograph]:
    """The photographs with the lens found, and the eyes that were moved with it."""
    return [replace(one, eye=eye, lens=found.lens) for one, eye in zip(photographs, found.solution.eyes, strict=True)]


def check(photographs: Sequence[Photograph], ground: Ground) -> None:
    """Raise DappledError where poses alone tell that no two frames show the same ground."""
    lowest = min(float(map_grid.footprint(one.eye, ground)[:, 2].min()) for one in photographs)
    if not hyperstereo.meet(photographs, lowest):
        raise _few(0)


def _few(points: int) -> DappledError:
    return DappledError(
        f"neighbouring frames have {points} points in common, and a lens needs {_LEAST_POINTS}: fly with more overlap"
    )


def sightings(
    photographs: Sequence[Photograph],
    ground: Ground,
    control: Sequence[ControlPoint],
    progress: Callable[[str, int, int], None],
) -> Sightings:
    """Features that two or more frames show, and control points. Raises DappledError for too few."""
    found = matching.of_all([one.image for one in photographs], progress)
    joined = _Joined()
    for number, other in matching.neighbours(len(photographs), progress):
        pairs = matching.matched(found[number], found[other])
        good = matching.on_one_plane(found[number].pixels[pairs[:, 0]], found[other].pixels[pairs[:, 1]], _PLANE_PX)
        if good.sum() < _LEAST_MATCHES:  # so few agree by chance
            continue
        for a, b in pairs[good]:
            joined.join((number, int(a)), (other, int(b)))
    frames, points = list[int](), list[int]()
    pixels, places, place_sigmas = list[Floats](), list[Floats](), list[float]()
    for track in joined.tracks():
        first, feature = track[0]
        met = ground.meet(photographs[first].eye, found[first].pixels[feature][None])[0]
        if not np.isfinite(met).all():
            continue
        for frame, feature in track:
            frames.append(frame)
            points.append(len(places))
            pixels.append(found[frame].pixels[feature])
        places.append(met)
        place_sigmas.append(np.inf)
    if len(places) < _LEAST_POINTS:
        raise _few(len(places))
    numbers = {one.name: number for number, one in enumerate(photographs)}
    by_name = defaultdict(list)
    for point in control:
        by_name[point.name].append(point)
    for same in by_name.values():
        for point in same:
            frames.append(numbers[point.frame])
            points.append(len(places))
            pixels.append(photographs[numbers[point.frame]].at(np.array([point.pixel]))[0])
        places.append(np.array(same[0].place))
        place_sigmas.append(_CONTROL_SIGMA_M)
    return Sightings(
        np.array(frames, dtype=np.intp), np.array(points, dtype=np.intp), np.array(pixels), np.array(places),
        np.array(place_sigmas),
    )  # fmt: skip


class _Joined:
    """Features that were matched with each other, over any number of frames."""

    def __init__(self) -> None:
        self._up: dict[tuple[int, int], tuple[int, int]] = {}

    def join(self, a: tuple[int, int], b: tuple[int, int]) -> None:
        self._up[self._root(a)] = self._root(b)

    def tracks(self) -> list[list[tuple[int, int]]]:
        """(frame, feature) of each point; without those that are at two places of one frame."""
        groups = defaultdict(list)
        for one in sorted(self._up):
            groups[self._root(one)].append(one)
        return [group for group in groups.values() if len({frame for frame, _ in group}) == len(group)]

    def _root(self, one: tuple[int, int]) -> tuple[int, int]:
        self._up.setdefault(one, one)
        while self._up[one] != one:
            self._up[one] = one = self._up[self._up[one]]
        return one


def _one_lens(photographs: Sequence[Photograph]) -> Lens:
    if len(photographs) < _LEAST_FRAMES:
        raise DappledError(f"a lens is found from {_LEAST_FRAMES} frames or more, not {len(photographs)}")
    lenses = {one.lens for one in photographs}
    if len(lenses) != 1 or None in lenses:
        lengths = ", ".join(sorted({f"{one.focal_length_mm:g}" for one in lenses if one is not None}))
        raise DappledError(f"the frames are of several focal lengths ({lengths} mm): choose with --frames")
    lens = lenses.pop()
    assert lens is not None
    return lens


def _values(lens: Lens) -> Floats:
    y, x = lens.principal_point_mm
    return np.array([lens.v_mm, x, y, *lens.distortion[:4]])


def _flat(one: Photograph) -> Floats:
    """(4, 2): a view's corners on the plane at distance 1."""
    eye = one.eye
    return np.asarray((eye.corners() - eye.matrix[:2, 2]) @ np.linalg.inv(eye.matrix[:2, :2]).T)


def _pose_sigmas(photographs: Sequence[Photograph], sigmas: tuple[float, float] | None) -> Floats:
    position, attitude = pose_sigmas(photographs, sigmas).T
    both = np.stack([np.maximum(position, _LEAST_SIGMA_M), np.hypot(attitude, _MOUNT_SIGMA_RAD)], axis=1)
    return np.repeat(both, 3, axis=1)
