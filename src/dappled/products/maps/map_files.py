"""Write a survey's files: mosaics and single frames as COG and KMZ, footprints as GeoJSON (RFC 7946), and a report."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from dappled import codec
from dappled.decode.array_types import Floats
from dappled.products.maps import cog, kmz, map_grid
from dappled.products.maps.earth import GEODETIC, Projection, geojson_collection, geojson_feature
from dappled.products.maps.georeference import Survey
from dappled.products.maps.ground import Ground
from dappled.products.maps.kmz import Overlay
from dappled.products.maps.map_grid import MapGrid, footprint, unwrapped
from dappled.products.maps.photographs import Photograph
from dappled.products.whole_files import write_json

LARGEST_KMZ = 16_384  # cells on a side: an overlay is held in memory as a whole


def mosaic_grid(made: Survey) -> MapGrid:
    """The grid of all frames on the survey's projection. Raises MapError for one that is too large."""
    return map_grid.grid_of(made.photographs, made.ground, made.projection, made.gsd_m)


def mosaic_cog(made: Survey, path: Path, gain: float | None = None) -> Path:
    """Write all frames as one COG on the survey's projection. Raises MapError."""
    grid = mosaic_grid(made)
    shown = gain_of(made) if gain is None else gain
    pieces = (
        (rows, columns, cog.display(values, shown))
        for rows, columns, values in map_grid.pieces(made.photographs, grid, made.ground, made.projection, made.focus_m)
    )
    cog.write_pieces(path, grid, pieces, dtype="uint8", bands=_bands(made.photographs), tags=made.tags())
    return path


def mosaic_kmz(made: Survey, path: Path, gain: float | None = None) -> Path:
    """Write all frames as one north-up overlay, a large one as a tree of tiles. Raises MapError."""
    path.parent.mkdir(parents=True, exist_ok=True)
    overlay = _overlay(made, made.photographs, made.flight, gain_of(made) if gain is None else gain)
    kmz.write(path, made.flight, [overlay])
    return path


def frame_cog(made: Survey, one: Photograph, path: Path, gain: float) -> Path:
    """Write one frame as a COG. Raises MapError."""
    return mosaic_cog(replace(made, photographs=(one,)), path, gain)


def frame_kmz(made: Survey, one: Photograph, path: Path, gain: float, *, quad: bool = False) -> Path:
    """Write one frame as a KMZ: north-up, or with `quad` the view itself between its four corners. Raises MapError."""
    path.parent.mkdir(parents=True, exist_ok=True)
    overlay = _quad(made, one, gain) if quad else _overlay(made, [one], one.name, gain)
    kmz.write(path, f"{made.flight} {one.name}", [overlay])
    return path


def gain_of(made: Survey) -> float:
    """One gain for the whole survey, so that frames keep their brightness relative to each other."""
    return cog.gain_of([one.image[::4, ::4] for one in made.photographs])


def overlay_grid(made: Survey, chosen: Sequence[Photograph]) -> MapGrid:
    """The grid of these frames' overlay. Raises MapError for one that is too large."""
    grid = map_grid.grid_of(chosen, made.ground, made.projection, made.gsd_m, degrees=True)
    if max(grid.shape) > LARGEST_KMZ:
        raise map_grid.MapError(
            f"the overlay would have {grid.shape[0]} × {grid.shape[1]} cells: choose a larger --gsd for the KMZ"
        )
    assert grid.crs == GEODETIC
    return grid


def _overlay(made: Survey, chosen: Sequence[Photograph], name: str, gain: float) -> Overlay:
    grid = overlay_grid(made, chosen)
    picture = np.zeros((*grid.shape, _bands(chosen)), dtype=np.uint8)
    for rows, columns, values in map_grid.pieces(chosen, grid, made.ground, made.projection, made.focus_m):
        if (shown := cog.display(values, gain))[..., -1].any():  # what stays empty takes no memory
            picture[rows, columns] = shown
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


def write_footprints(made: Survey, output: Path) -> Path:
    """Write footprints.geojson: what each frame covers."""
    features = [feature(one, made.ground, made.projection, made.facts.get(one.name, {})) for one in made.photographs]
    return write_json(output / "footprints.geojson", geojson_collection(features))


def report(made: Survey, files: Sequence[Path]) -> dict[str, Any]:
    """What report.json holds: projection, ground and files, frames left out, and how each frame was refined."""
    return {
        "flight": made.flight,
        "crs": made.projection.name,
        "ground": made.ground.name,
        "gsd_m": made.gsd_m,
        "frames": [{"name": one.name, **made.facts.get(one.name, {})} for one in made.photographs],
        "left_out": codec.plain(made.left),
        "notes": codec.plain(made.notes),
        "doubts": codec.plain(made.doubts),
        "lens": None if made.lens is None else made.lens.facts(),
        "files": [path.name for path in files],
    }


def feature(photograph: Photograph, ground: Ground, projection: Projection, facts: dict[str, Any]) -> dict[str, Any]:
    """One frame's footprint as a GeoJSON feature. Raises MapError where its view leaves the ground."""
    met = footprint(photograph.eye, ground)
    latitude, longitude = projection.to_geodetic(met[:, 0], met[:, 1])
    _, camera = projection.to_geodetic(*photograph.eye.centre[:2])
    ring = np.stack([unwrapped(longitude, float(camera)), latitude], axis=1)
    about = {"name": photograph.name, "utc_ns": photograph.utc_ns, "ground": ground.name, **facts}
    return geojson_feature(_polygon(ring), **about)


def _polygon(ring: Floats) -> dict[str, Any]:
    """The polygon of a ring (n, 2) of unwrapped longitude and latitude, counter-clockwise; cut in two at the
    antimeridian (RFC 7946, 3.1.9)."""
    shift = 360.0 * np.floor((ring[:, 0].mean() + 180) / 360)
    ring = ring - (shift, 0.0)
    pieces = [ring]
    for edge in (-180.0, 180.0):
        if ring[:, 0].min() < edge < ring[:, 0].max():
            pieces = [_beyond(ring, edge, 1.0), _beyond(ring, edge, -1.0)]
    rings = [[_closed(piece)] for piece in pieces]
    if len(rings) == 1:
        return {"type": "Polygon", "coordinates": rings[0]}
    return {"type": "MultiPolygon", "coordinates": rings}


def _beyond(ring: Floats, edge: float, side: float) -> Floats:
    """The part of a ring on one side of a meridian (Sutherland and Hodgman), with longitudes in −180 to 180."""
    kept: list[Floats] = []
    for here, there in zip(ring, np.roll(ring, -1, axis=0), strict=True):
        if side * (here[0] - edge) >= 0:
            kept.append(here)
        if (here[0] - edge) * (there[0] - edge) < 0:
            share = (edge - here[0]) / (there[0] - here[0])
            kept.append(np.array([edge, here[1] + share * (there[1] - here[1])]))
    piece = np.array(kept)
    middle = piece[:, 0].mean()
    return piece - (360.0 if middle > 180 else -360.0 if middle < -180 else 0.0, 0.0)


def _closed(ring: Floats) -> list[list[float]]:
    x, y = ring[:, 0], ring[:, 1]
    area = float(np.sum(x * np.roll(y, -1) - np.roll(x, -1) * y))
    turned = ring if area > 0 else ring[::-1]
    points = [[round(float(lon), 9), round(float(lat), 9)] for lon, lat in turned]
    return [*points, points[0]]
