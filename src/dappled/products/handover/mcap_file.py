"""Write a flight as one MCAP file of ROS 2 messages: pictures, positions, poses, cameras and slices.

For Foxglove and ROS. The definitions of all messages are in the file, so readers need no ROS. https://mcap.dev/spec
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from dappled import durable
from dappled.decode import srgb
from dappled.decode.geometry import field_of_view
from dappled.decode.lightfield import LightField
from dappled.products.exports import light_files
from dappled.products.extras import need
from dappled.products.handover import photo_files, view_cameras, view_files
from dappled.products.handover.view_cameras import FrameCameras, LocalAxes
from dappled.products.maps import cog
from dappled.products.maps.photographs import Photograph, Station

_CAMERA, _WORLD = "camera_optical", "map"  # frame ids: right, down, forward; east, north, up from the first frame
_RULE = "=" * 80
_HEADER = f"{_RULE}\nMSG: std_msgs/Header\nbuiltin_interfaces/Time stamp\nstring frame_id\n"
_TIME = f"{_RULE}\nMSG: builtin_interfaces/Time\nint32 sec\nuint32 nanosec\n"
_DEFINITIONS = {
    "sensor_msgs/msg/CompressedImage": f"std_msgs/Header header\nstring format\nuint8[] data\n{_HEADER}{_TIME}",
    "sensor_msgs/msg/NavSatFix": (
        "std_msgs/Header header\nsensor_msgs/NavSatStatus status\nfloat64 latitude\nfloat64 longitude\n"
        "float64 altitude\nfloat64[9] position_covariance\nuint8 position_covariance_type\n"
        f"{_HEADER}{_TIME}{_RULE}\nMSG: sensor_msgs/NavSatStatus\nint8 status\nuint16 service\n"
    ),
    "geometry_msgs/msg/PoseStamped": (
        f"std_msgs/Header header\ngeometry_msgs/Pose pose\n{_HEADER}{_TIME}"
        f"{_RULE}\nMSG: geometry_msgs/Pose\ngeometry_msgs/Point position\ngeometry_msgs/Quaternion orientation\n"
        f"{_RULE}\nMSG: geometry_msgs/Point\nfloat64 x\nfloat64 y\nfloat64 z\n"
        f"{_RULE}\nMSG: geometry_msgs/Quaternion\nfloat64 x\nfloat64 y\nfloat64 z\nfloat64 w\n"
    ),
    "sensor_msgs/msg/CameraInfo": (
        "std_msgs/Header header\nuint32 height\nuint32 width\nstring distortion_model\nfloat64[] d\nfloat64[9] k\n"
        "float64[9] r\nfloat64[12] p\nuint32 binning_x\nuint32 binning_y\nsensor_msgs/RegionOfInterest roi\n"
        f"{_HEADER}{_TIME}{_RULE}\nMSG: sensor_msgs/RegionOfInterest\nuint32 x_offset\nuint32 y_offset\nuint32 height\n"
        "uint32 width\nbool do_rectify\n"
    ),
    "dappled_msgs/msg/Slices": (
        "# data: complex64 (count, height, width), little endian, DC first; carriers: (count, 4) rows ky, kx, fy, fx\n"
        f"std_msgs/Header header\nuint32 count\nuint32 height\nuint32 width\nfloat64[] carriers\n"
        f"uint8[] data\n{_HEADER}{_TIME}"
    ),
}
_NO_COVARIANCE, _DIAGONAL = 0, 2
_FIX, _GPS = 0, 1


def write_parts(folder: Path, one: Photograph, field: LightField, station: Station, utc_ns: int | None) -> list[Path]:
    """Write what the file will hold of a frame: its picture, slices and camera's record; returns the paths.

    Raises DappledError, DappledError and OSError."""
    need("mcap_ros2.writer")
    record = view_cameras.of_photograph(one, [view_files.PICTURE], station, float("inf"), utc_ns)
    picture = folder / view_files.picture(view_files.PICTURE, record.name)
    durable.make_folder(picture.parent)
    durable.write_file(
        picture, photo_files.jpeg(one, station, utc_ns, srgb.sixteen(one.image * cog.gain_of([one.image])))
    )
    slices = folder / "slices" / f"{record.name}.npz"
    durable.make_folder(slices.parent)
    shape = field.slices.shape[1:]
    bare = replace(field, views=np.zeros((0, 0, *shape), np.float32), view_offsets=np.zeros((0, 0, 2)), view_sigma=None)
    light_files.save(slices, bare, overwrite=True)
    return [picture, slices, view_files.write_record(folder, record)]


def write(folder: Path, flight: str, frames: Sequence[FrameCameras]) -> list[Path]:
    """Write <flight>.mcap of the frames' parts, in the order of time; returns its path.

    Frames whose UTC was never known stand at time 0 and after. Raises MissingExtraError and OSError."""
    writers, plain = need("mcap_ros2.writer"), need("mcap.writer")
    world = view_cameras.world_of(frames)
    path = folder / f"{flight}.mcap"

    def fill(fd: int) -> None:
        with open(fd, "wb", closefd=False) as file:
            writer = writers.Writer(file, compression=plain.CompressionType.NONE)
            writer.add_metadata("origin of map", {key: str(value) for key, value in world.said().items()})
            schemas = {name: writer.register_msgdef(name, text) for name, text in _DEFINITIONS.items()}
            ordered = sorted(enumerate(frames), key=lambda pair: _at_ns(*pair))
            for sequence, (number, one) in enumerate(ordered):
                at_ns = _at_ns(number, one)
                for topic, kind, message in _messages(folder, one, world, at_ns):
                    writer.write_message(topic, schemas[kind], message, at_ns, at_ns, sequence)
            writer.finish()

    durable.fill_file(path, fill)
    return [path]


def _at_ns(number: int, one: FrameCameras) -> int:
    return number if one.utc_ns is None else one.utc_ns


def _messages(
    folder: Path, one: FrameCameras, world: LocalAxes, at_ns: int
) -> Iterator[tuple[str, str, dict[str, Any]]]:
    """(topic, type, message) of a frame."""
    camera, ground = _header(at_ns, _CAMERA), _header(at_ns, _WORLD)
    data = (folder / view_files.picture(one.views[0].name, one.name)).read_bytes()
    yield (
        "/camera/image/compressed",
        "sensor_msgs/msg/CompressedImage",
        {"header": camera, "format": "jpeg", "data": data},
    )
    yield "/camera/camera_info", "sensor_msgs/msg/CameraInfo", _info(one, camera)
    yield "/fix", "sensor_msgs/msg/NavSatFix", _fix(one, camera)
    turn, centre = world.place(one)
    w, x, y, z = field_of_view.quaternion(turn.T.tolist())
    east, north, up = centre.tolist()
    pose = {"position": {"x": east, "y": north, "z": up}, "orientation": {"x": x, "y": y, "z": z, "w": w}}
    yield "/camera/pose", "geometry_msgs/msg/PoseStamped", {"header": ground, "pose": pose}
    field = light_files.load(folder / "slices" / f"{one.name}.npz")
    count, height, width = field.slices.shape
    yield "/camera/slices", "dappled_msgs/msg/Slices", {
        "header": camera, "count": count, "height": height, "width": width,
        "carriers": field.carriers.ravel().tolist(), "data": field.slices.astype("<c8").tobytes(),
    }  # fmt: skip


def _header(at_ns: int, frame_id: str) -> dict[str, Any]:
    return {"stamp": {"sec": at_ns // 10**9, "nanosec": at_ns % 10**9}, "frame_id": frame_id}


def _info(one: FrameCameras, header: dict[str, Any]) -> dict[str, Any]:
    """Pixels count from the first one's centre, as in OpenCV."""
    (fx, fy), (cx, cy) = one.views[0].focal_px, (value - 0.5 for value in one.views[0].principal_px)
    return {
        "header": header, "height": one.shape[0], "width": one.shape[1], "distortion_model": "plumb_bob",
        "d": list(one.distortion), "k": [fx, 0.0, cx, 0.0, fy, cy, 0.0, 0.0, 1.0],
        "r": np.eye(3).ravel().tolist(), "p": [fx, 0.0, cx, 0.0, 0.0, fy, cy, 0.0, 0.0, 0.0, 1.0, 0.0],
        "binning_x": 0, "binning_y": 0,
        "roi": {"x_offset": 0, "y_offset": 0, "height": 0, "width": 0, "do_rectify": False},
    }  # fmt: skip


def _fix(one: FrameCameras, header: dict[str, Any]) -> dict[str, Any]:
    """The altitude is above the ellipsoid, NaN where that isn't known: ROS has no field for mean sea level."""
    across, up = one.position_sigma_m, one.vertical_sigma_m
    known = across is not None and up is not None
    variances = (across**2 / 2, across**2 / 2, up**2) if across is not None and up is not None else (0.0, 0.0, 0.0)
    return {
        "header": header, "status": {"status": _FIX, "service": _GPS},
        "latitude": one.latitude_deg, "longitude": one.longitude_deg,
        "altitude": float("nan") if one.height_m is None else one.height_m,
        "position_covariance": np.diag(variances).ravel().tolist(),
        "position_covariance_type": _DIAGONAL if known else _NO_COVARIANCE,
    }  # fmt: skip
