"""`dappled mask design` and `dappled mask plan`: from an altitude to a mask, and to a flight."""

from __future__ import annotations

import argparse
import json
from dataclasses import asdict
from pathlib import Path
from typing import Any

import numpy as np
from PIL import Image

from dappled.config import profiles
from dappled.config.schema import ConfigError
from dappled.decode import optics, prediction, spectrum_pictures, survey
from dappled.decode.carriers import LAWS, Sensor
from dappled.decode.design import DESIGNS, Design, Wish
from dappled.decode.film import FILMS


def configure(parser: argparse.ArgumentParser) -> None:
    _configure_camera(parser)
    parser.add_argument("--f-number", type=float, default=5.6, metavar="N", help="of the lens (default 5.6)")
    parser.add_argument("--views", type=int, default=5, metavar="N", help="views an axis, odd (default 5)")
    parser.add_argument("--film", default="4k", choices=tuple(FILMS))
    parser.add_argument("--law", default="", choices=("", *LAWS), help="carrier law (default: the camera's)")
    parser.add_argument("--mask-distance", type=float, metavar="MM", help="fixed by the camera (default: free)")
    parser.add_argument("--room", type=float, metavar="MM", help="the most that the mask may stand off (default 10)")
    parser.add_argument("--wavelength", type=float, default=550.0, metavar="NM")
    parser.add_argument("--shift-error", type=float, default=0.02, metavar="PX", help="of a shift between views")
    parser.add_argument("--mask", metavar="P", help="an installed mask: its best focal length instead")
    parser.add_argument("--picture", type=Path, metavar="FILE.png", help="draw the carriers on the spectrum")
    parser.add_argument("--json", action="store_true", help="as JSON")


def _configure_camera(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("--altitude", type=float, required=True, metavar="M", help="above ground")
    parser.add_argument("--camera", required=True, metavar="P", help="camera profile or TOML file")
    parser.add_argument("--focal-length", type=float, metavar="MM", help="default: the camera's, if it has one only")
    parser.add_argument(
        "--shape", type=int, nargs=2, metavar=("H", "W"), help="raw shape (default: the camera's first)"
    )


def configure_plan(parser: argparse.ArgumentParser) -> None:
    _configure_camera(parser)
    parser.add_argument("--speed", type=float, required=True, metavar="M/S", help="over ground")
    parser.add_argument("--overlap", type=float, default=0.8, metavar="SHARE", help="along the line (default 0.8)")
    parser.add_argument("--sidelap", type=float, default=0.6, metavar="SHARE", help="between lines (default 0.6)")
    parser.add_argument("--exposure", type=float, default=0.001, metavar="S", help="default 0.001")
    parser.add_argument("--hours", type=float, default=1.0, metavar="H", help="flight time (default 1)")
    parser.add_argument("--frame-mb", type=float, default=18.0, metavar="MB", help="size of a raw file (default 18)")
    parser.add_argument("--mask", metavar="P", help="mask profile, for the views' own ground sample")
    parser.add_argument("--sideways", action="store_true", help="the frame's columns lie along the flight")
    parser.add_argument("--json", action="store_true", help="as JSON")


def _camera(arguments: argparse.Namespace) -> tuple[profiles.CameraProfile, Sensor, float]:
    camera = profiles.camera(arguments.camera)
    shape = arguments.shape
    sensor = camera.sensor((shape[0], shape[1])) if shape else camera.raw[0].sensor
    length, known = arguments.focal_length, camera.focal_length_mm
    if length is None and known is not None and known[0] == known[1]:
        length = known[0]
    if length is None:
        raise ConfigError(f"--focal-length says, in mm, how {camera.name} is set: it has no single one")
    return camera, sensor, optics.focal_length(length)


def run(arguments: argparse.Namespace) -> int:
    if arguments.mask:
        return _best(arguments)
    camera, sensor, length = _camera(arguments)
    law = arguments.law or camera.law
    wish = Wish(
        sensor=sensor,
        focal_length_mm=length,
        f_number=arguments.f_number,
        altitude_m=arguments.altitude,
        film=FILMS[arguments.film],
        views=arguments.views,
        wavelength_nm=arguments.wavelength,
        shift_sigma_px=arguments.shift_error,
        mask_distance_mm=arguments.mask_distance,
        largest_distance_mm=min(10.0, length) if arguments.room is None else arguments.room,
    )
    made = DESIGNS[law](wish)
    if arguments.picture:
        Image.fromarray(_picture(made)).save(arguments.picture)
    if arguments.json:
        print(json.dumps(_as_json(made), indent=2))
    else:
        print(_as_text(made))
    return 0 if made.works else 1


def _best(arguments: argparse.Namespace) -> int:
    camera = profiles.camera(arguments.camera)
    sensor = camera.sensor(tuple(arguments.shape)) if arguments.shape else camera.raw[0].sensor
    mask, law = profiles.mask(arguments.mask).mask, arguments.law or camera.law
    distance = camera.mask_distance_mm if arguments.mask_distance is None else arguments.mask_distance
    best = prediction.best_focal_length(mask, sensor, distance, law=law)
    if arguments.json:
        print(json.dumps({"law": law, "mask_distance_mm": distance, **asdict(best)}, indent=2))
        return 0
    if best.slices_mm is None or best.carriers_mm is None:
        print(f"law {law}: no focal length brings the outer slices of {arguments.mask} to the edge of the spectrum")
    else:
        print(
            f"law {law}: {arguments.mask} at {distance:g} mm fills the spectrum at {best.slices_mm:.1f} mm "
            f"(carriers alone at {best.carriers_mm:.1f} mm)"
        )
    ideal = mask.frequency_per_mm * distance
    print(f"by geometry its views are separated at f/{ideal:.3g}, whatever the lens")
    return 0


def _picture(made: Design) -> Any:
    height, width = made.wish.sensor.shape
    shrink = max(1, max(height, width) // 1200)
    lattice = prediction.lattice_of(
        made.law, made.mask, made.wish.sensor, made.mask_distance_mm, made.wish.focal_length_mm
    )
    carriers = [c for c in lattice.carriers(made.mask.half_orders()) if c.on_sensor]
    size = abs(lattice.ky[0]), abs(lattice.kx[1])
    return spectrum_pictures.spectrum_boxes(np.zeros((height // shrink, width // shrink), np.float32), carriers, size)


def _as_json(made: Design) -> dict[str, Any]:
    told = asdict(made)
    wish = told.pop("wish")
    return {
        "works": made.works,
        **told,
        "film": wish["film"]["name"],
        "views": wish["views"],
        "altitude_m": wish["altitude_m"],
        "aperture_mm": made.wish.aperture_mm,
    }


def _as_text(made: Design) -> str:
    wish = made.wish
    rows, columns = made.view_shape
    lines = [
        f"law {made.law}: {wish.views} × {wish.views} views of {columns} × {rows} px from {wish.altitude_m:g} m",
        (
            f"mask       {made.mask.frequency_per_mm:.3f} periods/mm, p = {made.mask.p}, {made.mask.pattern}; "
            f"{made.film_period_px:.2f} px a period on film {wish.film.name}"
        ),
        f"distance   {made.mask_distance_mm:.3f} mm before the sensor",
        f"aperture   {wish.aperture_mm:.2f} mm (f/{wish.f_number:g}), {made.baseline_mm:.2f} mm from view to view",
        f"a view     ±{made.bandwidth_per_mm:.2f} cycles/mm, {made.ground_sample_m * 100:.1f} cm of ground a pixel",
        f"spectrum   {100 * made.spectrum_used:.0f} % used",
        (
            f"depth      ±{made.depth_sigma_m:.2g} m at {wish.altitude_m:g} m, "
            f"shifts known to {wish.shift_sigma_px:g} px a view"
        ),
        *(f"{'ok  ' if c.met else 'FAIL'}       {c.sentence}" for c in made.conditions),
    ]
    lines.append(f"film       {', '.join(made.films) or 'none of Table 2'} can print it")
    if made.problem:
        lines.append(made.problem)
    elif made.depth_sigma_m > wish.altitude_m / 2:
        lines.append("this depth is no measurement: fly lower, or take a longer lens with a wider aperture")
    return "\n".join(lines)


def run_plan(arguments: argparse.Namespace) -> int:
    camera, sensor, length = _camera(arguments)
    columns = None
    if arguments.mask:
        mask = profiles.mask(arguments.mask).mask
        lattice = prediction.lattice_of(camera.law, mask, sensor, camera.mask_distance_mm, length)
        size = prediction.slice_size(lattice, sensor.shape)
        columns = size[1] if size else None
    made = survey.plan(
        sensor,
        focal_length_mm=length,
        altitude_m=arguments.altitude,
        speed_m_s=arguments.speed,
        overlap=arguments.overlap,
        sidelap=arguments.sidelap,
        exposure_s=arguments.exposure,
        hours=arguments.hours,
        frame_bytes=round(optics.within("size of a frame", arguments.frame_mb, "MB", 1e-3, 10_000) * 1e6),
        view_columns=columns,
        sideways=arguments.sideways,
    )
    if arguments.json:
        print(json.dumps(asdict(made), indent=2))
        return 0
    views = "" if made.view_sample_m is None else f", {made.view_sample_m * 100:.1f} cm a pixel of a view"
    print(f"footprint  {made.footprint_m[1]:.1f} m across, {made.footprint_m[0]:.1f} m along the flight")
    print(f"ground     {made.ground_sample_m * 100:.2f} cm a pixel{views}")
    print(f"interval   {made.interval_s:.2f} s, {made.spacing_m:.2f} m; lines {made.line_m:.1f} m apart")
    print(f"body       must sustain {made.frames_per_minute:.1f} frames a minute")
    print(f"blur       {made.blur_px:.2f} px; one pixel at {made.longest_exposure_s * 1e3:.2f} ms")
    print(f"disk       {made.frames} frames, {made.disk_bytes / 1e9:.1f} GB; card and disk alike, without previews")
    return 0
