"""`dappled calibrate`: fit lattice, mask distance and phases to stopped-down frames."""

from __future__ import annotations

import argparse
import math
from pathlib import Path

import tomli_w

from dappled.cli import calibrate_lens, common
from dappled.config import profiles
from dappled.config.schema import ConfigError
from dappled.decode.calibration import Calibration, CalibrationFrame, calibrate
from dappled.drivers import rawfile
from dappled.drivers.darkroom import Darkroom, DarkroomError


def configure(parser: argparse.ArgumentParser) -> None:
    parser.epilog = "example: dappled calibrate white-f22.dng --camera canon-eos-450d --mask mask-2 -o calibration.toml"
    common.frames(parser, "+")
    common.add_recipe(parser, mask_needed=False)
    calibrate_lens.add(parser)
    parser.add_argument("-o", "--output", type=Path, required=True, metavar="FILE", help="calibration to write (.toml)")


def run(arguments: argparse.Namespace) -> int:
    if arguments.lens:
        arguments.mask = arguments.mask or ""
        return calibrate_lens.run(
            common.recipe(arguments), arguments.frames, arguments.board, arguments.output, arguments.focal_length
        )
    if not arguments.mask:
        raise ConfigError("which mask? Name its profile or TOML file with --mask")
    if arguments.mask == profiles.LENSLET:
        raise ConfigError("a lenslet array needs no calibration: give its white frame with --white when decoding")
    found = from_frames(
        Darkroom(common.recipe(arguments)), arguments.frames, arguments.focal_length, arguments.f_number
    )
    arguments.output.write_text(tomli_w.dumps(found.to_dict()), encoding="utf-8")
    for fit in found.fits:
        seen = f"{2 * fit.found - 1} carriers, residual {fit.residual_bins:.3f} bins"
        sits = f"turned by {math.degrees(fit.rotation_rad):.3f}°, mask {fit.mask_distance_mm:.4f} mm before the sensor"
        print(f"{fit.focal_length_mm:g} mm: {seen}, {sits}")
    print(f"written to {arguments.output}")
    return 0


def from_frames(
    darkroom: Darkroom, frames: list[Path], focal_length_mm: float | None = None, f_number: float | None = None
) -> Calibration:
    """The calibration that these frames show. Raises DappledError."""
    seen = []
    shape, model = (0, 0), ""
    for path in frames:
        raw = rawfile.read(path)
        with darkroom.naming(path):
            plane = darkroom.plane(raw)
        length, stop = focal_length_mm or raw.focal_length_mm, f_number or raw.f_number
        if length is None or stop is None:
            raise DarkroomError(f"{path} doesn't say its focal length and f-number: give --focal-length and --f-number")
        seen.append(CalibrationFrame(plane, length, stop))
        shape, model = (plane.shape[0], plane.shape[1]), raw.camera_model or ""
    camera = darkroom.camera(model)
    with darkroom.naming(frames[0]):
        return calibrate(
            seen,
            sensor=camera.sensor(shape),
            mask=profiles.mask(darkroom.recipe.mask).mask,
            law=darkroom.recipe.law or camera.law,
            mask_distance_mm=camera.mask_distance_mm,
            workers=2,
        )
