"""What each frame covers, as GeoJSON polygons (RFC 7946)."""

from __future__ import annotations

import json
from collections.abc import Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from dappled.products.maps.earth import Projection
from dappled.products.maps.ground import Ground
from dappled.products.maps.map_grid import footprint, unwrapped
from dappled.products.maps.photographs import Photograph

Floats = NDArray[np.float64]


def feature(photograph: Photograph, ground: Ground, projection: Projection, facts: dict[str, Any]) -> dict[str, Any]:
    """One frame's footprint as a GeoJSON feature. Raises MapError where its view leaves the ground."""
    met = footprint(photograph.eye, ground)
    latitude, longitude = projection.to_geodetic(met[:, 0], met[:, 1])
    _, camera = projection.to_geodetic(*photograph.eye.centre[:2])
    ring = np.stack([unwrapped(longitude, float(camera)), latitude], axis=1)
    return {
        "type": "Feature",
        "properties": {"name": photograph.name, "utc_ns": photograph.utc_ns, "ground": ground.name, **facts},
        "geometry": polygon(ring),
    }


def collection(features: Sequence[dict[str, Any]]) -> bytes:
    """The file of these features."""
    return (json.dumps({"type": "FeatureCollection", "features": list(features)}, indent=1) + "\n").encode()


def polygon(ring: Floats) -> dict[str, Any]:
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
