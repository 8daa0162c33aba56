"""The curve of sRGB (IEC 61966-2-1): linear light for programs, coded values for people."""

from __future__ import annotations

from functools import cache

import numpy as np
from numpy.typing import NDArray

_FINE = 1 << 20  # steps of linear light in the table of coded values: next to black one is 0.8 of a level of 16 bits


def encoded(linear: NDArray[np.floating]) -> NDArray[np.floating]:
    """Coded values of linear ones from 0 to 1, of any shape; NaN stays NaN."""
    return np.where(linear <= 0.0031308, 12.92 * linear, 1.055 * linear ** (1 / 2.4) - 0.055)


def decoded(coded: NDArray[np.floating]) -> NDArray[np.floating]:
    """Linear values of coded ones from 0 to 1, of any shape; NaN stays NaN."""
    return np.where(coded <= 0.04045, coded / 12.92, ((coded + 0.055) / 1.055) ** 2.4)


def sixteen(linear: NDArray[np.floating]) -> NDArray[np.uint16]:
    """Coded values of linear ones, of any shape, in 16 bits and at most one level from the nearest; what is beyond 0 or
    1 is cut there, NaN is black."""
    at = np.asarray(linear * np.float32(_FINE), dtype=np.float32)
    np.fmax(at, np.float32(0), out=at)
    np.minimum(at, np.float32(_FINE), out=at)
    at += np.float32(0.5)
    return np.asarray(np.take(_coded(), at.astype(np.intp)))


def eight(coded: NDArray[np.uint16]) -> NDArray[np.uint8]:
    """The nearest of 8 bits to coded values in 16."""
    return np.asarray(np.take(_eights(), coded))


@cache
def _coded() -> NDArray[np.uint16]:
    return np.asarray(np.round(encoded(np.arange(_FINE + 1) / _FINE) * 65535), dtype=np.uint16)


@cache
def _eights() -> NDArray[np.uint8]:
    return np.asarray((np.arange(65536) + 128) // 257, dtype=np.uint8)
