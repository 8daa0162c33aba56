"""Boards with detail far beyond what a slice, and even a pixel, can hold: power-law textures and photographs.

The boards face the camera. One of disparity D (mm on the sensor for each mm on the aperture) is seen from aperture
point θ moved by D·θ; 0 is in focus. A later board hides those before it.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy.typing import NDArray
from scipy import fft, ndimage

from dappled.decode.array_types import Singles

FINER = 2  # samples of a board for each of the fine grid, so that a shift between them costs little
_DARKEST = 0.05  # of the mean: a textured board is nowhere black


@dataclass(frozen=True)
class SharpBoard:
    """One board.

    `disparity` is dx/dθ. `extent` (top, bottom, left, right) in shares of the frame's sides from its middle, None for a
    backdrop without end. `colour` is the mean radiance of the texture, whose amplitude falls as frequency^-`exponent`
    from one cycle a frame on, with an rms of `contrast`; `finest` (cycles/pixel) band-limits it, None not at all.
    `picture` (rows, columns, 3), linear, stands in place of the texture, stretched over the frame.
    """

    disparity: float = 0.0
    extent: tuple[float, float, float, float] | None = None
    colour: tuple[float, float, float] = (0.42, 0.40, 0.37)
    exponent: float = 1.3
    contrast: float = 0.25
    finest: float | None = None
    picture: Singles | None = None


@dataclass(frozen=True)
class FineGrid:
    """Where light is computed before the pixels gather it: `finer`² samples in each of `frame`'s pixels."""

    frame: tuple[int, int]
    pitch_mm: tuple[float, float]
    finer: int

    @property
    def shape(self) -> tuple[int, int]:
        """Rows and columns of the samples."""
        return self.frame[0] * self.finer, self.frame[1] * self.finer

    @cached_property
    def places_mm(self) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """y (rows,) and x (columns,) of the samples on the sensor, from its middle."""
        y, x = ((np.arange(n) - (n - 1) / 2) * p / self.finer for n, p in zip(self.shape, self.pitch_mm, strict=True))
        return y, x

    def on_pixels(self, fine: Singles) -> Singles:
        """(..., H, W): the mean over each pixel's square, of some rows of pixels or all."""
        return np.asarray(fine.reshape(*fine.shape[:-2], -1, self.finer, self.frame[1], self.finer).mean(axis=(-3, -1)))


@dataclass(frozen=True)
class SharpScene:
    """Boards drawn on a fine grid with `margin` (y, x) samples of the board around it: `light` (C, rows, columns) of
    each, times its cover, and `cover` (rows, columns), None for a backdrop."""

    grid: FineGrid
    margin: tuple[int, int]
    layers: tuple[tuple[float, Singles, Singles | None], ...]

    @classmethod
    def of(
        cls, boards: tuple[SharpBoard, ...], grid: FineGrid, aperture_mm: float, *, seed: int, grey: bool,
        defocus: float = 0.0, cutoff_per_mm: float | None = None,
    ) -> SharpScene:  # fmt: skip
        """Draw them, with room for the shifts over an aperture.

        `defocus` is added to every board's disparity, `grey` keeps the mean of the colours. At `cutoff_per_mm` the
        diffraction of a round lens ends all contrast; None leaves it out.
        """
        far = max(abs(board.disparity + defocus) for board in boards) * aperture_mm / 2
        margin = tuple(math.ceil(far / p * grid.finer * FINER) + 2 * FINER for p in grid.pitch_mm)
        shape = tuple(n * FINER + 2 * m for n, m in zip(grid.shape, margin, strict=True))
        rng = np.random.default_rng([seed, 31])
        layers = []
        for board in boards:
            light = _light(board, grid, (shape[0], shape[1]), rng, grey=grey)
            if cutoff_per_mm is not None:
                light = _through_lens(light, grid, cutoff_per_mm)
            cover = None if board.extent is None else _cover(board.extent, grid, (margin[0], margin[1]))
            layers.append((board.disparity + defocus, light if cover is None else light * cover, cover))
        return cls(grid, (margin[0], margin[1]), tuple(layers))

    @property
    def flat(self) -> bool:
        """Whether every aperture point sees the same."""
        return all(disparity == 0 for disparity, _, _ in self.layers)

    def at_height(self, theta_mm: float, rows: slice) -> RowsSeen:
        """What the points of one row of the aperture have in common: some rows of every board, moved up or down."""
        found = []
        for disparity, light, cover in self.layers:
            first, part, _ = self.shift(disparity * theta_mm, 0)
            first, count = first + rows.start * FINER, (rows.stop - rows.start) * FINER
            hidden = None if cover is None else _halves(_moved_rows(cover, first, part, count))
            found.append((disparity, _halves(_moved_rows(light, first, part, count)), hidden))
        return RowsSeen(self, found)

    def shift(self, by_mm: float, axis: int) -> tuple[int, np.float32, int]:
        """First sample of a board, the share of its neighbour, and their number, for a board moved by `by_mm`."""
        samples_per_mm = self.grid.finer * FINER / self.grid.pitch_mm[axis]
        at = self.margin[axis] + (FINER - 1) / 2 - by_mm * samples_per_mm
        first = math.floor(at)
        return first, np.float32(at - first), self.grid.shape[axis] * FINER


Halves = tuple[Singles, Singles]


@dataclass(frozen=True)
class RowsSeen:
    """The boards of a scene on the fine grid's rows, their columns' even and odd samples apart."""

    scene: SharpScene
    boards: list[tuple[float, Halves, Halves | None]]

    def seen_from(self, theta_mm: float, out: Singles) -> None:
        """The light (C, rows, columns) on the fine grid from the aperture point at x = `theta_mm`, into `out`."""
        for disparity, light, cover in self.boards:
            first, part, count = self.scene.shift(disparity * theta_mm, 1)
            moved = _between(light, first, part, count)
            if cover is None:
                out[:] = moved
            else:
                out *= 1 - _between(cover, first, part, count)
                out += moved


def _moved_rows(board: Singles, first: int, part: np.float32, count: int) -> Singles:
    one, two = board[..., first : first + count : FINER, :], board[..., first + 1 : first + 1 + count : FINER, :]
    return np.asarray(one * (1 - part) + two * part)


def _halves(board: Singles) -> Halves:
    return np.ascontiguousarray(board[..., 0::2]), np.ascontiguousarray(board[..., 1::2])


def _between(board: Halves, first: int, part: np.float32, count: int) -> Singles:
    """Every second sample from `first` on, linear to its right neighbour."""
    one = board[first % 2][..., first // 2 : first // 2 + count // 2]
    two = board[(first + 1) % 2][..., (first + 1) // 2 : (first + 1) // 2 + count // 2]
    return np.asarray(one * (1 - part) + two * part)


def _light(
    board: SharpBoard, grid: FineGrid, shape: tuple[int, int], rng: np.random.Generator, *, grey: bool
) -> Singles:
    colour = np.array(board.colour, dtype=np.float32)
    if board.picture is not None:
        high, wide = board.picture.shape[:2]
        zoom = max(n * FINER / side for n, side in zip(grid.shape, (high, wide), strict=True))
        at = [(np.arange(n) - (n - 1) / 2) / zoom + (side - 1) / 2 for n, side in zip(shape, (high, wide), strict=True)]
        places = np.stack(np.meshgrid(*at, indexing="ij")).astype(np.float32)
        channels = [ndimage.map_coordinates(board.picture[..., c], places, order=1, mode="reflect") for c in range(3)]
        light = np.stack(channels).astype(np.float32)
        return light.mean(axis=0, keepdims=True) if grey else light
    if grey:
        colour = colour.mean(keepdims=True)
    if board.contrast == 0:
        return np.broadcast_to(colour[:, None, None], (len(colour), *shape)).astype(np.float32)
    rows, columns = (fft.fftfreq(n) * grid.finer * FINER for n in shape)  # cycles/pixel
    f = np.hypot(rows[:, None], columns[None, : shape[1] // 2 + 1])
    size = np.maximum(f, 1 / max(grid.frame)) ** -board.exponent
    if board.finest is not None:
        size = size * (f <= board.finest)
    size = size * (np.maximum(abs(rows)[:, None], abs(columns)[None, : shape[1] // 2 + 1]) <= grid.finer / 2)
    size[0, 0] = 0
    noise = fft.rfft2(rng.standard_normal(shape, dtype=np.float32), workers=2)
    texture = fft.irfft2(noise * size.astype(np.float32), s=shape, workers=2)
    texture *= np.float32(board.contrast) / texture.std()
    if board.finest is None:
        texture = np.maximum(texture, _DARKEST - 1)
    return np.asarray(colour[:, None, None] * (1 + texture), dtype=np.float32)


def _through_lens(light: Singles, grid: FineGrid, cutoff_per_mm: float) -> Singles:
    """The incoherent transfer of a round lens: 2/π·(acos s − s·√(1 − s²)) at s = f/cutoff."""
    steps = [p / grid.finer / FINER for p in grid.pitch_mm]
    fy, fx = fft.fftfreq(light.shape[-2], steps[0])[:, None], fft.rfftfreq(light.shape[-1], steps[1])[None]
    s = np.clip(np.hypot(fy, fx) / cutoff_per_mm, 0, 1)
    transfer = (2 / np.pi * (np.arccos(s) - s * np.sqrt(1 - s * s))).astype(np.float32)
    return np.asarray(fft.irfft2(fft.rfft2(light, workers=2) * transfer, s=light.shape[-2:], workers=2))


def _cover(extent: tuple[float, float, float, float], grid: FineGrid, margin: tuple[int, int]) -> Singles:
    top, bottom, left, right = extent
    sides = []
    for axis, (low, high) in enumerate(((top, bottom), (left, right))):
        n = grid.shape[axis] * FINER
        at = np.arange(n + 2 * margin[axis]) - margin[axis] - (n - 1) / 2
        sides.append(np.clip(np.minimum(at - low * n, high * n - at) + 0.5, 0, 1))
    return np.asarray(np.outer(sides[0], sides[1]), dtype=np.float32)
