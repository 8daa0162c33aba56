"""Write points as LAS or LAZ, each with its σ: LAS 1.4, coordinates to the millimetre."""

from __future__ import annotations

from collections.abc import Mapping
from datetime import UTC, datetime
from pathlib import Path

import numpy as np
import pyproj
from numpy.typing import NDArray

from dappled.decode.array_types import Floats, Singles
from dappled.products.extras import need


def write(
    path: Path,
    points: Floats,
    extra: Mapping[str, tuple[Singles, str]],
    *,
    crs: pyproj.CRS | None = None,
    colours: NDArray[np.uint16] | None = None,
    utc_ns: int | None = None,
) -> None:
    """Write `points` (n, 3) in m, with further float32 values of each (name: values (n,), what they are).

    `colours` (n, 3) are red, green, blue. `crs` and the day that `utc_ns` is in stand in the header. Raises OSError,
    and DappledError where laspy is not installed.
    """
    laspy = need("laspy")
    header = laspy.LasHeader(point_format=6 if colours is None else 7, version="1.4")
    header.generating_software = "dappled"
    header.scales = np.full(3, 0.001)
    if len(points):
        header.offsets = np.floor(points.min(axis=0))
    if utc_ns is not None:
        header.creation_date = datetime.fromtimestamp(utc_ns // 1_000_000_000, UTC).date()
    if crs is not None:
        header.add_crs(crs)
    for name, (_, what) in extra.items():
        header.add_extra_dim(laspy.ExtraBytesParams(name, np.float32, what))
    las = laspy.LasData(header)
    las.x, las.y, las.z = points.T
    if colours is not None:
        las.red, las.green, las.blue = colours.T
    for name, (values, _) in extra.items():
        las[name] = values
    las.write(str(path))
