"""What the camera says of itself when it is asked, by message id: made from memory, at once."""

from __future__ import annotations

import math
from collections.abc import Callable

from dappled.clock import Clock
from dappled.daemon.camera_protocol import camera_definition, messages
from dappled.daemon.camera_protocol.camera_definition import Definition
from dappled.daemon.camera_protocol.camera_settings import Knobs
from dappled.daemon.camera_protocol.messages import CameraFacts, Storage
from dappled.daemon.pipeline.shutter import Shutter
from dappled.decode.geometry import field_of_view
from dappled.decode.geometry.field_of_view import FieldOfView
from dappled.decode.geometry.pose import Pose
from dappled.drivers.mavlink.links import Message, mavlink

ZOOM = "CAM_FOCALLEN"
# Looks down, image top forward: camera axes (right, down, forward) to body axes (forward, right, down).
DOWN = (0.0, -1.0, 0.0, 1.0, 0.0, 0.0, 0.0, 0.0, 1.0)


class Telling:
    """Messages 259 to 262 and 271, and the definition file. `pose()` is the vehicle's of now, None while unknown;
    `mount` turns camera axes to body axes (nine numbers, row by row)."""

    def __init__(
        self,
        shutter: Shutter,
        clock: Clock,
        knobs: Knobs,
        component_id: int,
        *,
        facts: Callable[[], CameraFacts],
        storage: Callable[[], Storage | None],
        pose: Callable[[], Pose | None] = lambda: None,
        mount: tuple[float, ...] = DOWN,
    ) -> None:
        self.mode = mavlink.CAMERA_MODE_IMAGE
        self._shutter, self._clock, self._knobs, self._component_id = shutter, clock, knobs, component_id
        self._facts, self._storage, self._pose, self._mount = facts, storage, pose, mount
        self._start_ns = clock.monotonic_ns()
        self._messages: dict[int, Callable[[], Message]] = {
            mavlink.MAVLINK_MSG_ID_CAMERA_INFORMATION: self.information,
            mavlink.MAVLINK_MSG_ID_CAMERA_SETTINGS: self.settings,
            mavlink.MAVLINK_MSG_ID_STORAGE_INFORMATION: self.disk,
            mavlink.MAVLINK_MSG_ID_CAMERA_CAPTURE_STATUS: self.status,
            mavlink.MAVLINK_MSG_ID_CAMERA_FOV_STATUS: self.view,
        }

    def about(self, message_id: int) -> Message | None:
        """The message of this id; None where the camera has no such."""
        make = self._messages.get(message_id)
        return None if make is None else make()

    def knows(self, message_id: int) -> bool:
        """Whether there is such a message."""
        return message_id in self._messages

    def boot_ms(self) -> int:
        """Since the start, as the messages count it."""
        return ((self._clock.monotonic_ns() - self._start_ns) // 10**6) % 2**32

    def definition(self) -> Definition:
        """The camera definition file as it is now."""
        facts = self._facts()
        return camera_definition.definition(facts.vendor, facts.model, self._knobs.all())

    def files(self) -> dict[str, bytes]:
        """What is served over MAVLink FTP."""
        return {camera_definition.PATH: self.definition().xml}

    def information(self) -> Message:
        """CAMERA_INFORMATION."""
        definition = self.definition()
        return messages.information(
            self._facts(),
            self.boot_ms(),
            zooms=bool(self.focal_lengths()),
            definition=(definition.version, definition.uri(self._component_id)),
        )

    def settings(self) -> Message:
        """CAMERA_SETTINGS."""
        return messages.settings(self.mode, self.zoom_percent(), self.boot_ms())

    def disk(self) -> Message:
        """STORAGE_INFORMATION."""
        return messages.storage(self._storage(), self.boot_ms())

    def status(self) -> Message:
        """CAMERA_CAPTURE_STATUS."""
        now = self._shutter.statistics()
        return messages.capture_status(
            busy=now.pending > 0,
            interval_s=now.interval_s,
            image_count=now.next_index,
            disk=self._storage(),
            boot_ms=self.boot_ms(),
        )

    def view(self) -> Message:
        """CAMERA_FOV_STATUS."""
        facts, pose = self._facts(), self._pose()
        attitude, ground = field_of_view.look(pose, self._mount)
        view = FieldOfView(
            field_of_view.angle_rad(facts.sensor_width_mm, facts.focal_length_mm),
            field_of_view.angle_rad(facts.sensor_height_mm, facts.focal_length_mm),
            attitude,
            ground,
        )
        return messages.fov_status(view, pose, self.boot_ms())

    def focal_lengths(self) -> list[tuple[float, str]]:
        """What the lens can be set to, (millimetres, the body's word), rising; empty where that is done by hand."""
        knob = self._knobs.find(ZOOM)
        found = [(millimetres(word), word) for word in (knob.choices if knob else ())]
        return sorted((mm, word) for mm, word in found if mm is not None)

    def sensor_width_mm(self) -> float | None:
        """How wide the sensor is, where that is known."""
        return self._facts().sensor_width_mm

    def zoom_percent(self) -> float:
        """Where the lens stands in its range; NaN where it can't be set."""
        steps = [word for _, word in self.focal_lengths()]
        knob = self._knobs.find(ZOOM)
        if knob is None or knob.value not in steps or len(steps) < 2:
            return math.nan
        return 100.0 * steps.index(knob.value) / (len(steps) - 1)


def millimetres(word: str) -> float | None:
    """A focal length as bodies write it: "35", "35 mm", "35.0mm"."""
    try:
        value = float(word.lower().removesuffix("mm").strip())
    except ValueError:
        return None
    return value if math.isfinite(value) and value > 0 else None
