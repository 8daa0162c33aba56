"""Write one picture of a simulated camera as a file, to try the commands with.

python -m dappled.mocks.shoot frame.dng
python -m dappled.mocks.shoot white.dng --scene white --f-number 59.2
python -m dappled.mocks.shoot white-f22.dng --scene white --mask mask-2 --seed 1
python -m dappled.mocks.shoot hard.dng --rays print_scale=1.003 stop=square falloff=0.4 --scale 0.1
python -m dappled.mocks.shoot hard.jpg --rays --scale 0.1 --super-ccd
"""

from __future__ import annotations

import argparse
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from dappled.config import profiles
from dappled.mocks.scene import dng
from dappled.mocks.scene.masked_camera import (
    EXPOSURE_S,
    ISO,
    MAKE,
    MODEL,
    eos450d_camera,
    eos450d_f_number,
    reference_camera,
)
from dappled.mocks.scene.ray_camera import REAL_COLOURS, WHITE, RayCamera
from dappled.mocks.scene.super_ccd import SuperCcdBody


def main(words: list[str] | None = None) -> int:
    """Write the file; returns the exit code."""
    parser = argparse.ArgumentParser(prog="python -m dappled.mocks.shoot", description="A simulated frame.")
    parser.add_argument("output", type=Path, metavar="FILE", help=".dng, with --rays also .jpg")
    parser.add_argument("--scene", default="bench", choices=("bench", "white", "terrain"), help="default: bench")
    parser.add_argument("--f-number", type=float, metavar="N", help="default: open, f/7.4; with --mask f/22")
    parser.add_argument(
        "--mask", metavar="P", help="by a Canon EOS 450D with this mask instead: a profile or TOML file"
    )
    parser.add_argument(
        "--seed", type=int, default=3, help="seed of the scene and of how the mask is installed (default: 3)"
    )
    parser.add_argument("--scale", type=float, default=0.5, help="share of the full sensor's side (default: 0.5)")
    parser.add_argument("--truth", type=Path, metavar="FILE.npz", help="also write what the camera really saw")
    parser.add_argument(
        "--rays", nargs="*", metavar="NAME=VALUE",
        help="ray by ray, with the imperfections named here (RayCamera); mask=PROFILE and colours=yes, too",
    )  # fmt: skip
    parser.add_argument(
        "--super-ccd", action="store_true", help="with --rays and .jpg: sampled and processed as by a FinePix S5200"
    )
    arguments = parser.parse_args(words)
    if arguments.rays is not None:
        return _by_rays(parser, arguments)
    if arguments.mask is not None:
        camera = eos450d_camera(arguments.seed, profiles.mask(arguments.mask).mask, scene=arguments.scene, real=True)
        shot = camera.expose(0.0, 0, f_number=arguments.f_number or eos450d_f_number(camera))
    else:
        camera = reference_camera(arguments.seed, scale=arguments.scale, scene=arguments.scene)
        shot = camera.expose(0.0, 0, f_number=arguments.f_number)
    arguments.output.write_bytes(shot.file)
    if arguments.truth is not None:
        shot.truth.save(arguments.truth)
    return 0


def _by_rays(parser: argparse.ArgumentParser, arguments: argparse.Namespace) -> int:
    shape = round(2776 * arguments.scale / 2) * 2, round(3688 * arguments.scale / 2) * 2
    camera = RayCamera(profiles.mask("reference-5x5").mask, shape=shape, seed=arguments.seed)
    if arguments.scene == "terrain":
        parser.error("--rays knows the scenes bench and white")
    if arguments.scene == "white":
        camera = replace(camera, boards=WHITE)
    if arguments.f_number is not None:
        camera = replace(camera, f_number=arguments.f_number)
    for word in arguments.rays:
        name, _, value = word.partition("=")
        try:
            camera = replace(camera, **_set(camera, name, value))
        except ValueError as error:
            parser.error(f"--rays {word}: {error}")
    frame = camera.expose()
    if arguments.output.suffix == ".jpg":
        arguments.output.write_bytes(SuperCcdBody().jpeg(frame.plane) if arguments.super_ccd else frame.jpeg())
        return 0
    exif = dng.Exif(
        MAKE, MODEL, f"SIM{arguments.seed:08d}", camera.focal_length_mm, camera.f_number, EXPOSURE_S, ISO, 0
    )
    mono = camera.colour_filters is None
    arguments.output.write_bytes(dng.encode(frame.raw(), black=1024, white=15360, exif=exif, mono=mono))
    if arguments.truth is not None:
        truth = frame.truth
        np.savez(
            arguments.truth,
            views=truth.views,
            view_weights=truth.view_weights,
            disparity_mm_per_mm=truth.disparity,
            kappa=camera.kappa,
            lattice=camera.lattice().matrix(),
        )
    return 0


def _set(camera: RayCamera, name: str, value: str) -> dict[str, Any]:
    """One parameter in words. Raises ValueError for a name or a value that there isn't."""
    now = getattr(camera, name, None) if name in camera.__dataclass_fields__ else None
    made: Any = None
    if name == "mask":
        made = profiles.mask(value).mask
    elif name == "colours":
        return {"colour_filters": REAL_COLOURS if value == "yes" else None}
    elif isinstance(now, bool):
        made = value == "yes"
    elif isinstance(now, int | float):
        made = type(now)(value)
    elif name == "exit_pupil_mm":
        made = float(value)
    elif name == "stop" and value in ("round", "square", "polygon"):
        made = value
    elif name in ("moved_mm", "shift_mm", "pitch_mm"):
        y, x = value.split(",")
        made = float(y), float(x)
    else:
        raise ValueError("no such parameter, or not one that words can set")
    return {name: made}


if __name__ == "__main__":
    raise SystemExit(main())
