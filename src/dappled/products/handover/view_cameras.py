"""The pinhole cameras of a frame's views, and where they stood: a record for each frame, and one world for a flight.

A masked light-field camera is a rig: each view is what a small lens at one aperture point sees. All of them look the
same way, and their places relative to each other follow from the f-number and focal length.
"""

from __future__ import annotations

import json
import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from dappled import codec
from dappled.bounds.parsing import parse_json
from dappled.decode.array_types import Floats
from dappled.decode.geometry import camera_pose
from dappled.errors import DappledError
from dappled.findings import Finding, first_by_name, told
from dappled.products.maps.eye import through
from dappled.products.maps.photographs import Photograph, Station

_RECORD_BYTES = 1 << 20
_SAME_STOP = 0.02  # relative: apertures that differ by less count as one
_SKEW = 1e-6  # of the focal length, over a whole picture a thousandth of a pixel


@dataclass(frozen=True, slots=True)
class ViewCamera:
    """One view: focal lengths and principal point in pixels (x, y), counted from the outer corner of the first pixel
    as in COLMAP, and its perspective centre from the frame's (m, camera axes: right, down, forward)."""

    name: str
    focal_px: tuple[float, float]
    principal_px: tuple[float, float]
    centre_m: tuple[float, float, float]


@dataclass(frozen=True, slots=True)
class FrameCameras:
    """All views of a frame and where it was taken: the record beside its pictures.

    `altitude_m` is above mean sea level, `height_m` above the ellipsoid (None: no geoid was given). `camera_to_ned` is
    the rotation row by row, from camera axes to north, east, down. `shape` is (rows, columns) of a view; `distortion`
    OpenCV's k1, k2, p1, p2, k3. The views stand as far apart as the aperture is wide: `aperture_m`, with its standard
    error and where it comes from ("carriers" or "f-number"). `focus_m` None was taken for infinity.
    """

    name: str
    utc_ns: int | None
    latitude_deg: float
    longitude_deg: float
    altitude_m: float
    height_m: float | None
    position_sigma_m: float | None
    vertical_sigma_m: float | None
    attitude_sigma_rad: float | None
    camera_to_ned: tuple[float, ...]
    shape: tuple[int, int]
    distortion: tuple[float, ...]
    views: tuple[ViewCamera, ...]
    aperture_m: float | None = None
    aperture_sigma_m: float | None = None
    aperture_from: str = ""
    focus_m: float | None = None
    doubts: tuple[Finding, ...] = ()

    def __post_init__(self) -> None:
        """Raises ValueError for a frame without views, a rotation or a distortion of another size."""
        sizes = len(self.camera_to_ned), len(self.distortion)
        if not self.views or sizes != (9, 5):
            raise ValueError(f"{len(self.views)} views, {sizes} numbers of rotation and distortion: not (9, 5)")

    def encoded(self) -> bytes:
        """The record as JSON."""
        return (json.dumps(codec.plain(self), indent=1, allow_nan=False) + "\n").encode()


@dataclass(frozen=True, slots=True)
class LocalAxes:
    """East, north and up from an origin: metres, without a map projection, so that angles and lengths are true.

    Mean sea level stands for the ellipsoid: where it is 50 m above it, lengths are wrong by 8 mm in 1 km.
    """

    latitude_deg: float
    longitude_deg: float
    altitude_m: float

    def place(self, frame: FrameCameras) -> tuple[Floats, Floats]:
        """(3, 3) from camera axes to this world's, and (3,) the frame's perspective centre."""
        home = math.radians(self.latitude_deg), math.radians(self.longitude_deg)
        there = math.radians(frame.latitude_deg), math.radians(frame.longitude_deg)
        to_enu = _NED_TO_ENU @ camera_pose.ned_to_ecef(*home).T
        away = camera_pose.to_ecef(*there, frame.altitude_m) - camera_pose.to_ecef(*home, self.altitude_m)
        turn = to_enu @ camera_pose.ned_to_ecef(*there) @ np.array(frame.camera_to_ned).reshape(3, 3)
        return turn, to_enu @ away

    def said(self) -> dict[str, Any]:
        """The origin, for other programs."""
        return {
            "latitude_deg": self.latitude_deg,
            "longitude_deg": self.longitude_deg,
            "altitude_m": self.altitude_m,
            "heights": "above mean sea level, taken for the WGS 84 ellipsoid",
            "axes": "east, north, up",
            "unit": "m",
        }


_NED_TO_ENU = np.array([[0.0, 1.0, 0.0], [1.0, 0.0, 0.0], [0.0, 0.0, -1.0]])


def of_photograph(
    one: Photograph, names: Sequence[str], station: Station, focus_m: float, utc_ns: int | None
) -> FrameCameras:
    """The cameras of a photograph's views, or of its one picture where it has no views.

    Raises DappledError where they are skewed or mirrored."""
    apertures = np.zeros((1, 2)) if one.apertures_m is None else one.apertures_m
    lens_axes = replace(one.eye, rotation=np.eye(3), centre=np.zeros(3), scale=1.0)
    straight, turn = upright(one.eye.matrix[:2, :2], station.frame.name)
    views = []
    for name, (y, x) in zip(names, apertures, strict=True):
        eye = through(lens_axes, (float(y), float(x)), focus_m)
        right, down, forward = (turn @ eye.centre).tolist()
        column, row = (eye.matrix[:2, 2] + 0.5).tolist()
        views.append(ViewCamera(name, straight, (column, row), (right, down, forward)))
    k1, k2, p1, p2, k3 = one.eye.distortion
    p2, p1 = (turn[:2, :2] @ [p2, p1]).tolist()
    pose, camera = station.tag.pose, station.camera
    to_ned = station.camera_to_ned @ turn.T
    return FrameCameras(
        station.name,
        utc_ns,
        camera.latitude_deg,
        camera.longitude_deg,
        camera.altitude_msl_m,
        camera.height_ellipsoid_m,
        pose.position_sigma_m,
        pose.vertical_sigma_m,
        pose.attitude_sigma_rad,
        tuple(to_ned.ravel().tolist()),
        one.eye.shape,
        (k1, k2, p1, p2, k3),
        tuple(views),
        None if one.aperture is None else one.aperture.width_m,
        None if one.aperture is None else one.aperture.sigma_m,
        "" if one.aperture is None else one.aperture.source,
        focus_m if math.isfinite(focus_m) else None,
        one.doubts,
    )


def upright(matrix: Floats, name: str) -> tuple[tuple[float, float], Floats]:
    """Focal lengths (x, y) and the turn (3, 3) about the optical axis that together are `matrix` (2, 2), from the plane
    at distance 1 to pixels: a picture whose rows are not the sensor's is one of a camera that is turned."""
    lengths = np.linalg.norm(matrix, axis=1)
    rows = matrix / lengths[:, None]
    if np.linalg.det(rows) < 0 or abs(float(rows[0] @ rows[1])) > _SKEW:
        raise DappledError(
            f"the views of {name} are skewed or mirrored against the sensor: other programs' cameras can't be; "
            "resample them first (dappled export)"
        )
    turn = np.eye(3)
    turn[0, :2] = rows[0]
    turn[1, :2] = -rows[0, 1], rows[0, 0]
    return (float(lengths[0]), float(lengths[1])), turn


def decoded(data: bytes, where: str) -> FrameCameras:
    """A record that was written. Raises DappledError."""
    try:
        return codec.read(FrameCameras, parse_json(data, _RECORD_BYTES))
    except ValueError as error:
        raise DappledError(
            f"{where} is no record of a frame's cameras: remove it, and run the batch again ({error})"
        ) from None


def of_one_aperture(frames: Sequence[FrameCameras]) -> list[FrameCameras]:
    """The frames, those of one lens and nearly one aperture with one and the same: the most likely of them all.

    Each frame shows its aperture with an error of its own. Frames more than `_SAME_STOP` from the others' median keep
    theirs, as do those that don't show one.
    """
    rigs: dict[object, list[int]] = {}
    for n, one in enumerate(frames):
        if one.aperture_m is not None and one.aperture_sigma_m:
            lens = one.shape, one.distortion, one.focus_m, one.aperture_from, tuple(v.focal_px for v in one.views)
            rigs.setdefault(lens, []).append(n)
    made = list(frames)
    for members in rigs.values():
        widths = np.array([frames[n].aperture_m for n in members], dtype=np.float64)
        sigmas = np.array([frames[n].aperture_sigma_m for n in members], dtype=np.float64)
        near = np.abs(widths / np.median(widths) - 1) < _SAME_STOP
        width = float(np.average(widths[near], weights=sigmas[near] ** -2.0))
        for n in np.array(members)[near]:
            made[n] = _widened(frames[n], width)
    return made


def _widened(one: FrameCameras, width_m: float) -> FrameCameras:
    """The frame with its views as far apart as in an aperture of this width."""
    assert one.aperture_m is not None
    share = width_m / one.aperture_m
    middle_px = np.mean([view.principal_px for view in one.views], axis=0)
    views = []
    for view in one.views:
        x, y = (middle_px + share * (np.array(view.principal_px) - middle_px)).tolist()
        right, down, forward = (share * np.array(view.centre_m)).tolist()
        views.append(replace(view, principal_px=(x, y), centre_m=(right, down, forward)))
    return replace(one, aperture_m=width_m, views=tuple(views))


def provisos(frames: Sequence[FrameCameras]) -> list[str]:
    """What is uncertain about where the views stand, a sentence each: how wide the aperture is, focus, and doubts."""
    said = []
    for source, words in (("carriers", "the frames show"), ("f-number", "the f-number tells")):
        those = [one for one in frames if one.aperture_from == source]
        shares = [one.aperture_sigma_m / one.aperture_m for one in those if one.aperture_m and one.aperture_sigma_m]
        if shares:
            said.append(
                f"views stand as far apart as {words}, in {len(those)} of {len(frames)} frames: to ±{max(shares):.1%} "
                "(1 standard deviation)"
            )
    if any(one.focus_m is None and len(one.views) > 1 for one in frames):
        said.append(
            "the lens was taken as focused at infinity: focused at F metres, each view's principal point is off by its "
            "distance from the middle view (m) times the focal length (px) / F (give it with --focus)"
        )
    return [*said, *(f"in doubt: {told(one)}" for one in first_by_name((one.name, one.doubts) for one in frames))]


def world_of(frames: Sequence[FrameCameras]) -> LocalAxes:
    """The world whose origin is the first frame's camera."""
    first = frames[0]
    return LocalAxes(first.latitude_deg, first.longitude_deg, first.altitude_m)


def middle(views: Sequence[ViewCamera]) -> int:
    """The view nearest to the middle of the aperture."""
    return min(range(len(views)), key=lambda n: (math.hypot(*views[n].centre_m), n))
