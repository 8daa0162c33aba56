"""What the simulated camera knows of a shot and its file does not say."""

from __future__ import annotations

import math
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from dappled.decode.optics.carriers import Lattice
from dappled.decode.optics.masks import Mask
from dappled.mocks.autopilot.path import TruePose
from dappled.mocks.scene.lens import Floats


@dataclass(frozen=True, slots=True)
class Truth:
    """What really was in front of the mask.

    `views` float32 (n, n, h, w, 3): what each aperture point saw, band-limited to a slice, in the plane's scale
    (1.0 = sensor white), scaled so that their mean is the frame's local mean. `aperture_points_mm` (n, n, 2) are
    those points (θy, θx). `depth_m` (h, w) along the axis and `disparity_mm_per_mm` (h, w), dx/dθ on the sensor, are
    None where the scene does not know them. `grid` (2, 3) leads from (y, x, 1) of a view to sensor (row, column).
    `kappa` = f_m·α·A: the used aperture in periods of the mask; 1 is the ideal. `lattice`: where the carriers lie.
    """

    views: Floats
    aperture_points_mm: NDArray[np.float64]
    depth_m: Floats | None
    disparity_mm_per_mm: Floats | None
    pose: TruePose | None
    mid_exposure_t_s: float
    kappa: float
    mask: Mask
    mask_rotation_rad: float
    mask_shift_mm: tuple[float, float]
    mask_distance_mm: float
    angular_frequency_per_mm: float
    lattice: Lattice
    grid: NDArray[np.float64]

    def view_points_mm(self, n: int) -> NDArray[np.float64]:
        """(n, n, 2): centres of n × n cells over the mask's own aperture 1/(f_m·α), turned as the mask is."""
        axis = (np.arange(n) - (n - 1) / 2) / n / self.angular_frequency_per_mm
        points = np.stack(np.meshgrid(axis, axis, indexing="ij"), axis=-1)
        c, s = math.cos(self.mask_rotation_rad), math.sin(self.mask_rotation_rad)
        return np.asarray(points @ np.array([[c, s], [-s, c]]))  # Rᵀ applied to each point

    def project(self, points_mm: NDArray[np.float64]) -> Floats:
        """(..., h, w, 3): the light field at aperture points (..., 2), as far as the mask's carriers can tell.

        The views' angular spectrum is taken at the carriers' orders and summed back: what a perfect decoder gets that
        transforms slices to views. Where κ is not 1 an aperture of one brightness does not give views of one
        brightness: beyond 1 its rim is seen twice, below 1 the outer views see past it.
        """
        orders = np.array(self.mask.orders(), dtype=np.float64)
        c, s = math.cos(self.mask_rotation_rad), math.sin(self.mask_rotation_rad)
        k = orders @ np.array([[c, s], [-s, c]]) * self.angular_frequency_per_mm
        here = np.exp(2j * np.pi * self.aperture_points_mm.reshape(-1, 2) @ k.T)  # (J, K)
        there = np.exp(-2j * np.pi * np.asarray(points_mm).reshape(-1, 2) @ k.T)  # (U, K)
        weights = (there @ here.T).real.astype(np.float32) / len(here)
        n = self.views.shape[0]
        flat = weights @ self.views.reshape(n * n, -1)
        return np.asarray(flat.reshape(*np.shape(points_mm)[:-1], *self.views.shape[2:]))

    def band_views(self, n: int) -> Floats:
        """(n, n, h, w, 3): `project` at `view_points_mm`. With n = 2p+1, as many samples, and κ = 1, the views."""
        return self.project(self.view_points_mm(n))

    def save(self, path: Path) -> None:
        """All of it as an .npz file; what is None is left out."""
        arrays = {
            "views": self.views,
            "aperture_points_mm": self.aperture_points_mm,
            "grid": self.grid,
            "mid_exposure_t_s": self.mid_exposure_t_s,
            "kappa": self.kappa,
            "mask_rotation_rad": self.mask_rotation_rad,
            "mask_shift_mm": self.mask_shift_mm,
            "mask_distance_mm": self.mask_distance_mm,
            "lattice": self.lattice.matrix(),
        }
        if self.depth_m is not None and self.disparity_mm_per_mm is not None:
            arrays |= {"depth_m": self.depth_m, "disparity_mm_per_mm": self.disparity_mm_per_mm}
        if self.pose is not None:
            arrays |= {
                "position_ned_m": self.pose.position_ned_m,
                "attitude": self.pose.attitude,
                "geodetic": (self.pose.latitude_deg, self.pose.longitude_deg, self.pose.altitude_msl_m),
            }
        np.savez(path, **arrays)  # type: ignore[arg-type]  # savez takes whatever asarray takes
