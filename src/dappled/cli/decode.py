"""`dappled decode`: decode frames to light fields."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Any

from dappled import codec
from dappled.cli.field_arguments import views_words
from dappled.cli.frame_arguments import (
    FrameMade,
    FramesArguments,
    Several,
    each_frame,
    frames,
    recorded,
    refuse_same_names,
)
from dappled.cli.table import words_only
from dappled.cli.verb import Doubtable, Output, Overwriting, Report, Verb, flag, option
from dappled.errors import DappledError
from dappled.findings import FRAME, told

if not words_only:
    from dappled.drivers.raw import recipe_check
    from dappled.drivers.raw.darkroom import Darkroom, DecodeResult
    from dappled.drivers.raw.recipe import Recipe
    from dappled.products import processes
    from dappled.products.exports import light_files


@dataclass(frozen=True, kw_only=True)
class DecodeFrames(Overwriting, Doubtable, Several, FramesArguments, Verb):
    """Decode frames to light fields."""

    examples = (
        "dappled decode frame.dng --mask reference-5x5 --calibration c.toml -o frame.zarr",
        "dappled decode FLIGHT -o decoded/    (by the flight's own mask, camera and calibration)",
        "dappled decode *.png --mask lenslet --white white.png -o decoded/",
    )

    output: Path = option("-o --output", "light field (.zarr, .npz, .h5); with several frames a folder", metavar="OUT")
    colour: bool = flag("--colour", "views in red, green and blue (default: grey)")
    taper: float = option(
        "--taper", "share of each band with a soft edge: less ringing, less detail", 0.0, metavar="SHARE", low=0,
        high=1,
    )  # fmt: skip
    anyway: bool = flag(
        "--anyway",
        "write the light field although carriers that must be visible are not, and exit with 0 although what was "
        "written is in doubt (otherwise 1)",
    )
    json: bool = flag("--json", "print one JSON object per frame")

    def _recipe(self) -> Recipe:
        return recorded(self.frames, self.recipe(colour=self.colour, taper=self.taper))

    def check(self) -> None:
        recipe_check.check(self._recipe())

    def run(self, output: Output) -> Report:
        recipe, found = self._recipe(), frames(self.frames)
        single = len(found) == 1 and bool(self.output.suffix)
        if not single:
            refuse_same_names(found, self.output, ".zarr")
            self.output.mkdir(parents=True, exist_ok=True)

        workers = processes.worth(self.workers, len(found))
        make = _Decoding(self, recipe.shared_by(workers), single)
        with processes.Crew(workers) as crew:
            return each_frame(found, output, make, crew=crew, into_folder=not single, failure="could not be decoded")


@dataclass(frozen=True)
class _Decoding:
    """Decodes one frame after the other, in any process."""

    asked: DecodeFrames
    recipe: Recipe
    single: bool

    @cached_property
    def darkroom(self) -> Darkroom:
        """Its decoders, which are made once."""
        return Darkroom(self.recipe)

    def __call__(self, frame: Path) -> FrameMade:
        """Decode a frame and write its light field. Raises DappledError."""
        asked = self.asked
        target = asked.output if self.single else asked.output / f"{frame.stem}.zarr"
        made = self.darkroom.decode(frame, focal_length_mm=asked.focal_length, f_number=asked.f_number)
        if not asked.anyway:
            _refuse_contradicted(frame, made)
        light_files.save(target, made.light_field, overwrite=asked.overwrite)
        return FrameMade(tuple(made.doubts), _facts(target, made), (f"{target}: {summary(made)}",))


def _refuse_contradicted(frame: Path, made: DecodeResult) -> None:
    """Carriers that must be visible and are not: slices cut at the prediction would hold nothing."""
    if made.contradiction:
        raise DappledError(f"{frame}: {told(made.contradiction, FRAME)}; --anyway decodes it at the prediction")


def _facts(target: Path, made: DecodeResult) -> dict[str, Any]:
    """What the line of a frame says, for a program."""
    field = made.light_field
    return {
        "file": str(target),
        "slices": list(field.slices.shape),
        "views": list(field.views.shape[:2]),
        "carriers_found": made.carriers_found if made.observable else None,
        "carriers_predicted": made.carriers_predicted,
        "carriers_from": made.report.carriers_from,
        "law": field.attributes["law"],
        "views_model": field.attributes.get("views_model"),
        "views_reason": field.attributes.get("views_reason"),
        "doubts": field.attributes["doubts"],
        "contradiction": codec.plain(made.contradiction),
    }


def summary(made: DecodeResult) -> str:
    """Slices, views, and where both came from."""
    field = made.light_field
    rows, columns = field.views.shape[:2]
    views = f"{rows} × {columns} views" if rows else "no views (they need a calibration, or visible carriers)"
    size = " × ".join(str(n) for n in field.slices.shape)
    found = f"{made.carriers_found} of {made.carriers_predicted} carriers seen"
    whole = f"slices {size}, {views}; {found}, {made.report.carriers_from}"
    whose = "calibration's" if made.report.carriers_from == "calibrated" else "law's"
    if made.contradiction:
        whole += f": {told(made.contradiction, FRAME)}; cut at the {whose} prediction"
    elif made.unsettled:
        whole += f": {told(made.unsettled, FRAME)}"
    elif not made.observable:
        whole += f", not observable at this aperture: no carriers in this frame, cut at the {whose} prediction"
    elif (
        made.carriers_found == 0
        and not made.doubts
        and (odds := (field.attributes.get("mask_place") or {}).get("nats", 0.0)) > 0
    ):
        whole += f": the stop averages them away, and parallax shows the mask (log odds {odds:.0f})"
    elif made.carriers_found == 0:
        whole += (
            f": no carriers in this frame, cut at the {whose} prediction; unless it was taken near the mask's ideal "
            "aperture, mask, camera or focal length are not the right ones"
        )
    if made.search is not None and made.search.found is not None:
        whole += f", by the law {field.attributes['law']} ({made.search.sentence})"
    if words := views_words(field):
        whole += f"; {words}"
    return whole
