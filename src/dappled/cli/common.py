"""Arguments that several verbs share: which frame, camera, mask and files to decode with."""

from __future__ import annotations

import argparse
import math
import os
import socket
from pathlib import Path

from dappled.config import settings
from dappled.daemon.stream.wire import WireError
from dappled.decode.optics.carriers import LAWS
from dappled.drivers.raw.darkroom import Recipe

SERVICE_FOLDER = Path("/run/dappled")  # RuntimeDirectory= of systemd/dappled.service


def stream(config: Path | None, service: Path = SERVICE_FOLDER) -> str:
    """Endpoint of the daemon on this machine: as the settings name it, else this user's own, else the service's.

    Raises ConfigError; WireError where this user may not look into the service's folder.
    """
    endpoint = settings.load(config).publish.slices
    ours = settings.runtime_folder() / "slices"
    if endpoint != f"ipc://{ours}" or ours.parent == service or not service.is_dir() or answers(endpoint):
        return endpoint
    if not os.access(service, os.X_OK):
        raise WireError(
            f"{service}: only members of its group may ask the service: sudo usermod -aG dappled $USER, and log in anew"
        )
    return f"ipc://{service}/slices"


def answers(endpoint: str) -> bool:
    """Whether somebody listens on an ipc endpoint; of others nothing is known, and they don't."""
    if not endpoint.startswith("ipc://"):
        return False
    with socket.socket(socket.AF_UNIX) as probe:
        probe.settimeout(1.0)
        try:
            probe.connect(endpoint.removeprefix("ipc://"))
        except OSError:
            return False
    return True


def whole(text: str) -> int:
    """An argument that is a whole number from 1."""
    if not (text.isdecimal() and int(text) >= 1):
        raise argparse.ArgumentTypeError(f"{text!r} is not a whole number from 1")
    return int(text)


def seconds(text: str) -> float:
    """An argument that is a time of 0 s or more."""
    number = _number(text)
    if number is None or not (math.isfinite(number) and number >= 0):
        raise argparse.ArgumentTypeError(f"{text!r} is not a time of 0 s or more")
    return number


def positive(text: str) -> float:
    """An argument that is a number above 0."""
    number = _number(text)
    if number is None or not (math.isfinite(number) and number > 0):
        raise argparse.ArgumentTypeError(f"{text!r} is not a number above 0")
    return number


def _number(text: str) -> float | None:
    try:
        return float(text)
    except ValueError:
        return None


def add_law(parser: argparse.ArgumentParser) -> None:
    """--law; empty where it isn't given."""
    parser.add_argument("--law", default="", choices=tuple(LAWS), help="carrier law (default: the camera's)")


def add_recipe(parser: argparse.ArgumentParser, *, mask_needed: bool = True) -> None:
    """--camera, --mask, --law, and what files and numbers go with a frame."""
    parser.add_argument(
        "--camera", default="auto", metavar="P", help="camera profile or TOML file (default: by the frame)"
    )
    parser.add_argument("--mask", required=mask_needed, metavar="P", help="mask profile or TOML file, or lenslet")
    add_law(parser)
    parser.add_argument("--calibration", default="", metavar="FILE", help="file written by dappled calibrate")
    parser.add_argument("--white", default="", metavar="FILE", help="white frame")
    parser.add_argument("--dark", default="", metavar="FILE", help="dark frame")
    parser.add_argument("--cfa", default="", metavar="BGGR", help="colour pattern, row by row, where the file has none")
    parser.add_argument("--black", type=float, metavar="N", help="black level, where the file doesn't say")
    parser.add_argument("--white-level", type=float, metavar="N", help="level of a full pixel (a 12-bit PNG: 4095)")
    parser.add_argument("--focal-length", type=float, metavar="MM", help="of the lens, where the file doesn't say")
    parser.add_argument("--f-number", type=float, metavar="N", help="of the exposure, where the file doesn't say")


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
    )


def frames(parser: argparse.ArgumentParser, count: str) -> None:
    """The frames, as positional arguments."""
    parser.add_argument("frames", nargs=count, type=Path, metavar="FRAME", help="RAF, CR2, DNG, LFP, TIFF, PNG or NPY")
