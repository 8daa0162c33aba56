"""Arguments that verbs on light fields share: which one, where its lens was focused, which disparities."""

from __future__ import annotations

import argparse
import math
from pathlib import Path

from dappled.decode.depth.ranging import RANGING, Ranging
from dappled.drivers.raw import calibration_files
from dappled.products import opened
from dappled.products.opened import OpenedLightField


def add_field(parser: argparse.ArgumentParser, *, ranged: bool = True) -> None:
    """The light field, and what leads to metres."""
    parser.add_argument("field", type=Path, metavar="LIGHTFIELD",
                        help="decoded light field (.zarr, .npz, .h5), or a folder of n × n pictures")  # fmt: skip
    if ranged:
        parser.add_argument("--focus", type=metres, metavar="M", help="where the lens was focused, in metres, or inf")
        parser.add_argument("--calibration", type=Path, metavar="FILE",
                            help="calibration with targets, as dappled calibrate --target writes it")  # fmt: skip


def metres(text: str) -> float:
    """An argument that is a distance above 0 m; inf too."""
    number = float(text)
    if not number > 0 or math.isnan(number):
        raise argparse.ArgumentTypeError(f"{text} is not a distance above 0 m")
    return number


def opened_field(arguments: argparse.Namespace) -> OpenedLightField:
    """The light field that the arguments name. Raises DappledError."""
    found = opened.light_field(arguments.field, focus_m=getattr(arguments, "focus", None))
    calibration = getattr(arguments, "calibration", None)
    if calibration is not None:
        tables = calibration_files.tables(calibration)
        if RANGING not in tables:
            raise opened.OpenError(f"{calibration} knows no distances: make it anew with dappled calibrate --target")
        found = OpenedLightField(opened.with_ranging(found.field, Ranging.from_dict(tables[RANGING])), found.path)
        found.metres()  # asked for by name: refused where it is for another focal length
    return found


def add_between(parser: argparse.ArgumentParser) -> None:
    """--between."""
    parser.add_argument("--between", nargs=2, type=float, metavar=("LOW", "HIGH"),
                        help="disparities to look at, px/view (default: where the scene lies)")  # fmt: skip
