"""Which CAMERA_FEEDBACK, and which CAMERA_IMAGE_CAPTURED of an autopilot's, reports a trigger of this camera."""

from __future__ import annotations

from collections import deque
from collections.abc import Callable

from dappled.clock import Clock
from dappled.daemon.camera_protocol.own_autopilot import OwnAutopilot
from dappled.daemon.navigation.samples import CAPTURED, image_number, sent_us
from dappled.drivers.mavlink import MavlinkMessage

_CONTACT_NS = 2 * 10**9  # no body takes longer from the trigger to the contact
_TIMES = 256
_IMAGES = 2**16  # img_idx has 16 bits


class CameraFeedback:
    """The CAMERA_FEEDBACK of our autopilot. `makes_shots`: each trigger that is reported is a shot, as something
    else fires the camera."""

    def __init__(self, autopilot: OwnAutopilot, clock: Clock, *, makes_shots: bool) -> None:
        self._autopilot, self._clock = autopilot, clock
        self._makes_shots = makes_shots
        self._last: int | None = None
        self._last_ns = 0
        self._unclear: deque[tuple[int, int]] = deque(maxlen=64)  # no time, no newer number: of the next start, perhaps
        self._restarts = autopilot.restarts
        self._stamps: deque[int] = deque(maxlen=64)
        self._times: dict[int, int] = {}  # of the last images
        self._captured: deque[tuple[int, int]] = deque(maxlen=64)
        self._triggered: deque[int] = deque(maxlen=64)  # CAMERA_TRIGGERs whose CAMERA_IMAGE_CAPTURED has not come yet

    def made_shot(self, name: str, *, known: bool) -> None:
        """A message of this type became a shot; `known`: another one had become it."""
        if name == "CAMERA_TRIGGER" and not known:
            self._triggered.append(self._clock.monotonic_ns())

    def is_capture(self, captured: MavlinkMessage, where: Callable[[], str]) -> bool:
        """Whether a CAMERA_IMAGE_CAPTURED of the autopilot's reports an exposure of which no CAMERA_TRIGGER has told.

        PX4 sends one for each contact in the hot shoe (CAM_CAP_FBACK), whoever fired; without that one for each of its
        triggers. ArduPilot sends none.
        """
        told, now_ns = (image_number(captured), sent_us(captured)), self._clock.monotonic_ns()
        if captured.capture_result != 1 or told in self._captured:
            return False
        self._captured.append(told)
        while self._triggered:
            if now_ns - self._triggered.popleft() <= _CONTACT_NS:
                return False
        stale = bool(self._autopilot.is_stale(told[1]))
        if stale:
            numbers = self._autopilot.numbers[CAPTURED]
            numbers.late(told[0], now_ns, lambda: f"reported more than 5 s late, {where()}")
        return not stale

    def is_trigger(self, feedback: MavlinkMessage, where: Callable[[], str]) -> bool:
        """Whether it reports a trigger of our camera, and not another one's again. `where` says when and where that is
        noticed.

        ArduPilot sends one for each of its cameras at every trigger or contact of one. The others repeat their last
        time, or have neither time nor number. Without a time, or before the autopilot's clock is known, a number that
        is newer than the last one shows a trigger; the first number of all may be a repeated one, and is told as lost.
        """
        if feedback.cam_idx != self._autopilot.cam_idx:
            return False
        self._follow_restarts(where)
        now_ns = self._clock.monotonic_ns()
        time_us, image, known = int(feedback.time_usec), int(feedback.img_idx), self._last
        newer = image == 1 and known != 1
        if known is not None:
            newer = newer or 0 < (image - known) % _IMAGES < _IMAGES // 2
        if known is None or newer:
            self._last, self._last_ns = image, now_ns
        if time_us in self._stamps:
            return False
        if time_us:
            self._stamps.append(time_us)
        if self._begins_anew(image, time_us):
            self._last, self._last_ns = image, now_ns
            return True
        stale = self._autopilot.is_stale(time_us) if time_us else None
        if stale is not False and (stale or not newer) and image != known:
            self._unclear.append((image, now_ns))
        why = ""
        if stale and newer and known is not None:
            why = "reported more than 5 s late"
        elif stale is None and known is None and image > 1:
            why = "the first report heard, without a time that is known: perhaps another camera's"
        if why and self._makes_shots:
            numbers = self._autopilot.numbers["CAMERA_FEEDBACK"]
            numbers.late(image, now_ns, lambda: f"{why}, {where()}")
        return newer if stale is None else not stale

    def _begins_anew(self, image: int, time_us: int) -> bool:
        """Whether it has an earlier time than this number had: the autopilot has started again."""
        anew = 0 < time_us < self._times.get(image, 0)
        if anew:
            self._times.clear()
        if time_us:
            self._times[image] = time_us
            if len(self._times) > _TIMES:
                del self._times[next(iter(self._times))]
        return anew

    def _follow_restarts(self, where: Callable[[], str]) -> None:
        """Where the autopilot has started again its numbers began at 1 then, and some may have come before that was
        certain: those that seemed no newer are triggers that are lost."""
        if self._restarts == self._autopilot.restarts:
            return
        self._restarts, since_ns = self._autopilot.restarts, self._autopilot.restarted_ns
        if self._last is None or self._last_ns <= since_ns:
            self._last = 0
        numbers, now_ns = self._autopilot.numbers["CAMERA_FEEDBACK"], self._clock.monotonic_ns()
        for image, heard_ns in self._unclear:
            if heard_ns >= since_ns and image > self._last and self._makes_shots:
                numbers.late(image, now_ns, lambda: f"reported while the autopilot started again, {where()}")
                self._last = image
        self._unclear.clear()
