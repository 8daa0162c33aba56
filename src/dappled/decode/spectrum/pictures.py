"""Pictures of a spectrum: magnitude, phase in colour and Laplacian, with the slices' boxes (Figs 30 to 36, 41, 42).

Phases are yellow at 0 and red at π: the ends of the thesis' colours, which it calls real and imaginary.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Literal

import numpy as np
from numpy.typing import NDArray
from scipy import fft

from dappled.decode.optics import Carrier
from dappled.decode.spectrum.peaks import Measured

Look = Literal["magnitude", "phase", "laplacian"]
Colour = NDArray[np.uint8]
_RED, _GREEN, _YELLOW, _BLUE = (230, 30, 30), (60, 220, 60), (250, 220, 40), (70, 130, 255)  # sRGB, 8 bits


def spectrum_boxes(
    plane: NDArray[np.float32],
    carriers: Sequence[Carrier],
    slice_cycles: tuple[float, float],
    *,
    predicted: Sequence[Carrier] | None = None,
    measured: Sequence[Measured | None] = (),
    look: Look = "magnitude",
    longest_side: int = 1200,
) -> Colour:
    """uint8 RGB (H, W, 3): the spectrum, DC in the middle, at most `longest_side` px a side.

    A red box (blue over phases, which are red themselves) of `slice_cycles` (height, width in cycles/pixel) around
    each carrier and its conjugate, a yellow cross where it is `predicted` (None: where the box is), a green ring where
    one was measured.
    """
    picture = _pictured(_centred(plane, windowed=look != "phase"), look, longest_side)
    tall, wide = picture.shape[:2]

    def place(fy: float, fx: float) -> tuple[int, int]:
        return round((0.5 + fy) * tall), round((0.5 + fx) * wide)

    edge = _BLUE if look == "phase" else _RED
    for carrier in carriers:
        for sign in (1, -1):
            fy, fx = sign * carrier.fy, sign * carrier.fx
            top, left_edge = place(fy - slice_cycles[0] / 2, fx - slice_cycles[1] / 2)
            bottom, right_edge = place(fy + slice_cycles[0] / 2, fx + slice_cycles[1] / 2)
            _box(picture, (top, bottom), (left_edge, right_edge), edge)
    for carrier in carriers if predicted is None else predicted:
        for sign in (1, -1):
            row, column = place(sign * carrier.fy, sign * carrier.fx)
            _line(picture, (row, row), (column - 3, column + 3), _YELLOW)
            _line(picture, (row - 3, row + 3), (column, column), _YELLOW)
    for peak in measured:
        if peak is not None:
            for sign in (1, -1):
                row, column = place(sign * peak.fy, sign * peak.fx)
                _box(picture, (row - 5, row + 5), (column - 5, column + 5), _GREEN)
    return picture


def around(
    plane: NDArray[np.float32],
    frequency: tuple[float, float],
    *,
    look: Look = "phase",
    bins: int = 24,
    longest_side: int = 480,
) -> Colour:
    """uint8 RGB (S, S, 3): the `bins` × `bins` bins around a frequency (fy, fx), each a square (Fig 35).

    No window lies on the plane: if a carrier lies between bins, diagonal neighbours have the same phase and direct ones
    opposite phases.
    """
    centred = _centred(plane, windowed=False)
    height, width = centred.shape
    top = round(height // 2 + frequency[0] * height) - bins // 2
    left = round(width // 2 + frequency[1] * width) - bins // 2
    part = centred[np.ix_(np.arange(top, top + bins) % height, np.arange(left, left + bins) % width)]
    small = _pictured(part, look, bins)
    times = max(1, longest_side // bins)
    return np.ascontiguousarray(small.repeat(times, axis=0).repeat(times, axis=1))


def _centred(plane: NDArray[np.float32], *, windowed: bool) -> NDArray[np.complex64]:
    """The DFT of the plane less its mean, DC at (H//2, W//2); a Hann window lies on it where it is `windowed`."""
    light = plane - np.float32(plane.mean())
    if windowed:
        light *= np.hanning(plane.shape[0]).astype(np.float32)[:, None]
        light *= np.hanning(plane.shape[1]).astype(np.float32)
    half = fft.rfft2(light)
    height, width = plane.shape
    columns = np.arange(width) - width // 2
    rows = np.arange(height) - height // 2
    right = half[np.ix_(rows, columns[columns >= 0])]
    left = np.conj(half[np.ix_(-rows % height, -columns[columns < 0])])
    return np.concatenate([left, right], axis=1)


def _pictured(centred: NDArray[np.complex64], look: Look, longest_side: int) -> Colour:
    """Scaled down by the strongest bin of each block, so that peaks stay."""
    if look != "phase":
        size = np.abs(centred)
        shown = np.log((size if look == "magnitude" else _above_neighbours(size)) + np.float32(1e-9))
        bright = _bright(_pooled(shown, longest_side), 0.02 if look == "magnitude" else 0.5, 0.9999)
        return np.repeat(bright[:, :, None], 3, axis=2)
    strongest = _strongest(centred, longest_side)
    size = np.abs(strongest)
    bright = _bright(np.log(size + np.float32(1e-9)), 0.02, 0.9999)
    turn = (1 + strongest.real / np.maximum(size, np.float32(1e-9))) / 2  # phase 0: yellow, phase π: red
    green = np.rint(bright * turn).astype(np.uint8)
    return np.stack([bright, green, np.zeros_like(bright)], axis=2)


def _above_neighbours(size: NDArray[np.float32]) -> NDArray[np.float32]:
    """The Laplacian of the magnitude where it is negative, turned positive: bins that are larger than their
    neighbours."""
    ring = sum(np.roll(size, step, axis) for step in (1, -1) for axis in (0, 1))
    return np.asarray(np.maximum(4 * size - ring, 0), dtype=np.float32)


def _bright(values: NDArray[np.floating], low_share: float, high_share: float) -> NDArray[np.uint8]:
    low, high = np.quantile(values, [low_share, high_share])
    bright: NDArray[np.uint8] = np.rint(255 * np.clip((values - low) / max(high - low, 1e-9), 0, 1)).astype(np.uint8)
    return bright


def _pooled(image: NDArray[np.floating], longest_side: int) -> NDArray[np.floating]:
    """The largest value of each block; the shape is divided by the smallest whole number that makes it fit."""
    step = max(1, -(-max(image.shape) // longest_side))
    if step == 1:
        return image
    rows = np.maximum.reduceat(image, np.arange(0, image.shape[0], step), axis=0)
    pooled: NDArray[np.floating] = np.maximum.reduceat(rows, np.arange(0, image.shape[1], step), axis=1)
    return pooled


def _strongest(centred: NDArray[np.complex64], longest_side: int) -> NDArray[np.complex64]:
    """The strongest bin of each block, with its phase."""
    step = max(1, -(-max(centred.shape) // longest_side))
    if step == 1:
        return centred
    height, width = (-(-side // step) for side in centred.shape)
    padded = np.zeros((height * step, width * step), dtype=np.complex64)
    padded[: centred.shape[0], : centred.shape[1]] = centred
    blocks = padded.reshape(height, step, width, step).swapaxes(1, 2).reshape(height, width, step * step)
    best = np.argmax(np.abs(blocks), axis=2)
    return np.asarray(np.take_along_axis(blocks, best[:, :, None], axis=2)[:, :, 0])


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
