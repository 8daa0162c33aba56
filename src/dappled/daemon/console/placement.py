"""Place frames on maps: the background picture of the console's map, footprints, and KML for virtual globes.

The background is a PNG or JPEG in degrees, with the world file that GIS programs write beside it.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from dappled import durable
from dappled.bounds.parsing import read_bytes
from dappled.bounds.pictures import open_picture
from dappled.decode.geometry import camera_pose
from dappled.decode.geometry.footprint import OrientedFrame, RectifiedFrame
from dappled.errors import DappledError, first_line
from dappled.kml import box, node, overlay, page

_WORLD_BYTES = 4096
_WORLD = {".png": ".pgw", ".jpg": ".jgw", ".jpeg": ".jgw"}


@dataclass(frozen=True, slots=True)
class Background:
    """The background picture's file, and its bounds in degrees."""

    file: Path
    north: float
    south: float
    east: float
    west: float

    def bounds(self) -> dict[str, float]:
        """The bounds as JSON values."""
        return {"north": self.north, "south": self.south, "east": self.east, "west": self.west}


def load_background(file: Path) -> Background:
    """Read a map and its world file: six lines, with degrees per pixel and the centre of the first pixel.

    Raises DappledError for a file that is not a picture, is turned, or is not in degrees.
    """
    if file.suffix.lower() not in _WORLD:
        raise DappledError(f"{file}: a map is a PNG or a JPEG")
    world = next((p for p in (file.with_suffix(_WORLD[file.suffix.lower()]), file.with_suffix(".wld")) if p.is_file()),
                 None)  # fmt: skip
    if world is None:
        raise DappledError(f"{file} has no world file {file.with_suffix(_WORLD[file.suffix.lower()]).name} beside it")
    try:
        lines = read_bytes(world, _WORLD_BYTES).decode("ascii").split()
        across, turned, turned_too, down, left, top = (float(line) for line in lines)
        with open(file, "rb", opener=durable.plain_file) as picture:
            width, height = open_picture(picture).size
    except (OSError, ValueError) as error:
        raise DappledError(f"{file} with {world.name} can't be used as a map: {first_line(error)}") from None
    if turned or turned_too or across <= 0 or down >= 0:
        raise DappledError(f"{file}: a map must be north up; warp it first (gdalwarp -t_srs EPSG:4326)")
    west, north = left - across / 2, top - down / 2
    east, south = west + across * width, north + down * height
    if not (-180 <= west < east <= 181 and -90 <= south < north <= 90):
        raise DappledError(f"{file} is not in degrees; warp it first (gdalwarp -t_srs EPSG:4326)")
    return Background(file, north, south, east, west)


def oriented_frame(
    pose: Mapping[str, Any], size_mm: tuple[float, float] | None, focal_length_mm: float | None, mount: Sequence[float]
) -> OrientedFrame | None:
    """From the `pose` of a header; None where something is unknown. The ground is level, as high as straight below
    where that was measured, else as the take-off point."""
    above_m = pose.get("height_above_ground_m")
    above_m = pose.get("height_above_home_m") if above_m is None else above_m
    needed = (pose["latitude_deg"], pose["longitude_deg"], above_m, pose["attitude"])
    if any(value is None for value in needed) or size_mm is None or not focal_length_mm:
        return None
    height = float(above_m or 0.0)
    if height <= 0.5:
        return None
    rotation = camera_pose.matrix_of(tuple(pose["attitude"])) @ np.asarray(mount, dtype=np.float64).reshape(3, 3)
    return OrientedFrame(size_mm, focal_length_mm, rotation, height, pose["latitude_deg"], pose["longitude_deg"])


def network_link_kml(href: str) -> bytes:
    """A document that a globe opens once; the globe then reads `href` every two seconds."""
    target = node("Link", node("href", href), node("refreshMode", "onInterval"), node("refreshInterval", "2"))
    return page(node("name", "dappled"), node("NetworkLink", node("name", "dappled, the latest frame"), target))


def latest_kml(
    name: str, picture: str, frame: RectifiedFrame | None, track: Sequence[tuple[float, float, float]]
) -> bytes:
    """The frame's picture as an overlay, and the track of (longitude, latitude, altitude above sea level)."""
    shown = [node("name", "dappled")]
    if frame is not None:
        sides = {"north": frame.north, "south": frame.south, "east": frame.east, "west": frame.west}
        shown.append(overlay(name, picture, box("LatLonBox", sides)))
    if len(track) > 1:
        places = node("coordinates", " ".join(f"{lon:.8f},{lat:.8f},{alt:.2f}" for lon, lat, alt in track))
        line = node("LineString", node("altitudeMode", "absolute"), places)
        shown.append(node("Placemark", node("name", "track"), line))
    return page(*shown)
