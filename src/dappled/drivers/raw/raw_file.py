"""What every kind of frame is read as: values, and what they mean."""

from __future__ import annotations

import mmap
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from dappled.drivers.raw.exif import Exposure

Source = Path | str | bytes | memoryview | mmap.mmap
Values = NDArray[np.uint8] | NDArray[np.uint16] | NDArray[np.float32] | NDArray[np.float64]


@dataclass(frozen=True, slots=True)
class RawFile:
    """A frame's values and what its file says about them; unknown is None.

    `mosaic` (H, W), uint8, uint16 or float, the visible part of the sensor, a copy. `black` and `white` in the same
    units; `black` is one number, or one for each colour index. `cfa` is an int array (a, b) of colour indices that
    repeats over the mosaic from its pixel (0, 0), or None for a single colour; `colour_names[i]` names index i.
    `balance` are the file's own white balance gains by colour index, green 1. `taken` is the camera's local time
    without a zone, ISO 8601. `focal_sigma_mm` is half of what the file rounds its focal length to.
    """

    mosaic: Values
    black: float | tuple[float, ...]
    white: float
    cfa: NDArray[np.int64] | None
    colour_names: tuple[str, ...]
    camera_make: str | None
    camera_model: str | None
    focal_length_mm: float | None
    f_number: float | None
    exposure_s: float | None
    iso: float | None
    taken: str | None
    balance: tuple[float, ...] | None
    focal_sigma_mm: float | None = None


def made(exposure: Exposure, mosaic: Values, **known: Any) -> RawFile:
    """A frame of these values, with what its file says of the exposure; `known` are the other fields."""
    return RawFile(
        mosaic=mosaic,
        camera_make=exposure.make,
        camera_model=exposure.model,
        focal_length_mm=exposure.focal_length_mm,
        f_number=exposure.f_number,
        exposure_s=exposure.exposure_s,
        iso=exposure.iso,
        taken=exposure.taken,
        focal_sigma_mm=exposure.focal_sigma_mm,
        **known,
    )
