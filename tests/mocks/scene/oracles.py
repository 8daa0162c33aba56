"""What the simulated camera is compared with: the printed mask's values, and views by the mask's own carriers."""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from dappled.decode.array_types import Singles
from dappled.decode.optics.carriers import Mask
from dappled.mocks.autopilot.path import TruePose
from dappled.mocks.scene import lens
from dappled.mocks.scene.flyover import rotation
from dappled.mocks.scene.masked_camera import Truth


def mask_values(mask: Mask, y_mm: NDArray[np.float64], x_mm: NDArray[np.float64]) -> NDArray[np.float64]:
    """Transmission 0 to 1 of the printed mask at places on it."""
    low, high = lens.pattern_range(mask)
    f = mask.frequency_per_mm
    return (lens.transmission(mask, y_mm * f, x_mm * f) - low) / (high - low)


def view_points_mm(truth: Truth, n: int) -> NDArray[np.float64]:
    """(n, n, 2): centres of n × n cells over the mask's own aperture 1/(f_m·α), turned as the mask is."""
    axis = (np.arange(n) - (n - 1) / 2) / n / truth.angular_frequency_per_mm
    points = np.stack(np.meshgrid(axis, axis, indexing="ij"), axis=-1)
    c, s = math.cos(truth.mask_rotation_rad), math.sin(truth.mask_rotation_rad)
    return np.asarray(points @ np.array([[c, s], [-s, c]]))  # Rᵀ applied to each point


def project(truth: Truth, points_mm: NDArray[np.float64]) -> Singles:
    """(..., h, w, 3): the light field at aperture points (..., 2), as far as the mask's carriers can tell.

    The views' angular spectrum is taken at the carriers' orders and summed back: what a perfect decoder gets that
    transforms slices to views. Where κ is not 1 an aperture of one brightness does not give views of one
    brightness: beyond 1 its rim is seen twice, below 1 the outer views see past it.
    """
    orders = np.array(truth.mask.orders(), dtype=np.float64)
    c, s = math.cos(truth.mask_rotation_rad), math.sin(truth.mask_rotation_rad)
    k = orders @ np.array([[c, s], [-s, c]]) * truth.angular_frequency_per_mm
    here = np.exp(2j * np.pi * truth.aperture_points_mm.reshape(-1, 2) @ k.T)  # (J, K)
    there = np.exp(-2j * np.pi * np.asarray(points_mm).reshape(-1, 2) @ k.T)  # (U, K)
    weights = (there @ here.T).real.astype(np.float32) / len(here)
    n = truth.views.shape[0]
    flat = weights @ truth.views.reshape(n * n, -1)
    return np.asarray(flat.reshape(*np.shape(points_mm)[:-1], *truth.views.shape[2:]))


def band_views(truth: Truth, n: int) -> Singles:
    """(n, n, h, w, 3): `project` at `view_points_mm`. With n = 2p+1, as many samples, and κ = 1, the views."""
    return project(truth, view_points_mm(truth, n))


def place_on_sensor_mm(pose: TruePose, point_ned_m: tuple[float, float, float], v_mm: float) -> tuple[float, float]:
    """(y, x) in mm on the sensor where the aperture's centre sees a point.

    Raises ValueError for a point that is not in front of the camera.
    """
    forward, right, down = rotation(pose.attitude).T @ (np.array(point_ned_m) - np.array(pose.position_ned_m))
    if down <= 0:
        raise ValueError("the point is not below the camera")
    return float(-forward / down * v_mm), float(right / down * v_mm)
