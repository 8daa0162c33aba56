"""The same packet, come over two links or delivered twice by the network."""

from __future__ import annotations

from dappled.drivers.mavlink.links import Packet, mavlink

COPY_NS = 500_000_000
OTHER_LINK_NS = 2_500_000_000  # a radio may be seconds behind a cable
_REMEMBERED = 1024
_Key = tuple[int, int, int, int, bytes]


class Copies:
    """Remembers packets (at most 1024) by sender, sequence number, message and payload: what a link adds (version,
    signature) does not count. A copy comes within 0.5 s over the same link, within 2.5 s over another one: one byte
    of sequence number soon comes round again on a busy link."""

    def __init__(self) -> None:
        self._seen: dict[_Key, dict[int, int]] = {}  # when it came last over each link; the oldest packet first

    def is_copy(self, packet: Packet, now_ns: int) -> bool:
        """Whether this packet came before; remembers it. Times are monotonic."""
        while self._seen:
            oldest = next(iter(self._seen))
            if now_ns - max(self._seen[oldest].values()) <= OTHER_LINK_NS and len(self._seen) < _REMEMBERED:
                break
            del self._seen[oldest]
        key = _key(packet)
        came = self._seen.pop(key, {})
        copy = any(
            now_ns - at_ns <= (COPY_NS if link == packet.link else OTHER_LINK_NS) for link, at_ns in came.items()
        )
        self._seen[key] = came | {packet.link: now_ns}
        return copy


def _key(packet: Packet) -> _Key:
    message, raw = packet.message, packet.raw
    start = 10 if raw[0] == mavlink.PROTOCOL_MARKER_V2 else 6
    payload = raw[start : start + raw[1]].rstrip(b"\0")  # version 2 leaves trailing zeros out
    return message.get_srcSystem(), message.get_srcComponent(), message.get_seq(), message.get_msgId(), payload
