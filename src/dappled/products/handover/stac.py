"""Write a flight's maps as a STAC collection: for each frame an item with its Cloud-Optimised GeoTIFF and camera.

STAC 1.1 with the extensions Projection 2.0 and Perspective Imagery 1.0. Image axes of `pers:rotation_matrix` are right,
up, backward.
"""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

from dappled import durable
from dappled.bounds.parsing import parse_json
from dappled.errors import DappledError
from dappled.products.geotags import sidecars
from dappled.products.handover import view_cameras
from dappled.products.maps import map_files, map_grid
from dappled.products.maps.georeference import Survey
from dappled.products.maps.photographs import Photograph, Station
from dappled.products.whole_files import write_json

_VERSION = "1.1.0"
_EXTENSIONS = [
    "https://stac-extensions.github.io/projection/v2.0.0/schema.json",
    "https://stac-extensions.github.io/perspective-imagery/v1.0.0/schema.json",
]
_COG = "image/tiff; application=geotiff; profile=cloud-optimized"
_SEA_LEVEL = 5773  # EPSG: EGM96 height
_BACKWARD = np.diag([1.0, -1.0, -1.0])  # right, down, forward → right, up, backward
_ITEM_BYTES = 1 << 20

Json = dict[str, Any]


def write_item(
    folder: Path, made: Survey, one: Photograph, station: Station, *, gain: float, utc_ns: int | None
) -> list[Path]:
    """Write <frame>/<frame>.tif, then the item <frame>/<frame>.json; returns their paths.

    Raises DappledError where UTC was never known, MapError and OSError."""
    if utc_ns is None:
        raise DappledError(f"the time of {station.frame.name} in UTC was never known, and a STAC item needs it")
    name = station.name
    durable.make_folder(folder / name)
    image = map_files.frame_cog(made, one, folder / name / f"{name}.tif", gain)
    return [image, write_json(folder / name / f"{name}.json", _item(made, one, station, utc_ns))]


def write_collection(folder: Path, flight: str, names: Sequence[str]) -> list[Path]:
    """Write collection.json, which lists these frames' items; returns its path. Raises DappledError and OSError."""
    items = [_read(folder / name / f"{name}.json") for name in names]
    boxes, times = [item["bbox"] for item in items], sorted(item["properties"]["datetime"] for item in items)
    crossing = any(box[0] > box[2] for box in boxes)
    west = min(box[0] for box in boxes if not crossing or box[0] > 0)
    east = max(box[2] for box in boxes if not crossing or box[2] < 0)
    collection = {
        "type": "Collection",
        "stac_version": _VERSION,
        "id": flight,
        "title": f"Flight {flight}",
        "description": "Frames of a masked light-field camera, each as a map.",
        "license": "other",
        "extent": {
            "spatial": {"bbox": [[west, min(box[1] for box in boxes), east, max(box[3] for box in boxes)]]},
            "temporal": {"interval": [[times[0], times[-1]]]},
        },
        "links": [
            _link("root", "./collection.json"),
            *(_link("item", f"./{name}/{name}.json", "application/geo+json") for name in names),
        ],
    }
    return [write_json(folder / "collection.json", collection)]


def _item(made: Survey, one: Photograph, station: Station, utc_ns: int) -> Json:
    feature = map_files.feature(one, made.ground, made.projection, {})
    grid = map_grid.grid_of([one], made.ground, made.projection, made.gsd_m)
    rows, columns = grid.shape
    code = made.projection.crs.to_epsg()
    east, south = grid.west + columns * grid.step_x, grid.north - rows * grid.step_y
    projected: Json = {
        "proj:shape": [rows, columns],
        "proj:transform": [grid.step_x, 0.0, grid.west, 0.0, -grid.step_y, grid.north],
        "proj:bbox": [grid.west, south, east, grid.north],
    }
    system: Json = (
        {"proj:code": f"EPSG:{code}"} if code else {"proj:code": None, "proj:wkt2": made.projection.crs.to_wkt()}
    )
    _, turn = view_cameras.upright(one.eye.matrix[:2, :2], station.frame.name)
    to_image = (one.eye.rotation @ turn.T @ _BACKWARD).T
    return {
        "type": "Feature",
        "stac_version": _VERSION,
        "stac_extensions": _EXTENSIONS,
        "id": f"{made.flight}-{station.name}",
        "collection": made.flight,
        "geometry": feature["geometry"],
        "bbox": _box(feature["geometry"]),
        "properties": {
            "datetime": sidecars.stamp(utc_ns),
            "gsd": made.gsd_m,
            "instruments": [station.tag.camera],
            **system,
            "pers:perspective_center": one.eye.centre.tolist(),
            "pers:crs": code or made.projection.crs.to_wkt(),
            "pers:vertical_crs": _SEA_LEVEL,
            "pers:rotation_matrix": to_image.ravel().tolist(),
            "pers:interior_orientation": _interior(one, station),
        },
        "assets": {"visual": {"href": f"./{station.name}.tif", "type": _COG, "roles": ["data", "visual"], **projected}},
        "links": [
            _link("root", "../collection.json"),
            _link("parent", "../collection.json"),
            _link("collection", "../collection.json"),
        ],
    }


def _interior(one: Photograph, station: Station) -> Json:
    """The camera of the picture that the map was made of: its samples on the sensor count as pixels. With distortion
    it is not told, as the extension's polynomial is another than OpenCV's."""
    rows, columns = one.eye.shape
    said: Json = {"camera_model": station.tag.camera, "sensor_array_dimensions": [columns, rows]}
    length_mm = station.tag.focal_length_mm
    if length_mm and not any(one.eye.distortion):
        across, down = (length_mm / float(np.linalg.norm(one.eye.matrix[axis, :2])) for axis in (0, 1))
        x, y = (one.eye.matrix[:2, 2] - [(columns - 1) / 2, (rows - 1) / 2]).tolist()
        said |= {
            "focal_length": length_mm,
            "pixel_spacing": [across, down],
            "principal_point_offset": [x * across, -y * down],
        }
    return said


def _box(geometry: Json) -> list[float]:
    """West, south, east, north; west above east across the antimeridian (RFC 7946, 5.2)."""
    polygons = [geometry["coordinates"]] if geometry["type"] == "Polygon" else geometry["coordinates"]
    rings = [np.array(polygon[0]) for polygon in polygons]
    lows, highs = np.array([ring.min(axis=0) for ring in rings]), np.array([ring.max(axis=0) for ring in rings])
    west, east = (lows[:, 0].min(), highs[:, 0].max()) if len(rings) == 1 else (lows[:, 0].max(), highs[:, 0].min())
    return [float(west), float(lows[:, 1].min()), float(east), float(highs[:, 1].max())]


def _link(relation: str, href: str, kind: str = "application/json") -> Json:
    return {"rel": relation, "href": href, "type": kind}


def _read(path: Path) -> Json:
    try:
        item: Json = parse_json(durable.read_plain(path), _ITEM_BYTES)
        _ = item["bbox"][3], item["properties"]["datetime"]
    except (OSError, ValueError, TypeError, KeyError, IndexError):
        raise DappledError(f"{path} is no item of this batch: remove it, and run the batch again") from None
    return item
