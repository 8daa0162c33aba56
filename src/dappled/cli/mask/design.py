"""`dappled mask design`: design a mask, its distance and its film for an altitude."""

from __future__ import annotations

import argparse
import json
from dataclasses import asdict
from pathlib import Path
from typing import Any

import numpy as np
from PIL import Image

from dappled.cli.arguments import add_overwrite, refuse_existing
from dappled.cli.mask import arguments as mask_arguments
from dappled.decode.optics import carrier_tables
from dappled.decode.optics.film import FILMS
from dappled.decode.optics.mask_design import DESIGNS, Design, DesignRequirements, buildable
from dappled.decode.spectrum import pictures

HELP = "design mask, distance and film for an altitude"
EXAMPLE = "dappled mask design --altitude 40 --camera fujifilm-s5200 --focal-length 13 --f-number 3.5 --film 16k"


def configure(parser: argparse.ArgumentParser) -> None:
    mask_arguments.add_altitude(parser)
    parser.add_argument("--f-number", type=float, default=5.6, metavar="N", help="f-number of the lens (default: 5.6)")
    parser.add_argument("--views", type=int, default=5, metavar="N", help="views per axis, odd (default: 5)")
    parser.add_argument("--film", default="4k", choices=tuple(FILMS), help="film to print it on (default: 4k)")
    mask_arguments.add_installation(parser, free=True)
    parser.add_argument(
        "--room", type=float, metavar="MM", help="largest distance of the mask from the sensor (default: 10)"
    )
    parser.add_argument(
        "--wavelength", type=float, default=550.0, metavar="NM", help="wavelength of the light (default: 550)"
    )
    parser.add_argument(
        "--shift-error",
        type=float,
        default=0.02,
        metavar="PX",
        help="σ of a measured shift between views (default: 0.02)",
    )
    parser.add_argument("--mask", metavar="P", help="print the best focal length of this installed mask instead")
    parser.add_argument("--picture", type=Path, metavar="FILE.png", help="draw the carriers on the spectrum")
    add_overwrite(parser)
    parser.add_argument("--json", action="store_true", help="print JSON")


def run(arguments: argparse.Namespace) -> int:
    if arguments.picture:
        refuse_existing(arguments, arguments.picture)
    if arguments.mask:
        return _best(arguments)
    camera, sensor, length = mask_arguments.camera_set(arguments)
    law = arguments.law or camera.law
    wanted = DesignRequirements(
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
        least_distance_mm=camera.least_mask_distance_mm or 0.0,
        f_numbers=camera.f_numbers,
    )
    made = DESIGNS[law](wanted)
    instead = None if made.works else buildable(wanted, law)
    if arguments.picture:
        Image.fromarray(_picture(made)).save(arguments.picture)
    if arguments.json:
        print(json.dumps({**_as_json(made), "buildable": None if instead is None else _as_json(instead)}, indent=2))
    else:
        print(_as_text(made, instead))
    return 0 if made.works else 1


def _best(arguments: argparse.Namespace) -> int:
    one = mask_arguments.installed(arguments)
    best = carrier_tables.best_focal_length(one.mask, one.sensor, one.distance_mm, law=one.law)
    if arguments.json:
        print(json.dumps({"law": one.law, "mask_distance_mm": one.distance_mm, **asdict(best)}, indent=2))
        return 0
    if best.slices_mm is None or best.carriers_mm is None:
        print(f"law {one.law}: no focal length brings the outer slices of {arguments.mask} to the edge of the spectrum")
    else:
        print(
            f"law {one.law}: {arguments.mask} at {one.distance_mm:g} mm fills the spectrum at {best.slices_mm:.1f} mm "
            f"(carriers alone at {best.carriers_mm:.1f} mm)"
        )
    ideal = one.mask.frequency_per_mm * one.distance_mm
    print(f"by geometry its views are separated at f/{ideal:.3g}, whatever the lens")
    warning = mask_arguments.out_of_reach(one.camera, ideal)
    if warning is not None:
        print(f"warning: {warning}")
    return 0


def _picture(made: Design) -> Any:
    height, width = made.wanted.sensor.shape
    shrink = max(1, max(height, width) // 1200)
    lattice = carrier_tables.lattice_of(
        made.law, made.mask, made.wanted.sensor, made.mask_distance_mm, made.wanted.focal_length_mm
    )
    carriers = [c for c in lattice.carriers(made.mask.half_orders()) if c.on_sensor]
    size = abs(lattice.ky[0]), abs(lattice.kx[1])
    return pictures.spectrum_boxes(np.zeros((height // shrink, width // shrink), np.float32), carriers, size)


def _as_json(made: Design) -> dict[str, Any]:
    report = asdict(made)
    wanted = report.pop("wanted")
    return {
        "works": made.works,
        **report,
        "film": wanted["film"]["name"],
        "views": wanted["views"],
        "altitude_m": wanted["altitude_m"],
        "aperture_mm": made.wanted.aperture_mm,
    }


def _as_text(made: Design, instead: Design | None) -> str:
    wanted = made.wanted
    rows, columns = made.view_shape
    lines = [
        f"law {made.law}: {wanted.views} × {wanted.views} views of {columns} × {rows} px from {wanted.altitude_m:g} m",
        (
            f"mask       {made.mask.frequency_per_mm:.3f} periods/mm, p = {made.mask.p}, {made.mask.pattern}; "
            f"{made.film_period_px:.2f} px a period on film {wanted.film.name}"
        ),
        f"distance   {made.mask_distance_mm:.3f} mm before the sensor",
        f"aperture   {wanted.aperture_mm:.2f} mm (f/{wanted.f_number:g}), {made.baseline_mm:.2f} mm from view to view",
        f"a view     ±{made.bandwidth_per_mm:.2f} cycles/mm, {made.ground_sample_m * 100:.1f} cm of ground per pixel",
        f"spectrum   {100 * made.spectrum_used:.{0 if made.spectrum_used >= 0.01 else 2}f} % used",
        (
            f"depth      ±{made.depth_sigma_m:.2g} m at {wanted.altitude_m:g} m, "
            f"shifts known to {wanted.shift_sigma_px:g} px per view"
        ),
        *(f"{'ok  ' if c.met else 'FAIL'}       {c.sentence}" for c in made.conditions),
    ]
    lines.append(f"film       {', '.join(made.films) or 'none of Table 2'} can print it")
    lines += [f"warning    {warning}" for warning in made.warnings]
    if made.problem:
        lines.append(made.problem)
        lines.append(_instead(instead))
    elif made.depth_sigma_m > wanted.altitude_m / 2:
        lines.append(
            "this depth error is too large to measure depth: fly lower, or use a longer lens with a wider aperture"
        )
    return "\n".join(lines)


def _instead(made: Design | None) -> str:
    if made is None:
        return "nothing can be built here with any stop of this lens or fewer views"
    (rows, columns), n, stop = made.view_shape, made.wanted.views, made.wanted.f_number
    return (
        f"buildable: {n} × {n} views of {columns} × {rows} px at f/{stop:g}, a mask of "
        f"{made.mask.frequency_per_mm:.3g} periods/mm {made.mask_distance_mm:.3g} mm before the sensor, depth "
        f"±{made.depth_sigma_m:.2g} m at {made.wanted.altitude_m:g} m (--views {n} --f-number {stop:g})"
    )
