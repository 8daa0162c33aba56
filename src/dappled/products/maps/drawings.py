"""A survey's pictures as files: strip mosaics and single frames, as COG and as KMZ."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np

from dappled.products.maps import cog, kmz, map_grid, mosaic
from dappled.products.maps.earth import GEODETIC
from dappled.products.maps.georeference import Survey
from dappled.products.maps.kmz import Overlay
from dappled.products.maps.photographs import Photograph

LARGEST_KMZ = 16_384  # cells on a side: a globe overlay is held in memory whole


def mosaic_cog(made: Survey, path: Path, gain: float | None = None) -> Path:
    """All frames as one COG on the survey's projection. Raises MapError."""
    grid = mosaic.grid_of(made.photographs, made.ground, made.projection, made.gsd_m)
    shown = gain_of(made) if gain is None else gain
    pieces = (
        (rows, columns, cog.display(values, shown))
        for rows, columns, values in mosaic.pieces(made.photographs, grid, made.ground, made.projection, made.focus_m)
    )
    cog.write_pieces(path, grid, pieces, dtype="uint8", bands=_bands(made.photographs), tags=made.tags())
    return path


def mosaic_kmz(made: Survey, path: Path, gain: float | None = None) -> Path:
    """All frames as one north-up overlay; as a tree of tiles where it is large. Raises MapError."""
    path.parent.mkdir(parents=True, exist_ok=True)
    overlay = _overlay(made, made.photographs, made.flight, gain_of(made) if gain is None else gain)
    kmz.write(path, made.flight, [overlay])
    return path


def frame_cog(made: Survey, one: Photograph, path: Path, gain: float) -> Path:
    """One frame as a COG. Raises MapError."""
    return mosaic_cog(replace(made, photographs=(one,)), path, gain)


def frame_kmz(made: Survey, one: Photograph, path: Path, gain: float, *, quad: bool = False) -> Path:
    """One frame as a KMZ: north-up, or as a `quad` the view itself between its four corners. Raises MapError."""
    path.parent.mkdir(parents=True, exist_ok=True)
    overlay = _quad(made, one, gain) if quad else _overlay(made, [one], one.name, gain)
    kmz.write(path, f"{made.flight} {one.name}", [overlay])
    return path


def gain_of(made: Survey) -> float:
    """One gain for the whole survey: frames keep their brightness against each other."""
    return cog.gain_of([one.image[::4, ::4] for one in made.photographs])


def _overlay(made: Survey, chosen: Sequence[Photograph], name: str, gain: float) -> Overlay:
    grid = mosaic.grid_of(chosen, made.ground, made.projection, made.gsd_m, degrees=True)
    if max(grid.shape) > LARGEST_KMZ:
        raise map_grid.MapError(
            f"the overlay would have {grid.shape[0]} × {grid.shape[1]} cells: choose a larger --gsd for the KMZ"
        )
    assert grid.crs == GEODETIC
    picture = np.zeros((*grid.shape, _bands(chosen)), dtype=np.uint8)
    for rows, columns, values in mosaic.pieces(chosen, grid, made.ground, made.projection, made.focus_m):
        picture[rows, columns] = cog.display(values, gain)
    return Overlay(name, picture, grid)


def _quad(made: Survey, one: Photograph, gain: float) -> Overlay:
    met = made.ground.meet(one.eye, one.eye.corners())
    latitude, longitude = made.projection.to_geodetic(met[:, 0], met[:, 1])
    order = (3, 2, 1, 0)  # corners go clockwise from top left, KML's counter-clockwise from lower left
    image = one.image if one.image.ndim == 3 else one.image[..., None]
    quad = tuple((float(longitude[k]), float(latitude[k])) for k in order)
    return Overlay(one.name, cog.display(np.asarray(image), gain), quad=quad)


def _bands(chosen: Sequence[Photograph]) -> int:
    return 4 if any(one.image.ndim == 3 for one in chosen) else 2
