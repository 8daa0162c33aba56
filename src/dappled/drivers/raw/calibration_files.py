"""Read and write calibrations: a TOML file and an NPZ file with the same as arrays; either is enough."""

from __future__ import annotations

import io
from pathlib import Path
from typing import Any

import numpy as np
import tomli_w

from dappled import durable
from dappled.bounds.arrays import read_npz
from dappled.bounds.parsing import parse_toml
from dappled.config import profiles
from dappled.config.schema import ConfigError, read_toml
from dappled.decode import DecodeError
from dappled.decode.calibration import Calibration
from dappled.drivers.raw.recipe import Recipe
from dappled.errors import first_line
from dappled.findings import Code, Finding, Subject, finding

_TEXT = "calibration_toml"
_RECIPE = Subject("recipe")


def save(path: Path, found: Calibration, more: dict[str, Any] | None = None) -> tuple[Path, Path]:
    """Write both files, each whole or not at all; `path` names either. `more` are tables beside the calibration.

    Returns both paths. Raises OSError."""
    text = tomli_w.dumps({**found.to_dict(), **(more or {})})
    toml, npz = pair(path)
    arrays = {
        _TEXT: np.array(text),
        "orders": np.array(found.mask.half_orders()),
        "focal_length_mm": np.array([fit.focal_length_mm for fit in found.fits]),
        "lattice": np.array([fit.lattice.matrix() for fit in found.fits]),
        "origin": np.array([fit.origin for fit in found.fits]),
        "rotation_rad": np.array([fit.rotation_rad for fit in found.fits]),
        "mask_distance_mm": np.array([fit.mask_distance_mm for fit in found.fits]),
        "transfer": np.array([fit.transfer for fit in found.fits]),
    }
    packed = io.BytesIO()
    np.savez(packed, **arrays)  # type: ignore[arg-type]  # savez takes whatever asarray takes
    durable.write_file(npz, packed.getvalue())
    durable.write_file(toml, text.encode())  # last: it is the one that settings name
    return toml, npz


def pair(path: Path) -> tuple[Path, Path]:
    """Both files of a calibration; `path` names either."""
    return path.with_suffix(".toml"), path.with_suffix(".npz")


def tables(path: Path) -> dict[str, Any]:
    """Return all tables of a calibration file, TOML or NPZ. Raises ConfigError where it can't be read."""
    if path.suffix.lower() != ".npz":
        return read_toml(path)[0]
    try:
        return parse_toml(str(read_npz(path, [_TEXT])[_TEXT]))
    except FileNotFoundError as error:
        raise ConfigError(f"no calibration at {path}: check the path") from error
    except Exception as error:  # zipfile and numpy raise anything on damaged bytes
        raise ConfigError(
            f"{path} is not a calibration: make one with dappled calibrate ({first_line(error)})"
        ) from error


def load(path: Path) -> Calibration:
    """Read a calibration file. Raises ConfigError where it is not one."""
    try:
        return Calibration.from_dict(tables(path))
    except DecodeError as error:
        raise ConfigError(f"{path}: {error}") from error


def misfit(recipe: Recipe, model: str = "") -> Finding | None:
    """Why the calibration (fact `file`) can't be used: it is for another mask, law or frame size. None where it can,
    or there is none.

    The frame size is judged where the camera is known: by its profile, or by the body's `model`. Raises ConfigError
    where a file is missing or wrong.
    """
    path = recipe.calibration
    if not path or recipe.mask == profiles.LENSLET:
        return None
    known, mask = load(Path(path)), profiles.mask(recipe.mask)
    if known.mask != mask.mask:
        return finding(Code.CALIBRATION_OTHER_MASK, _RECIPE, file=path, mask=mask.name)
    if recipe.law and known.law != recipe.law:
        return finding(Code.CALIBRATION_OTHER_LAW, _RECIPE, file=path, made_by=known.law, law=recipe.law)
    camera = profiles.camera_for_model(model) if recipe.camera == "auto" else profiles.camera(recipe.camera)
    if camera is None or known.shape in camera.shapes():
        return None
    height, width = known.shape
    code = Code.CALIBRATION_OTHER_SIZE
    return finding(code, _RECIPE, file=path, camera=camera.name, height_px=height, width_px=width)
