"""Act as a ground station: find the camera, request photographs, and report how each one ended."""

from __future__ import annotations

import threading
from collections import deque
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

from dappled.clock import Clock, SystemClock
from dappled.drivers.mavlink import MavlinkLinks, MavlinkMessage, Packet, Transport, is_for, mavlink, open_signing
from dappled.errors import DappledError
from dappled.workers import Loop

ACK_S = 0.5
ACK_TRIES = 4
_REQUESTS = 3  # of a message: it may be lost where its acknowledgement is not
_ASK_AGAIN_S = 3.0
_KEPT = 1000


class GroundStationError(DappledError):
    """The camera could not be reached: one sentence."""


@dataclass(frozen=True, slots=True)
class Outcome:
    """How one requested photograph ended.

    `index` is None where none was reported; `reason` is a sentence for a photograph that failed.
    `ack_ms`: from the request to the acknowledgement.
    """

    sequence: int
    index: int | None
    ok: bool
    reason: str | None
    ack_ms: float | None


class GroundClient:
    """One ground station on one link (a pymavlink connection string). Use as a context manager.

    It sends a heartbeat each second while open. `key_file` signs the link; the signing time is kept beside it. Raises
    LinkError from `__enter__`, SigningError for a key that can't be used.
    """

    def __init__(
        self,
        url: str,
        *,
        system_id: int = 255,
        component_id: int = 190,
        key_file: Path | None = None,
        clock: Clock | None = None,
        transport: Transport | None = None,
    ) -> None:
        self._clock = clock = clock or SystemClock()
        self._links = MavlinkLinks(
            [url],
            system_id=system_id,
            component_id=component_id,
            clock=clock,
            signing=open_signing([key_file], key_file.with_name(f"{key_file.name}.time"), clock) if key_file else None,
            transport=transport,
        )
        self._changed = threading.Condition()
        self._listeners: list[deque[MavlinkMessage]] = []
        self._camera: tuple[int, int] | None = None
        self._heart = Loop("ground heartbeat", self._beat, clock=clock)
        self._sequence = clock.utc_ns() // 10**8 % 2**23  # differs from a run just before; exact as a float

    def __enter__(self) -> GroundClient:
        self._links.start(self)
        self._heart.start()
        return self

    def __exit__(self, *_: object) -> None:
        self._heart.stop(2.0)
        self._links.stop()

    @property
    def port(self) -> int:
        """The local port of the link."""
        return self._links.port(0)

    def find_camera(self, timeout_s: float = 10.0) -> tuple[int, int]:
        """(system id, component id) of the first camera whose heartbeat is heard. Raises GroundStationError."""
        url, failed = self._links.statistics()[0].url, self._links.statistics()[0].error
        if failed:  # a person waits: the link can't be opened now
            raise GroundStationError(failed)
        with self._changed:
            if not self._clock.wait_for(self._changed, lambda: self._camera is not None, timeout_s):
                raise GroundStationError(
                    f"no camera was heard on {url} for {timeout_s:g} s; is the daemon running there?"
                )
            assert self._camera is not None
            return self._camera

    def request(self, message_id: int, parameter: float = 0.0, timeout_s: float = 2.0) -> MavlinkMessage | None:
        """One message of the camera, by MAV_CMD_REQUEST_MESSAGE, asked for three times; None where it didn't arrive."""
        with self._listening() as heard:
            for _ in range(_REQUESTS):
                result, _ = self.command(mavlink.MAV_CMD_REQUEST_MESSAGE, float(message_id), parameter)
                found = heard(lambda m: m.get_msgId() == message_id, timeout_s)
                if found is not None or result not in (None, mavlink.MAV_RESULT_ACCEPTED):
                    return found
        return None

    def command(self, name: int, *parameters: float) -> tuple[int | None, float | None]:
        """Send a command until it is acknowledged (4 times, 0.5 s each): (MAV_RESULT, milliseconds), or Nones."""
        system, component = self.find_camera()
        padded = (*parameters, *[0.0] * (7 - len(parameters)))
        with self._listening() as heard:
            for confirmation in range(ACK_TRIES):
                asked_ns = self._clock.monotonic_ns()
                self.send_command(mavlink.MAVLink_command_long_message(system, component, name, confirmation, *padded))
                ack = heard(lambda m: m.get_type() == "COMMAND_ACK" and m.command == name and self._mine(m), ACK_S)
                if ack is not None:
                    return int(ack.result), (self._clock.monotonic_ns() - asked_ns) / 1e6
        return None, None

    def send_command(self, message: MavlinkMessage) -> None:
        """Send one COMMAND_LONG. A simulated ground station with another way of sending overrides this."""
        self._links.sender.send(message)

    def capture(
        self,
        count: int,
        interval_s: float = 0.0,
        *,
        timeout_s: float = 60.0,
        on_outcome: Callable[[Outcome], None] = lambda _: None,
    ) -> list[Outcome]:
        """Request `count` photographs, each after the last one ended, at least `interval_s` apart."""
        outcomes: list[Outcome] = []
        status = self.request(mavlink.MAVLINK_MSG_ID_CAMERA_CAPTURE_STATUS)
        if status is None:
            raise GroundStationError(
                "the camera doesn't report its capture status, so a new image can't be recognised; does it run dappled?"
            )
        expected = int(status.image_count)
        for _ in range(count):
            began_ns = self._clock.monotonic_ns()
            outcome = self._capture_one(expected, timeout_s)
            if outcome.index is not None:
                expected = outcome.index + 1
            outcomes.append(outcome)
            on_outcome(outcome)
            if len(outcomes) < count:
                left_s = interval_s - (self._clock.monotonic_ns() - began_ns) / 1e9
                self._clock.wait(self._heart.stopping, left_s)
        return outcomes

    def by_distance(self, metres: float | None) -> None:
        """Have the camera take a photograph every so many metres, the first at once; None: as its settings say; 0 ends
        them. Raises GroundStationError with the camera's reason."""
        self.find_camera()
        with self._listening() as heard:
            if metres is None:
                result, _ = self.command(mavlink.MAV_CMD_DO_TRIGGER_CONTROL, 1)
            else:
                result, _ = self.command(mavlink.MAV_CMD_DO_SET_CAM_TRIGG_DIST, metres, 0, 1)
            if result != mavlink.MAV_RESULT_ACCEPTED:
                raise GroundStationError(_refusal(result, heard))

    def _capture_one(self, expected: int, timeout_s: float) -> Outcome:
        self._sequence += 1
        sequence = self._sequence
        with self._listening() as heard:
            result, ack_ms = self.command(mavlink.MAV_CMD_IMAGE_START_CAPTURE, 0, 0, 1, sequence)
            if result != mavlink.MAV_RESULT_ACCEPTED:
                return Outcome(sequence, None, False, _refusal(result, heard), ack_ms)
            until_ns = self._clock.monotonic_ns() + round(timeout_s * 1e9)
            while (left_ns := until_ns - self._clock.monotonic_ns()) > 0:
                wait_s = min(_ASK_AGAIN_S, left_ns / 1e9)
                captured = heard(
                    lambda m: m.get_type() == "CAMERA_IMAGE_CAPTURED" and m.image_index >= expected, wait_s
                )
                if captured is not None:
                    ok = captured.capture_result == 1
                    reason = None if ok else "the camera reports that it failed"
                    return Outcome(sequence, int(captured.image_index), ok, reason, ack_ms)
                self.command(
                    mavlink.MAV_CMD_REQUEST_MESSAGE, mavlink.MAVLINK_MSG_ID_CAMERA_IMAGE_CAPTURED, float(expected)
                )
        return Outcome(sequence, None, False, f"the camera reported nothing about it for {timeout_s:g} s", ack_ms)

    def _mine(self, message: MavlinkMessage) -> bool:
        own = self._links.sender
        return is_for(message, (own.system_id,), own.component_id)

    def _listening(self) -> _Listening:
        return _Listening(self._changed, self._listeners, self._clock)

    def log_packet(self, _stamp_us: int, _raw: bytes) -> None:
        """Write a packet to the telemetry log. A ground client keeps no log."""

    def on_packet(self, packet: Packet) -> None:
        message = packet.message
        if packet.sent:
            return
        with self._changed:
            sender = (message.get_srcSystem(), message.get_srcComponent())
            if message.get_type() == "HEARTBEAT" and message.type == mavlink.MAV_TYPE_CAMERA and self._camera is None:
                self._camera = sender
            if sender == self._camera:
                for heard in self._listeners:
                    heard.append(message)
            self._changed.notify_all()

    def _beat(self) -> None:
        while not self._heart.stopping.is_set():
            self._links.sender.send(
                mavlink.MAVLink_heartbeat_message(
                    mavlink.MAV_TYPE_GCS, mavlink.MAV_AUTOPILOT_INVALID, 0, 0, mavlink.MAV_STATE_ACTIVE, 3
                )
            )
            self._clock.wait(self._heart.stopping, 1.0)


def _refusal(
    result: int | None, heard: Callable[[Callable[[MavlinkMessage], bool], float], MavlinkMessage | None]
) -> str:
    """Why a command was not accepted, with what the camera says beside it."""
    if result is None:
        return f"no answer to {ACK_TRIES} requests"
    said = heard(lambda m: m.get_type() == "STATUSTEXT", 0.2)
    return f"refused with MAV_RESULT {result}" + (f": {said.text}" if said is not None else "")


class _Listening:
    """A context in which no message is missed: it searches those that arrived since `with`."""

    def __init__(self, changed: threading.Condition, listeners: list[deque[MavlinkMessage]], clock: Clock) -> None:
        self._changed, self._listeners, self._clock = changed, listeners, clock
        self._heard: deque[MavlinkMessage] = deque(maxlen=_KEPT)

    def __enter__(self) -> Callable[[Callable[[MavlinkMessage], bool], float], MavlinkMessage | None]:
        with self._changed:
            self._listeners.append(self._heard)
        return self._wait

    def __exit__(self, *_: object) -> None:
        with self._changed:
            self._listeners[:] = [one for one in self._listeners if one is not self._heard]

    def _wait(self, wanted: Callable[[MavlinkMessage], bool], timeout_s: float) -> MavlinkMessage | None:
        def found() -> MavlinkMessage | None:
            return next((message for message in self._heard if wanted(message)), None)

        with self._changed:
            self._clock.wait_for(self._changed, lambda: found() is not None, timeout_s)
            return found()
