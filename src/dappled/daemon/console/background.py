"""A picture behind the track: a PNG or JPEG in degrees, with the world file that GIS programs write beside it."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

from PIL import Image, UnidentifiedImageError

from dappled.errors import DappledError

_WORLD = {".png": ".pgw", ".jpg": ".jgw", ".jpeg": ".jgw"}


class BackgroundError(DappledError):
    """A map can't be used; one sentence."""


@dataclass(frozen=True, slots=True)
class Background:
    """The picture's file, and its bounds in degrees."""

    file: Path
    north: float
    south: float
    east: float
    west: float

    def bounds(self) -> dict[str, float]:
        """The bounds as JSON values."""
        return {"north": self.north, "south": self.south, "east": self.east, "west": self.west}


def load(file: Path) -> Background:
    """A map and its world file: six lines, degrees a pixel and the middle of the first pixel. Raises BackgroundError
    for a picture that isn't one, is turned, or lies off the Earth."""
    if file.suffix.lower() not in _WORLD:
        raise BackgroundError(f"{file}: a map is a PNG or a JPEG")
    world = next((p for p in (file.with_suffix(_WORLD[file.suffix.lower()]), file.with_suffix(".wld")) if p.is_file()),
                 None)  # fmt: skip
    if world is None:
        raise BackgroundError(
            f"{file} has no world file {file.with_suffix(_WORLD[file.suffix.lower()]).name} beside it"
        )
    try:
        across, turned, turned_too, down, left, top = (float(line) for line in world.read_text().split())
        with Image.open(file) as picture:
            width, height = picture.size
    except (OSError, ValueError, UnidentifiedImageError) as error:
        raise BackgroundError(f"{file} with {world.name} can't be used as a map: {error}") from None
    if turned or turned_too or across <= 0 or down >= 0:
        raise BackgroundError(f"{file}: a map must be north up; warp it first (gdalwarp -t_srs EPSG:4326)")
    west, north = left - across / 2, top - down / 2
    east, south = west + across * width, north + down * height
    if not (-180 <= west < east <= 181 and -90 <= south < north <= 90):
        raise BackgroundError(f"{file} is not in degrees; warp it first (gdalwarp -t_srs EPSG:4326)")
    return Background(file, north, south, east, west)
