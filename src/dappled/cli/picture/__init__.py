"""`dappled picture`: the photograph without the mask's shadow, at the sensor's own resolution."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import Any

from dappled import codec, durable, findings
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
from dappled.errors import CallError, counted

if not words_only:
    from dappled.cli.picture import places
    from dappled.drivers.raw.picture_maker import LensFrame, MadePicture, PictureMaker, ToldShadow, beside
    from dappled.drivers.raw.recipe import Recipe
    from dappled.products import processes
    from dappled.products.handover import picture_files, reflectance
    from dappled.products.handover.reflectance import ReflectancePanel, ReflectancePicture
    from dappled.products.maps.laboratory import ShadowAsked, laboratory, shadows

_PANEL = "reflectance"


def _rectangle(text: str) -> tuple[int, int, int, int]:
    try:
        left, top, right, bottom = (int(word) for word in text.split(","))
    except ValueError:
        raise ValueError(f"{text!r} is not four whole numbers: left,top,right,bottom") from None
    return left, top, right, bottom


@dataclass(frozen=True, kw_only=True)
class MakePictures(Overwriting, Doubtable, Several, FramesArguments, Verb):
    """Make photographs without the mask's shadow."""

    examples = (
        "dappled picture frame.cr2 --mask mask-2 -o frame.dng",
        "dappled picture FLIGHT -o pictures/ --as jpg    (by the flight's own mask, camera and calibration)",
        "dappled picture panel.dng --mask mask-2 -o panel.tif --panel 900,700,1100,860 --reflectance 0.5",
        "dappled picture FLIGHT -o reflectances/ --as tif --panel-file panel.panel.toml",
    )

    output: Path = option("-o --output", "picture (.dng, .tif, .jpg, .png); otherwise a folder", metavar="OUT")
    kind: str = option("--as", "kind of the pictures in a folder", "dng", choices=("dng", "tif", "jpg", "png"))
    sigma: bool = flag("--sigma", "write NAME.sigma.tif: each pixel's standard error, NaN where not trusted")
    panel: tuple[int, int, int, int] | None = option(
        "--panel", "a reflectance panel in the picture, in px: write its factors as NAME.panel.toml", None,
        metavar="LEFT,TOP,RIGHT,BOTTOM", parse=_rectangle, group=_PANEL,
    )  # fmt: skip
    reflectance: float | None = option(
        "--reflectance", "the panel's, as a share (0.5)", None, above=0.0, high=1.0, group=_PANEL
    )
    reflectance_sigma: float = option(
        "--reflectance-sigma", "standard error of --reflectance", 0.0, low=0.0, high=1.0, group=_PANEL
    )
    panel_file: Path | None = option(
        "--panel-file", "file written by --panel: TIFFs in reflectances", None, there=True, group=_PANEL
    )
    json: bool = flag("--json", "print one JSON object per frame")

    def check(self) -> None:
        if (self.panel is None) != (self.reflectance is None):
            raise CallError("--panel and --reflectance belong together")
        if self.panel_file is not None and self._suffix() not in (".tif", ".tiff"):
            raise CallError("reflectances are written as TIFF: name a .tif, or a folder and --as tif")
        PictureMaker(recorded(self.frames, self.recipe())).check()

    def _suffix(self) -> str:
        """The kind of the pictures, as a file's ending."""
        own = self.output.suffix.lower()
        return own if own in picture_files.SUFFIXES else f".{self.kind}"

    def run(self, output: Output) -> Report:
        recipe, found = recorded(self.frames, self.recipe()), frames(self.frames)
        panel = None if self.panel_file is None else reflectance.read(self.panel_file)
        if self.panel is not None and len(found) > 1:
            raise CallError(f"{counted(len(found), 'frame')} don't show one panel at one place: name its frame")
        suffix = self.output.suffix.lower()
        single = len(found) == 1 and suffix in picture_files.SUFFIXES
        if not single:
            if suffix in picture_files.SUFFIXES:
                raise CallError(f"{counted(len(found), 'frame')} can't all be {self.output}: name a folder")
            refuse_same_names(found, self.output, f".{self.kind}")
            durable.make_folder(self.output)

        workers = processes.worth(self.workers, len(found))
        recipe = recipe.shared_by(workers)
        near = beside([LensFrame(one, self.focal_length, self.f_number) for one in found])
        asked = {one.path: [ShadowAsked(recipe, other) for other in few] for one, few in near.items()}
        with processes.Crew(workers) as crew:
            shown = partial(output.show, "measure the mask's shadow")
            told = shadows((one for few in asked.values() for one in few), crew.in_order, shown)
            each = {path: tuple(told[one] for one in few if one in told) for path, few in asked.items()}
            make = _Picturing(self, recipe, single, panel, each)
            return each_frame(found, output, make, crew=crew, into_folder=not single, failure="gave no picture")

    def made(
        self,
        maker: PictureMaker,
        frame: Path,
        target: Path,
        panel: ReflectancePanel | None,
        told: Sequence[ToldShadow],
    ) -> FrameMade:
        """Make and write one picture. Raises DappledError."""
        errors, factors = target.with_suffix(".sigma.tif"), target.with_suffix(".panel.toml")
        self.refuse_existing(target, errors if self.sigma else None, None if self.panel is None else factors)
        made = maker.picture(frame, focal_length_mm=self.focal_length, f_number=self.f_number, told=told)
        measured = reflected = None
        if self.panel is not None and self.reflectance is not None:
            measured, more = reflectance.measured(
                made, str(frame), self.panel, reflectance=self.reflectance, sigma=self.reflectance_sigma
            )
            made = replace(made, findings=(*made.findings, *more))
        if panel is not None:
            reflected, more = reflectance.reflected(made, str(frame), panel)
            made = replace(made, findings=(*made.findings, *more))
        durable.write_file(target, picture_files.encoded(made, target.suffix, places.place_of(frame), reflected))
        if self.sigma:
            durable.write_file(errors, picture_files.sigma_file(made))
        if measured is not None:
            reflectance.write(measured, factors)
        values = _facts(target, made) | _panel_facts(measured, reflected)
        lines = f"{target}: {summary(made)}", *_panel_lines(measured, reflected)
        return FrameMade(tuple(made.findings), values, lines)


@dataclass(frozen=True)
class _Picturing:
    """Makes one picture after the other, in any process."""

    asked: MakePictures
    recipe: Recipe
    single: bool
    panel: ReflectancePanel | None
    told: Mapping[Path, Sequence[ToldShadow]]

    def __call__(self, frame: Path) -> FrameMade:
        """Make and write a frame's picture. Raises DappledError."""
        asked = self.asked
        target = asked.output if self.single else asked.output / f"{frame.stem}.{asked.kind}"
        maker = laboratory(self.recipe).pictures
        assert maker is not None  # it was checked
        return asked.made(maker, frame, target, self.panel, self.told[frame])


def _facts(target: Path, made: MadePicture) -> dict[str, Any]:
    """What the line of a frame says, for a program."""
    shadow = made.picture.shadow
    return {
        "file": str(target),
        "shape": list(made.picture.plane.shape),
        "shadow_from": shadow.source.value,
        "shadow_depth": shadow.depth,
        "shadow_alike": shadow.alike,
        "shadow_sigma": float(shadow.sigma.max()),
        "lattice": shadow.lattice.matrix().tolist(),
        "dark_share": made.picture.dark_share,
        "soft_share": made.picture.soft_share,
        "sure_noise_share": made.picture.sure_noise,
        "trusted_share": float(made.picture.trusted.mean()),
        "findings": [codec.plain(one) for one in findings.in_order(made.findings)],
    }


def summary(made: MadePicture) -> str:
    """Its size, and where its shadow is from."""
    rows, columns = made.picture.plane.shape
    shadow = made.picture.shadow
    flown = f"found in the frame and {shadow.alike} beside it"
    whose = {
        "frame": "found in the frame",
        "flight": flown,
        "white": "the white frame's",
        "calibration": "the calibration's",
    }
    if (told := whose.get(shadow.source.value)) is None:
        return f"{columns} × {rows} px; no shadow of the mask was seen"
    return (
        f"{columns} × {rows} px; the mask's shadow is {told}: it varies by {shadow.depth:.1%} of its mean, "
        f"known to {float(shadow.sigma.max()):.2%}"
    )


def _panel_facts(measured: ReflectancePanel | None, reflected: ReflectancePicture | None) -> dict[str, Any]:
    told: dict[str, Any] = {} if measured is None else {"panel": codec.plain(measured)}
    if reflected is not None:
        told |= {"steps_at_reflectance_1": reflectance.STEPS, "above_share": reflected.above_share}
    return told


def _panel_lines(measured: ReflectancePanel | None, reflected: ReflectancePicture | None) -> list[str]:
    lines = [
        f"  {one.name}: mean {one.mean:.4g} of white, standard deviation {one.deviation:.2g}, {one.pixels} px; "
        f"factor {one.factor:.4g} ± {one.factor_sigma:.2g}"
        for one in (() if measured is None else measured.colours)
    ]
    if reflected is not None:
        above = f"; {reflected.above_share:.1%} of the pixels are brighter than that holds"
        lines.append(f"  reflectance 1 is {reflectance.STEPS} of 65535{above if reflected.above_share > 0 else ''}")
    return lines
