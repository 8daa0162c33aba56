"""The picture behind a mask at the sensor's own resolution: the frame over the mask's shadow, with its errors."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from dappled.decode.array_types import Singles
from dappled.decode.picture.blocks import EMPTY, MosaicPlane, local_mean
from dappled.decode.picture.focus import Sharp, mixed
from dappled.decode.picture.noise import noise_of
from dappled.decode.picture.shadow import Shadow

# Chosen by hand where no figure stands beside a number; tests/decode/picture measures what all of them together make.

DARK = 0.2  # of the mean: behind less of the mask the picture has five times the noise


@dataclass(frozen=True, slots=True, eq=False)
class UnmaskedPicture:
    """`plane` float32 (H, W), linear, 1.0 = sensor white behind no mask of the same mean, with the frame's `pattern` of
    colours (see `MosaicPlane`). `sigma` (H, W) is the standard error of each pixel: noise, the shadow's own, and what
    ghosts leave. `dark_share` of the pixels lie behind less than `DARK` of the mask's mean, in
    `soft_share` of the blocks more than half of the detail is left out, as they are out of focus (see `focus`).
    `sure_noise` of the noise's variance in `sigma` can be no detail. `trusted` is False where the frame was clipped or
    the mask let less than `DARK` of its mean through, `valid` only where it was clipped (None: nowhere)."""

    plane: Singles
    pattern: NDArray[np.intp]
    sigma: Singles
    trusted: NDArray[np.bool_]
    shadow: Shadow
    dark_share: float
    soft_share: float
    sure_noise: float
    valid: NDArray[np.bool_] | None


def picture_of(mosaic: MosaicPlane, shadow: Shadow, period: float) -> UnmaskedPicture:
    """The picture of a mosaic behind a known shadow. A clipped pixel is as bright as what is around it tells, and no
    darker than itself."""
    shape = mosaic.shape
    plane, sigma = np.zeros(shape, dtype=np.float32), np.zeros(shape, dtype=np.float32)
    trusted = np.zeros(shape, dtype=bool)
    dark = samples = 0
    sharp, shadows = [], []
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
        trusted[place.cut] = sound
        # The shadow's error is far below the detail that a block holds at its carriers: no noise to be filtered.
        sharp.append(Sharp(place, made, made * known, np.maximum(base + slope * values, base) / (known * known)))
        shadows.append(known)
    shown = mixed(sharp, mosaic.pattern != EMPTY, shadow)
    for one, known, image, variance in zip(sharp, shadows, shown.pictures, shown.variances, strict=True):
        off = image * np.float32(shadow.sigma[one.place.colour]) / known
        plane[one.place.cut], sigma[one.place.cut] = image, np.sqrt(variance + off * off)
    dark_share = dark / max(samples, 1)
    shares = (dark_share, shown.soft_share, shown.sure_noise)
    return UnmaskedPicture(plane, mosaic.pattern, sigma, trusted, shadow, *shares, mosaic.valid)


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
