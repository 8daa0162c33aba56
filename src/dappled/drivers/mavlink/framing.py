"""Bytes to MAVLink packets and back: framing of versions 1 and 2, checksums, finding the way after garbage."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from typing import Any

from pymavlink.dialects.v20 import ardupilotmega as mavlink

# The messages themselves; everything that speaks MAVLink takes them from here. Version 2 on the wire, ArduPilot's
# dialect, which contains `common`.
__all__ = ["Decoder", "Framed", "Framer", "Message", "mavlink", "pack"]

Message = Any  # pymavlink's message classes carry no common typed base

_MAGIC_1, _MAGIC_2 = 0xFE, 0xFD
_SIGNED = 0x01
_LONGEST = 10 + 255 + 2 + 13
_MAX_ID_1 = 255


@dataclass(frozen=True, slots=True)
class Framed:
    """One packet: its bytes as they came, and what they say."""

    raw: bytes
    message: Message

    @property
    def version(self) -> int:
        """MAVLink 1 or 2."""
        return 1 if self.raw[0] == _MAGIC_1 else 2


class Decoder:
    """Whole packets to messages, checksums verified. Keeps what later verifies signatures: one for each stream."""

    def __init__(self) -> None:
        self._parser = mavlink.MAVLink(None)

    def __call__(self, raw: bytes) -> Message | None:
        """The message, or None where the bytes are not one sound packet. Unknown ids give `MAVLink_unknown`."""
        try:
            return self._parser.decode(bytearray(raw))
        except (mavlink.MAVError, IndexError):  # IndexError: no bytes at all
            return None


class Framer:
    """Cuts a stream of bytes into packets. Holds less than one packet (280 bytes) between calls.

    `bad` counts places where bytes did not make a packet: garbage, wrong checksum, unknown flags. A packet of an
    unknown message has no checksum that could be verified; in a stream it counts only if another packet, or nothing,
    follows it.
    """

    def __init__(self) -> None:
        self.bad = 0
        self._rest = b""
        self._lost = False
        self._decode = Decoder()

    def feed(self, data: bytes) -> Iterator[Framed]:
        """Packets completed by more bytes of a stream."""
        buffer = self._rest + data
        position, packets = self._cut(buffer, whole=False)
        self._rest = buffer[position:]
        yield from packets

    def datagram(self, data: bytes) -> Iterator[Framed]:
        """Packets of one datagram, which holds whole packets only."""
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
        message = self._decode(raw)
        if message is None:
            return None
        if isinstance(message, mavlink.MAVLink_unknown) and not whole:
            follows = end == len(buffer) or buffer[end] in (_MAGIC_1, _MAGIC_2)
            if not follows:
                return None
        return Framed(raw, message)


def pack(message: Message, packer: Any, *, version_1: bool) -> bytes:
    """A message as bytes with the packer's ids and next sequence number; version 1 only where the id fits in it."""
    version_1 = version_1 and message.get_msgId() <= _MAX_ID_1
    raw: bytes = message.pack(packer, force_mavlink1=version_1)
    packer.seq = (packer.seq + 1) % 256
    return raw


def _length(buffer: bytes, position: int) -> int | None:
    """Bytes of the packet that begins here; None when its header isn't there yet, 0 when no packet begins here."""
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
        return buffer[position + 1] + 12 + (13 if flags & _SIGNED else 0)
    return 0


def _next_magic(buffer: bytes, start: int) -> int:
    places = [p for p in (buffer.find(_MAGIC_1, start), buffer.find(_MAGIC_2, start)) if p >= 0]
    return min(places, default=len(buffer))
