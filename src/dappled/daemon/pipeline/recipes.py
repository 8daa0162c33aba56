"""Make a decoding recipe from settings or from a recorded flight, and keep copies of its files in the flight.

A flight keeps its own calibration, white and dark frame and profiles, so that it can be decoded the same way when the
originals have changed.
"""

from __future__ import annotations

import platform
import sys
from dataclasses import dataclass, replace
from importlib import metadata, resources
from pathlib import Path
from typing import Any

from dappled import durable
from dappled.config import profiles
from dappled.config.settings import Settings
from dappled.drivers.raw import recipe_check
from dappled.drivers.raw.recipe import FILES, FOLDER, Recipe, camera_name, of_flight
from dappled.errors import DappledError

__all__ = ["FOLDER", "Names", "called", "keep", "names", "of_flight", "recipe", "versions"]
_LIBRARIES = ("numpy", "scipy", "rawpy", "pyzmq", "pymavlink", "gphoto2", "pillow", "tifffile")


@dataclass(frozen=True, slots=True)
class Names:
    """What headers and tags call camera, mask and carrier law. `camera` "auto" takes the model that the frame names."""

    camera: str
    mask: str
    law: str


def recipe(settings: Settings) -> tuple[Names, Recipe | None]:
    """What frames will be called, and how they are decoded: None where that isn't asked for or no mask is named.

    Raises DappledError when a named profile or file isn't right.
    """
    names = called(settings)
    if not settings.decode.enabled or not settings.mask.profile:
        return names, None
    made = Recipe(
        camera=settings.camera.profile,
        mask=settings.mask.profile,
        law=settings.decode.law,
        calibration=settings.decode.calibration,
        white=settings.decode.white,
        dark=settings.decode.dark,
        workers=settings.decode.workers,
        try_laws=True,
    )
    recipe_check.check(made)
    return names, made


def called(settings: Settings) -> Names:
    """What frames will be called. Raises DappledError when the named camera profile isn't right."""
    return Names(
        camera=settings.camera.profile
        if settings.camera.profile == "auto"
        else camera_name(settings.camera.profile, None),
        mask=Path(settings.mask.profile).stem if settings.mask.profile else "",
        law=_law(settings),
    )


def keep(made: Recipe, flight: Path, run: str = "") -> Recipe:
    """The same recipe with its files and profiles copied into the flight, those of a later run into a folder of its
    name. Raises DappledError when the disk refuses."""
    folder = flight / FOLDER / run
    try:
        durable.make_folder(folder)
        kept: dict[str, Any] = {name: _copy(getattr(made, name), folder, name) for name in FILES if getattr(made, name)}
        kept["camera"] = _copy_profile(made.camera, folder, "cameras")
        kept["mask"] = _copy_profile(made.mask, folder, "masks")
    except OSError as error:
        raise DappledError(f"the decoder's inputs can't be copied to {folder}: {error.strerror}") from None
    return replace(made, **kept)


def names(made: Recipe | None) -> Names:
    """What a replay by another recipe calls things."""
    if made is None:
        return Names("auto", "", "")
    return Names(
        made.camera if made.camera == "auto" else camera_name(made.camera, None), Path(made.mask).stem, made.law
    )


def versions() -> dict[str, str]:
    """What the last bits of the results depend on: libraries, and the processor."""
    machine = {"machine": platform.machine(), "processor": _processor()}
    return {"python": sys.version.split()[0], **{name: metadata.version(name) for name in _LIBRARIES}, **machine}


def _processor() -> str:
    """The processor's name where Linux tells it: libraries choose their code by it."""
    try:
        for line in Path("/proc/cpuinfo").read_text().splitlines():
            if line.startswith("model name"):
                return line.partition(":")[2].strip()
    except (OSError, ValueError):
        pass
    return ""


def _law(settings: Settings) -> str:
    if settings.decode.law or settings.camera.profile == "auto":
        return settings.decode.law
    return profiles.camera(settings.camera.profile).law


def _copy(source: str, folder: Path, name: str) -> str:
    target = folder / f"{name}{Path(source).suffix}"
    durable.write_file(target, durable.read_plain(Path(source)))
    return str(target)


def _copy_profile(profile: str, folder: Path, kind: str) -> str:
    """A copy of the profile under its own name; a name that is not a file ("auto", "lenslet") stays as it is."""
    if profile in ("auto", profiles.LENSLET):
        return profile
    target = folder / kind / f"{Path(profile).stem}.toml"
    durable.make_folder(target.parent)
    shipped = resources.files("dappled.config") / "profiles" / kind / f"{profile}.toml"
    source = Path(profile) if profile.endswith(".toml") else shipped
    durable.write_file(target, source.read_bytes())
    return str(target)
