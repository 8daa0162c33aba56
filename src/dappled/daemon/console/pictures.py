"""Make 8-bit pictures of one frame from its slices, for the page."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy import fft

from dappled.decode import srgb
from dappled.decode.lightfield import ViewStack
from dappled.decode.lightfield.refocus import shift_and_add
from dappled.encoded_pictures import file_of
from dappled.findings import Finding

Grey = NDArray[np.uint8]
MOSAIC_PX = 2560  # of the mosaic of views; every WebGL2 supports 2048, phones of the last ten years 4096
_DEPTH_STOPS = np.array(  # dark violet to yellow, even in lightness: after viridis
    [[68, 1, 84], [59, 82, 139], [33, 145, 140], [94, 201, 98], [253, 231, 37]], dtype=np.float64
)
_UNKNOWN = 205


@dataclass(frozen=True, slots=True)
class Mosaic:
    """All views side by side, sRGB bytes on one scale. `tile` is the (height, width) of one, reduced by the whole
    number `scale`; a disparity of `scale` moves a view by its step (of `row_steps`, `column_steps`) in tile pixels.
    `sensor_px_per_disparity` as that of the stack."""

    picture: Grey
    tile: tuple[int, int]
    scale: int
    row_steps: NDArray[np.float64]
    column_steps: NDArray[np.float64]
    sensor_px_per_disparity: float | None = None


@dataclass(frozen=True, slots=True)
class FullSizePicture:
    """A frame's picture at the sensor's own resolution, and what speaks against it."""

    jpeg: bytes
    doubts: tuple[Finding, ...]


def small(image: NDArray[np.floating], longest_side: int) -> NDArray[np.float32]:
    """An image (h, w) averaged down by a whole number to at most this size."""
    step = max(1, -(-max(image.shape) // longest_side))
    height, width = (side // step * step for side in image.shape)
    blocks = image[:height, :width].reshape(height // step, step, width // step, step)
    out: NDArray[np.float32] = blocks.mean(axis=(1, 3), dtype=np.float32)
    return out


def shown(image: NDArray[np.floating]) -> Grey:
    """A linear image as sRGB bytes, from 0 to its 99.5th percentile."""
    return encoded(image / level(image))


def level(image: NDArray[np.floating]) -> float:
    """The value that is shown as white."""
    return max(float(np.quantile(image, 0.995)), 1e-9)


def encoded(linear: NDArray[np.floating]) -> Grey:
    """Linear 0 to 1 as sRGB bytes, as a browser decodes them."""
    grey: Grey = np.rint(255 * srgb.encoded(np.clip(linear, 0, 1))).astype(np.uint8)
    return grey


def decoded(coded: Grey) -> NDArray[np.float32]:
    """sRGB bytes as linear 0 to 1."""
    linear: NDArray[np.float32] = srgb.decoded(coded / np.float32(255)).astype(np.float32)
    return linear


def spectrum(slices: NDArray[np.complex64], carriers: Sequence[Sequence[float]], grid: Sequence[Sequence[float]],
             size: tuple[int, int]) -> Grey:  # fmt: skip
    """uint8 `size` (H, W), DC in the middle, −½ to ½ cycles/pixel on both axes: the bands that the slices were cut
    from, put back in their places. Log magnitude, each pixel the largest of its bins; what no slice covers is 0.

    `carriers` rows [ky, kx, fy, fx]; `grid` leads from a slice's samples to the frame's, so a band is 1/grid wide.
    """
    out = np.zeros(size, dtype=np.float32)
    tall, wide = (max(2, round(side / step)) for side, step in zip(size, (grid[0][0], grid[1][1]), strict=True))
    window = np.hanning(slices.shape[1])[:, None] * np.hanning(slices.shape[2])
    for image, (_, _, fy, fx) in zip(slices, carriers, strict=True):
        mean = image.mean() if fy == fx == 0 else 0
        band = np.abs(fft.fftshift(fft.fft2((image - mean) * window.astype(np.float32))))
        tile = _pooled(band, (tall, wide))
        for sign in (1, -1):
            top = round((0.5 + sign * fy) * size[0] - tall / 2)
            left = round((0.5 + sign * fx) * size[1] - wide / 2)
            _lay(out, tile if sign > 0 else tile[::-1, ::-1], top, left)
    seen = out > 0
    if not seen.any():
        return np.zeros(size, dtype=np.uint8)
    log = np.log(out, where=seen, out=np.zeros_like(out))
    low, high = np.quantile(log[seen], [0.05, 0.9998])
    grey: Grey = np.where(seen, np.clip((log - low) / max(high - low, 1e-9), 0, 1) * 235 + 20, 0).astype(np.uint8)
    return grey


def views_mosaic(stack: ViewStack) -> Mosaic:
    """The mosaic of grey views. Tiles are cut to whole 8 px, so that a JPEG's blocks never hold two views."""
    v, u, height, width = stack.views.shape
    step = max(1, -(-max(v * height, u * width) // MOSAIC_PX))
    height, width = height // step // 8 * 8, width // step // 8 * 8
    out = np.empty((v * height, u * width), dtype=np.uint8)
    white = level(stack.middle())
    for row in range(v):
        for column in range(u):
            view = stack.views[row, column][: height * step, : width * step]
            mean = view.reshape(height, step, width, step).mean(axis=(1, 3))
            out[row * height : (row + 1) * height, column * width : (column + 1) * width] = encoded(mean / white)
    return Mosaic(out, (height, width), step, stack.row_steps, stack.column_steps, stack.sensor_px_per_disparity)


def refocused(mosaic: Mosaic, disparity: float) -> Grey:
    """The mosaic's views focused on a disparity (Eq 28 and 29), in linear light; the page's shader does the same."""
    height, width = mosaic.tile
    v, u = len(mosaic.row_steps), len(mosaic.column_steps)
    views = decoded(mosaic.picture).reshape(v, height, u, width).swapaxes(1, 2)
    stack = ViewStack(np.ascontiguousarray(views), mosaic.row_steps, mosaic.column_steps)
    return encoded(np.nan_to_num(shift_and_add(stack, disparity / mosaic.scale)))


def depth_colours(disparity: NDArray[np.float32], sigma: NDArray[np.float32] | None) -> NDArray[np.uint8]:
    """uint8 (h, w, 3): near to far from yellow to violet; grey where unknown (NaN, or σ above a quarter of
    the range)."""
    known = np.isfinite(disparity)
    if sigma is not None:
        known &= np.isfinite(sigma)
    if not known.any():
        return np.full((*disparity.shape, 3), _UNKNOWN, dtype=np.uint8)
    inner = np.zeros_like(known)  # disparities at the picture's edge are unreliable
    inner[
        known.shape[0] // 10 : -(known.shape[0] // 10) or None, known.shape[1] // 10 : -(known.shape[1] // 10) or None
    ] = 1
    low, high = np.quantile(disparity[known & inner if (known & inner).any() else known], [0.02, 0.98])
    span = max(float(high - low), 1e-6)
    if sigma is not None:
        known &= np.where(known, sigma, np.inf) < span / 4 + 1e-6
    place = np.clip((np.where(known, disparity, low) - low) / span, 0, 1) * (len(_DEPTH_STOPS) - 1)
    colours = np.stack(
        [np.interp(place, range(len(_DEPTH_STOPS)), _DEPTH_STOPS[:, channel]) for channel in range(3)], axis=-1
    )
    picture: NDArray[np.uint8] = np.where(known[..., None], np.rint(colours), _UNKNOWN).astype(np.uint8)
    return picture


def jpeg(picture: NDArray[np.uint8], quality: int = 85) -> bytes:
    """A JPEG file."""
    return file_of(picture, "JPEG", quality=quality)


def png(picture: NDArray[np.uint8]) -> bytes:
    """A PNG file."""
    return file_of(picture, "PNG", compress_level=3)


def _pooled(band: NDArray[np.floating], size: tuple[int, int]) -> NDArray[np.floating]:
    """The largest value for each pixel of `size`; repeated where there are more pixels than values."""
    for axis in (0, 1):
        n, wanted = band.shape[axis], size[axis]
        starts = np.arange(wanted) * n // wanted
        band = np.maximum.reduceat(band, starts, axis=axis) if wanted <= n else np.take(band, starts, axis=axis)
    return band


def _lay(out: NDArray[np.float32], tile: NDArray[np.floating], top: int, left: int) -> None:
    """Copy a tile to its place on the picture; where there is a larger value, keep it."""
    bottom, right = min(top + tile.shape[0], out.shape[0]), min(left + tile.shape[1], out.shape[1])
    y, x = max(top, 0), max(left, 0)
    if y < bottom and x < right:
        part = out[y:bottom, x:right]
        np.maximum(part, tile[y - top : bottom - top, x - left : right - left], out=part)
