"""The picture behind a mask at the sensor's own resolution: the frame over the mask's shadow, with its errors."""

from __future__ import annotations

import itertools
import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from dappled.decode.array_types import Floats, Singles
from dappled.decode.picture.blocks import EMPTY, MosaicPlane, local_mean
from dappled.decode.picture.focus import Mixed, Sharp, mixed
from dappled.decode.picture.shadow import Shadow, ShadowFrom

# Chosen by hand where no figure stands beside a number; tests/decode/picture measures what all of them together make.

DARK = 0.2  # of the mean: behind less of the mask the picture has five times the noise
_NOISE_PX = 16  # samples on a side of the parts that the noise is measured in
_NOISE_LEVELS = 6  # of brightness
_QUIET = 0.1  # of the parts of a level have as little detail as this
_EVEN_OUT = 36.0  # sum of the squares of (1, −2, 1) times itself
_ALIKE = 3.78  # the samples that one independent value of that is spread over: Σ of its autocorrelation squared
_QUIET_SIGMAS = 1.28  # below the mean, where as many values as `_QUIET` lie


@dataclass(frozen=True, slots=True, eq=False)
class UnmaskedPicture:
    """`plane` float32 (H, W), linear, 1.0 = sensor white behind no mask of the same mean, with the frame's `pattern` of
    colours (see `MosaicPlane`). `sigma` (H, W) is the standard error of each pixel: noise, and the shadow's own;
    what focus leaves is not in it. `dark_share` of the pixels lie behind less than `DARK` of the mask's mean, in
    `soft_share` of the blocks more than half of the detail is left out, as they are out of focus (see `focus`).
    `trusted` is False where the frame was clipped or the mask let less than `DARK` of its mean through."""

    plane: Singles
    pattern: NDArray[np.intp]
    sigma: Singles
    trusted: NDArray[np.bool_]
    shadow: Shadow
    dark_share: float
    soft_share: float


def picture_of(mosaic: MosaicPlane, shadow: Shadow, period: float) -> UnmaskedPicture:
    """The picture of a mosaic behind a known shadow. A clipped pixel is as bright as what is around it tells, and no
    darker than itself."""
    shape = mosaic.shape
    plane, sigma = np.zeros(shape, dtype=np.float32), np.zeros(shape, dtype=np.float32)
    trusted = np.zeros(shape, dtype=bool)
    dark = samples = 0
    sharp = []
    for place in mosaic.places():
        known, values = shadow.at(place), mosaic.plane[place.cut]
        made = values / known
        sound = known >= DARK
        dark, samples = dark + int(np.count_nonzero(~sound)), samples + sound.size
        if mosaic.valid is not None and not (good := mosaic.valid[place.cut]).all():
            weights = known * good
            around = local_mean(values * weights, period, place.step, known * weights)
            made = np.asarray(np.where(good, made, np.maximum(made, around)), dtype=np.float32)
            sound &= good
        base, slope = (np.float32(one) for one in noise_of(made, known))
        light = np.maximum(base + slope * values, base) / (known * known)
        variance = light + (made * np.float32(shadow.sigma[place.colour]) / known) ** 2
        sigma[place.cut], trusted[place.cut] = np.sqrt(variance), sound
        sharp.append(Sharp(place, made, made * known, variance))
    plain = Mixed([one.picture for one in sharp], None, 0.0)
    shown = plain if shadow.source == ShadowFrom.NONE else mixed(sharp, shadow)
    for one, image in zip(sharp, shown.pictures, strict=True):
        plane[one.place.cut] = image
    for one, left in zip(sharp, shown.sigma_left or (), strict=False):
        sigma[one.place.cut] *= left
    return UnmaskedPicture(plane, mosaic.pattern, sigma, trusted, shadow, dark / max(samples, 1), shown.soft_share)


def noise_of(made: Singles, shadow: Singles) -> tuple[float, float]:
    """(base, slope) of the variance of a frame's noise over its brightness, from the parts of its picture `made` (H, W)
    with least detail.

    Detail up to the sampling limit is taken for noise where it is everywhere.
    """
    bent = np.diff(np.diff(made, 2, axis=0), 2, axis=1)
    rows, columns = (max(1, side // _NOISE_PX) for side in bent.shape)
    high, wide = bent.shape[0] // rows, bent.shape[1] // columns

    def parts(image: NDArray[np.floating]) -> Floats:
        cut = np.asarray(image)[: rows * high, : columns * wide].reshape(rows, high, columns, wide)
        return np.asarray(cut.mean(axis=(1, 3), dtype=np.float64).ravel())

    inner = shadow[1:-1, 1:-1]
    variance = parts(bent * bent) / _EVEN_OUT / parts(np.float32(1) / (inner * inner))
    level = parts(made[1:-1, 1:-1])
    # Of parts that are all alike, the quietest are so by chance.
    variance /= max(0.3, 1 - _QUIET_SIGMAS * math.sqrt(2 * _ALIKE / (high * wide)))
    edges = np.quantile(level, np.linspace(0, 1, _NOISE_LEVELS + 1))
    quiet, at = [], []
    for low, high_level in itertools.pairwise(edges):
        inside = (level >= low) & (level <= high_level)
        if inside.any():
            quiet.append(float(np.quantile(variance[inside], _QUIET)))
            at.append(float(level[inside].mean()))
    slope = max(0.0, float(np.polyfit(at, quiet, 1)[0])) if np.ptp(at) > 0 else 0.0
    base = max(0.0, float(np.median(np.array(quiet) - slope * np.array(at))))
    return base, slope


def interpolated(picture: UnmaskedPicture) -> Singles:
    """The picture in every pixel, (H, W) of one colour or (H, W, colours): samples that a place lacks are the means of
    those of its colour around it, the nearest most."""
    pattern = picture.pattern
    colours = [colour for colour in np.unique(pattern) if colour != EMPTY]
    if len(colours) == 1 and not (pattern == EMPTY).any():
        return picture.plane
    shape = picture.plane.shape
    made = []
    for colour in colours:
        own = np.tile(pattern == colour, [-(-side // n) for side, n in zip(shape, pattern.shape, strict=True)])
        own = own[: shape[0], : shape[1]]
        weights, values = own.astype(np.float32), np.where(own, picture.plane, np.float32(0))
        for axis in (0, 1):
            weights, values = (_widened(image, axis, max(pattern.shape) > 2) for image in (weights, values))
        made.append(np.where(own, picture.plane, values / np.maximum(weights, 1e-6)))
    return made[0] if len(made) == 1 else np.stack(made, axis=2)


def _widened(image: Singles, axis: int, wide: bool) -> Singles:
    """(1, 2, 1) along an axis, twice where samples stand far apart."""
    for _ in range(2 if wide else 1):
        padded = np.pad(image, [(1, 1) if axis == one else (0, 0) for one in (0, 1)], mode="reflect")
        before, here, after = (np.take(padded, np.arange(image.shape[axis]) + n, axis) for n in (0, 1, 2))
        image = before + 2 * here + after
    return image
