"""How near decoded views come to what the simulated camera really saw."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy import ndimage

from dappled.decode.lightfield.light_field import LightField
from dappled.mocks.scene.masked_camera import Truth

GREEN = 1  # what a mosaic is balanced to
BORDER = 12  # px of a view left out: the lens' blur of the truth wraps around there


@dataclass(frozen=True)
class Score:
    """PSNR in dB, range 1.0 = sensor white: of the views, and of their mean taken for every view."""

    views_db: float
    mean_db: float
    pixels: int


def score(found: LightField, truth: Truth, *, least_disparity_px: float, pixel_mm: float) -> Score:
    """Where neighbouring views differ by `least_disparity_px` sensor pixels or more."""
    rows, columns = found.views.shape[2:]
    y, x = np.mgrid[0:rows, 0:columns].astype(np.float64)
    sensor_row = found.grid[0, 0] * y + found.grid[0, 2]
    sensor_column = found.grid[1, 1] * x + found.grid[1, 2]
    at = np.array([sensor_row / truth.grid[0, 0], sensor_column / truth.grid[1, 1]])

    def sampled(image: NDArray[np.float32], order: int) -> NDArray[np.float32]:
        return np.asarray(ndimage.map_coordinates(image, at, order=order, mode="nearest"), dtype=np.float32)

    wanted = np.stack([[sampled(view, 3) for view in line] for line in truth.views[..., GREEN]])
    assert truth.disparity_mm_per_mm is not None
    step_mm = np.abs(truth.aperture_points_mm[1, 1] - truth.aperture_points_mm[0, 0]).max()
    disparity_px = np.abs(sampled(truth.disparity_mm_per_mm, 0)) * step_mm / pixel_mm
    mask = disparity_px >= least_disparity_px
    inner = np.zeros_like(mask)
    inner[BORDER:-BORDER, BORDER:-BORDER] = True
    mask &= inner

    def psnr(views: NDArray[np.float32]) -> float:
        return float(-10 * np.log10(np.mean((views - wanted)[..., mask] ** 2)))

    mean = np.broadcast_to(found.views.mean(axis=(0, 1)), found.views.shape)
    return Score(psnr(found.views), psnr(mean), int(mask.sum()))
