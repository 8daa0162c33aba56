"""Pictures of what the decoder did: the slice mosaic (Fig 43), the spectrum with its boxes (Fig 42), the views."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray
from scipy import fft

from dappled.decode.carriers import Carrier
from dappled.decode.peaks import Measured

Grey = NDArray[np.uint8]
Colour = NDArray[np.uint8]
_RED, _GREEN, _YELLOW = (230, 30, 30), (60, 220, 60), (250, 220, 40)


def slice_mosaic(slices: NDArray[np.complex64], carriers: NDArray[np.float64], *, longest_side: int = 2400) -> Grey:
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
    return _smaller(out, longest_side)


def view_mosaic(views: NDArray[np.float32], *, longest_side: int = 2400) -> NDArray[np.uint8]:
    """uint8 (H, W) or (H, W, 3): all views (V, U, h, w(, 3)) side by side, one common scale from 0, display gamma."""
    v, u, height, width = views.shape[:4]
    flat = np.moveaxis(views, 2, 1).reshape(v * height, u * width, *views.shape[4:])
    step = max(1, -(-max(flat.shape[:2]) // longest_side))
    flat = flat[::step, ::step]
    top = max(float(np.quantile(flat, 0.995)), 1e-9)
    picture: NDArray[np.uint8] = np.rint(255 * np.clip(flat / top, 0, 1) ** (1 / 2.2)).astype(np.uint8)
    return picture


def spectrum_boxes(
    plane: NDArray[np.float32],
    carriers: Sequence[Carrier],
    slice_cycles: tuple[float, float],
    *,
    measured: Sequence[Measured | None] = (),
    longest_side: int = 1200,
) -> Colour:
    """uint8 RGB (H, W, 3): log magnitude of the spectrum, DC in the middle, at most `longest_side` px a side.

    A red box of `slice_cycles` (height, width in cycles/pixel) around each carrier and its conjugate, a yellow cross
    where it is predicted, a green ring where one was measured. Scaled down by the maximum, so that peaks stay.
    """
    windowed = (plane - np.float32(plane.mean())) * np.hanning(plane.shape[0]).astype(np.float32)[:, None]
    windowed *= np.hanning(plane.shape[1]).astype(np.float32)
    half = np.abs(fft.rfft2(windowed))
    height, width = plane.shape
    columns = np.arange(width) - width // 2
    rows = np.arange(height) - height // 2
    right = half[np.ix_(rows, columns[columns >= 0])]
    left = half[np.ix_(-rows % height, -columns[columns < 0])]
    log = np.log(_pooled(np.concatenate([left, right], axis=1), longest_side) + 1e-9)
    low, high = np.quantile(log, [0.02, 0.9999])
    grey = np.rint(255 * np.clip((log - low) / max(high - low, 1e-9), 0, 1)).astype(np.uint8)
    picture: Colour = np.repeat(grey[:, :, None], 3, axis=2)
    tall, wide = grey.shape

    def place(fy: float, fx: float) -> tuple[int, int]:
        return round((0.5 + fy) * tall), round((0.5 + fx) * wide)

    for carrier in carriers:
        for sign in (1, -1):
            fy, fx = sign * carrier.fy, sign * carrier.fx
            top, left_edge = place(fy - slice_cycles[0] / 2, fx - slice_cycles[1] / 2)
            bottom, right_edge = place(fy + slice_cycles[0] / 2, fx + slice_cycles[1] / 2)
            _box(picture, (top, bottom), (left_edge, right_edge), _RED)
            row, column = place(fy, fx)
            _line(picture, (row, row), (column - 3, column + 3), _YELLOW)
            _line(picture, (row - 3, row + 3), (column, column), _YELLOW)
    for peak in measured:
        if peak is not None:
            for sign in (1, -1):
                row, column = place(sign * peak.fy, sign * peak.fx)
                _box(picture, (row - 5, row + 5), (column - 5, column + 5), _GREEN)
    return picture


def _stretched(image: NDArray[np.floating]) -> Grey:
    high = max(float(np.quantile(image, 0.995)), 1e-12)
    grey: Grey = np.rint(255 * np.clip(image / high, 0, 1)).astype(np.uint8)
    return grey


def _smaller(picture: Grey, longest_side: int) -> Grey:
    step = max(1, -(-max(picture.shape) // longest_side))
    return np.ascontiguousarray(picture[::step, ::step])


def _pooled(image: NDArray[np.floating], longest_side: int) -> NDArray[np.floating]:
    """The largest value of each block; the shape is divided by the smallest whole number that makes it fit."""
    step = max(1, -(-max(image.shape) // longest_side))
    if step == 1:
        return image
    rows = np.maximum.reduceat(image, np.arange(0, image.shape[0], step), axis=0)
    pooled: NDArray[np.floating] = np.maximum.reduceat(rows, np.arange(0, image.shape[1], step), axis=1)
    return pooled


def _box(picture: Colour, rows: tuple[int, int], columns: tuple[int, int], colour: tuple[int, int, int]) -> None:
    for row in rows:
        _line(picture, (row, row), columns, colour)
    for column in columns:
        _line(picture, rows, (column, column), colour)


def _line(picture: Colour, rows: tuple[int, int], columns: tuple[int, int], colour: tuple[int, int, int]) -> None:
    """A filled rectangle, ends included, as far as it lies in the picture."""
    (top, bottom), (left, right) = rows, columns
    height, width = picture.shape[:2]
    if bottom < 0 or right < 0 or top >= height or left >= width:
        return
    picture[max(top, 0) : bottom + 1, max(left, 0) : right + 1] = colour
