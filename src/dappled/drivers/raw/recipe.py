"""How frames are to be decoded, as a person names it, and what that says of a frame in its file's stead."""

from __future__ import annotations

import math
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from dappled.config import profiles
from dappled.decode.errors import DecodeError
from dappled.drivers.raw import reading
from dappled.drivers.raw.reading import RawFile
from dappled.errors import DappledError


class DarkroomError(DappledError):
    """A frame or a recipe can't be decoded; one sentence."""


@dataclass(frozen=True, slots=True)
class Recipe:
    """What decoding needs to know, as a person names it; see the configuration's [camera], [mask] and [decode].

    `camera` a profile, a TOML file or "auto" (by the frame's model); `mask` a profile, a TOML file or "lenslet";
    `law` "" takes the camera's; the files are "" where there are none.
    `cfa` (as "BGGR", row by row), `black` and `white_level` are for files that don't say so themselves. `colour` asks
    for views in red, green and blue; `taper`, 0 to 1, for slices whose bands fall off softly (printed masks).
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
    """A frame's file, with what the recipe says about it. Raises DappledError."""
    return said(reading.read(Path(path)), recipe)


def said(raw: RawFile, recipe: Recipe) -> RawFile:
    """What a file says, with what the recipe says instead. Raises DarkroomError for a pattern that is none."""
    changed: dict[str, Any] = {}
    if recipe.cfa:
        side = math.isqrt(len(recipe.cfa))
        pattern = recipe.cfa.upper()
        if side < 2 or side * side != len(pattern) or set(pattern) != set("RGB"):
            raise DarkroomError(
                f"--cfa {recipe.cfa} is no colour pattern: name its letters R, G, B row by row, as in BGGR"
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


def camera_name(camera: str, model: str | None) -> str:
    """What a camera is called: its profile, by name or by model; else the model, or "unknown"."""
    if camera != "auto":
        return Path(camera).stem if camera.endswith(".toml") else camera
    found = profiles.camera_for_model(model or "")
    return found.name if found else model or "unknown"


@contextmanager
def naming(path: Path | str) -> Iterator[None]:
    """Around mathematics on a frame: its errors get the file's name."""
    try:
        yield
    except DecodeError as error:
        raise DarkroomError(f"{path}: {error}") from error
