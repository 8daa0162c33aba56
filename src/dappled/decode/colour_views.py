"""Views in red, green and blue behind a printed mask: each colour's own DC view, with the parallax of the grey views.

Red alone is sampled every other pixel, and most carriers would alias onto others; around zero frequency it is whole.
What a view's grey differs from the DC view's has three parts. One is a move by the disparity that a depth map of the
views has, at edges that of the nearer of two things: colours move as far as grey, even where two of them have the same
grey. Another part is shade, the same for all around. The rest is what neither explains: what is hidden, and where depth
is wrong. Where two things meet, their colours blend in the DC view as their greys do, so a colour is near a straight
line over grey, a few samples around (He, Sun and Tang, "Guided image filtering"): along it a colour follows shade and
rest. Where moves explain little, the rest is mostly the views' own error, and counts less.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray
from scipy import ndimage, sparse

from dappled.decode.array_types import Floats, Singles
from dappled.decode.depth.depth_map import nearest_known
from dappled.decode.depth.estimate import estimate
from dappled.decode.depth.evidence import of_views
from dappled.decode.errors import DecodeError
from dappled.decode.lightfield import ViewStack

# Chosen by hand where no figure stands beside a number; benchmarks/colour_views.py measures what they make together.

_AROUND = 11  # samples of a view on each side: what is the same around
_SMOOTH, _NEARER, _SOFT = 5, 3, 0.6  # samples: the windows of a median, and of the nearest; the last one's blur
_SLOPE = np.array([1, -8, 0, 8, -1]) / 12  # of a line of samples, exact for polynomials of fourth order
_TRUST = 1.5  # times the share that moves explain, and at most 1: the square of how much of the rest counts
_BOX = 5  # samples of a view on each side, in which a colour is taken as linear in grey
_CELL_PX = 12  # local means: half a period of the mask
_LOBES = 12  # of the interpolating sinc on each side
_FLAT = 0.08  # of grey's mean: where grey varies less, noise and folded detail do, and colour is a share of grey
_MOST = 10.0  # times grey
_DARK = 1e-3  # of grey's mean


def dc_views(
    plane: Singles, index: NDArray[np.integer], colours: Sequence[int], size: tuple[int, int], grid: Floats
) -> Singles:
    """float32 (len(colours), h, w): the band around zero frequency of each colour, at the samples of a slice.

    `plane` (H, W) is linear, its colours not evened from place to place; `index` (H, W) says which colour a pixel is,
    `size` is (h, w) of a slice, `grid` as in `LightField`. Other colours' pixels are filled with the colour's local
    mean, so that the pattern has little to repeat; what is left is divided by what the colour's pixels have of the
    band. Raises DecodeError for a colour without pixels in some place.
    """
    (height, width), (rows, columns) = plane.shape, size
    down = _band(height, rows, grid[0, 0], grid[0, 2])
    across = _band(width, columns, grid[1, 1], grid[1, 2])
    made = np.empty((len(colours), rows, columns), dtype=np.float32)
    for out, colour in zip(made, colours, strict=True):
        here = (index == colour).astype(np.float32)
        share = _local_mean(here)
        if not share.min() > 0:
            raise DecodeError(f"the colour pattern has no pixel of colour {colour} in some places of the frame")
        local = _local_mean(plane * here) / share
        least = 0.5 * float(here.mean())
        rest = _through(down, (plane - local) * here, across) / np.maximum(_through(down, here, across), least)
        out[...] = _through(down, local, across) + rest
    return made


def in_colour(
    views: Singles, grey: Singles, colours: Singles, *, row_over_column: float = 1.0, workers: int = 1
) -> Singles:
    """float32 (V, U, h, w, C): each colour's DC view, moved by the disparity there, plus its slope over grey times what
    the move leaves of a view's difference from the grey DC view.

    `views` (V, U, h, w), evenly spaced over the aperture; `grey` (h, w) their DC view, `colours` (C, h, w) as from
    `dc_views`; `row_over_column` the height of a sample over its width. The slope is the colour's covariance with grey
    over grey's variance in boxes, averaged over the boxes that hold a sample. Where grey hardly varies, it tends to the
    colour's share of grey.
    """
    made = np.empty((*views.shape, len(colours)), dtype=np.float32)
    if not made.size:
        return made
    down, across = (np.arange(n) - (n - 1) / 2 for n in views.shape[:2])
    places = down / row_over_column, across
    beyond = views - grey
    disparity = _disparity(views, places, workers)
    rest = beyond - _moved(grey, disparity, places)
    shade = _around(rest).astype(np.float32)
    rest = shade + (rest - shade) * _trusted(rest - shade, beyond - shade)
    mean = _box(grey)
    spread = np.maximum(_box(grey * grey) - mean**2, 0)
    level = max(float(np.abs(grey).mean()), 1e-12)
    least = (_FLAT * level) ** 2
    for number, colour in enumerate(colours):
        own = _box(colour)
        ratio = np.clip(own / np.maximum(mean, _DARK * level), 0, _MOST)
        slope = _box((_box(colour * grey) - own * mean + least * ratio) / (spread + least))
        made[..., number] = colour + _moved(colour, disparity, places) + slope.astype(np.float32) * rest
    return made


def _disparity(views: Singles, places: tuple[Floats, Floats], workers: int) -> Singles:
    """(h, w) columns from view to view of the nearest thing around each sample, by the nearest sample whose depth is
    known; 0 where none is."""
    if max(views.shape[:2]) < 2:
        return np.zeros(views.shape[2:], dtype=np.float32)
    found = estimate(of_views(ViewStack(views, *places)), workers=workers)
    smooth = ndimage.median_filter(np.nan_to_num(nearest_known(found.disparity, found.known)), _SMOOTH)
    return np.asarray(ndimage.gaussian_filter(ndimage.maximum_filter(smooth, _NEARER), _SOFT), dtype=np.float32)


def _moved(image: Singles, disparity: Singles, places: tuple[Floats, Floats]) -> Singles:
    """(V, U, h, w): by how much each view of an image (h, w), the mean of all views, differs from it where all of it
    moves: Taylor's series to second order."""
    down, across = (place.astype(np.float32)[:, None, None] for place in places)
    dy, dx = (_slope(image, axis) * -disparity for axis in (0, 1))
    dyy, dyx, dxx = ((_slope(_slope(image, a), b) * disparity**2) for a, b in ((0, 0), (0, 1), (1, 1)))
    rows = down * dy + (down**2 - np.mean(down**2)) * dyy / 2
    columns = across * dx + (across**2 - np.mean(across**2)) * dxx / 2
    return np.asarray(rows[:, None] + columns + down[:, None] * across * dyx, dtype=np.float32)


def _slope(image: Singles, axis: int) -> Singles:
    """(h, w) the image's change a sample; 0 along an axis of one sample."""
    return np.asarray(ndimage.correlate1d(image, _SLOPE, axis=axis, mode="nearest"), dtype=np.float32)


def _trusted(rest: Singles, beyond: Singles) -> Singles:
    """(h, w) how much of the rest counts, from 0 to 1."""
    left, whole = (_around(np.mean(part**2, axis=(0, 1))) for part in (rest, beyond))
    explained = 1 - left / np.maximum(whole, 1e-20)
    return np.asarray(np.sqrt(np.clip(_TRUST * explained, 0, 1)), dtype=np.float32)


def _around(values: Floats | Singles) -> Floats:
    """Local means of images (…, h, w)."""
    return np.asarray(ndimage.uniform_filter(values.astype(np.float64), _AROUND, mode="nearest", axes=(-2, -1)))


def _box(values: NDArray[np.floating]) -> Floats:
    return np.asarray(ndimage.uniform_filter(values.astype(np.float64), _BOX, mode="nearest"))


def _local_mean(values: Singles) -> Singles:
    for _ in range(2):  # one box leaves 8 % of what the pattern repeats beside its own frequency
        values = ndimage.uniform_filter(values, _CELL_PX, mode="mirror")
    return values


def _through(down: sparse.csr_array, plane: Singles, across: sparse.csr_array) -> Singles:
    return np.asarray((across @ (down @ plane).T).T, dtype=np.float32)


def _band(pixels: int, count: int, step: float, first: float) -> sparse.csr_array:
    """(count, pixels): from pixels to samples `step` apart, every frequency within half a sample rate and no other."""
    reach = int(np.ceil(_LOBES * step))
    middle = first + np.arange(count) * step
    columns = np.rint(middle)[:, None].astype(np.int64) + np.arange(-reach, reach + 1)
    at = (columns - middle[:, None]) / step
    kernel = np.sinc(at) * np.sinc(np.clip(at / _LOBES, -1, 1))
    kernel /= kernel.sum(axis=1, keepdims=True)
    rows = np.repeat(np.arange(count), columns.shape[1])
    inside = (pixels - 1) - np.abs(np.abs(columns) - (pixels - 1))  # mirrored at the outer pixels: the pattern goes on
    places = np.clip(inside, 0, pixels - 1).ravel()
    return sparse.csr_array((kernel.ravel().astype(np.float32), (rows, places)), shape=(count, pixels))
