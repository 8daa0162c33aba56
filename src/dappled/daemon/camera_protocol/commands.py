"""The commands of the camera protocol: what each one does, and how it is answered."""

from __future__ import annotations

import math
import threading
from collections import deque
from collections.abc import Callable
from dataclasses import dataclass, replace

from dappled import findings
from dappled.clock import Clock
from dappled.daemon.camera_protocol.camera_status import STORAGE_ID, ZOOM, CameraStatus
from dappled.daemon.camera_protocol.parameters import Parameters, unsigned_refusal
from dappled.daemon.pipeline.repeats import CaptureRequest, RecentRequests
from dappled.daemon.pipeline.shutter import CANNOT_FIRE, ShotDecision, Shutter
from dappled.daemon.pipeline.spacing import DistanceTrigger, Spacing
from dappled.drivers.camera import CameraError
from dappled.drivers.mavlink import MavlinkMessage, mavlink

ACCEPTED = mavlink.MAV_RESULT_ACCEPTED
DENIED = mavlink.MAV_RESULT_DENIED
UNSUPPORTED = mavlink.MAV_RESULT_UNSUPPORTED
REJECTED = mavlink.MAV_RESULT_TEMPORARILY_REJECTED
AUTOPILOT = 1  # MAV_COMP_ID_AUTOPILOT1
OLD_IMAGES = 256
SHORTEST_NS = 100_000_000  # 10 Hz: nothing here changes faster
LONGEST_US = 3.6e9
LISTING_NS = 10 * 10**9
_SEQUENCES = 16
_ALL_CAMERAS, _ONLY_SENSOR = 0, 1
_NAMES_CAMERA = {  # which parameter is the "target camera ID" (MAV_CMD)
    mavlink.MAV_CMD_DO_SET_CAM_TRIGG_DIST: 4,
    mavlink.MAV_CMD_DO_SET_CAM_TRIGG_INTERVAL: 3,
    mavlink.MAV_CMD_RESET_CAMERA_SETTINGS: 2,
    mavlink.MAV_CMD_SET_CAMERA_MODE: 1,
    mavlink.MAV_CMD_SET_CAMERA_ZOOM: 3,
    mavlink.MAV_CMD_SET_CAMERA_FOCUS: 3,
    mavlink.MAV_CMD_SET_CAMERA_SOURCE: 1,
    mavlink.MAV_CMD_IMAGE_START_CAPTURE: 1,
    mavlink.MAV_CMD_IMAGE_STOP_CAPTURE: 1,
    mavlink.MAV_CMD_DO_TRIGGER_CONTROL: 4,
    mavlink.MAV_CMD_CAMERA_TRACK_POINT: 4,
    mavlink.MAV_CMD_CAMERA_TRACK_RECTANGLE: 5,
    mavlink.MAV_CMD_CAMERA_STOP_TRACKING: 1,
    mavlink.MAV_CMD_VIDEO_START_CAPTURE: 3,
    mavlink.MAV_CMD_VIDEO_STOP_CAPTURE: 2,
    mavlink.MAV_CMD_VIDEO_START_STREAMING: 2,
    mavlink.MAV_CMD_VIDEO_STOP_STREAMING: 2,
}
# Their texts want a broadcast that names a camera denied. The others may be the autopilot's own.
_DENIED_TO_ALL = (mavlink.MAV_CMD_IMAGE_START_CAPTURE, mavlink.MAV_CMD_IMAGE_STOP_CAPTURE)
_ZOOM_STEP, _ZOOM_CONTINUOUS, _ZOOM_RANGE, _ZOOM_FOCAL_LENGTH, _ZOOM_WIDTH = range(5)
ZOOM_NS = 10**9  # a body's lens moves from one focal length to the next in less


@dataclass(frozen=True, slots=True)
class Command:
    """A COMMAND_LONG or COMMAND_INT. Parameters may be NaN. `broadcast`: to all components; `exposed`: a stranger may
    have sent it."""

    name: int
    parameters: tuple[float, ...]
    confirmation: int
    system: int
    component: int
    link: int
    broadcast: bool
    exposed: bool = False

    @classmethod
    def of(cls, message: MavlinkMessage, link: int, *, exposed: bool = False) -> Command:
        """From a COMMAND_LONG or COMMAND_INT."""
        is_long = message.get_type() == "COMMAND_LONG"
        last = (message.param5, message.param6, message.param7) if is_long else (message.x, message.y, message.z)
        return cls(
            message.command,
            (message.param1, message.param2, message.param3, message.param4, *map(float, last)),
            message.confirmation if is_long else 0,
            message.get_srcSystem(),
            message.get_srcComponent(),
            link,
            message.target_component == 0,
            exposed,
        )

    def number(self, place: int, default: float = 0.0) -> float:
        """Parameter 1 to 7; the default for NaN and infinities."""
        value = self.parameters[place - 1]
        return value if math.isfinite(value) else default

    def integer(self, place: int, default: int = 0) -> int:
        """Parameter 1 to 7 as an integer; the default where it is not finite."""
        return round(self.number(place, float(default)))

    def concerns(self, component: int) -> bool:
        """Whether it means the camera with this component id: by its target camera id, where it has one.

        0 (and NaN) are all cameras, 7 to 255 the one with that component id. 1 to 6 are cameras of an autopilot; but
        sent to one MAVLink camera, 1 is its first sensor, and there is no other (MAV_CMD_IMAGE_START_CAPTURE)."""
        place = _NAMES_CAMERA.get(self.name)
        camera = self.parameters[place - 1] if place else _ALL_CAMERAS
        ours = (_ALL_CAMERAS, component) if self.broadcast else (_ALL_CAMERAS, component, _ONLY_SENSOR)
        return math.isnan(camera) or camera in ours

    @property
    def photographs(self) -> int:
        """How many MAV_CMD_IMAGE_START_CAPTURE asks for; 0: until it is stopped, which needs an interval."""
        count = self.integer(3, 1)
        return 1 if count == 0 and self.number(2) == 0 else count

    @property
    def test_shot(self) -> bool:
        """Whether its photograph is a test shot, which an autopilot doesn't count (MAV_CMD_DO_DIGICAM_CONTROL)."""
        return self.name == mavlink.MAV_CMD_DO_DIGICAM_CONTROL and self.integer(7) == 1

    @property
    def of_autopilot(self) -> bool:
        """Whether an autopilot sent it."""
        return self.component == AUTOPILOT

    @property
    def source(self) -> str:
        """The sender, as causes name it."""
        return f"mavlink:{self.system}/{self.component}"


@dataclass(frozen=True, slots=True)
class CommandAnswer:
    """The result of a command, messages that follow the acknowledgement, and text for the pilot. `new_shot`: it became
    a shot of its own, and is no message more of a known one. `to_all`: a refusal of a broadcast is sent, too."""

    result: int
    then: tuple[MavlinkMessage, ...] = ()
    words: str | None = None
    new_shot: bool = False
    to_all: bool = False


_NOT_OURS = CommandAnswer(DENIED)  # a broadcast to a camera that something else fires: it is left alone, unanswered


class MessageIntervals:
    """The messages that were asked for at an interval (MAV_CMD_SET_MESSAGE_INTERVAL).

    One set for all links, as a link has no name of its own in the protocol.
    """

    def __init__(self) -> None:
        self._lock = threading.Lock()
        self._intervals: dict[int, tuple[int, int]] = {}  # message id: (interval_ns, due_ns)

    def set(self, message_id: int, interval_us: float, now_ns: int) -> None:
        """Send it every `interval_us` microseconds, at most at 10 Hz; 0 or less: stop."""
        with self._lock:
            self._intervals.pop(message_id, None)
            if interval_us > 0:
                interval_ns = max(SHORTEST_NS, round(min(interval_us, LONGEST_US) * 1e3))
                self._intervals[message_id] = (interval_ns, now_ns + interval_ns)

    def interval_us(self, message_id: int) -> int:
        """The interval in microseconds; 0 where none is set."""
        with self._lock:
            return self._intervals.get(message_id, (0, 0))[0] // 1000

    def due(self, now_ns: int) -> list[int]:
        """The messages that are due by now; the next of each is due an interval later."""
        with self._lock:
            due = [number for number, (_, due_ns) in self._intervals.items() if now_ns >= due_ns]
            for number in due:
                interval_ns = self._intervals[number][0]
                self._intervals[number] = (interval_ns, now_ns + interval_ns)
        return due


@dataclass(slots=True)
class _Zooming:
    """A zoom in one direction until it is stopped, or at the end: at most `left` more steps, the next at `due_ns`."""

    direction: float
    left: int
    due_ns: int


class CameraCommands:
    """Answers commands from memory. `wanted_images` are the past images asked for, (index, link)."""

    def __init__(
        self,
        shutter: Shutter,
        clock: Clock,
        status: CameraStatus,
        parameters: Parameters,
        *,
        intervals: MessageIntervals,
        series: DistanceTrigger,
        component_id: int,
    ) -> None:
        self._series, self._component_id = series, component_id
        self._shutter, self._clock, self._status, self._parameters = shutter, clock, status, parameters
        self._intervals = intervals
        self._steps = RecentRequests()
        self._zoom_lock = threading.Lock()
        self._zooming: _Zooming | None = None
        self._next_images: dict[
            tuple[str, bool], tuple[int, int]
        ] = {}  # (source, as image 0): the next one, when asked
        self.wanted_images: deque[tuple[int, int]] = deque()

    def answer(self, command: Command) -> CommandAnswer:
        """Do it, or say why not. Never raises for what a command says."""
        if not self.concerns(command):
            return CommandAnswer(DENIED, to_all=command.name in _DENIED_TO_ALL)
        handler = _COMMANDS.get(command.name)
        return CommandAnswer(UNSUPPORTED) if handler is None else handler(self, command)

    def concerns(self, command: Command) -> bool:
        """Whether it means this camera, and not another one behind the same address."""
        return command.concerns(self._component_id)

    # photographs

    def fires(self, command: Command) -> bool:
        """Whether it asks for one photograph now."""
        if command.name == mavlink.MAV_CMD_IMAGE_START_CAPTURE:
            return command.photographs == 1 and self.concerns(command)
        return command.name == mavlink.MAV_CMD_DO_DIGICAM_CONTROL and command.integer(5) == 1

    def _start_capture(self, command: Command) -> CommandAnswer:
        if command.broadcast and not self._shutter.fires:
            return _NOT_OURS
        count = command.photographs
        request = CaptureRequest(
            command.source,
            "IMAGE_START_CAPTURE",
            command.integer(4),
            command.confirmation,
            command.link,
            broadcast=command.broadcast,
            autopilot=command.of_autopilot,
        )
        if count == 1:
            return _decided(self._shutter.request(request))
        return _decided(self._shutter.start_interval(request, command.number(2), count))

    def _stop_capture(self, command: Command) -> CommandAnswer:
        self._shutter.stop_interval(command.source)
        self._series.end()
        return CommandAnswer(ACCEPTED)

    def _digicam_control(self, command: Command) -> CommandAnswer:
        if command.integer(5) != 1:
            return CommandAnswer(ACCEPTED if command.broadcast else UNSUPPORTED)
        if command.broadcast and not self._shutter.fires:
            return _NOT_OURS
        request = CaptureRequest(
            command.source,
            "DO_DIGICAM_CONTROL",
            None,
            command.confirmation,
            command.link,
            acknowledged=not command.broadcast,
            broadcast=command.broadcast,
            autopilot=command.of_autopilot,
        )
        return _decided(self._shutter.request(request))

    # series by distance

    def _trigger_distance(self, command: Command) -> CommandAnswer:
        """206 to this camera: a photograph every parameter 1 metres, the first at once where parameter 3 is 1; 0 ends
        it. One to all components is the autopilot's own, which triggers this camera itself."""
        if command.broadcast:
            return CommandAnswer(UNSUPPORTED)
        metres = command.parameters[0]
        if metres == 0:
            self._series.end()
            return CommandAnswer(ACCEPTED)
        if not self._shutter.fires:
            return CommandAnswer(DENIED, words=f"no photos: {findings.text(CANNOT_FIRE)}")
        try:
            self._series.begin(Spacing(metres), command.source, at_once=command.integer(3) == 1)
        except ValueError as error:
            return CommandAnswer(DENIED, words=f"no photos: {error}")
        return CommandAnswer(ACCEPTED)

    def _trigger_control(self, command: Command) -> CommandAnswer:
        """2003 to this camera: 1 begins the series of the settings ([trigger]), 0 ends what runs; -1 leaves it."""
        if command.broadcast:
            return CommandAnswer(UNSUPPORTED)
        wanted = command.integer(1, -1)
        if wanted == 0 or command.integer(3, -1) == 1:
            self._series.end()
            return CommandAnswer(ACCEPTED)
        if wanted != 1:
            return CommandAnswer(ACCEPTED)
        if not self._shutter.fires:
            return CommandAnswer(DENIED, words=f"no photos: {findings.text(CANNOT_FIRE)}")
        if not self._series.begin_configured(command.source):
            return CommandAnswer(DENIED, words="no photos: set trigger.distance_m or overlap")
        return CommandAnswer(ACCEPTED)

    # questions

    def _request_message(self, command: Command) -> CommandAnswer:
        number = command.integer(1, -1)
        if number == mavlink.MAVLINK_MSG_ID_CAMERA_IMAGE_CAPTURED:
            return self._old_image(command, 2)
        if number == mavlink.MAVLINK_MSG_ID_MESSAGE_INTERVAL:
            return self._get_interval(command, 2)
        if number == mavlink.MAVLINK_MSG_ID_STORAGE_INFORMATION:
            return self._storage(command, 2)
        return self._send_status(number)

    def _send_status(self, number: int) -> CommandAnswer:
        message = self._status.about(number)
        return CommandAnswer(UNSUPPORTED) if message is None else CommandAnswer(ACCEPTED, (message,))

    def _storage(self, command: Command, place: int = 1) -> CommandAnswer:
        """261: the disk, storage 1, is the only one; 0 (and NaN) are all."""
        if command.integer(place) not in (0, STORAGE_ID):
            return CommandAnswer(DENIED)
        return self._send_status(mavlink.MAVLINK_MSG_ID_STORAGE_INFORMATION)

    def _request_image(self, command: Command) -> CommandAnswer:
        return self._old_image(command, 1)

    def _old_image(self, command: Command, place: int) -> CommandAnswer:
        """How a past shot ended. MAVSDK leaves the index out (NaN) when it lists photographs from before it connected:
        each such request gets the next image, from the first on. Through ArduPilot it asks for image 0 again and again:
        from its second request within 10 s on it gets the next image as well."""
        count = self._shutter.statistics().next_index
        if len(self.wanted_images) >= OLD_IMAGES:
            return CommandAnswer(REJECTED, words=f"{OLD_IMAGES} past images are already being looked up: ask again")
        given = math.isfinite(command.parameters[place - 1])
        index = command.integer(place)
        if index == 0:
            now_ns = self._clock.monotonic_ns()
            following, asked_ns = self._next_images.pop((command.source, given), (0, now_ns))
            following = 0 if given and now_ns - asked_ns > LISTING_NS else following % max(count, 1)
            self._next_images[command.source, given] = following + 1, now_ns
            if len(self._next_images) > _SEQUENCES:
                self._next_images.pop(next(iter(self._next_images)))
            if given and following:
                self.wanted_images.append((following, command.link))
            index = 0 if given else following
        else:
            self._next_images.pop((command.source, True), None)  # it asks for others: that is no list of image 0 alone
        if not 0 <= index < count:
            return CommandAnswer(DENIED, words=f"no image {index}: there are {count}")
        self.wanted_images.append((index, command.link))
        return CommandAnswer(ACCEPTED)

    def _set_interval(self, command: Command) -> CommandAnswer:
        """511 for one of our messages: microseconds, -1 off, 0 default (off)."""
        number = command.integer(1, -1)
        if not self._status.knows(number):
            return CommandAnswer(UNSUPPORTED)
        self._intervals.set(number, command.number(2, -1.0), self._clock.monotonic_ns())
        return CommandAnswer(ACCEPTED)

    def _get_interval(self, command: Command, place: int = 1) -> CommandAnswer:
        """510: the interval in microseconds, -1 for off, 0 for an unknown message."""
        number = command.integer(place, -1)
        if not 0 <= number < 65536:
            return CommandAnswer(DENIED)
        interval_us = self._intervals.interval_us(number) or -1
        known = self._status.knows(number)
        return CommandAnswer(ACCEPTED, (mavlink.MAVLink_message_interval_message(number, interval_us if known else 0),))

    # settings

    def _set_mode(self, command: Command) -> CommandAnswer:
        mode = command.integer(2, -1)
        if mode not in (mavlink.CAMERA_MODE_IMAGE, mavlink.CAMERA_MODE_IMAGE_SURVEY):
            return CommandAnswer(DENIED, (self._status.settings(),), "this camera only takes photographs")
        self._status.mode = mode
        return CommandAnswer(ACCEPTED, (self._status.settings(),))

    def _reset_settings(self, command: Command) -> CommandAnswer:
        """529: reset what this protocol has set, which is the mode; the body's dials keep their settings."""
        self._status.mode = mavlink.CAMERA_MODE_IMAGE
        return CommandAnswer(ACCEPTED, (self._status.settings(),))

    def _zoom(self, command: Command) -> CommandAnswer:
        """531: to the nearest focal length that the body offers."""
        lengths = self._status.focal_lengths()
        if not lengths:
            return CommandAnswer(DENIED, words="no zoom: this lens is zoomed by hand")
        if command.exposed and self._parameters.closed_to_strangers(ZOOM):
            return CommandAnswer(DENIED, words=f"no zoom: {unsigned_refusal(ZOOM)}")
        if command.integer(1, -1) == _ZOOM_CONTINUOUS and math.isfinite(command.parameters[1]):
            return self._zoom_on(command.parameters[1])
        with self._zoom_lock:
            self._zooming = None
        return self._zoom_to(command, lengths)

    def _zoom_to(self, command: Command, lengths: list[tuple[float, str]]) -> CommandAnswer:
        kind, value = command.integer(1, -1), command.number(2, math.nan)
        step = CaptureRequest(
            command.source, "SET_CAMERA_ZOOM", None, command.confirmation, command.link, series=(kind, value)
        )
        now_ns = self._clock.monotonic_ns()
        if kind == _ZOOM_STEP and self._steps.same(step, now_ns) is not None:
            return CommandAnswer(ACCEPTED, (self._status.settings(),))  # a retry: its sender missed the answer
        at = self._zoom_target(kind, value, [mm for mm, _ in lengths])
        if at is None:
            return CommandAnswer(DENIED, words="zoom goes by step, range, focal length or field of view")
        try:
            self._parameters.change(ZOOM, lengths[at][1])
        except CameraError as error:
            return CommandAnswer(DENIED, words=str(error))
        self._steps.forget(replace(step, series=(kind, -value)))  # forth, back and forth again is three steps
        if kind == _ZOOM_STEP:
            self._steps.add(step, now_ns, at)
        return CommandAnswer(ACCEPTED, (self._status.settings(),))  # again when the body has reported it

    def _zoom_on(self, direction: float) -> CommandAnswer:
        """One focal length now, and one each second until 0 comes or the end is reached. The same again is a retry."""
        words = None
        with self._zoom_lock:
            zooming = self._zooming
            if zooming is None or zooming.direction * direction <= 0:
                steps = len(self._status.focal_lengths()) - 1
                self._zooming = _Zooming(direction, steps, self._clock.monotonic_ns()) if direction else None
                words = self._zoom_further()
        if words is not None:
            return CommandAnswer(DENIED, words=words)
        return CommandAnswer(ACCEPTED, (self._status.settings(),))

    def zoom_further(self) -> str | None:
        """Take the next step of a zoom that goes on, where it is due; a sentence where the body refuses it."""
        with self._zoom_lock:
            return self._zoom_further()

    def _zoom_further(self) -> str | None:
        zooming, now_ns = self._zooming, self._clock.monotonic_ns()
        if zooming is None or now_ns < zooming.due_ns:
            return None
        lengths = self._status.focal_lengths()
        at = self._zoom_target(_ZOOM_STEP, math.copysign(1, zooming.direction), [mm for mm, _ in lengths])
        zooming.left, zooming.due_ns = zooming.left - 1, now_ns + ZOOM_NS
        if zooming.left <= 0 or at in (0, len(lengths) - 1):
            self._zooming = None
        if at is None or not lengths:
            return None
        try:
            self._parameters.change(ZOOM, lengths[at][1])
        except CameraError as error:
            self._zooming = None
            return str(error)
        return None

    def _zoom_target(self, kind: int, value: float, lengths_mm: list[float]) -> int | None:
        last = len(lengths_mm) - 1
        if not math.isfinite(value):
            return None
        if kind == _ZOOM_STEP:
            percent = self._status.zoom_percent()
            now = 0 if math.isnan(percent) else round(percent * last / 100)
            return min(max(now + round(math.copysign(min(abs(value), 1), value)), 0), last)
        if kind == _ZOOM_RANGE and 0 <= value <= 100:
            return round(value / 100 * last)
        wanted_mm = value
        if kind == _ZOOM_WIDTH:
            width_mm = self._status.sensor_width_mm()
            if not width_mm or not 0 < value < 180:
                return None
            wanted_mm = width_mm / 2 / math.tan(math.radians(value) / 2)
        elif kind != _ZOOM_FOCAL_LENGTH:
            return None
        return min(range(last + 1), key=lambda at: abs(lengths_mm[at] - wanted_mm))

    def _focus(self, command: Command) -> CommandAnswer:
        return CommandAnswer(DENIED, words="no focus: this lens is focused by hand")

    def _format(self, command: Command) -> CommandAnswer:
        return CommandAnswer(DENIED, (self._status.disk(),), "flights are not erased over MAVLink")


def _requests(number: int) -> Callable[[CameraCommands, Command], CommandAnswer]:
    """The old 52x commands without a storage: one message each, whatever parameter 1 says (Mission Planner sends 0)."""
    return lambda commands, command: commands._send_status(number)


_COMMANDS: dict[int, Callable[[CameraCommands, Command], CommandAnswer]] = {
    mavlink.MAV_CMD_IMAGE_START_CAPTURE: CameraCommands._start_capture,
    mavlink.MAV_CMD_IMAGE_STOP_CAPTURE: CameraCommands._stop_capture,
    mavlink.MAV_CMD_DO_DIGICAM_CONTROL: CameraCommands._digicam_control,
    mavlink.MAV_CMD_DO_SET_CAM_TRIGG_DIST: CameraCommands._trigger_distance,
    mavlink.MAV_CMD_DO_TRIGGER_CONTROL: CameraCommands._trigger_control,
    mavlink.MAV_CMD_REQUEST_MESSAGE: CameraCommands._request_message,
    mavlink.MAV_CMD_GET_MESSAGE_INTERVAL: CameraCommands._get_interval,
    mavlink.MAV_CMD_SET_MESSAGE_INTERVAL: CameraCommands._set_interval,
    mavlink.MAV_CMD_REQUEST_CAMERA_INFORMATION: _requests(mavlink.MAVLINK_MSG_ID_CAMERA_INFORMATION),
    mavlink.MAV_CMD_REQUEST_CAMERA_SETTINGS: _requests(mavlink.MAVLINK_MSG_ID_CAMERA_SETTINGS),
    mavlink.MAV_CMD_REQUEST_STORAGE_INFORMATION: CameraCommands._storage,
    mavlink.MAV_CMD_REQUEST_CAMERA_CAPTURE_STATUS: _requests(mavlink.MAVLINK_MSG_ID_CAMERA_CAPTURE_STATUS),
    mavlink.MAV_CMD_REQUEST_CAMERA_IMAGE_CAPTURE: CameraCommands._request_image,
    mavlink.MAV_CMD_SET_CAMERA_MODE: CameraCommands._set_mode,
    mavlink.MAV_CMD_RESET_CAMERA_SETTINGS: CameraCommands._reset_settings,
    mavlink.MAV_CMD_SET_CAMERA_ZOOM: CameraCommands._zoom,
    mavlink.MAV_CMD_SET_CAMERA_FOCUS: CameraCommands._focus,
    mavlink.MAV_CMD_STORAGE_FORMAT: CameraCommands._format,
}


def _decided(decision: ShotDecision) -> CommandAnswer:
    """The answer to a capture request. ACCEPTED means that the shot will be attempted, DENIED that none ever will."""
    if decision.accepted:
        return CommandAnswer(ACCEPTED, new_shot=decision.outcome == "shot")
    result = DENIED if decision.reason == CANNOT_FIRE else REJECTED
    return CommandAnswer(result, words=decision.words)
