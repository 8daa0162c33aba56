"""Build the ground of the simulation: a procedural landscape from a seed, which repeats every `EXTENT_M` metres.

Maps are square, row = −north, column = east, home in the middle (index n/2);
everything wraps. Heights are metres above home.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from functools import lru_cache

import numpy as np
from numpy.typing import NDArray
from scipy import fft, ndimage

from dappled.decode.array_types import Singles

Reflectance = tuple[float, float, float]

EXTENT_M = 80.0
TEXEL_M = 0.05
DETAIL_PERIOD_M = 20.0
DETAIL_TEXEL_M = 0.0125
SHARP_DETAIL = 10.0, 0.005, 1.2  # its period, texel (metres) and slope
HEADROOM = 2.3  # brightest surface over the mean
SUN = (0.45, -0.5, 0.74)  # towards the sun: north, east, up

GRASS: Reflectance = (0.115, 0.140, 0.080)
MEADOW: Reflectance = (0.150, 0.150, 0.095)
SOIL: Reflectance = (0.165, 0.135, 0.105)
ASPHALT: Reflectance = (0.105, 0.105, 0.110)
GRAVEL: Reflectance = (0.200, 0.190, 0.170)
PAINT: Reflectance = (0.330, 0.330, 0.325)
TREE: Reflectance = (0.062, 0.085, 0.045)
ROOFS: tuple[Reflectance, ...] = ((0.235, 0.155, 0.120), (0.135, 0.140, 0.150), (0.185, 0.160, 0.135))
CARS: tuple[Reflectance, ...] = (
    (0.300, 0.300, 0.300),
    (0.190, 0.095, 0.085),
    (0.085, 0.110, 0.170),
    (0.050, 0.050, 0.055),
)


@dataclass(frozen=True, slots=True)
class GroundTarget:
    """A painted survey target under the usual flight path: its centre, metres north and east of home and above it."""

    north_m: float
    east_m: float
    height_m: float


@dataclass(frozen=True, slots=True)
class Landscape:
    """The landscape as maps.

    `albedo` (3, n, n) with sunlight and shadow in it, `relief` (n, n) heights, `roughness` (n, n): how much of the fine
    texture shows; all at TEXEL_M. `detail` (m, m) at `detail_texel_m`: fine texture of unit variance, clipped at ±2.2.
    """

    albedo: Singles
    relief: Singles
    roughness: Singles
    detail: Singles
    targets: tuple[GroundTarget, ...]
    mean_radiance: float
    detail_texel_m: float = DETAIL_TEXEL_M


@lru_cache(maxsize=2)  # 60 MB each
def build(seed: int, finest_period_m: float, *, sharp: bool = False) -> Landscape:
    """The landscape of a seed; who asks for the same one shares it, and cannot write to its maps. The fine texture has
    nothing finer than `finest_period_m` (metres a cycle).

    Its amplitude falls as frequency^-0.85; where `sharp`, as frequency^-1.2, on a finer map.
    """
    rng = np.random.default_rng([seed, 10])
    n = round(EXTENT_M / TEXEL_M)
    axis = (np.arange(n) * TEXEL_M - EXTENT_M / 2).astype(np.float32)
    north, east = -axis[:, None], axis[None, :]

    relief = 0.75 * noise(rng, n, TEXEL_M, slope=2.6, finest_m=9.0)
    relief -= relief[n // 2, n // 2]
    lawn = noise(rng, n, TEXEL_M, slope=2.0, finest_m=1.2)
    field = noise(rng, n, TEXEL_M, slope=2.4, finest_m=2.5)
    canvas = _Canvas(
        relief=relief, albedo=_mix(GRASS, MEADOW, _step(lawn, 0.8)), rough=np.full((n, n), 0.24, np.float32)
    )

    furrows = 1 + 0.16 * np.sin(2 * np.pi * (0.8 * north + 0.6 * east) / 0.5)  # whole rows along both sides
    canvas.paint(_step(field - 0.35, 0.12), SOIL, 0.20, furrows.astype(np.float32))
    _roads(canvas, north, east)
    _houses(canvas, rng, axis)
    _cars(canvas, rng, axis)
    _trees(canvas, rng, axis)
    targets = _targets(canvas, rng, axis)

    lit = canvas.albedo * _sunlight(canvas.relief)
    mean = float(lit.mean())
    period_m, texel_m, slope = SHARP_DETAIL if sharp else (DETAIL_PERIOD_M, DETAIL_TEXEL_M, 0.85)
    made = Landscape(
        albedo=np.minimum(lit, HEADROOM / 1.15 * mean).astype(np.float32),
        relief=canvas.relief,
        roughness=canvas.rough,
        detail=noise(rng, round(period_m / texel_m), texel_m, slope=slope, finest_m=finest_period_m),
        targets=targets,
        mean_radiance=mean,
        detail_texel_m=texel_m,
    )
    for one in (made.albedo, made.relief, made.roughness, made.detail):
        one.flags.writeable = False
    return made


def noise(rng: np.random.Generator, n: int, texel_m: float, *, slope: float, finest_m: float) -> Singles:
    """(n, n) cyclic noise of unit variance, clipped at ±2.2; amplitude falls as frequency^−slope to nothing finer than
    `finest_m` (metres a cycle)."""
    fy, fx = fft.fftfreq(n, texel_m), fft.rfftfreq(n, texel_m)
    white = rng.standard_normal((2, n, len(fx)), dtype=np.float32)
    spectrum = np.zeros(white.shape[1:], dtype=np.complex64)
    some = np.ix_(np.abs(fy) * finest_m < 1, fx * finest_m < 1)  # beyond them there is nothing
    radius = np.hypot(fy[:, None], fx[None, :])[some]
    radius[0, 0] = np.inf
    amplitude = radius**-slope * (0.5 + 0.5 * np.cos(np.pi * np.clip((radius * finest_m - 0.8) / 0.2, 0, 1)))
    spectrum[some] = amplitude * (white[0][some] + 1j * white[1][some])
    field = fft.irfft2(spectrum, s=(n, n), overwrite_x=True)
    return np.asarray(np.clip(field / field.std(), -2.2, 2.2), dtype=np.float32)


@dataclass(slots=True)
class _Canvas:
    """The maps while they are painted."""

    relief: Singles
    albedo: Singles
    rough: Singles

    def paint(self, cover: Singles, colour: Reflectance, rough: float, shade: Singles | float = 1.0) -> None:
        """Cover the whole map, as far as `cover` (0 to 1) says."""
        self.stamp((slice(None), slice(None)), cover, colour, rough, shade)

    def stamp(
        self,
        where: tuple[slice, slice],
        cover: Singles,
        colour: Reflectance,
        rough: float,
        shade: Singles | float = 1.0,
    ) -> None:
        """Cover a part of the map."""
        for plane, value in zip(self.albedo, colour, strict=True):
            part = plane[where]
            part += cover * (value * shade - part)
        part = self.rough[where]
        part += cover * (rough - part)


@dataclass(frozen=True, slots=True)
class _Patch:
    """A square window of the map around a place, not crossing the map's edge: where, and metres from the place."""

    where: tuple[slice, slice]
    north: Singles
    east: Singles

    def turned(self, angle_rad: float) -> tuple[Singles, Singles]:
        """(along, across) in metres, axes turned by an angle."""
        c, s = math.cos(angle_rad), math.sin(angle_rad)
        return c * self.north + s * self.east, c * self.east - s * self.north


def _patch(axis: Singles, north: float, east: float, radius: float) -> _Patch | None:
    """None where the window would cross an edge of the arrays."""
    n, reach = len(axis), math.ceil(radius / TEXEL_M)
    row, column = n // 2 + round(-north / TEXEL_M), n // 2 + round(east / TEXEL_M)
    if not (reach <= row < n - reach and reach <= column < n - reach):
        return None
    where = slice(row - reach, row + reach + 1), slice(column - reach, column + reach + 1)
    return _Patch(where, (-axis[where[0]] - north)[:, None], (axis[where[1]] - east)[None, :])


def _roads(canvas: _Canvas, north: Singles, east: Singles) -> None:
    wave = 2 * np.pi * north / EXTENT_M
    road = east - 20 - 2.2 * np.sin(wave)
    path = east + 14 - 5.0 * np.sin(wave + 1.0)
    lane = north - 17 - 2.5 * np.sin(2 * np.pi * east / EXTENT_M)
    canvas.paint(_step(0.6 - np.abs(path), 0.08), GRAVEL, 0.13)
    for line in (lane, road):
        canvas.paint(_step(2.2 - np.abs(line), 0.12), GRAVEL, 0.13)
        canvas.paint(_step(1.9 - np.abs(line), 0.03), ASPHALT, 0.09)
    for line, along in ((lane, east), (road, north)):
        dashes = _step(np.cos(2 * np.pi * along / 4.0), 0.08)
        clear = _step(np.hypot(lane, road) - 3.4, 0.05)
        canvas.paint(_step(0.075 - np.abs(line), 0.025) * dashes * clear, PAINT, 0.05)
        canvas.paint(_step(0.05 - np.abs(np.abs(line) - 1.7), 0.025) * clear, PAINT, 0.05)


def _houses(canvas: _Canvas, rng: np.random.Generator, axis: Singles) -> None:
    for number, (north, east) in enumerate(
        ((25, 8), (9, 30), (-9, 25), (-23, 9), (-20, -17), (2, -24), (24, -11), (10, 6))
    ):
        patch = _patch(axis, north + rng.uniform(-1.5, 1.5), east + rng.uniform(-1, 1), 6.5)
        if patch is None:
            continue
        along, across = patch.turned(rng.uniform(0, np.pi))
        length, width = rng.uniform(3.2, 4.4), rng.uniform(2.2, 2.8)  # half sides
        ground = canvas.relief[patch.where]
        inside = np.minimum(length - np.abs(along), width - np.abs(across))
        roof = ground.max() + 2.0 + 1.2 * (1 - np.abs(across) / width)
        colour = ROOFS[number % len(ROOFS)]
        tiles = 1 + 0.10 * np.sin(2 * np.pi * across / 0.33) + 0.04 * np.sin(2 * np.pi * along / 0.25)
        canvas.stamp(patch.where, _step(inside, 0.04), colour, 0.10, tiles.astype(np.float32))
        canvas.stamp(patch.where, _step(0.09 - np.abs(across), 0.03) * _step(inside, 0.04), (0.09, 0.085, 0.08), 0.05)
        chimney = np.minimum(0.35 - np.abs(along - 0.5 * length), 0.35 - np.abs(across - 0.8))
        roof = np.maximum(roof, np.where(chimney > 0, ground.max() + 3.9, -np.inf))
        canvas.stamp(patch.where, _step(chimney, 0.03), (0.16, 0.12, 0.105), 0.10)
        canvas.stamp(patch.where, _step(0.07 - np.abs(inside), 0.03), (0.150, 0.140, 0.125), 0.01)  # the wall's texels
        ground += _step(inside, 0.05) * (roof - ground)


def _cars(canvas: _Canvas, rng: np.random.Generator, axis: Singles) -> None:
    for number in range(10):
        along = -34 + 7.5 * number + rng.uniform(-1, 1)
        if number % 2:
            place = along, 20 + 2.2 * math.sin(2 * np.pi * along / EXTENT_M) + 0.9
            heading = math.atan2(2.2 * 2 * np.pi / EXTENT_M * math.cos(2 * np.pi * along / EXTENT_M), 1)
        else:
            place = 17 + 2.5 * math.sin(2 * np.pi * along / EXTENT_M) - 0.9, along
            heading = math.atan2(1, 2.5 * 2 * np.pi / EXTENT_M * math.cos(2 * np.pi * along / EXTENT_M))
        patch = _patch(axis, *place, 2.6)
        if patch is None:
            continue
        x, y = patch.turned(heading)
        body = np.minimum(2.1 - np.abs(x), 0.88 - np.abs(y))
        cabin = np.minimum(1.0 - np.abs(x + 0.25), 0.72 - np.abs(y))
        roof = np.minimum(0.65 - np.abs(x + 0.3), 0.62 - np.abs(y))
        colour = CARS[number % len(CARS)]
        canvas.stamp(patch.where, _step(body, 0.03), colour, 0.02)
        canvas.stamp(patch.where, _step(cabin, 0.03), (0.035, 0.04, 0.045), 0.02)
        canvas.stamp(patch.where, _step(roof, 0.03), colour, 0.02)
        ground = canvas.relief[patch.where]
        top = float(ground.mean())
        ground += _step(body, 0.05) * (top + 0.9 - ground)
        ground += _step(cabin, 0.15) * (top + 1.4 - ground)


def _trees(canvas: _Canvas, rng: np.random.Generator, axis: Singles) -> None:
    leaves = noise(rng, len(axis), TEXEL_M, slope=0.9, finest_m=0.25)
    for _ in range(120):
        north, east = rng.uniform(-38, 38, 2)
        radius, height = rng.uniform(0.5, 1.8), rng.uniform(1.2, 1.9)
        patch = _patch(axis, north, east, radius * 1.25)
        if patch is None or canvas.rough[patch.where].min() < 0.19:  # not on roads, roofs and cars
            continue
        bumps = leaves[patch.where]
        distance = np.hypot(patch.north, patch.east) / radius + 0.12 * bumps
        crown = np.sqrt(np.clip(1 - distance**2, 0, None))
        tint = 0.85 + 0.3 * rng.random()
        canvas.stamp(patch.where, _step(1 - distance, 0.05), TREE, 0.30, tint * (0.55 + 0.6 * crown + 0.2 * bumps))
        ground = canvas.relief[patch.where]
        ground += height * radius * crown * (1 + 0.1 * bumps) * (crown > 0)


def _targets(canvas: _Canvas, rng: np.random.Generator, axis: Singles) -> tuple[GroundTarget, ...]:
    found: list[GroundTarget] = []
    for number in range(40):
        angle, radius = 2 * np.pi * number / 40, rng.uniform(22.5, 27.5)
        north, east = float(radius * math.cos(angle)), float(radius * math.sin(angle))
        patch = _patch(axis, north, east, 0.9)
        if patch is None:
            continue
        ground = canvas.relief[patch.where]
        if np.ptp(ground) > 0.8 or canvas.rough[patch.where].min() < 0.08:
            continue  # on a roof, a tree or a line
        distance = np.hypot(patch.north, patch.east)
        quarter = _step(patch.north * patch.east / 0.1, 0.2)
        canvas.stamp(patch.where, _step(0.6 - distance, 0.03), (0.045, 0.045, 0.045), 0.03)
        canvas.stamp(patch.where, _step(0.52 - distance, 0.03) * quarter, PAINT, 0.03)
        row, column = (s.start + (s.stop - s.start) // 2 for s in patch.where)
        found.append(GroundTarget(north, east, float(canvas.relief[row, column])))
    return tuple(found)


def _sunlight(relief: Singles) -> Singles:
    """Light on each texel: slope towards the sun, cast shadow, and sky."""
    norm = math.sqrt(sum(c * c for c in SUN))
    north, east, up = (c / norm for c in SUN)
    smooth = ndimage.gaussian_filter(relief, 2, mode="wrap")
    d_south, d_east = (np.gradient(smooth, TEXEL_M, axis=a).astype(np.float32) for a in (0, 1))
    facing = (north * d_south - east * d_east + up) / np.sqrt(1 + d_south**2 + d_east**2)
    coarse = relief[::2, ::2]
    step_m, flat = 2 * TEXEL_M, math.hypot(north, east)
    shaded = np.zeros(coarse.shape, dtype=bool)
    for count in range(1, math.ceil(4.5 * flat / up / step_m)):
        towards = round(-north / flat * count), round(east / flat * count)  # rows, columns towards the sun
        horizon = np.roll(coarse, (-towards[0], -towards[1]), axis=(0, 1))
        shaded |= horizon - coarse > 0.03 + count * step_m * up / flat
    shadow = ndimage.gaussian_filter(np.repeat(np.repeat(shaded.astype(np.float32), 2, 0), 2, 1), 1.5, mode="wrap")
    return np.asarray(0.35 + 0.85 * np.clip(facing, 0, None) * (1 - shadow), dtype=np.float32)


def _step(distance: Singles | NDArray[np.float64], half_width: float) -> Singles:
    """0 below −half_width, 1 above +half_width, smooth between: edges that a lens could have made."""
    t = np.clip(np.asarray(distance, dtype=np.float32) / (2 * half_width) + 0.5, 0, 1)
    return np.asarray(t * t * (3 - 2 * t), dtype=np.float32)


def _mix(a: Reflectance, b: Reflectance, share: Singles) -> Singles:
    return np.stack([x + share * (y - x) for x, y in zip(a, b, strict=True)]).astype(np.float32)
