"""Write pictures for virtual globes: KMZ with north-up ground overlays, which every viewer draws.

A picture across the antimeridian becomes two overlays. A LatLonQuad (Google's extension) keeps a view unrotated; not
every viewer draws it.
"""

from __future__ import annotations

import io
import zipfile
import zlib
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from xml.etree.ElementTree import Element

import numpy as np
from numpy.typing import NDArray
from PIL import Image as Pictures

from dappled import durable
from dappled.encoded_pictures import file_of
from dappled.kml import box, node, overlay, page
from dappled.products.maps.map_grid import MapGrid

TILE = 1024
_STRIP = 32  # rows that are shrunk at a time
Pixels = NDArray[np.uint8]
_FOLDER = "tiles/"
_WHEN = (1980, 1, 1, 0, 0, 0)  # zip's earliest time: the same picture gives the same bytes


@dataclass(frozen=True, slots=True, eq=False)
class Overlay:
    """One picture uint8 (h, w, 2 or 4) on the ground: north-up on a grid in degrees, or between the four corners
    `quad` (longitude, latitude) in KML's order: lower left, lower right, upper right, upper left."""

    name: str
    picture: Pixels
    grid: MapGrid | None = None
    quad: tuple[tuple[float, float], ...] = ()


def write(path: Path, name: str, overlays: Sequence[Overlay]) -> None:
    """Write a KMZ of overlays. Large ones become trees of tiles that a viewer loads as it comes near.

    Raises OSError.
    """
    files: dict[str, bytes] = {}
    shown = [node("name", name)]
    for number, one in enumerate(overlays):
        if one.grid is None:
            corners = " ".join(f"{lon:.10f},{lat:.10f}" for lon, lat in one.quad)
            quad = node("gx:LatLonQuad", node("coordinates", corners))
            shown.append(overlay(one.name, _picture(files, f"{number}", one.picture), quad))
            continue
        for side, (grid, picture) in enumerate(_sides(one.grid, one.picture)):
            place = f"{number}-{side}"
            if max(grid.shape) > TILE:
                shown.append(_tree(files, place, Overlay(one.name, picture, grid), _FOLDER))
            else:
                shown.append(overlay(one.name, _picture(files, place, picture), _bounded("LatLonBox", grid)))
    pages = {"doc.kml": page(*shown), **files}  # the first .kml in the archive is the one that is opened
    durable.write_file(path, _zipped(pages))


def _sides(grid: MapGrid, picture: Pixels) -> list[tuple[MapGrid, Pixels]]:
    """The picture, cut at the antimeridian where it crosses, each with longitudes from −180 to 180."""
    west, _, east, _ = grid.bounds
    shift = 360.0 * np.floor((west + 180) / 360)
    cut = round((180 + shift - west) / grid.step_x)
    pieces = [slice(0, grid.shape[1])]
    if east - shift > 180 and 0 < cut < grid.shape[1]:
        pieces = [slice(0, cut), slice(cut, grid.shape[1])]
    made = []
    for number, columns in enumerate(pieces):
        part = grid.part(slice(0, grid.shape[0]), columns)
        moved = MapGrid(part.crs, part.west - shift - 360 * number, part.north, part.step_x, part.step_y, part.shape)
        if len(pieces) == 2:  # the cut is at a whole cell: the seam itself is the meridian
            edge = -180.0 if number else 180.0 - part.shape[1] * part.step_x
            moved = MapGrid(part.crs, edge, part.north, part.step_x, part.step_y, part.shape)
        made.append((moved, picture[:, columns]))
    return made


def _tree(files: dict[str, bytes], place: str, one: Overlay, folder: str = "") -> Element:
    """A super-overlay: a link to a page with a coarse picture of the whole and links to its four quarters, and so on.

    `folder` is the path from the link's file to the folder of all pages and pictures.
    """
    grid, picture = one.grid, one.picture
    assert grid is not None
    step = -(-max(grid.shape) // TILE)
    coarse = _picture(files, f"{_FOLDER}{place}", _shrunk(picture, step)).removeprefix(_FOLDER)
    more = _region(grid), node("drawOrder", str(len(place)))
    shown = [_region(grid), overlay(one.name, coarse, _bounded("LatLonBox", grid), *more)]  # GDAL looks here for it
    if step > 1:
        middle = [-(-side // 2) for side in grid.shape]
        for quarter, (row, column) in enumerate(((0, 0), (0, 1), (1, 0), (1, 1))):
            rows = slice(middle[0] * row, grid.shape[0] if row else middle[0])
            columns = slice(middle[1] * column, grid.shape[1] if column else middle[1])
            piece = picture[rows, columns]
            if piece.size and piece[..., -1].any():
                shown.append(_tree(files, f"{place}{quarter}", Overlay(one.name, piece, grid.part(rows, columns))))
    files[f"{_FOLDER}{place}.kml"] = page(*shown)
    target = node("Link", node("href", f"{folder}{place}.kml"), node("viewRefreshMode", "onRegion"))
    return node("NetworkLink", node("name", one.name), _region(grid), target)


def _bounded(tag: str, grid: MapGrid) -> Element:
    return box(tag, dict(zip(("west", "south", "east", "north"), grid.bounds, strict=True)))


def _region(grid: MapGrid) -> Element:
    """The area that must be in view, and its least size on the screen (px), before a viewer loads a tile."""
    lod = node("Lod", node("minLodPixels", "256"), node("maxLodPixels", "-1"))
    return node("Region", _bounded("LatLonAltBox", grid), lod)


def _picture(files: dict[str, bytes], place: str, picture: Pixels) -> str:
    """Add the picture as PNG to the archive's files; returns its name."""
    mode = "LA" if picture.shape[2] == 2 else "RGBA"
    drawn, name = Pictures.fromarray(np.ascontiguousarray(picture), mode), f"{place}.png"
    files[name] = file_of(drawn, "PNG", compress_level=1, compress_type=zlib.Z_RLE)
    return name


def _shrunk(picture: Pixels, step: int) -> Pixels:
    """Means over step × step cells, weighted by alpha."""
    if step == 1:
        return picture
    straight, weighted = ("LA", "La") if picture.shape[2] == 2 else ("RGBA", "RGBa")
    made = np.zeros((*(-(-side // step) for side in picture.shape[:2]), picture.shape[2]), dtype=np.uint8)
    for top in range(0, len(made), _STRIP):  # a flight's map is empty for the most part
        strip = picture[top * step : (top + _STRIP) * step]
        seen = np.flatnonzero(strip[..., -1].any(axis=0))
        if seen.size:
            left, right = seen[0] // step, seen[-1] // step + 1
            part = np.ascontiguousarray(strip[:, left * step : right * step])
            reduced = Pictures.fromarray(part, straight).convert(weighted).reduce(step).convert(straight)
            made[top : top + _STRIP, left:right] = np.asarray(reduced)
    return made


def _zipped(files: dict[str, bytes]) -> bytes:
    memory = io.BytesIO()
    with zipfile.ZipFile(memory, "w", zipfile.ZIP_DEFLATED) as archive:
        for name, data in files.items():
            info = zipfile.ZipInfo(name, _WHEN)
            info.compress_type = zipfile.ZIP_STORED if name.endswith(".png") else zipfile.ZIP_DEFLATED
            info.external_attr = 0o644 << 16
            archive.writestr(info, data)
    return memory.getvalue()
