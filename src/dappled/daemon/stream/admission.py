"""Which TCP connections of viewers are kept: limits for each address and for all, and when a handshake is complete."""

from __future__ import annotations

import ipaddress
from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass

SIGNATURE_BYTES = 10
_GREETING_BYTES = 64
_LONG, _COMMAND = 0x02, 0x04
_READY = b"\x05READY"
_HANDSHAKE_BYTES = 4096  # libzmq's own is below 600


@dataclass(frozen=True, slots=True)
class ConnectionLimits:
    """How many connections are kept: `opening` before the end of the handshake, for `handshake_s` at most, and `open`
    after it. A viewer that also asks for slices needs two. One whose peer reads nothing for `unread_s` is closed, and
    one that sends more than `said_bytes`, and `said_b_s` for each second since: ZeroMQ keeps the parts of a message
    until its last has come, and all subscriptions."""

    opening: int = 48
    opening_per_address: int = 24
    open: int = 64
    open_per_address: int = 32
    handshake_s: float = 10.0
    unread_s: float = 30.0
    said_bytes: int = 1 << 20
    said_b_s: float = 4000.0


@dataclass(frozen=True, slots=True)
class OpeningConnection:
    """A connection before the end of its handshake; `speaks` once a ZeroMQ signature has come. Lower numbers are
    older."""

    number: int
    network: str
    speaks: bool


def surplus(opening: Sequence[OpeningConnection], limits: ConnectionLimits) -> OpeningConnection | None:
    """The connection to close where there are too many: of the address with most of them, a silent one first, then the
    oldest. So strangers displace strangers, and one address can't keep another out. None where there is room."""
    each = Counter(one.network for one in opening)
    if not each:
        return None
    network, count = each.most_common(1)[0]
    if count <= limits.opening_per_address and len(opening) <= limits.opening:
        return None
    return min((one for one in opening if one.network == network), key=lambda one: (one.speaks, one.number))


def network_of(address: str) -> str:
    """What the limits of one address hold for: the address; for IPv6 the /64 network, because one machine can have many
    addresses there."""
    try:
        parsed = ipaddress.ip_address(address.partition("%")[0])
    except ValueError:
        return address
    if isinstance(parsed, ipaddress.IPv4Address):
        return address
    if parsed.ipv4_mapped is not None:
        return str(parsed.ipv4_mapped)
    return str(ipaddress.ip_network((int(parsed) >> 64 << 64, 64)))


def is_zeromq(begin: bytes) -> bool:
    """Whether a connection that begins with these 10 bytes speaks ZMTP 2 or later (RFC 15, RFC 37)."""
    return len(begin) >= SIGNATURE_BYTES and begin[0] == 0xFF and bool(begin[9] & 1)


class Handshake:
    """Follows what the daemon sends on a connection, until its READY: ZeroMQ sends that only to a peer that it has let
    in, with CURVE after the key was found on the list (RFC 23, RFC 26)."""

    def __init__(self) -> None:
        self.complete = False
        self._seen = bytearray()
        self._next = _GREETING_BYTES  # where the next frame begins

    def feed(self, data: bytes | memoryview) -> None:
        """Take the next bytes."""
        if self.complete or self._next > _HANDSHAKE_BYTES:
            return
        self._seen += data[: _HANDSHAKE_BYTES - len(self._seen)]
        while not self.complete and len(self._seen) > self._next + 1:
            flags = self._seen[self._next]
            body = self._next + (9 if flags & _LONG else 2)
            size = int.from_bytes(self._seen[self._next + 1 : body], "big")
            if len(self._seen) < body + min(size, len(_READY)):
                return
            self.complete = bool(flags & _COMMAND) and self._seen[body : body + len(_READY)] == _READY
            self._next = body + size
        if self.complete:
            self._seen.clear()
