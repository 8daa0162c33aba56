"""How much of the planned area the frames so far have seen, for the console: a share, and the holes as a picture."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Any

import numpy as np

from dappled.daemon.console import pictures
from dappled.decode.array_types import Floats
from dappled.decode.geometry.area import PlannedArea, within

_LONGER_SIDE = 240  # cells
_METRES_PER_DEGREE = 111_319.49
_HOLE, _STRIPE = (200, 60, 20, 120), 6  # red, green, blue, opacity; a stripe each so many cells

Corners = Sequence[tuple[float, float]]  # (latitude, longitude), degrees


class _Metres:
    """East and north of a place, for an area of some kilometres."""

    def __init__(self, latitude_deg: float, longitude_deg: float) -> None:
        self._origin = latitude_deg, longitude_deg
        self._east_m = _METRES_PER_DEGREE * math.cos(math.radians(latitude_deg))

    def to_map(self, latitude_deg: Floats, longitude_deg: Floats) -> tuple[Floats, Floats]:
        east = (longitude_deg - self._origin[1] + 540) % 360 - 180
        return east * self._east_m, (latitude_deg - self._origin[0]) * _METRES_PER_DEGREE


class SeenGround:
    """Counts, for each cell of the area, the frames whose footprint covers the cell's middle. Use it from one thread.

    The cells are those of a grid with 240 along the area's longer side.
    """

    def __init__(self, area: PlannedArea) -> None:
        self._area = area
        places = np.array([place for ring in area.rings for place in ring])
        places[:, 1] = places[0, 1] + (places[:, 1] - places[0, 1] + 540) % 360 - 180  # across 180° too
        south, west = places.min(axis=0)
        north, east = places.max(axis=0)
        self.bounds = {"north": float(north), "south": float(south), "east": float(east), "west": float(west)}
        self._metres = _Metres((south + north) / 2, (west + east) / 2)
        (left, right), (bottom, top) = self._metres.to_map(np.array([south, north]), np.array([west, east]))
        step = max(right - left, top - bottom, 1e-3) / _LONGER_SIDE
        across, down = (max(1, round(side / step)) for side in (right - left, top - bottom))
        self._east, self._north = np.meshgrid(
            left + (np.arange(across) + 0.5) * (right - left) / across,
            top - (np.arange(down) + 0.5) * (top - bottom) / down,
        )
        self._planned = area.inside(self._metres, self._east, self._north)
        self._frames = np.zeros(self._planned.shape, dtype=np.int32)
        self._counted: dict[int, tuple[tuple[float, float], ...]] = {}
        self.version = 0

    def put(self, frame: int, corners: Corners | None) -> None:
        """A frame saw the ground between these corners; None: it saw none that counts, or is not to count any more."""
        new = None if corners is None else tuple((float(a), float(b)) for a, b in corners)
        old = self._counted.pop(frame, None)
        if new is not None:
            self._counted[frame] = new
        if new == old:
            return
        for one, by in ((old, -1), (new, 1)):
            if one is not None:
                ring = np.stack(self._metres.to_map(*np.array(one).T), axis=1)
                self._frames += by * within([ring], self._east, self._north)
        self.version += 1

    @property
    def share(self) -> float | None:
        """Of the planned cells, those that a frame or more has seen; None for an area smaller than a cell."""
        planned = int(self._planned.sum())
        return float((self._planned & (self._frames > 0)).sum() / planned) if planned else None

    def facts(self) -> dict[str, Any]:
        """As the page gets it with each health record."""
        return {"share": self.share, "frames": len(self._counted), "version": self.version}

    def outline(self) -> dict[str, Any]:
        """As a page gets it once: the area's name, its rings as (latitude, longitude), and its bounds in degrees."""
        return {"name": self._area.name, "rings": self._area.rings, "bounds": self.bounds}

    def holes_png(self) -> bytes:
        """What no frame has seen of the area, hatched; the rest is transparent."""
        rows, columns = np.indices(self._planned.shape)
        hatched = self._planned & (self._frames == 0) & ((rows + columns) % _STRIPE < _STRIPE // 2)
        return pictures.png(np.where(hatched[..., None], np.array(_HOLE, dtype=np.uint8), np.uint8(0)))
