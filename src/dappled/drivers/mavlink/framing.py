"""Cut bytes into MAVLink packets, parse them, and pack messages."""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from dataclasses import dataclass
from typing import Any

from pymavlink.dialects.v20 import ardupilotmega

mavlink = ardupilotmega
"""The message classes, for the whole project: version 2, and the dialect of ArduPilot, which contains `common`."""

MavlinkMessage = Any  # pymavlink's message classes have no common typed base
SIGNATURE_BYTES = 13
_MAGIC_1, _MAGIC_2 = 0xFE, 0xFD
_SIGNED = 0x01
_MAX_ID_1 = 255


def is_for(message: MavlinkMessage, systems: Iterable[int], component: int) -> bool:
    """Whether a message is addressed to this component, or all, of one of these systems, or all."""
    return message.target_system in (0, *systems) and message.target_component in (0, component)


class PacketParser:
    """Parse whole packets and verify their checksums, not their signatures. One for each stream: it keeps state."""

    def __init__(self) -> None:
        self._parser = mavlink.MAVLink(None)

    def __call__(self, raw: bytes) -> MavlinkMessage | None:
        """Return the message, or None where the bytes are not one sound packet. An unknown id is `MAVLink_unknown`."""
        try:
            return self._parser.decode(bytearray(raw))
        except (mavlink.MAVError, IndexError):  # IndexError: no bytes at all
            return None


@dataclass(frozen=True, slots=True)
class Framed:
    """The bytes of one packet as they came, and its message."""

    raw: bytes
    message: MavlinkMessage

    @property
    def version(self) -> int:
        """MAVLink 1 or 2."""
        return 1 if self.raw[0] == _MAGIC_1 else 2

    def numbered(self) -> tuple[int, bytes]:
        """Return the sender's number of the packet, and its payload: no link changes them. Version 2 leaves trailing
        zeros out."""
        start = 6 if self.version == 1 else 10
        return self.message.get_seq(), self.raw[start : start + self.raw[1]].rstrip(b"\0")


class Framer:
    """Cut bytes into packets. Keeps less than one packet (280 bytes) between calls.

    `bad` counts the places where bytes did not make a packet: garbage, wrong checksum, unknown flags. The checksum of a
    packet with an unknown message can't be verified; in a stream it counts only if another packet, or nothing, follows.
    """

    def __init__(self) -> None:
        self.bad = 0
        self._rest = b""
        self._lost = False
        self._parse = PacketParser()

    def feed(self, data: bytes) -> Iterator[Framed]:
        """Yield the packets that more bytes of a stream complete."""
        buffer = self._rest + data
        position, packets = self._cut(buffer, whole=False)
        self._rest = buffer[position:]
        yield from packets

    def datagram(self, data: bytes) -> Iterator[Framed]:
        """Yield the packets of one datagram, which holds whole packets only."""
        _, packets = self._cut(data, whole=True)
        self._lost = False
        yield from packets

    def _cut(self, buffer: bytes, *, whole: bool) -> tuple[int, list[Framed]]:
        packets: list[Framed] = []
        position = 0
        while position < len(buffer):
            length = _length(buffer, position)
            if length is None and not whole:
                break
            if length is not None and length > 0 and position + length > len(buffer) and not whole:
                break
            framed = None
            if length is not None and 0 < length <= len(buffer) - position:
                framed = self._packet(buffer, position, length, whole=whole)
            if framed is None:
                if not self._lost:
                    self.bad += 1
                self._lost = True
                position = _next_magic(buffer, position + 1)
                continue
            self._lost = False
            packets.append(framed)
            position += len(framed.raw)
        return position, packets

    def _packet(self, buffer: bytes, position: int, length: int, *, whole: bool) -> Framed | None:
        end = position + length
        raw = buffer[position:end]
        message = self._parse(raw)
        if message is None:
            return None
        if isinstance(message, mavlink.MAVLink_unknown) and not whole:
            follows = end == len(buffer) or buffer[end] in (_MAGIC_1, _MAGIC_2)
            if not follows:
                return None
        return Framed(raw, message)


def _length(buffer: bytes, position: int) -> int | None:
    """The length of the packet that begins here; None when its header is incomplete, 0 when no packet begins here."""
    magic = buffer[position]
    have = len(buffer) - position
    if magic == _MAGIC_1:
        return None if have < 2 else buffer[position + 1] + 8
    if magic == _MAGIC_2:
        if have < 3:
            return None
        flags = buffer[position + 2]
        if flags & ~_SIGNED:
            return 0
        return buffer[position + 1] + 12 + (SIGNATURE_BYTES if flags & _SIGNED else 0)
    return 0


def _next_magic(buffer: bytes, start: int) -> int:
    places = [p for p in (buffer.find(_MAGIC_1, start), buffer.find(_MAGIC_2, start)) if p >= 0]
    return min(places, default=len(buffer))


def pack(message: MavlinkMessage, packer: Any, *, version_1: bool) -> bytes:
    """Pack a message with the packer's ids and next sequence number; in version 1 only where its id fits."""
    version_1 = version_1 and message.get_msgId() <= _MAX_ID_1
    raw: bytes = message.pack(packer, force_mavlink1=version_1)
    packer.seq = (packer.seq + 1) % 256
    return raw


def is_signed(raw: bytes) -> bool:
    """Whether a packet carries a signature, right or wrong."""
    return raw[0] == _MAGIC_2 and bool(raw[2] & _SIGNED)


def message_of(raw: bytes) -> int:
    """The id of a packet's message, by its header."""
    return int.from_bytes(raw[7:10], "little") if raw[0] == _MAGIC_2 else raw[5]


def packet_length(data: bytes, at: int) -> int | None:
    """The length of the whole packet that begins at `at`, by its header; None where none begins or it is cut off."""
    length = _length(data, at)
    return length if length and at + length <= len(data) else None
