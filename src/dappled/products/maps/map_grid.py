"""Draw views on a north-up map: the grid, where each view saw each cell, and mosaics of many frames.

A mosaic is made tile by tile: memory is bounded by a tile and the frames' own pictures.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from dappled.decode.array_types import Floats, Singles
from dappled.errors import DappledError
from dappled.products.extras import need
from dappled.products.maps.earth import DEGREE_M, GEODETIC, Projection, wrapped
from dappled.products.maps.eye import Eye
from dappled.products.maps.ground import Flat, Ground, level_shown
from dappled.products.maps.photographs import Photograph

LARGEST = 30_000  # cells on a side
_NODE = 16  # cells between places that are transformed exactly when the map is in degrees
_FLAT_NODE = (
    8  # cells between places on flat ground that are looked up in a frame exactly: between them a straight line
)
# misses by 0.003 px of a picture, and by 0.02 px of a view, at 45°
_SQUARED = 3  # times: a frame's weight is its distance from the rim, to a power, so that one shows at each place
_TILE = 1024
_COARSER = 1.5  # times the picture's sample: a map's cell that is larger is a mean of pixels
_STEPS = 64  # pixels: OpenCV works on a power of two of them at once
_CUBIC = 2  # pixels beside the one that is looked up
_SPREAD = 64  # cells that are interpolated at once: most weights of many nodes are 0
_MARGIN = 8  # cells: the rim's points are joined by straight lines


class MapError(DappledError):
    """A map can't be drawn."""


@dataclass(frozen=True, slots=True)
class MapGrid:
    """A north-up raster: the centre of cell (row, column) is (west + (column + ½)·step_x, north − (row + ½)·step_y).

    `crs` is the projection's name (units: metres), or EPSG:4326 (degrees of longitude and latitude).
    """

    crs: str
    west: float
    north: float
    step_x: float
    step_y: float
    shape: tuple[int, int]

    @property
    def bounds(self) -> tuple[float, float, float, float]:
        """West, south, east, north: outer edges."""
        rows, columns = self.shape
        return self.west, self.north - rows * self.step_y, self.west + columns * self.step_x, self.north

    @property
    def affine(self) -> Any:
        """From column and row to the map, as rasterio takes it. Raises MissingExtraError."""
        return need("rasterio").Affine(self.step_x, 0, self.west, 0, -self.step_y, self.north)

    def part(self, rows: slice, columns: slice) -> MapGrid:
        """The grid of some rows and columns."""
        return MapGrid(
            self.crs,
            self.west + columns.start * self.step_x,
            self.north - rows.start * self.step_y,
            self.step_x,
            self.step_y,
            (rows.stop - rows.start, columns.stop - columns.start),
        )

    def reached(self, x: Floats, y: Floats, beside: int = 0) -> tuple[slice, slice]:
        """The rows and columns between places, and so many beside them, within the grid; empty ones outside of it."""
        found = []
        for at, side in (
            ((self.north - y) / self.step_y, self.shape[0]),
            ((x - self.west) / self.step_x, self.shape[1]),
        ):
            first, last = math.floor(at.min()) - beside, math.ceil(at.max()) + beside
            found.append(slice(min(max(first, 0), side), max(min(last, side), 0)))
        return found[0], found[1]

    def axes(self) -> tuple[Floats, Floats]:
        """(x of the columns, y of the rows), cell centres."""
        rows, columns = (np.arange(side, dtype=np.float64) + 0.5 for side in self.shape)
        return np.asarray(self.west + columns * self.step_x), np.asarray(self.north - rows * self.step_y)

    def places(self, projection: Projection) -> tuple[Floats, Floats]:
        """(east, north) on the projection of each cell, (rows, columns) each."""
        x, y = self.axes()
        if self.crs != GEODETIC:
            east, north = np.meshgrid(x, y)
            return np.asarray(east, np.float64), np.asarray(north, np.float64)
        # Every _NODE-th cell is exact; between them linear interpolation errs by far less than a hundredth of a cell.
        at_x, at_y = (np.linspace(line[0], line[-1], max(2, math.ceil(len(line) / _NODE) + 1)) for line in (x, y))
        node_x, node_y = np.meshgrid(at_x, at_y)
        nodes = projection.to_map(node_y, node_x)
        aside, down = between(x, at_x), between(y, at_y)
        east, north = (_spread(node, down, aside, np.empty(self.shape)) for node in nodes)
        return east, north


def around(points: Floats, crs: str, step_x: float, step_y: float) -> MapGrid:
    """The grid that covers points (n, 2) of (x, y), its edges at whole steps. Raises MapError if it is too large."""
    low, high = points.min(axis=0), points.max(axis=0)
    west, east = math.floor(low[0] / step_x), math.ceil(high[0] / step_x)
    south, north = math.floor(low[1] / step_y), math.ceil(high[1] / step_y)
    shape = max(1, north - south), max(1, east - west)
    if max(shape) > LARGEST:
        raise MapError(f"the map would have {shape[0]} × {shape[1]} cells: choose a larger --gsd, or fewer frames")
    return MapGrid(crs, west * step_x, north * step_y, step_x, step_y, shape)


def shared(grids: Sequence[MapGrid]) -> list[tuple[slice, slice]] | None:
    """The rows and columns of each grid that all have in common, None where there are none; of grids with one step."""
    one = grids[0]
    tops = [round((one.north - grid.north) / one.step_y) for grid in grids]  # rows below the first's top
    lefts = [round((grid.west - one.west) / one.step_x) for grid in grids]
    bottom = min(top + grid.shape[0] for top, grid in zip(tops, grids, strict=True))
    right = min(left + grid.shape[1] for left, grid in zip(lefts, grids, strict=True))
    if max(tops) >= bottom or max(lefts) >= right:
        return None
    return [
        (slice(max(tops) - top, bottom - top), slice(max(lefts) - left, right - left))
        for top, left in zip(tops, lefts, strict=True)
    ]


def footprint(eye: Eye, ground: Ground) -> Floats:
    """(n, 3) east, north, height along the view's border, each side beginning with its corner. Raises MapError where a
    ray misses the ground."""
    met = ground.meet(eye, eye.border())
    if np.isnan(met).any():
        raise MapError(f"its view leaves the ground ({ground.name}): give terrain that covers it")
    return met


def degree_steps(projection: Projection, east: float, north: float, gsd_m: float) -> tuple[float, float]:
    """(longitude, latitude) degrees for one cell of `gsd_m` at a place."""
    latitude, _ = projection.to_geodetic(east, north)
    return gsd_m / (DEGREE_M * max(0.01, math.cos(math.radians(float(latitude))))), gsd_m / DEGREE_M


def unwrapped(longitude_deg: Floats, near_deg: float) -> Floats:
    """Longitudes within 180° of `near_deg`, so that a strip across the antimeridian stays in one piece."""
    return near_deg + wrapped(longitude_deg - near_deg)


def sample(image: Singles, at: Floats) -> Singles:
    """float32 (rows, columns, c): an image (h, w, c) at pixels (rows, columns, 2); NaN where those are NaN."""
    seen, outside = _looked_up(image, at)
    seen[outside] = np.nan
    return seen


def _looked_up(image: Singles, at: Floats) -> tuple[Singles, NDArray[np.bool_]]:
    """An image (h, w, c) at pixels (rows, columns, 2): float32 (rows, columns, c), and where it means nothing, as those
    are NaN."""
    cv2 = need("cv2")
    outside = ~np.isfinite(at[..., 0])
    if outside.all():
        return np.zeros((*outside.shape, image.shape[2]), dtype=np.float32), outside
    x, y = (at[..., axis].astype(np.float32) for axis in (0, 1))
    for one in (x, y):
        np.copyto(one, np.float32(0), where=outside)
    values = cv2.remap(image, x, y, cv2.INTER_CUBIC, borderMode=cv2.BORDER_REPLICATE).reshape(*outside.shape, -1)
    return np.asarray(values, np.float32), outside


def seen_at(eye: Eye, grid: MapGrid, ground: Ground, projection: Projection) -> Floats:
    """(rows, columns, 2): the view's pixel (x, y) that shows each map cell; NaN where none does."""
    rows, columns = eye.shape
    if isinstance(ground, Flat):
        at = _on_flat(eye, grid, ground, projection)
        inside = np.ones(grid.shape, dtype=bool)
    else:
        east, north = grid.places(projection)
        height = ground.heights(east, north)
        at = eye.project(np.stack([east, north, height], axis=-1).reshape(-1, 3)).reshape(*grid.shape, 2)
        inside = ground.sees(eye, east, north, height)
    for axis, side in enumerate((columns, rows)):  # one after the other: NumPy is slow along an axis of two
        inside &= (at[..., axis] >= -0.5) & (at[..., axis] <= side - 0.5)
    outside = ~inside
    for axis in (0, 1):
        np.copyto(at[..., axis], np.nan, where=outside)
    return at


def _on_flat(eye: Eye, grid: MapGrid, ground: Flat, projection: Projection) -> Floats:
    """(rows, columns, 2), x and y apart in memory: the pixel at which each cell of flat ground stands, also outside of
    the view; NaN behind the camera."""
    axes = grid.axes()
    nodes = [np.linspace(axis[0], axis[-1], max(2, math.ceil(len(axis) / _FLAT_NODE) + 1)) for axis in axes]
    x, y = np.meshgrid(*nodes)
    east, north = (x, y) if grid.crs != GEODETIC else projection.to_map(y, x)
    bent = any(eye.distortion)
    to_view = eye.homography(ground.height_m)
    from_ground = np.linalg.inv(eye.matrix) @ to_view if bent else to_view
    u, v, w = (row[0] * (east - eye.centre[0]) + row[1] * (north - eye.centre[1]) + row[2] for row in from_ground)
    ahead = np.where(w > 0, w, np.nan)
    at = np.stack([u / ahead, v / ahead], axis=-1)
    if bent:
        at = eye.imaged(at.reshape(-1, 2)).reshape(at.shape)
    aside, down = (between(axis, node) for axis, node in zip(axes, nodes, strict=True))
    made = np.empty((2, len(down), len(aside)))
    for axis in (0, 1):
        _spread(at[..., axis], down, aside, made[axis])
    return np.moveaxis(made, 0, -1)


def _spread(nodes: Floats, down: Floats, aside: Floats, made: Floats) -> Floats:
    """Fill `made` (rows, columns) with what lies between nodes (n, m), by weights (rows, n) and (columns, m) that are 0
    but for two neighbours."""
    tall = down @ nodes
    for start in range(0, len(aside), _SPREAD):
        weights = aside[start : start + _SPREAD]
        used = np.flatnonzero(weights.any(axis=0))
        near = slice(used[0], used[-1] + 1)
        np.matmul(tall[:, near], weights[:, near].T, out=made[:, start : start + _SPREAD])
    return made


def smoothed(image: Singles, eye: Eye, grid: MapGrid, ground: Ground, at: Floats | None = None) -> Singles:
    """The image (h, w, c), smoothed where the map is much coarser; only around its pixels (rows, columns, 2) `at`, if
    they are given, and elsewhere undefined."""
    if image.ndim == 2:
        image = image[..., None]
    level = level_shown(ground, eye)
    step_m = grid.step_y * DEGREE_M if grid.crs == GEODETIC else grid.step_y
    ratio = step_m / eye.gsd_m(level) if math.isfinite(level) else 1.0
    if at is None or ratio < _COARSER:
        return smoothed_to(image, ratio)
    made = np.empty_like(image)  # untouched, it takes no memory
    used = [_reached(at[..., axis], side, _CUBIC) for axis, side in ((1, image.shape[0]), (0, image.shape[1]))]
    beside = math.ceil(4 * _sigma(ratio)) + 1
    # Where a part begins, its rows are worked on in the same steps as the whole: rounding is the same.
    wide = [
        slice(max(0, one.start - beside) // _STEPS * _STEPS, min(side, one.stop + beside))
        for one, side in zip(used, image.shape, strict=False)
    ]
    inner = tuple(slice(one.start - more.start, one.stop - more.start) for one, more in zip(used, wide, strict=True))
    made[tuple(used)] = smoothed_to(image[tuple(wide)], ratio)[inner]
    return made


def _reached(at: Floats, side: int, beside: int) -> slice:
    """The rows, or columns, of a picture that are looked at, and those beside them."""
    known = at[np.isfinite(at)]
    if not known.size:
        return slice(0, 0)
    return slice(max(0, math.floor(known.min()) - beside), min(side, math.ceil(known.max()) + 1 + beside))


def _sigma(ratio: float) -> float:
    return 0.5 * math.sqrt(ratio**2 - 1)


def smoothed_to(image: Singles, ratio: float) -> Singles:
    """The image, smoothed for sampling at every `ratio`-th pixel; unchanged below 1.5."""
    if ratio < _COARSER or not image.size:
        return image
    cv2 = need("cv2")
    smooth = cv2.GaussianBlur(image, (0, 0), _sigma(ratio), borderType=cv2.BORDER_REPLICATE)
    return np.asarray(smooth, np.float32).reshape(image.shape)


def between(fine: Floats, nodes: Floats) -> Floats:
    """(len(fine), len(nodes)): weights of linear interpolation between evenly spaced nodes."""
    step = (nodes[-1] - nodes[0]) / (len(nodes) - 1) or 1.0
    place = np.clip((fine - nodes[0]) / step, 0, len(nodes) - 1)
    left = np.minimum(np.floor(place).astype(np.intp), len(nodes) - 2)
    weights = np.zeros((len(fine), len(nodes)))
    rows = np.arange(len(fine))
    weights[rows, left] = 1 - (place - left)
    weights[rows, left + 1] = place - left
    return weights


def grid_of(
    photographs: Sequence[Photograph], ground: Ground, projection: Projection, gsd_m: float, *, degrees: bool = False
) -> MapGrid:
    """The map that all frames fit into, on the projection or in degrees. Raises MapError."""
    met = np.concatenate([footprint(one.eye, ground) for one in photographs])
    if not degrees:
        return around(met[:, :2], projection.name, gsd_m, gsd_m)
    latitude, longitude = projection.to_geodetic(met[:, 0], met[:, 1])
    step_x, step_y = degree_steps(projection, float(met[0, 0]), float(met[0, 1]), gsd_m)
    points = np.stack([unwrapped(longitude, float(longitude[0])), latitude], axis=1)
    return around(points, GEODETIC, step_x, step_y)


def pieces(
    photographs: Sequence[Photograph],
    grid: MapGrid,
    ground: Ground,
    projection: Projection,
    focus_m: float = math.inf,
) -> Iterator[tuple[slice, slice, Singles]]:
    """Yield (rows, columns, float32 (h, w, c)) tiles that cover the grid, to be read alone; NaN where no frame looks.

    A frame's weight at a place grows with the distance from its own rim, so that each place is shown by the frame that
    sees it best, with soft seams.
    """
    colours = max((1 if one.image.ndim == 2 else one.image.shape[2]) for one in photographs)
    boxes = [_cells(one, grid, ground, projection) for one in photographs]
    for top in range(0, grid.shape[0], _TILE):
        for left in range(0, grid.shape[1], _TILE):
            rows = slice(top, min(top + _TILE, grid.shape[0]))
            columns = slice(left, min(left + _TILE, grid.shape[1]))
            shape = rows.stop - rows.start, columns.stop - columns.start
            met = [
                (one, (_both(down, rows), _both(across, columns)))
                for one, (down, across) in zip(photographs, boxes, strict=True)
            ]
            met = [(one, near) for one, near in met if all(part.start < part.stop for part in near)]
            if not met:
                yield rows, columns, np.broadcast_to(np.float32(np.nan), (*shape, colours))
                continue
            total = np.zeros((*shape, colours), dtype=np.float32)
            weight = np.zeros(shape, dtype=np.float32)
            for one, near in met:
                inner = slice(near[0].start - top, near[0].stop - top), slice(near[1].start - left, near[1].stop - left)
                layers = one.layers(focus_m)
                for image, eye in layers:
                    at = seen_at(eye, grid.part(*near), ground, projection)
                    seen, outside = _looked_up(smoothed(image, eye, grid, ground, at), at)
                    say = _say(at, eye.shape) / np.float32(len(layers))
                    if not np.isfinite(seen).all():
                        outside |= ~np.isfinite(seen[..., 0])
                        seen[outside] = 0
                    np.copyto(say, np.float32(0), where=outside)
                    seen = np.multiply(seen, _of_each(say, colours), out=seen if seen.shape[2] == colours else None)
                    total[inner] += seen
                    weight[inner] += say
            with np.errstate(invalid="ignore"):
                total /= _of_each(weight, colours)  # NaN where none looks
            yield rows, columns, total


def _both(one: slice, other: slice) -> slice:
    """What two have in common."""
    return slice(max(one.start, other.start), min(one.stop, other.stop))


def _of_each(values: Singles, colours: int) -> Singles:
    """(rows, columns, colours) of values (rows, columns): NumPy is slow at repeating them along an axis of three."""
    return np.asarray(need("cv2").merge([values] * colours)).reshape(*values.shape, colours)


def _say(at: NDArray[np.float64], shape: tuple[int, int]) -> Singles:
    """(rows, columns): the weight of a view of this shape where its pixels (rows, columns, 2) are looked up; NaN where
    those are NaN."""
    away = np.full(at.shape[:2], 0.5, dtype=np.float32)
    for axis, side in enumerate((shape[1], shape[0])):
        share = ((at[..., axis] + 0.5) / side).astype(np.float32)
        np.minimum(away, np.minimum(share, 1 - share), out=away)
    weight = 2 * np.maximum(away, np.float32(0)) + np.float32(1e-3)
    for _ in range(_SQUARED):
        np.square(weight, out=weight)
    return weight


def _cells(one: Photograph, grid: MapGrid, ground: Ground, projection: Projection) -> tuple[slice, slice]:
    """The rows and columns that a frame may reach."""
    met = footprint(one.eye, ground)
    x, y = met[:, 0], met[:, 1]
    if grid.crs == GEODETIC:
        y, x = projection.to_geodetic(x, y)
        x = unwrapped(x, (grid.bounds[0] + grid.bounds[2]) / 2)
    return grid.reached(x, y, _MARGIN)
