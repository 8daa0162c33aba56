"""What the camera says of itself, as MAVLink messages 259 to 263 and 271. Pure: values in, messages out."""

from __future__ import annotations

import math
from dataclasses import dataclass

from dappled.decode.geometry.field_of_view import FieldOfView
from dappled.decode.geometry.pose import Pose
from dappled.drivers.mavlink.links import Message, mavlink

UNKNOWN_INT32 = 2**31 - 1
_NAN = math.nan


@dataclass(frozen=True, slots=True)
class CameraFacts:
    """What CAMERA_INFORMATION tells. Unknown is None. `firmware` is (major, minor, patch) of dappled."""

    vendor: str
    model: str
    firmware: tuple[int, int, int]
    focal_length_mm: float | None = None
    sensor_width_mm: float | None = None
    sensor_height_mm: float | None = None
    columns: int | None = None
    rows: int | None = None


@dataclass(frozen=True, slots=True)
class Storage:
    """The disk that frames go to, in bytes."""

    total: int
    used: int
    available: int


@dataclass(frozen=True, slots=True)
class Captured:
    """How a shot ended. `url` names the frame; empty for a failed shot."""

    index: int
    ok: bool
    utc_ns: int | None = None
    pose: Pose | None = None
    url: str = ""


def information(
    facts: CameraFacts, boot_ms: int, *, zooms: bool = False, definition: tuple[int, str] | None = None
) -> Message:
    """CAMERA_INFORMATION (259): takes photographs, has modes (photo, survey), and zooms where the lens can be set.

    `definition`: version and address of the camera definition file."""
    major, minor, patch = (min(255, max(0, part)) for part in facts.firmware)
    version, uri = definition or (0, "")
    return mavlink.MAVLink_camera_information_message(
        boot_ms,
        _text(facts.vendor, 32),
        _text(facts.model, 32),
        major | minor << 8 | patch << 16,
        _or_nan(facts.focal_length_mm),
        _or_nan(facts.sensor_width_mm),
        _or_nan(facts.sensor_height_mm),
        facts.columns or 0,
        facts.rows or 0,
        0,
        mavlink.CAMERA_CAP_FLAGS_CAPTURE_IMAGE
        | mavlink.CAMERA_CAP_FLAGS_HAS_MODES
        | (mavlink.CAMERA_CAP_FLAGS_HAS_BASIC_ZOOM if zooms else 0),
        version,
        uri.encode(),
    )


def settings(mode: int, zoom_percent: float, boot_ms: int) -> Message:
    """CAMERA_SETTINGS (260). NaN for a zoom that can't be read; focus never can."""
    return mavlink.MAVLink_camera_settings_message(boot_ms, mode, zoom_percent, _NAN)


def fov_status(view: FieldOfView, pose: Pose | None, boot_ms: int) -> Message:
    """CAMERA_FOV_STATUS (271). Unknown: position INT32_MAX, angles and `q` NaN."""
    camera = image = (UNKNOWN_INT32,) * 3
    if pose is not None:
        camera = _place(pose.latitude_rad, pose.longitude_rad, pose.altitude_msl_m)
    if view.ground is not None:
        image = _place(*view.ground)
    return mavlink.MAVLink_camera_fov_status_message(
        boot_ms,
        *camera,
        *image,
        view.attitude or (_NAN,) * 4,
        _or_nan(None if view.width_rad is None else math.degrees(view.width_rad)),
        _or_nan(None if view.height_rad is None else math.degrees(view.height_rad)),
    )


def storage(disk: Storage | None, boot_ms: int) -> Message:
    """STORAGE_INFORMATION (261) in MiB. READY, else ground stations shut their shutter; NOT_SUPPORTED while unknown."""
    if disk is None:
        return mavlink.MAVLink_storage_information_message(
            boot_ms, 1, 1, mavlink.STORAGE_STATUS_NOT_SUPPORTED, _NAN, _NAN, _NAN, _NAN, _NAN
        )
    total, used, available = (part / 2**20 for part in (disk.total, disk.used, disk.available))
    return mavlink.MAVLink_storage_information_message(
        boot_ms,
        1,
        1,
        mavlink.STORAGE_STATUS_READY,
        total,
        used,
        available,
        _NAN,
        _NAN,
        mavlink.STORAGE_TYPE_OTHER,
        b"flights",
        mavlink.STORAGE_USAGE_FLAG_SET | mavlink.STORAGE_USAGE_FLAG_PHOTO,
    )


def capture_status(
    *, busy: bool, interval_s: float | None, image_count: int, disk: Storage | None, boot_ms: int
) -> Message:
    """CAMERA_CAPTURE_STATUS (262). image_status: bit 0 capturing now, bit 1 an interval runs."""
    return mavlink.MAVLink_camera_capture_status_message(
        boot_ms,
        int(busy) | (2 if interval_s is not None else 0),
        0,
        interval_s or 0.0,
        0,
        _NAN if disk is None else disk.available / 2**20,
        image_count,
    )


def image_captured(captured: Captured, boot_ms: int) -> Message:
    """CAMERA_IMAGE_CAPTURED (263). `q` is (w, x, y, z), vehicle body to north-east-down at mid-exposure.

    Unknown: time 0, position INT32_MAX (no place on Earth), `q` NaN.
    """
    pose = captured.pose
    place, height, q = (UNKNOWN_INT32,) * 3, UNKNOWN_INT32, (_NAN,) * 4
    if pose is not None:
        place = _place(pose.latitude_rad, pose.longitude_rad, pose.altitude_msl_m)
        height, q = _millimetres(pose.height_above_home_m), pose.attitude or q
    return mavlink.MAVLink_camera_image_captured_message(
        boot_ms,
        0 if captured.utc_ns is None else max(0, captured.utc_ns // 1000),
        0,
        *place,
        height,
        q,
        captured.index,
        int(captured.ok),
        captured.url.encode()[:205],
    )


def _text(text: str, length: int) -> bytes:
    return text.encode()[: length - 1].ljust(length, b"\0")


def _or_nan(value: float | None) -> float:
    return _NAN if value is None else value


def _place(latitude_rad: float | None, longitude_rad: float | None, altitude_m: float | None) -> tuple[int, int, int]:
    return _degrees_e7(latitude_rad), _degrees_e7(longitude_rad), _millimetres(altitude_m)


def _degrees_e7(angle_rad: float | None) -> int:
    return UNKNOWN_INT32 if angle_rad is None else round(math.degrees(angle_rad) * 1e7)


def _millimetres(length_m: float | None) -> int:
    return UNKNOWN_INT32 if length_m is None else max(-(2**31), min(UNKNOWN_INT32, round(length_m * 1e3)))
