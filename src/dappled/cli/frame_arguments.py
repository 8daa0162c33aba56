"""Arguments of verbs that decode frames: which frames, by which camera, mask and files; and going over them."""

from __future__ import annotations

import os
from collections.abc import Callable, Mapping, Sequence
from contextlib import closing
from dataclasses import dataclass, fields
from functools import partial
from pathlib import Path
from typing import Any

from dappled import picture_order
from dappled.cli.table import words_only
from dappled.cli.verb import Output, Report, argument, option
from dappled.config.settings import LAW_NAMES
from dappled.errors import CallError, DappledError, counted
from dappled.findings import Finding, Level, first_by_name, worst

if not words_only:
    from dappled.drivers.raw.recipe import Recipe
    from dappled.drivers.raw.recipe import of_flight as recorded_recipe
    from dappled.flight import layout
    from dappled.products import processes

# No JPEG: beside a raw file it is the same picture again. One that is named is taken.
FRAME_SUFFIXES = (".arw", ".cr2", ".dng", ".lfp", ".lfr", ".nef", ".npy", ".png", ".raf", ".tif", ".tiff")
FRAME_HELP = "frame: RAF, CR2, DNG, LFP, TIFF, PNG or NPY; or a folder of frames, or a flight"


@dataclass(frozen=True, kw_only=True)
class RecipeArguments:
    """How frames are decoded: camera, mask and law, and the files and numbers that go with a frame."""

    camera: str = option("--camera", "camera profile or TOML file", "auto", otherwise="the one that fits the frame")
    mask: str | None = option("--mask", "mask profile or TOML file, or lenslet", None)
    law: str = option("--law", "carrier law", "", choices=LAW_NAMES, otherwise="the camera's")
    calibration: str = option("--calibration", "file written by dappled calibrate", "", metavar="FILE", there=True)
    white: str = option("--white", "white frame", "", metavar="FILE", there=True)
    dark: str = option("--dark", "dark frame", "", metavar="FILE", there=True)
    cfa: str = option("--cfa", "colour pattern, row by row, if the file has none", "", metavar="BGGR")
    black: float | None = option("--black", "black level, if the file doesn't say", None)
    white_level: float | None = option("--white-level", "level of a full pixel (a 12-bit PNG: 4095)", None, above=0.0)
    focal_length: float | None = option(
        "--focal-length", "focal length, if the file doesn't say", None, unit="mm", above=0.0,
    )  # fmt: skip
    f_number: float | None = option("--f-number", "f-number of the exposure, if the file doesn't say", None, above=0.0)

    def recipe(self, *, colour: bool = False, taper: float = 0.0) -> Recipe:
        """The recipe that these arguments name. Raises CallError where black is not below white."""
        if self.black is not None and self.white_level is not None and self.black >= self.white_level:
            raise CallError(f"--black {self.black:g} is not below --white-level {self.white_level:g}")
        return Recipe(
            camera=self.camera,
            mask=self.mask or "",
            law=self.law,
            calibration=self.calibration,
            white=self.white,
            dark=self.dark,
            workers=2,
            cfa=self.cfa,
            black=self.black,
            white_level=self.white_level,
            colour=colour,
            taper=taper,
            try_laws=not self.law,
            keep_law=bool(self.law),
        )


@dataclass(frozen=True, kw_only=True)
class FramesArguments(RecipeArguments):
    """Frames, of which those of a flight bring its recipe along."""

    frames: tuple[Path, ...] = argument("FRAME", FRAME_HELP, there=True)
    mask: str | None = option(
        "--mask", "mask profile or TOML file, or lenslet", None, otherwise="that of the flight that the frames are of",
    )  # fmt: skip


def frames(given: Sequence[Path]) -> list[Path]:
    """The frames that were named, and those in the folders that were: of a flight, those in its folder of frames.

    Raises CallError for a folder without frames.
    """
    found: list[Path] = []
    for path in given:
        if not path.is_dir():
            found.append(path)
            continue
        flight = (path / "flight.toml").is_file()
        folder = path / "frames" if flight else path
        inside = picture_order.by_name(
            (one for one in folder.iterdir() if _is_frame(one) and (not flight or one.stem.isdigit())), Path.as_posix
        )
        if not inside:
            kinds = ", ".join(FRAME_SUFFIXES)
            raise CallError(f"{folder} holds no frame ({kinds}): name frames, a folder of frames, or a flight")
        found += inside
    return found


def recorded(given: Sequence[Path], asked: Recipe) -> Recipe:
    """The recipe by which the flight that these frames belong to was decoded, with what was asked for in its place.

    Frames belong to a flight if they, their folder or the flight itself is named. Where a mask is asked for, the recipe
    is the one that was asked for. Raises CallError for frames of two flights, or of none, if no mask is named.
    """
    if asked.mask:
        return asked
    flights = {flight_of(path.resolve()) for path in given}
    if len(flights) > 1:
        raise CallError("these are not the frames of one flight: give --mask, or decode each flight by itself")
    (flight,) = flights
    if flight is None:
        raise CallError("no mask is named: give --mask P (only frames in the folder of a flight bring one along)")
    facts = layout.read_facts(layout.open_folder(flight))
    untouched = Recipe(camera="auto", mask="")
    changed = {one.name for one in fields(Recipe) if getattr(asked, one.name) != getattr(untouched, one.name)}
    made = recorded_recipe(flight, facts, {name: getattr(asked, name) for name in changed})
    if made is None:
        raise CallError(f"{flight} was recorded without a mask: give --mask P")
    return made


def flight_of(path: Path) -> Path | None:
    """The flight that a folder is, or that a file or a folder of frames lies in."""
    return next((one for one in (path, *path.parents[:2]) if (one / "flight.toml").is_file()), None)


def refuse_same_names(frames: Sequence[Path], folder: Path, suffix: str) -> None:
    """Two frames of one name would overwrite each other's results. Raises CallError."""
    first: dict[str, Path] = {}
    for frame in frames:
        other = first.setdefault(frame.stem, frame)
        if other is not frame:
            raise CallError(
                f"{other} and {frame} would both be written as {folder / frame.stem}{suffix}: "
                "decode them into two folders"
            )


def _is_frame(path: Path) -> bool:
    """Whether a name is a frame's. Hidden ones are what other systems leave on cards, or half-written."""
    return path.suffix.lower() in FRAME_SUFFIXES and not path.name.startswith(".") and path.is_file()


@dataclass(frozen=True, slots=True)
class FrameMade:
    """What is told of a frame of which something was made: what was found, its row as values and as lines."""

    findings: tuple[Finding, ...]
    values: Mapping[str, Any]
    lines: tuple[str, ...]


@dataclass(frozen=True, kw_only=True)
class Several:
    """Work on several frames at a time."""

    workers: int = option("--workers", "number of processes", os.cpu_count() or 1, low=1, otherwise="one per core")


def each_frame(
    frames: Sequence[Path],
    output: Output,
    make: Callable[[Path], FrameMade],
    *,
    crew: processes.Crew,
    into_folder: bool,
    failure: str,
) -> Report:
    """Make something of each frame, in the processes of a crew: one that fails is told, and the others go on.

    `failure` says what became of the frames that failed. Raises the DappledError of a frame that goes to no folder.
    """
    bad = 0
    found: dict[Path, Sequence[Finding]] = {}
    answers = crew.in_order(frames, partial(processes.tried, make) if into_folder else make, _lost)
    with closing(answers):
        for frame, made in zip(output.each(frames), answers, strict=True):
            if isinstance(made, FrameMade):
                found[frame] = made.findings
                output.row(made.values, *made.lines)
                continue
            bad += 1
            output.warn(str(made))
            output.row({"frame": str(frame), "error": str(made)})
    of_all = counted(len(frames), "frame")
    if bad:
        output.remark(f"{bad} of {of_all} {failure}")
    if not into_folder:
        return Report(findings=[one for each in found.values() for one in each])
    doubted = sum(worst(each) > Level.NOTE for each in found.values())
    told = first_by_name((frame.stem, each) for frame, each in found.items())
    return Report(findings=told, extent=f"{doubted} of {of_all}", failed=bool(bad))


def _lost(frame: Path, why: str) -> DappledError:
    return DappledError(f"{frame} {why}")
