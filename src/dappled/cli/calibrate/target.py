"""`dappled calibrate --target`: fit disparity to distance with frames of targets at known distances."""

from __future__ import annotations

import argparse
import sys
from pathlib import Path
from typing import Any

import tomli_w
from tqdm import tqdm

from dappled import durable
from dappled.config import profiles
from dappled.decode.depth import RANGING, Ranging
from dappled.decode.depth.ranging import Target, fit_targets, target_shift
from dappled.drivers.raw import calibration_files
from dappled.drivers.raw.darkroom import Darkroom, DarkroomError, Recipe
from dappled.errors import counted
from dappled.products import opened
from dappled.products.opened import OpenedLightField


def add(parser: argparse.ArgumentParser) -> None:
    """Add --target."""
    group = parser.add_argument_group("distances")
    group.add_argument("--target", nargs="+", type=float, metavar="M",
                       help="frames at full aperture show a textured target in the middle, at these distances, one\n"
                       "per frame: fit disparity to distance (Eq 5), on top of --calibration")  # fmt: skip


def run(recipe: Recipe, frames: list[Path], metres: list[float], output: Path, focal_length_mm: float | None) -> int:
    """Fit the ranging, and write it with the calibration that the frames were decoded with."""
    if output.suffix != ".toml":
        raise DarkroomError(f"{output}: the name of a calibration with distances must end in .toml")
    found, targets = from_frames(recipe, frames, metres, focal_length_mm)
    written = _write(recipe, output, found)
    for path, target in zip(frames, targets, strict=True):
        clear = target.shift_px - found.offset_px
        says = f"{found.gain_px_m / clear:.3g} m" if clear > 0 else "beyond infinity"
        print(f"{path.name}: {target.distance_m:g} m, {target.shift_px:.3f} px over the aperture; by the fit {says}")
    print(f"shift = {found.gain_px_m:.4g} px·m / distance {found.offset_px:+.4g} px, from {found.source}")
    if found.offset_px < 0:
        print(f"in focus at {-found.gain_px_m / found.offset_px:.4g} m")
    print(f"written to {', '.join(map(str, written))}")
    return 0


def from_frames(
    recipe: Recipe, frames: list[Path], metres: list[float], focal_length_mm: float | None = None
) -> tuple[Ranging, list[Target]]:
    """The ranging that frames of targets show, and what each target showed. Raises DappledError."""
    if len(frames) != len(metres):
        both = f"{counted(len(frames), 'frame')} and {counted(len(metres), 'distance')}"
        raise DarkroomError(f"{both}: give --target one distance per frame")
    darkroom = Darkroom(recipe)
    targets: list[Target] = []
    stops: set[float | None] = set()
    lengths: set[float | None] = set()
    lens: Ranging | None = None
    bar = tqdm(frames, unit="frame", disable=not sys.stderr.isatty(), file=sys.__stderr__)
    for path, distance in zip(bar, metres, strict=True):
        made = darkroom.decode(path, focal_length_mm=focal_length_mm, joint_views=False)  # depth is made from slices
        field = OpenedLightField(made.light_field, path)
        with darkroom.naming(path):
            targets.append(Target(distance, *target_shift(field.depth(), field.stack)))
        stops.add(None if recipe.mask == profiles.LENSLET else field.attributes.get("f_number"))
        lengths.add(field.attributes.get("focal_length_mm"))
        lens = opened.lens_ranging(field.field, float("inf"))
    for several, name in ((stops, "f-numbers"), (lengths, "focal lengths")):
        if len(several) > 1:
            raise DarkroomError(f"the targets were taken at several {name} ({_listed(several)}): take them all at one")
    return fit_targets(targets, f_number=stops.pop(), focal_length_mm=lengths.pop(), lens=lens), targets


def _listed(values: set[float | None]) -> str:
    return ", ".join(sorted("unknown" if value is None else f"{value:g}" for value in values))


def _write(recipe: Recipe, output: Path, found: Ranging) -> list[Path]:
    more: dict[str, Any] = {RANGING: {k: v for k, v in found.to_dict().items() if v is not None}}
    if not recipe.calibration:
        durable.write_file(output, tomli_w.dumps(more).encode())
        return [output]
    known = calibration_files.load(Path(recipe.calibration))
    return list(calibration_files.save(output, known, more))
