"""`dappled export`: write light fields in the formats that other tools read."""

from __future__ import annotations

import argparse
import json
import sys
from pathlib import Path

from dappled.cli import decode_arguments
from dappled.cli.arguments import add_overwrite, refuse_existing
from dappled.errors import DappledError
from dappled.products.exports import exports, light_files
from dappled.products.opened import OpenedLightField

KINDS = {
    "hci": "HCI benchmark folder: one PNG per view, parameters.cfg; with --depth also disp_estimate.pfm",
    "eslf": "ESLF: one 16-bit PNG with a lenslet for each pixel of a view; the lenslet's size is in a .txt beside it",
    "mat": "MATLAB v5 in LFToolbox's layout: LF [t, s, v, u, c]",
    "quilt": "quilt PNG for light-field displays; its name gives columns, rows and aspect",
    "h5": "HDF5: the whole light field", "npz": "NumPy: the whole light field", "zarr": "Zarr: the whole light field",
    "rerun": "Rerun recording (.rrd): views, picture, depth",
}  # fmt: skip


REPLACED = ("h5", "npz", "zarr", "rerun")


def configure(parser: argparse.ArgumentParser) -> None:
    lines = "\n".join(f"  {name:6} {what}" for name, what in KINDS.items())
    parser.epilog = f"formats:\n{lines}\n\nexample: dappled export frame.zarr --as hci -o hci/frame"
    decode_arguments.add_field(parser)
    parser.add_argument("--as", dest="kind", choices=tuple(KINDS), required=True, help="the format")
    parser.add_argument("--depth", action="store_true", help="hci, rerun: add a depth map (method combined)")
    parser.add_argument("--lenslet", type=int, default=0, metavar="PX",
                        help=f"eslf: side of a lenslet (LFToolbox: {exports.ESLF_LENSLET_PX})")  # fmt: skip
    parser.add_argument(
        "--disparity",
        type=float,
        default=0.0,
        metavar="D",
        help="quilt: the disparity that appears in the plane of the screen",
    )
    parser.add_argument("-o", "--output", type=Path, required=True, metavar="OUT", help="file or folder to write")
    add_overwrite(parser)
    parser.add_argument("--json", action="store_true", help="print JSON")


def run(arguments: argparse.Namespace) -> int:
    _make_room(arguments)
    found = decode_arguments.opened_field(arguments)
    written = write(found, arguments.kind, arguments.output, arguments)
    words = decode_arguments.views_words(found.field)
    if arguments.json:
        print(json.dumps({"file": str(written), "as": arguments.kind, "views": words or None, "doubts": found.doubts}))
    else:
        print(written)
        if words:
            print(words, file=sys.stderr)
    return 0


def _make_room(arguments: argparse.Namespace) -> None:
    """Refuse an output that exists before the work is done. Raises DappledError. A quilt's name is known only then."""
    if arguments.kind in REPLACED:
        refuse_existing(arguments, arguments.output)
    elif arguments.overwrite:
        raise DappledError(f"--overwrite goes with --as {', '.join(REPLACED)}: remove what is there yourself")
    elif arguments.kind != "quilt" and arguments.output.exists():
        raise DappledError(f"{arguments.output} exists already: move it away, or choose another name")


def write(found: OpenedLightField, kind: str, path: Path, arguments: argparse.Namespace) -> Path:
    """Write the light field; returns the path. Raises DappledError."""
    match kind:
        case "hci":
            exports.hci(path, found.field, found.depth() if arguments.depth else None)
        case "eslf":
            exports.eslf(path, found.field, arguments.lenslet)
        case "mat":
            exports.mat(path, found.field)
        case "quilt":
            return exports.quilt(path, found.field, disparity=arguments.disparity)
        case "rerun":
            depth = found.depth() if arguments.depth else None
            distances = found.distances(depth) if depth is not None and found.ranging is not None else None
            exports.rerun(path, found.field, found.refocus(), depth, distances)
        case _:
            if path.suffix != f".{kind}":
                raise DappledError(f"{path}: --as {kind} writes a .{kind} file; give it that ending")
            light_files.save(path, found.field, overwrite=arguments.overwrite)
    return path
