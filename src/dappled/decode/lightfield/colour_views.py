"""Views in red, green and blue behind a printed mask: each colour's own DC view, with the parallax of the grey views.

Red alone is sampled every other pixel, and most carriers would alias onto others; around zero frequency it is whole.
Where two things meet, their colours blend in the DC view as their greys do, so a colour is near a straight line over
grey, a few samples around (He, Sun and Tang, "Guided image filtering"): along it each view's colour follows its grey.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray
from scipy import ndimage, sparse

from dappled.decode.array_types import Floats, Singles
from dappled.decode.errors import DecodeError

_BOX = 5  # samples of a view on each side, in which a colour is taken as linear in grey
_CELL_PX = 12  # local means: half a period of the mask
_LOBES = 12  # of the interpolating sinc on each side
_FLAT = 0.05  # of grey's mean: where grey varies less, noise and folded detail do, and colour is a share of grey
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


def in_colour(views: Singles, grey: Singles, colours: Singles) -> Singles:
    """float32 (V, U, h, w, C): each colour's DC view plus its slope over grey times what a view differs from the grey
    DC view.

    `views` (V, U, h, w), `grey` (h, w) their DC view, `colours` (C, h, w) as from `dc_views`. The slope is the colour's
    covariance with grey over grey's variance in boxes, averaged over the boxes that hold a sample. Where grey hardly
    varies, it tends to the colour's share of grey.
    """
    mean = _box(grey)
    spread = np.maximum(_box(grey * grey) - mean**2, 0)
    level = max(float(np.abs(grey).mean()), 1e-12)
    least = (_FLAT * level) ** 2
    beyond = views - grey
    made = np.empty((*views.shape, len(colours)), dtype=np.float32)
    for number, colour in enumerate(colours):
        own = _box(colour)
        ratio = np.clip(own / np.maximum(mean, _DARK * level), 0, _MOST)
        slope = _box((_box(colour * grey) - own * mean + least * ratio) / (spread + least))
        made[..., number] = colour + slope.astype(np.float32) * beyond
    return made


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
