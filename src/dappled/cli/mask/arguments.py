"""Arguments that the actions of `mask` share: the mask, its distance from the sensor, the camera and the law."""

from __future__ import annotations

import argparse
from dataclasses import dataclass

from dappled.cli import decode_arguments
from dappled.cli.arguments import whole
from dappled.config import profiles
from dappled.config.profiles import CameraProfile
from dappled.config.schema import ConfigError
from dappled.decode.optics import Mask, Sensor, lenses


@dataclass(frozen=True, slots=True)
class Installed:
    """A mask before a sensor."""

    camera: CameraProfile
    mask: Mask
    sensor: Sensor
    law: str
    distance_mm: float


def add_mask(parser: argparse.ArgumentParser) -> None:
    """--mask."""
    parser.add_argument("--mask", required=True, metavar="P", help="mask profile or TOML file")


def add_sensor(parser: argparse.ArgumentParser) -> None:
    """--camera and --shape."""
    parser.add_argument("--camera", required=True, metavar="P", help="camera profile or TOML file")
    parser.add_argument(
        "--shape", type=whole, nargs=2, metavar=("H", "W"), help="raw shape (default: the camera's first)"
    )


def add_installation(parser: argparse.ArgumentParser, *, free: bool = False) -> None:
    """--law and --mask-distance; `free` where a design may choose the distance."""
    decode_arguments.add_law(parser)
    default = "default: free; with --mask the camera's" if free else "default: the camera's"
    parser.add_argument("--mask-distance", type=float, metavar="MM", help=f"distance from mask to sensor ({default})")


def add_altitude(parser: argparse.ArgumentParser) -> None:
    """--altitude, and the camera that is flown there."""
    parser.add_argument("--altitude", type=float, required=True, metavar="M", help="height above ground")
    add_sensor(parser)
    parser.add_argument(
        "--focal-length",
        type=float,
        metavar="MM",
        help="focal length of the lens (default: the camera's, if it has only one)",
    )


def sensor(camera: CameraProfile, arguments: argparse.Namespace) -> Sensor:
    """The camera's sensor for --shape, or for its first raw shape. Raises ConfigError for a shape it hasn't."""
    shape = arguments.shape
    return camera.sensor((shape[0], shape[1])) if shape else camera.raw[0].sensor


def only_length(camera: CameraProfile) -> float | None:
    """The focal length of a lens that can't zoom; None for others."""
    known = camera.focal_length_mm
    return known[0] if known is not None and known[0] == known[1] else None


def camera_set(arguments: argparse.Namespace) -> tuple[CameraProfile, Sensor, float]:
    """The camera of `add_altitude`, its sensor, its focal length in mm. Raises ConfigError where that isn't known."""
    camera = profiles.camera(arguments.camera)
    length = only_length(camera) if arguments.focal_length is None else arguments.focal_length
    if length is None:
        raise ConfigError(
            f"{camera.name} does not fix the focal length: give the lens' setting in mm with --focal-length"
        )
    return camera, sensor(camera, arguments), lenses.focal_length(length)


def installed(arguments: argparse.Namespace) -> Installed:
    """What these arguments name. Raises ConfigError."""
    camera = profiles.camera(arguments.camera)
    return Installed(
        camera,
        profiles.mask(arguments.mask).mask,
        sensor(camera, arguments),
        arguments.law or camera.law,
        camera.mask_distance_mm if arguments.mask_distance is None else arguments.mask_distance,
    )


def out_of_reach(camera: CameraProfile, ideal: float) -> str | None:
    """A sentence where the lens has no stop as small as a mask's ideal f-number; None where it has or nobody knows."""
    if camera.f_numbers is None or ideal <= camera.f_numbers[1] * 1.05:
        return None
    return (
        f"the lens of {camera.name} only stops down to f/{camera.f_numbers[1]:g}: this mask separates its views at "
        f"f/{ideal:.3g}; wider open it mixes them, and few carriers can be seen (dappled mask table --visibility)"
    )
