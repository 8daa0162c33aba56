"""`dappled calibrate --kit`: read frames shot by the list of `dappled mask kit`: law, distance, print scale."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

from dappled import codec
from dappled.cli.calibrate.frames import Given, fit_views, view_of, views_of
from dappled.cli.frame_arguments import frames
from dappled.cli.mask.kit import KIT
from dappled.cli.table import words_only
from dappled.cli.verb import Output, Report
from dappled.config.schema import read_toml
from dappled.decode.errors import NoCarriers
from dappled.errors import DappledError, counted
from dappled.findings import Code, Finding, Level, Subject, finding

if not words_only:
    import numpy as np

    from dappled.decode.calibration import Calibration, report
    from dappled.decode.calibration.law_choice import CALIBRATION, EXPLAINED_BINS, LawFit
    from dappled.drivers.raw import calibration_files, recipe_check
    from dappled.drivers.raw.darkroom import Darkroom
    from dappled.drivers.raw.raw_file import exposure
    from dappled.drivers.raw.recipe import Recipe

BARE = Subject("bare frames")
_MASKS = ("diagonal", "full")
_DARK_SHARE = 0.05  # of white: a white frame so dark was not exposed
_SAME_LENGTH, _SAME_STOP = 0.1, 0.15  # relative: a zoom is set by eye; f/22 may be f/22.6
_TOLD = 0.1  # relative: a distance with a larger error is not told
_AGREE = 3.0  # standard errors between the two masks
_REMOUNTED_MM = 0.1  # by which a film's distance may differ after it was mounted again


@dataclass(frozen=True, slots=True)
class MaskResult:
    """What the frames of one mask show: `used` frames, `unseen` ones in which no carrier can be seen at their stop.

    `fit` is the law that explains them, as fitted; None where no frame shows carriers, or neither law explains them.
    `shots` are the focal lengths and f-numbers of the used frames.
    """

    used: int
    unseen: int
    found: Calibration | None
    fit: LawFit | None
    shots: tuple[tuple[float, float], ...] = ()


@dataclass(frozen=True, slots=True)
class KitCall:
    """What a call says of a kit: its folder, how its frames are read, and what it says of them all."""

    folder: Path
    recipe: Recipe
    given: Given

    def darkroom(self, name: str) -> Darkroom:
        """What reads the frames of one mask. Raises DappledError."""
        recipe = replace(self.recipe, mask=str(self.folder / f"{name}.toml"))
        recipe_check.check(recipe)
        return Darkroom(recipe)

    def shows_full(self, path: Path) -> bool:
        """Whether a frame shows the full mask."""
        full = self.darkroom("full")
        try:
            view_of(full, path, self.given)
        except DappledError:
            return False
        return True


def calibrated(call: KitCall, to: Path | None, output: Output) -> Report:
    """Read a kit's frames, and write the full mask's calibration where it was asked for."""
    asked = _asked(call.folder)
    if call.recipe.camera == "auto":
        call = replace(call, recipe=replace(call.recipe, camera=asked["camera"]))
    doubts: list[Finding] = []
    results = {name: _mask_result(call, name, asked, doubts) for name in _MASKS}
    bare = _bare(call, results["diagonal"].shots, doubts)
    agree = _agree(results, doubts)
    full = results["full"].found
    lines = _lines(results, bare, agree)
    written = to is not None and full is not None and (call.given.anyway or not doubts)
    if written:
        assert to is not None
        assert full is not None
        calibration_files.save(to, replace(full, overridden=tuple(doubts)))
        lines.append(f"written to {' and '.join(map(str, calibration_files.pair(to)))}")
    if to is not None and full is None:
        output.warn("nothing written: no frame of the full mask shows its carriers")
    values = _values(call.recipe.camera, results, bare, agree, doubts)
    return Report(values, lines, findings=doubts, failed=to is not None and not written)


def _asked(folder: Path) -> dict[str, Any]:
    """What the kit's list asks for: camera, focal lengths, f-numbers. Raises DappledError for another folder."""
    path = folder / KIT
    if not path.is_file():
        raise DappledError(f"{folder} is no test kit, it has no {KIT}: name the folder that dappled mask kit wrote")
    asked = read_toml(path)[0]
    numbers = [asked.get(name) for name in ("focal_lengths_mm", "f_numbers")]
    if not isinstance(asked.get("camera"), str) or not all(
        isinstance(row, list) and row and all(isinstance(one, int | float) and one > 0 for one in row)
        for row in numbers
    ):
        raise DappledError(
            f"{path} doesn't name camera, focal_lengths_mm and f_numbers: write it again with dappled mask kit"
        )
    return asked


def _frames(folder: Path) -> list[Path]:
    return frames([folder]) if folder.is_dir() and any(folder.iterdir()) else []


def _mask_result(call: KitCall, name: str, asked: dict[str, Any], doubts: list[Finding]) -> MaskResult:
    """What the frames of one mask show. Appends what speaks against it to `doubts`."""
    darkroom = call.darkroom(name)
    paths = _frames(call.folder / name)
    seen, bad = views_of(darkroom, paths, call.given)
    blank = [none for _, error in bad if (none := _no_carriers(error)) is not None]
    unseen = [none for none in blank if not none.expected]
    doubts += [_refused(path, error) for path, error in bad if (no := _no_carriers(error)) is None or no.expected]
    used = tuple((one.shown.focal_length_mm, one.shown.f_number) for one in seen)
    shot = [*used, *((none.focal_length_mm, none.f_number) for none in blank)]
    doubts += _missing(name, shot, len(paths), asked)
    if not seen:
        if unseen:
            mask = Subject("mask", name)
            doubts += [finding(Code.KIT_UNSEEN, mask), replace(unseen[0].finding, subject=mask, level=Level.CAUTION)]
        return MaskResult(0, len(unseen), None, None)
    if name == "diagonal":
        doubts += _mixed_up(call, paths, bad)
    found = fit_views(darkroom, seen, choose_law=not call.recipe.law)
    stated = darkroom.camera(seen[0].model).mask_distance_mm
    fits = report.law_fits(found, stated)
    fit = next((one for one in fits if one.law == found.law and one.explains), None)
    doubts += [*found.overridden, *(replace(one, subject=Subject("mask", name)) for one in _untold(found, fits, fit))]
    return MaskResult(len(seen), len(unseen), found, fit, used)


def _no_carriers(error: DappledError) -> NoCarriers | None:
    """What says that a frame shows no carriers; None for any other error."""
    cause = error if isinstance(error, NoCarriers) else error.__cause__
    return cause if isinstance(cause, NoCarriers) else None


def _refused(path: Path, error: DappledError) -> Finding:
    """Why a frame is of no use for a calibration."""
    subject, none = Subject("calibration frame", path.name), _no_carriers(error)
    if none is not None:
        return replace(none.finding, subject=subject)
    return finding(Code.FRAME_REFUSED, subject, why=error)


def _missing(name: str, shot: Sequence[tuple[float, float]], there: int, asked: dict[str, Any]) -> list[Finding]:
    """The shots of the list that no frame is of.

    `shot` are focal lengths and f-numbers of the frames that tell them; each other one of all that are `there` may be
    any shot.
    """
    untold = there - len(shot)
    wanted = [(length, stop) for length in asked["focal_lengths_mm"] for stop in asked["f_numbers"]]
    lacking = [(length, stop) for length, stop in wanted if not _among(shot, length, stop)]
    missing = len(lacking) - untold
    if missing <= 0:
        return []
    shots = ", ".join(f"{length:g} mm at f/{stop:g}" for length, stop in lacking)
    return [finding(Code.KIT_SHOTS_MISSING, Subject("mask", name), missing=missing, wanted=len(wanted), shots=shots)]


def _among(shots: Sequence[tuple[float, float]], length_mm: float, f_number: float) -> bool:
    """Whether one of the shots has this focal length and f-number."""
    return any(
        abs(math.log(its_length / length_mm)) < _SAME_LENGTH and abs(math.log(its_stop / f_number)) < _SAME_STOP
        for its_length, its_stop in shots
    )


def _mixed_up(call: KitCall, paths: Sequence[Path], bad: Sequence[tuple[Path, DappledError]]) -> list[Finding]:
    """A sentence where a frame of the diagonal mask shows the full one: films or folders were exchanged."""
    path = next(one for one in paths if one not in {refused for refused, _ in bad})
    if not call.shows_full(path):
        return []
    return [finding(Code.KIT_MIXED_UP, Subject("calibration frame", path.name))]


def _untold(found: Calibration, fits: Sequence[LawFit], fit: LawFit | None) -> list[Finding]:
    """What the frames of one mask leave open, in sentences."""
    if fit is None:
        verdict = [] if found.verdict is None else [replace(found.verdict, level=Level.CAUTION)]
        geometric = next(one for one in fits if one.law == "geometric")
        if geometric.rms_bins <= EXPLAINED_BINS and abs(geometric.print_scale - 1) > 0.01:
            return [*verdict, finding(Code.KIT_PRINT_SIZE, CALIBRATION, size=1 / geometric.print_scale)]
        return verdict
    able = [one.law for one in fits if one.explains]
    open_ = [] if len(able) == 1 else [finding(Code.KIT_LAW_OPEN, CALIBRATION, laws=" and ".join(able))]
    sigma = fit.distance_sigma_mm
    if fit.law == "geometric" and sigma is None:
        open_.append(finding(Code.KIT_DISTANCE_OPEN, CALIBRATION))
    elif fit.law == "geometric" and sigma is not None and sigma > _TOLD * fit.mask_distance_mm:
        open_.append(
            finding(Code.KIT_DISTANCE_UNCERTAIN, CALIBRATION, distance_mm=fit.mask_distance_mm, sigma_mm=sigma)
        )
    return open_


def _bare(call: KitCall, shown: Sequence[tuple[float, float]], doubts: list[Finding]) -> int:
    """How many frames without a mask show no carriers where a mask would. Every mask has the diagonal one's lattice.

    `shown` are the focal lengths and f-numbers at which the diagonal mask's own frames show them: what the f-number
    alone leaves open, since stops differ in shape.
    """
    darkroom = call.darkroom("diagonal")
    paths = _frames(call.folder / "bare")
    if not paths:
        doubts.append(finding(Code.KIT_NO_BARE, BARE))
    clean = blind = 0
    for path in paths:
        frame = Subject("calibration frame", path.name)
        if (mean := exposure(darkroom.read(path)).mean_share) < _DARK_SHARE:
            doubts.append(finding(Code.KIT_DARK, frame, share=mean))
            continue
        try:
            view_of(darkroom, path, call.given)
        except DappledError as error:
            none = _no_carriers(error)
            if none is None:
                doubts.append(_refused(path, error))
            elif call.shows_full(path):
                doubts.append(finding(Code.KIT_FULL_FILM_IN, frame))
            elif none.expected or _among(shown, none.focal_length_mm, none.f_number):
                clean += 1
            else:
                blind += 1
            continue
        doubts.append(finding(Code.KIT_FILM_IN, frame))
    if blind and not clean:
        doubts.append(finding(Code.KIT_BLIND, BARE, frames=blind))
    return clean


def _agree(results: dict[str, MaskResult], doubts: list[Finding]) -> bool | None:
    """Whether both masks show one law, distance and print scale; None where one of them tells no distance."""
    first, second = (results[name].fit for name in _MASKS)
    if first is None or second is None:
        return None
    if first.law != second.law:
        doubts.append(finding(Code.KIT_LAWS_DISAGREE, CALIBRATION, diagonal=first.law, full=second.law))
        return False
    if first.law == "geometric" and None in (first.distance_sigma_mm, second.distance_sigma_mm):
        return None  # a distance that was stated, not measured
    apart: list[Finding] = []
    off = second.mask_distance_mm - first.mask_distance_mm
    if abs(off) > _REMOUNTED_MM + _AGREE * _both(first.distance_sigma_mm, second.distance_sigma_mm):
        mm = {"diagonal_mm": first.mask_distance_mm, "full_mm": second.mask_distance_mm}
        apart.append(Finding(Code.KIT_DISTANCES_DISAGREE, CALIBRATION, mm, Level.CAUTION))
    error = _AGREE * _both(first.print_scale_sigma, second.print_scale_sigma)
    if first.law == "geometric" and error > 0 and abs(second.print_scale - first.print_scale) > error:
        scales = {"diagonal": first.print_scale, "full": second.print_scale}
        apart.append(Finding(Code.KIT_PRINTS_DISAGREE, CALIBRATION, scales, Level.CAUTION))
    doubts += apart
    return not apart


def _both(first: float | None, second: float | None) -> float:
    return math.hypot(first or 0.0, second or 0.0)


def _values(
    camera: str, results: dict[str, MaskResult], bare: int, agree: bool | None, doubts: list[Finding]
) -> dict[str, Any]:
    def of(one: MaskResult) -> dict[str, Any]:
        fit, found = one.fit, one.found
        return {
            "frames_used": one.used,
            "frames_unseen": one.unseen,
            "law": None if fit is None else fit.law,
            "mask_distance_mm": None if fit is None else fit.mask_distance_mm,
            "mask_distance_sigma_mm": None if fit is None else fit.distance_sigma_mm,
            "print_scale": None if fit is None else fit.print_scale,
            "print_scale_sigma": None if fit is None else fit.print_scale_sigma,
            "pupil_mm": None if fit is None else fit.pupil_mm,
            "rotation_rad": None if found is None else float(np.mean([length.rotation_rad for length in found.fits])),
            "verdict": codec.plain(found and found.verdict),
        }

    return {
        "camera": camera,
        "masks": {name: of(one) for name, one in results.items()},
        "bare_clean": bare,
        "agree": agree,
        "doubts": codec.plain(doubts),
    }


def _distance(fit: LawFit) -> str:
    """A mask's distance, and how it is known: `fd` fits one without an error, `geometric` keeps the stated one."""
    if fit.distance_sigma_mm is not None:
        return f"{fit.mask_distance_mm:.3f} ± {fit.distance_sigma_mm:.3f} mm"
    known = "stated" if fit.law == "geometric" else "fitted, error unknown"
    return f"{fit.mask_distance_mm:.3f} mm ({known})"


def _lines(results: dict[str, MaskResult], bare: int, agree: bool | None) -> list[str]:
    lines = []
    for name, one in results.items():
        none = f", no carrier can be seen at the stop of {counted(one.unseen, 'other')}" if one.unseen else ""
        lines.append(f"{name}: {counted(one.used, 'frame')} used{none}")
        if one.fit is None:
            lines.append("  law: cannot tell")
            continue
        fit = one.fit
        lines.append(f"  law {fit.law}, mask {_distance(fit)} before the sensor")
        if fit.law == "geometric":
            error = "" if fit.print_scale_sigma is None else f" ± {fit.print_scale_sigma:.4f}"
            lines.append(f"  print {fit.print_scale:.4f}{error} times as fine as its design")
        if fit.pupil_mm is not None:
            lines.append(f"  exit pupil at the focal length {fit.pupil_mm:+.1f} mm")
    lines.append(f"bare: {counted(bare, 'frame')} without carriers")
    if agree is not None:
        lines.append("the masks agree" if agree else "the masks disagree")
    return lines
