"""UDP under a MAVLink link: one end that listens, one that speaks first."""

from __future__ import annotations

import errno
import socket
import time
from collections.abc import Sequence

from dappled.drivers.mavlink.address import Address

_CHUNK = 65536
_PEERS_LIMIT = 16
_PEER_SILENT_S = 60.0
_NOTHING = (errno.EAGAIN, errno.EWOULDBLOCK, errno.ECONNREFUSED)  # the last: nobody listens there yet


class _Udp:
    """What both ends share: a socket whose datagrams hold whole packets, and that never has to wait to write."""

    datagrams = True

    def __init__(self, sock: socket.socket) -> None:
        sock.setblocking(False)
        self._sock = sock

    def descriptors(self) -> Sequence[int]:
        return (self._sock.fileno(),)

    def read(self) -> bytes | None:
        try:
            data, peer = self._sock.recvfrom(_CHUNK)
        except OSError as error:
            if error.errno in _NOTHING:
                return b""
            raise
        self._heard(peer)
        return data

    def wants_write(self) -> bool:
        return False

    def flush(self) -> None:
        return

    def port(self) -> int:
        return int(self._sock.getsockname()[1])

    def close(self) -> None:
        self._sock.close()

    def _heard(self, peer: tuple[str, int]) -> None:
        return

    def _send(self, data: bytes, peer: tuple[str, int]) -> bool:
        try:
            self._sock.sendto(data, peer)
        except OSError:  # nobody listens, or the network is away: the next packet tries again
            return False
        return True


class UdpIn(_Udp):
    """Listens; answers everybody who was heard in the last minute (at most 16)."""

    def __init__(self, sock: socket.socket) -> None:
        super().__init__(sock)
        self._peers: dict[tuple[str, int], float] = {}

    def write(self, data: bytes) -> bool:
        silent = time.monotonic() - _PEER_SILENT_S
        for peer, heard in list(self._peers.items()):
            if heard < silent and len(self._peers) > 1:
                self._peers.pop(peer, None)
        sent = [self._send(data, peer) for peer in list(self._peers)]
        return any(sent)

    def _heard(self, peer: tuple[str, int]) -> None:
        self._peers.pop(peer, None)
        self._peers[peer] = time.monotonic()
        if len(self._peers) > _PEERS_LIMIT:
            self._peers.pop(next(iter(self._peers)))


class UdpOut(_Udp):
    """Speaks first, to one address."""

    def __init__(self, address: Address) -> None:
        """Raises OSError."""
        found = socket.getaddrinfo(address.host, address.port, socket.AF_INET, socket.SOCK_DGRAM)
        self._to = (str(found[0][4][0]), int(found[0][4][1]))
        broadcast = address.kind == "udpbcast"
        super().__init__(socket.socket(socket.AF_INET, socket.SOCK_DGRAM))
        if broadcast:
            self._sock.setsockopt(socket.SOL_SOCKET, socket.SO_BROADCAST, 1)
        near = self._to[0].startswith("127.") and not broadcast
        self._sock.bind(("127.0.0.1" if near else "0.0.0.0", 0))  # noqa: S104  # a client's own port: answers come back to it

    def write(self, data: bytes) -> bool:
        return self._send(data, self._to)
