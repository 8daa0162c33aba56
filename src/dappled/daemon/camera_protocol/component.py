"""The MAVLink camera (Camera Protocol v2): answer messages at once, and report how shots ended.

`on_packet` runs in a link's receiving thread and only answers from memory. What may read a disk (an old image looked up
by index) waits for `tick`, which the daemon's working loop calls: without the loop there is no heartbeat.
"""

from __future__ import annotations

import threading
from collections import deque
from collections.abc import Callable, Iterator, Sequence
from typing import Protocol

from dappled.clock import Clock
from dappled.daemon.camera_protocol.camera_status import CameraModel, CameraStatus, Captured, image_captured
from dappled.daemon.camera_protocol.commands import (
    ACCEPTED,
    UNSUPPORTED,
    CameraCommands,
    Command,
    CommandAnswer,
    MessageIntervals,
)
from dappled.daemon.camera_protocol.ftp_server import FtpServer
from dappled.daemon.camera_protocol.parameters import ParameterReply, Parameters, ParameterServer
from dappled.daemon.health.status_text import GroundStations, PilotMessages
from dappled.daemon.pipeline.repeats import AutopilotCommands, CaptureRequest, PacketDedup
from dappled.daemon.pipeline.shutter import Shutter
from dappled.drivers.mavlink import Message, Packet, mavlink

TIMESYNC_NS = 200_000_000
STREAMS_NS = 5 * 10**9
STREAMS = (  # message, interval in microseconds
    (mavlink.MAVLINK_MSG_ID_GLOBAL_POSITION_INT, 20_000),
    (mavlink.MAVLINK_MSG_ID_ATTITUDE_QUATERNION, 20_000),
    (mavlink.MAVLINK_MSG_ID_GPS_RAW_INT, 200_000),
    (mavlink.MAVLINK_MSG_ID_SYSTEM_TIME, 1_000_000),
)
LISTEN_NS = 3 * 10**9
ALONE_NS = 1_200_000_000  # heartbeats come every second: a second autopilot would have shown by now
_WANTED = frozenset(message_id for message_id, _ in STREAMS)


class Links(Protocol):
    """What the camera needs of `drivers.mavlink.MavlinkLinks`."""

    system_id: int
    component_id: int

    def send(self, message: Message, link: int | None = None) -> bool: ...


class OwnAutopilot:
    """The autopilot of the system that the camera belongs to, on the link that it was last heard on."""

    def __init__(self, links: Links, identity: SystemIdentity, clock: Clock) -> None:
        self._links, self._identity, self._clock = links, identity, clock
        self._commands = AutopilotCommands()
        self._requests = AutopilotRequests()

    def heard(self, message: Message) -> None:
        """Count a message of its system."""
        self._requests.heard(message.get_msgId())

    def ask(self) -> None:
        """Send what is due by now: requests for the time, and for streams that arrive too slowly."""
        autopilot = self._identity.autopilot()
        if autopilot is not None:
            system, link = autopilot
            for message in self._requests.due(system, self._clock.monotonic_ns(), self._clock.utc_ns()):
                self._links.send(message, link)

    def command(self, number: int, parameters: Sequence[float]) -> str | None:
        """Send it a command (MAV_CMD, parameters from the first); a sentence where it can't be sent."""
        autopilot = self._identity.autopilot()
        if autopilot is None:
            return "no autopilot was heard on the MAVLink links"
        system, link = autopilot
        self._commands.sent(number, self._clock.monotonic_ns())
        seven = (*parameters, *(0.0,) * (7 - len(parameters)))
        sent = self._links.send(mavlink.MAVLink_command_long_message(system, 1, number, 0, *seven), link)
        return None if sent else "its link takes no more messages"

    def refusal(self, message: Message) -> str | None:
        """A sentence where a COMMAND_ACK refuses a command of ours."""
        ours = message.get_srcSystem() == self._identity.system_id and message.target_component in (
            0,
            self._links.component_id,
        )
        if not ours or message.command not in self._commands.numbers:
            return None
        if message.result in (mavlink.MAV_RESULT_ACCEPTED, mavlink.MAV_RESULT_IN_PROGRESS):
            return None
        result = mavlink.enums["MAV_RESULT"].get(message.result)
        word = result.name.removeprefix("MAV_RESULT_").lower() if result else message.result
        return f"the autopilot did not fire the camera: command {message.command} {word}"

    def is_echo(self, packet: Packet, kind: str) -> bool:
        """Whether it only reports that it does what we commanded."""
        message = packet.message
        if (message.get_srcSystem(), message.get_srcComponent()) != (self._identity.system_id, 1):
            return False
        return self._commands.is_echo(kind, packet.link, self._clock.monotonic_ns())


class AutopilotRequests:
    """Requests for the time at 5 Hz and, every five seconds, for streams that arrived at less than half their rate."""

    def __init__(self) -> None:
        self._heard: dict[int, int] = {}
        self._time_due_ns = self._streams_due_ns = 0

    def heard(self, message_id: int) -> None:
        """Count a message of our autopilot."""
        if message_id in _WANTED:
            self._heard[message_id] = self._heard.get(message_id, 0) + 1

    def due(self, system: int, now_ns: int, utc_ns: int) -> Iterator[Message]:
        """The requests that are due by now."""
        if now_ns >= self._time_due_ns:
            self._time_due_ns = now_ns + TIMESYNC_NS
            yield mavlink.MAVLink_timesync_message(0, utc_ns)
        if now_ns >= self._streams_due_ns:
            self._streams_due_ns = now_ns + STREAMS_NS
            heard, self._heard = self._heard, {}
            for message_id, interval_us in STREAMS:
                if heard.get(message_id, 0) < STREAMS_NS / (interval_us * 1e3) / 2:
                    yield mavlink.MAVLink_command_long_message(
                        system, 1, mavlink.MAV_CMD_SET_MESSAGE_INTERVAL, 0, message_id, interval_us, 0, 0, 0, 0, 0
                    )


class SystemIdentity:
    """Which system this camera belongs to.

    Decides three seconds after the start at the latest: the system id of the only autopilot heard, or the configured
    one where there are several or none. Decides sooner when one autopilot was heard alone for 1.2 s. Where none was
    heard (it boots more slowly than this machine), the first one heard alone for 1.2 s later is taken, for good.
    """

    def __init__(self, configured_system_id: int, start_ns: int) -> None:
        self.system_id = configured_system_id
        self.settled = False
        self.autopilots: dict[int, int] = {}  # system id: link it was last heard on
        self._none_yet = True
        self._start_ns = start_ns
        self._first_heard_ns: int | None = None

    def heard(self, message: Message, link: int, now_ns: int) -> None:
        """Take a HEARTBEAT. Times are monotonic."""
        if message.autopilot == mavlink.MAV_AUTOPILOT_INVALID or message.type == mavlink.MAV_TYPE_GCS:
            return
        if len(self.autopilots) < 32 or message.get_srcSystem() in self.autopilots:
            self.autopilots[message.get_srcSystem()] = link
        if self._first_heard_ns is None:
            self._first_heard_ns = now_ns

    def decide(self, now_ns: int) -> bool:
        """Decide if possible by now. Whether it is decided."""
        waited = self._first_heard_ns is not None and now_ns - self._first_heard_ns >= ALONE_NS
        if not self.settled and now_ns - self._start_ns >= LISTEN_NS:
            self.settled = waited = True
        if self._none_yet and self.autopilots and waited:
            self._none_yet = False
            heard = tuple(self.autopilots)  # as of now: another may be heard meanwhile
            if len(heard) == 1:
                self.settled = True
                self.system_id = heard[0]
        return self.settled

    def doubt(self) -> str | None:
        """A sentence where autopilots are heard, but not the one of the system that the camera belongs to."""
        heard = sorted(self.autopilots)
        if not self.settled or self._none_yet or not heard or self.system_id in heard:
            return None
        ids = ", ".join(map(str, heard))
        who = f"autopilot {ids} is" if len(heard) == 1 else f"autopilots {ids} are"
        return f"{who} heard, the camera belongs to system {self.system_id}: set mavlink.system_id"

    def vehicle(self) -> int | None:
        """The system whose telemetry counts: our own, once that is decided.

        None while no autopilot was heard, or only one of another system, whose telemetry is better than none.
        """
        known = self.settled and (len(self.autopilots) > 1 or self.system_id in self.autopilots)
        return self.system_id if known else None

    def autopilot(self) -> tuple[int, int] | None:
        """(system id, link) of our own autopilot; None while it was not heard."""
        link = self.autopilots.get(self.system_id)
        return None if link is None else (self.system_id, link)


HEARTBEAT_NS = 10**9
STATUS_NS = 100_000_000
_OLD_IMAGES_A_TICK = 2


class Component:
    """One camera on all links.

    `feedback_is_shot`: the autopilot fires the camera, and each of its CAMERA_FEEDBACK is a shot.
    """

    def __init__(
        self,
        links: Links,
        shutter: Shutter,
        clock: Clock,
        parameters: Parameters,
        model: CameraModel,
        *,
        feedback_is_shot: bool = False,
    ) -> None:
        self._links, self._shutter, self._clock = links, shutter, clock
        self._model, self._feedback_is_shot = model, feedback_is_shot
        self._status = CameraStatus(model, shutter, parameters, clock, component_id=links.component_id)
        self._intervals = MessageIntervals()
        self._commands = CameraCommands(shutter, clock, self._status, parameters, self._intervals)
        self._parameters = ParameterServer(parameters)
        self._files = FtpServer(self._status.files)
        self._identity = SystemIdentity(links.system_id, clock.monotonic_ns())
        self._autopilot = OwnAutopilot(links, self._identity, clock)
        self._dedup = PacketDedup()
        self._lines, self._stations = PilotMessages(), GroundStations()
        self._results: deque[tuple[Command, int]] = deque(maxlen=64)
        self._heartbeat_due_ns = self._status_due_ns = 0
        self._status_wanted = threading.Event()
        self._reported = shutter.statistics()

    @property
    def system_id(self) -> int:
        """The system that the camera belongs to, as far as decided."""
        return self._identity.system_id

    @property
    def vehicle(self) -> int | None:
        """The system whose telemetry counts (see `SystemIdentity.vehicle`)."""
        return self._identity.vehicle()

    def doubt(self) -> str | None:
        """A sentence where the camera may belong to the wrong system (see `SystemIdentity.doubt`)."""
        return self._identity.doubt()

    # what comes in

    def on_packet(self, packet: Packet) -> None:
        """A packet was received (sent ones are ignored). Quick; never raises for what a message says."""
        message = packet.message
        if packet.sent or message.get_srcSystem() == 0:
            return
        if (message.get_srcSystem(), message.get_srcComponent()) == (self._links.system_id, self._links.component_id):
            return  # our own packet, received over another link
        handler = _HANDLERS.get(message.get_type())
        if handler is not None and packet.trusted:
            handler(self, packet)
        elif message.get_type() == "HEARTBEAT":
            if (
                packet.trusted
            ):  # an untrusted one must not decide whose camera this is, or which autopilot gets commands
                now_ns = self._clock.monotonic_ns()
                self._identity.heard(message, packet.link, now_ns)
                self._stations.heard(message, now_ns)
        elif message.get_srcSystem() == self._identity.system_id:
            self._autopilot.heard(message)

    def _command(self, packet: Packet) -> None:
        if not self._is_for_us(packet.message):
            return
        command = Command.of(packet.message, packet.link)
        if self._is_duplicate(packet):
            self._acknowledge_again(command)
            return
        echo = self._commands.fires(command) and self._autopilot.is_echo(packet, str(command.name))
        answer = CommandAnswer(ACCEPTED) if echo else self._commands.answer(command)
        if not command.broadcast or answer.result == ACCEPTED:  # a broadcast is never refused
            self._acknowledge(command, answer.result)
            self._results.append((command, answer.result))
        for message in answer.then:
            self._links.send(message, command.link)
        if answer.words is not None:
            self.say(answer.words)
        if answer.result not in (ACCEPTED, UNSUPPORTED):
            self.state_changed()  # a ground station's button waits for the status

    def _acknowledge(self, command: Command, result: int) -> None:
        self._links.send(
            mavlink.MAVLink_command_ack_message(command.name, result, 0, 0, command.system, command.component),
            command.link,
        )

    def _acknowledge_again(self, command: Command) -> None:
        """Answer a duplicate packet without doing its command again: its sender may wait on another link."""
        for known, result in reversed(self._results):
            if (known.source, known.name) == (command.source, command.name):
                if not command.broadcast:
                    self._acknowledge(command, result)
                return

    def _trigger(self, packet: Packet) -> None:
        """CAMERA_TRIGGER (112), and CAMERA_FEEDBACK (180) where the autopilot fires. Neither is acknowledged."""
        message = packet.message
        name = message.get_type()
        if message.get_srcSystem() != self._identity.system_id or self._is_duplicate(packet):
            return
        if name == "CAMERA_FEEDBACK" and not self._feedback_is_shot:
            return  # the hot shoe's time of a known shot: telemetry uses it
        if self._autopilot.is_echo(packet, name):
            return
        source = f"mavlink:{message.get_srcSystem()}/{message.get_srcComponent()}"
        sequence = message.seq if name == "CAMERA_TRIGGER" else message.img_idx
        decision = self._shutter.request(CaptureRequest(source, name, sequence, 0, packet.link, acknowledged=False))
        if not decision.accepted:
            self.say(f"no photo: {decision.reason}")
            self.state_changed()

    def _parameter(self, packet: Packet) -> None:
        message = packet.message
        if not self._is_for_us(message) or self._is_duplicate(packet):
            return
        name = message.get_type()
        if name == "PARAM_EXT_REQUEST_LIST":
            reply = self._parameters.listing()
        elif name == "PARAM_EXT_REQUEST_READ":
            reply = self._parameters.read(message)
        else:
            self._send_changed_parameters()  # earlier changes first, so that the reply follows them
            reply = self._parameters.set(message, packet.link, self._clock.monotonic_ns())
        self._send_reply(reply, packet.link)
        self._send_changed_parameters()

    def _file(self, packet: Packet) -> None:
        if packet.message.target_component == self._links.component_id and self._is_for_us(packet.message):
            for reply in self._files.answer(packet.message, self._clock.monotonic_ns()):
                self._links.send(reply, packet.link)

    def _is_for_us(self, message: Message) -> bool:
        """Our system or all, our component or all."""
        systems = (0, self._links.system_id, self._identity.system_id)
        return message.target_system in systems and message.target_component in (0, self._links.component_id)

    def _is_duplicate(self, packet: Packet) -> bool:
        return self._dedup.is_duplicate(packet, self._clock.monotonic_ns())

    def _command_result(self, packet: Packet) -> None:
        refusal = self._autopilot.refusal(packet.message)
        if refusal is not None:
            self.say(refusal)

    # what goes out

    def command_autopilot(self, number: int, parameters: Sequence[float]) -> str | None:
        """Send our autopilot a command (MAV_CMD, parameters from the first); a sentence where it can't be sent."""
        return self._autopilot.command(number, parameters)

    def announce(self, captured: Captured) -> None:
        """Report a shot that ended, its frame safe or lost, on all links, once."""
        self._links.send(image_captured(captured, self._status.boot_ms()))
        self.state_changed()

    def state_changed(self) -> None:
        """CAMERA_CAPTURE_STATUS may have changed: send it with the next tick."""
        self._status_wanted.set()

    def settings_changed(self, refused: str = "") -> None:
        """The body reported its settings, with a sentence where it `refused` a change."""
        for link, reply in self._parameters.settled(self._clock.monotonic_ns(), refused):
            self._send_reply(reply, link)
        self._send_changed_parameters()
        self._links.send(self._status.settings())

    def say(self, text: str, severity: int = mavlink.MAV_SEVERITY_WARNING) -> None:
        """Send a line to the pilot (STATUSTEXT)."""
        for message in self._lines.messages(text, severity, self._clock.monotonic_ns()):
            self._links.send(message)

    def audience_has_grown(self) -> bool:
        """Whether a ground station has connected that missed earlier lines; True once."""
        return self._stations.new_one(self._clock.monotonic_ns())

    def tick(self) -> None:
        """Send what is due by now: heartbeat, time requests, stream requests, status, periodic messages, old images."""
        now_ns = self._clock.monotonic_ns()
        if not self._identity.decide(now_ns):
            return
        self._links.system_id = self._identity.system_id
        if now_ns >= self._heartbeat_due_ns and self._model.healthy():
            on_time_ns = self._heartbeat_due_ns + HEARTBEAT_NS
            self._heartbeat_due_ns = on_time_ns if on_time_ns > now_ns else now_ns + HEARTBEAT_NS
            state = mavlink.MAV_STATE_CRITICAL if self._model.troubled() else mavlink.MAV_STATE_ACTIVE
            self._links.send(
                mavlink.MAVLink_heartbeat_message(
                    mavlink.MAV_TYPE_CAMERA, mavlink.MAV_AUTOPILOT_INVALID, 0, 0, state, 3
                )
            )
        self._autopilot.ask()
        if (counts := self._shutter.statistics()) != self._reported:
            self._reported = counts
            self._status_wanted.set()
        if self._status_wanted.is_set() and now_ns >= self._status_due_ns:
            self._status_wanted.clear()
            self._status_due_ns = now_ns + STATUS_NS
            self._links.send(self._status.status())
        for number in self._intervals.due(now_ns):
            self._links.send(self._status.about(number))
        for link, reply in self._parameters.settled(now_ns):
            self._send_reply(reply, link)
        self._send_old_images()

    def _send_reply(self, reply: ParameterReply, link: int) -> None:
        for message in reply.messages:
            self._links.send(message, link)
        if reply.words is not None:
            self.say(reply.words)

    def _send_changed_parameters(self) -> None:
        for message in self._parameters.changed():
            self._links.send(message)

    def _send_old_images(self) -> None:
        wanted = self._commands.wanted_images
        for _ in range(min(_OLD_IMAGES_A_TICK, len(wanted))):  # each may open a ledger: heartbeats go on
            index, link = wanted.popleft()
            captured = self._model.lookup(index)
            if captured is None:
                self.say(f"image {index} is in none of the flights here, or has not ended yet")
            else:
                self._links.send(image_captured(captured, self._status.boot_ms()), link)


_HANDLERS: dict[str, Callable[[Component, Packet], None]] = {
    "COMMAND_LONG": Component._command,
    "COMMAND_INT": Component._command,
    "COMMAND_ACK": Component._command_result,
    "CAMERA_TRIGGER": Component._trigger,
    "CAMERA_FEEDBACK": Component._trigger,
    "PARAM_EXT_REQUEST_LIST": Component._parameter,
    "PARAM_EXT_REQUEST_READ": Component._parameter,
    "PARAM_EXT_SET": Component._parameter,
    "FILE_TRANSFER_PROTOCOL": Component._file,
}
