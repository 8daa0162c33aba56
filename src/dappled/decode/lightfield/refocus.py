"""Refocus by shift and add (Eq 28 and 29): on any α, disparity or plane, in focal stacks, for two eyes.

Eq 28 puts the film at α times its distance F from the lens: a ray from aperture point u to x on that film crosses
the sensor at u(1 − 1/α) + x/α, all lengths in mm. Over the whole aperture A a point that is sharp on that film moves
over the sensor by A(1 − 1/α). So α > 1 is nearer than the focus and α < 1 farther, and F itself is not needed. Pixels
from view to view are called disparity here, never α: an α that counts views would depend on how many there are.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy import ndimage

from dappled.decode.errors import DecodeError
from dappled.decode.lightfield.light_field import Image, ViewStack
from dappled.workers import each

_LEAST_CONTRAST = 1e-4  # rms of the Laplacian, of white 1.0: smoother areas have no sharpest picture
_SHARPNESS_BOX = 5  # px: the side of the box that sharpness is averaged over, twice
# Of the windowed sinc, and its window: true views refocused reach 65.9 to 79.4 dB, by cubic convolution 51.7 to 63.6
# (frames of benchmarks/views.py, 25 points, seed 1, four planes).
_TAPS, _KAISER = 16, 5.0
_LEAST_WEIGHT = 1e-6  # of all views: a pixel that less is seen of is unknown


def disparity_of_alpha(alpha: float, aperture_px: float, stack: ViewStack) -> float:
    """The disparity that a film at α times its distance has in focus (Eq 28): A(1 − 1/α) over the whole aperture.

    `aperture_px` is the diameter A in columns of the sensor. Raises DecodeError for an α that is not an image plane,
    and for views without a sensor.
    """
    if not (math.isfinite(alpha) and alpha > 0):
        raise DecodeError(f"α = {alpha:g} is not an image plane: it must be above 0 (1 leaves the focus where it was)")
    if stack.sensor_px_per_disparity is None:
        raise DecodeError("views from a folder have no sensor, so they have no α: give --disparity")
    return aperture_px * (1 - 1 / alpha) / stack.sensor_px_per_disparity


def shift_and_add(
    stack: ViewStack, disparity: float, *, weights: NDArray[np.floating] | None = None, workers: int = 1
) -> Image:
    """The picture focused on one disparity, float32 (h, w) or (h, w, 3): mean of L_vu(p + D·step) over views.

    `weights` (V, U) are the views' shares of the aperture. Between pixels views are interpolated by a sinc of 16 taps
    under a Kaiser window: 59 dB at 0.7 of the finest detail that a view holds, where cubic convolution has 9 dB.
    Towards the edges, where it would reach beyond a view, it is cubic convolution (Keys 1981). There a pixel's mean is
    over the views that have it, and pixels that none has are NaN.
    """
    if not math.isfinite(disparity):
        raise DecodeError(f"a disparity of {disparity} is not a plane: give a finite one, in pixels from view to view")
    share = _checked(stack, weights)
    if stack.colour:
        made = np.stack(
            [_focused(stack, stack.views[..., c], disparity, share, workers) for c in range(stack.views.shape[4])],
            axis=-1,
        )
    else:
        made = _focused(stack, stack.views, disparity, share, workers)
    return made


def along(
    stack: ViewStack, disparity: NDArray[np.floating], *, weights: NDArray[np.floating] | None = None, workers: int = 1
) -> Image:
    """The picture focused on a surface: `disparity` (h, w) for each of its pixels, NaN where it is unknown.

    The same mean as `shift_and_add`, with spline interpolation; NaN where the disparity is.
    """
    share = _checked(stack, weights)
    height, width = stack.views.shape[2:4]
    if disparity.shape != (height, width):
        raise DecodeError(f"the surface is {disparity.shape}, the views are {(height, width)}")
    known = np.isfinite(disparity)
    surface = np.where(known, disparity, 0).astype(np.float32)
    rows, columns = np.meshgrid(np.arange(height, dtype=np.float32), np.arange(width, dtype=np.float32), indexing="ij")
    channels = np.moveaxis(stack.views, 4, 2) if stack.colour else stack.views[:, :, None]
    sums = np.zeros((len(stack.row_steps), channels.shape[2] + 1, height, width), dtype=np.float32)

    def one(v: int) -> None:
        for u, column_step in enumerate(stack.column_steps):
            if not share[v, u]:
                continue
            at = np.stack(
                [rows + surface * np.float32(stack.row_steps[v]), columns + surface * np.float32(column_step)]
            )
            inside = (at[0] >= 0) & (at[0] <= height - 1) & (at[1] >= 0) & (at[1] <= width - 1)
            weight = np.float32(share[v, u]) * inside
            for c, view in enumerate(channels[v, u]):
                sums[v, c] += weight * ndimage.map_coordinates(view, at, order=3, mode="nearest")
            sums[v, -1] += weight

    each(one, range(len(stack.row_steps)), workers)
    total = sums.sum(axis=0)
    seen = known & (total[-1] > _LEAST_WEIGHT)
    made = np.where(seen, total[:-1] / np.where(seen, total[-1], 1), np.float32(np.nan)).astype(np.float32)
    return np.moveaxis(made, 0, -1) if stack.colour else made[0]


@dataclass(frozen=True, slots=True)
class FocalPlane:
    """A plane of disparities over the picture: at its middle, and how it changes over its full height and width."""

    disparity: float
    over_height: float = 0.0
    over_width: float = 0.0

    def over(self, shape: tuple[int, int]) -> NDArray[np.float32]:
        """(h, w) disparities. (1/Z is linear over the picture of a plane, and so is disparity.)"""
        y, x = (np.linspace(-0.5, 0.5, side, dtype=np.float32) for side in shape)
        plane: NDArray[np.float32] = (
            np.float32(self.disparity)
            + np.float32(self.over_height) * y[:, None]
            + np.float32(self.over_width) * x[None, :]
        )
        return plane


def tilted(
    stack: ViewStack, plane: FocalPlane, *, weights: NDArray[np.floating] | None = None, workers: int = 1
) -> Image:
    """The picture focused on a tilted plane, such as ground that is seen obliquely; `weights` as `shift_and_add`."""
    height, width = stack.views.shape[2:4]
    if plane.over_height == 0 and plane.over_width == 0:
        return shift_and_add(stack, plane.disparity, weights=weights, workers=workers)
    return along(stack, plane.over((height, width)), weights=weights, workers=workers)


def disc(stack: ViewStack, diameter: float, centre: tuple[float, float] = (0.0, 0.0)) -> NDArray[np.float64]:
    """(V, U) weights of a round synthetic aperture: `diameter` and `centre` (v, u) as shares of the whole aperture.

    The rim is one view wide. The view nearest to the centre always counts. Raises DecodeError for a diameter of 0.
    """
    if not diameter > 0:
        raise DecodeError(f"a synthetic aperture of {diameter:g} lets no light through: its diameter must be above 0")
    count = max(stack.views.shape[:2])
    rows, columns = (np.arange(n) - (n - 1) / 2 for n in stack.views.shape[:2])
    away = np.hypot(rows[:, None] - centre[0] * count, columns[None, :] - centre[1] * count)
    weights: NDArray[np.float64] = np.clip(diameter * count / 2 - away + 0.5, 0, 1)
    weights[np.unravel_index(np.argmin(away), away.shape)] = 1.0
    return weights


@dataclass(frozen=True, slots=True, eq=False)
class AllInFocus:
    """`picture` (h, w(, 3)): each pixel from the picture of the stack that is sharpest there. `index` int16 (h, w) says
    which, −1 where nothing is sharp: there the picture is the stack's middle one."""

    picture: Image
    index: NDArray[np.int16]


def focal_stack(
    stack: ViewStack, disparities: Sequence[float] | NDArray[np.float64], *, workers: int = 1
) -> NDArray[np.float32]:
    """The pictures float32 (D, h, w) or (D, h, w, 3) focused on each disparity. Raises DecodeError for none."""
    if len(disparities) == 0:
        raise DecodeError("a focal stack needs at least one plane")
    return np.stack([shift_and_add(stack, float(d), workers=workers) for d in disparities])


def all_in_focus(stack: NDArray[np.float32]) -> AllInFocus:
    """The sharpest of a focal stack at every pixel: the largest local energy of the Laplacian."""
    pictures = np.nan_to_num(stack)
    grey = pictures.mean(axis=3) if pictures.ndim == 4 else pictures
    energy = np.stack([ndimage.laplace(p, mode="nearest") for p in grey]) ** 2
    for axis in (1, 2):
        for _ in range(2):  # a box used twice is a smooth window
            energy = ndimage.uniform_filter1d(energy, _SHARPNESS_BOX, axis=axis)
    index = ndimage.median_filter(energy.argmax(axis=0), 3)
    smooth = energy.max(axis=0) < _LEAST_CONTRAST**2
    chosen = np.where(smooth, len(pictures) // 2, index)
    gather = chosen[None, ..., None] if pictures.ndim == 4 else chosen[None]
    picture = np.take_along_axis(pictures, gather, axis=0)[0]
    return AllInFocus(picture, np.where(smooth, -1, index).astype(np.int16))


@dataclass(frozen=True, slots=True, eq=False)
class StereoPair:
    """The pictures for the left and the right eye, float32 (h, w) or (h, w, 3)."""

    left: Image
    right: Image


def eyes(
    stack: ViewStack, *, separation: float = 0.6, pupil: float = 0.35, disparity: float = 0.0, workers: int = 1
) -> StereoPair:
    """Two synthetic apertures `separation` apart, `pupil` wide (shares of the whole aperture), converging on a
    disparity. Raises DecodeError where there is only one column of views."""
    if not 0 < separation <= 1:
        raise DecodeError(
            f"eyes {separation:g} of the aperture apart don't fit into it: give more than 0 and at most 1"
        )
    if np.ptp(stack.column_steps) == 0:
        raise DecodeError("a stereo pair needs views from several columns of the aperture")
    # A point nearer than the focus is seen further to the right by the view with the larger step: that is the left eye.
    towards_left = float(np.sign(stack.column_steps[-1] - stack.column_steps[0]))
    left, right = (
        shift_and_add(
            stack, disparity, weights=disc(stack, pupil, (0.0, side * towards_left * separation / 2)), workers=workers
        )
        for side in (1, -1)
    )
    return StereoPair(left, right)


def anaglyph(pair: StereoPair) -> NDArray[np.float32]:
    """(h, w, 3) for red-cyan glasses: red is the left eye's, green and blue the right one's."""
    left, right = (p if p.ndim == 3 else np.repeat(p[..., None], 3, axis=2) for p in (pair.left, pair.right))
    made: NDArray[np.float32] = np.concatenate([left[..., :1], right[..., 1:]], axis=2).astype(np.float32)
    return made


def side_by_side(pair: StereoPair, *, crossed: bool = False) -> Image:
    """(h, 2w(, 3)): the left eye's picture left, or right for crossed eyes."""
    both = (pair.right, pair.left) if crossed else (pair.left, pair.right)
    made: Image = np.concatenate(both, axis=1)
    return made


def magnified(image: Image, factor: float) -> Image:
    """The picture `factor` times as large about its middle, on the same pixels; NaN beyond its edges."""
    middle = [(side - 1) / 2 for side in image.shape[:2]]
    offset = [m - m / factor for m in middle]
    channels = np.moveaxis(image, 2, 0) if image.ndim == 3 else image[None]
    made = np.stack(
        [
            ndimage.affine_transform(c, [1 / factor, 1 / factor], offset, order=3, mode="constant", cval=np.nan)
            for c in channels
        ]
    ).astype(np.float32)
    return np.moveaxis(made, 0, 2) if image.ndim == 3 else made[0]


def _checked(stack: ViewStack, weights: NDArray[np.floating] | None) -> NDArray[np.float64]:
    """(V, U) weights whose sum is 1."""
    share = np.ones(stack.views.shape[:2]) if weights is None else np.asarray(weights, dtype=np.float64)
    if share.shape != stack.views.shape[:2]:
        raise DecodeError(f"weights of shape {share.shape} for {stack.views.shape[0]} × {stack.views.shape[1]} views")
    if not (np.all(np.isfinite(share)) and np.all(share >= 0) and share.sum() > 0):
        raise DecodeError("the views' weights must be 0 or more, and not all 0")
    normal: NDArray[np.float64] = share / share.sum()
    return normal


def _focused(
    stack: ViewStack, views: NDArray[np.float32], disparity: float, share: NDArray[np.float64], workers: int
) -> Image:
    """One colour (h, w): by the sinc where all of it lies in all views, else by cubic convolution."""
    total, seen = _summed(stack, views, _Shift(disparity, _sinc), share, workers)
    whole = seen > 1 - _LEAST_WEIGHT
    if whole.all():
        return total
    near, seen = _summed(stack, views, _Shift(disparity, _cubic), share, workers)
    known = seen > _LEAST_WEIGHT
    made: Image = np.where(known, near / np.where(known, seen, 1), np.float32(np.nan)).astype(np.float32)
    return np.where(whole, total, made)


def _summed(
    stack: ViewStack, views: NDArray[np.float32], shift: _Shift, share: NDArray[np.float64], workers: int
) -> tuple[Image, NDArray[np.float32]]:
    """(sum, the share of views in it): columns are shifted view by view, rows once for each row of views,
    Σ_v shift_y(Σ_u shift_x(L_vu))."""
    height, width = views.shape[2:]
    rows = np.zeros((len(stack.row_steps), height, width), dtype=np.float32)
    down = np.zeros((len(stack.row_steps), height))
    across = np.zeros((len(stack.column_steps), width))
    for u, step in enumerate(stack.column_steps):
        across[u, slice(*shift.taps(step, width).span)] = 1

    def one(v: int) -> None:
        line = np.zeros((height, width), dtype=np.float32)
        for u, step in enumerate(stack.column_steps):
            if share[v, u]:
                _add_shifted(line, views[v, u], shift.taps(step, width), share[v, u], by_columns=True)
        taps = shift.taps(stack.row_steps[v], height)
        _add_shifted(rows[v], line, taps, 1.0, by_columns=False)
        down[v, slice(*taps.span)] = 1

    each(one, range(len(stack.row_steps)), workers)
    return rows.sum(axis=0), (down.T @ share @ across).astype(np.float32)


@dataclass(frozen=True, slots=True)
class _Taps:
    """What a shift along an axis does: pixel i becomes Σ weight·pixel[i + offset], for i in `span`."""

    offsets: tuple[int, ...]
    weights: tuple[float, ...]
    span: tuple[int, int]


@dataclass(frozen=True, slots=True)
class _Shift:
    """How views are moved: `disparity` times their steps, between pixels by the weights that `between` has for them."""

    disparity: float
    between: Callable[[float], tuple[float, ...]]

    def taps(self, step: float, side: int) -> _Taps:
        """The taps at a fractional shift; one tap at a whole one."""
        shift = self.disparity * step
        whole = math.floor(shift)
        t = shift - whole
        if t < 1e-6 or t > 1 - 1e-6:
            offsets: tuple[int, ...] = (round(shift),)
            weights: tuple[float, ...] = (1.0,)
        else:
            weights = self.between(t)
            offsets = tuple(range(whole + 1 - len(weights) // 2, whole + 1 + len(weights) // 2))
        first, last = max(0, -offsets[0]), min(side, side - offsets[-1])
        return _Taps(offsets, weights, (first, max(first, last)))


def _cubic(t: float) -> tuple[float, ...]:
    """Cubic convolution with a = −1/2."""
    return (
        ((-0.5 * t + 1) * t - 0.5) * t,
        (1.5 * t - 2.5) * t * t + 1,
        ((-1.5 * t + 2) * t + 0.5) * t,
        (0.5 * t - 0.5) * t * t,
    )


def _sinc(t: float) -> tuple[float, ...]:
    """sin(πx)/πx of `_TAPS` taps under a Kaiser window; their sum is 1."""
    away = t - np.arange(1 - _TAPS // 2, 1 + _TAPS // 2)
    weights = np.sinc(away) * np.i0(_KAISER * np.sqrt(np.maximum(1 - (2 * away / _TAPS) ** 2, 0)))
    return tuple((weights / weights.sum()).tolist())


def _add_shifted(out: Image, image: Image, taps: _Taps, share: float, *, by_columns: bool) -> None:
    """Add `share` times the shifted image to `out`, as far as all taps lie inside."""
    first, last = taps.span
    if first >= last:
        return
    target = out[:, first:last] if by_columns else out[first:last]
    scratch = np.empty_like(target)
    for offset, weight in zip(taps.offsets, taps.weights, strict=True):
        here = slice(first + offset, last + offset)
        np.multiply(image[:, here] if by_columns else image[here], np.float32(share * weight), out=scratch)
        target += scratch
