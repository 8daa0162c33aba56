"""Make point clouds of distance maps, in camera or map coordinates, and write them as PLY or LAS.

Points above a limit of σ are withheld.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import pyproj
from numpy.typing import NDArray

from dappled.config import profiles
from dappled.decode.array_types import Floats
from dappled.decode.depth import DistanceMap
from dappled.decode.lightfield import LightField
from dappled.errors import DappledError
from dappled.products.maps import las_files
from dappled.products.maps.earth import Projection, utm
from dappled.products.maps.eye import intrinsics
from dappled.products.maps.photographs import Station, eye_of, lens_of
from dappled.products.whole_files import whole


@dataclass(frozen=True, slots=True, eq=False)
class PointCloud:
    """`points` float64 (n, 3) in m, `colours` uint16 (n, 3), `sigma_m` (n,) along the line of sight; `withheld` is the
    number of points left out for their σ. `crs` names the projection; "" is camera axes: right, down, forward."""

    points: Floats
    colours: NDArray[np.uint16]
    sigma_m: NDArray[np.float32]
    withheld: int
    crs: str = ""


def of(
    field: LightField,
    picture: NDArray[np.float32],
    distances: DistanceMap,
    *,
    most_sigma: float = 0.1,
    station: Station | None = None,
    crs: str = "",
) -> PointCloud:
    """The known points of a distance map whose σ is at most `most_sigma` of their distance.

    `picture` (h, w(, 3)) gives the colours. With a `station` the points are on the map, in UTM unless `crs` is given.
    Raises DappledError where the camera's profile or focal length isn't known.
    """
    known = np.isfinite(distances.distance_m)
    good = known & (distances.sigma_m <= most_sigma * distances.distance_m)
    rows, columns = np.nonzero(good)
    depth = distances.distance_m[good].astype(np.float64)
    pixels = np.stack([columns, rows], axis=1).astype(np.float64)
    said = field.attributes
    length, name = said.get("focal_length_mm"), said.get("camera")
    if not (length and name and said.get("shape")):
        raise DappledError("the light field doesn't say its camera and focal length: points need both")
    profile = profiles.camera(str(name))
    if station is None:
        high, wide = said["shape"]
        matrix = intrinsics(profile.sensor((int(high), int(wide))), lens_of(profile, float(length)), field.grid)
        flat = (pixels - matrix[:2, 2]) @ np.linalg.inv(matrix[:2, :2]).T
        points = np.concatenate([flat, np.ones((len(flat), 1))], axis=1) * depth[:, None]
        crs = ""
    else:
        crs = crs or utm(station.camera.latitude_deg, station.camera.longitude_deg)
        eye = eye_of(station, field, profile, Projection(crs))
        points = eye.centre + eye.rays(pixels) * depth[:, None]
    grey = picture if picture.ndim == 3 else np.repeat(picture[..., None], 3, axis=2)
    seen = np.nan_to_num(grey[good])
    white = max(float(np.quantile(seen, 0.995)), 1e-9) if seen.size else 1.0
    colours = np.rint(65535 * np.clip(seen / white, 0, 1)).astype(np.uint16)
    return PointCloud(points, colours, distances.sigma_m[good], int(known.sum() - good.sum()), crs)


def write(path: Path, cloud: PointCloud) -> None:
    """Write .ply (binary) or .las, .laz (needs laspy). Raises DappledError."""
    writers: dict[str, Callable[[Path, PointCloud], None]] = {".ply": _ply, ".las": _las, ".laz": _las}
    if path.suffix.lower() not in writers:
        raise DappledError(f"{path}: the name of a file of points must end in .ply, .las or .laz")
    if len(cloud.points) == 0:
        raise DappledError(
            f"no point of {path.name} is known well enough ({cloud.withheld} withheld): allow a larger σ"
        )
    with whole(path) as part:
        writers[path.suffix.lower()](part, cloud)


def _ply(path: Path, cloud: PointCloud) -> None:
    origin = np.zeros(3) if not cloud.crs else np.floor(cloud.points.min(axis=0))
    table = np.empty(
        len(cloud.points),
        dtype=[("xyz", "<f4", 3), ("rgb", "u1", 3), ("sigma", "<f4")],
    )
    table["xyz"] = cloud.points - origin
    table["rgb"] = cloud.colours >> 8
    table["sigma"] = cloud.sigma_m
    where = f"{cloud.crs}, offset {origin[0]:.0f} {origin[1]:.0f} {origin[2]:.0f}" if cloud.crs else "camera axes"
    lines = [
        "ply",
        "format binary_little_endian 1.0",
        f"comment dappled, metres, {where}",
        f"element vertex {len(table)}",
    ]
    lines += [f"property float {axis}" for axis in "xyz"]
    lines += [f"property uchar {colour}" for colour in ("red", "green", "blue")]
    lines += ["property float sigma_m", "end_header"]
    with path.open("wb") as file:
        file.write(("\n".join(lines) + "\n").encode())
        file.write(table.tobytes())


def _las(path: Path, cloud: PointCloud) -> None:
    crs = pyproj.CRS(cloud.crs) if cloud.crs else None
    las_files.write(path, cloud.points, {"sigma_m": (cloud.sigma_m, "1 sigma, m")}, crs=crs, colours=cloud.colours)
