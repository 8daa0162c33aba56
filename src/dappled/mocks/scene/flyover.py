"""Render the landscape as the vehicle's camera sees it: down in body axes, the picture's top towards the nose."""

from __future__ import annotations

import math
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray
from scipy import ndimage

from dappled.decode.array_types import Singles
from dappled.decode.geometry import Quaternion
from dappled.mocks.autopilot.path import TruePose
from dappled.mocks.scene import landscape
from dappled.mocks.scene.landscape import TEXEL_M, Landscape
from dappled.mocks.scene.lens import Rays, Rendering

MARCH_STEP_M = 0.3
THREADS = 2


def rotation(attitude: Quaternion) -> NDArray[np.float64]:
    """(3, 3) from body (forward, right, down) to north-east-down."""
    w, x, y, z = attitude
    return np.array(
        [
            [1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)],
            [2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)],
            [2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)],
        ]
    )


@dataclass(frozen=True, slots=True)
class TerrainScene:
    """The landscape as a scene. Where `sharp`, only every second ray of each axis is followed to the ground; the others
    meet it between their neighbours."""

    ground: Landscape
    sharp: bool = False

    @classmethod
    def of(cls, seed: int, finest_period_m: float = 0.037, *, sharp: bool = False) -> TerrainScene:
        """The landscape of a seed; nothing in its fine texture is finer than `finest_period_m` (metres a cycle)."""
        return cls(landscape.build(seed, finest_period_m, sharp=sharp), sharp)

    @property
    def mean_radiance(self) -> float:
        """Mean over the whole landscape: exposure does not jump from frame to frame."""
        return self.ground.mean_radiance

    @property
    def headroom(self) -> float:
        """Brightest surface over the mean."""
        return landscape.HEADROOM

    def render(self, rays: Rays, pose: TruePose | None) -> Rendering:
        """The ground along the rays.

        The centre ray of each sample is followed to the ground; the other aperture points' rays meet the plane that
        touches the ground there (apertures are millimetres, slopes decimetres). Raises ValueError without a pose, or
        where the horizon is in the picture.
        """
        if pose is None:
            raise ValueError("a scene of terrain needs a path of the camera")
        hits = _hits_between(self.ground, rays, pose) if self.sharp else _centre_hits(self.ground, rays, pose)
        surface = _Surface.under(self.ground, hits)
        radiance = np.empty((len(rays.aperture_mm), 3, len(rays.y_mm), len(rays.x_mm)), dtype=np.float32)

        def one(number: int) -> None:
            theta = (rays.aperture_mm[number] * 1e-3).astype(np.float32)
            at = np.empty((2, *hits.row.shape), dtype=np.float32)
            for axis, place, per_m in ((0, hits.row, hits.row_per_m), (1, hits.column, hits.column_per_m)):
                np.multiply(per_m[0], theta[0], out=at[axis])
                at[axis] += place
                at[axis] += per_m[1] * theta[1]
            surface.look(at, radiance[number])

        with ThreadPoolExecutor(THREADS) as pool:
            list(pool.map(one, range(len(rays.aperture_mm))))
        return Rendering(radiance, hits.depth_m)


@dataclass(frozen=True, slots=True)
class _Surface:
    """The part of the ground that is in the picture, its colours (3, rows, columns) at the detail map's texel, and the
    landscape's indices (row, column) of its first texel; `finer` of its texels are one of the landscape's."""

    colours: Singles
    corner: tuple[int, int]
    finer: int

    @classmethod
    def under(cls, ground: Landscape, hits: _Hits) -> _Surface:
        finer = round(TEXEL_M / ground.detail_texel_m)
        corner, texels = [], []
        for place in (hits.row, hits.column):
            first, last = math.floor(float(place.min())) - 2, math.ceil(float(place.max())) + 2
            corner.append(first)
            texels.append(np.arange(first, last + 1) % len(ground.relief))
        part = np.ix_(*texels)
        fine = (np.arange(at * finer, (at + len(along) - 1) * finer) for at, along in zip(corner, texels, strict=True))
        detail = ground.detail[np.ix_(*(i % len(ground.detail) for i in fine))]
        texture = _finer(ground.roughness[part], finer)
        texture *= detail
        texture += 1
        colours = np.stack([_finer(albedo[part], finer) for albedo in ground.albedo])
        colours *= texture
        return cls(colours, (corner[0], corner[1]), finer)

    def look(self, at: Singles, out: Singles) -> None:
        """Colours (3, h, w) at (2, h, w) landscape indices, which are used up."""
        at -= np.array(self.corner, dtype=np.float32)[:, None, None]
        at *= np.float32(self.finer)
        for plane, colour in zip(out, self.colours, strict=True):
            ndimage.map_coordinates(colour, at, output=plane, order=1, mode="nearest", prefilter=False)


@dataclass(frozen=True, slots=True)
class _Hits:
    """Where centre rays meet the ground, in map texels, and how the place moves for each metre of aperture (y, x)."""

    depth_m: Singles
    row: Singles
    column: Singles
    row_per_m: tuple[Singles, Singles]
    column_per_m: tuple[Singles, Singles]


def _centre_hits(ground: Landscape, rays: Rays, pose: TruePose) -> _Hits:
    turn = rotation(pose.attitude)
    north0, east0, down0 = pose.position_ned_m
    y, x = (rays.y_mm / rays.v_mm)[:, None], (rays.x_mm / rays.v_mm)[None, :]
    north, east, down = ((-r[0] * y + r[1] * x + r[2]).astype(np.float32) for r in turn)  # per metre of depth
    if float(down.min()) < 0.2:
        raise ValueError("the simulated camera looks at the horizon: the flight path tilts too far")

    home = np.float32(len(ground.relief) // 2)

    def relief(depth: Singles, d_north: float = 0.0, d_east: float = 0.0) -> Singles:
        at = np.stack([-(north0 + d_north + north * depth), east0 + d_east + east * depth])
        return _look(ground.relief, at / np.float32(TEXEL_M) + home)

    def above(depth: Singles) -> Singles:
        return np.asarray(-(np.float32(down0) + down * depth) - relief(depth))

    # March from the level of the highest ground to the lowest's, keeping the last depth above and the first below.
    low, high = _relief_range(ground, pose, north, east, down)
    first, last = (-high - down0) / down, (-low - down0) / down
    if float(first.min()) <= 0:
        raise ValueError(f"the vehicle at {-down0:.1f} m flies into the ground (highest {high:.1f} m)")
    steps = max(4, math.ceil((high - low) / MARCH_STEP_M))
    near, gap_near = first, above(first)
    far, gap_far = last, above(last)
    reached = np.zeros(down.shape, dtype=bool)
    for count in range(1, steps):
        depth = first + np.float32(count / steps) * (last - first)
        gap = above(depth)
        under = ~reached & (gap <= 0)
        far, gap_far = np.where(under, depth, far), np.where(under, gap, gap_far)
        reached |= under
        near, gap_near = np.where(reached, near, depth), np.where(reached, gap_near, gap)
        if reached.all():
            break
    for _ in range(5):  # false position, kept off the ends so that both close in
        share = np.clip(gap_near / (gap_near - gap_far), 0.05, 0.95)
        depth = near + share * (far - near)
        gap = above(depth)
        under = gap <= 0
        far, gap_far = np.where(under, depth, far), np.where(under, gap, gap_far)
        near, gap_near = np.where(under, near, depth), np.where(under, gap_near, gap)
    depth = near + gap_near / (gap_near - gap_far) * (far - near)

    half = TEXEL_M / 2
    slope_north = (relief(depth, d_north=half) - relief(depth, d_north=-half)) / np.float32(TEXEL_M)
    slope_east = (relief(depth, d_east=half) - relief(depth, d_east=-half)) / np.float32(TEXEL_M)
    closing = down + slope_north * north + slope_east * east
    closing = np.where(np.abs(closing) < 0.25, np.float32(0.25), closing)
    behind_focus = 1 - depth / np.float32(rays.focus_m)
    rows, columns = [], []
    for body in (turn[:, 0], -turn[:, 1]):  # an aperture point θ stands θy forward and −θx right of the centre
        shift = [np.float32(b) * behind_focus for b in body]
        longer = -(shift[2] + slope_north * shift[0] + slope_east * shift[1]) / closing
        rows.append(-(shift[0] + north * longer) / np.float32(TEXEL_M))
        columns.append((shift[1] + east * longer) / np.float32(TEXEL_M))
    return _Hits(
        depth_m=depth.astype(np.float32),
        row=(-(north0 + north * depth) / TEXEL_M + home).astype(np.float32),
        column=((east0 + east * depth) / TEXEL_M + home).astype(np.float32),
        row_per_m=(rows[0], rows[1]),
        column_per_m=(columns[0], columns[1]),
    )


def _hits_between(ground: Landscape, rays: Rays, pose: TruePose) -> _Hits:
    """The hits of an even number of rays along each axis, by those of every second one."""
    y, x = (np.append(at[::2], 2 * at[-1] - at[-2]) for at in (rays.y_mm, rays.x_mm))
    some = _centre_hits(ground, replace(rays, y_mm=y, x_mm=x), pose)
    return _Hits(
        depth_m=_doubled(some.depth_m),
        row=_doubled(some.row),
        column=_doubled(some.column),
        row_per_m=(_doubled(some.row_per_m[0]), _doubled(some.row_per_m[1])),
        column_per_m=(_doubled(some.column_per_m[0]), _doubled(some.column_per_m[1])),
    )


def _doubled(plane: Singles) -> Singles:
    """(2h - 2, 2w - 2): the values of (h, w), and their means between them."""
    rows = np.empty((2 * len(plane) - 2, plane.shape[1]), dtype=np.float32)
    rows[::2], rows[1::2] = plane[:-1], (plane[:-1] + plane[1:]) / 2
    out = np.empty((len(rows), 2 * plane.shape[1] - 2), dtype=np.float32)
    out[:, ::2], out[:, 1::2] = rows[:, :-1], (rows[:, :-1] + rows[:, 1:]) / 2
    return out


def _relief_range(
    ground: Landscape, pose: TruePose, north: Singles, east: Singles, down: Singles
) -> tuple[float, float]:
    """(lowest, highest) ground that the picture may show, with 5 cm to spare."""
    n = len(ground.relief)
    spans = []
    for start, slope, sign in ((pose.position_ned_m[0], north, -1), (pose.position_ned_m[1], east, 1)):
        edges = [
            sign * (start + float(f(slope / down)) * (-level - pose.position_ned_m[2])) / TEXEL_M
            for level in (float(ground.relief.min()), float(ground.relief.max()))
            for f in (np.min, np.max)
        ]
        spans.append(np.arange(math.floor(min(edges)) - 1, math.ceil(max(edges)) + 2) + n // 2)
    shown = ground.relief if max(map(len, spans)) >= n else ground.relief[np.ix_(spans[0] % n, spans[1] % n)]
    return float(shown.min()) - 0.05, float(shown.max()) + 0.05


def _finer(plane: Singles, times: int) -> Singles:
    """(h·times, w·times): the values of (h + 1, w + 1), and what lies evenly between them."""
    for _ in range(2):  # along columns, then along rows
        between = np.empty((plane.shape[1], len(plane) - 1, times), dtype=np.float32)
        slope = np.diff(plane, axis=0).T
        for count in range(times):
            between[..., count] = plane[:-1].T + np.float32(count / times) * slope
        plane = between.reshape(len(between), -1)
    return plane


def _look(plane: Singles, at: NDArray[np.floating]) -> Singles:
    """Bilinear value of a cyclic map at (2, h, w) indices."""
    out = np.empty(at.shape[1:], dtype=np.float32)
    ndimage.map_coordinates(plane, at, output=out, order=1, mode="grid-wrap", prefilter=False)
    return out


def finest_period_m(height_m: float, pitch_mm: float, focal_length_mm: float, pass_cycles_per_pixel: float) -> float:
    """The ground period that a slice can just carry at this height: the limit of the texture."""
    if not (height_m > 0 and math.isfinite(height_m)):
        raise ValueError(f"height must be positive, not {height_m:g} m")
    return height_m / focal_length_mm * pitch_mm / pass_cycles_per_pixel
