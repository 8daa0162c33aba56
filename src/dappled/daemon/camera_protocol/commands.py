"""The commands of the camera protocol, one function each: what is done, and what is answered."""

from __future__ import annotations

import math
from collections import deque
from collections.abc import Callable
from dataclasses import replace

from dappled.clock import Clock
from dappled.daemon.camera_protocol.camera_settings import Knobs
from dappled.daemon.camera_protocol.camera_status import ZOOM, Telling
from dappled.daemon.camera_protocol.command import ACCEPTED, DENIED, REJECTED, UNSUPPORTED, Answer, Command, judged
from dappled.daemon.camera_protocol.message_intervals import MessageIntervals
from dappled.daemon.pipeline.capture_requests import Recent
from dappled.daemon.pipeline.shutter import CaptureRequest, Shutter
from dappled.drivers.camera import CameraError
from dappled.drivers.mavlink.links import mavlink

OLD_IMAGES = 256
_WALKS = 16
_ZOOM_STEP, _ZOOM_RANGE, _ZOOM_FOCAL_LENGTH, _ZOOM_WIDTH = 0, 2, 3, 4


class CameraCommands:
    """Answers commands from memory. `wanted_images` are the past images that were asked for, (index, link)."""

    def __init__(
        self,
        shutter: Shutter,
        clock: Clock,
        telling: Telling,
        knobs: Knobs,
        intervals: MessageIntervals,
    ) -> None:
        self._shutter, self._clock, self._telling, self._knobs = shutter, clock, telling, knobs
        self._intervals = intervals
        self._steps = Recent()
        self._walks: dict[str, int] = {}  # who asks without an index: the next image for it
        self.wanted_images: deque[tuple[int, int]] = deque()

    def answer(self, command: Command) -> Answer:
        """Do it, or say why not. Never raises for what a command says."""
        handler = _COMMANDS.get(command.name)
        return Answer(UNSUPPORTED) if handler is None else handler(self, command)

    # photographs

    def fires(self, command: Command) -> bool:
        """Whether it asks for one photograph now."""
        if command.name == mavlink.MAV_CMD_IMAGE_START_CAPTURE:
            return command.whole(3, 1) == 1
        return command.name == mavlink.MAV_CMD_DO_DIGICAM_CONTROL and command.whole(5) == 1

    def _start_capture(self, command: Command) -> Answer:
        count = command.whole(3, 1)
        request = CaptureRequest(
            command.source, "IMAGE_START_CAPTURE", command.whole(4), command.confirmation, command.link
        )
        if count == 1:
            return judged(self._shutter.request(request))
        return judged(self._shutter.start_interval(request, command.number(2), count))

    def _stop_capture(self, command: Command) -> Answer:
        self._shutter.stop_interval(command.source)
        return Answer(ACCEPTED)

    def _digicam_control(self, command: Command) -> Answer:
        if command.whole(5) != 1:
            return Answer(ACCEPTED if command.broadcast else UNSUPPORTED)
        request = CaptureRequest(
            command.source,
            "DO_DIGICAM_CONTROL",
            None,
            command.confirmation,
            command.link,
            acknowledged=not command.broadcast,
        )
        return judged(self._shutter.request(request))

    # questions

    def _request_message(self, command: Command) -> Answer:
        number = command.whole(1, -1)
        if number == mavlink.MAVLINK_MSG_ID_CAMERA_IMAGE_CAPTURED:
            return self._old_image(command, 2)
        if number == mavlink.MAVLINK_MSG_ID_MESSAGE_INTERVAL:
            return self._get_interval(command, 2)
        return self._tell(number)

    def _tell(self, number: int) -> Answer:
        message = self._telling.about(number)
        return Answer(UNSUPPORTED) if message is None else Answer(ACCEPTED, (message,))

    def _request_image(self, command: Command) -> Answer:
        return self._old_image(command, 1)

    def _old_image(self, command: Command, place: int) -> Answer:
        """How a past shot ended. MAVSDK, which lists photographs from before it came, leaves the index out (NaN) each
        time: it is told one after the other, from the first."""
        count = self._shutter.statistics().next_index
        if len(self.wanted_images) >= OLD_IMAGES:
            return Answer(REJECTED, words=f"{OLD_IMAGES} past images are being looked up: ask again")
        if math.isfinite(command.parameters[place - 1]):
            index = command.whole(place)
        else:
            index = self._walks.pop(command.source, 0) % max(count, 1)
            self._walks[command.source] = index + 1
            if len(self._walks) > _WALKS:
                self._walks.pop(next(iter(self._walks)))
        if not 0 <= index < count:
            return Answer(DENIED, words=f"no image {index}: there are {count}")
        self.wanted_images.append((index, command.link))
        return Answer(ACCEPTED)

    def _set_interval(self, command: Command) -> Answer:
        """511 for one of our messages: microseconds, -1 off, 0 default (off)."""
        number = command.whole(1, -1)
        if not self._telling.knows(number):
            return Answer(UNSUPPORTED)
        self._intervals.set(number, command.number(2, -1.0), self._clock.monotonic_ns())
        return Answer(ACCEPTED)

    def _get_interval(self, command: Command, place: int = 1) -> Answer:
        """510: the interval in microseconds, -1 for off, 0 for a message that there isn't."""
        number = command.whole(place, -1)
        if not 0 <= number < 65536:
            return Answer(DENIED)
        interval_us = self._intervals.interval_us(number) or -1
        known = self._telling.knows(number)
        return Answer(ACCEPTED, (mavlink.MAVLink_message_interval_message(number, interval_us if known else 0),))

    # settings

    def _set_mode(self, command: Command) -> Answer:
        mode = command.whole(2, -1)
        if mode not in (mavlink.CAMERA_MODE_IMAGE, mavlink.CAMERA_MODE_IMAGE_SURVEY):
            return Answer(DENIED, (self._telling.settings(),), "this camera takes photographs only")
        self._telling.mode = mode
        return Answer(ACCEPTED, (self._telling.settings(),))

    def _reset_settings(self, command: Command) -> Answer:
        """529: what this protocol has set, which is the mode; the body keeps what its dials say."""
        self._telling.mode = mavlink.CAMERA_MODE_IMAGE
        return Answer(ACCEPTED, (self._telling.settings(),))

    def _zoom(self, command: Command) -> Answer:
        """531: to the nearest focal length that the body offers."""
        lengths = self._telling.focal_lengths()
        if not lengths:
            return Answer(DENIED, words="no zoom: this lens is zoomed by hand")
        kind, value = command.whole(1, -1), command.number(2, math.nan)
        step = CaptureRequest(
            command.source, "SET_CAMERA_ZOOM", None, command.confirmation, command.link, series=(kind, value)
        )
        now_ns = self._clock.monotonic_ns()
        if kind == _ZOOM_STEP and self._steps.same(step, now_ns) is not None:
            return Answer(ACCEPTED)  # its sender missed the answer
        at = self._zoom_target(kind, value, [mm for mm, _ in lengths])
        if at is None:
            return Answer(DENIED, words="zoom goes by step, range, focal length or field of view")
        try:
            self._knobs.turn(ZOOM, lengths[at][1])
        except CameraError as error:
            return Answer(DENIED, words=str(error))
        self._steps.forget(replace(step, series=(kind, -value)))  # forth, back and forth again is three steps
        if kind == _ZOOM_STEP:
            self._steps.add(step, now_ns, at)
        return Answer(ACCEPTED)

    def _zoom_target(self, kind: int, value: float, lengths_mm: list[float]) -> int | None:
        last = len(lengths_mm) - 1
        if not math.isfinite(value):
            return None
        if kind == _ZOOM_STEP:
            percent = self._telling.zoom_percent()
            now = 0 if math.isnan(percent) else round(percent * last / 100)
            return min(max(now + round(math.copysign(min(abs(value), 1), value)), 0), last)
        if kind == _ZOOM_RANGE and 0 <= value <= 100:
            return round(value / 100 * last)
        wanted_mm = value
        if kind == _ZOOM_WIDTH:
            width_mm = self._telling.sensor_width_mm()
            if not width_mm or not 0 < value < 180:
                return None
            wanted_mm = width_mm / 2 / math.tan(math.radians(value) / 2)
        elif kind != _ZOOM_FOCAL_LENGTH:
            return None
        return min(range(last + 1), key=lambda at: abs(lengths_mm[at] - wanted_mm))

    def _focus(self, command: Command) -> Answer:
        return Answer(DENIED, words="no focus: this lens is focused by hand")

    def _format(self, command: Command) -> Answer:
        return Answer(DENIED, (self._telling.disk(),), "flights are not erased over MAVLink")


def _requests(number: int) -> Callable[[CameraCommands, Command], Answer]:
    """The old 52x commands: one message each, whatever parameter 1 says (Mission Planner sends 0)."""
    return lambda commands, command: commands._tell(number)


_COMMANDS: dict[int, Callable[[CameraCommands, Command], Answer]] = {
    mavlink.MAV_CMD_IMAGE_START_CAPTURE: CameraCommands._start_capture,
    mavlink.MAV_CMD_IMAGE_STOP_CAPTURE: CameraCommands._stop_capture,
    mavlink.MAV_CMD_DO_DIGICAM_CONTROL: CameraCommands._digicam_control,
    mavlink.MAV_CMD_REQUEST_MESSAGE: CameraCommands._request_message,
    mavlink.MAV_CMD_GET_MESSAGE_INTERVAL: CameraCommands._get_interval,
    mavlink.MAV_CMD_SET_MESSAGE_INTERVAL: CameraCommands._set_interval,
    mavlink.MAV_CMD_REQUEST_CAMERA_INFORMATION: _requests(mavlink.MAVLINK_MSG_ID_CAMERA_INFORMATION),
    mavlink.MAV_CMD_REQUEST_CAMERA_SETTINGS: _requests(mavlink.MAVLINK_MSG_ID_CAMERA_SETTINGS),
    mavlink.MAV_CMD_REQUEST_STORAGE_INFORMATION: _requests(mavlink.MAVLINK_MSG_ID_STORAGE_INFORMATION),
    mavlink.MAV_CMD_REQUEST_CAMERA_CAPTURE_STATUS: _requests(mavlink.MAVLINK_MSG_ID_CAMERA_CAPTURE_STATUS),
    mavlink.MAV_CMD_REQUEST_CAMERA_IMAGE_CAPTURE: CameraCommands._request_image,
    mavlink.MAV_CMD_SET_CAMERA_MODE: CameraCommands._set_mode,
    mavlink.MAV_CMD_RESET_CAMERA_SETTINGS: CameraCommands._reset_settings,
    mavlink.MAV_CMD_SET_CAMERA_ZOOM: CameraCommands._zoom,
    mavlink.MAV_CMD_SET_CAMERA_FOCUS: CameraCommands._focus,
    mavlink.MAV_CMD_STORAGE_FORMAT: CameraCommands._format,
}
