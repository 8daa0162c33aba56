"""Planning a flight: ground sample, interval, motion blur, and what the body and the disk must take."""

from __future__ import annotations

import math
from dataclasses import dataclass

from dappled.decode.optics.carriers import Sensor
from dappled.decode.optics.lenses import ground_sample_m, within


@dataclass(frozen=True, slots=True)
class Plan:
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


def plan(
    sensor: Sensor,
    *,
    focal_length_mm: float,
    altitude_m: float,
    speed_m_s: float,
    overlap: float = 0.8,
    sidelap: float = 0.6,
    exposure_s: float = 1 / 1000,
    hours: float = 1.0,
    frame_bytes: int = 18_000_000,
    view_columns: int | None = None,
    sideways: bool = False,
) -> Plan:
    """What a flight at this altitude above ground and speed over ground asks for.

    `overlap` and `sidelap` are shares of the footprint, `view_columns` the pixels of a decoded view across.
    `longest_exposure_s` blurs by one frame pixel. Raises DecodeError for nonsense in any value.
    """
    within("ground speed", speed_m_s, "m/s", 0.01, 200, hint="is it in metres a second?")
    within("overlap", overlap, "", 0, 0.99, hint="a share, not percent")
    within("sidelap", sidelap, "", 0, 0.99, hint="a share, not percent")
    within("exposure", exposure_s, "s", 1e-6, 60, hint="in seconds, as in 0.001")
    within("flight time", hours, "h", 1 / 3600, 1000)
    within("size of a frame", frame_bytes, "bytes", 1, 1e10)
    height_mm, width_mm = sensor.size_mm
    down, across = (ground_sample_m(side, focal_length_mm, altitude_m) for side in (height_mm, width_mm))
    footprint = (across, down) if sideways else (down, across)
    samples = (down / sensor.shape[0], across / sensor.shape[1])
    along_sample = samples[1] if sideways else samples[0]
    view_sample = None
    if view_columns is not None:
        within("view", view_columns, "px", 1, sensor.shape[1])
        view_sample = across / view_columns
    spacing = footprint[0] * (1 - overlap)
    line = footprint[1] * (1 - sidelap)
    interval = spacing / speed_m_s
    blur = speed_m_s * exposure_s
    frames = math.ceil(hours * 3600 / interval)
    return Plan(
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
        longest_exposure_s=along_sample / speed_m_s,
        frames=frames,
        disk_bytes=frames * frame_bytes,
        area_m2=speed_m_s * hours * 3600 * line,
    )
