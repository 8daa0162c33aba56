"""Open rasters that others made: those that hold their own values."""

from __future__ import annotations

from pathlib import Path
from typing import Any

from dappled import durable
from dappled.products.extras import need

_FORMATS = ["GTiff", "COG", "DTED", "SRTMHGT", "AAIGrid", "EHdr", "HFA", "USGSDEM", "GTX", "PNG", "JPEG", "JP2OpenJPEG"]
"""By GDAL's names. A virtual raster (VRT) may name other files of this machine, or a server, under any name."""


def open_raster(path: Path) -> Any:
    """An open dataset of rasterio's. Raises OSError, and whatever GDAL raises."""
    with open(path, "rb", opener=durable.plain_file):
        pass
    open_here = need("rasterio.env").ensure_env(need("rasterio.io").DatasetReader)
    return open_here(str(path), driver=_FORMATS)
