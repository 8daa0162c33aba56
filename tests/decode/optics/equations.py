"""Optics as the equations say them, for comparison with what ships: Eq 4 and 5, propagation to the sensor, spots."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy import fft, ndimage

from dappled.decode.errors import DecodeError
from dappled.decode.optics import lenses
from dappled.decode.optics.laser_bench import Screen, bench_scale


def conjugate_distance_mm(sensor_distance_mm: float, h_mm: float, v_mm: float) -> float:
    """Eq 4: 1/g = (1/f)(1 − h/v), g from the lens to the real image (Table 1 names another distance; Eq 3 decides).

    `sensor_distance_mm` is f, lens to sensor; `h_mm` the displacement on the sensor of the ray that crossed the lens
    at `v_mm` from its axis. inf where the rays are parallel (h = v).
    """
    lenses.within("lens to sensor", sensor_distance_mm, "mm", 0.5, 5000)
    if v_mm == 0 or not math.isfinite(h_mm) or not math.isfinite(v_mm):
        raise DecodeError(f"displacements h = {h_mm:g} mm, v = {v_mm:g} mm must be finite, and v not 0")
    inverse = (1 - h_mm / v_mm) / sensor_distance_mm  # Eq 4
    return math.inf if inverse == 0 else 1 / inverse


@dataclass(frozen=True, slots=True)
class Depth:
    """A distance from the lens and its standard error, both in m."""

    distance_m: float
    sigma_m: float


def object_distance(
    focal_length_mm: float, sensor_distance_mm: float, h_mm: float, v_mm: float, sigma_h_mm: float = 0.0
) -> Depth:
    """Eq 5: 1/d = 1/F − (1/f)(1 − h/v), with the error that `sigma_h_mm` of h makes: σ_d = d²·σ_h / (f·|v|).

    Raises DecodeError where h is that of rays from beyond infinity.
    """
    lenses.focal_length(focal_length_mm)
    lenses.within("error of h", sigma_h_mm, "mm", 0, 1e3)
    inverse_per_mm = 1 / focal_length_mm - 1 / conjugate_distance_mm(sensor_distance_mm, h_mm, v_mm)  # Eq 5
    if inverse_per_mm < 0:
        raise DecodeError(f"no object makes h = {h_mm:g} mm at v = {v_mm:g} mm: its rays come from beyond infinity")
    if inverse_per_mm == 0:
        return Depth(math.inf, math.inf)
    d_mm = 1 / inverse_per_mm
    return Depth(d_mm / 1e3, d_mm**2 * sigma_h_mm / (sensor_distance_mm * abs(v_mm)) / 1e3)


def near_field(
    field: NDArray[np.complexfloating] | NDArray[np.floating],
    pitch_mm: tuple[float, float],
    wavelength_nm: float,
    distance_m: float,
) -> NDArray[np.complex128]:
    """Fresnel diffraction by the transfer function H(p, q) = exp(−iπλz(p² + q²)) (Eq 19), for mask to sensor.

    `field` (H, W) is taken as periodic; the result has its pitch. H is sampled properly while λ·z ≤ N·pitch². Raises
    DecodeError where it is not: use `far_screen`.
    """
    area_mm2 = bench_scale(wavelength_nm, distance_m) * 1e6
    for count, pitch in zip(field.shape, pitch_mm, strict=True):
        lenses.within("pitch of the mask", pitch, "mm", 1e-6, 10)
        if area_mm2 > count * pitch**2:
            raise DecodeError(
                f"{distance_m:g} m is too far for {count} samples of {pitch:g} mm: the transfer function needs "
                f"λz ≤ samples × pitch² = {count * pitch**2:.4g} mm², this is {area_mm2:.4g}"
            )
    q, p = (fft.fftfreq(n, pitch) for n, pitch in zip(field.shape, pitch_mm, strict=True))
    transfer = np.exp(-1j * np.pi * area_mm2 * (q[:, None] ** 2 + p**2))
    result: NDArray[np.complex128] = fft.ifft2(fft.fft2(field.astype(np.complex128)) * transfer)
    return result


@dataclass(frozen=True, slots=True)
class Spot:
    """A spot of light: its centre of gravity in mm from the axis, and its peak as a share of the brightest."""

    x_mm: float
    y_mm: float
    strength: float


def spots(screen: Screen, *, separation_mm: float = 1.0, faintest: float = 1e-4) -> list[Spot]:
    """The spots on a screen, the brightest first: local maxima that are alone within `separation_mm` (a square's side).

    The place is the centre of gravity of the brighter half around the peak. Nothing of the mask is assumed.
    """
    reach = [max(1, round(separation_mm / 2 / pitch)) for pitch in screen.pitch_mm]
    smooth = ndimage.uniform_filter(screen.intensity, [max(1, r // 4) for r in reach])
    highest = ndimage.maximum_filter(smooth, [2 * r + 1 for r in reach], mode="constant")
    brightest = float(smooth.max())
    found = []
    height, width = smooth.shape
    for row, column in np.argwhere((smooth == highest) & (smooth > faintest * brightest)).tolist():
        top, left = max(0, row - reach[0]), max(0, column - reach[1])
        box = smooth[top : min(height, row + reach[0] + 1), left : min(width, column + reach[1] + 1)]
        weight = np.clip(box - 0.5 * smooth[row, column], 0, None)
        y, x = np.mgrid[top : top + box.shape[0], left : left + box.shape[1]]
        x_mm, y_mm = _at_mm(screen, float((weight * y).sum() / weight.sum()), float((weight * x).sum() / weight.sum()))
        found.append(Spot(x_mm, y_mm, float(smooth[row, column]) / brightest))
    return sorted(found, key=lambda spot: -spot.strength)


# --- what a person measured --------------------------------------------------------------------------------------


def _at_mm(screen: Screen, row: float, column: float) -> tuple[float, float]:
    """(x, y) in mm of a fractional index."""
    height, width = screen.intensity.shape
    return (column - width // 2) * screen.pitch_mm[1], (row - height // 2) * screen.pitch_mm[0]
