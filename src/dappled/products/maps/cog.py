"""Write maps as Cloud-Optimised GeoTIFF, whole or not at all."""

from __future__ import annotations

import tempfile
from collections.abc import Iterable, Mapping
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from dappled import durable
from dappled.decode import srgb
from dappled.decode.array_types import Singles
from dappled.products.extras import need
from dappled.products.maps.map_grid import MapError, MapGrid

TILE = 512
_LEVELS = 65535  # of linear values: a twentieth of what 8 bits in sRGB's curve tell apart in the dark
_DEFLATE = 1  # of 9: a map of the sensor's own fineness is mostly noise, which no effort makes smaller


def display(image: Singles, gain: float) -> NDArray[np.uint8]:
    """(h, w, 2) grey and alpha, or (h, w, 4) red, green, blue and alpha: linear values times `gain` in sRGB's curve.

    NaN becomes transparent black.
    """
    colours = image.shape[2]
    known = np.isfinite(image[..., 0])
    made = np.zeros((*known.shape, colours + 1), dtype=np.uint8)
    for band in range(1, colours):
        known &= np.isfinite(image[..., band])
    if not known.any():
        return made
    level = image * np.float32(gain * _LEVELS)
    np.fmax(level, np.float32(0), out=level)  # NaN, too
    np.minimum(level, np.float32(_LEVELS), out=level)
    made[..., :colours] = np.take(_shown(), level.astype(np.uint16))
    made[..., -1] = 255
    made[~known] = 0
    return made


@cache
def _shown() -> NDArray[np.uint8]:
    """The 8 bits in sRGB's curve of each of `_LEVELS` linear ones."""
    return np.asarray(np.round(srgb.encoded(np.arange(_LEVELS + 1) / _LEVELS) * 255), dtype=np.uint8)


def gain_of(images: Iterable[Singles]) -> float:
    """The gain that brings the brightest hundredth of these pictures to 0.9 of white."""
    brightest = [float(np.nanpercentile(image, 99)) for image in images]
    level = float(np.median(brightest)) if brightest else 0.0
    return 0.9 / level if level > 0 else 1.0


def write_pieces(
    path: Path,
    grid: MapGrid,
    pieces: Iterable[tuple[slice, slice, NDArray[Any]]],
    *,
    dtype: str,
    bands: int,
    tags: Mapping[str, str],
    names: tuple[str, ...] = (),
) -> None:
    """Write a COG from pieces (rows, columns, values (h, w, bands)) that cover the grid.

    uint8 with 2 or 4 bands is a picture whose last band is alpha; floats are NaN where unknown.
    Raises MapError.
    """
    rasterio, windows, shutil = (need(name) for name in ("rasterio", "rasterio.windows", "rasterio.shutil"))
    rows, columns = grid.shape
    profile: dict[str, Any] = {
        "driver": "GTiff",
        "width": columns,
        "height": rows,
        "count": bands,
        "dtype": dtype,
        "crs": grid.crs,
        "transform": grid.affine,
        "tiled": True,
        "blockxsize": TILE,
        "blockysize": TILE,
        "bigtiff": "if_safer",
    }
    if dtype == "uint8":  # set at creation: GDAL writes what is set later into a file beside the GeoTIFF
        profile |= {"alpha": "yes", "photometric": "rgb" if bands == 4 else "minisblack"}
    else:
        profile["nodata"] = float("nan")
    durable.make_folder(path.parent)
    with tempfile.TemporaryDirectory(prefix=".maps-", dir=path.parent) as scratch:
        plain = Path(scratch) / "plain.tif"
        try:
            with rasterio.open(plain, "w", **profile) as target:
                for at_rows, at_columns, values in pieces:
                    window = windows.Window.from_slices(at_rows, at_columns)
                    target.write(np.moveaxis(values, -1, 0), window=window)
                for number, name in enumerate(names, 1):
                    target.set_band_description(number, name)
                target.update_tags(**tags)
            with durable.replacing(path) as part:
                shutil.copy(
                    plain, part, driver="COG", compress="deflate", level=_DEFLATE, predictor="yes", blocksize=TILE,
                    overview_resampling="average", num_threads=1,
                )  # fmt: skip
        except rasterio.errors.RasterioError as error:
            raise MapError(f"cannot write the map {path}: {error}") from error


def write(
    path: Path, grid: MapGrid, values: NDArray[Any], tags: Mapping[str, str], names: tuple[str, ...] = ()
) -> None:
    """Write a COG of values (rows, columns, bands); see `write_pieces`."""
    everything = (slice(0, grid.shape[0]), slice(0, grid.shape[1]), values)
    write_pieces(path, grid, [everything], dtype=str(values.dtype), bands=values.shape[2], tags=tags, names=names)
