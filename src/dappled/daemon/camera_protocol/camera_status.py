"""What the camera reports about itself: MAVLink messages 259 to 263 and 271 from memory, and the facts behind them."""

from __future__ import annotations

import logging
import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any, Protocol

import dappled
from dappled.clock import Clock
from dappled.config import profiles
from dappled.config.settings import Settings
from dappled.daemon.camera_protocol.parameters import DEFINITION_PATH, Definition, Parameters, camera_definition
from dappled.daemon.live_settings import LiveSettings
from dappled.daemon.pipeline.capture import PendingShot
from dappled.daemon.pipeline.shutter import Shutter
from dappled.decode.geometry import Pose, field_of_view
from dappled.drivers.camera import Identity
from dappled.drivers.mavlink import MavlinkMessage, PacketSender, mavlink
from dappled.errors import DappledError, report
from dappled.findings import Finding
from dappled.flight import ImageIndex, LedgerReader
from dappled.flight.layout import DiskSpace

log = logging.getLogger(__name__)
ZOOM = "CAM_FOCALLEN"
STORAGE_ID = 1  # of the disk, the only one
UNKNOWN_INT32 = 2**31 - 1
_NAN = math.nan
_NEAREST_M, _FARTHEST_M = 0.3, 655.0  # what DISTANCE_SENSOR's centimetres can say
_UNKNOWN_VARIANCE = 255
_DOWN, _FORWARD = mavlink.MAV_SENSOR_ROTATION_PITCH_270, mavlink.MAV_SENSOR_ROTATION_NONE


@dataclass(frozen=True, slots=True)
class CameraFacts:
    """What CAMERA_INFORMATION says. Unknown is None. `firmware` is (major, minor, patch) of dappled."""

    vendor: str
    model: str
    firmware: tuple[int, int, int]
    focal_length_mm: float | None = None
    sensor_width_mm: float | None = None
    sensor_height_mm: float | None = None
    columns: int | None = None
    rows: int | None = None


@dataclass(frozen=True, slots=True)
class Captured:
    """How a shot ended. `url` names the frame; empty for a failed shot."""

    index: int
    ok: bool
    utc_ns: int | None = None
    pose: Pose | None = None
    url: str = ""


class ReportedCamera:
    """What the camera has reported so far: who it is, and the focal length of its last frame. Any thread may ask."""

    def __init__(self, settings: Settings) -> None:
        self._settings = settings
        self._identity: Identity | None = None
        self._focal_length_mm: float | None = None
        self._sensor = _sensor_facts(settings, "")

    @property
    def known(self) -> bool:
        """Whether it has said who it is."""
        return self._identity is not None

    def identify(self, camera: Identity) -> bool:
        """Take who it is. Whether that is another camera than before, or the first."""
        other = camera != self._identity
        if other:
            self._identity, self._sensor = camera, _sensor_facts(self._settings, camera.model)
        return other

    def zoomed(self, focal_length_mm: float | None) -> tuple[float, float] | None:
        """Take a frame's focal length, None where it is unknown. Returns the last one and this one if they differ."""
        before_mm = self._focal_length_mm
        self._focal_length_mm = focal_length_mm or before_mm
        return (before_mm, focal_length_mm) if before_mm and focal_length_mm and before_mm != focal_length_mm else None

    def facts(self) -> CameraFacts:
        """CAMERA_INFORMATION's facts."""
        who = self._identity
        major, minor, patch = (int(part) for part in dappled.__version__.split(".")[:3])
        return CameraFacts(
            vendor=who.make if who else "dappled",
            model=who.model if who else "masked camera",
            firmware=(major, minor, patch),
            focal_length_mm=self._focal_length_mm,
            **self._sensor,
        )


class CameraModel(Protocol):
    """What the component reports about the camera. Every method but `lookup` answers from memory.

    `mount` turns camera axes to body axes (nine numbers, row by row); to those of the gimbal's head with `on_gimbal`.
    """

    @property
    def mount(self) -> tuple[float, ...]: ...

    @property
    def on_gimbal(self) -> bool: ...

    def facts(self) -> CameraFacts:
        """Make, model, lens and sensor, as far as they are known."""

    def storage(self) -> DiskSpace | None:
        """The disk that frames go to; None while it can't be read."""

    def lookup(self, index: int) -> Captured | None:
        """How an old shot ended; None for one that never was. May read a disk."""

    def pose(self) -> Pose | None:
        """The vehicle's pose now; None while it is unknown."""

    def troubled(self) -> bool:
        """Whether the heartbeat says MAV_STATE_CRITICAL."""

    def lost(self, triggers: Finding) -> None:
        """Write down triggers of the autopilot that became no shot."""


class CameraStatus:
    """Messages 259 to 263 and 271, and the camera definition file."""

    def __init__(
        self, model: CameraModel, shutter: Shutter, parameters: Parameters, clock: Clock, *, component_id: int
    ) -> None:
        self.mode = mavlink.CAMERA_MODE_IMAGE
        self._model, self._shutter, self._parameters, self._clock = model, shutter, parameters, clock
        self._component_id = component_id
        self._start_ns = clock.monotonic_ns()
        self._messages: dict[int, Callable[[], MavlinkMessage]] = {
            mavlink.MAVLINK_MSG_ID_CAMERA_INFORMATION: self.information,
            mavlink.MAVLINK_MSG_ID_CAMERA_SETTINGS: self.settings,
            mavlink.MAVLINK_MSG_ID_STORAGE_INFORMATION: self.disk,
            mavlink.MAVLINK_MSG_ID_CAMERA_CAPTURE_STATUS: self.status,
            mavlink.MAVLINK_MSG_ID_CAMERA_FOV_STATUS: self.view,
        }

    def about(self, message_id: int) -> MavlinkMessage | None:
        """The message of this id; None where the camera has none."""
        make = self._messages.get(message_id)
        return None if make is None else make()

    def knows(self, message_id: int) -> bool:
        """Whether there is such a message."""
        return message_id in self._messages

    def boot_ms(self) -> int:
        """Milliseconds since the start, as the messages count them."""
        return ((self._clock.monotonic_ns() - self._start_ns) // 10**6) % 2**32

    def definition(self) -> Definition:
        """The camera definition file as it is now."""
        facts = self._model.facts()
        return camera_definition(facts.vendor, facts.model, self._parameters.all())

    def files(self) -> dict[str, bytes]:
        """What is served over MAVLink FTP."""
        return {DEFINITION_PATH: self.definition().xml}

    def information(self) -> MavlinkMessage:
        """CAMERA_INFORMATION."""
        definition = self.definition()
        return _information(
            self._model.facts(),
            self.boot_ms(),
            zooms=bool(self.focal_lengths()),
            definition=(definition.version, definition.uri(self._component_id)),
        )

    def settings(self) -> MavlinkMessage:
        """CAMERA_SETTINGS."""
        return _settings(self.mode, self.zoom_percent(), self.boot_ms())

    def disk(self) -> MavlinkMessage:
        """STORAGE_INFORMATION."""
        return _storage(self._model.storage(), self.boot_ms())

    def status(self) -> MavlinkMessage:
        """CAMERA_CAPTURE_STATUS."""
        now = self._shutter.statistics()
        return _capture_status(
            busy=now.pending > 0,
            interval_s=now.interval_s,
            image_count=now.next_index,
            disk=self._model.storage(),
            boot_ms=self.boot_ms(),
        )

    def view(self) -> MavlinkMessage:
        """CAMERA_FOV_STATUS. Unknown: position INT32_MAX, angles and `q` NaN."""
        facts, pose = self._model.facts(), self._model.pose()
        attitude, ground = field_of_view.look(pose, self._model.mount, on_gimbal=self._model.on_gimbal)
        camera = image = (UNKNOWN_INT32,) * 3
        if pose is not None:
            camera = _place(pose.latitude_rad, pose.longitude_rad, pose.altitude_msl_m)
        if ground is not None:
            image = _place(*ground)
        return mavlink.MAVLink_camera_fov_status_message(
            self.boot_ms(),
            *camera,
            *image,
            attitude or (_NAN,) * 4,
            _degrees_or_nan(field_of_view.angle_rad(facts.sensor_width_mm, facts.focal_length_mm)),
            _degrees_or_nan(field_of_view.angle_rad(facts.sensor_height_mm, facts.focal_length_mm)),
        )

    def image(self, captured: Captured) -> MavlinkMessage:
        """CAMERA_IMAGE_CAPTURED (263). `q` as CAMERA_FOV_STATUS has it, at mid-exposure, by the mount of now;
        `relative_alt` is above the ground below or, where nothing measures that, above the take-off place.

        Unknown: time 0, position INT32_MAX (no place on Earth), `q` NaN.
        """
        pose = captured.pose
        attitude, _ = field_of_view.look(pose, self._model.mount, on_gimbal=self._model.on_gimbal)
        place, height = (UNKNOWN_INT32,) * 3, UNKNOWN_INT32
        if pose is not None:
            place = _place(pose.latitude_rad, pose.longitude_rad, pose.altitude_msl_m)
            height = _millimetres(pose.ground.metres if pose.ground else pose.height_above_home_m)
        return mavlink.MAVLink_camera_image_captured_message(
            self.boot_ms(),
            0 if captured.utc_ns is None else max(0, captured.utc_ns // 1000),
            0,
            *place,
            height,
            attitude or (_NAN,) * 4,
            captured.index,
            int(captured.ok),
            captured.url.encode()[:205],
        )

    def focal_lengths(self) -> list[tuple[float, str]]:
        """The lens' settings, (millimetres, the body's word), rising; empty for a lens that is zoomed by hand."""
        zoom = self._parameters.find(ZOOM)
        found = [(_focal_length_mm(word), word) for word in (zoom.choices if zoom else ())]
        return sorted((mm, word) for mm, word in found if mm is not None)

    def sensor_width_mm(self) -> float | None:
        """The sensor's width; None where it is unknown."""
        return self._model.facts().sensor_width_mm

    def zoom_percent(self) -> float:
        """Where the lens is in its range; NaN where it can't be set."""
        steps = [word for _, word in self.focal_lengths()]
        zoom = self._parameters.find(ZOOM)
        if zoom is None or zoom.value not in steps or len(steps) < 2:
            return math.nan
        return 100.0 * steps.index(zoom.value) / (len(steps) - 1)


def sensor_orientation(mount: Sequence[float]) -> int | None:
    """MAV_SENSOR_ORIENTATION of a mount (camera axes to body, row by row): down or forward; None for another one."""
    forward, _, down = mount[2], mount[5], mount[8]  # where the camera's axis points on the vehicle
    if down > 0.9:
        return int(_DOWN)
    return int(_FORWARD) if forward > 0.9 else None


@dataclass(frozen=True, slots=True)
class DistanceSensor:
    """The camera as a rangefinder of the autopilot; `settings` have its mount, as it may be changed in flight."""

    sender: PacketSender
    settings: LiveSettings
    clock: Clock

    def send(self, nearest_m: tuple[float, float]) -> None:
        """Send the nearest distance and its standard error in m."""
        boot_ms = (self.clock.monotonic_ns() // 10**6) % 2**32
        message = distance_message(nearest_m, boot_ms, self.settings.now.pose.mount)
        if message is not None:
            self.sender.send(message)


def distance_message(nearest: tuple[float, float], boot_ms: int, mount: Sequence[float]) -> MavlinkMessage | None:
    """DISTANCE_SENSOR (132) of a distance and its standard error in m; None where the camera looks aside, or the
    distance is out of the message's range."""
    distance_m, sigma_m = nearest
    looks = sensor_orientation(mount)
    if looks is None or not _NEAREST_M <= distance_m <= _FARTHEST_M:
        return None
    variance_cm2 = (100 * sigma_m) ** 2
    return mavlink.MAVLink_distance_sensor_message(
        boot_ms,
        round(100 * _NEAREST_M),
        round(100 * _FARTHEST_M),
        round(100 * distance_m),
        mavlink.MAV_DISTANCE_SENSOR_UNKNOWN,
        0,
        looks,
        round(variance_cm2) if variance_cm2 < _UNKNOWN_VARIANCE - 0.5 else _UNKNOWN_VARIANCE,
    )


def captured_shot(pending: PendingShot, utc_ns: Callable[[int], int | None]) -> Captured:
    """The 263 of a shot that has just been tagged, or has failed. `utc_ns` corrects a time of
    this machine; None where the correction is unknown."""
    index = pending.shot.index
    if pending.tag is not None and pending.frame is not None:
        return Captured(index, True, utc_ns(pending.tag.utc_ns), pending.tag.pose, pending.frame.name)
    if pending.where is not None:  # exposed; its file stays on the camera for now
        exposure, pose = pending.where
        return Captured(index, True, utc_ns(exposure.utc_ns), pose)
    return Captured(index, pending.frame is not None, url=pending.frame.name if pending.frame else "")


def captured_image(index: int, images: ImageIndex) -> Captured | None:
    """The 263 of any recorded image, of earlier flights too; None where it is unknown or has not ended."""
    try:
        entry = images.lookup(index)
        if entry is None or entry.state not in ("safe", "failed"):
            return None
        with LedgerReader.open(images.flight(entry.flight).ledger) as ledger:
            tag = ledger.tag(index)
            ok = entry.state == "safe" or index in ledger.following()
            correction_ns = ledger.utc_correction_ns()
    except DappledError as error:  # such as an old flight that was moved away
        report(log, f"image {index} can't be looked up", error)
        return None
    if tag is None:
        return Captured(index, ok, url=entry.frame or "")
    utc_ns = None if correction_ns is None else tag.utc_ns + correction_ns
    return Captured(index, ok, utc_ns, tag.pose, entry.frame or "")


def _sensor_facts(settings: Settings, model: str) -> dict[str, Any]:
    """Sensor size and pixels of the camera, for CAMERA_INFORMATION; empty where they are unknown."""
    name = settings.camera.profile
    try:
        profile = profiles.camera_for_model(model) if name == "auto" else profiles.camera(name)
    except DappledError:
        profile = None
    if profile is None:
        return {}
    chip = profile.raw[0].sensor
    height_mm, width_mm = chip.size_mm
    return {
        "sensor_width_mm": width_mm,
        "sensor_height_mm": height_mm,
        "columns": chip.shape[1],
        "rows": chip.shape[0],
    }


def _information(
    facts: CameraFacts, boot_ms: int, *, zooms: bool = False, definition: tuple[int, str] | None = None
) -> MavlinkMessage:
    """CAMERA_INFORMATION (259): photographs, modes (photo, survey) and zoom where the lens can be set; no video.

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
        | mavlink.CAMERA_CAP_FLAGS_HAS_IMAGE_SURVEY_MODE
        | (mavlink.CAMERA_CAP_FLAGS_HAS_BASIC_ZOOM if zooms else 0),
        version,
        uri.encode(),
    )


def _settings(mode: int, zoom_percent: float, boot_ms: int) -> MavlinkMessage:
    """CAMERA_SETTINGS (260). NaN for a zoom that can't be read; focus never can be."""
    return mavlink.MAVLink_camera_settings_message(boot_ms, mode, zoom_percent, _NAN)


def _storage(disk: DiskSpace | None, boot_ms: int) -> MavlinkMessage:
    """STORAGE_INFORMATION (261) in MiB. READY, else ground stations disable the shutter; NOT_SUPPORTED: unknown."""
    if disk is None:
        return mavlink.MAVLink_storage_information_message(
            boot_ms, STORAGE_ID, 1, mavlink.STORAGE_STATUS_NOT_SUPPORTED, _NAN, _NAN, _NAN, _NAN, _NAN
        )
    total, used, available = (part / 2**20 for part in (disk.total, disk.used, disk.available))
    return mavlink.MAVLink_storage_information_message(
        boot_ms,
        STORAGE_ID,
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


def _capture_status(
    *, busy: bool, interval_s: float | None, image_count: int, disk: DiskSpace | None, boot_ms: int
) -> MavlinkMessage:
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


def _focal_length_mm(word: str) -> float | None:
    """A focal length as bodies spell it: "35", "35 mm", "35.0mm"."""
    try:
        value = float(word.lower().removesuffix("mm").strip())
    except ValueError:
        return None
    return value if math.isfinite(value) and value > 0 else None


def _text(text: str, length: int) -> bytes:
    return text.encode()[: length - 1].ljust(length, b"\0")


def _or_nan(value: float | None) -> float:
    return _NAN if value is None else value


def _degrees_or_nan(angle_rad: float | None) -> float:
    return _NAN if angle_rad is None else math.degrees(angle_rad)


def _place(latitude_rad: float | None, longitude_rad: float | None, altitude_m: float | None) -> tuple[int, int, int]:
    return _degrees_e7(latitude_rad), _degrees_e7(longitude_rad), _millimetres(altitude_m)


def _degrees_e7(angle_rad: float | None) -> int:
    return UNKNOWN_INT32 if angle_rad is None else round(math.degrees(angle_rad) * 1e7)


def _millimetres(length_m: float | None) -> int:
    return UNKNOWN_INT32 if length_m is None else max(-(2**31), min(UNKNOWN_INT32, round(length_m * 1e3)))
