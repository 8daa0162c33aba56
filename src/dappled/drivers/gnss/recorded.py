"""A receiver's stream in the telemetry log: MAVLink packets that no link carries.

Bytes stand in TUNNEL (385), up to 128 in each, in order; a time mark also as CAMERA_TRIGGER (112) in UTC, its `seq` the
mark's count. Both come from component 220, the GNSS receiver, of the camera's system.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator

from dappled.clock import Clock
from dappled.drivers.gnss.ubx import TimeMark
from dappled.drivers.mavlink import MavlinkMessage, Packet, PacketLog, PacketSender, mavlink, pack

COMPONENT = mavlink.MAV_COMP_ID_GPS
PAYLOAD_TYPE = 33_010  # above 32767: not given out by MAVLink
CHUNK = 128
_TUNNEL = mavlink.MAVLINK_MSG_ID_TUNNEL.to_bytes(3, "little")
_HEAD, _TAIL = 10, 2
_FIELDS = 5  # bytes of TUNNEL before its payload: type, target, length


def bytes_message(data: bytes) -> MavlinkMessage:
    """Up to 128 bytes of the stream as a message."""
    return mavlink.MAVLink_tunnel_message(0, 0, PAYLOAD_TYPE, len(data), [*data, *bytes(CHUNK - len(data))])


def mark_message(mark: TimeMark) -> MavlinkMessage:
    """A time mark as a message."""
    return mavlink.MAVLink_camera_trigger_message(mark.utc_ns // 1000, mark.count)


class TelemetryNotebook:
    """Logs such messages among the packets of the links, in the order of their numbers."""

    def __init__(self, sender: PacketSender, packet_log: PacketLog, clock: Clock) -> None:
        self._sender, self._log, self._clock = sender, packet_log, clock
        self._packer = mavlink.MAVLink(None)

    def note(self, message: MavlinkMessage) -> None:
        """Log one. Raises FlightError where the disk refuses."""
        with self._sender.order:
            self._packer.srcSystem, self._packer.srcComponent = self._sender.system_id, COMPONENT
            raw, stamp_us = pack(message, self._packer, version_1=False), self._clock.utc_ns() // 1000
            number = self._log.log_packet(stamp_us, raw)
            self._log.on_packet(Packet(number, stamp_us, -1, message, raw, sent=True))


def stream(packets: Iterable[bytes]) -> Iterator[bytes]:
    """The receiver's bytes again, from the packets of a telemetry log. MAVLink 2 cuts zeros off a payload's end."""
    for packet in packets:
        if packet[:1] != b"\xfd" or packet[7:10] != _TUNNEL or packet[6] != COMPONENT:
            continue
        payload = packet[_HEAD : _HEAD + packet[1]].ljust(_FIELDS + CHUNK, b"\0")
        if int.from_bytes(payload[:2], "little") == PAYLOAD_TYPE:
            yield payload[_FIELDS : _FIELDS + payload[4]]
