"""Thin lens and survey geometry: Eq 2 to 5, sampling (Tables 2 and 10), ground sample, depth error, flight plan.

Lengths inside the camera are in mm, distances in front of it in m, as the names say. Every function refuses nonsense
(negative, zero, NaN, a wrong unit) with a DecodeError that names the value and the limit.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

from dappled.decode.errors import DecodeError
from dappled.decode.optics.carriers import Sensor


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


def depth_sigma_m(distance_m: float, sensor_distance_mm: float, baseline_mm: float, sigma_shift_mm: float) -> float:
    """Eq 5's limit: the error of a distance when the shift over a baseline on the aperture has one."""
    within("lens to sensor", sensor_distance_mm, "mm", 0.5, 5000)
    within("baseline", baseline_mm, "mm", 1e-6, 5000)
    within("error of the shift", sigma_shift_mm, "mm", 0, 1e3)
    return (1e3 * distance(distance_m)) ** 2 * sigma_shift_mm / (sensor_distance_mm * baseline_mm) / 1e3


def ground_sample_m(pitch_mm: float, focal_length_mm: float, altitude_m: float) -> float:
    """What one sample of `pitch_mm` covers on flat ground straight below a lens focused on it, m.

    A whole chip's length as `pitch_mm` gives the footprint.
    """
    within("pitch", pitch_mm, "mm", 1e-6, 10_000)
    return pitch_mm * altitude_m / image_distance_mm(focal_length_mm, altitude_m)


SHIFT_SIGMA_PX = 0.02  # of a view: a good matcher's error of a shift from view to view


@dataclass(frozen=True, slots=True)
class SingleFrameDepth:
    """What one frame tells of depth from a distance. `stop_px` is how far the picture of a place moves over the whole
    stop, pixels of the frame (against infinity: what blurs it where the lens is focused there), `relief_px` what a
    metre of relief adds to it, `sigma_m` the standard error of a distance (Eq 5)."""

    f_number: float
    stop_px: float
    relief_px: float
    sigma_m: float


def frame_depth(
    *, focal_length_mm: float, f_number: float, distance_m: float, pixel_mm: float, view_pixel_mm: float, views: int
) -> SingleFrameDepth:
    """The depth in one frame of `views` a side, whose pixels are as large on the sensor as told. Raises DecodeError."""
    within("f-number", f_number, "", 0.5, 1000)
    aperture_mm, image_mm = focal_length_mm / f_number, image_distance_mm(focal_length_mm, distance_m)
    stop_px = aperture_mm * image_mm / (1e3 * distance_m) / pixel_mm
    sigma_m = depth_sigma_m(distance_m, image_mm, aperture_mm / views, SHIFT_SIGMA_PX * view_pixel_mm)
    return SingleFrameDepth(f_number, stop_px, stop_px / distance_m, sigma_m)


@dataclass(frozen=True, slots=True)
class SurveyPlan:
    """A flight over flat ground. Along is the direction of flight, the frame's rows unless it flies sideways.

    `footprint_m` (along, across), `interval_s` between frames for the overlap, `spacing_m` on the ground, `line_m`
    between flight lines, `blur_px` (frame pixels) and `view_blur_px` (pixels of a view, None without one),
    `ground_sample_m` of a frame pixel, `view_sample_m` of a view's. `disk_bytes` is what frames alone need.
    """

    footprint_m: tuple[float, float]
    ground_sample_m: float
    view_sample_m: float | None
    spacing_m: float
    line_m: float
    interval_s: float
    frames_per_minute: float
    blur_m: float
    blur_px: float
    view_blur_px: float | None
    longest_exposure_s: float
    frames: int
    disk_bytes: int
    area_m2: float


@dataclass(frozen=True, slots=True, kw_only=True)
class SurveyFlight:
    """A flight to plan: the lens, the altitude above ground and speed over ground, `overlap` and `sidelap` as shares of
    the footprint. `sideways`: the frame's columns lie along the flight."""

    focal_length_mm: float
    altitude_m: float
    speed_m_s: float
    overlap: float
    sidelap: float
    exposure_s: float
    hours: float
    frame_bytes: int
    sideways: bool = False

    def plan(self, sensor: Sensor, view_columns: int | None = None) -> SurveyPlan:
        """What it takes. `view_columns` are a decoded view's pixels across. `longest_exposure_s` blurs by one frame
        pixel."""
        down, across = (ground_sample_m(side, self.focal_length_mm, self.altitude_m) for side in sensor.size_mm)
        footprint = (across, down) if self.sideways else (down, across)
        samples = (down / sensor.shape[0], across / sensor.shape[1])
        along_sample = samples[1] if self.sideways else samples[0]
        view_sample = None
        if view_columns is not None:
            within("view", view_columns, "px", 1, sensor.shape[1])
            view_sample = across / view_columns
        spacing, line = footprint[0] * (1 - self.overlap), footprint[1] * (1 - self.sidelap)
        interval, blur = spacing / self.speed_m_s, self.speed_m_s * self.exposure_s
        frames = math.ceil(self.hours * 3600 / interval)
        return SurveyPlan(
            footprint_m=footprint,
            ground_sample_m=max(samples),
            view_sample_m=view_sample,
            spacing_m=spacing,
            line_m=line,
            interval_s=interval,
            frames_per_minute=60 / interval,
            blur_m=blur,
            blur_px=blur / along_sample,
            view_blur_px=None if view_sample is None else blur / view_sample,
            longest_exposure_s=along_sample / self.speed_m_s,
            frames=frames,
            disk_bytes=frames * self.frame_bytes,
            area_m2=self.speed_m_s * self.hours * 3600 * line,
        )
