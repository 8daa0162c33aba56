"""The decoded light field as a value, the stack of its views, its slices as one picture and as a few numbers."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from functools import cache
from typing import Any

import numpy as np
from numpy.typing import NDArray

from dappled import codec
from dappled.decode.errors import DecodeError
from dappled.findings import Finding

Image = NDArray[np.float32]
CAMERAS = "cameras"  # an attribute of light fields: true where each view is a camera's, further right with larger u
PROJECTIONS = 64  # of a fingerprint: fixed, recorded flights hold them (docs/flight-data.md)
_BLOCK = 4096  # values of each projection that are summed at once
_REGULAR = 1e-3  # of a view: how far views may stand from a grid of rows and columns


@dataclass(frozen=True, slots=True)
class LightField:
    """Slices and views of one frame.

    `slices` complex64 (K, h, w): DC first, then the orders lexicographically greater than (0, 0).
    `carriers` float64 (K, 4): rows [ky, kx, fy, fx], cycles/pixel.
    `views` float32 (V, U, h, w) or (V, U, h, w, 3): linear, 1.0 = sensor white.
    `view_offsets` float64 (V, U, 2): the aperture point (v, u) of each view as a share of the full aperture,
    −0.5 to 0.5.
    `grid` float64 (2, 3): from (y, x, 1) of a view to sensor (row, column).
    `view_sigma` float32 (V, U, m, n): standard errors of the grey views in patches, (i, j) around the view's sample
    (12·i − 0.5, 12·j − 0.5); None where they are unknown.
    `attributes`: frame shape, camera, mask, law, focal length, f-number, calibration, software version, and
    pose where known.
    """

    slices: NDArray[np.complex64]
    carriers: NDArray[np.float64]
    views: NDArray[np.float32]
    view_offsets: NDArray[np.float64]
    grid: NDArray[np.float64]
    attributes: Mapping[str, Any] = field(default_factory=dict)
    view_sigma: NDArray[np.float32] | None = None

    @property
    def doubts(self) -> tuple[Finding, ...]:
        """What may be wrong with it; the attribute `doubts` has them as JSON."""
        return codec.read(tuple[Finding, ...], self.attributes.get("doubts") or ())

    @property
    def views_reason(self) -> Finding | None:
        """Why its views are not of one model of the light field; None where they are, or none were asked for."""
        reason = self.attributes.get("views_reason")
        return None if reason is None else codec.read(Finding, reason)


@dataclass(frozen=True, slots=True, eq=False)
class ViewStack:
    """Views with the places they were seen from, which refocusing and depth work on, wherever the views came from.

    `views` float32 (V, U, h, w) or (V, U, h, w, 3); their places are `row_steps` (V,) and `column_steps` (U,). The
    convention: a point of disparity D that the aperture's middle sees at (y, x) is seen by the view (v, u) at
    (y + D·row_steps[v], x + D·column_steps[u]). Disparity is in columns of a view from one view to the next, 0 where
    the camera was focused, larger for what is nearer.

    `sensor_px_per_disparity` is what a disparity of 1 moves over the whole aperture, in columns of the sensor: it leads
    to metres (see `ranging`). None where the sensor is unknown.
    """

    views: NDArray[np.float32]
    row_steps: NDArray[np.float64]
    column_steps: NDArray[np.float64]
    sensor_px_per_disparity: float | None = None

    def __post_init__(self) -> None:
        """Raises DecodeError for shapes that don't fit together, and for no views at all."""
        if self.views.ndim not in (4, 5) or (self.views.ndim == 5 and self.views.shape[4] != 3):
            raise DecodeError(f"views of shape {self.views.shape}: they must be (V, U, h, w), or (V, U, h, w, 3)")
        if 0 in self.views.shape:
            raise DecodeError(
                "there are no views: decode the frame with a calibration, or take one whose carriers are visible"
            )
        if (len(self.row_steps), len(self.column_steps)) != self.views.shape[:2]:
            raise DecodeError(
                f"{len(self.row_steps)} × {len(self.column_steps)} places for "
                f"{self.views.shape[0]} × {self.views.shape[1]} views"
            )

    @classmethod
    def of(cls, field: LightField, views: NDArray[np.float32] | None = None) -> ViewStack:
        """The views of a light field, or others on the same places.

        Behind a mask a larger aperture coordinate sees nearer things at larger ones. A lenslet turns the picture of the
        aperture round, so there they are at smaller ones, as for a camera further to the right. Raises DecodeError
        where there are no views, or where they are not on rows and columns.
        """
        values = field.views if views is None else views
        if 0 in values.shape:
            raise DecodeError("the light field has no views: decode the frame with a calibration")
        offsets = np.asarray(field.view_offsets, dtype=np.float64)
        across, down = offsets[0, :, 1], offsets[:, 0, 0]
        on_rows = np.abs(offsets[..., 0] - down[:, None]).max(), np.abs(offsets[..., 1] - across[None, :]).max()
        count = max(values.shape[:2])
        if max(on_rows) > _REGULAR / count:
            raise DecodeError("the light field's views are not on rows and columns of the aperture")
        cameras = bool(field.attributes.get(CAMERAS))
        sign = -1.0 if cameras or field.attributes.get("lenslet_pitch_px") else 1.0
        row_px, column_px = float(np.hypot(*field.grid[:, 0])), float(np.hypot(*field.grid[:, 1]))
        # One step is 1/count of the aperture; a row of a view may be taller than a column is wide.
        return cls(
            values,
            sign * count * down * column_px / row_px,
            sign * count * across,
            sensor_px_per_disparity=None if cameras else count * column_px,
        )

    @property
    def reach(self) -> float:
        """The largest step: how many pixels the outermost view moves for a disparity of 1."""
        return float(max(np.abs(self.row_steps).max(), np.abs(self.column_steps).max()))

    @property
    def colour(self) -> bool:
        """Whether the views are red, green and blue."""
        return self.views.ndim == 5

    def grey(self) -> ViewStack:
        """The mean of the colours; grey views as they are."""
        return replace(self, views=self.views.mean(axis=4, dtype=np.float32)) if self.colour else self

    def middle(self) -> NDArray[np.float32]:
        """The view nearest to the aperture's middle, (h, w) or (h, w, 3)."""
        found: NDArray[np.float32] = self.views[
            int(np.argmin(np.abs(self.row_steps))), int(np.argmin(np.abs(self.column_steps)))
        ]
        return found


def centred(count: int) -> NDArray[np.float64]:
    """0…count−1 about their middle."""
    return np.arange(count, dtype=np.float64) - (count - 1) / 2


def needs_parallax(stack: ViewStack, what: str) -> None:
    """Raises DecodeError if all views are at one place."""
    if stack.reach == 0:
        raise DecodeError(f"{what} needs views from several places, and this light field's are all from one")


def slice_mosaic(
    slices: NDArray[np.complex64], carriers: NDArray[np.float64], *, longest_side: int = 2400
) -> NDArray[np.uint8]:
    """uint8 (H, W): the slices' magnitudes placed by their orders, conjugate halves filled in.

    `slices` (K, h, w) with `carriers` rows [ky, kx, …] as in a LightField. Each slice from its own 0 to its own
    99.5th percentile. Missing orders (of an octave or diagonal mask) take no room where a whole row or column lacks.
    A conjugate has the same magnitude.
    """
    tiles = {}
    for image, (ky, kx) in zip(slices, carriers[:, :2].astype(int).tolist(), strict=True):
        tile = _stretched(np.abs(image))
        tiles[(ky, kx)] = tile
        tiles.setdefault((-ky, -kx), tile)
    rows = sorted({ky for ky, _ in tiles})
    columns = sorted({kx for _, kx in tiles})
    height, width = slices.shape[1:]
    out = np.full((len(rows) * (height + 2), len(columns) * (width + 2)), 255, dtype=np.uint8)
    for (ky, kx), tile in tiles.items():
        top, left = rows.index(ky) * (height + 2) + 1, columns.index(kx) * (width + 2) + 1
        out[top : top + height, left : left + width] = tile
    step = max(1, -(-max(out.shape) // longest_side))
    return np.ascontiguousarray(out[::step, ::step])


def _stretched(image: NDArray[np.floating]) -> NDArray[np.uint8]:
    high = max(float(np.quantile(image, 0.995)), 1e-12)
    grey: NDArray[np.uint8] = np.rint(255 * np.clip(image / high, 0, 1)).astype(np.uint8)
    return grey


def fingerprint(values: NDArray[np.complex64] | NDArray[np.float32]) -> dict[str, Any] | None:
    """A few numbers that tell how much two arrays differ: `count` (real and imaginary parts counted singly), `largest`
    amount, and `sums`, 64 fixed random projections; None where a value is not finite.

    A hash says whether an array is the same; on another processor the last bits of a sum differ. Each projection is the
    sum of a 64th of the values, each with a fixed random sign, so a change of one value changes one projection by as
    much, and rounding of n values by √n as much as that of one.
    """
    flat = np.ascontiguousarray(values).reshape(-1).view(np.float32)
    largest = float(np.abs(flat).max(initial=0.0))
    if not math.isfinite(largest):
        return None
    sums = np.zeros(PROJECTIONS)
    side = _BLOCK * PROJECTIONS
    signs = _signs(0)
    for number, start in enumerate(range(0, len(flat), side)):
        block = flat[start : start + side]
        if len(block) < side:
            block = np.concatenate([block, np.zeros(side - len(block), np.float32)])
        summed = np.einsum("rc,rc->c", signs, block.reshape(_BLOCK, PROJECTIONS))
        sums += _signs(1)[number % _BLOCK] * summed
    return {"count": len(flat), "largest": float(f"{largest:.9g}"), "sums": [float(f"{one:.9g}") for one in sums]}


def difference(recorded: Mapping[str, Any], found: Mapping[str, Any]) -> float:
    """By how much two arrays differ, as a share of the recorded one's largest value: for independent errors of their
    values about one of them; a change of one value alone counts less by the root of a projection's length.

    inf for arrays of different sizes, or where a fingerprint is damaged.
    """
    try:
        if recorded["count"] != found["count"] or not recorded["count"]:
            return math.inf
        apart = np.abs(np.array(recorded["sums"], dtype=np.float64) - np.array(found["sums"], dtype=np.float64))
        if apart.shape != (PROJECTIONS,):
            return math.inf
        length = math.sqrt(max(1.0, recorded["count"] / PROJECTIONS))
        share = float(apart.max()) / length / float(recorded["largest"]) if apart.any() else 0.0
    except (KeyError, TypeError, ValueError, ZeroDivisionError):
        return math.inf
    return share if math.isfinite(share) else math.inf


@cache
def _signs(seed: int) -> NDArray[np.float32]:
    """(_BLOCK, PROJECTIONS) of ±1, the same on every machine (splitmix64)."""
    z = np.arange(1, _BLOCK * PROJECTIONS + 1, dtype=np.uint64) + np.uint64(seed << 32)
    with np.errstate(over="ignore"):
        z *= np.uint64(0x9E3779B97F4A7C15)
        z = (z ^ (z >> np.uint64(30))) * np.uint64(0xBF58476D1CE4E5B9)
        z = (z ^ (z >> np.uint64(27))) * np.uint64(0x94D049BB133111EB)
    z ^= z >> np.uint64(31)
    return (1.0 - 2.0 * (z >> np.uint64(63))).astype(np.float32).reshape(_BLOCK, PROJECTIONS)


def no_views(shape: tuple[int, ...]) -> tuple[NDArray[np.float32], NDArray[np.float64]]:
    """The views (0, 0, h, w) and offsets (0, 0, 2) of slices (h, w) alone."""
    return np.zeros((0, 0, *shape), dtype=np.float32), np.zeros((0, 0, 2))
