"""The camera's own autopilot: what it is asked for (telemetry, the time), what it is ordered, what it only echoes."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from typing import Protocol

from dappled.clock import Clock
from dappled.daemon.camera_protocol.autopilot_commands import Orders
from dappled.daemon.camera_protocol.command import ACCEPTED
from dappled.daemon.camera_protocol.identity import Identity
from dappled.drivers.mavlink.links import Message, Packet, mavlink

TIMESYNC_NS = 200_000_000
STREAMS_NS = 5 * 10**9
STREAMS = (  # message, interval in microseconds
    (mavlink.MAVLINK_MSG_ID_GLOBAL_POSITION_INT, 20_000),
    (mavlink.MAVLINK_MSG_ID_ATTITUDE_QUATERNION, 20_000),
    (mavlink.MAVLINK_MSG_ID_GPS_RAW_INT, 200_000),
    (mavlink.MAVLINK_MSG_ID_SYSTEM_TIME, 1_000_000),
)
_WANTED = frozenset(message_id for message_id, _ in STREAMS)


class Links(Protocol):
    """What the camera needs of `drivers.mavlink.MavlinkLinks`."""

    system_id: int
    component_id: int

    def send(self, message: Message, link: int | None = None) -> bool: ...


class OwnAutopilot:
    """The autopilot of the system that the camera belongs to, over the link that it was heard on last."""

    def __init__(self, links: Links, identity: Identity, clock: Clock) -> None:
        self._links, self._identity, self._clock = links, identity, clock
        self._orders = Orders()
        self._requests = AutopilotRequests()

    def heard(self, message: Message) -> None:
        """A message of its system came in."""
        self._requests.heard(message.get_msgId())

    def ask(self) -> None:
        """Send what is due by now: requests for the time, and for streams that come too slowly."""
        autopilot = self._identity.autopilot()
        if autopilot is not None:
            system, link = autopilot
            for message in self._requests.due(system, self._clock.monotonic_ns(), self._clock.utc_ns()):
                self._links.send(message, link)

    def order(self, number: int, parameters: Sequence[float]) -> str | None:
        """Give it a command (MAV_CMD, parameters from the first); a sentence where it can't be given."""
        autopilot = self._identity.autopilot()
        if autopilot is None:
            return "no autopilot was heard on the MAVLink links"
        system, link = autopilot
        self._orders.given(number, self._clock.monotonic_ns())
        seven = (*parameters, *(0.0,) * (7 - len(parameters)))
        sent = self._links.send(mavlink.MAVLink_command_long_message(system, 1, number, 0, *seven), link)
        return None if sent else "its link takes no more messages"

    def refusal(self, message: Message) -> str | None:
        """A sentence where a COMMAND_ACK refuses an order of ours: nobody else would hear of it."""
        ours = message.get_srcSystem() == self._identity.system_id and message.target_component in (
            0,
            self._links.component_id,
        )
        if not ours or message.command not in self._orders.commands:
            return None
        if message.result in (ACCEPTED, mavlink.MAV_RESULT_IN_PROGRESS):
            return None
        result = mavlink.enums["MAV_RESULT"].get(message.result)
        word = result.name.removeprefix("MAV_RESULT_").lower() if result else message.result
        return f"the autopilot did not fire the camera: command {message.command} {word}"

    def is_echo(self, packet: Packet, kind: str) -> bool:
        """Whether it only tells that it does what we ordered."""
        message = packet.message
        if (message.get_srcSystem(), message.get_srcComponent()) != (self._identity.system_id, 1):
            return False
        return self._orders.is_echo(kind, packet.link, self._clock.monotonic_ns())


class AutopilotRequests:
    """Asks for the time at 5 Hz and, every five seconds, for each stream that came at less than half its rate."""

    def __init__(self) -> None:
        self._heard: dict[int, int] = {}
        self._time_due_ns = self._streams_due_ns = 0

    def heard(self, message_id: int) -> None:
        """A message of our autopilot came in."""
        if message_id in _WANTED:
            self._heard[message_id] = self._heard.get(message_id, 0) + 1

    def due(self, system: int, now_ns: int, utc_ns: int) -> Iterator[Message]:
        """What is to be sent to it by now."""
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
