"""`dappled calibrate --target`: fit disparity to distance with frames of targets at known distances."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

from dappled import codec, durable
from dappled.cli.table import words_only
from dappled.cli.verb import Output, Report
from dappled.errors import DappledError, counted

if not words_only:
    import tomli_w

    from dappled.config import profiles
    from dappled.decode.depth import RANGING, Ranging
    from dappled.decode.depth.ranging import Target, fit_targets, target_shift
    from dappled.drivers.raw import calibration_files
    from dappled.drivers.raw.darkroom import Darkroom, Recipe
    from dappled.products import opened
    from dappled.products.opened import OpenedLightField


def calibrated(
    recipe: Recipe,
    frames: list[Path],
    metres: Sequence[float],
    to: Path,
    *,
    focal_length_mm: float | None,
    output: Output,
) -> Report:
    """Fit the ranging, and write it with the calibration that the frames were decoded with."""
    if to.suffix != ".toml":
        raise DappledError(f"{to}: the name of a calibration with distances must end in .toml")
    found, targets = from_frames(recipe, frames, metres, focal_length_mm, output)
    written = _write(recipe, to, found)
    lines = []
    for path, target in zip(frames, targets, strict=True):
        clear = target.shift_px - found.offset_px
        says = f"{found.gain_px_m / clear:.3g} m" if clear > 0 else "beyond infinity"
        shift = f"{target.shift_px:.3f} px over the aperture; by the fit {says}"
        lines.append(f"{path.name}: {target.distance_m:g} m, {shift}")
    lines.append(f"shift = {found.gain_px_m:.4g} px·m / distance {found.offset_px:+.4g} px, from {found.source}")
    if found.offset_px < 0:
        lines.append(f"in focus at {-found.gain_px_m / found.offset_px:.4g} m")
    lines.append(f"written to {', '.join(map(str, written))}")
    return Report({"targets": codec.plain(targets), **codec.plain(found)}, lines)


def from_frames(
    recipe: Recipe,
    frames: list[Path],
    metres: Sequence[float],
    focal_length_mm: float | None = None,
    output: Output | None = None,
) -> tuple[Ranging, list[Target]]:
    """The ranging that frames of targets show, and what each target showed. Raises DappledError."""
    if len(frames) != len(metres):
        both = f"{counted(len(frames), 'frame')} and {counted(len(metres), 'distance')}"
        raise DappledError(f"{both}: give --target one distance per frame")
    darkroom = Darkroom(recipe)
    targets: list[Target] = []
    stops: set[float | None] = set()
    lengths: set[float | None] = set()
    lens: Ranging | None = None
    bar = frames if output is None else output.each(frames)
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
            raise DappledError(f"the targets were taken at several {name} ({_listed(several)}): take them all at one")
    return fit_targets(targets, f_number=stops.pop(), focal_length_mm=lengths.pop(), lens=lens), targets


def _listed(values: set[float | None]) -> str:
    return ", ".join(sorted("unknown" if value is None else f"{value:g}" for value in values))


def _write(recipe: Recipe, output: Path, found: Ranging) -> list[Path]:
    more: dict[str, Any] = {RANGING: codec.table(found)}
    if not recipe.calibration:
        durable.write_file(output, tomli_w.dumps(more).encode())
        return [output]
    known = calibration_files.load(Path(recipe.calibration))
    return list(calibration_files.save(output, known, more))
