"""`dappled mask diffraction`: predict a laser's spots behind a printed mask, and judge the measured ones."""

from __future__ import annotations

import argparse
import json
import sys
from dataclasses import asdict
from pathlib import Path

import numpy as np
from PIL import Image

from dappled.cli.arguments import add_overwrite, refuse_existing
from dappled.cli.mask import arguments as mask_arguments
from dappled.cli.mask import make
from dappled.config import profiles
from dappled.config.profiles import MaskProfile
from dappled.decode.optics import laser_bench
from dappled.decode.optics.film import FILMS, MaskImage
from dappled.decode.optics.lenses import within
from dappled.products.exports import mask_files

HELP = "predict a laser's spots, and judge a print by the measured ones"
EXAMPLE = "dappled mask diffraction --mask mask-1 --measured bench.csv"


def configure(parser: argparse.ArgumentParser) -> None:
    mask_arguments.add_mask(parser)
    parser.add_argument("--wavelength", type=float, default=laser_bench.THESIS_WAVELENGTH_NM, metavar="NM",
                        help="wavelength of the laser (default: %(default)g)")  # fmt: skip
    parser.add_argument(
        "--distance",
        type=float,
        default=laser_bench.THESIS_DISTANCE_M,
        metavar="M",
        help="distance from mask to wall (default: %(default)g)",
    )
    parser.add_argument("--measured", type=Path, metavar="CSV", help="x_mm,y_mm of the measured spots")
    parser.add_argument(
        "--tolerance", type=float, default=0.5, metavar="MM", help="tolerance of the measurement (default: %(default)g)"
    )
    parser.add_argument("--picture", type=Path, metavar="FILE.png", help="draw what the wall should show")
    add_overwrite(parser)
    parser.add_argument(
        "--image", type=Path, metavar="FILE", help="draw it for this mask image (a positive) instead of the design"
    )
    parser.add_argument(
        "--beam", type=float, default=2.0, metavar="MM", help="diameter of the laser's beam (default: %(default)g)"
    )
    parser.add_argument("--json", action="store_true", help="print JSON")


def run(arguments: argparse.Namespace) -> int:
    if arguments.picture:
        refuse_existing(arguments, arguments.picture)
    known = profiles.mask(arguments.mask)
    wavelength, distance = arguments.wavelength, arguments.distance
    found = [(i, i.landing_mm(wavelength, distance)) for i in laser_bench.impulses(known.mask)]
    verdict, others = None, list[str]()
    if arguments.measured:
        seen = mask_files.read_spots(arguments.measured)
        verdict = laser_bench.judge(known.mask, seen, wavelength, distance, tolerance_mm=arguments.tolerance)
        if verdict.kind != "as designed":
            others = _others(seen, arguments)
    if arguments.picture:
        screen = _screen(arguments, known)
        bright = np.sqrt(screen.intensity / screen.intensity.max())
        Image.fromarray(np.rint(255 * np.clip(4 * bright, 0, 1)).astype(np.uint8)).save(arguments.picture)
        half = screen.intensity.shape[1] / 2 * screen.pitch_mm[1]
        print(f"{arguments.picture}: the wall from {-half:.1f} to {half:.1f} mm", file=sys.stderr)
    if arguments.json:
        report = {
            "wavelength_nm": wavelength,
            "distance_m": distance,
            "impulses": [{**asdict(i), "x_mm": x, "y_mm": y} for i, (x, y) in found],
            "verdict": asdict(verdict) if verdict else None,
            "spots_of": others,
        }
        print(json.dumps(report, indent=2))
    elif verdict:
        print(verdict.text)
        if others:
            print(f"these are the spots of {', '.join(others)}: make sure that you hold the right mask")
    else:
        print(f"{'ky':>4} {'kx':>4} {'p/m':>9} {'q/m':>9} {'x/mm':>8} {'y/mm':>8}")
        for i, (x, y) in found:
            print(f"{i.ky:4d} {i.kx:4d} {i.p_per_m:9.0f} {i.q_per_m:9.0f} {x:8.2f} {y:8.2f}")
    return 0 if verdict is None or verdict.kind == "as designed" else 1


def _others(seen: list[tuple[float, float]], arguments: argparse.Namespace) -> list[str]:
    """The shipped masks whose own spots these are. Mask 1's measured spots in Table 5 are Mask 2's in Table 7."""
    found = []
    for name in profiles.shipped("masks"):
        verdict = laser_bench.judge(
            profiles.mask(name).mask, seen, arguments.wavelength, arguments.distance, tolerance_mm=arguments.tolerance
        )
        if verdict.kind == "as designed":
            found.append(name)
    return found


def _screen(arguments: argparse.Namespace, known: MaskProfile) -> laser_bench.Screen:
    """The wall behind the middle of the mask: of an image file, or of the design drawn on 4k film."""
    within("beam diameter", arguments.beam, "mm", 1e-2, 20)
    if arguments.image:
        read, density = mask_files.read(arguments.image)
        values = read.astype(np.float64)
    else:
        chosen = FILMS["4k"]
        image = MaskImage(known.mask, chosen, make.periods_on(known, chosen))
        values = image.transmittance(slice(None), slice(None))
        density = chosen.px_per_mm
    pitch = 1 / density[0], 1 / density[1]
    reach = [min(n, round(3 * arguments.beam / d)) for n, d in zip(values.shape, pitch, strict=True)]
    top, left = ((n - r) // 2 for n, r in zip(values.shape, reach, strict=True))
    middle = values[top : top + reach[0], left : left + reach[1]]
    lit = middle * laser_bench.beam(middle.shape, pitch, arguments.beam)
    return laser_bench.far_screen(lit, pitch, arguments.wavelength, arguments.distance, samples=2048)
