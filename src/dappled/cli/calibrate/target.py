"""`dappled calibrate --target`: fit disparity to distance with frames of targets at known distances."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from dappled import codec, durable
from dappled.cli.table import words_only
from dappled.cli.verb import Output, Report
from dappled.errors import DappledError, counted
from dappled.findings import Code, Finding, Subject, finding, of_subject

if not words_only:
    import tomli_w

    from dappled.config import profiles
    from dappled.decode.depth import RANGING, Ranging
    from dappled.decode.depth.ranging import Target, fit_targets, target_shift
    from dappled.decode.lightfield import ViewStack
    from dappled.drivers.raw import calibration_files
    from dappled.drivers.raw.darkroom import Darkroom, naming
    from dappled.drivers.raw.recipe import Recipe
    from dappled.products import opened
    from dappled.products.opened import OpenedLightField

_FAR_SIGMAS = 4.0  # 1 in 10⁴ of normal errors is beyond it


@dataclass(frozen=True, slots=True)
class TargetFit:
    """A ranging, what each target showed, what puts it in doubt, and the last frame's views."""

    ranging: Ranging
    targets: list[Target]
    doubts: list[Finding]
    stack: ViewStack


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
    seen = from_frames(recipe, frames, metres, focal_length_mm, output)
    found = seen.ranging
    written = _write(recipe, to, found)
    lines = []
    for path, target in zip(frames, seen.targets, strict=True):
        clear = target.shift_px - found.offset_px
        says = f"{found.gain_px_m / clear:.3g} m" if clear > 0 else "beyond infinity"
        shift = f"{target.shift_px:.3f} ± {target.sigma_px:.3f} px over the aperture; by the fit {says}"
        lines.append(f"{path.name}: {target.distance_m:g} m, {shift}")
    gain = f"{found.gain_px_m:.4g} ± {found.gain_sigma_share * found.gain_px_m:.2g} px·m"
    offset = f"{found.offset_px:+.4g} ± {found.offset_sigma_px:.2g} px"
    lines.append(f"shift = {gain} / distance {offset}, from {found.source}")
    focus = found.focus(seen.stack)
    if focus is not None:
        lines.append("in focus at {:.4g} ± {:.1g} m".format(*focus))
    lines.append(f"written to {', '.join(map(str, written))}")
    values = {"targets": codec.plain(seen.targets), **codec.plain(found), "focus_m": focus}
    return Report(values | {"doubts": codec.plain(seen.doubts)}, lines, findings=seen.doubts)


def from_frames(
    recipe: Recipe,
    frames: list[Path],
    metres: Sequence[float],
    focal_length_mm: float | None = None,
    output: Output | None = None,
) -> TargetFit:
    """The ranging that frames of targets show. Raises DappledError."""
    if len(frames) != len(metres):
        both = f"{counted(len(frames), 'frame')} and {counted(len(metres), 'distance')}"
        raise DappledError(f"{both}: give --target one distance per frame")
    darkroom = Darkroom(recipe)
    targets: list[Target] = []
    doubts: list[Finding] = []
    stops: set[float | None] = set()
    lengths: set[float | None] = set()
    lens: Ranging | None = None
    bar = frames if output is None else output.each(frames)
    for path, distance in zip(bar, metres, strict=True):
        made = darkroom.decode(path, focal_length_mm=focal_length_mm, joint_views=False)  # depth is made from slices
        field = OpenedLightField(made.light_field, path)
        with naming(path):
            targets.append(Target(distance, *target_shift(field.depth(), field.stack)))
        doubts += of_subject(made.doubts, Subject("frame", path.name))
        stops.add(None if recipe.mask == profiles.LENSLET else field.attributes.get("f_number"))
        lengths.add(field.attributes.get("focal_length_mm"))
        lens = opened.lens_ranging(field.field, float("inf"))
    for several, name in ((stops, "f-numbers"), (lengths, "focal lengths")):
        if len(several) > 1:
            raise DappledError(f"the targets were taken at several {name} ({_listed(several)}): take them all at one")
    found = fit_targets(targets, f_number=stops.pop(), focal_length_mm=lengths.pop(), lens=lens)
    return TargetFit(found, targets, doubts + misfits(found, frames, targets), field.stack)


def misfits(found: Ranging, frames: Sequence[Path], targets: Sequence[Target]) -> list[Finding]:
    """What tells of a wrong distance, or of a lens that was focused in between: three or more targets on no line."""
    off = [abs(found.gain_px_m / one.distance_m + found.offset_px - one.shift_px) / one.sigma_px for one in targets]
    path, sigmas = max(zip(frames, off, strict=True), key=lambda pair: pair[1])
    if len(targets) < 3 or sigmas < _FAR_SIGMAS:
        return []
    return [finding(Code.TARGETS_DISAGREE, Subject("frame", path.name), sigmas=sigmas)]


def _listed(values: set[float | None]) -> str:
    return ", ".join(sorted("unknown" if value is None else f"{value:g}" for value in values))


def _write(recipe: Recipe, output: Path, found: Ranging) -> list[Path]:
    more: dict[str, Any] = {RANGING: codec.table(found)}
    if not recipe.calibration:
        durable.write_file(output, tomli_w.dumps(more).encode())
        return [output]
    known = calibration_files.load(Path(recipe.calibration))
    return list(calibration_files.save(output, known, more))
