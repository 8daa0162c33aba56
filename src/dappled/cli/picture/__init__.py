"""`dappled picture`: the photograph without the mask's shadow, at the sensor's own resolution."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from dappled import codec, durable, findings
from dappled.cli.frame_arguments import FramesArguments, each_frame, frames, recorded, refuse_same_names
from dappled.cli.table import words_only
from dappled.cli.verb import CallError, Doubtable, Output, Overwriting, Report, Verb, flag, option
from dappled.errors import counted
from dappled.findings import Finding

if not words_only:
    from dappled.cli.picture import places
    from dappled.drivers.raw.picture_maker import MadePicture, PictureMaker
    from dappled.products.handover import picture_files


@dataclass(frozen=True, kw_only=True)
class MakePictures(Overwriting, Doubtable, FramesArguments, Verb):
    """Make photographs without the mask's shadow."""

    examples = (
        "dappled picture frame.cr2 --mask mask-2 -o frame.dng",
        "dappled picture FLIGHT -o pictures/ --as jpg    (by the flight's own mask, camera and calibration)",
    )

    output: Path = option("-o --output", "picture (.dng, .tif, .jpg, .png); otherwise a folder", metavar="OUT")
    kind: str = option("--as", "kind of the pictures in a folder", "dng", choices=("dng", "tif", "jpg", "png"))
    sigma: bool = flag("--sigma", "write NAME.sigma.tif: each pixel's standard error, NaN where not trusted")
    json: bool = flag("--json", "print one JSON object per frame")

    def _maker(self) -> PictureMaker:
        return PictureMaker(recorded(self.frames, self.recipe()))

    def check(self) -> None:
        """Refuse a call that is wrong by itself."""
        self._maker().check()

    def run(self, output: Output) -> Report:
        """Make photographs without the mask's shadow."""
        maker, found = self._maker(), frames(self.frames)
        suffix = self.output.suffix.lower()
        single = len(found) == 1 and suffix in picture_files.SUFFIXES
        if not single:
            if suffix in picture_files.SUFFIXES:
                raise CallError(f"{counted(len(found), 'frame')} can't all be {self.output}: name a folder")
            refuse_same_names(found, self.output, f".{self.kind}")
            durable.make_folder(self.output)

        def pictured(frame: Path) -> Sequence[Finding]:
            target = self.output if single else self.output / f"{frame.stem}.{self.kind}"
            return self._made(maker, frame, target, output)

        return each_frame(found, output, pictured, into_folder=not single, failure="gave no picture")

    def _made(self, maker: PictureMaker, frame: Path, target: Path, output: Output) -> Sequence[Finding]:
        """Make and write one picture; what was found of it. Raises DappledError."""
        beside = target.with_suffix(".sigma.tif")
        self.refuse_existing(target, beside if self.sigma else None)
        made = maker.picture(frame, focal_length_mm=self.focal_length, f_number=self.f_number)
        durable.write_file(target, picture_files.encoded(made, target.suffix, places.place_of(frame)))
        if self.sigma:
            durable.write_file(beside, picture_files.sigma_file(made))
        output.row(_facts(target, made), f"{target}: {summary(made)}")
        return made.findings


CLASSES = {"picture": MakePictures}


def _facts(target: Path, made: MadePicture) -> dict[str, Any]:
    """What the line of a frame says, for a program."""
    shadow = made.picture.shadow
    return {
        "file": str(target),
        "shape": list(made.picture.plane.shape),
        "shadow_from": shadow.source.value,
        "shadow_depth": shadow.depth,
        "shadow_sigma": float(shadow.sigma.max()),
        "lattice": shadow.lattice.matrix().tolist(),
        "dark_share": made.picture.dark_share,
        "soft_share": made.picture.soft_share,
        "trusted_share": float(made.picture.trusted.mean()),
        "findings": [codec.plain(one) for one in findings.in_order(made.findings)],
    }


def summary(made: MadePicture) -> str:
    """Its size, and where its shadow is from."""
    rows, columns = made.picture.plane.shape
    shadow = made.picture.shadow
    whose = {"frame": "found in the frame", "white": "the white frame's", "calibration": "the calibration's"}
    if (told := whose.get(shadow.source.value)) is None:
        return f"{columns} × {rows} px; no shadow of the mask was seen"
    return (
        f"{columns} × {rows} px; the mask's shadow is {told}: it varies by {shadow.depth:.1%} of its mean, "
        f"known to {float(shadow.sigma.max()):.2%}"
    )
