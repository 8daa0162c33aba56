"""The decoded light field as one value; its files are laid out in the same words."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from numpy.typing import NDArray


@dataclass(frozen=True, slots=True)
class LightField:
    """Slices and views of one frame.

    `slices` complex64 (K, h, w): DC first, then the orders lexicographically greater than (0, 0).
    `carriers` float64 (K, 4): rows [ky, kx, fy, fx], cycles/pixel.
    `views` float32 (V, U, h, w) or (V, U, h, w, 3): linear, 1.0 = sensor white.
    `view_offsets` float64 (V, U, 2): the aperture point (v, u) of each view as a share of the full aperture,
    −0.5 to 0.5.
    `grid` float64 (2, 3): from (y, x, 1) of a view to sensor (row, column).
    `attributes`: frame shape, camera, mask, law, focal length, f-number, calibration, software version, and
    pose where known.
    """

    slices: NDArray[np.complex64]
    carriers: NDArray[np.float64]
    views: NDArray[np.float32]
    view_offsets: NDArray[np.float64]
    grid: NDArray[np.float64]
    attributes: Mapping[str, Any] = field(default_factory=dict)
