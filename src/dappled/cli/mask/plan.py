"""`dappled plan`, also `dappled mask plan`: interval, motion blur, frame rate and disk space at an altitude."""

from __future__ import annotations

import argparse
import json
from collections.abc import Iterator
from dataclasses import asdict

from dappled.cli.mask import arguments as mask_arguments
from dappled.config import profiles
from dappled.config.profiles import CameraProfile
from dappled.decode.optics import Lattice, Mask, Sensor, carrier_tables, lenses
from dappled.decode.optics.mask_design import SMALL_VIEW_PX

HELP = "plan a flight: interval, motion blur, frame rate and disk space"
EXAMPLE = "dappled mask plan --altitude 40 --speed 8 --camera fujifilm-s5200 --focal-length 13"


def configure(parser: argparse.ArgumentParser) -> None:
    parser.epilog = parser.epilog or f"example: {EXAMPLE.replace('mask plan', 'plan')}"
    mask_arguments.add_altitude(parser)
    parser.add_argument("--speed", type=float, required=True, metavar="M/S", help="speed over ground")
    parser.add_argument(
        "--overlap", type=float, default=0.8, metavar="SHARE", help="overlap along the line (default: 0.8)"
    )
    parser.add_argument(
        "--sidelap", type=float, default=0.6, metavar="SHARE", help="overlap between lines (default: 0.6)"
    )
    parser.add_argument("--exposure", type=float, default=0.001, metavar="S", help="exposure time (default: 0.001)")
    parser.add_argument("--hours", type=float, default=1.0, metavar="H", help="flight time (default: 1)")
    parser.add_argument("--frame-mb", type=float, default=18.0, metavar="MB", help="size of a raw file (default: 18)")
    parser.add_argument("--mask", metavar="P", help="mask profile, for the ground sample distance of the views")
    parser.add_argument(
        "--sideways", action="store_true", help="the width of the frame, not its height, lies along the flight line"
    )
    parser.add_argument("--json", action="store_true", help="print JSON")


def run(arguments: argparse.Namespace) -> int:
    camera, sensor, length = mask_arguments.camera_set(arguments)
    columns, warnings = None, list[str]()
    if arguments.mask:
        mask = profiles.mask(arguments.mask).mask
        lattice = carrier_tables.lattice_of(camera.law, mask, sensor, camera.mask_distance_mm, length)
        size = carrier_tables.slice_size(lattice, sensor.shape)
        columns = size[1] if size else None
        warnings = list(_warnings(camera, mask, sensor, lattice, length))
    made = lenses.plan_survey(
        sensor,
        focal_length_mm=length,
        altitude_m=arguments.altitude,
        speed_m_s=arguments.speed,
        overlap=arguments.overlap,
        sidelap=arguments.sidelap,
        exposure_s=arguments.exposure,
        hours=arguments.hours,
        frame_bytes=round(lenses.within("size of a frame", arguments.frame_mb, "MB", 1e-3, 10_000) * 1e6),
        view_columns=columns,
        sideways=arguments.sideways,
    )
    if arguments.json:
        print(json.dumps({**asdict(made), "warnings": warnings}, indent=2))
        return 0
    views = "" if made.view_sample_m is None else f", {made.view_sample_m * 100:.1f} cm per pixel of a view"
    print(f"footprint  {made.footprint_m[1]:.1f} m across, {made.footprint_m[0]:.1f} m along the flight")
    print(f"ground     {made.ground_sample_m * 100:.2f} cm per pixel{views}")
    print(f"interval   {made.interval_s:.2f} s, {made.spacing_m:.2f} m; lines {made.line_m:.1f} m apart")
    print(f"body       must sustain {made.frames_per_minute:.1f} frames per minute")
    print(f"blur       {made.blur_px:.2f} px; one pixel at {made.longest_exposure_s * 1e3:.2f} ms")
    print(f"disk       {made.frames} frames, {made.disk_bytes / 1e9:.1f} GB, on the card and again on the disk")
    for warning in warnings:
        print(f"warning: {warning}")
    return 0


def _warnings(
    camera: CameraProfile, mask: Mask, sensor: Sensor, lattice: Lattice, focal_length_mm: float
) -> Iterator[str]:
    """What the camera's own limits make of this mask."""
    size = carrier_tables.slice_size(lattice, sensor.shape)
    if size is None:
        yield "the carriers lie too close together for views"
    elif min(size) < SMALL_VIEW_PX:
        yield f"views of {size[1]} × {size[0]} px show little more than large shapes"
    beyond = carrier_tables.beyond_mask(mask, sensor, lattice)
    if beyond is not None:
        by_rays = carrier_tables.lattice_of("geometric", mask, sensor, camera.mask_distance_mm, focal_length_mm)
        smaller = carrier_tables.slice_size(by_rays, sensor.shape)
        views = "no views" if smaller is None else f"views of {smaller[1]} × {smaller[0]} px"
        yield f"{beyond}; the law geometric gives {views}"
    unreachable = mask_arguments.out_of_reach(camera, mask.frequency_per_mm * camera.mask_distance_mm)
    if unreachable is not None:
        yield unreachable
