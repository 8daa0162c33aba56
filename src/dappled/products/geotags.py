"""A recorded flight's places in the forms that other programs read. Nothing recorded is touched."""

from __future__ import annotations

import csv
import io
import json
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path, PurePosixPath
from typing import Any

from dappled.flight import durable, layout
from dappled.flight.errors import disk_error
from dappled.flight.ledger import LedgerReader
from dappled.flight.records import Frame, Tag, Vector3
from dappled.products import camera_pose, sidecars
from dappled.products.camera_pose import NADIR, CameraPose, Matrix


@dataclass(frozen=True, slots=True)
class Placed:
    """One frame with its tag; `camera` is None where its position is not known."""

    frame: Frame
    tag: Tag
    camera: CameraPose | None

    @property
    def file_name(self) -> str:
        """The frame's name without its folder."""
        return PurePosixPath(self.frame.name).name


@dataclass(frozen=True, slots=True)
class Written:
    """What was written, and which frames have no place or no tag."""

    files: tuple[Path, ...]
    placed: int
    without_position: tuple[str, ...]
    without_tag: tuple[str, ...]


def read(flight: Path, lever_m: Vector3 = (0.0, 0.0, 0.0), mount: Matrix = NADIR) -> tuple[list[Placed], list[str]]:
    """A flight's tagged frames in order, and the names of frames without a tag. Raises FlightError."""
    with LedgerReader.open(layout.open_folder(flight).ledger) as ledger:
        tags = ledger.tags()
        frames = ledger.frames()
    placed = [
        Placed(frame, tags[frame.index], camera_pose.of(tags[frame.index].pose, lever_m, mount))
        for frame in frames
        if frame.index in tags
    ]
    return placed, [frame.name for frame in frames if frame.index not in tags]


def write(
    flight: Path,
    *,
    lever_m: Vector3 = (0.0, 0.0, 0.0),
    mount: Matrix = NADIR,
    output: Path | None = None,
    replace_extension: bool = False,
    force: bool = False,
) -> Written:
    """Sidecars beside the frames, and geo.txt, pix4d.csv and track.geojson in `<flight>/geotags/`; all of it in
    `output` instead where that is given. Raises FlightError and SidecarError."""
    placed, without_tag = read(flight, lever_m, mount)
    folder = output or flight / "geotags"
    try:
        durable.make_folder(folder)
    except OSError as error:
        raise disk_error("make the folder", folder, error) from error
    files = []
    for one in placed:
        beside = folder / one.file_name if output else flight / one.frame.name
        path = sidecars.path_of(beside, replace_extension=replace_extension)
        sidecars.write(path, sidecars.text(one.tag, one.camera), force=force)
        files.append(path)
    forms: dict[str, Callable[[Sequence[Placed]], str]] = {
        "geo.txt": odm,
        "pix4d.csv": pix4d,
        "track.geojson": geojson,
    }
    for name, form in forms.items():
        path = folder / name
        try:
            durable.write_file(path, form(placed).encode())
        except OSError as error:
            raise disk_error("write", path, error) from error
        files.append(path)
    lost = tuple(one.frame.name for one in placed if one.camera is None)
    return Written(tuple(files), len(placed) - len(lost), lost, tuple(without_tag))


def odm(placed: Sequence[Placed]) -> str:
    """OpenDroneMap's geo.txt: EPSG:4326, then `name x y z [yaw pitch roll [hacc]]`.

    Its fields go by position: where the attitude is unknown a line ends before it. The vertical accuracy is not known.
    """
    lines = ["EPSG:4326"]
    for one in placed:
        if one.camera is None:
            continue
        camera, sigma = one.camera, one.tag.pose.position_sigma_m
        words = [one.file_name, f"{camera.longitude_deg:.9f}", f"{camera.latitude_deg:.9f}"]
        words.append(f"{camera.altitude_msl_m:.3f}")
        if camera.pix4d:
            words += [f"{angle:.4f}" for angle in _ypr(camera)]
            words += [] if sigma is None else [f"{sigma:.3f}"]
        lines.append(" ".join(words))
    return "\n".join(lines) + "\n"


def pix4d(placed: Sequence[Placed]) -> str:
    """Pix4D's geolocation CSV, no header: name, latitude, longitude, altitude, yaw, pitch, roll, horizontal accuracy,
    vertical accuracy; unknown is empty."""
    text = io.StringIO()
    rows = csv.writer(text, lineterminator="\n")
    for one in placed:
        if one.camera is None:
            continue
        camera, sigma = one.camera, one.tag.pose.position_sigma_m
        turned = [f"{angle:.4f}" for angle in _ypr(camera)] if camera.pix4d else ["", "", ""]
        place = [f"{camera.latitude_deg:.9f}", f"{camera.longitude_deg:.9f}", f"{camera.altitude_msl_m:.3f}"]
        rows.writerow([one.file_name, *place, *turned, "" if sigma is None else f"{sigma:.3f}", ""])
    return text.getvalue()


def geojson(placed: Sequence[Placed]) -> str:
    """A point a frame and a line through them, in the order of exposure (RFC 7946). Altitude is a property: GeoJSON's
    third coordinate would be ellipsoidal."""
    known = sorted(((one, one.camera) for one in placed if one.camera), key=lambda pair: pair[0].tag.utc_ns)
    features: list[dict[str, Any]] = []
    if len(known) > 1:
        line = [[round(c.longitude_deg, 9), round(c.latitude_deg, 9)] for _, c in known]
        features.append(
            {
                "type": "Feature",
                "properties": {"name": "track"},
                "geometry": {"type": "LineString", "coordinates": line},
            }
        )
    for one, camera in known:
        turned = _ypr(camera) if camera.pix4d else (None, None, None)
        features.append(
            {
                "type": "Feature",
                "properties": {
                    "name": one.file_name,
                    "index": one.frame.index,
                    "utc_ns": one.tag.utc_ns,
                    "time_source": one.tag.time_source,
                    "pose_source": one.tag.pose.source,
                    "altitude_msl_m": camera.altitude_msl_m,
                    "height_above_home_m": camera.height_above_home_m,
                    "position_sigma_m": one.tag.pose.position_sigma_m,
                    **dict(zip(("yaw_deg", "pitch_deg", "roll_deg"), turned, strict=True)),
                },
                "geometry": {
                    "type": "Point",
                    "coordinates": [round(camera.longitude_deg, 9), round(camera.latitude_deg, 9)],
                },
            }
        )
    return json.dumps({"type": "FeatureCollection", "features": features}, allow_nan=False, indent=1) + "\n"


def _ypr(camera: CameraPose) -> tuple[float, float, float]:
    """Yaw, pitch, roll in Pix4D's convention."""
    assert camera.pix4d is not None
    return camera.pix4d.yaw_deg, camera.pix4d.pitch_deg, camera.pix4d.roll_deg
