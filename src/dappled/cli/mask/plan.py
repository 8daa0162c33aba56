"""`dappled plan`, also `dappled mask plan`: interval, motion blur, frame rate and disk space at an altitude."""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import dataclass

from dappled import codec
from dappled.cli.mask.arguments import AltitudeArguments, out_of_reach
from dappled.cli.table import words_only
from dappled.cli.verb import Output, Report, Verb, flag, option

if not words_only:
    from dappled.config import profiles
    from dappled.config.profiles import CameraProfile
    from dappled.decode.optics import MaskedOptics, carrier_tables, lenses
    from dappled.decode.optics.lenses import SingleFrameDepth, SurveyPlan
    from dappled.decode.optics.mask_design import SMALL_VIEW_PX
    from dappled.decode.optics.picture_contrast import PictureContrast, picture_contrast

_FREQUENCIES = (0.1, 0.2, 0.3, 0.4)  # cycles a pixel
_SHALLOW = 0.05  # of the altitude: a house is no higher


@dataclass(frozen=True, kw_only=True)
class PlanFlight(AltitudeArguments, Verb):
    """Plan a flight."""

    examples = (
        "dappled plan --altitude 40 --speed 8 --camera fujifilm-s5200 --focal-length 13",
        "dappled mask plan --altitude 40 --speed 8 --camera fujifilm-s5200 --focal-length 13   (the same)",
    )

    speed: float = option("--speed", "speed over ground", unit="m/s", low=0.01, high=200)
    overlap: float = option("--overlap", "overlap along the line, a share", 0.8, metavar="SHARE", low=0, high=0.99)
    sidelap: float = option("--sidelap", "overlap between lines, a share", 0.6, metavar="SHARE", low=0, high=0.99)
    exposure: float = option("--exposure", "exposure time", 0.001, unit="s", low=1e-6, high=60)
    hours: float = option("--hours", "flight time", 1.0, unit="h", above=0.0, high=1000)
    frame_mb: float = option("--frame-mb", "size of a raw file", 18.0, unit="MB", low=1e-3, high=10_000)
    mask: str | None = option("--mask", "mask profile, for what its views and one frame's depth are worth", None)
    f_number: float | None = option(
        "--f-number", "f-number of the lens", None, above=0.0, otherwise="the mask's ideal one",
    )  # fmt: skip
    interval: float | None = option(
        "--interval", "time that the body needs for a photograph", None, unit="s", above=0.0, otherwise="not looked at",
    )  # fmt: skip
    sideways: bool = flag("--sideways", "the width of the frame, not its height, lies along the flight line")

    def check(self) -> None:
        self.camera_set()
        if self.mask:
            profiles.mask(self.mask)

    def run(self, output: Output) -> Report:
        camera, sensor, length = self.camera_set()
        columns, warnings, depth, contrast = None, list[str](), None, None
        if self.mask:
            optics = MaskedOptics(sensor, profiles.mask(self.mask).mask, camera.law, camera.mask_distance_mm)
            f_number = self.f_number or optics.mask.frequency_per_mm * optics.distance_mm
            contrast = picture_contrast(optics, f_number, _FREQUENCIES)
            size = carrier_tables.slice_size(carrier_tables.lattice_of(optics, length), sensor.shape)
            columns = size[1] if size else None
            warnings = list(_warnings(camera, optics, length))
            if columns is not None:
                width_mm = sensor.size_mm[1]
                depth = lenses.frame_depth(
                    focal_length_mm=length,
                    f_number=f_number,
                    distance_m=self.altitude,
                    pixel_mm=width_mm / sensor.shape[1],
                    view_pixel_mm=width_mm / columns,
                    views=optics.mask.views_per_axis,
                )
                warnings += _shallow(depth, self.altitude)
        flight = lenses.SurveyFlight(
            focal_length_mm=length,
            altitude_m=self.altitude,
            speed_m_s=self.speed,
            overlap=self.overlap,
            sidelap=self.sidelap,
            exposure_s=self.exposure,
            hours=self.hours,
            frame_bytes=round(self.frame_mb * 1e6),
            sideways=self.sideways,
        )
        made = flight.plan(sensor, columns)
        if self.interval is not None and made.interval_s < self.interval:
            warnings.append(_too_fast(made, self.interval, self.speed))
        views = "" if made.view_sample_m is None else f" of the picture, {made.view_sample_m * 100:.1f} cm of a view"
        lines = [
            f"footprint  {made.footprint_m[1]:.1f} m across, {made.footprint_m[0]:.1f} m along the flight",
            f"ground     {made.ground_sample_m * 100:.2f} cm per pixel{views}",
            *(() if contrast is None else [_contrast_line(contrast)]),
            *(() if depth is None else [_depth_line(depth)]),
            f"interval   {made.interval_s:.2f} s, {made.spacing_m:.2f} m; lines {made.line_m:.1f} m apart",
            f"body       must sustain {made.frames_per_minute:.1f} frames per minute",
            f"blur       {made.blur_px:.2f} px; one pixel at {made.longest_exposure_s * 1e3:.2f} ms",
            f"disk       {made.frames} frames, {made.disk_bytes / 1e9:.1f} GB, on the card and again on the disk",
            *(f"warning: {warning}" for warning in warnings),
        ]
        brings = {"frame_depth": codec.plain(depth), "picture_contrast": codec.plain(contrast)}
        said = {**codec.plain(made), **brings, "warnings": warnings}
        return Report(said, lines)


def _contrast_line(contrast: PictureContrast) -> str:
    """What the mask leaves of the picture's contrast."""
    pairs = zip(contrast.cycles_per_px, contrast.left, strict=True)
    each = ", ".join(f"{one:.2f} at {at:g}" for at, one in pairs)
    return (
        f"picture    contrast in focus against the camera without a mask (f/{contrast.f_number:.3g}): {each} cycles/px"
    )


def _depth_line(depth: SingleFrameDepth) -> str:
    """What one frame tells of heights."""
    return (
        f"one frame  over the stop (f/{depth.f_number:.3g}) the ground moves by {depth.stop_px:.2g} px, a metre of "
        f"relief by {depth.relief_px:.2g} px more; a height is known to ±{_two_digits(depth.sigma_m)} m"
    )


def _too_fast(made: SurveyPlan, body_s: float, speed_m_s: float) -> str:
    """Which speed or overlap the body, which takes a photograph in `body_s`, keeps up with."""
    slow = math.floor(100 * made.spacing_m / body_s) / 100
    overlap = math.floor(100 * (1 - speed_m_s * body_s / made.footprint_m[0])) / 100
    less = f", or with an --overlap of {overlap:g} or less" if overlap >= 0 else ""
    needs = f"the body takes a photograph in {body_s:g} s, not in {made.interval_s:.2g} s"
    return f"{needs}: fly at {slow:g} m/s or slower{less}"


def _two_digits(value: float) -> str:
    return f"{float(f'{value:.2g}'):g}"


def _shallow(depth: SingleFrameDepth, altitude_m: float) -> Iterator[str]:
    if depth.sigma_m > _SHALLOW * altitude_m:
        yield (
            f"one frame tells no relief from {altitude_m:g} m (±{_two_digits(depth.sigma_m)} m): it brings a picture; "
            "heights come from overlapping frames (dappled georeference --as terrain)"
        )


def _warnings(camera: CameraProfile, optics: MaskedOptics, focal_length_mm: float) -> Iterator[str]:
    """What the camera's own limits make of this mask."""
    mask, sensor, lattice = optics.mask, optics.sensor, carrier_tables.lattice_of(optics, focal_length_mm)
    size = carrier_tables.slice_size(lattice, sensor.shape)
    if size is None:
        yield "the carriers lie too close together for views"
    elif min(size) < SMALL_VIEW_PX:
        yield f"views of {size[1]} × {size[0]} px show little more than large shapes"
    beyond = carrier_tables.beyond_mask(mask, sensor, lattice)
    if beyond is not None:
        by_rays = carrier_tables.lattice_of(optics.by("geometric"), focal_length_mm)
        smaller = carrier_tables.slice_size(by_rays, sensor.shape)
        views = "no views" if smaller is None else f"views of {smaller[1]} × {smaller[0]} px"
        yield f"{beyond}; the law geometric gives {views}"
    unreachable = out_of_reach(camera, mask.frequency_per_mm * optics.distance_mm)
    if unreachable is not None:
        yield unreachable
