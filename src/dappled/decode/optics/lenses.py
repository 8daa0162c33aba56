"""Thin lens and survey geometry: Eq 2 to 5, sampling (Tables 2 and 10), field of view, ground sample, depth error.

Lengths inside the camera are in mm, distances in front of it in m, as the names say. Every function refuses nonsense
(negative, zero, NaN, a wrong unit) with a DecodeError that names the value and the limit.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

from dappled.decode.errors import DecodeError


def within(name: str, value: float, unit: str, low: float, high: float, *, hint: str = "") -> float:
    """`value`, checked to lie between the limits, both included. Raises DecodeError."""
    if not (math.isfinite(value) and low <= value <= high):
        ending = f"; {hint}" if hint else ""
        raise DecodeError(f"{name} = {value:g} {unit} must lie between {low:g} and {high:g} {unit}{ending}")
    return value


def focal_length(value_mm: float) -> float:
    """A lens' focal length in mm, checked."""
    return within("focal length", value_mm, "mm", 0.5, 5000, hint="is it given in millimetres?")


def distance(value_m: float) -> float:
    """A distance in front of the lens in m, checked."""
    return within("distance", value_m, "m", 1e-3, 1e6, hint="is it given in metres?")


@dataclass(frozen=True, slots=True)
class Sampling:
    """Samples along one axis of a chip or a film: their number and the length they cover."""

    count: int
    length_mm: float

    def __post_init__(self) -> None:
        within("pixels along an axis", self.count, "px", 1, 1_000_000)
        within("length of an axis", self.length_mm, "mm", 1e-3, 10_000)

    @property
    def px_per_mm(self) -> float:
        """Sampling rate, samples a mm (Tables 2 and 10)."""
        return self.count / self.length_mm

    @property
    def nyquist_per_mm(self) -> float:
        """The highest frequency that can be sampled, cycles/mm."""
        return self.px_per_mm / 2


def lens_maker_focal_length_mm(refractive_index: float, radius_1_mm: float, radius_2_mm: float) -> float:
    """Eq 2: 1/F = (n − 1)(1/R1 + 1/R2), both radii positive for a lens that is convex on both sides.

    Raises DecodeError where the lens has no power.
    """
    within("refractive index", refractive_index, "", 1, 5)
    if not (math.isfinite(radius_1_mm) and math.isfinite(radius_2_mm)) or 0 in (radius_1_mm, radius_2_mm):
        raise DecodeError(f"radii {radius_1_mm:g} and {radius_2_mm:g} mm must be finite and not 0")
    power = (refractive_index - 1) * (1 / radius_1_mm + 1 / radius_2_mm)  # Eq 2
    if power == 0:
        raise DecodeError("this lens has no power: its surfaces cancel, or its index is 1")
    return 1 / power


def image_distance_mm(focal_length_mm: float, object_distance_m: float) -> float:
    """Eq 3, 1/F = 1/d + 1/g, solved for g: lens to real image. An object at infinity is imaged at F.

    Raises DecodeError for an object at or inside the focal length: it has no real image.
    """
    focal_length(focal_length_mm)
    if object_distance_m == math.inf:
        return focal_length_mm
    object_mm = 1e3 * distance(object_distance_m)
    if object_mm <= focal_length_mm:
        raise DecodeError(
            f"an object at {object_distance_m:g} m has no real image behind a {focal_length_mm:g} mm lens"
        )
    return 1 / (1 / focal_length_mm - 1 / object_mm)


def conjugate_distance_mm(sensor_distance_mm: float, h_mm: float, v_mm: float) -> float:
    """Eq 4: 1/g = (1/f)(1 − h/v), g from the lens to the real image (Table 1 names another distance; Eq 3 decides).

    `sensor_distance_mm` is f, lens to sensor; `h_mm` the displacement on the sensor of the ray that crossed the lens
    at `v_mm` from its axis. inf where the rays are parallel (h = v).
    """
    within("lens to sensor", sensor_distance_mm, "mm", 0.5, 5000)
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
    focal_length(focal_length_mm)
    within("error of h", sigma_h_mm, "mm", 0, 1e3)
    inverse_per_mm = 1 / focal_length_mm - 1 / conjugate_distance_mm(sensor_distance_mm, h_mm, v_mm)  # Eq 5
    if inverse_per_mm < 0:
        raise DecodeError(f"no object makes h = {h_mm:g} mm at v = {v_mm:g} mm: its rays come from beyond infinity")
    if inverse_per_mm == 0:
        return Depth(math.inf, math.inf)
    d_mm = 1 / inverse_per_mm
    return Depth(d_mm / 1e3, d_mm**2 * sigma_h_mm / (sensor_distance_mm * abs(v_mm)) / 1e3)


def depth_sigma_m(distance_m: float, sensor_distance_mm: float, baseline_mm: float, sigma_shift_mm: float) -> float:
    """Eq 5's limit: the error of a distance when the shift over a baseline on the aperture has one."""
    within("lens to sensor", sensor_distance_mm, "mm", 0.5, 5000)
    within("baseline", baseline_mm, "mm", 1e-6, 5000)
    within("error of the shift", sigma_shift_mm, "mm", 0, 1e3)
    return (1e3 * distance(distance_m)) ** 2 * sigma_shift_mm / (sensor_distance_mm * baseline_mm) / 1e3


def field_of_view_rad(length_mm: float, sensor_distance_mm: float) -> float:
    """The full angle that an axis of `length_mm` sees from `sensor_distance_mm` (the focal length at infinity)."""
    within("length of the chip", length_mm, "mm", 1e-3, 10_000)
    within("lens to sensor", sensor_distance_mm, "mm", 0.5, 5000)
    return 2 * math.atan2(length_mm / 2, sensor_distance_mm)


def ground_sample_m(pitch_mm: float, focal_length_mm: float, altitude_m: float) -> float:
    """What one sample of `pitch_mm` covers on flat ground straight below a lens focused on it, m.

    A whole chip's length as `pitch_mm` gives the footprint.
    """
    within("pitch", pitch_mm, "mm", 1e-6, 10_000)
    return pitch_mm * altitude_m / image_distance_mm(focal_length_mm, altitude_m)


def hyperfocal_m(focal_length_mm: float, f_number: float, circle_mm: float) -> float:
    """Focused here, everything from half of it to infinity is blurred by less than `circle_mm`: F²/(N·c) + F, in m."""
    focal_length(focal_length_mm)
    within("f-number", f_number, "", 0.5, 128)
    within("circle of confusion", circle_mm, "mm", 1e-6, 10)
    return (focal_length_mm**2 / (f_number * circle_mm) + focal_length_mm) / 1e3
