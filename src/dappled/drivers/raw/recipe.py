"""What frames are decoded by: camera, mask, law and files, as asked for, decided, or kept by a recorded flight."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from functools import lru_cache
from pathlib import Path
from typing import Any

from dappled import codec, confined
from dappled.config import profiles
from dappled.decode.optics import LAWS
from dappled.errors import DappledError
from dappled.findings import FRAME, Code, Finding, finding

FOLDER = "inputs"
"""The folder of a flight that keeps copies of the recipe's files and profiles."""
FILES = ("calibration", "white", "dark")
"""The fields of a recipe that name files."""
DECISION = "law_decision"
"""The entry of flight.toml that holds a LawDecision."""


@dataclass(frozen=True, slots=True)
class LawDecision:
    """The law that the frames of a flight obey, where it is not the configured one or stands elsewhere.

    `ratio` is the lattice that was found over the law's prediction, row by row: a print of another scale, turned.
    `first` is the index of the frame that decided: it and those after it are decoded by this law. `sentence` says why.
    """

    law: str
    ratio: tuple[float, float, float, float]
    first: int
    sentence: str

    def __post_init__(self) -> None:
        """Raises ValueError for an unknown law."""
        if self.law not in LAWS:
            raise ValueError(f"the law {self.law!r} is unknown")

    @property
    def found(self) -> Finding:
        """It as a finding, for ledger and pilot."""
        return finding(Code.DECODE_LAW_DECIDED, FRAME, law=self.law, frame=self.first)


@dataclass(frozen=True, slots=True)
class Recipe:
    """What decoding needs to know; see [camera], [mask] and [decode] of the settings.

    `camera` a profile, a TOML file or "auto" (by the frame's model); `mask` a profile, a TOML file or "lenslet";
    `law` "" takes the camera's; a file is "" where there is none.
    `cfa` (as "BGGR", row by row), `black` and `white_level` are for files that don't contain them. `colour` makes
    views in red, green and blue; `taper`, 0 to 1, makes the bands of a printed mask's slices fall off softly.
    With `try_laws` a frame without carriers at the prediction is searched near those of all laws, and decoded where
    they stand; with `keep_law` it is only checked, and decoded by `law` (see `law_check`). `decided` is what
    such a search has decided for a whole flight: its law goes before `law` and a calibration.
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
    try_laws: bool = False
    keep_law: bool = False
    decided: LawDecision | None = None

    def shared_by(self, processes: int) -> Recipe:
        """The recipe of each of so many processes: where there are several, each has one thread."""
        return self if processes == 1 else replace(self, workers=1)


def of_flight(flight: Path, facts: Mapping[str, Any], overrides: Mapping[str, Any]) -> Recipe | None:
    """Return the recipe that a recorded flight was decoded by, with the flight's own copies of its files.

    `facts` are those of flight.toml; the law that the flight decided on is kept, unless another law, mask, camera or
    calibration is asked for. `overrides` that are not None replace fields. None where no mask is named.
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
    changed = {name: value for name, value in overrides.items() if value is not None}
    if not any(changed.get(name) for name in ("law", "mask", "camera", "calibration")):
        made = replace(made, decided=_decided(flight, facts))
    made = replace(made, **changed)
    return made if made.mask else None


def _decided(flight: Path, facts: Mapping[str, Any]) -> LawDecision | None:
    try:
        return codec.read(LawDecision, facts[DECISION]) if DECISION in facts else None
    except codec.CodecError as error:
        raise DappledError(f"{flight}/flight.toml: the law that the flight decided on can't be read: {error}") from None


def _kept(named: str, folder: Path, name: str) -> str:
    return str(_inside(folder, f"{name}{Path(named).suffix}")) if named else ""


def _kept_profile(profile: str, folder: Path, kind: str) -> str:
    copy = _inside(folder, f"{kind}/{Path(profile).stem}.toml")
    return str(copy) if copy.is_file() else profile


def _inside(folder: Path, name: str) -> Path:
    """A file of the flight's own inputs. Raises OutsideError where a link leads out of them."""
    return confined.path(folder.parent, f"{folder.name}/{name}", f"the flight {folder.parent}")


@lru_cache(maxsize=64)  # each frame asks, and finding a model reads every profile
def camera_name(camera: str, model: str | None) -> str:
    """Return what a camera is called: its profile, by name or by model; else the model, or "unknown"."""
    if camera != "auto":
        return Path(camera).stem if camera.endswith(".toml") else camera
    found = profiles.camera_for_model(model or "")
    return found.name if found else model or "unknown"
