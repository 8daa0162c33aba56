"""Read and write calibrations: a TOML file and an NPZ file with the same as arrays; either is enough."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import tomli_w

from dappled.bounds.arrays import read_npz
from dappled.bounds.parsing import parse_toml
from dappled.config.schema import ConfigError, read_toml
from dappled.decode import DecodeError
from dappled.decode.calibration import Calibration
from dappled.errors import first_line

_TEXT = "calibration_toml"


def save(path: Path, found: Calibration, more: dict[str, Any] | None = None) -> tuple[Path, Path]:
    """Write both files; `path` names either. `more` are tables beside the calibration. Returns both paths."""
    text = tomli_w.dumps({**found.to_dict(), **(more or {})})
    toml, npz = path.with_suffix(".toml"), path.with_suffix(".npz")
    toml.write_text(text, encoding="utf-8")
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
    np.savez(npz, **arrays)  # type: ignore[arg-type]  # savez takes whatever asarray takes
    return toml, npz


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
