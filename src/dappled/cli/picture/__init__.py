"""`dappled picture`: the photograph without the mask's shadow, at the sensor's own resolution."""

from __future__ import annotations

import argparse
import json
import sys
from pathlib import Path
from typing import Any

from dappled import durable, findings
from dappled.cli import decode_arguments
from dappled.cli.arguments import add_overwrite
from dappled.cli.each_frame import each_frame
from dappled.cli.picture import places
from dappled.cli.verb import OutputExistsError
from dappled.drivers.raw.picture_maker import MadePicture, PictureMaker
from dappled.errors import DappledError, counted
from dappled.products.handover import picture_files
from dappled.shown import printable


def configure(parser: argparse.ArgumentParser) -> None:
    parser.epilog = (
        "examples:\n  dappled picture frame.cr2 --mask mask-2 -o frame.dng\n"
        "  dappled picture FLIGHT -o pictures/ --as jpg    (by the flight's own mask, camera and calibration)"
    )
    decode_arguments.add_frames(parser, "+")
    decode_arguments.add_recipe(parser, mask_needed=False, mask_otherwise="that of the flight that the frames are of")
    parser.add_argument("-o", "--output", type=Path, required=True, metavar="OUT",
                        help="picture (.dng, .tif, .jpg, .png); otherwise a folder")  # fmt: skip
    parser.add_argument("--as", dest="kind", choices=("dng", "tif", "jpg", "png"), default="dng",
                        help="kind of the pictures in a folder (default: dng)")  # fmt: skip
    parser.add_argument("--sigma", action="store_true",
                        help="write NAME.sigma.tif: each pixel's standard error, NaN where not trusted")  # fmt: skip
    parser.add_argument("--anyway", action="store_true",
                        help="exit with 0 although a picture is in doubt (otherwise 1)")  # fmt: skip
    add_overwrite(parser)
    parser.add_argument("--json", action="store_true", help="print one JSON object per frame")


def run(arguments: argparse.Namespace) -> int:
    maker = PictureMaker(decode_arguments.recorded(arguments.frames, decode_arguments.recipe(arguments)))
    maker.check()
    frames = decode_arguments.frames(arguments.frames)
    suffix = arguments.output.suffix.lower()
    single = len(frames) == 1 and suffix in picture_files.SUFFIXES
    if not single:
        if suffix in picture_files.SUFFIXES:
            raise DappledError(f"{counted(len(frames), 'frame')} can't all be {arguments.output}: name a folder")
        decode_arguments.refuse_same_names(frames, arguments.output, f".{arguments.kind}")
        durable.make_folder(arguments.output)

    def pictured(frame: Path) -> bool:
        target = arguments.output if single else arguments.output / f"{frame.stem}.{arguments.kind}"
        return _made(maker, frame, target, arguments)

    return each_frame("picture", frames, arguments, pictured, into_folder=not single, failure="gave no picture")


def _made(maker: PictureMaker, frame: Path, target: Path, arguments: argparse.Namespace) -> bool:
    """Make and write one picture; whether it is in doubt. Raises DappledError."""
    beside = target.with_suffix(".sigma.tif")
    for path in (target, *([beside] if arguments.sigma else [])):
        if not arguments.overwrite and (path.is_symlink() or path.exists()):
            raise OutputExistsError(f"{path} exists already: choose another name, or --overwrite replaces it")
    made = maker.picture(frame, focal_length_mm=arguments.focal_length, f_number=arguments.f_number)
    durable.write_file(target, picture_files.encoded(made, target.suffix, places.place_of(frame)))
    if arguments.sigma:
        durable.write_file(beside, picture_files.sigma_file(made))
    for one in findings.in_order(made.findings):
        print(printable(f"dappled picture: {findings.told(one)}"), file=sys.stderr)
    print(json.dumps(_facts(target, made)) if arguments.json else printable(f"{target}: {summary(made)}"))
    return made.in_doubt


def _facts(target: Path, made: MadePicture) -> dict[str, Any]:
    """What the line of a frame says, for a program."""
    shadow = made.picture.shadow
    return {
        "file": str(target),
        "shape": list(made.picture.plane.shape),
        "shadow_from": shadow.source.value,
        "shadow_depth": shadow.depth,
        "shadow_sigma": float(shadow.sigma.max()),
        "lattice": shadow.lattice.matrix().tolist(),
        "dark_share": made.picture.dark_share,
        "soft_share": made.picture.soft_share,
        "trusted_share": float(made.picture.trusted.mean()),
        "findings": [one.to_json() for one in findings.in_order(made.findings)],
    }


def summary(made: MadePicture) -> str:
    """Its size, and where its shadow is from."""
    rows, columns = made.picture.plane.shape
    shadow = made.picture.shadow
    whose = {"frame": "found in the frame", "white": "the white frame's", "calibration": "the calibration's"}
    if (told := whose.get(shadow.source.value)) is None:
        return f"{columns} × {rows} px; no shadow of the mask was seen"
    return (
        f"{columns} × {rows} px; the mask's shadow is {told}: it varies by {shadow.depth:.1%} of its mean, "
        f"known to {float(shadow.sigma.max()):.2%}"
    )
