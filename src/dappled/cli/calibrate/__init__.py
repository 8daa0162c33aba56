"""`dappled calibrate`: fit lattice, mask distance and phases to stopped-down frames; see `kit`, `lens` and `target`."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path

from dappled.cli.calibrate import kit, lens, target
from dappled.cli.calibrate.frames import CalibrationView, Given, fit_views, views_of
from dappled.cli.frame_arguments import FRAME_HELP, RecipeArguments, frames
from dappled.cli.table import words_only
from dappled.cli.verb import Doubtable, Output, Overwriting, Report, Verb, argument, flag, option
from dappled.errors import CallError, DappledError, counted
from dappled.findings import Code, finding, told

if not words_only:
    from dappled.config import profiles
    from dappled.decode.calibration import Calibration, report
    from dappled.decode.calibration.law_choice import CALIBRATION
    from dappled.drivers.raw import calibration_files, recipe_check
    from dappled.drivers.raw.darkroom import Darkroom


@dataclass(frozen=True, kw_only=True)
class CalibrateMask(Overwriting, Doubtable, lens.LensArguments, RecipeArguments, Verb):
    """Fit lattice, law and phases."""

    examples = (
        "dappled calibrate white-f22.dng --camera canon-eos-450d --mask mask-2 -o calibration.toml",
        "dappled calibrate zoom/*.RAF --mask mask-2 --dark dark.RAF -o calibration.toml",
        "dappled calibrate --kit kit -o calibration.toml",
    )

    frames: tuple[Path, ...] = argument("FRAME", FRAME_HELP, default=(), there=True)
    target: tuple[float, ...] = option(
        "--target", "frames at full aperture show a textured target in the middle, at these distances, one per "
        "frame: fit disparity to distance (Eq 5), on top of --calibration", (), metavar="M", above=0.0,
        group="distances",
    )  # fmt: skip
    kit: Path | None = option(
        "--kit", "read the frames that were shot by the list of `dappled mask kit`, from its folders bare, diagonal "
        "and full: which law, distance and print scale; exit 1 if in doubt. -o is optional, and takes the full "
        "mask's calibration", None, metavar="FOLDER", group="test kit", there=True,
    )  # fmt: skip
    output: Path | None = option("-o --output", "calibration to write: FILE.toml and FILE.npz", None)
    anyway: bool = flag(
        "--anyway",
        "write a calibration that no law explains, or of frames that are not linear, with these doubts in it",
    )

    def check(self) -> None:
        if self.kit is not None:
            if self.frames or self.mask:
                raise CallError("--kit reads the frames and masks of its folder: leave out FRAME and --mask")
        elif not self.frames or self.output is None:
            raise CallError("name the frames, and the calibration to write with -o FILE; or the folder of a --kit")
        elif not self.lens and not self.mask:
            raise CallError("name the mask to calibrate with --mask: a profile or TOML file")
        elif self.mask == profiles.LENSLET and not (self.target or self.lens):
            raise CallError("a lenslet array needs no calibration: give its white frame with --white when decoding")
        if self.output is not None:
            self.refuse_existing(*([self.output] if self.lens else calibration_files.pair(self.output)))
        if self.mask:
            recipe_check.check(self.recipe())

    def run(self, output: Output) -> Report:
        if self.kit is not None:
            return kit.calibrated(kit.KitCall(self.kit, self.recipe(), self._given), self.output, output)
        assert self.output is not None
        found, recipe = frames(self.frames), self.recipe()
        if self.lens:
            return lens.calibrated(
                recipe, found, self.board, self.output, focal_length_mm=self.focal_length, output=output
            )
        if self.target:
            return target.calibrated(
                recipe, found, self.target, self.output, focal_length_mm=self.focal_length, output=output
            )
        return self._from_frames(found, self.output, output)

    @property
    def _given(self) -> Given:
        return Given(self.focal_length, self.f_number, self.anyway)

    def _from_frames(self, paths: Sequence[Path], to: Path, output: Output) -> Report:
        """Calibrate with stopped-down frames, and write the files."""
        darkroom = Darkroom(self.recipe())
        seen, bad = views_of(darkroom, output.each(paths), self._given)
        if len(paths) == len(bad) == 1:
            raise bad[0][1]
        for _, error in bad:
            output.warn(str(error))
        if not seen:
            raise DappledError("no frame is left to calibrate with: each was refused, for the reason above")
        camera = darkroom.camera(seen[0].model)
        found = fit_views(darkroom, seen, choose_law=not self.law)
        found = self._judged(found, seen, camera.mask_distance_mm)
        written = calibration_files.save(to, found)
        if bad:
            output.remark(f"{len(bad)} of {counted(len(paths), 'frame')} could not be used")
        lines = report.as_lines(found, camera.mask_distance_mm)
        return Report(
            report.as_values(found, camera.mask_distance_mm),
            [*lines, f"written to {written[0]} and {written[1]}"],
            findings=found.doubts,
            failed=bool(bad),
        )

    def _judged(self, found: Calibration, seen: Sequence[CalibrationView], stated_mm: float) -> Calibration:
        """The calibration with what its law leaves in doubt.

        Raises DappledError where its own law does not, or all frames' carriers are weak, without --anyway.
        """
        weak = [one.shown.weak for one in seen if one.shown.weak is not None]
        if len(weak) == len(seen) and not self.anyway:
            raise DappledError(f"{told(weak[0], CALIBRATION)}; --anyway writes the calibration with this doubt in it")
        able = [law.law for law in report.law_fits(found, stated_mm) if law.explains]
        if found.law in able:
            return found
        asked = found.verdict
        if able:
            fits = asked.facts["fits"] if asked is not None else ""
            asked = finding(Code.LAW_ASKED, CALIBRATION, law=found.law, seen=able[0], fits=fits)
        if asked is not None and not self.anyway:
            raise DappledError(f"{told(asked, CALIBRATION)}; --anyway writes the calibration with this doubt in it")
        return replace(found, overridden=(*found.overridden, asked)) if able and asked is not None else found
