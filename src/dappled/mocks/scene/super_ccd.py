"""What a Super CCD body makes of light: samples on a lattice at 45°, interpolated to twice as many, sharpened, as JPEG.

The chip of the FinePix S5200 has a sample at every second place of its 2776 × 3688 picture, in a chequered order. Even
rows hold blue and red, odd rows green, half a column's width to the right:

    rows 0, 4 …   B . R . B . R .        rows 2, 6 …   R . B . R . B .        odd rows   . G . G . G . G
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy import ndimage

from dappled.decode import srgb
from dappled.decode.array_types import Singles
from dappled.mocks.scene.chip_faults import encoded, jpeg_of

_GREEN = np.outer([1, 2, 1], [1, 2, 1]).astype(np.float32)  # bilinear on a lattice of 2 × 2 places
_RED = np.outer([1, 2, 3, 4, 3, 2, 1], [1, 2, 3, 4, 3, 2, 1]).astype(np.float32)  # likewise of 4 × 4


@dataclass(frozen=True, slots=True)
class SuperCcdBody:
    """The processing of a body: `sharpening` is the share of what a 3 × 3 blur takes away that is added again."""

    sharpening: float = 0.8
    quality: int = 90

    def jpeg(self, light: Singles) -> bytes:
        """The grey file of linear light (H, W) or (H, W, 3), 1.0 = white."""
        grey = interpolated(light) @ np.array([0.299, 0.587, 0.114], dtype=np.float32)
        tone = encoded(grey)
        tone = tone + self.sharpening * (tone - ndimage.uniform_filter(tone, 3, mode="mirror"))
        return jpeg_of(srgb.decoded(np.clip(tone, 0, 1)).astype(np.float32), self.quality)


def sampled(light: Singles) -> tuple[Singles, NDArray[np.int8]]:
    """The chip's samples (H, W) of light (H, W) or (H, W, 3), 0 where it has none, and the colour of each: 0 red,
    1 green, 2 blue, -1 none."""
    rows, columns = np.indices(light.shape[:2])
    colour = np.full(light.shape[:2], -1, dtype=np.int8)
    colour[(rows % 2 == 1) & (columns % 2 == 1)] = 1
    even = (rows % 2 == 0) & (columns % 2 == 0)
    reds = (rows // 2 + columns // 2) % 2 == 1
    colour[even & reds], colour[even & ~reds] = 0, 2
    values = np.zeros(light.shape[:2], dtype=np.float32)
    for channel in range(3):
        values += (light if light.ndim == 2 else light[..., channel]) * (colour == channel)
    return values, colour


def interpolated(light: Singles) -> Singles:
    """(H, W, 3): the picture of the chip's samples, full in every colour; red and blue as differences from green."""
    values, colour = sampled(light)
    green = _filled(values, colour == 1, _GREEN)
    differences = [_filled(values - green, colour == channel, _RED) for channel in (0, 2)]
    return np.stack([green + differences[0], green, green + differences[1]], axis=-1)


def _filled(values: Singles, there: NDArray[np.bool_], kernel: Singles) -> Singles:
    """The samples that are there, spread by a kernel and divided by how much of it they fill."""
    weight = ndimage.convolve(there.astype(np.float32), kernel, mode="mirror")
    return np.asarray(ndimage.convolve(values * there, kernel, mode="mirror") / weight, dtype=np.float32)
