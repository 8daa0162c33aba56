"""Open rasters that others made: those that hold their own values."""

from __future__ import annotations

import math
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

from dappled import durable
from dappled.errors import DappledError, first_line
from dappled.products.extras import need
from dappled.products.maps.earth import DEGREE_M, Projection

_FORMATS = ["GTiff", "COG", "DTED", "SRTMHGT", "AAIGrid", "EHdr", "HFA", "USGSDEM", "GTX", "PNG", "JPEG", "JP2OpenJPEG"]
"""By GDAL's names. A virtual raster (VRT) may name other files of this machine, or a server, under any name."""


@contextmanager
def opened(path: Path, what: str, error: type[DappledError] = DappledError) -> Iterator[Any]:
    """An open dataset of rasterio's that lies somewhere on Earth; `what` it is, in sentences. Raises `error` where it
    can't be read or has no coordinates, and for whatever GDAL raises while it is open."""
    try:
        with open(path, "rb", opener=durable.plain_file):
            pass
        open_here = need("rasterio.env").ensure_env(need("rasterio.io").DatasetReader)
        with open_here(str(path), driver=_FORMATS) as source:
            if placed := source.crs is not None and not source.transform.is_identity:
                yield source
    except DappledError:
        raise
    except Exception as caught:  # GDAL, PROJ and a transform of zeros raise anything
        raise error(f"{what} {path} can't be read: {first_line(caught)}") from caught
    if not placed:
        raise error(f"{what} {path} has no coordinates: give a GeoTIFF or another with a coordinate system")


def step_m(source: Any, projection: Projection, east: float, north: float) -> float:
    """The size of a raster's own cells at a place of the map, in metres."""
    across, down = abs(source.transform.a), abs(source.transform.e)
    if source.crs.is_geographic:
        latitude, _ = projection.to_geodetic(east, north)
        return float(min(across * math.cos(math.radians(float(latitude))), down)) * DEGREE_M
    return float(min(across, down) * (source.crs.linear_units_factor[1] if source.crs.is_projected else 1.0))
