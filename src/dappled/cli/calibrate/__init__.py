"""`dappled calibrate`: fit lattice, mask distance and phases to stopped-down frames; see `kit`, `lens` and `target`."""

from __future__ import annotations

import argparse
import json
import sys
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

from dappled.cli import decode_arguments
from dappled.cli.arguments import add_overwrite, refuse_existing
from dappled.cli.calibrate import kit, lens, target
from dappled.cli.calibrate.frames import CalibrationView, fit_views, views_of
from dappled.config import profiles
from dappled.config.schema import ConfigError
from dappled.decode.calibration import Calibration, report
from dappled.decode.calibration.law_choice import CALIBRATION
from dappled.drivers.raw import calibration_files
from dappled.drivers.raw.darkroom import Darkroom, DarkroomError
from dappled.errors import counted
from dappled.findings import Code, finding, told


def configure(parser: argparse.ArgumentParser) -> None:
    parser.epilog = (
        "examples:\n  dappled calibrate white-f22.dng --camera canon-eos-450d --mask mask-2 -o calibration.toml\n"
        "  dappled calibrate zoom/*.RAF --mask mask-2 --dark dark.RAF -o calibration.toml\n"
        "  dappled calibrate --kit kit -o calibration.toml"
    )
    decode_arguments.add_frames(parser, "*")
    decode_arguments.add_recipe(parser, mask_needed=False)
    lens.add(parser)
    target.add(parser)
    kit.add(parser)
    parser.add_argument(
        "-o", "--output", type=Path, metavar="FILE", help="calibration to write: FILE.toml and FILE.npz"
    )
    add_overwrite(parser)
    parser.add_argument(
        "--anyway",
        action="store_true",
        help="write a calibration that no law explains, or of frames that are not linear, with these doubts in it",
    )
    parser.add_argument("--json", action="store_true", help="print the report as JSON")


def run(arguments: argparse.Namespace) -> int:
    if arguments.kit is None and (not arguments.frames or arguments.output is None):
        raise ConfigError("name the frames, and the calibration to write with -o FILE; or the folder of a --kit")
    if arguments.output is not None:
        outputs = [arguments.output] if arguments.lens else calibration_files.pair(arguments.output)
        refuse_existing(arguments, *outputs)
    if arguments.kit is not None:
        return kit.run(arguments)
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
    return _from_frames(arguments)


def _from_frames(arguments: argparse.Namespace) -> int:
    """Calibrate with stopped-down frames, print the report, and write the files."""
    if not arguments.mask:
        raise ConfigError("name the mask to calibrate with --mask: a profile or TOML file")
    if arguments.mask == profiles.LENSLET:
        raise ConfigError("a lenslet array needs no calibration: give its white frame with --white when decoding")
    darkroom = Darkroom(decode_arguments.recipe(arguments))
    darkroom.check()
    seen, bad = views_of(darkroom, arguments.frames, arguments.focal_length, arguments.f_number, arguments.anyway)
    if len(arguments.frames) == len(bad) == 1:
        raise bad[0][1]
    for _, error in bad:
        print(f"dappled calibrate: {error}", file=sys.stderr)
    if not seen:
        raise DarkroomError("no frame is left to calibrate with: each was refused, for the reason above")
    camera = darkroom.camera(seen[0].model)
    found = fit_views(darkroom, seen, choose_law=not arguments.law)
    found = _judged(arguments, found, seen, camera.mask_distance_mm)
    for doubt in found.doubts:
        print(f"dappled calibrate: written with this doubt in it: {told(doubt)}", file=sys.stderr)
    written = calibration_files.save(arguments.output, found)
    if arguments.json:
        print(json.dumps(report.as_values(found, camera.mask_distance_mm), indent=2))
    else:
        print(report.as_text(found, camera.mask_distance_mm))
        print(f"written to {written[0]} and {written[1]}")
    if bad:
        print(f"{len(bad)} of {counted(len(arguments.frames), 'frame')} could not be used", file=sys.stderr)
    return 1 if bad else 0


def _judged(
    arguments: argparse.Namespace, found: Calibration, seen: Sequence[CalibrationView], stated_mm: float
) -> Calibration:
    """The calibration with what its law leaves in doubt.

    Raises DarkroomError where its own law does not, or all frames' carriers are weak, without --anyway.
    """
    weak = [one.shown.weak for one in seen if one.shown.weak is not None]
    if len(weak) == len(seen) and not arguments.anyway:
        raise DarkroomError(f"{told(weak[0], CALIBRATION)}; --anyway writes the calibration with this doubt in it")
    able = [law.law for law in report.law_fits(found, stated_mm) if law.explains]
    if found.law in able:
        return found
    asked = found.verdict
    if able:
        fits = asked.facts["fits"] if asked is not None else ""
        asked = finding(Code.LAW_ASKED, CALIBRATION, law=found.law, seen=able[0], fits=fits)
    if asked is not None and not arguments.anyway:
        raise DarkroomError(f"{told(asked, CALIBRATION)}; --anyway writes the calibration with this doubt in it")
    return replace(found, overridden=(*found.overridden, asked)) if able and asked is not None else found
