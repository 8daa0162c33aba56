"""Light fields with exact disparities, for `depth.py`: surfaces seen ray by ray from each view, in three families.

A point of a surface at (y, x) of the middle view (px from its middle) has a disparity D(y, x); a view with steps
(sy, sx) sees it at (y + D·sy, x + D·sx). Each ray of each view meets the nearest surface (largest D) that covers it;
a pixel is the mean of 3 × 3 rays. Textures hold detail up to the pixel's own limit, and views are stored in 8 bits of
sRGB, as the HCI benchmark has them. `boards`: occluders of all sizes; `room`: slanted planes, round and glossy things,
a wall nearly without detail; `fence`: thin bars and leaves in front of fine texture.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy import ndimage

Floats = NDArray[np.float32]
RAYS = 3  # along each side of a pixel
TEXELS = 2  # a pixel
TEXTURE_SIDE = 1024
KINDS = ("fine", "rough", "blotches", "stripes", "smooth", "faint")


@dataclass(frozen=True)
class Surface:
    """D = level + slope·(y, x) + `bulge`·(1 − r²), r being the distance from the centre in half sides. `half` None:
    without end. `round`: an ellipse. `gloss`: strength of a highlight, which stands still while the surface moves."""

    level: float
    slope: tuple[float, float] = (0.0, 0.0)
    centre: tuple[float, float] = (0.0, 0.0)
    half: tuple[float, float] | None = None
    round: bool = False
    turn: float = 0.0
    bulge: float = 0.0
    texture: int = 0
    mean: float = 0.4
    contrast: float = 0.2
    gloss: float = 0.0

    def disparity(self, y: Floats, x: Floats) -> Floats:
        """At points of the middle view."""
        made = self.level + self.slope[0] * (y - self.centre[0]) + self.slope[1] * (x - self.centre[1])
        if self.bulge and self.half is not None:
            a, b = self._own(y, x)
            made = made + self.bulge * np.maximum(1 - (a / self.half[0]) ** 2 - (b / self.half[1]) ** 2, -1)
        return np.asarray(made, dtype=np.float32)

    def covers(self, y: Floats, x: Floats) -> NDArray[np.bool_]:
        """Whether the surface is there, at points of the middle view."""
        if self.half is None:
            return np.ones(y.shape, dtype=bool)
        a, b = self._own(y, x)
        if self.round:
            return np.asarray((a / self.half[0]) ** 2 + (b / self.half[1]) ** 2 < 1)
        return (np.abs(a) < self.half[0]) & (np.abs(b) < self.half[1])

    def _own(self, y: Floats, x: Floats) -> tuple[Floats, Floats]:
        c, s = math.cos(self.turn), math.sin(self.turn)
        py, px = y - np.float32(self.centre[0]), x - np.float32(self.centre[1])
        return c * py + s * px, -s * py + c * px


@dataclass(frozen=True)
class Scene:
    """Surfaces, and the textures (n, side, side) of unit variance that they name by number."""

    name: str
    surfaces: tuple[Surface, ...]
    textures: Floats


@dataclass(frozen=True, eq=False)
class Rendered:
    """`views` float32 (n, n, h, w), linear, at `steps` (n,) both ways, and the middle view's true `disparity`."""

    name: str
    views: Floats
    steps: NDArray[np.float64]
    disparity: Floats


def render(scene: Scene, side: int, count: int, *, reach: float = 0.0) -> Rendered:
    """`count` × `count` square views of a scene; the outermost at a step of `reach` (0: one from view to view)."""
    steps = np.arange(count) - (count - 1) / 2
    if reach:
        steps = steps * (2 * reach / (count - 1))
    views = np.empty((count, count, side, side), dtype=np.float32)
    for v, sy in enumerate(steps):
        for u, sx in enumerate(steps):
            light, _ = seen(scene, side, float(sy), float(sx))
            views[v, u] = _eight_bits(light.reshape(side, RAYS, side, RAYS).mean(axis=(1, 3)))
    _, disparity = seen(scene, side, 0.0, 0.0)
    return Rendered(scene.name, views, steps.astype(np.float64), disparity[RAYS // 2 :: RAYS, RAYS // 2 :: RAYS].copy())


def seen(scene: Scene, side: int, sy: float, sx: float) -> tuple[Floats, Floats]:
    """(light, disparity) of each ray of the view at steps (sy, sx), `RAYS` × `RAYS` a pixel."""
    fine = side * RAYS
    along = ((np.arange(fine) + 0.5) / RAYS - side / 2).astype(np.float32)
    light, nearest = np.zeros((fine, fine), np.float32), np.full((fine, fine), -np.inf, np.float32)
    for number, surface in enumerate(scene.surfaces):
        window = _window(surface, along, sy, sx)
        y, x = np.meshgrid(along[window[0]], along[window[1]], indexing="ij")
        if y.size == 0:
            continue
        y0, x0 = y, x
        for _ in range(2 if surface.slope == (0.0, 0.0) and not surface.bulge else 8):
            at = surface.disparity(y0, x0)
            y0, x0 = y - at * np.float32(sy), x - at * np.float32(sx)
        at = surface.disparity(y0, x0)
        nearer = surface.covers(y0, x0) & (at > nearest[window])
        place = [(p[nearer] * TEXELS + 311.0 * (number + 1)) for p in (y0, x0)]
        value = ndimage.map_coordinates(
            scene.textures[surface.texture], place, order=1, mode="grid-wrap", output=np.float32
        )
        shown = np.float32(surface.mean) * (1 + np.float32(surface.contrast) * value)
        if surface.gloss and surface.half is not None:
            # Fixed to the view: a mirror image far behind the surface.
            far = ((y[nearer] - surface.centre[0]) ** 2 + (x[nearer] - surface.centre[1]) ** 2) / min(surface.half) ** 2
            shown = shown + np.float32(surface.gloss) * np.exp(-8 * far)
        light[window][nearer] = shown
        nearest[window][nearer] = at[nearer]
    return light, nearest


def _window(surface: Surface, along: Floats, sy: float, sx: float) -> tuple[slice, slice]:
    if surface.half is None:
        return slice(None), slice(None)
    size = math.hypot(*surface.half) + 1
    most = surface.level + abs(surface.bulge) + size * math.hypot(*surface.slope)
    least = surface.level - abs(surface.bulge) - size * math.hypot(*surface.slope)
    cut = []
    for centre, step in zip(surface.centre, (sy, sx), strict=True):
        ends = centre + np.array([most * step, least * step])
        cut.append(slice(*np.searchsorted(along, [ends.min() - size, ends.max() + size])))
    return cut[0], cut[1]


def _eight_bits(light: Floats) -> Floats:
    """As it comes back from an sRGB picture of 8 bits."""
    light = np.clip(light, 0, 1)
    encoded = np.where(light <= 0.0031308, 12.92 * light, 1.055 * light ** (1 / 2.4) - 0.055)
    encoded = np.rint(255 * encoded) / 255
    return np.asarray(np.where(encoded <= 0.04045, encoded / 12.92, ((encoded + 0.055) / 1.055) ** 2.4), np.float32)


def textures(seed: int) -> Floats:
    """One of each of `KINDS`, cyclic."""
    rng = np.random.default_rng([seed, 5])
    x = np.arange(TEXTURE_SIDE) / TEXTURE_SIDE
    waves = int(rng.integers(60, 110))
    bent = waves * x[None, :] + 2.0 * np.sin(2 * np.pi * x)[:, None]
    made = [
        _noise(rng, 0.5),
        _noise(rng, 1.4),
        np.sign(_noise(rng, 1.2) - 0.3) + 0.2 * _noise(rng, 1.0),
        np.sign(np.sin(2 * np.pi * bent)) + 0.3 * _noise(rng, 1.0),
        _noise(rng, 2.2) + 0.02 * _noise(rng, 0.8),
        0.08 * _noise(rng, 1.2),
    ]
    return np.stack([np.clip(one / max(float(one.std()), 0.5), -2.2, 2.2) for one in made]).astype(np.float32)


def _noise(rng: np.random.Generator, slope: float) -> NDArray[np.float64]:
    """Unit variance, amplitude falling with frequency to the power of `slope`, coarser than an eighth flattened."""
    side = TEXTURE_SIDE
    f = np.hypot(np.fft.fftfreq(side)[:, None], np.fft.rfftfreq(side)[None])
    spectrum = np.maximum(f, 8 / side) ** -slope * np.exp(2j * np.pi * rng.random(f.shape))
    spectrum[0, 0] = 0
    made = np.fft.irfft2(spectrum, s=(side, side))
    return np.asarray(made / made.std())


def boards(seed: int, side: int) -> Scene:
    """Fourteen occluders of all sizes and textures on a slanted ground."""
    rng = np.random.default_rng([seed, 1])
    ground = Surface(-1.2, tuple(rng.uniform(-0.8, 0.8, 2) / side), texture=int(rng.integers(1, 3)), contrast=0.12)
    made = [ground]
    for _ in range(14):
        made.append(
            Surface(
                float(rng.uniform(-0.8, 1.6)),
                tuple(rng.uniform(-0.6, 0.6, 2) / side),
                tuple(rng.uniform(-0.45, 0.45, 2) * side),
                tuple(rng.uniform(0.02, 0.16, 2) * side),
                bool(rng.integers(2)),
                float(rng.uniform(0, np.pi)),
                texture=int(rng.choice(6, p=[0.1, 0.25, 0.15, 0.1, 0.3, 0.1])),
                mean=float(rng.uniform(0.15, 0.6)),
                contrast=float(rng.uniform(0.03, 0.25)),
            )
        )
    return Scene("boards", tuple(made), textures(seed))


def room(seed: int, side: int) -> Scene:
    """Three planes that meet, one of them faint, and six round things, half of them glossy."""
    rng = np.random.default_rng([seed, 2])
    lean = rng.uniform(1.2, 2.0, 3) / side
    made = [
        Surface(-0.9, (float(lean[0]), 0.0), (0.1 * side, 0.0), texture=0, mean=0.45),
        Surface(-1.1, (0.0, float(lean[1])), (0.0, -0.1 * side), texture=4, mean=0.3),
        Surface(-1.3, (0.0, -float(lean[2])), (0.0, -0.1 * side), texture=5, mean=0.55),
    ]
    for number in range(6):
        size = float(rng.uniform(0.05, 0.13) * side)
        made.append(
            Surface(
                float(rng.uniform(-0.2, 1.2)),
                centre=tuple(rng.uniform(-0.4, 0.4, 2) * side),
                half=(size, float(size * rng.uniform(0.7, 1.3))),
                round=True,
                bulge=float(rng.uniform(0.1, 0.5)),
                texture=int(rng.choice([0, 1, 2, 3, 4, 4, 5])),
                mean=float(rng.uniform(0.15, 0.5)),
                contrast=float(rng.uniform(0.1, 0.3)),
                gloss=0.3 * (number % 2),
            )
        )
    return Scene("room", tuple(made), textures(seed))


def fence(seed: int, side: int) -> Scene:
    """Bars of 3 to 6 px and fifty leaves in front of fine texture."""
    rng = np.random.default_rng([seed, 3])
    made = [
        Surface(-1.0, (float(rng.choice([-1, 1]) * rng.uniform(0.5, 0.8) / side), 0.3 / side), texture=0, contrast=0.25)
    ]
    for _ in range(50):
        size = float(rng.uniform(3, 9))
        made.append(
            Surface(
                float(rng.uniform(-0.6, 0.5)),
                centre=tuple(rng.uniform(-0.5, 0.5, 2) * side),
                half=(size, size * float(rng.uniform(0.4, 0.8))),
                round=True,
                turn=float(rng.uniform(0, np.pi)),
                texture=int(rng.integers(0, 3)),
                mean=float(rng.uniform(0.1, 0.6)),
                contrast=float(rng.uniform(0.1, 0.25)),
            )
        )
    turn, spacing = float(rng.uniform(-0.3, 0.3)), float(rng.uniform(38, 55))
    for k in range(-int(side / spacing), int(side / spacing) + 1):
        made.append(
            Surface(
                float(0.9 + 0.02 * k),
                (0.0, float(rng.uniform(-0.2, 0.2)) / side),
                (0.0, k * spacing),
                (2.0 * side, float(rng.uniform(1.5, 3.0))),
                turn=turn,
                texture=1,
                mean=0.2,
                contrast=0.3,
            )
        )
    return Scene("fence", tuple(made), textures(seed))


def step(seed: int, side: int) -> Scene:
    """One board with upright edges before a ground: for halos."""
    ground = Surface(-0.8, texture=0, mean=0.35)
    board = Surface(1.2, half=(2.0 * side, 0.22 * side), texture=1, mean=0.45)
    return Scene("step", (ground, board), textures(seed))


def half_bare(seed: int, side: int) -> Scene:
    """A textured wall, and a nearer one without any detail before its right half: nothing can be known there."""
    wall = Surface(0.4, (0.3 / side, 0.2 / side), texture=1, contrast=0.25)
    bare = Surface(0.6, (0.3 / side, 0.2 / side), (0.0, 0.5 * side), (2.0 * side, 0.5 * side), contrast=0.0)
    return Scene("half bare", (wall, bare), textures(seed))


FAMILIES: Mapping[str, Callable[[int, int], Scene]] = {"boards": boards, "room": room, "fence": fence}
