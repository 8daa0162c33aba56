"""Answer on the links while no flight can be recorded: heartbeats, why, and a refusal for each photograph asked for.

The disk may be read-only, full or gone. Whoever flies is to hear that, not silence.
"""

from __future__ import annotations

import os
import tempfile
import threading
from collections.abc import Callable
from pathlib import Path

from dappled.clock import Clock, SystemClock
from dappled.config.settings import Settings
from dappled.daemon.camera_protocol.own_autopilot import SystemIdentity
from dappled.daemon.configured_links import configured_links
from dappled.daemon.health.status_text import GroundStations, PilotMessages
from dappled.drivers.mavlink import MavlinkMessage, Packet, PacketSender, Transport, is_for, mavlink

_HEARTBEAT_NS = 10**9
_SAID_NS = 30 * 10**9
_TURN_S = 0.1


def answer_meanwhile(
    settings: Settings,
    reason: str,
    until: Callable[[], bool],
    clock: Clock | None = None,
    transport: Transport | None = None,
) -> None:
    """Answer on the links of the settings, and say the reason, until that holds. Raises LinkError, SigningError.

    Signing times can't be kept either. A packet that is replayed here is refused like any other.
    """
    clock = clock or SystemClock()
    runtime = os.environ.get("RUNTIME_DIRECTORY")  # systemd's, in memory: /tmp may lie on the disk that is read-only
    with tempfile.TemporaryDirectory(prefix="dappled-", dir=runtime) as times:
        links = configured_links(settings, clock, transport, times=Path(times))
        camera = _GroundedCamera(links.sender, settings, reason, clock)
        turn = threading.Event()
        links.start(camera)
        try:
            while not until():
                camera.tick()
                clock.wait(turn, _TURN_S)
        finally:
            links.stop()


class _GroundedCamera:
    """The camera of a daemon that can't record. Packets come from the links' threads."""

    def __init__(self, links: PacketSender, settings: Settings, reason: str, clock: Clock) -> None:
        self._links, self._reason, self._clock = links, reason, clock
        self._identity = SystemIdentity(settings.mavlink.system_id, clock.monotonic_ns())
        self._lines, self._stations = PilotMessages(), GroundStations()
        self._heartbeat_due_ns = self._said_due_ns = 0

    def log_packet(self, _stamp_us: int, _raw: bytes) -> int | None:
        """There is no telemetry log."""
        return None

    def on_packet(self, packet: Packet) -> None:
        """Refuse each command to this camera; another one may do what is for all."""
        message = packet.message
        if packet.sent or not packet.trusted:
            return
        if message.get_type() == "HEARTBEAT":
            now_ns = self._clock.monotonic_ns()
            self._identity.heard(message, packet.link, now_ns)
            self._stations.heard(message, now_ns)
        elif message.get_type() in ("COMMAND_LONG", "COMMAND_INT") and self._is_for_us(message):
            source = message.get_srcSystem(), message.get_srcComponent()
            refused = mavlink.MAVLink_command_ack_message(message.command, mavlink.MAV_RESULT_FAILED, 0, 0, *source)
            self._links.send(refused, packet.link)

    def _is_for_us(self, message: MavlinkMessage) -> bool:
        systems = self._links.system_id, self._identity.system_id
        return message.target_component != 0 and is_for(message, systems, self._links.component_id)

    def tick(self) -> None:
        """Send what is due: the heartbeat, and why there is no photograph."""
        now_ns = self._clock.monotonic_ns()
        if not self._identity.decide(now_ns):
            return
        self._links.system_id = self._identity.system_id
        if now_ns >= self._heartbeat_due_ns:
            self._heartbeat_due_ns = now_ns + _HEARTBEAT_NS
            kind, none = mavlink.MAV_TYPE_CAMERA, mavlink.MAV_AUTOPILOT_INVALID
            self._links.send(mavlink.MAVLink_heartbeat_message(kind, none, 0, 0, mavlink.MAV_STATE_CRITICAL, 3))
        if self._stations.new_one(now_ns) or now_ns >= self._said_due_ns:
            self._said_due_ns = now_ns + _SAID_NS
            text = f"NO PHOTOGRAPHS: {self._reason}"
            for line in self._lines.messages(text, mavlink.MAV_SEVERITY_CRITICAL, now_ns, news=True):
                self._links.send(line)
