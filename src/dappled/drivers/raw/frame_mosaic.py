"""A frame's linear values at the places of their samples, each with its colour."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from dappled.decode import srgb
from dappled.decode.picture.blocks import EMPTY, MosaicPlane
from dappled.decode.spectrum import plane as planes
from dappled.drivers.raw.raw_file import WHITE_SHARE, RawFile, shares_of_white


def mosaic_of(
    raw: RawFile, most_px: int | None = None, *, staggered: bool, dark: NDArray[Any] | None = None
) -> tuple[MosaicPlane, tuple[int, int]]:
    """A frame's linear values with its colours as they are, of a `staggered` chip its samples at their places, and the
    row and column that they begin at. With `most_px` its middle of at most so many pixels on a side."""
    cfa, black = raw.colour_pattern()
    pattern = np.zeros((1, 1), dtype=np.intp) if cfa is None else np.asarray(cfa, dtype=np.intp)
    wide = 2 if staggered else 1
    top, left = (
        0 if most_px is None else max(0, -(-(side - most_px // across) // (4 * step))) * 2 * step
        for side, step, across in zip(raw.mosaic.shape, pattern.shape, (1, wide), strict=True)
    )
    inner = slice(top, raw.mosaic.shape[0] - top), slice(left, raw.mosaic.shape[1] - left)
    part = replace(raw, mosaic=raw.mosaic[inner])
    ones = np.ones(int(pattern.max()) + 1)
    dark = None if dark is None else dark[inner]
    plane = planes.to_plane(part.mosaic, black=black, white=raw.white, cfa=cfa, balance=ones, dark=dark)
    if raw.developed:
        plane = np.asarray(srgb.decoded(np.clip(plane, 0, 1)), dtype=np.float32)
    good = shares_of_white(part, 1) < WHITE_SHARE
    valid = None if good.all() else good
    if staggered:
        plane, pattern = _spread(plane), _spread_pattern(pattern)
        valid = None if valid is None else _spread(valid)
    return MosaicPlane(plane, pattern, valid), (top, wide * left)


def _spread(values: NDArray[Any]) -> NDArray[Any]:
    """A staggered chip's samples at their places, on twice as many columns; what is between is 0."""
    wide = np.zeros((values.shape[0], 2 * values.shape[1]), dtype=values.dtype)
    wide[0::2, 0::2], wide[1::2, 1::2] = values[0::2], values[1::2]
    return wide


def _spread_pattern(pattern: NDArray[np.intp]) -> NDArray[np.intp]:
    rows = pattern if len(pattern) % 2 == 0 else np.tile(pattern, (2, 1))
    wide = np.full((len(rows), 2 * rows.shape[1]), EMPTY, dtype=np.intp)
    wide[0::2, 0::2], wide[1::2, 1::2] = rows[0::2], rows[1::2]
    return wide
