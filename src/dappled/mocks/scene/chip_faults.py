"""What a sensor and the body's processing add to the light: faults of the chip, noise, clipping, and a JPEG."""

from __future__ import annotations

import numpy as np
from scipy import ndimage

from dappled.decode import srgb
from dappled.decode.array_types import Singles
from dappled.encoded_pictures import file_of

RGGB = np.array([[0, 1], [1, 2]])


def mosaic_of(colours: Singles) -> Singles:
    """(H, W) of colours (3, H, W): each pixel behind its own filter, red first."""
    out = np.empty(colours.shape[1:], dtype=np.float32)
    for y in (0, 1):
        for x in (0, 1):
            out[y::2, x::2] = colours[RGGB[y, x], y::2, x::2]
    return out


def demosaiced(mosaic: Singles) -> Singles:
    """(H, W, 3): the missing colours as means of their nearest neighbours (bilinear), mirrored at the edges."""
    high, wide = mosaic.shape
    rows, columns = np.indices(mosaic.shape) % 2
    kernel = np.array([[1, 2, 1], [2, 4, 2], [1, 2, 1]], dtype=np.float32)
    out = np.empty((high, wide, 3), dtype=np.float32)
    for channel in range(3):
        there = (RGGB[rows, columns] == channel).astype(np.float32)
        total = ndimage.convolve(mosaic * there, kernel, mode="mirror")
        out[..., channel] = total / ndimage.convolve(there, kernel, mode="mirror")
    return out


def with_dust(light: Singles, specks: int, rng: np.random.Generator) -> Singles:
    """Round soft shadows of 3 to 12 px, up to a third deep, on the cover glass."""
    out = light.copy()
    y, x = np.indices(light.shape, dtype=np.float32)
    for _ in range(specks):
        at = rng.uniform((0, 0), light.shape)
        radius, depth = rng.uniform(3, 12), rng.uniform(0.1, 0.33)
        out *= np.float32(1) - np.float32(depth) * np.exp(-((np.hypot(y - at[0], x - at[1]) / radius) ** 4))
    return out


def with_gain_drift(light: Singles, drift: float) -> Singles:
    """The gain rises by `drift` from the first row to the last; 1 in the middle."""
    return np.asarray(light * (1 + drift * np.linspace(-0.5, 0.5, len(light), dtype=np.float32)[:, None]))


def with_banding(light: Singles, rms: float, rng: np.random.Generator) -> Singles:
    """Each row has an offset of its own, of `rms` of white."""
    return np.asarray(light + rng.normal(0, rms, (len(light), 1)).astype(np.float32))


def with_hot_pixels(light: Singles, share: float, rng: np.random.Generator) -> Singles:
    """That share of the pixels is at white whatever the light."""
    hot = rng.choice(light.size, size=round(share * light.size), replace=False)
    out = light.copy()
    out.reshape(-1)[hot] = 1.0
    return out


def with_noise(light: Singles, full_well_e: float, read_noise_e: float, rng: np.random.Generator) -> Singles:
    """Shot noise of `full_well_e` electrons at white (0: none) and read noise."""
    if full_well_e == 0:
        return light
    variance = np.maximum(light, 0) / full_well_e + (read_noise_e / full_well_e) ** 2
    return np.asarray(light + np.sqrt(variance) * rng.standard_normal(light.shape, dtype=np.float32))


def encoded(linear: Singles) -> Singles:
    """sRGB's tone curve (IEC 61966-2-1), 0 to 1."""
    return srgb.encoded(np.clip(linear, 0, 1)).astype(np.float32)


def jpeg_of(linear: Singles, quality: int) -> bytes:
    """An sRGB JPEG of linear light (H, W) or (H, W, 3), 1.0 = white."""
    return file_of(np.rint(encoded(linear) * 255).astype(np.uint8), "JPEG", quality=quality)
