"""The same packet, come over two links or delivered twice by the network."""

from __future__ import annotations

from dappled.drivers.mavlink import Packet, mavlink

COPY_NS = 500_000_000
_Key = tuple[int, int, int, int, bytes]


class Copies:
    """Remembers packets for half a second (at most 256), by sender, sequence number, message and payload: what a
    link adds (version, signature) does not count."""

    def __init__(self) -> None:
        self._seen: dict[_Key, int] = {}

    def is_copy(self, packet: Packet, now_ns: int) -> bool:
        """Whether this packet came before; remembers it. Times are monotonic."""
        key = _key(packet)
        self._seen = {each: at_ns for each, at_ns in self._seen.items() if now_ns - at_ns <= COPY_NS}
        copy = key in self._seen
        self._seen[key] = now_ns
        if len(self._seen) > 256:
            self._seen.pop(next(iter(self._seen)))
        return copy


def _key(packet: Packet) -> _Key:
    message, raw = packet.message, packet.raw
    start = 10 if raw[0] == mavlink.PROTOCOL_MARKER_V2 else 6
    payload = raw[start : start + raw[1]].rstrip(b"\0")  # version 2 leaves trailing zeros out
    return message.get_srcSystem(), message.get_srcComponent(), message.get_seq(), message.get_msgId(), payload
