"""`dappled calibrate`: fit lattice, mask distance and phases to stopped-down frames; see `lens` and `target` too."""

from __future__ import annotations

import argparse
import json
import sys
from dataclasses import dataclass
from pathlib import Path

from tqdm import tqdm

from dappled.cli import decode_arguments
from dappled.cli.arguments import add_overwrite, refuse_existing
from dappled.cli.calibrate import lens, target
from dappled.config import profiles
from dappled.config.schema import ConfigError
from dappled.decode.calibration import Calibration, report
from dappled.decode.calibration.fit import CalibrationFrame, from_lattices, lattice_of
from dappled.decode.calibration.lattice_fit import FrameLattice
from dappled.drivers.raw import calibration_files
from dappled.drivers.raw.darkroom import Darkroom, DarkroomError
from dappled.drivers.raw.raw_file import not_linear
from dappled.errors import DappledError, counted


def configure(parser: argparse.ArgumentParser) -> None:
    parser.epilog = (
        "examples:\n  dappled calibrate white-f22.dng --camera canon-eos-450d --mask mask-2 -o calibration.toml\n"
        "  dappled calibrate zoom/*.RAF --mask mask-2 --dark dark.RAF -o calibration.toml"
    )
    decode_arguments.add_frames(parser, "+")
    decode_arguments.add_recipe(parser, mask_needed=False)
    lens.add(parser)
    target.add(parser)
    parser.add_argument(
        "-o", "--output", type=Path, required=True, metavar="FILE", help="calibration to write: FILE.toml and FILE.npz"
    )
    add_overwrite(parser)
    parser.add_argument(
        "--anyway",
        action="store_true",
        help="write a calibration that no law explains, or of frames that are not linear, too",
    )
    parser.add_argument("--json", action="store_true", help="print the report as JSON")


def run(arguments: argparse.Namespace) -> int:
    refuse_existing(arguments, *([arguments.output] if arguments.lens else calibration_files.pair(arguments.output)))
    arguments.frames = decode_arguments.frames(arguments.frames)
    if arguments.lens:
        arguments.mask = arguments.mask or ""
        return lens.run(
            decode_arguments.recipe(arguments),
            arguments.frames,
            arguments.board,
            arguments.output,
            arguments.focal_length,
        )
    if arguments.target and arguments.mask:
        return target.run(
            decode_arguments.recipe(arguments),
            arguments.frames,
            arguments.target,
            arguments.output,
            arguments.focal_length,
        )
    if not arguments.mask:
        raise ConfigError("name the mask to calibrate with --mask: a profile or TOML file")
    if arguments.mask == profiles.LENSLET:
        raise ConfigError("a lenslet array needs no calibration: give its white frame with --white when decoding")
    darkroom = Darkroom(decode_arguments.recipe(arguments))
    darkroom.check()
    seen, bad = _views(darkroom, arguments)
    if not seen:
        raise DarkroomError("no frame is left to calibrate with: each was refused, for the reason above")
    camera = darkroom.camera(seen[0].model)
    found = fit_views(darkroom, seen, choose_law=not arguments.law)
    if not arguments.anyway and not any(law.explains for law in report.law_fits(found, camera.mask_distance_mm)):
        raise DarkroomError(
            f"{found.verdict}: check that mask, camera and focal length are the right ones; --anyway writes the "
            "calibration with this doubt in it"
        )
    written = calibration_files.save(arguments.output, found)
    if arguments.json:
        print(json.dumps(report.as_values(found, camera.mask_distance_mm), indent=2))
    else:
        print(report.as_text(found, camera.mask_distance_mm))
        print(f"written to {written[0]} and {written[1]}")
    if bad:
        print(f"{bad} of {counted(len(arguments.frames), 'frame')} could not be used", file=sys.stderr)
    return 1 if bad else 0


@dataclass(frozen=True, slots=True)
class CalibrationView:
    """What a calibration frame shows, with its camera and size."""

    shown: FrameLattice
    shape: tuple[int, int]
    model: str


def _views(darkroom: Darkroom, arguments: argparse.Namespace) -> tuple[list[CalibrationView], int]:
    """What the good frames show, and how many were bad; prints why each was."""
    good: list[CalibrationView] = []
    bad = 0
    paths = arguments.frames
    for path in tqdm(paths, unit="frame", disable=len(paths) < 2 or not sys.stderr.isatty()):
        try:
            one = view_of(darkroom, path, arguments.focal_length, arguments.f_number, arguments.anyway)
            if good and (one.shape, one.model) != (good[0].shape, good[0].model):
                first, this = (f"{s.model} {s.shape[0]} × {s.shape[1]}" for s in (good[0], one))
                raise DarkroomError(f"{path} is of another camera or size ({this}, the first {first})")
            good.append(one)
        except DappledError as error:
            if len(paths) == 1:
                raise
            bad += 1
            print(f"dappled calibrate: {error}", file=sys.stderr)
    return good, bad


def view_of(
    darkroom: Darkroom,
    path: Path,
    focal_length_mm: float | None = None,
    f_number: float | None = None,
    anyway: bool = False,
) -> CalibrationView:
    """What one frame shows, `anyway` also where it is not linear. Raises DappledError where it can't be used."""
    raw = darkroom.read(path)
    length, stop = focal_length_mm or raw.focal_length_mm, f_number or raw.f_number
    if length is None or stop is None:
        raise DarkroomError(f"{path} doesn't say its focal length and f-number: give --focal-length and --f-number")
    if not anyway and (bent := not_linear(raw)):
        raise DarkroomError(f"{path}: {'; '.join(bent)}; --anyway calibrates with it")
    camera = darkroom.camera(raw.camera_model or "")
    with darkroom.naming(path):
        plane = darkroom.plane(raw)
        shape = plane.shape[0], plane.shape[1]
        shown = lattice_of(
            CalibrationFrame(plane, length, stop),
            camera.sensor(shape),
            profiles.mask(darkroom.recipe.mask).mask,
            darkroom.recipe.law or camera.law,
            camera.mask_distance_mm,
            workers=2,
        )
    return CalibrationView(shown, shape, raw.camera_model or "")


def fit_views(darkroom: Darkroom, seen: list[CalibrationView], *, choose_law: bool = False) -> Calibration:
    """The calibration that these frames show together; with `choose_law` also which law explains them best."""
    camera = darkroom.camera(seen[0].model)
    return from_lattices(
        [one.shown for one in seen],
        sensor=camera.sensor(seen[0].shape),
        mask=profiles.mask(darkroom.recipe.mask).mask,
        law=darkroom.recipe.law or camera.law,
        mask_distance_mm=camera.mask_distance_mm,
        choose_law=choose_law,
    )
