"""Find which ground a flight's frames have seen: by how many frames, and from how many directions."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from dappled.config import profiles
from dappled.decode.array_types import Floats
from dappled.decode.geometry.area import PlannedArea
from dappled.decode.optics import Sensor
from dappled.drivers.raw import reading
from dappled.errors import DappledError
from dappled.findings import Code, Finding, Level, Subject, finding, text
from dappled.flight import LedgerReader, layout
from dappled.products.maps import ground as grounds
from dappled.products.maps.earth import EarthError, Projection, utm
from dappled.products.maps.eye import Eye, EyeError
from dappled.products.maps.ground import Flat, Ground
from dappled.products.maps.map_grid import MapError, MapGrid, around, footprint
from dappled.products.maps.photographs import PhotographError, Station, home_m, lens_of, stations, unplaced
from dappled.products.mounting import Mounting

CELLS = 500  # on the longer side, where no cell is asked for
STEEP_RAD = math.radians(10)  # a ray nearer to the vertical counts as one from above, whatever its azimuth
_SECTORS = 8
_DEEPER = 0.5  # of the height above ground: terrain is read as far as frames would see that much lower ground
MOST_CELLS = 25_000_000
_DOUBTFUL = 0.25  # of a footprint's shorter side: a frame that is placed less well may have seen other ground
_SILENT_MS = 2000.0  # a receiver's fix of longer ago says nothing about the exposure
_FIX_3D = 3  # GPS_FIX_TYPE
_ALIKE = 0.05  # sensors whose sides differ by less see the same ground


@dataclass(frozen=True, slots=True, eq=False)
class FramesSeen:
    """The frames that count, with their eyes by name, on a map; and why the others don't. `unjudged` of
    those that count have no verdict, or an unknown one."""

    flight: str
    projection: Projection
    ground: Ground
    eyes: dict[str, Eye]
    stations: tuple[Station, ...]
    left: tuple[Finding, ...]
    mounting: Mounting = field(default_factory=Mounting)
    unjudged: int = 0


@dataclass(frozen=True, slots=True, eq=False)
class Coverage:
    """For each cell of the grid (rows, columns) how many frames saw it, and from how many directions: straight from
    above, and 8 azimuths. `planned` is where the area lies; all true without one (not `bounded`), and then nothing is
    a hole. Where the ground's height is not known (`unknown`), no frame counts as having seen it."""

    grid: MapGrid
    frames: NDArray[np.uint16]
    directions: NDArray[np.uint8]
    planned: NDArray[np.bool_]
    bounded: bool = True
    unknown: NDArray[np.bool_] | None = None

    def holes(self, least: int = 1) -> NDArray[np.bool_]:
        """The planned cells that fewer than `least` frames saw."""
        return self.planned & (self.frames < least) & self.bounded

    @property
    def unknown_cells(self) -> int:
        """How many of the planned cells have no height."""
        return 0 if self.unknown is None else int((self.planned & self.unknown).sum())

    @property
    def cell_m2(self) -> float:
        """The area of a cell on the map."""
        return self.grid.step_x * self.grid.step_y


def of_flight(
    flight: Path,
    *,
    area: PlannedArea | None = None,
    terrain: Path | None = None,
    ground_m: float | None = None,
    count_bad: bool = False,
    count_doubtful: bool = False,
) -> FramesSeen:
    """A flight's frames that can be placed on the ground; those judged bad only with `count_bad`, and those whose place
    or time is in doubt only with `count_doubtful`.

    The ground is `terrain`, read below the frames and the `area`, else flat at `ground_m`, else flat at home's height.
    Raises DappledError, FlightError, DappledError, ConfigError.
    """
    folder = layout.open_folder(flight)
    with LedgerReader.open(folder.ledger) as ledger:
        results = ledger.results()
    states = {index: one.verdict.state for index, one in results.items() if one.verdict is not None}
    mounting = Mounting.of(layout.read_facts(folder))
    placed, left = stations(flight, mounting)

    def keep(doubt: Callable[[Station], Finding | None]) -> None:
        found = [(one, doubt(one)) for one in placed]
        left.extend(why for _, why in found if why is not None)
        placed[:] = [one for one, why in found if why is None]

    if not count_bad:
        keep(lambda one: finding(Code.FRAME_JUDGED_BAD, _of(one)) if states.get(one.frame.index) == "bad" else None)
    if not count_doubtful:
        keep(doubt_of)
    if not placed:
        why = f": {text(left[0])}" if left else ""
        raise DappledError(f"{folder.name} has no frame that can be placed on the ground{why}")
    middle = [sorted(side)[len(placed) // 2] for side in zip(*(_where(one) for one in placed), strict=True)]
    projection = Projection(utm(middle[0], middle[1]))
    eyes: dict[str, Eye] = {}
    sensors: dict[str, Sensor] = {}
    for one in placed:
        try:
            if one.tag.camera not in sensors:
                sensors[one.tag.camera] = _sensor(one, folder.path)
            eyes[one.name] = eye_of(one, projection, sensors[one.tag.camera])
        except (PhotographError, EyeError, EarthError) as error:
            left.append(unplaced(one.frame.name, error))
    placed = [one for one in placed if one.name in eyes]
    if placed:
        corners = [] if area is None else area.on_map(projection)
        ground = _ground(placed, [*eyes.values()], projection, terrain=terrain, ground_m=ground_m, corners=corners)
        keep(lambda one: _off(one, eyes[one.name], ground, count_doubtful=count_doubtful))
    if not placed:
        raise DappledError(f"{folder.name} has no frame that looks at the ground: {text(left[-1])}")
    return FramesSeen(
        folder.name,
        projection,
        ground,
        {one.name: eyes[one.name] for one in placed},
        tuple(placed),
        tuple(left),
        mounting,
        unjudged=sum(states.get(one.frame.index, "unknown") == "unknown" for one in placed),
    )


def _where(station: Station) -> tuple[float, float]:
    return station.camera.latitude_deg, station.camera.longitude_deg


def _of(station: Station) -> Subject:
    return Subject("frame", station.frame.name)


def doubt_of(station: Station) -> Finding | None:
    """Why it is in doubt where a frame was taken; None where it isn't."""
    pose = station.tag.pose
    if pose.source not in ("interpolated", "mark"):
        return finding(Code.POSITION_FAR_TELEMETRY, _of(station), age_s=(pose.age_ms or 0) / 1e3)
    if station.tag.doubts:
        codes = ", ".join(one.code for one in station.tag.doubts)
        return finding(Code.POSITION_TIME_DOUBTED, _of(station), codes=codes)
    if pose.source == "mark" or pose.gnss is None or pose.gnss.age_ms > _SILENT_MS:
        return None  # no receiver that says how it is: `unjudged` tells that
    return finding(Code.POSITION_WITHOUT_FIX, _of(station)) if pose.gnss.fix_type < _FIX_3D else None


def _off(station: Station, eye: Eye, ground: Ground, *, count_doubtful: bool) -> Finding | None:
    """Why a frame can't be put on the ground: it is below it, or known less well than its footprint asks."""
    level = float(ground.heights(eye.centre[:1], eye.centre[1:2])[0])
    if not math.isfinite(level):
        return None  # beyond the terrain, which `cover` tells
    if not eye.centre[2] > level:
        at = {"camera_m": float(eye.centre[2]), "ground_m": level}
        return Finding(Code.FRAME_UNDERGROUND, _of(station), at, Level.CAUTION)
    sigma_m = station.tag.pose.position_sigma_m
    if count_doubtful or sigma_m is None:
        return None
    side_m = min(eye.shape) * eye.gsd_m(level)
    coarse = finding(Code.POSITION_TOO_COARSE, _of(station), sigma_m=sigma_m)
    return None if sigma_m <= _DOUBTFUL * side_m else coarse


def _ground(
    placed: Sequence[Station],
    eyes: Sequence[Eye],
    projection: Projection,
    *,
    terrain: Path | None,
    ground_m: float | None,
    corners: Sequence[Floats],
) -> Ground:
    if ground_m is None:
        ground_m = home_m(placed)
        if ground_m is None and terrain is None:
            raise DappledError(
                "the height of the ground is not known (the telemetry has no height above home): give --ground or "
                "--terrain"
            )
    if ground_m is None:
        ground_m = min(one.camera.altitude_msl_m for one in placed) - 100
    flat = Flat(ground_m)
    if terrain is None:
        return flat
    seen = [eye.on_plane(eye.border(), ground_m - _DEEPER * abs(eye.centre[2] - ground_m))[:, :2] for eye in eyes]
    met = np.concatenate([*seen, *(eye.centre[None, :2] for eye in eyes), *corners])
    met = met[np.isfinite(met).all(axis=1)]
    bounds = (*met.min(axis=0).tolist(), *met.max(axis=0).tolist())
    return grounds.load(terrain, projection, (bounds[0], bounds[1], bounds[2], bounds[3]))


def _sensor(station: Station, flight: Path) -> Sensor:
    """The sensor that took a frame: where its camera's profile has frames of several sizes, the file says which.

    Raises PhotographError."""
    with _sized(station):
        profile = profiles.camera(station.tag.camera)
        sizes = [known.sensor.size_mm for known in profile.raw]
        if np.allclose(sizes, sizes[0], rtol=_ALIKE):
            return profile.raw[0].sensor
        rows, columns = reading.read(flight / station.frame.name).mosaic.shape[:2]
        return profile.sensor((rows, columns))


@contextmanager
def _sized(station: Station) -> Iterator[None]:
    """Context in which what goes wrong leaves the size of a frame's sensor unknown, as a PhotographError."""
    try:
        yield
    except DappledError as error:
        raise PhotographError(f"the size of the sensor of {station.frame.name} is unknown: {error}") from None


def eye_of(station: Station, projection: Projection, sensor: Sensor | None = None) -> Eye:
    """The eye of a frame's whole sensor, by its tag and the camera's profile; `sensor` None: the first of the profile.

    Raises PhotographError where the focal length or the camera isn't known, EyeError where it looks at the horizon.
    """
    focal_mm = station.tag.focal_length_mm
    if focal_mm is None:
        raise PhotographError(f"the focal length of {station.frame.name} is unknown")
    with _sized(station):
        profile = profiles.camera(station.tag.camera)
    sensor = sensor or profile.raw[0].sensor
    eye = station.eye(projection, sensor, lens_of(profile, focal_mm), np.eye(2, 3), sensor.shape)
    eye.check_horizon(station.frame.name)
    return eye


def grid_of(seen: FramesSeen, area: PlannedArea | None, cell_m: float | None = None) -> MapGrid:
    """A grid over the area, else over what the frames saw. Raises DappledError, MapError."""
    points: list[Floats] = [] if area is None else area.on_map(seen.projection)
    if area is None:
        for eye in seen.eyes.values():
            try:
                points.append(footprint(eye, seen.ground)[:, :2])
            except MapError:
                continue  # beyond the terrain: the other frames say where the map lies
    if not points:
        raise DappledError(f"no frame lies on the ground ({seen.ground.name}): give terrain that covers the flight")
    every = np.concatenate(points)
    step = cell_m or max(float(np.ptp(every, axis=0).max()) / CELLS, 0.01)
    cells = math.prod(float(side) / step + 1 for side in np.ptp(every, axis=0))
    if cells > MOST_CELLS:
        raise DappledError(
            f"the map would have {cells / 1e6:.0f} million cells of {step:.2g} m: give a --cell of "
            f"{step * math.sqrt(cells / MOST_CELLS) * 1.01:.2g} or more"
        )
    return around(every, seen.projection.name, step, step)


def cover(seen: FramesSeen, grid: MapGrid, area: PlannedArea | None = None) -> Coverage:
    """Count the frames and directions that saw each cell's middle. Raises DappledError where the ground's height is
    nowhere known."""
    east, north = grid.places(seen.projection)
    height = seen.ground.heights(east, north)
    if not np.isfinite(height).any():
        raise DappledError(f"the terrain {seen.ground.name} has no heights there: give one that covers the area")
    planned = np.ones(grid.shape, bool) if area is None else area.inside(seen.projection, east, north)
    frames, from_where = np.zeros(grid.shape, np.uint16), np.zeros(grid.shape, np.uint16)
    for eye in seen.eyes.values():
        rows, columns = _reach(eye, seen.ground, grid)
        if not (rows.stop > rows.start and columns.stop > columns.start):
            continue
        at = (rows, columns)
        shown, sector = _shown(eye, seen.ground, east[at], north[at], height[at])
        frames[at] += shown
        from_where[at] |= np.where(shown, np.uint16(1) << sector, 0).astype(np.uint16)
    directions = np.sum([(from_where >> n) & 1 for n in range(_SECTORS + 1)], axis=0).astype(np.uint8)
    return Coverage(grid, frames, directions, planned, area is not None, ~np.isfinite(height))


def _reach(eye: Eye, ground: Ground, grid: MapGrid) -> tuple[slice, slice]:
    """The rows and columns that a frame can have seen; all of them where its footprint leaves the terrain."""
    try:
        x, y, _ = footprint(eye, ground).T
    except MapError:
        return slice(0, grid.shape[0]), slice(0, grid.shape[1])
    margin = 0 if isinstance(ground, Flat) else 0.1 * max(np.ptp(x), np.ptp(y))  # a hill shows beyond the border
    east, north = (np.array([side.min() - margin, side.max() + margin]) for side in (x, y))
    return grid.reached(east, north)


def _shown(
    eye: Eye, ground: Ground, east: Floats, north: Floats, height: Floats
) -> tuple[NDArray[np.bool_], NDArray[np.uint16]]:
    """Which cells a frame shows, and the direction that it saw each from: 0 above, else 1 to 8 by azimuth."""
    places = np.stack([east, north, height], axis=-1).reshape(-1, 3)
    rows, columns = eye.shape
    x, y = eye.project(places).T
    inside = (x >= -0.5) & (x <= columns - 0.5) & (y >= -0.5) & (y <= rows - 0.5) & _in_lens(eye, places)
    shown = inside.reshape(east.shape) & ground.sees(eye, east, north, height)
    aside = np.hypot(eye.centre[0] - east, eye.centre[1] - north)
    azimuth = np.arctan2(eye.centre[0] - east, eye.centre[1] - north)
    sector = 1 + np.floor((azimuth + math.pi) / (2 * math.pi) * _SECTORS).astype(np.int64) % _SECTORS
    above = aside <= np.tan(STEEP_RAD) * (eye.centre[2] - height)
    return shown, np.where(above, 0, sector).astype(np.uint16)


def _in_lens(eye: Eye, places: Floats) -> NDArray[np.bool_]:
    """Whether places (n, 3) lie within the angle that the lens takes in: beyond it the polynomials of its distortion
    turn back, and would put far ground into the picture."""
    if not any(eye.distortion):
        return np.ones(len(places), dtype=bool)
    edge, seen = ((rays / (eye.scale, eye.scale, 1.0)) @ eye.rotation for rays in (
        eye.rays(eye.border()), places - eye.centre,
    ))  # fmt: skip
    widest = float((np.hypot(edge[:, 0], edge[:, 1]) / edge[:, 2]).max())
    return np.asarray(np.hypot(seen[:, 0], seen[:, 1]) <= 1.02 * widest * seen[:, 2])
