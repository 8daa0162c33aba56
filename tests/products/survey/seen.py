"""Frames of textured ground with things above it, by rays: independent of how frames are refocused and swept."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from scipy import ndimage

from dappled.products.maps.eye import Eye
from dappled.products.maps.georeference import Survey
from dappled.products.maps.photographs import Photograph
from tests.products.maps.test_eye import eye_at
from tests.products.maps.test_map_grid import photograph, survey

Arrays = NDArray[np.float64]
Inside = Callable[[Arrays, Arrays], NDArray[np.bool_]]  # whether places (east, north) belong to a thing
HEIGHT_M = 30.0  # of the cameras
_TEXEL_M = 0.05
_TEXTURE = ndimage.gaussian_filter(np.random.default_rng(8).normal(size=(1024, 1024)), 2.0, mode="wrap")


def texture(east: Arrays, north: Arrays, shift: float = 0.0) -> Arrays:
    """The brightness of the ground: noise around 0.4, coarser than 0.2 m."""
    at = np.array([np.ravel(north), np.ravel(east)]) / _TEXEL_M + shift
    value = 0.4 + 0.1 * ndimage.map_coordinates(_TEXTURE / _TEXTURE.std(), at, order=1, mode="grid-wrap")
    return np.asarray(value.reshape(np.shape(east)))


def frame(eye: Eye, things: Sequence[tuple[float, Inside, float]] = ()) -> NDArray[np.float32]:
    """What an eye sees of ground at 0 m and of `things` (height, where, shift of the texture), the highest last."""
    rows, columns = eye.shape
    pixels = np.stack(np.meshgrid(np.arange(columns), np.arange(rows)), axis=-1).reshape(-1, 2).astype(float)
    met = eye.on_plane(pixels, 0.0)
    value = texture(met[:, 0], met[:, 1])
    for height, inside, shift in things:
        met = eye.on_plane(pixels, height)
        here = inside(met[:, 0], met[:, 1])
        value[here] = texture(met[here, 0], met[here, 1], shift) - (0.25 if shift < 0 else 0.0)
    return value.reshape(rows, columns).astype(np.float32)


def eyes(places: Sequence[tuple[float, float]], tilt_deg: float = 1.0) -> list[Eye]:
    """Cameras at places (east, north) from the first one's."""
    made = []
    for number, (east, north) in enumerate(places):
        one = eye_at(height_m=HEIGHT_M, tilt_deg=(tilt_deg, -tilt_deg * (number % 2), 0.0))
        made.append(replace(one, centre=one.centre + np.array([east, north, 0.0])))
    return made


def folder(parent: Path) -> str:
    """A flight's folder with nothing in it but an empty ledger."""
    (parent / "flight").mkdir()
    (parent / "flight" / "flight.sqlite").touch()
    return str(parent / "flight")


def flown(
    places: Sequence[tuple[float, float]], things: Sequence[tuple[float, Inside, float]] = (), gsd_m: float = 0.06
) -> Survey:
    """A survey of such frames, with true poses."""
    return survey(*(_photo(number, eye, things) for number, eye in enumerate(eyes(places))), gsd_m=gsd_m)


def _photo(number: int, eye: Eye, things: Sequence[tuple[float, Inside, float]]) -> Photograph:
    return photograph(eye, frame(eye, things), f"{number:06d}")
