"""Split a u-blox receiver's stream into UBX messages, and read the time marks in it.

The form is that of u-blox' interface descriptions: B5 62, class, id, length (little-endian), payload, and a checksum of
two bytes (RFC 1145) over all of it but the first two.
"""

from __future__ import annotations

import struct
from collections.abc import Iterator
from dataclasses import dataclass
from datetime import timedelta
from typing import Literal

from dappled.drivers.gps_time import GPS_EPOCH, gps_to_utc

Edge = Literal["falling", "rising"]
TIM_TM2, RXM_RAWX = (0x0D, 0x03), (0x02, 0x15)
_SYNC = b"\xb5\x62"
_AROUND = 8
_MOST_PAYLOAD = 8192  # RXM-RAWX of 184 satellites has 5.9 kB
_TIME_MARK = struct.Struct("<BBHHHIIIII")
_NEW: dict[Edge, int] = {"falling": 1 << 2, "rising": 1 << 7}
_VALID, _BASE, _BASE_SHIFT = 1 << 6, 0b11, 3
_GNSS_TIME, _UTC_TIME = 1, 2
_WEEK_MS = 604_800_000


@dataclass(frozen=True, slots=True)
class UbxMessage:
    """One message: its class and id, and what it holds."""

    kind: tuple[int, int]
    payload: bytes


@dataclass(frozen=True, slots=True)
class TimeMark:
    """An edge at the receiver's EXTINT, in UTC with the receiver's own accuracy (ns). `count` counts rising edges,
    modulo 65536."""

    count: int
    utc_ns: int
    accuracy_ns: int


class UbxStream:
    """Messages out of bytes as they arrive. NMEA and RTCM between them is passed over; `bad` counts wrong checksums."""

    def __init__(self) -> None:
        self._left = b""
        self.bad = 0

    def feed(self, data: bytes) -> Iterator[UbxMessage]:
        """The messages that are whole with these bytes."""
        buffer, done = self._left + data, 0
        try:
            while (at := buffer.find(_SYNC, done)) >= 0:
                done = at
                if len(buffer) - at < _AROUND:
                    break
                length = int.from_bytes(buffer[at + 4 : at + 6], "little")
                end = at + _AROUND + length
                if length > _MOST_PAYLOAD:
                    done = at + 1
                    continue
                if end > len(buffer):
                    break
                if checksum(buffer[at + 2 : end - 2]) == buffer[end - 2 : end]:
                    done = end
                    yield UbxMessage((buffer[at + 2], buffer[at + 3]), buffer[at + 6 : end - 2])
                else:
                    self.bad += 1
                    done = at + 1
            if at < 0:
                done = max(done, len(buffer) - buffer.endswith(_SYNC[:1]))
        finally:
            self._left = buffer[done:]


def checksum(data: bytes) -> bytes:
    """UBX' checksum of class, id, length and payload (RFC 1145, Fletcher).

    >>> checksum(bytes([0x06, 0x01, 0x02, 0x00, 0x0D, 0x03])).hex()
    '194e'
    """
    first = second = 0
    for byte in data:
        first = (first + byte) & 0xFF
        second = (second + first) & 0xFF
    return bytes((first, second))


def time_mark(message: UbxMessage, edge: Edge, rollovers: int = 0) -> TimeMark | None:
    """The mark of a UBX-TIM-TM2; None for another message, one without a new edge of this kind, and one whose time is
    not valid or only the receiver's own. `rollovers`: how often the receiver's count of weeks began anew unseen.

    Payload: channel, flags, count of rising edges; week of the rising and of the falling edge; time of week in ms and
    its part in ns of the rising edge, then of the falling one; accuracy in ns.
    """
    if message.kind != TIM_TM2 or len(message.payload) != _TIME_MARK.size:
        return None
    _, flags, count, week_r, week_f, ms_r, ns_r, ms_f, ns_f, accuracy_ns = _TIME_MARK.unpack(message.payload)
    week, ms, ns = (week_f, ms_f, ns_f) if edge == "falling" else (week_r, ms_r, ns_r)
    base = flags >> _BASE_SHIFT & _BASE
    if not flags & _NEW[edge] or not flags & _VALID or base not in (_GNSS_TIME, _UTC_TIME):
        return None
    if ms >= _WEEK_MS or ns >= 10**6:
        return None
    at = GPS_EPOCH + timedelta(weeks=week + 1024 * rollovers, seconds=ms // 1000)
    at = gps_to_utc(at) if base == _GNSS_TIME else at
    seconds = (at - GPS_EPOCH) // timedelta(seconds=1) + round(GPS_EPOCH.timestamp())
    return TimeMark(count, seconds * 10**9 + ms % 1000 * 10**6 + ns, accuracy_ns)
