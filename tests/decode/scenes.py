"""Views of painted boards with exact truth: what refocusing and depth are judged by.

Boards lie in front of each other, each a plane of disparities with a texture of its own. A point of a board at (y, x)
of the middle view is seen by a view with steps (sy, sx) at (y + D·sy, x + D·sx), D being the plane's value there.
"""

from __future__ import annotations

import functools
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy import ndimage

from dappled.decode.lightfield.light_field import ViewStack, centred

Floats = NDArray[np.float32]


@dataclass(frozen=True)
class Board:
    """Disparity `d` at its centre and its slopes per pixel; an ellipse or a rectangle, None for a backdrop."""

    d: float
    slope: tuple[float, float] = (0.0, 0.0)
    centre: tuple[float, float] = (0.0, 0.0)
    half: tuple[float, float] | None = None
    round: bool = False
    turn: float = 0.0
    mean: float = 0.45
    contrast: float = 0.15
    texture: int = 0


def noise(seed: int, side: int = 512, slope: float = 1.0, finest: float = 0.33) -> Floats:
    """A cyclic texture of unit variance, power falling with frequency, nothing above `finest` cycles/pixel."""
    rng = np.random.default_rng([seed, 7])
    f = np.hypot(np.fft.fftfreq(side)[:, None], np.fft.rfftfreq(side)[None])
    f[0, 0] = 1
    spectrum = f**-slope * np.exp(-((f / finest) ** 8)) * np.exp(2j * np.pi * rng.random(f.shape))
    spectrum[0, 0] = 0
    made = np.fft.irfft2(spectrum, s=(side, side))
    return np.asarray(made / made.std(), dtype=np.float32)


def boards(seed: int, side: int, reach: float, count: int = 12) -> list[Board]:
    """A leaning backdrop and `count` boards in rising order, disparities from −`reach` to `reach`."""
    rng = np.random.default_rng([seed, 8])
    made = [Board(-0.6 * reach, (0.5 * reach / side, 0.25 * reach / side), contrast=0.2, texture=0)]
    for number, d in enumerate(np.sort(rng.uniform(-0.6 * reach, 0.9 * reach, count))):
        made.append(
            Board(
                float(d),
                tuple(rng.uniform(-0.3, 0.3, 2) * reach / side),
                tuple(rng.uniform(-0.45, 0.45, 2) * side),
                tuple(rng.uniform(0.05, 0.15, 2) * side),
                bool(rng.integers(2)),
                float(rng.uniform(0, np.pi)),
                float(rng.uniform(0.25, 0.65)),
                float(rng.uniform(0.08, 0.25)),
                number % 4 + 1,
            )
        )
    return made


def paint(layers: list[Board], shape: tuple[int, int], views: int, *, seed: int = 0) -> tuple[ViewStack, Floats]:
    """(views × views of the boards as a stack, true disparity (h, w) of the middle)."""
    steps = centred(views)
    textures = {n: _splines(seed + n) for n in {b.texture for b in layers}}
    out = np.empty((views, views, *shape), dtype=np.float32)
    for i, sy in enumerate(steps):
        for j, sx in enumerate(steps):
            out[i, j], _ = _see(layers, textures, shape, sy, sx)
    _, truth = _see(layers, textures, shape, 0.0, 0.0)
    return ViewStack(out, steps, steps), truth


@functools.cache
def _splines(seed: int) -> Floats:
    made = np.asarray(ndimage.spline_filter(noise(seed), order=3, mode="grid-wrap"))
    made.flags.writeable = False
    return made


def _see(
    layers: list[Board], textures: dict[int, Floats], shape: tuple[int, int], sy: float, sx: float
) -> tuple[Floats, Floats]:
    picture, truth = np.zeros(shape, np.float32), np.zeros(shape, np.float32)
    y, x = np.meshgrid(*(centred(n).astype(np.float32) for n in shape), indexing="ij")
    for number, board in enumerate(layers):
        by, bx = board.slope
        flat = board.d - by * board.centre[0] - bx * board.centre[1]  # D = flat + by·y + bx·x
        where: tuple[slice, slice] = (slice(None), slice(None))
        if board.half is not None:
            reach = 1.5 * max(board.half) + 4 + 2 * max(abs(board.d * sy), abs(board.d * sx)) * 0.1
            at = [board.centre[0] + board.d * sy, board.centre[1] + board.d * sx]
            where = tuple(  # type: ignore[assignment]  # two sides, two slices
                slice(max(0, int(c + (n - 1) / 2 - reach)), max(0, int(c + (n - 1) / 2 + reach)))
                for c, n in zip(at, shape, strict=True)
            )
        ry, rx = y[where] - flat * sy, x[where] - flat * sx
        det = 1 + by * sy + bx * sx
        y0 = ((1 + bx * sx) * ry - bx * sy * rx) / det
        x0 = ((1 + by * sy) * rx - by * sx * ry) / det
        if y0.size == 0:
            continue
        cover: Floats | float = 1.0
        if board.half is not None:
            c, s = np.cos(board.turn), np.sin(board.turn)
            py, px = y0 - board.centre[0], x0 - board.centre[1]
            a, b = c * py + s * px, -s * py + c * px
            if board.round:
                inside = (1 - np.hypot(a / board.half[0], b / board.half[1])) * min(board.half)
            else:
                inside = np.minimum(board.half[0] - np.abs(a), board.half[1] - np.abs(b))
            cover = np.clip(inside + 0.5, 0, 1)
        texture = ndimage.map_coordinates(
            textures[board.texture], [y0 + 97.0 * number, x0 + 61.0 * number], order=3, mode="grid-wrap",
            prefilter=False, output=np.float32,
        )  # fmt: skip
        value = np.float32(board.mean) * (1 + np.float32(board.contrast) * texture)
        picture[where] += cover * (value - picture[where])
        truth[where] = np.where(np.asarray(cover) > 0.5, flat + by * y0 + bx * x0, truth[where])
    return picture, truth


def cameras(views: np.ndarray) -> ViewStack:
    """Views (V, U, h, w(, 3)) of cameras side by side: further to the right, near things are further left."""
    v, u = views.shape[:2]
    return ViewStack(np.asarray(views, dtype=np.float32), -centred(v), -centred(u))
