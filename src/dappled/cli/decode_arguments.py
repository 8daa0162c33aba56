"""Parse what verbs take that decode frames or read light fields: camera, mask, files, focus, disparities."""

from __future__ import annotations

import argparse
import math
import sys
from collections.abc import Sequence
from dataclasses import fields
from pathlib import Path
from typing import Any

from dappled import picture_order
from dappled.cli.arguments import metres, positive
from dappled.decode.depth import RANGING, Ranging
from dappled.decode.lightfield import LightField
from dappled.decode.optics import LAWS
from dappled.drivers.raw import calibration_files
from dappled.drivers.raw.darkroom import Recipe
from dappled.drivers.raw.darkroom import of_flight as recorded_recipe
from dappled.errors import DappledError
from dappled.findings import FRAME, told
from dappled.flight import layout
from dappled.products import opened
from dappled.products.opened import OpenedLightField


class FieldCallError(DappledError):
    """A call names neither a light field nor a flight, or what doesn't go with it; one sentence."""

    exit_code = 2


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
        inside = picture_order.by_name(
            (one for one in folder.iterdir() if _is_frame(one) and (not flight or one.stem.isdigit())), Path.as_posix
        )
        if not inside:
            kinds = ", ".join(FRAME_SUFFIXES)
            raise DappledError(f"{folder} holds no frame ({kinds}): name frames, a folder of frames, or a flight")
        found += inside
    return found


def recorded(given: Sequence[Path], asked: Recipe) -> Recipe:
    """The recipe by which the flight that these frames belong to was decoded, with what was asked for in its place.

    Frames belong to a flight if they, their folder or the flight itself is named. Where a mask is asked for, the recipe
    is the one that was asked for. Raises DappledError for frames of two flights, or of none, if no mask is named.
    """
    if asked.mask:
        return asked
    flights = {flight_of(path.resolve()) for path in given}
    if len(flights) > 1:
        raise DappledError("these are not the frames of one flight: give --mask, or decode each flight by itself")
    (flight,) = flights
    if flight is None:
        raise DappledError("no mask is named: give --mask P (only frames in the folder of a flight bring one along)")
    facts = layout.read_facts(layout.open_folder(flight))
    untouched = Recipe(camera="auto", mask="")
    changed = {one.name for one in fields(Recipe) if getattr(asked, one.name) != getattr(untouched, one.name)}
    made = recorded_recipe(flight, facts, {name: getattr(asked, name) for name in changed})
    if made is None:
        raise DappledError(f"{flight} was recorded without a mask: give --mask P")
    return made


def flight_of(path: Path) -> Path | None:
    """The flight that a folder is, or that a file or a folder of frames lies in."""
    return next((one for one in (path, *path.parents[:2]) if (one / "flight.toml").is_file()), None)


def refuse_same_names(frames: Sequence[Path], folder: Path, suffix: str) -> None:
    """Two frames of one name would overwrite each other's results. Raises DappledError."""
    first: dict[str, Path] = {}
    for frame in frames:
        other = first.setdefault(frame.stem, frame)
        if other is not frame:
            raise DappledError(
                f"{other} and {frame} would both be written as {folder / frame.stem}{suffix}: "
                "decode them into two folders"
            )


def _is_frame(path: Path) -> bool:
    """Whether a name is a frame's. Hidden ones are what other systems leave on cards, or half-written."""
    return path.suffix.lower() in FRAME_SUFFIXES and not path.name.startswith(".") and path.is_file()


def add_law(parser: argparse.ArgumentParser) -> None:
    """Add --law; empty by default."""
    parser.add_argument("--law", default="", choices=tuple(LAWS), help="carrier law (default: the camera's)")


def add_recipe(parser: argparse.ArgumentParser, *, mask_needed: bool = True, mask_otherwise: str = "") -> None:
    """Add --camera, --mask, --law, and the files and numbers that go with a frame. `mask_otherwise` is what the help
    says of a mask that is not given."""
    mask_help = f"mask profile or TOML file, or lenslet{f' (default: {mask_otherwise})' if mask_otherwise else ''}"
    parser.add_argument(
        "--camera",
        default="auto",
        metavar="P",
        help="camera profile or TOML file (default: the one that fits the frame)",
    )
    parser.add_argument("--mask", required=mask_needed, metavar="P", help=mask_help)
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
        keep_law=bool(arguments.law),
    )


def add_field(parser: argparse.ArgumentParser, *, ranged: bool = True, needed: bool = True) -> None:
    """Add the light field; if `ranged`, also --focus and --calibration, which give distances in metres. Where it is not
    `needed`, a flight may be given in its place."""
    parser.add_argument("field", type=Path, metavar="LIGHTFIELD", nargs=None if needed else "?",
                        help="decoded light field (.zarr, .npz, .h5), or a folder of n × n pictures")  # fmt: skip
    if ranged:
        parser.add_argument(
            "--focus", type=metres, metavar="M", help="distance at which the lens was focused, in metres, or inf"
        )
        parser.add_argument("--calibration", type=Path, metavar="FILE",
                            help="calibration with targets, from dappled calibrate --target")  # fmt: skip


def add_flight(parser: argparse.ArgumentParser) -> None:
    """Add what goes with --flight where no light field is given: how its frames are decoded and placed."""
    of_flight = parser.add_argument_group("of a flight (--flight without LIGHTFIELD)")
    of_flight.add_argument("--terrain", type=Path, metavar="FILE", help="given terrain: DTED, GeoTIFF …")
    of_flight.add_argument("--ground", type=float, metavar="M",
                           help="height of flat ground, metres above sea level (default: home's)")  # fmt: skip
    of_flight.add_argument("--camera", metavar="P", help="camera profile (default: the flight's)")
    of_flight.add_argument("--mask", metavar="P", help="mask profile (default: the flight's)")
    of_flight.add_argument("--refine", action="store_true", help="fit the frames' poses to each other first")
    of_flight.add_argument("--cell", type=positive, metavar="M", help="side of a cell of the map")
    of_flight.add_argument("--crs", default="", metavar="EPSG:N", help="projection in metres (default: the UTM zone)")


def of_flight(arguments: argparse.Namespace) -> dict[str, Any]:
    """The arguments of `add_flight`, --focus and --calibration as `georeference.placed` takes them.

    Raises FieldCallError where no flight is given either.
    """
    if arguments.flight is None:
        raise FieldCallError("name a decoded light field, or a flight with --flight")
    return {
        "focus": math.inf if arguments.focus is None else arguments.focus,
        "calibration": None if arguments.calibration is None else str(arguments.calibration),
        "crs": arguments.crs or None,
        "refine": ["neighbours"] if arguments.refine else [],
        **{name: getattr(arguments, name) for name in ("terrain", "ground", "camera", "mask")},
    }


def refuse_of_flight(arguments: argparse.Namespace, *more: str) -> None:
    """Refuse what only goes with a flight beside a light field. Raises FieldCallError."""
    for name in ("terrain", "ground", "camera", "mask", "refine", "cell", *more):
        if getattr(arguments, name) not in (None, False):
            raise FieldCallError(
                f"--{name} goes with --flight FLIGHT and no light field: leave it or {arguments.field} out"
            )


def opened_field(arguments: argparse.Namespace) -> OpenedLightField:
    """The light field that the arguments name. What is in doubt about it is said on standard error: whatever is made
    of it is in doubt for that. Raises DappledError."""
    found = opened.light_field(arguments.field, focus_m=getattr(arguments, "focus", None))
    calibration = getattr(arguments, "calibration", None)
    if calibration is not None:
        tables = calibration_files.tables(calibration)
        if RANGING not in tables:
            raise opened.OpenError(f"{calibration} has no distances: make it again with dappled calibrate --target")
        found = OpenedLightField(opened.with_ranging(found.field, Ranging.from_dict(tables[RANGING])), found.path)
        found.metres()  # the user named it: refuse it if it is for another focal length
    for doubt in found.doubts:
        print(f"dappled {arguments.verb}: {arguments.field} is in doubt: {told(doubt, FRAME)}", file=sys.stderr)
    return found


def add_between(parser: argparse.ArgumentParser) -> None:
    """Add --between."""
    parser.add_argument("--between", nargs=2, type=float, metavar=("LOW", "HIGH"),
                        help="range of disparities to search, px/view (default: the scene's)")  # fmt: skip


def views_words(field: LightField) -> str:
    """How the views of a light field were made, where that was not by the model of the light field; else ""."""
    if field.attributes.get("views_model") != "independent":
        return ""
    reason = field.attributes.get("views_reason")
    return f"views of each spatial frequency by itself{f': {reason}' if reason else ''}"
