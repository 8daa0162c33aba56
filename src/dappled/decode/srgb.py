"""The curve of sRGB (IEC 61966-2-1): linear light for programs, coded values for people."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray


def encoded(linear: NDArray[np.floating]) -> NDArray[np.floating]:
    """Coded values of linear ones from 0 to 1, of any shape; NaN stays NaN."""
    return np.where(linear <= 0.0031308, 12.92 * linear, 1.055 * linear ** (1 / 2.4) - 0.055)


def decoded(coded: NDArray[np.floating]) -> NDArray[np.floating]:
    """Linear values of coded ones from 0 to 1, of any shape; NaN stays NaN."""
    return np.where(coded <= 0.04045, coded / 12.92, ((coded + 0.055) / 1.055) ** 2.4)
