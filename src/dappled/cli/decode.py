"""`dappled decode`: decode frames to light fields."""

from __future__ import annotations

import argparse
import json
from pathlib import Path
from typing import Any

from dappled.cli import decode_arguments
from dappled.cli.arguments import add_overwrite
from dappled.cli.each_frame import each_frame
from dappled.drivers.raw.darkroom import Darkroom, DecodeResult
from dappled.errors import DappledError
from dappled.findings import FRAME, told
from dappled.products.exports import light_files
from dappled.shown import printable


def configure(parser: argparse.ArgumentParser) -> None:
    parser.epilog = (
        "examples:\n  dappled decode frame.dng --mask reference-5x5 --calibration c.toml -o frame.zarr\n"
        "  dappled decode FLIGHT -o decoded/    (by the flight's own mask, camera and calibration)\n"
        "  dappled decode *.png --mask lenslet --white white.png -o decoded/"
    )
    decode_arguments.add_frames(parser, "+")
    decode_arguments.add_recipe(parser, mask_needed=False, mask_otherwise="that of the flight that the frames are of")
    parser.add_argument("-o", "--output", type=Path, required=True, metavar="OUT",
                        help="light field (.zarr, .npz, .h5); with several frames a folder")  # fmt: skip
    parser.add_argument("--colour", action="store_true", help="views in red, green and blue (default: grey)")
    parser.add_argument("--taper", type=float, default=0.0, metavar="SHARE",
                        help="share of each band with a soft edge, 0 to 1: less ringing, less detail")  # fmt: skip
    parser.add_argument("--anyway", action="store_true",
                        help="write the light field although carriers that must be visible are not, and exit with 0\n"
                        "although what was written is in doubt (otherwise 1)")  # fmt: skip
    add_overwrite(parser)
    parser.add_argument("--json", action="store_true", help="print one JSON object per frame")


def run(arguments: argparse.Namespace) -> int:
    darkroom = Darkroom(decode_arguments.recorded(arguments.frames, decode_arguments.recipe(arguments)))
    darkroom.check()
    arguments.frames = decode_arguments.frames(arguments.frames)
    single = len(arguments.frames) == 1 and arguments.output.suffix
    if not single:
        decode_arguments.refuse_same_names(arguments.frames, arguments.output, ".zarr")
        arguments.output.mkdir(parents=True, exist_ok=True)

    def decoded(frame: Path) -> bool:
        target = arguments.output if single else arguments.output / f"{frame.stem}.zarr"
        made = darkroom.decode(frame, focal_length_mm=arguments.focal_length, f_number=arguments.f_number)
        if not arguments.anyway:
            _refuse_contradicted(frame, made)
        light_files.save(target, made.light_field, overwrite=arguments.overwrite)
        print(json.dumps(_facts(target, made)) if arguments.json else printable(f"{target}: {summary(made)}"))
        return bool(made.doubts)

    return each_frame(
        "decode", arguments.frames, arguments, decoded, into_folder=not single, failure="could not be decoded"
    )


def _refuse_contradicted(frame: Path, made: DecodeResult) -> None:
    """Carriers that must be visible and are not: slices cut at the prediction would hold nothing."""
    if made.contradiction:
        raise DappledError(f"{frame}: {told(made.contradiction, FRAME)}; --anyway decodes it at the prediction")


def _facts(target: Path, made: DecodeResult) -> dict[str, Any]:
    """What the line of a frame says, for a program."""
    field = made.light_field
    return {
        "file": str(target),
        "slices": list(field.slices.shape),
        "views": list(field.views.shape[:2]),
        "carriers_found": made.carriers_found if made.observable else None,
        "carriers_predicted": made.carriers_predicted,
        "carriers_from": made.report.carriers_from,
        "law": field.attributes["law"],
        "views_model": field.attributes.get("views_model"),
        "views_reason": field.attributes.get("views_reason") or None,
        "doubts": field.attributes["doubts"],
        "contradiction": None if made.contradiction is None else made.contradiction.to_json(),
    }


def summary(made: DecodeResult) -> str:
    """Slices, views, and where both came from."""
    field = made.light_field
    rows, columns = field.views.shape[:2]
    views = f"{rows} × {columns} views" if rows else "no views (they need a calibration, or visible carriers)"
    size = " × ".join(str(n) for n in field.slices.shape)
    found = f"{made.carriers_found} of {made.carriers_predicted} carriers seen"
    whole = f"slices {size}, {views}; {found}, {made.report.carriers_from}"
    whose = "calibration's" if made.report.carriers_from == "calibrated" else "law's"
    if made.contradiction:
        whole += f": {told(made.contradiction, FRAME)}; cut at the {whose} prediction"
    elif made.unsettled:
        whole += f": {told(made.unsettled, FRAME)}"
    elif not made.observable:
        whole += f", not observable at this aperture: no carriers in this frame, cut at the {whose} prediction"
    elif made.carriers_found == 0:
        whole += (
            f": no carriers in this frame, cut at the {whose} prediction; unless it was taken near the mask's ideal "
            "aperture, mask, camera or focal length are not the right ones"
        )
    if made.search is not None and made.search.found is not None:
        whole += f", by the law {field.attributes['law']} ({made.search.sentence})"
    if words := decode_arguments.views_words(field):
        whole += f"; {words}"
    if others := [one for one in made.doubts if one not in (made.contradiction, made.unsettled)]:
        whole += f"; in doubt: {'; '.join(told(one, FRAME) for one in others)}"
    return whole
