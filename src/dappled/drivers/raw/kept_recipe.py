"""The recipe that a recorded flight was decoded by, from the copies of its files that the flight keeps."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any

from dappled.drivers.raw.recipe import Recipe

FOLDER = "inputs"
FILES = ("calibration", "white", "dark")


def of_flight(flight: Path, facts: Mapping[str, Any], overrides: Mapping[str, Any]) -> Recipe | None:
    """The recipe that a recorded flight was decoded by, its files from the flight's own copies; overrides on top."""
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
