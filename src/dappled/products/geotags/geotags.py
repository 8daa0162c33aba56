"""Write the positions of a recorded flight in the formats that other programs read. Recorded files stay untouched."""

from __future__ import annotations

import csv
import io
import json
import math
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path, PurePosixPath
from typing import Any

from dappled import codec, durable
from dappled.decode.geometry import Pose
from dappled.decode.geometry.camera_pose import CameraPose
from dappled.findings import Finding, Subject
from dappled.flight import FlightError, Frame, LedgerReader, Tag, disk_error, disk_errors, layout
from dappled.flight.records import DOUBT, LATER_DOUBT
from dappled.products.geotags import exif_gps, sidecars
from dappled.products.geotags.exif_gps import ExifError
from dappled.products.geotags.marks import Marked
from dappled.products.maps.earth import Geoid, geojson_collection, geojson_feature, geojson_line
from dappled.products.mounting import Mounting


@dataclass(frozen=True, slots=True)
class Placed:
    """One frame with its tag; `camera` is None where its position is not known. `utc_ns` is mid-exposure, corrected
    where UTC was learnt in flight; None where UTC was never known."""

    frame: Frame
    tag: Tag
    camera: CameraPose | None
    utc_ns: int | None

    @property
    def file_name(self) -> str:
        """The frame's name without its folder."""
        return PurePosixPath(self.frame.name).name


@dataclass(frozen=True, slots=True)
class Written:
    """The files that were written, and the frames that have no position or no tag."""

    files: tuple[Path, ...]
    placed: int
    without_position: tuple[str, ...]
    without_tag: tuple[str, ...]


@dataclass(frozen=True, slots=True)
class PlacedBy:
    """What frames are placed by. Where one has a mark, its time and position are the mark's. `tags` replace the
    recorded ones; with a geoid heights are ellipsoidal."""

    mounting: Mounting
    geoid: Geoid | None = None
    marked: Marked | None = None
    tags: Mapping[int, Tag] | None = None


def read(flight: Path, by: PlacedBy) -> tuple[list[Placed], list[str]]:
    """A flight's tagged frames in order, and the names of frames without a tag. Doubts whose a frame is that came after
    its tag are among the tag's. Raises FlightError and EarthError."""
    with LedgerReader.open(layout.open_folder(flight).ledger) as ledger:
        tags = ledger.tags() if by.tags is None else by.tags
        frames, correction_ns = ledger.frames(), ledger.utc_correction_ns()
        doubted = _doubts(ledger, LATER_DOUBT)
    placed = []
    for frame in frames:
        tag = tags.get(frame.index)
        if tag is None:
            continue
        utc_ns = None if correction_ns is None else tag.utc_ns + correction_ns
        if by.marked is not None and frame.index in by.marked.marks:
            tag = by.marked.tag(tag, by.geoid)
            utc_ns = tag.utc_ns
        later = (found for index, found in doubted if index == frame.index)
        tag = replace(tag, doubts=(*tag.doubts, *later))
        placed.append(Placed(frame, tag, _camera(tag.pose, by.mounting, by.geoid), utc_ns))
    return placed, [frame.name for frame in frames if frame.index not in tags]


def _doubts(ledger: LedgerReader, *kinds: str) -> list[tuple[int, Finding]]:
    """(index, why) of each frame that may be another shot's."""
    events = (event for event in ledger.events() if event.kind in kinds)
    return [(one.index, found) for one in events if one.index is not None and (found := one.finding) is not None]


def doubts(flight: Path) -> list[Finding]:
    """Which frames, by their names, may be other shots', as the ledger has it. Raises FlightError."""
    with LedgerReader.open(layout.open_folder(flight).ledger) as ledger:
        names = {frame.index: frame.name for frame in ledger.frames()}
        doubted = _doubts(ledger, DOUBT, LATER_DOUBT)
    return [replace(found, subject=Subject("frame", names[index])) for index, found in doubted if index in names]


def write(
    flight: Path,
    by: PlacedBy,
    *,
    output: Path | None = None,
    replace_extension: bool = False,
    force: bool = False,
) -> Written:
    """Write sidecars beside the frames, and geo.txt, pix4d.csv and track.geojson into `<flight>/geotags/`; or all of
    them into `output`. Raises FlightError, DappledError and EarthError."""
    placed, without_tag = read(flight, by)
    inside = layout.FlightFolder(flight)
    forms: dict[str, Callable[[Sequence[Placed]], str]] = {
        "geo.txt": odm,
        "pix4d.csv": pix4d,
        "track.geojson": geojson,
    }
    frames = [inside.file(one.frame.name) for one in placed]  # every name is looked at before a file is written
    lists = [output / name if output else inside.file(f"geotags/{name}") for name in forms]
    _make(lists[0].parent)
    files = []
    for one, frame in zip(placed, frames, strict=True):
        path = sidecars.path_of(output / frame.name if output else frame, replace_extension=replace_extension)
        sidecars.write(path, sidecars.text(one.tag, one.camera, one.utc_ns), force=force)
        files.append(path)
    for path, form in zip(lists, forms.values(), strict=True):
        _write(path, form(placed).encode())
        files.append(path)
    lost = tuple(one.frame.name for one in placed if one.camera is None)
    return Written(tuple(files), len(placed) - len(lost), lost, tuple(without_tag))


def copies(flight: Path, folder: Path, by: PlacedBy) -> Iterator[tuple[str, Path | str]]:
    """Copy the placed frames to `folder`, with positions in EXIF; yields (frame, its copy or why there is none).

    The originals are only read. Raises FlightError, also for a folder within the flight.
    """
    if folder.resolve().is_relative_to(flight.resolve()):
        raise FlightError(f"cannot write copies into the flight itself ({folder}): give another folder")
    placed, without_tag = read(flight, by)
    originals = [layout.FlightFolder(flight).file(one.frame.name) for one in placed]
    _make(folder)
    for one, original in zip(placed, originals, strict=True):
        if one.camera is None:
            yield one.frame.name, "its position is not known"
            continue
        where = exif_gps.place(one.camera, one.utc_ns, one.tag.pose)
        try:
            made = exif_gps.tagged(durable.read_plain(original), where)
        except OSError as error:
            raise disk_error("read", original, error) from error
        except ExifError as error:
            yield one.frame.name, str(error)
            continue
        _write(folder / one.file_name, made)
        yield one.frame.name, folder / one.file_name
    for name in without_tag:
        yield name, "it was never tagged"


def _camera(pose: Pose, mounting: Mounting, geoid: Geoid | None) -> CameraPose | None:
    """The camera's pose, with its ellipsoidal height where the geoid is known. Raises EarthError."""
    if geoid is None or pose.latitude_rad is None or pose.longitude_rad is None:
        return mounting.camera(pose)
    latitude_deg, longitude_deg = math.degrees(pose.latitude_rad), math.degrees(pose.longitude_rad)
    return mounting.camera(pose, geoid.undulation_m(latitude_deg, longitude_deg))


def _make(folder: Path) -> None:
    with disk_errors("make the folder", folder):
        durable.make_folder(folder)


def _write(path: Path, data: bytes) -> None:
    with disk_errors("write", path):
        durable.write_file(path, data)


def odm(placed: Sequence[Placed], suffix: str | None = None) -> str:
    """OpenDroneMap's geo.txt: EPSG:4326, then `name x y z [yaw pitch roll [hacc vacc]]`.

    Fields are positional: a line ends before the first unknown one; of the two accuracies OpenDroneMap reads both or
    none. z is above mean sea level. `suffix` replaces that of the frames' names, for pictures made of them.
    """
    lines = ["EPSG:4326"]
    for one in placed:
        if one.camera is None:
            continue
        camera, sigma = one.camera, one.tag.pose.position_sigma_m
        name = one.file_name if suffix is None else PurePosixPath(one.file_name).stem + suffix
        words = [name, f"{camera.longitude_deg:.9f}", f"{camera.latitude_deg:.9f}"]
        words.append(f"{camera.altitude_msl_m:.3f}")
        if camera.pix4d:
            words += [f"{angle:.4f}" for angle in _ypr(camera)]
            vertical = one.tag.pose.vertical_sigma_m
            words += [] if sigma is None or vertical is None else [f"{sigma:.3f}", f"{vertical:.3f}"]
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
        sigmas = ["" if each is None else f"{each:.3f}" for each in (sigma, one.tag.pose.vertical_sigma_m)]
        rows.writerow([one.file_name, *place, *turned, *sigmas])
    return text.getvalue()


def geojson(placed: Sequence[Placed]) -> str:
    """GeoJSON (RFC 7946): a point for each frame and a line through them, in the order of the shots. The third
    coordinate is the height above the ellipsoid, where known; the altitude above mean sea level is a property."""
    known = sorted(((one, one.camera) for one in placed if one.camera), key=lambda pair: pair[0].frame.index)
    features: list[dict[str, Any]] = []
    if len(known) > 1:
        line = geojson_line([_coordinates(camera) for _, camera in known])
        features.append(geojson_feature(line, name="track"))
    for one, camera in known:
        turned = _ypr(camera) if camera.pix4d else (None, None, None)
        about = {
            "name": one.file_name,
            "index": one.frame.index,
            "utc_ns": one.utc_ns,
            "time_source": one.tag.time_source,
            "doubts": codec.plain(one.tag.doubts),
            "pose_source": one.tag.pose.source,
            "altitude_msl_m": camera.altitude_msl_m,
            "height_above_home_m": camera.height_above_home_m,
            "position_sigma_m": one.tag.pose.position_sigma_m,
            "vertical_sigma_m": one.tag.pose.vertical_sigma_m,
            "gnss": codec.plain(one.tag.pose.gnss),
            **dict(zip(("yaw_deg", "pitch_deg", "roll_deg"), turned, strict=True)),
        }
        features.append(geojson_feature({"type": "Point", "coordinates": _coordinates(camera)}, **about))
    return json.dumps(geojson_collection(features), allow_nan=False, indent=1) + "\n"


def _coordinates(camera: CameraPose) -> list[float]:
    place = [round(camera.longitude_deg, 9), round(camera.latitude_deg, 9)]
    return place if camera.height_ellipsoid_m is None else [*place, round(camera.height_ellipsoid_m, 3)]


def _ypr(camera: CameraPose) -> tuple[float, float, float]:
    """Yaw, pitch, roll in Pix4D's convention."""
    assert camera.pix4d is not None
    return camera.pix4d.yaw_deg, camera.pix4d.pitch_deg, camera.pix4d.roll_deg
