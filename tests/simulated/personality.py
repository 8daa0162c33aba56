"""How real autopilots trigger cameras: the messages of ArduPilot and of PX4, as observed from the flight code.

Pure: a method returns the messages that the autopilot sends next, in order. `Flyer` sends them over a link; tests give
them to parts of the daemon.
"""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import dataclass, field
from typing import Literal, cast, get_args

from dappled.drivers.mavlink import MavlinkMessage, mavlink

_START, _STOP, _DIGICAM = (
    mavlink.MAV_CMD_IMAGE_START_CAPTURE,
    mavlink.MAV_CMD_IMAGE_STOP_CAPTURE,
    mavlink.MAV_CMD_DO_DIGICAM_CONTROL,
)
_FIRST_CAMERA, _PX4_CAMERAS = 100, 6
_PIN_WRAP_US = 2**32

Wiring = Literal["mavlink", "broadcast", "wire"]


@dataclass(frozen=True, slots=True)
class CameraPort:
    """One camera of the autopilot, and how it is fired.

    `mavlink`: ArduPilot's CAM_TYPE 6, PX4's TRIG_INTERFACE 3; `broadcast`: CAM_TYPE 5; `wire`: a servo, relay or pin.
    `pin`: its hot shoe is wired to the autopilot.
    """

    wiring: Wiring = "mavlink"
    pin: bool = False

    @classmethod
    def of(cls, text: str) -> CameraPort:
        """From "mavlink", "broadcast" or "wire", with ":pin" after it for a wired hot shoe. Raises ValueError."""
        wiring, _, pin = text.partition(":")
        if wiring not in get_args(Wiring) or pin not in ("", "pin"):
            raise ValueError(f"{text!r} is not a camera: mavlink, broadcast or wire, and :pin for a wired hot shoe")
        return cls(cast(Wiring, wiring), pin == "pin")


@dataclass(slots=True)
class CameraTriggers:
    """The cameras of one autopilot, their counters, and what it sends for each trigger.

    ArduPilot reports every camera at each trigger of one (CAMERA_FEEDBACK), with the time since boot in 32 bits where
    the camera has a pin, else that of its satellites, 0 without any. A pin sleeps until the autopilot itself has
    triggered that camera once. PX4 sends CAMERA_TRIGGER, six IMAGE_START_CAPTURE and DO_DIGICAM_CONTROL, and
    CAMERA_IMAGE_CAPTURED for each contact of a pin (CAM_CAP_FBACK), with a counter of its own.
    """

    personality: str = "ardupilot"
    cameras: tuple[CameraPort, ...] = (CameraPort(),)
    system_id: int = 1
    images: list[int] = field(default_factory=list)
    _stamps: list[int] = field(default_factory=list)
    _awake: set[int] = field(default_factory=set)
    _sequence: int = 0
    _contacts: int = 0
    _interval: tuple[int, int, int] | None = None  # boot_us of the next trigger, its period, how many are left (0: ∞)

    def __post_init__(self) -> None:
        self.images, self._stamps = [0] * len(self.cameras), [0] * len(self.cameras)

    def trigger(self, boot_us: int, unix_us: int = 0, camera: int | None = None) -> list[MavlinkMessage]:
        """The autopilot triggers one camera, or all; `unix_us` 0: it has no satellites."""
        if self.personality == "px4":
            return list(self._px4(boot_us))
        chosen = range(len(self.cameras)) if camera is None else (camera,)
        return [message for one in chosen for message in self._ardupilot(one, unix_us)]

    def contact(self, boot_us: int, camera: int = 0) -> list[MavlinkMessage]:
        """The hot shoe of a camera closed."""
        if not self.cameras[camera].pin:
            return []
        if self.personality == "px4":
            self._contacts += 1
            at = boot_us // 1000, 0, 1, 0, 0, 0, 0, (1.0, 0.0, 0.0, 0.0)
            return [mavlink.MAVLink_camera_image_captured_message(*at, self._contacts - 1, 1, b"")]
        if camera not in self._awake:
            return []
        self._stamps[camera] = boot_us % _PIN_WRAP_US
        return self._feedbacks()

    def command(self, message: MavlinkMessage, boot_us: int, unix_us: int = 0) -> list[MavlinkMessage]:
        """What a command to all components, or to the autopilot, makes it send."""
        if message.target_component not in (0, 1):
            return []
        if message.command == _STOP:
            self._interval = None
        elif message.command == _DIGICAM and message.param5 == 1:
            return self.trigger(boot_us, unix_us)
        elif message.command == _START and self.personality == "ardupilot":
            if message.param3 != 1:
                period_us = round(message.param2 * 1e6)
                left = max(0, round(message.param3))
                self._interval = (boot_us + period_us, period_us, left - 1) if left != 1 else None
            camera = round(message.param1) - 1  # parameter 1 is the camera, from 1; 0 is all of them
            return self.trigger(boot_us, unix_us, camera if camera in range(len(self.cameras)) else None)
        return []

    def due(self, boot_us: int, unix_us: int = 0) -> list[MavlinkMessage]:
        """The triggers of a running interval that are due. Each counts from the last one, so lateness adds up."""
        if self._interval is None or boot_us < self._interval[0]:
            return []
        _, period_us, left = self._interval
        self._interval = None if left == 1 else (boot_us + period_us, period_us, max(0, left - 1))
        return self.trigger(boot_us, unix_us)

    def _ardupilot(self, camera: int, unix_us: int) -> Iterator[MavlinkMessage]:
        port = self.cameras[camera]
        self.images[camera] += 1
        if port.wiring == "mavlink":
            target = self.system_id, _FIRST_CAMERA + camera
            yield mavlink.MAVLink_command_long_message(*target, _START, 0, 0, 0, 1, self.images[camera], 0, 0, 0)
        elif port.wiring == "broadcast":
            yield mavlink.MAVLink_command_long_message(0, 0, _DIGICAM, 0, 0, 0, 0, 0, 1, 0, 0)
        if port.pin:
            self._awake.add(camera)
        else:
            self._stamps[camera] = unix_us
            yield from self._feedbacks()

    def _feedbacks(self) -> list[MavlinkMessage]:
        return [
            mavlink.MAVLink_camera_feedback_message(stamp, 0, camera, image, 0, 0, 0, 0, 0, 0, 0, 0, 0, image)
            for camera, (stamp, image) in enumerate(zip(self._stamps, self.images, strict=True))
        ]

    def _px4(self, boot_us: int) -> Iterator[MavlinkMessage]:
        self.images = [image + 1 for image in self.images]
        yield mavlink.MAVLink_camera_trigger_message(boot_us, self.images[0])
        if any(port.wiring == "wire" for port in self.cameras):
            return
        nan = math.nan
        for camera in range(_PX4_CAMERAS):
            self._sequence += 1
            target = self.system_id, _FIRST_CAMERA + camera
            yield mavlink.MAVLink_command_long_message(*target, _START, 0, 0, 0, 1, self._sequence, nan, nan, nan)
        yield mavlink.MAVLink_command_long_message(0, 0, _DIGICAM, 0, nan, nan, nan, nan, 1, nan, nan)
