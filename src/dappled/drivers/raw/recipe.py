"""Recipes: how frames are decoded, by the settings or the options of a command, or as a recorded flight was."""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass, replace
from functools import lru_cache
from pathlib import Path
from typing import Any

import numpy as np

from dappled.config import profiles
from dappled.config.profiles import CameraProfile
from dappled.decode import DecodeError
from dappled.drivers.raw import reading
from dappled.drivers.raw.reading import RawFile
from dappled.errors import DappledError

FOLDER = "inputs"
"""The folder of a flight that keeps copies of the recipe's files and profiles."""
FILES = ("calibration", "white", "dark")
"""The fields of a recipe that name files."""


class DarkroomError(DappledError):
    """A frame or a recipe can't be decoded; one sentence."""


@dataclass(frozen=True, slots=True)
class Recipe:
    """What decoding needs to know; see [camera], [mask] and [decode] of the settings.

    `camera` a profile, a TOML file or "auto" (by the frame's model); `mask` a profile, a TOML file or "lenslet";
    `law` "" takes the camera's; a file is "" where there is none.
    `cfa` (as "BGGR", row by row), `black` and `white_level` are for files that don't contain them. `colour` makes
    views in red, green and blue; `taper`, 0 to 1, makes the bands of a printed mask's slices fall off softly.
    """

    camera: str
    mask: str
    law: str = ""
    calibration: str = ""
    white: str = ""
    dark: str = ""
    workers: int = 1
    cfa: str = ""
    black: float | None = None
    white_level: float | None = None
    colour: bool = False
    taper: float = 0.0


def read(path: Path | str, recipe: Recipe) -> RawFile:
    """Read a frame's file, with the values that the recipe overrides. Raises DappledError."""
    return override(reading.read(Path(path)), recipe)


def override(raw: RawFile, recipe: Recipe) -> RawFile:
    """Replace the values that the recipe gives. Raises DarkroomError for a wrong colour pattern."""
    changed: dict[str, Any] = {}
    if recipe.cfa:
        side = math.isqrt(len(recipe.cfa))
        pattern = recipe.cfa.upper()
        if side < 2 or side * side != len(pattern) or set(pattern) != set("RGB"):
            raise DarkroomError(
                f"--cfa {recipe.cfa} is not a colour pattern: give its letters R, G, B row by row, as in BGGR"
            )
        changed["cfa"] = np.array(["RGB".index(letter) for letter in pattern], dtype=np.int64).reshape(side, side)
        changed["colour_names"] = ("R", "G", "B")
        changed["balance"] = None
        if isinstance(raw.black, tuple):
            changed["black"] = max(raw.black)
    if recipe.black is not None:
        changed["black"] = recipe.black
    if recipe.white_level is not None:
        changed["white"] = recipe.white_level
    return replace(raw, **changed) if changed else raw


def of_flight(flight: Path, facts: Mapping[str, Any], overrides: Mapping[str, Any]) -> Recipe | None:
    """Return the recipe that a recorded flight was decoded by, with the flight's own copies of its files.

    `facts` are those of flight.toml. `overrides` that are not None replace fields. None where no mask is named.
    """
    settings = facts.get("settings", {})
    decode, folder = settings.get("decode", {}), flight / FOLDER
    files: dict[str, Any] = {name: _kept(decode.get(name, ""), folder, name) for name in FILES}
    made = Recipe(
        camera=_kept_profile(settings.get("camera", {}).get("profile", "auto"), folder, "cameras"),
        mask=_kept_profile(settings.get("mask", {}).get("profile", ""), folder, "masks"),
        law=decode.get("law", ""),
        workers=decode.get("workers", 1),
        **files,
    )
    made = replace(made, **{name: value for name, value in overrides.items() if value is not None})
    return made if made.mask else None


def _kept(named: str, folder: Path, name: str) -> str:
    return str(folder / f"{name}{Path(named).suffix}") if named else ""


def _kept_profile(profile: str, folder: Path, kind: str) -> str:
    copy = folder / kind / f"{Path(profile).stem}.toml"
    return str(copy) if copy.is_file() else profile


@lru_cache(maxsize=64)  # each frame asks, and finding a model reads every profile
def camera_name(camera: str, model: str | None) -> str:
    """Return what a camera is called: its profile, by name or by model; else the model, or "unknown"."""
    if camera != "auto":
        return Path(camera).stem if camera.endswith(".toml") else camera
    found = profiles.camera_for_model(model or "")
    return found.name if found else model or "unknown"


def camera_profile(recipe: Recipe, model: str) -> CameraProfile:
    """Return the camera's profile: the recipe's, or by model. Raises DarkroomError where no profile knows the model."""
    if recipe.camera != "auto":
        return profiles.camera(recipe.camera)
    found = profiles.camera_for_model(model)
    if found is None:
        named = f"the frame says {model!r}" if model else "the frame names no camera"
        raise DarkroomError(f"which camera? {named}, and no profile knows it: name one with --camera")
    return found


@contextmanager
def naming(path: Path | str) -> Iterator[None]:
    """Context in which a DecodeError becomes a DarkroomError with the file's name."""
    try:
        yield
    except DecodeError as error:
        raise DarkroomError(f"{path}: {error}") from error
