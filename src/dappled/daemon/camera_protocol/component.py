"""The MAVLink camera (Camera Protocol v2): answer messages at once, and report how shots ended.

`on_packet` runs in a link's receiving thread and only answers from memory. What may read a disk (an old image looked up
by index) waits for `tick`, which the daemon's working loop calls: without the loop there is no heartbeat.
"""

from __future__ import annotations

import math
import threading
from collections import deque
from collections.abc import Callable, Mapping
from dataclasses import replace
from datetime import UTC, datetime

from dappled.daemon.camera_protocol.camera_status import CameraModel, CameraStatus, Captured
from dappled.daemon.camera_protocol.commands import (
    ACCEPTED,
    AUTOPILOT,
    UNSUPPORTED,
    CameraCommands,
    Command,
    CommandAnswer,
    MessageIntervals,
)
from dappled.daemon.camera_protocol.earlier_outcomes import EarlierOutcomes
from dappled.daemon.camera_protocol.feedback import CameraFeedback
from dappled.daemon.camera_protocol.ftp_server import FtpServer
from dappled.daemon.camera_protocol.own_autopilot import LISTEN_NS, OwnAutopilot
from dappled.daemon.camera_protocol.parameters import ParameterReply, Parameters, ParameterServer
from dappled.daemon.health.status_text import GroundStations, PilotMessages
from dappled.daemon.navigation.samples import CAPTURED, image_number, sent_us
from dappled.daemon.pipeline.repeats import CaptureRequest, PacketDedup
from dappled.daemon.pipeline.shutter import Shutter
from dappled.daemon.pipeline.spacing import DistanceTrigger
from dappled.drivers.mavlink import MavlinkMessage, Packet, is_for, mavlink
from dappled.drivers.mavlink.log_budget import Rate
from dappled.findings import Code, Finding, Subject, Value, finding, told

PROOF_NS = 500_000_000
_STEADY_NS = 300_000_000  # telemetry is requested at 50 Hz
_ON_ITS_WAY_NS = 100_000_000  # what came so soon after a report may have been sent before it
_HEARTBEATS, _HEARTBEATS_NS = 256, 5 * 10**9
_KNOWN_NS = 2 * 10**9  # so long, and every station behind a port has been heard there
_REPORTS = 256
HEARTBEAT_NS = 10**9
STATUS_NS = 600_000_000  # at most twice a second, and the last state within a second
_OLD_IMAGES_A_TICK = 2
_ANSWERS_A_S, _WORDS_A_S = 250.0, 0.5  # over unsigned links that strangers reach; twice as much at once
_SAME_IDS_NS = 15 * 10**9


class ReportRoutes:
    """On which links a report is sent, so that each station has it once where one autopilot is heard on two of them.

    An autopilot forwards what it gets on one port to its radio and to its other ports; or not, which can't be asked. No
    packet of our own shows it: ArduPilot returns no heartbeat to a port on which it has heard the sender. The proof
    is the heartbeats of others. If every one that came over a port came over the other port too, as the same
    packet, whoever can be reached over the first port can be over the other: the first port gets no report. A
    heartbeat that came over one port alone is a station that may only be there, and both ports get it. So does a
    port where nobody but the autopilot was heard, and one that has just come back: a station there may not have
    been heard yet. If the other port falls silent around a report for `_STEADY_NS` (the cable is out, or the
    autopilot's telemetry is slower than requested), it is sent on the first port after all: a station that has it
    twice is better than one that never has it. With three ports or more all get every report. Times are monotonic;
    all methods may be called from any thread.
    """

    def __init__(self) -> None:
        self._lock = threading.Lock()
        self._ports: dict[
            int, tuple[int, int]
        ] = {}  # link: since when the autopilot is heard steadily there; last time
        self._heartbeats: dict[int, dict[tuple[int, int, int], int]] = {}  # link: packets, and when they came
        self._waiting: dict[int, tuple[int, int, int, MavlinkMessage]] = {}  # image: sent, on, not on, the report
        self._ended = False

    def autopilot_heard(self, link: int, now_ns: int) -> None:
        """The autopilot of our system was heard on a link."""
        with self._lock:
            since_ns, last_ns = self._ports.get(link, (now_ns, now_ns))
            self._ports[link] = (since_ns if now_ns - last_ns <= _STEADY_NS else now_ns), now_ns

    def heartbeat(self, message: MavlinkMessage, link: int, now_ns: int) -> None:
        """A heartbeat of another component than our own autopilot."""
        with self._lock:
            known = self._heartbeats.setdefault(link, {})
            known[message.get_srcSystem(), message.get_srcComponent(), message.get_seq()] = now_ns
            if len(known) > _HEARTBEATS:
                known.pop(next(iter(known)))

    def without(self, report: MavlinkMessage, now_ns: int) -> int | None:
        """The port that this report is not sent on; None: it is sent on all links."""
        with self._lock:
            heard = {link: last_ns for link, (_, last_ns) in self._ports.items() if now_ns - last_ns <= LISTEN_NS}
            ports = sorted(heard, key=lambda link: -heard[link])
            if len(ports) != 2 or self._ended:
                return None
            for port, other in (ports, ports[::-1]):
                if self._reaches_all_of(port, other, now_ns):
                    self._waiting[report.image_index] = now_ns, port, other, report
                    return other
            return None

    def _reaches_all_of(self, port: int, other: int, now_ns: int) -> bool:
        """Whether every heartbeat that came over `other` came over `port` too. The last one may still come."""
        if now_ns - self._ports[other][0] < _KNOWN_NS:
            return False
        there = self._heartbeats.get(port, {})
        proven: set[tuple[int, int]] = set()
        for packet, heard_ns in self._heartbeats.get(other, {}).items():
            if now_ns - heard_ns > _HEARTBEATS_NS:
                continue
            sender, copy_ns = packet[:2], there.get(packet)
            if copy_ns is not None and abs(copy_ns - heard_ns) <= LISTEN_NS:
                proven.add(sender)
            elif sender not in proven or now_ns - heard_ns > HEARTBEAT_NS // 2:
                return False
        return bool(proven)

    def taken(self, image: int) -> None:
        """This report needs no other port any more."""
        with self._lock:
            self._waiting.pop(image, None)

    def unproven(self, now_ns: int, *, ended: bool = False) -> list[tuple[int, MavlinkMessage]]:
        """(link, report) of those whose port has been silent since: to be sent, again and again until one is `taken`.
        `ended`: nothing is waited for, and later reports are sent on all links."""
        with self._lock:
            self._ended = self._ended or ended
            for image, (sent_ns, port, _, _) in list(self._waiting.items()):
                since_ns, last_ns = self._ports[port]
                if since_ns <= sent_ns and last_ns > sent_ns + _ON_ITS_WAY_NS:
                    del self._waiting[image]
            while len(self._waiting) > _REPORTS:
                self._waiting.pop(next(iter(self._waiting)))
            due = [one for one in self._waiting.values() if ended or now_ns - one[0] >= PROOF_NS]
        return [(other, report) for _, _, other, report in due]


class Component:
    """One camera on all links of its autopilot.

    Where the shutter doesn't fire the camera, each CAMERA_FEEDBACK about it is a shot.
    """

    def __init__(
        self,
        autopilot: OwnAutopilot,
        shutter: Shutter,
        parameters: Parameters,
        *,
        model: CameraModel,
        earlier: EarlierOutcomes,
        series: DistanceTrigger,
    ) -> None:
        links, clock = autopilot.links, shutter.clock
        self._links, self._autopilot, self._identity = links, autopilot, autopilot.identity
        self.shutter, self._clock = shutter, clock
        self._model, self._earlier = model, earlier
        self._feedback = CameraFeedback(autopilot, clock, makes_shots=not shutter.fires)
        self._status = CameraStatus(model, shutter, parameters, clock, component_id=links.component_id)
        self._intervals = MessageIntervals()
        self._commands = CameraCommands(
            shutter,
            clock,
            self._status,
            parameters,
            intervals=self._intervals,
            series=series,
            component_id=links.component_id,
        )
        self._parameters = ParameterServer(parameters)
        self._files = FtpServer(self._status.files)
        self._answers, self._words = Rate(_ANSWERS_A_S), Rate(_WORDS_A_S)
        self._dedup, self._routes = PacketDedup(), ReportRoutes()
        self._lines, self._stations = PilotMessages(), GroundStations()
        self._rivals: Mapping[str, Value] = {}  # the other vehicles that were told of
        self._same_ids: dict[int, tuple[str, int]] = {}  # link: who sends with our ids, and when last
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

    def findings(self) -> list[Finding]:
        """That the camera may belong to the wrong system (see `SystemIdentity.doubt`); other vehicles on the links, and
        other components that send with our own ids: who hears both can't tell them apart; and what the
        autopilot does otherwise than the camera needs."""
        rivals, other = self._identity.rivals(), self._identity.doubt()
        now_ns = self._clock.monotonic_ns()
        system, component = self._links.system_id, self._links.component_id
        same = [
            *([] if other is None else [other]),
            *(
                finding(Code.LINK_SAME_IDS, Subject("link", link), source=source, system=system, component=component)
                for link, (source, heard_ns) in sorted(self._same_ids.items())
                if now_ns - heard_ns <= _SAME_IDS_NS
            ),
            *self._autopilot.findings(),
        ]
        return same if rivals is None else [*same, rivals]

    # what comes in

    def on_packet(self, packet: Packet) -> None:
        """A packet was received (sent ones are ignored). Quick; never raises for what a message says."""
        message = packet.message
        if packet.sent or message.get_srcSystem() == 0:
            return
        source = message.get_srcSystem(), message.get_srcComponent()
        if source == (self._links.system_id, self._links.component_id):
            if packet.same_ids and packet.trusted:
                self._heard_same_ids(packet)
            return  # mostly our own, forwarded to another link
        if packet.trusted and source == (self._identity.system_id, 1):
            self._routes.autopilot_heard(packet.link, self._clock.monotonic_ns())
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
                if source != (self._identity.system_id, 1):
                    self._routes.heartbeat(message, packet.link, now_ns)
        elif packet.trusted and message.get_srcSystem() == self._identity.system_id:
            self._autopilot.heard(message)

    def _heard_same_ids(self, packet: Packet) -> None:
        """Names one source on a link while it is heard; before the ids are decided it may be nobody's."""
        if not self._identity.settled:
            return
        now_ns = self._clock.monotonic_ns()
        source, heard_ns = self._same_ids.get(packet.link, (packet.same_ids, now_ns))
        if packet.same_ids == source or now_ns - heard_ns > _SAME_IDS_NS:
            self._same_ids[packet.link] = packet.same_ids, now_ns

    def _command(self, packet: Packet) -> None:
        if not self._is_for_us(packet.message):
            return
        command = Command.of(packet.message, packet.link, exposed=packet.exposed)
        if self._is_duplicate(packet):
            self._acknowledge_again(command)
            return
        echo = self._commands.fires(command) and self._autopilot.is_echo(packet, str(command.name))
        answer = CommandAnswer(ACCEPTED) if echo else self._commands.answer(command)
        if (
            command.of_autopilot
            and not command.broadcast
            and self._commands.fires(command)
            and answer.result == ACCEPTED
        ):
            self._autopilot.fired_by(command.system)
        self._count_trigger(command, new=answer.new_shot)
        if not command.broadcast or answer.result == ACCEPTED or answer.to_all:  # another one may do what is for all
            self._acknowledge(command, answer.result)
            self._results.append((command, answer.result))
        for message in answer.then:
            self._links.send(message, command.link)
        if answer.words is not None:
            self.say(answer.words)
        if answer.result not in (ACCEPTED, UNSUPPORTED):
            self.state_changed()  # a ground station's button waits for the status

    def _count_trigger(self, command: Command, *, new: bool) -> None:
        """ArduPilot numbers its requests as its CAMERA_FEEDBACK; PX4 numbers those to each camera on their own.

        `new`: the command became a shot of its own."""
        if not command.of_autopilot or command.system != self._identity.system_id:
            return
        if not self._commands.concerns(command):
            return  # the numbers of another camera
        if not self._identity.is_ardupilot():
            if new and not command.test_shot:
                self._autopilot.numbers["CAMERA_TRIGGER"].unnumbered(self._clock.monotonic_ns())
        elif command.name != mavlink.MAV_CMD_IMAGE_START_CAPTURE:
            return
        elif command.photographs == 1 and (number := command.integer(4)) > 0:
            self._autopilot.numbers["CAMERA_FEEDBACK"].heard(number, self._clock.monotonic_ns(), self._here)

    def _here(self) -> str:
        """When and where that is noticed, in words."""
        now = datetime.fromtimestamp(self._clock.utc_ns() / 1e9, UTC)
        when = f"noticed at {now:%Y-%m-%dT%H:%M:%S}.{now.microsecond // 100_000}Z"
        pose = self._model.pose()
        if pose is None or pose.latitude_rad is None or pose.longitude_rad is None:
            return when
        return f"{when} near {math.degrees(pose.latitude_rad):.6f}, {math.degrees(pose.longitude_rad):.6f}"

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
        """CAMERA_TRIGGER (112); where the autopilot fires, CAMERA_FEEDBACK (180) and the autopilot's own
        CAMERA_IMAGE_CAPTURED (263). None is acknowledged."""
        message = packet.message
        name, of_autopilot = message.get_type(), message.get_srcComponent() == AUTOPILOT
        if name == CAPTURED and (self.shutter.fires or not of_autopilot):
            return
        if message.get_srcSystem() != self._identity.system_id or self._is_duplicate(packet):
            return
        sequence, time_us = image_number(message), sent_us(message)
        clock_us = 0 if name == "CAMERA_FEEDBACK" else time_us  # a contact repeats ArduPilot's number
        if not of_autopilot or self._autopilot.is_stale(clock_us):
            clock_us = 0
        numbers, now_ns = self._autopilot.numbers[name], self._clock.monotonic_ns()
        if name == "CAMERA_FEEDBACK":
            ours = self._feedback.is_trigger(message, self._here)
            if ours and self.shutter.fires:
                numbers.reported(sequence, now_ns, self._here)
            if not ours or self.shutter.fires:
                return  # the hot shoe's time of a known shot: telemetry uses it
        if name == CAPTURED and not self._feedback.is_capture(message, self._here):
            return
        if self._autopilot.is_echo(packet, name):
            numbers.heard(sequence, now_ns, self._here, time_us=clock_us)
            return
        request = CaptureRequest(
            f"mavlink:{message.get_srcSystem()}/{message.get_srcComponent()}",
            name,
            sequence,
            0,
            packet.link,
            acknowledged=False,
            time_us=time_us,
            autopilot=True,
            happened=not self.shutter.fires,
        )
        known = False
        try:
            decision = self.shutter.request(request)
            known = decision.outcome == "duplicate"
        finally:  # a shot that could not be fired is in the books as failed, and not lost
            triggers = self._autopilot.numbers["CAMERA_TRIGGER"]
            if name != CAPTURED or not triggers.begun:
                numbers.heard(sequence, now_ns, self._here, known=known, time_us=clock_us)
            elif not known:
                triggers.unnumbered(now_ns)  # its CAMERA_TRIGGER was lost, or there was none
            self._feedback.made_shot(name, known=known)
        if not decision.accepted:
            self.say(decision.words)
            self.state_changed()

    def _parameter(self, packet: Packet) -> None:
        message = packet.message
        if not self._is_for_us(message) or self._is_duplicate(packet):
            return
        name = message.get_type()
        if name == "PARAM_EXT_REQUEST_LIST":
            reply = self._parameters.listing()
            if not self._may_answer(packet, len(reply.messages)):
                return
        elif name == "PARAM_EXT_REQUEST_READ":
            reply = self._parameters.read(message)
        else:
            self._send_changed_parameters()  # earlier changes first, so that the reply follows them
            reply = self._parameters.set(message, packet.link, self._clock.monotonic_ns(), exposed=packet.exposed)
        if packet.exposed and reply.words is not None and not self._words.takes(1, self._clock.monotonic_ns()):
            reply = replace(reply, words=None)  # the pilot's screen is not the strangers'
        self._send_reply(reply, packet.link)
        self._send_changed_parameters()

    def _file(self, packet: Packet) -> None:
        if packet.message.target_component == self._links.component_id and self._is_for_us(packet.message):
            replies = self._files.answer(packet.message, self._clock.monotonic_ns())
            for reply in replies if self._may_answer(packet, len(replies)) else ():
                self._links.send(reply, packet.link)

    def _may_answer(self, packet: Packet, count: int) -> bool:
        """Whether so many messages may follow one: where strangers ask, they are few, so that the others' commands are
        acknowledged meanwhile."""
        return not packet.exposed or self._answers.takes(count, self._clock.monotonic_ns())

    def _is_for_us(self, message: MavlinkMessage) -> bool:
        return is_for(message, (self._links.system_id, self._identity.system_id), self._links.component_id)

    def _is_duplicate(self, packet: Packet) -> bool:
        return self._dedup.is_duplicate(packet, self._clock.monotonic_ns())

    def _command_result(self, packet: Packet) -> None:
        refusal = self._autopilot.refusal(packet.message)
        if refusal is not None:
            self.say(refusal)

    # what goes out

    def announce(self, captured: Captured) -> bool:
        """Report a shot that ended, its frame safe or lost, once to each receiver (see `ReportRoutes`). False where no
        link took it."""
        report = self._status.image(captured)
        without = self._routes.without(report, self._clock.monotonic_ns())
        taken = self._links.send(report, without=without)
        if not taken and without is not None:
            self._routes.taken(captured.index)
            taken = self._links.send(report)
        self.state_changed()
        return taken

    def state_changed(self) -> None:
        """CAMERA_CAPTURE_STATUS may have changed: send it with the next tick."""
        self._status_wanted.set()

    def settings_changed(self, refused: str = "") -> None:
        """The body reported its settings, with a sentence where it `refused` a change."""
        for link, reply in self._parameters.settled(self._clock.monotonic_ns(), refused):
            self._send_reply(reply, link)
        self._send_changed_parameters()
        self._links.send(self._status.settings())

    def say(self, text: str, severity: int = mavlink.MAV_SEVERITY_WARNING, *, news: bool = False) -> None:
        """Send a line to the pilot (STATUSTEXT); `news` although it was sent just before."""
        for message in self._lines.messages(text, severity, self._clock.monotonic_ns(), news=news):
            self._links.send(message)

    def audience_has_grown(self) -> bool:
        """Whether a ground station has connected that missed earlier lines; True once."""
        return self._stations.new_one(self._clock.monotonic_ns())

    def tick(self, *, healthy: Callable[[], bool] = lambda: True) -> None:
        """Send what is due by now: time requests, stream requests, status, periodic messages, old images, outcomes of
        earlier flights; and, where the daemon is `healthy`, the heartbeat."""
        now_ns = self._clock.monotonic_ns()
        if not self._identity.decide(now_ns):
            return
        self._links.system_id = self._identity.system_id
        if now_ns >= self._heartbeat_due_ns and healthy():
            on_time_ns = self._heartbeat_due_ns + HEARTBEAT_NS
            self._heartbeat_due_ns = on_time_ns if on_time_ns > now_ns else now_ns + HEARTBEAT_NS
            state = mavlink.MAV_STATE_CRITICAL if self._model.troubled() else mavlink.MAV_STATE_ACTIVE
            self._links.send(
                mavlink.MAVLink_heartbeat_message(
                    mavlink.MAV_TYPE_CAMERA, mavlink.MAV_AUTOPILOT_INVALID, 0, 0, state, 3
                )
            )
        self._autopilot.ask()
        rivals = self._identity.rivals()
        if rivals is not None and rivals.facts != self._rivals:
            self._rivals = rivals.facts
            self.say(str(told(rivals)), mavlink.MAV_SEVERITY_NOTICE)
        self._tell_lost_triggers()
        if (counts := self.shutter.statistics()) != self._reported:
            self._reported = counts
            self._status_wanted.set()
        if self._status_wanted.is_set() and now_ns >= self._status_due_ns:
            self._status_wanted.clear()
            self._status_due_ns = now_ns + STATUS_NS
            self._links.send(self._status.status())
        self._send_unproven_reports(now_ns)
        for number in self._intervals.due(now_ns):
            self._links.send(self._status.about(number))
        if (refused := self._commands.zoom_further()) is not None:
            self.say(refused)
        for link, reply in self._parameters.settled(now_ns):
            self._send_reply(reply, link)
        self._send_old_images()
        if self._stations.listening(now_ns):
            self._send_earlier_outcomes(now_ns)

    def finish(self) -> None:
        """The flight ends: tell what would have been waited for."""
        self._tell_lost_triggers(at_once=True)
        self._send_unproven_reports(self._clock.monotonic_ns(), ended=True)

    def _send_unproven_reports(self, now_ns: int, *, ended: bool = False) -> None:
        for link, report in self._routes.unproven(now_ns, ended=ended):
            if self._links.send(report, link):
                self._routes.taken(report.image_index)

    def _tell_lost_triggers(self, *, at_once: bool = False) -> None:
        for lost in self._autopilot.lost_triggers(at_once=at_once):
            self._model.lost(lost)
            self.say(f"lost: {told(lost)}", mavlink.MAV_SEVERITY_ERROR)

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
                self._links.send(self._status.image(captured), link)

    def _send_earlier_outcomes(self, now_ns: int) -> None:
        if lost := self._earlier.summary():
            self.say(lost, mavlink.MAV_SEVERITY_ERROR)
        for captured in self._earlier.due(now_ns):
            if self.announce(captured):
                self._earlier.sent(captured.index)


_HANDLERS: dict[str, Callable[[Component, Packet], None]] = {
    "COMMAND_LONG": Component._command,
    "COMMAND_INT": Component._command,
    "COMMAND_ACK": Component._command_result,
    "CAMERA_TRIGGER": Component._trigger,
    "CAMERA_FEEDBACK": Component._trigger,
    "CAMERA_IMAGE_CAPTURED": Component._trigger,
    "PARAM_EXT_REQUEST_LIST": Component._parameter,
    "PARAM_EXT_REQUEST_READ": Component._parameter,
    "PARAM_EXT_SET": Component._parameter,
    "FILE_TRANSFER_PROTOCOL": Component._file,
}
