"""Parse what verbs take that decode frames or read light fields: camera, mask, files, focus, disparities."""

from __future__ import annotations

import argparse
from collections.abc import Sequence
from pathlib import Path

from dappled.cli.arguments import metres
from dappled.decode.depth import RANGING, Ranging
from dappled.decode.optics import LAWS
from dappled.drivers.raw import calibration_files
from dappled.drivers.raw.darkroom import Recipe
from dappled.errors import DappledError
from dappled.products import opened
from dappled.products.opened import OpenedLightField

# No JPEG: beside a raw file it is the same picture again. One that is named is taken.
FRAME_SUFFIXES = (".arw", ".cr2", ".dng", ".lfp", ".lfr", ".nef", ".npy", ".png", ".raf", ".tif", ".tiff")


def add_frames(parser: argparse.ArgumentParser, count: str) -> None:
    """Add the frames, as positional arguments."""
    parser.add_argument(
        "frames",
        nargs=count,
        type=Path,
        metavar="FRAME",
        help="frame: RAF, CR2, DNG, LFP, TIFF, PNG or NPY; or a folder of frames, or a flight",
    )


def frames(given: Sequence[Path]) -> list[Path]:
    """The frames that were named, and those in the folders that were: of a flight, those in its folder of frames.

    Raises DappledError for a folder without frames.
    """
    found: list[Path] = []
    for path in given:
        if not path.is_dir():
            found.append(path)
            continue
        flight = (path / "flight.toml").is_file()
        folder = path / "frames" if flight else path
        inside = sorted(one for one in folder.iterdir() if _is_frame(one) and (not flight or one.stem.isdigit()))
        if not inside:
            kinds = ", ".join(FRAME_SUFFIXES)
            raise DappledError(f"{folder} holds no frame ({kinds}): name frames, a folder of frames, or a flight")
        found += inside
    return found


def _is_frame(path: Path) -> bool:
    """Whether a name is a frame's. Hidden ones are what other systems leave on cards, or half-written."""
    return path.suffix.lower() in FRAME_SUFFIXES and not path.name.startswith(".") and path.is_file()


def add_law(parser: argparse.ArgumentParser) -> None:
    """Add --law; empty by default."""
    parser.add_argument("--law", default="", choices=tuple(LAWS), help="carrier law (default: the camera's)")


def add_recipe(parser: argparse.ArgumentParser, *, mask_needed: bool = True) -> None:
    """Add --camera, --mask, --law, and the files and numbers that go with a frame."""
    parser.add_argument(
        "--camera",
        default="auto",
        metavar="P",
        help="camera profile or TOML file (default: the one that fits the frame)",
    )
    parser.add_argument("--mask", required=mask_needed, metavar="P", help="mask profile or TOML file, or lenslet")
    add_law(parser)
    parser.add_argument("--calibration", default="", metavar="FILE", help="file written by dappled calibrate")
    parser.add_argument("--white", default="", metavar="FILE", help="white frame")
    parser.add_argument("--dark", default="", metavar="FILE", help="dark frame")
    parser.add_argument("--cfa", default="", metavar="BGGR", help="colour pattern, row by row, if the file has none")
    parser.add_argument("--black", type=float, metavar="N", help="black level, if the file doesn't say")
    parser.add_argument("--white-level", type=float, metavar="N", help="level of a full pixel (a 12-bit PNG: 4095)")
    parser.add_argument("--focal-length", type=float, metavar="MM", help="focal length, if the file doesn't say")
    parser.add_argument("--f-number", type=float, metavar="N", help="f-number of the exposure, if the file doesn't say")


def recipe(arguments: argparse.Namespace) -> Recipe:
    """The recipe that these arguments name."""
    return Recipe(
        camera=arguments.camera,
        mask=arguments.mask,
        law=arguments.law,
        calibration=arguments.calibration,
        white=arguments.white,
        dark=arguments.dark,
        workers=2,
        cfa=arguments.cfa,
        black=arguments.black,
        white_level=arguments.white_level,
        colour=getattr(arguments, "colour", False),
        taper=getattr(arguments, "taper", 0.0),
        try_laws=not arguments.law,
    )


def add_field(parser: argparse.ArgumentParser, *, ranged: bool = True) -> None:
    """Add the light field; if `ranged`, also --focus and --calibration, which give distances in metres."""
    parser.add_argument("field", type=Path, metavar="LIGHTFIELD",
                        help="decoded light field (.zarr, .npz, .h5), or a folder of n × n pictures")  # fmt: skip
    if ranged:
        parser.add_argument(
            "--focus", type=metres, metavar="M", help="distance at which the lens was focused, in metres, or inf"
        )
        parser.add_argument("--calibration", type=Path, metavar="FILE",
                            help="calibration with targets, from dappled calibrate --target")  # fmt: skip


def opened_field(arguments: argparse.Namespace) -> OpenedLightField:
    """The light field that the arguments name. Raises DappledError."""
    found = opened.light_field(arguments.field, focus_m=getattr(arguments, "focus", None))
    calibration = getattr(arguments, "calibration", None)
    if calibration is not None:
        tables = calibration_files.tables(calibration)
        if RANGING not in tables:
            raise opened.OpenError(f"{calibration} has no distances: make it again with dappled calibrate --target")
        found = OpenedLightField(opened.with_ranging(found.field, Ranging.from_dict(tables[RANGING])), found.path)
        found.metres()  # the user named it: refuse it if it is for another focal length
    return found


def add_between(parser: argparse.ArgumentParser) -> None:
    """Add --between."""
    parser.add_argument("--between", nargs=2, type=float, metavar=("LOW", "HIGH"),
                        help="range of disparities to search, px/view (default: the scene's)")  # fmt: skip
