"""Write what a flight has seen: GeoTIFF, GeoJSON, and a picture."""

from __future__ import annotations

from collections.abc import Iterator
from itertools import chain
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from PIL import Image, ImageDraw, ImageFont

from dappled import durable
from dappled.decode.array_types import Floats
from dappled.decode.geometry.area import PlannedArea
from dappled.encoded_pictures import file_of
from dappled.errors import counted
from dappled.products.extras import need
from dappled.products.maps import cog
from dappled.products.maps.coverage import Coverage
from dappled.products.maps.earth import Projection, geojson_collection, geojson_feature
from dappled.products.maps.map_grid import unwrapped
from dappled.products.whole_files import write_json

MOST_SHOWN = 8  # more frames than these are drawn and listed as so many
_HOLE = (214, 40, 40)
_COLOURS = (  # by frames, from 0: light to dark, so that it also reads in grey
    (240, 240, 236), (222, 235, 247), (198, 219, 239), (158, 202, 225), (107, 174, 214),
    (66, 146, 198), (33, 113, 181), (8, 81, 156), (8, 48, 107),
)  # fmt: skip
_OUTSIDE = 0.35  # how much of its colour ground beyond the area keeps
_SIDE = 1080  # of the picture


def write_raster(covered: Coverage, path: Path, *, least: int) -> None:
    """A GeoTIFF of uint16: frames, directions, holes (1, else 0). Raises MapError."""
    layers = np.stack([covered.frames, covered.directions, covered.holes(least)], axis=2).astype(np.float32)
    cog.write(path, covered.grid, layers, {"DAPPLED_LEAST_FRAMES": str(least)}, ("frames", "directions", "holes"))


def write_geojson(covered: Coverage, projection: Projection, path: Path, *, least: int) -> None:
    """Polygons of equal counts in the area ("frames", up to `MOST_SHOWN`), and of the holes ("hole": true)."""
    counts = np.minimum(covered.frames, MOST_SHOWN).astype(np.int32)
    seen, holes = covered.planned & ~covered.holes(least), covered.holes(least)
    features = chain.from_iterable(
        _features(covered, projection, counts, where, hole=hole) for where, hole in ((seen, False), (holes, True))
    )
    write_json(path, geojson_collection(features), indent=None)


def _features(
    covered: Coverage, projection: Projection, values: NDArray[np.int32], where: NDArray[np.bool_], *, hole: bool
) -> Iterator[dict[str, Any]]:
    shapes = need("rasterio.features")
    for shape, value in shapes.shapes(values, mask=where, transform=covered.grid.affine):
        rings = []
        for ring in shape["coordinates"]:
            latitude, longitude = projection.to_geodetic(*np.array(ring).T)
            whole = unwrapped(longitude, float(longitude[0]))
            rings.append(np.round(np.stack([whole, latitude], axis=1), 8).tolist())
        area_m2 = sum(_area(np.array(ring)) for ring in shape["coordinates"])
        polygon = {"type": "Polygon", "coordinates": rings}
        yield geojson_feature(polygon, frames=int(value), hole=hole, area_m2=round(abs(area_m2), 2))


def _area(ring: Floats) -> float:
    """Signed: a ring inside another runs the other way round."""
    x, y = ring.T
    return float(np.sum(x * np.roll(y, -1) - y * np.roll(x, -1)) / 2)


def write_picture(
    covered: Coverage, projection: Projection, area: PlannedArea | None, path: Path, *, least: int
) -> None:
    """A PNG, north up: blue by the number of frames, red holes, the area's border, a scale and a legend."""
    rows, columns = covered.grid.shape
    colours = np.array(_COLOURS, dtype=np.float64)[np.minimum(covered.frames, MOST_SHOWN)]
    colours = np.where(covered.planned[..., None], colours, 255 - _OUTSIDE * (255 - colours))
    colours[covered.holes(least)] = _HOLE
    zoom = _SIDE / max(rows, columns)
    size = max(1, round(columns * zoom)), max(1, round(rows * zoom))
    drawn = Image.fromarray(colours.astype(np.uint8)).resize(size, Image.Resampling.NEAREST)
    pen, font = ImageDraw.Draw(drawn), ImageFont.load_default(30)
    for ring in [] if area is None else area.on_map(projection):
        x = (ring[:, 0] - covered.grid.west) / covered.grid.step_x * zoom
        y = (covered.grid.north - ring[:, 1]) / covered.grid.step_y * zoom
        pen.line([*zip(x.tolist(), y.tolist(), strict=True), (float(x[0]), float(y[0]))], fill=(20, 20, 20), width=4)
    sheet = Image.new("RGB", (max(size[0], _SIDE), size[1] + 150), (255, 255, 255))
    sheet.paste(drawn, (0, 0))
    _legend(ImageDraw.Draw(sheet), font, size[1] + 12, zoom / covered.grid.step_x, least)
    durable.write_file(path.absolute(), file_of(sheet, "PNG"))


def _legend(pen: ImageDraw.ImageDraw, font: Any, top: int, px_per_m: float, least: int) -> None:
    at = 12
    words = [f"{n}{'+' if n == MOST_SHOWN else ''}" for n in range(MOST_SHOWN + 1)]
    for colour, word in zip(_COLOURS, words, strict=True):
        pen.rectangle((at, top, at + 44, top + 44), fill=colour, outline=(90, 90, 90))
        pen.text((at + 52, top + 4), word, fill=(20, 20, 20), font=font)
        at += 100
    pen.text((at, top + 4), "frames", fill=(20, 20, 20), font=font)
    top += 66
    pen.rectangle((12, top, 56, top + 44), fill=_HOLE, outline=(90, 90, 90))
    pen.text((64, top + 4), f"fewer than {counted(least, 'frame')}", fill=(20, 20, 20), font=font)
    metres = _round(_SIDE / 4 / px_per_m)
    length = metres * px_per_m
    pen.line((560, top + 22, 560 + length, top + 22), fill=(20, 20, 20), width=6)
    pen.text((572 + length, top + 4), f"{metres:g} m", fill=(20, 20, 20), font=font)


def _round(value: float) -> float:
    """The largest of 1, 2, 5, 10 … that is not above a value."""
    power = 10.0 ** np.floor(np.log10(value))
    return float(max(power * step for step in (1, 2, 5) if power * step <= value * (1 + 1e-9)))
