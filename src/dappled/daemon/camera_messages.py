"""What the camera says of itself, as MAVLink messages 259 to 263. Pure: values in, messages out."""

from __future__ import annotations

import math
from dataclasses import dataclass

from dappled.drivers.mavlink import Message, mavlink
from dappled.flight.records import Pose

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


def information(facts: CameraFacts, boot_ms: int) -> Message:
    """CAMERA_INFORMATION (259): takes photographs, and has modes (photo, survey)."""
    major, minor, patch = (min(255, max(0, part)) for part in facts.firmware)
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
        mavlink.CAMERA_CAP_FLAGS_CAPTURE_IMAGE | mavlink.CAMERA_CAP_FLAGS_HAS_MODES,
        0,
        b"",
    )


def settings(mode: int, boot_ms: int) -> Message:
    """CAMERA_SETTINGS (260). Zoom and focus can't be read: NaN."""
    return mavlink.MAVLink_camera_settings_message(boot_ms, mode, _NAN, _NAN)


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
    latitude = longitude = altitude = height = UNKNOWN_INT32
    q = (_NAN, _NAN, _NAN, _NAN)
    if pose is not None:
        latitude, longitude = _degrees_e7(pose.latitude_rad), _degrees_e7(pose.longitude_rad)
        altitude, height = _millimetres(pose.altitude_msl_m), _millimetres(pose.height_above_home_m)
        q = pose.attitude or q
    return mavlink.MAVLink_camera_image_captured_message(
        boot_ms,
        0 if captured.utc_ns is None else max(0, captured.utc_ns // 1000),
        0,
        latitude,
        longitude,
        altitude,
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


def _degrees_e7(angle_rad: float | None) -> int:
    return UNKNOWN_INT32 if angle_rad is None else round(math.degrees(angle_rad) * 1e7)


def _millimetres(length_m: float | None) -> int:
    return UNKNOWN_INT32 if length_m is None else max(-(2**31), min(UNKNOWN_INT32, round(length_m * 1e3)))
