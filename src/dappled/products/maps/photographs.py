"""Turn a flight's frames into photographs: the decoded image, and the eye (camera geometry) that took it."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from dappled.config.profiles import CameraProfile, Lens
from dappled.decode.array_types import Floats, Singles
from dappled.decode.geometry import Pose, camera_pose
from dappled.decode.geometry.camera_pose import CameraPose, Matrix
from dappled.decode.lightfield import LightField
from dappled.decode.optics import Sensor
from dappled.drivers.raw import developing
from dappled.drivers.raw.picture_maker import MadePicture
from dappled.drivers.raw.raw_file import RawFile
from dappled.errors import DappledError
from dappled.findings import FRAME, Code, Evidence, Finding, Subject, finding
from dappled.flight import Frame, LedgerReader, Tag, layout
from dappled.products.maps.earth import Projection
from dappled.products.maps.eye import Eye, intrinsics, through
from dappled.products.mounting import Mounting

DEFAULT_POSITION_SIGMA_M = 3.0
DEFAULT_ATTITUDE_SIGMA_RAD = 0.02


_NOMINAL_SIGMA = 0.02  # relative, of the aperture that an f-number tells: nominal f/22 is 22.6


class PhotographError(DappledError):
    """A frame can't be placed on the map."""


@dataclass(frozen=True, slots=True)
class Station:
    """A frame with its tag and the camera's position and attitude."""

    frame: Frame
    tag: Tag
    camera: CameraPose
    camera_to_ned: Matrix

    @property
    def name(self) -> str:
        """The frame's number, as in its file name."""
        return Path(self.frame.name).stem

    @property
    def ground_m(self) -> float | None:
        """The height of home above sea level, from the autopilot; None where unknown."""
        height = self.camera.height_above_home_m
        return None if height is None else self.camera.altitude_msl_m - height

    def eye(self, projection: Projection, sensor: Sensor, lens: Lens, grid: Matrix, shape: tuple[int, int]) -> Eye:
        """The eye on the map, for samples of this `shape` that lie on the sensor by `grid` (2, 3), as in `LightField`.
        Raises EarthError."""
        at = projection.at(self.camera.latitude_deg, self.camera.longitude_deg)
        centre = np.array([at.east, at.north, self.camera.altitude_msl_m])
        rotation = at.from_ned() @ self.camera_to_ned
        return Eye(intrinsics(sensor, lens, grid), lens.distortion, rotation, centre, at.scale, shape)


def home_m(stations: Sequence[Station]) -> float | None:
    """The height of home above sea level, the middle one of what the stations tell; None where none does."""
    told = [one.ground_m for one in stations if one.ground_m is not None]
    return float(np.median(told)) if told else None


@dataclass(frozen=True, slots=True)
class ApertureWidth:
    """The full aperture's diameter (m), its standard error, None where unknown; `source` is "carriers" where the frame
    showed it, else "f-number"."""

    width_m: float
    sigma_m: float | None
    source: str


@dataclass(frozen=True, slots=True, eq=False)
class Photograph:
    """One frame's image float32 (h, w) or (h, w, 3), linear, 1.0 = sensor white, and its eye on the map.

    Sigmas are one standard deviation of the eye's centre (m) and attitude (rad) as recorded. `grid` maps to the
    sensor, as in `LightField`. With `views` (n, h, w[, 3]) and their aperture points, maps are drawn from the views:
    their mean on the ground is the frame refocused there. `doubts` are the picture's and the light field's,
    `mask_nats` the log odds that this shows its mask, or that its frame did in flight, None where neither is known;
    `lens` is that of the eye.
    """

    name: str
    utc_ns: int
    image: Singles
    eye: Eye
    position_sigma_m: float
    attitude_sigma_rad: float
    grid: NDArray[np.float64]
    views: Singles | None = None
    apertures_m: NDArray[np.float64] | None = None
    aperture: ApertureWidth | None = None
    doubts: tuple[Finding, ...] = ()
    lens: Lens | None = None
    mask_nats: float | None = None

    @property
    def grey(self) -> Singles:
        """The image (h, w, 1), the mean of its colours."""
        image = np.asarray(self.image, dtype=np.float32)
        return np.ascontiguousarray(image.mean(axis=2) if image.ndim == 3 else image)[..., None]

    def at(self, sensor_px: Floats) -> Floats:
        """(n, 2): the pixels (x, y) at which this shows the sensor's (n, 2), as (column, row)."""
        there = (sensor_px[:, ::-1] - self.grid[:, 2]) @ np.linalg.inv(self.grid[:, :2]).T
        return np.asarray(there[:, ::-1])

    def eye_on(self, grid: Matrix, shape: tuple[int, int]) -> Eye:
        """The same eye for samples that lie elsewhere on the sensor: `grid` (2, 3) and their `shape`, as in
        `LightField`."""
        mine, theirs = (np.vstack([one[::-1, [1, 0, 2]], [0, 0, 1]]) for one in (self.grid, grid))
        return replace(self.eye, matrix=np.linalg.inv(theirs) @ mine @ self.eye.matrix, shape=shape)

    def reduced(self, step: int) -> Photograph:
        """The photograph with means of `step` × `step` pixels in place of each, without views."""
        rows, columns = (side // step for side in self.eye.shape)
        blocks = self.image[: rows * step, : columns * step].reshape(rows, step, columns, step, -1)
        image = blocks.mean(axis=(1, 3), dtype=np.float32)
        coarser = np.array([[step, 0, (step - 1) / 2], [0, step, (step - 1) / 2], [0, 0, 1]])
        grid = self.grid[:, :3] @ coarser
        return replace(
            self, image=image[..., 0] if self.image.ndim == 2 else image, eye=self.eye_on(grid, (rows, columns)),
            grid=grid, views=None, apertures_m=None,
        )  # fmt: skip

    def layers(self, focus_m: float = math.inf) -> list[tuple[Singles, Eye]]:
        """The images that make up the map, each with its eye."""
        if self.views is None or self.apertures_m is None:
            return [(self.image, self.eye)]
        return [
            (view, through(self.eye, (float(y), float(x)), focus_m))
            for view, (y, x) in zip(self.views, self.apertures_m, strict=True)
        ]


def unplaced(name: str, why: Evidence) -> Finding:
    """Why a frame is not on the map."""
    return finding(Code.FRAME_UNPLACED, Subject("frame", name), why=why)


def stations(flight: Path, mounting: Mounting) -> tuple[list[Station], list[Finding]]:
    """A flight's frames that have a full pose, in order, and why the others have none.

    Raises FlightError.
    """
    frames, tags = recorded(flight)
    placed: list[Station] = []
    left: list[Finding] = []
    for frame in frames:
        try:
            placed.append(station(frame, tags.get(frame.index), mounting))
        except PhotographError as error:
            left.append(unplaced(frame.name, error))
    return placed, left


def recorded(flight: Path) -> tuple[list[Frame], dict[int, Tag]]:
    """A flight's safe frames and their tags. Raises FlightError."""
    with LedgerReader.open(layout.open_folder(flight).ledger) as ledger:
        return ledger.frames(), ledger.tags()


def flown_nats(flight: Path) -> dict[int, float]:
    """What decoding in flight told of the mask, by image index: the log odds that it is where it was calibrated. Raises
    FlightError."""
    with LedgerReader.open(layout.open_folder(flight).ledger) as ledger:
        return {at: one.mask_nats for at, one in ledger.results().items() if one.mask_nats is not None}


def station(frame: Frame, tag: Tag | None, mounting: Mounting) -> Station:
    """Where a frame was taken. Raises PhotographError where its pose isn't known."""
    if tag is None:
        raise PhotographError(f"{frame.name} was never tagged: `dappled geotag` tags frames that a crash left untagged")
    camera = mounting.camera(tag.pose)
    if camera is None:
        raise PhotographError(f"no position is known for {frame.name}: there was no telemetry at its exposure")
    attitude = tag.pose.gimbal_attitude if mounting.on_gimbal else tag.pose.attitude
    if attitude is None:
        whose = "of the gimbal " if mounting.on_gimbal else ""
        raise PhotographError(f"no attitude {whose}is known for {frame.name}: there was none in its telemetry")
    return Station(frame, tag, camera, camera_pose.matrix_of(attitude) @ mounting.matrix)


def lens_of(profile: CameraProfile, focal_length_mm: float, focus_m: float = math.inf) -> Lens:
    """The calibrated lens, or a plain one focused at a distance: v = f / (1 − f/F). Raises PhotographError for a
    distance within the focal length."""
    share = focal_length_mm * 1e-3 / focus_m
    if share >= 1:
        raise PhotographError(f"a lens of {focal_length_mm:g} mm can't be focused at {focus_m:g} m: see --focus")
    return profile.lens(focal_length_mm) or Lens(focal_length_mm, focal_length_mm / (1 - share))


def eye_of(
    station: Station, field: LightField, profile: CameraProfile, projection: Projection, *, focus_m: float = math.inf
) -> Eye:
    """The eye of a light field's mean view on the map, its lens focused at a distance.

    Raises PhotographError, ConfigError, EarthError.
    """
    rows, columns = field.attributes["shape"]
    lens = lens_of(profile, _focal_length_mm(station, field.attributes.get("focal_length_mm")), focus_m)
    sensor, shape = profile.sensor((int(rows), int(columns))), (field.slices.shape[1], field.slices.shape[2])
    return station.eye(projection, sensor, lens, field.grid, shape)


def foreseen(
    station: Station, profile: CameraProfile, projection: Projection, focal_length_mm: float | None, focus_m: float
) -> Photograph:
    """What a frame will show, by its pose and the camera's largest raw shape: a photograph without a picture. Raises as
    `eye_of`."""
    sensor = max((known.sensor for known in profile.raw), key=lambda one: math.prod(one.size_mm))
    lens = lens_of(profile, _focal_length_mm(station, focal_length_mm), focus_m)
    grid: Matrix = np.eye(2, 3)
    eye = station.eye(projection, sensor, lens, grid, sensor.shape)
    nothing = np.empty((0, 0), np.float32)
    return Photograph(station.name, station.tag.utc_ns, nothing, eye, *_sigmas(station.tag.pose), grid, lens=lens)


def of_picture(
    station: Station,
    made: MadePicture,
    profile: CameraProfile,
    projection: Projection,
    *,
    focus_m: float = math.inf,
    colour: bool = True,
) -> Photograph:
    """The photograph of a frame's picture at the sensor's own resolution. Raises as `eye_of`."""
    lens = lens_of(profile, _focal_length_mm(station, made.focal_length_mm), focus_m)
    shape = made.picture.shadow.shape
    grid: Matrix = np.eye(2, 3)
    eye = station.eye(projection, made.sensor, lens, grid, shape)
    doubts = tuple(replace(one, subject=FRAME) for one in made.doubts)
    return Photograph(
        station.name, station.tag.utc_ns, developing.linear(made, colour=colour), eye, *_sigmas(station.tag.pose), grid,
        doubts=doubts, lens=lens,
    )  # fmt: skip


def _focal_length_mm(station: Station, told: float | None) -> float:
    known = told or station.tag.focal_length_mm
    if known is None:
        raise PhotographError(f"the focal length of {station.frame.name} is unknown: give it with --focal-length")
    return float(known)


def photograph(
    station: Station,
    field: LightField,
    profile: CameraProfile,
    projection: Projection,
    *,
    view: str = "mean",
    focus_m: float = math.inf,
) -> Photograph:
    """A decoded frame's photograph; `view` is "mean", "ground" (all views, to be laid over each other on the ground),
    or "v,u", the row and column of one view. Raises PhotographError where there is no such view, and as `eye_of`."""
    eye = eye_of(station, field, profile, projection, focus_m=focus_m)
    image, views, apertures, aperture = mean_view(field), None, None, None
    if view == "ground" and field.views.shape[0]:
        views, aperture = field.views.reshape(-1, *field.views.shape[2:]), aperture_of(station, field)
        apertures = field.view_offsets.reshape(-1, 2) * aperture.width_m
    elif view not in ("mean", "ground"):
        v, u = _which(view, field)
        image = np.ascontiguousarray(field.views[v, u])
        y, x = field.view_offsets[v, u] * aperture_of(station, field).width_m
        eye = through(eye, (float(y), float(x)), focus_m)
    sigmas = _sigmas(station.tag.pose)
    return Photograph(
        station.name, station.tag.utc_ns, image, eye, *sigmas, field.grid, views, apertures, aperture, field.doubts,
        lens_of(profile, _focal_length_mm(station, field.attributes.get("focal_length_mm")), focus_m),
    )  # fmt: skip


def aperture_of(station: Station, field: LightField) -> ApertureWidth:
    """The full aperture: focal length / f-number, the one that the carriers show where they do. Raises PhotographError
    where one is unknown."""
    length_m = _focal_length_mm(station, field.attributes.get("focal_length_mm")) * 1e-3
    shown, sigma = (field.attributes.get(f"f_number_shown{word}") for word in ("", "_sigma"))
    if shown and sigma:
        return ApertureWidth(length_m / float(shown), length_m / float(shown) ** 2 * float(sigma), "carriers")
    f_number = field.attributes.get("f_number") or station.tag.f_number
    if f_number is None:
        raise PhotographError(
            f"the f-number of {station.frame.name} is unknown: give it with --f-number, or map its mean"
        )
    width_m = length_m / float(f_number)
    off = max(_NOMINAL_SIGMA, abs(float(f_number) / float(shown) - 1)) if shown else _NOMINAL_SIGMA
    return ApertureWidth(width_m, off * width_m, "f-number")


def true_colours(raw: RawFile) -> NDArray[np.float64] | None:
    """(3,) gains for the red, green and blue of the views; None for a frame without these colours.

    The decoder gives all colours of a frame one mean, so that the mosaic has no impulse of its own. The gains undo that
    and apply the camera's white balance, so that neighbouring frames show the ground in one colour.
    """
    names = raw.colour_names
    if raw.cfa is None or not set("RGB") <= set(names):
        return None
    blacks = raw.black if isinstance(raw.black, tuple) else (raw.black,) * len(names)
    a, b = raw.cfa.shape
    means: dict[str, list[float]] = {}
    for (row, column), index in np.ndenumerate(raw.cfa):
        level = float(raw.mosaic[row::a, column::b].mean(dtype=np.float64)) - blacks[index]
        means.setdefault(names[index], []).append(max(level, 0.0))
    balance = dict(zip(names, raw.balance, strict=True)) if raw.balance is not None else {}
    light = {name: float(np.mean(means[name])) * balance.get(name, 1.0) for name in "RGB"}
    if not light["G"] > 0:
        return None
    return np.array([light[name] / light["G"] for name in "RGB"])


def mean_view(field: LightField) -> Singles:
    """The mean of the views; without views the DC slice, which is the same picture in grey."""
    if field.views.shape[0]:
        return np.asarray(field.views.mean(axis=(0, 1), dtype=np.float32))
    return np.ascontiguousarray(field.slices[0].real)


def _which(view: str, field: LightField) -> tuple[int, int]:
    rows, columns = field.views.shape[:2]
    if not rows:
        raise PhotographError("the frame has no views, only slices: decode it with a calibration, or map its mean")
    try:
        v, u = (int(word) for word in view.split(","))
    except ValueError:
        raise PhotographError(f"{view!r} does not name a view: give row,column, as 0,4") from None
    if not (0 <= v < rows and 0 <= u < columns):
        raise PhotographError(f"there is no view {view}: rows go to {rows - 1}, columns to {columns - 1}")
    return v, u


def pose_sigmas(photographs: Sequence[Photograph], given: tuple[float, float] | None) -> Floats:
    """(n, 2): σ of each one's position (m) and attitude (rad), or those that are given for all."""
    return np.array([given or (one.position_sigma_m, one.attitude_sigma_rad) for one in photographs])


def _sigmas(pose: Pose) -> tuple[float, float]:
    position, attitude = pose.position_sigma_m, pose.attitude_sigma_rad
    return (
        DEFAULT_POSITION_SIGMA_M if position is None else position,
        DEFAULT_ATTITUDE_SIGMA_RAD if attitude is None else attitude,
    )
