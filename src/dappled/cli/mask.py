"""`dappled mask make|table|diffraction|design|plan`: the printed mask, from altitude to film and back to the bench."""

from __future__ import annotations

import argparse
import json
import math
import re
import sys
from dataclasses import asdict
from pathlib import Path
from typing import Any

import numpy as np
from PIL import Image
from tqdm import tqdm

from dappled.cli import mask_design
from dappled.config import profiles
from dappled.config.profiles import MaskProfile
from dappled.config.schema import ConfigError
from dappled.decode import diffraction, film, prediction
from dappled.decode.carriers import LAWS, Sensor
from dappled.decode.film import FILMS, Film
from dappled.decode.maskimage import MaskImage, period_on
from dappled.decode.masks import Mask
from dappled.decode.optics import within
from dappled.products import maskfiles

THESIS_FOCAL_LENGTHS_MM = (6, 8, 10, 11, 12, 13, 15, 19, 25, 29, 33, 39, 52)  # Table 11


def configure(parser: argparse.ArgumentParser) -> None:
    parser.epilog = (
        "examples:\n"
        "  dappled mask make mask-2 --negative -o mask-2.png\n"
        "  dappled mask table --mask mask-2 --camera fujifilm-s5200\n"
        "  dappled mask diffraction --mask mask-1 --measured bench.csv\n"
        "  dappled mask design --altitude 40 --camera fujifilm-s5200 --focal-length 13 --f-number 3.5 --film 16k\n"
        "  dappled mask plan --altitude 40 --speed 8 --camera fujifilm-s5200 --focal-length 13"
    )
    actions = parser.add_subparsers(dest="action", required=True, metavar="ACTION")
    _configure_make(actions.add_parser("make", help="write the picture that goes on film, or a step wedge"))
    _configure_table(actions.add_parser("table", help="where the carriers land over focal lengths (Tables 11 and 14)"))
    _configure_diffraction(actions.add_parser("diffraction", help="where a laser's spots land, and what they say"))
    mask_design.configure(actions.add_parser("design", help="mask, distance and film for an altitude"))
    mask_design.configure_plan(actions.add_parser("plan", help="interval, blur, body and disk of a flight"))


def run(arguments: argparse.Namespace) -> int:
    actions = {
        "make": _make,
        "table": _table,
        "diffraction": _diffraction,
        "design": mask_design.run,
        "plan": mask_design.run_plan,
    }
    return actions[arguments.action](arguments)


# --- make ---------------------------------------------------------------------------------------------------------


def _configure_make(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("mask", nargs="?", metavar="P", help="mask profile or TOML file (or --period/--frequency)")
    parser.add_argument("-o", "--output", type=Path, required=True, metavar="FILE", help=".png or .tif")
    parser.add_argument("--film", default="4k", metavar="F", help="4k, 8k, 16k, or WIDTHxHEIGHT in pixels")
    parser.add_argument("--density", type=float, metavar="PX/MM", help="of a film given as WIDTHxHEIGHT")
    parser.add_argument("--size-mm", type=float, nargs=2, metavar=("H", "W"), help="only the middle of the film")
    parser.add_argument("--period", type=float, metavar="PX", help="longest period in the film's pixels")
    parser.add_argument("--frequency", type=float, metavar="1/MM", help="fundamental, instead of --period")
    parser.add_argument("--p", type=int, metavar="N", help="number of harmonics")
    parser.add_argument("--pattern", choices=("full", "diagonal"), help="Eq 11's product, or Fig 14's diagonals")
    parser.add_argument("--harmonics", choices=("linear", "octave"), help="1, 2, 3 … or 1, 2, 4 …")
    parser.add_argument(
        "--negative", action="store_true", help="the negative (Eq 13), for black-and-white negative film"
    )
    parser.add_argument("--bits", type=int, default=8, choices=(8, 16))
    parser.add_argument(
        "--curve", type=Path, metavar="CSV", help="level,density of this film's wedge: compensate for it"
    )
    parser.add_argument("--drawable-only", action="store_true", help="leave out harmonics finer than two pixels")
    parser.add_argument("--wedge", type=int, nargs="?", const=21, metavar="STEPS", help="write a step wedge instead")
    parser.add_argument("--json", action="store_true", help="what was written, as JSON")


def _film(arguments: argparse.Namespace) -> Film:
    if arguments.film in FILMS:
        if arguments.density is not None:
            raise ConfigError(f"film {arguments.film} has its own density; --density is for --film WIDTHxHEIGHT")
        chosen = FILMS[arguments.film]
    elif size := re.fullmatch(r"(\d+)x(\d+)", arguments.film):
        if arguments.density is None:
            raise ConfigError(f"--film {arguments.film} needs --density in px/mm")
        chosen = film.film_of(int(size[1]), int(size[2]), arguments.density)
    else:
        raise ConfigError(f"no film {arguments.film!r}; known are {', '.join(FILMS)}, or WIDTHxHEIGHT with --density")
    return chosen


def _make(arguments: argparse.Namespace) -> int:
    chosen = _film(arguments)
    if arguments.size_mm:
        chosen = chosen.cut_to(*arguments.size_mm)
    bits = arguments.bits
    if arguments.wedge is not None:
        levels = np.rint(film.wedge((1, chosen.shape[1]), arguments.wedge) * (2**bits - 1))
        levels = levels.astype(np.uint8 if bits == 8 else np.uint16)

        def tile(rows: slice, columns: slice) -> maskfiles.Levels:
            return np.repeat(levels[:, columns], rows.stop - rows.start, axis=0)

        told: dict[str, Any] = {"wedge_steps": arguments.wedge, "warnings": []}
    else:
        image = _image(arguments, chosen)
        tile = image.levels
        told = {
            "carriers": len(image.orders_drawn()),
            "period_px": list(image.period_px),
            "harmonics": [{**asdict(h), "drawable": h.drawable} for h in image.harmonics()],
            "warnings": image.warnings(),
        }
    for text in told["warnings"]:
        print(f"dappled mask: warning: {text}", file=sys.stderr)
    with tqdm(total=chosen.shape[0], unit="row", disable=not sys.stderr.isatty(), delay=1) as bar:
        maskfiles.write(arguments.output, chosen.shape, bits, chosen.px_per_mm, tile, progress=bar.update)
    told = {"file": str(arguments.output), "shape": list(chosen.shape), "px_per_mm": list(chosen.px_per_mm), **told}
    if arguments.json:
        print(json.dumps(told, indent=2))
    else:
        high, wide = chosen.vertical.length_mm, chosen.horizontal.length_mm
        print(f"{arguments.output}: {chosen.shape[1]} × {chosen.shape[0]} px, {bits} bits, {wide:.4g} × {high:.4g} mm")
    return 0


def _image(arguments: argparse.Namespace, chosen: Film) -> MaskImage:
    known = profiles.mask(arguments.mask) if arguments.mask else None
    if known is None and arguments.period is None and arguments.frequency is None:
        raise ConfigError("name a mask profile, or give --period in px or --frequency in 1/mm")
    if arguments.period is not None and arguments.frequency is not None:
        raise ConfigError("--period and --frequency say the same: give one of them")
    if arguments.period is not None:
        period = within("period", arguments.period, "px", 1e-2, 1e6)
        mask = Mask(chosen.px_per_mm[1] / period, 2)
        periods = (period, period * chosen.px_per_mm[0] / chosen.px_per_mm[1])
        if math.isclose(*chosen.px_per_mm, rel_tol=1e-3):
            periods = (period, period)
    elif arguments.frequency is not None:
        mask = Mask(within("frequency", arguments.frequency, "1/mm", 1e-3, 1e5), 2)
        periods = period_on(chosen, mask)
    else:
        assert known is not None
        mask, periods = known.mask, _periods(known, chosen)
    base = known.mask if known else mask
    mask = Mask(
        mask.frequency_per_mm,
        base.p if arguments.p is None else int(within("p", arguments.p, "", 1, 20)),
        arguments.pattern or base.pattern,
        arguments.harmonics or base.harmonics,
    )
    curve = maskfiles.read_density_curve(arguments.curve) if arguments.curve else None
    return MaskImage(mask, chosen, periods, arguments.negative, arguments.bits, curve, arguments.drawable_only)


def _periods(known: MaskProfile, chosen: Film) -> tuple[float, float]:
    """Whole pixels where the mask was designed in pixels of this very film, else by its frequency."""
    own = known.film_px_per_mm
    if own is not None and known.period_px is not None and np.allclose(chosen.px_per_mm, own, rtol=1e-3):
        return known.period_px, known.period_px
    return period_on(chosen, known.mask)


# --- table --------------------------------------------------------------------------------------------------------


def _configure_table(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("--mask", required=True, metavar="P", help="mask profile or TOML file")
    parser.add_argument("--camera", required=True, metavar="P", help="camera profile or TOML file")
    parser.add_argument("--law", default="", choices=("", *LAWS), help="carrier law (default: the camera's)")
    parser.add_argument("--focal-length", type=float, nargs="+", metavar="MM", help="default: those of Table 11")
    parser.add_argument(
        "--shape", type=int, nargs=2, metavar=("H", "W"), help="raw shape (default: the camera's first)"
    )
    parser.add_argument("--mask-distance", type=float, metavar="MM", help="default: the camera's")
    parser.add_argument("--rotation", type=float, default=0.0, metavar="DEGREES", help="of the installed mask")
    parser.add_argument("--carriers", action="store_true", help="every carrier with row and column, crossed ones too")
    parser.add_argument("--json", action="store_true", help="as JSON")


def sensor_of(arguments: argparse.Namespace, camera: profiles.CameraProfile) -> Sensor:
    """The camera's sensor for --shape, or its first raw shape."""
    shape = getattr(arguments, "shape", None)
    return camera.sensor((shape[0], shape[1])) if shape else camera.raw[0].sensor


def _table(arguments: argparse.Namespace) -> int:
    camera, mask = profiles.camera(arguments.camera), profiles.mask(arguments.mask).mask
    sensor, law = sensor_of(arguments, camera), arguments.law or camera.law
    distance = camera.mask_distance_mm if arguments.mask_distance is None else arguments.mask_distance
    lengths = arguments.focal_length or THESIS_FOCAL_LENGTHS_MM
    if not arguments.focal_length and camera.focal_length_mm and camera.focal_length_mm[0] == camera.focal_length_mm[1]:
        lengths = camera.focal_length_mm[:1]
    rows = prediction.table(mask, sensor, distance, lengths, law=law)
    if arguments.carriers or arguments.rotation:
        return _carriers(arguments, mask, sensor, lengths)
    if arguments.json:
        told = {
            "shape": list(sensor.shape),
            "law": law,
            "mask_distance_mm": distance,
            "rows": [asdict(r) for r in rows],
        }
        print(json.dumps(told, indent=2))
        return 0
    names = "".join(f"  {'×' + str(m):>10} H {'V':>7}" for m in mask.multiples)
    print(f"law {law}, mask {distance:g} mm from {sensor.shape[1]} × {sensor.shape[0]} px; bins from the centre, * off")
    print(f"{'f/mm':>6}{names}   slice")
    for row in rows:
        cells = "".join(
            f"  {h.horizontal_px:11.0f}{' ' if h.horizontal_on_sensor else '*'}"
            f"{h.vertical_px:7.0f}{' ' if h.vertical_on_sensor else '*'}"
            for h in row.harmonics
        )
        size = "none" if row.slice_px is None else f"{row.slice_px[1]} × {row.slice_px[0]}"
        print(f"{row.focal_length_mm:6g}{cells}  {size}")
    contrasts = ", ".join(f"×{h.multiple} {h.contrast:.2f}" for h in rows[0].harmonics)
    print(f"contrast left by diffraction at 550 nm: {contrasts}")
    return 0


def _carriers(arguments: argparse.Namespace, mask: Mask, sensor: Sensor, lengths: Any) -> int:
    camera = profiles.camera(arguments.camera)
    law = arguments.law or camera.law
    distance = camera.mask_distance_mm if arguments.mask_distance is None else arguments.mask_distance
    turn = math.radians(arguments.rotation)
    told = []
    for length in lengths:
        lattice = prediction.lattice_of(law, mask, sensor, distance, length, rotation_rad=turn)
        for main, orders in ((True, mask.orders()), (False, prediction.crossed_orders(mask))):
            for carrier in lattice.carriers(orders):
                row, column = carrier.index(sensor.shape)
                place = {"row": row, "col": column, "main": main, "on_sensor": carrier.on_sensor}
                told.append({"focal_length_mm": length, "ky": carrier.ky, "kx": carrier.kx, **place})
    if arguments.json:
        print(json.dumps({"shape": list(sensor.shape), "law": law, "carriers": told}, indent=2))
        return 0
    print(f"{'f/mm':>6} {'ky':>4} {'kx':>4} {'row':>9} {'col':>9}")
    for c in told:
        words = f"{'' if c['main'] else '  crossed'}{'' if c['on_sensor'] else '  off the sensor'}"
        print(f"{c['focal_length_mm']:6g} {c['ky']:4d} {c['kx']:4d} {c['row']:9.1f} {c['col']:9.1f}{words}")
    return 0


# --- diffraction --------------------------------------------------------------------------------------------------


def _configure_diffraction(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("--mask", required=True, metavar="P", help="mask profile or TOML file")
    parser.add_argument("--wavelength", type=float, default=diffraction.THESIS_WAVELENGTH_NM, metavar="NM")
    parser.add_argument(
        "--distance", type=float, default=diffraction.THESIS_DISTANCE_M, metavar="M", help="to the wall"
    )
    parser.add_argument("--measured", type=Path, metavar="CSV", help="x_mm,y_mm of the spots that were seen")
    parser.add_argument("--tolerance", type=float, default=0.5, metavar="MM", help="of the measurement")
    parser.add_argument("--picture", type=Path, metavar="FILE.png", help="draw what the wall should show")
    parser.add_argument("--image", type=Path, metavar="FILE", help="of this mask image, positive, not of the design")
    parser.add_argument("--beam", type=float, default=2.0, metavar="MM", help="diameter of the laser's beam")
    parser.add_argument("--json", action="store_true", help="as JSON")


def _diffraction(arguments: argparse.Namespace) -> int:
    known = profiles.mask(arguments.mask)
    wavelength, distance = arguments.wavelength, arguments.distance
    found = [(i, i.landing_mm(wavelength, distance)) for i in diffraction.impulses(known.mask)]
    verdict = None
    if arguments.measured:
        seen = maskfiles.read_spots(arguments.measured)
        verdict = diffraction.judge(known.mask, seen, wavelength, distance, tolerance_mm=arguments.tolerance)
    if arguments.picture:
        screen = _screen(arguments, known)
        bright = np.sqrt(screen.intensity / screen.intensity.max())
        Image.fromarray(np.rint(255 * np.clip(4 * bright, 0, 1)).astype(np.uint8)).save(arguments.picture)
        half = screen.intensity.shape[1] / 2 * screen.pitch_mm[1]
        print(f"{arguments.picture}: the wall from {-half:.1f} to {half:.1f} mm", file=sys.stderr)
    if arguments.json:
        told = {
            "wavelength_nm": wavelength,
            "distance_m": distance,
            "impulses": [{**asdict(i), "x_mm": x, "y_mm": y} for i, (x, y) in found],
            "verdict": asdict(verdict) if verdict else None,
        }
        print(json.dumps(told, indent=2))
    elif verdict:
        print(verdict.text)
    else:
        print(f"{'ky':>4} {'kx':>4} {'p/m':>9} {'q/m':>9} {'x/mm':>8} {'y/mm':>8}")
        for i, (x, y) in found:
            print(f"{i.ky:4d} {i.kx:4d} {i.p_per_m:9.0f} {i.q_per_m:9.0f} {x:8.2f} {y:8.2f}")
    return 0 if verdict is None or verdict.kind == "as designed" else 1


def _screen(arguments: argparse.Namespace, known: MaskProfile) -> diffraction.Screen:
    """The wall behind the middle of the mask: of an image file, or of the design drawn on 4k film."""
    within("beam diameter", arguments.beam, "mm", 1e-2, 20)
    if arguments.image:
        read, density = maskfiles.read(arguments.image)
        values = read.astype(np.float64)
    else:
        chosen = FILMS["4k"]
        values = MaskImage(known.mask, chosen, _periods(known, chosen)).transmittance(slice(None), slice(None))
        density = chosen.px_per_mm
    pitch = 1 / density[0], 1 / density[1]
    reach = [min(n, round(3 * arguments.beam / d)) for n, d in zip(values.shape, pitch, strict=True)]
    top, left = ((n - r) // 2 for n, r in zip(values.shape, reach, strict=True))
    middle = values[top : top + reach[0], left : left + reach[1]]
    lit = middle * diffraction.beam(middle.shape, pitch, arguments.beam)
    return diffraction.far_screen(lit, pitch, arguments.wavelength, arguments.distance, samples=2048)
