"""The bytes under a MAVLink link: UDP, TCP and serial, never blocking, made again after they were lost."""

from __future__ import annotations

import errno
import socket
from collections.abc import Sequence
from typing import Protocol

from dappled.drivers.mavlink.address import Address, LinkError
from dappled.drivers.mavlink.stream import Listener, over_serial, over_tcp
from dappled.drivers.mavlink.udp import UdpIn, UdpOut


class Channel(Protocol):
    """One open way in and out. One thread reads; `write` is called under the link's lock."""

    datagrams: bool  # what `read` gives holds whole packets

    def descriptors(self) -> Sequence[int]:
        """What to wait on: any of them may have something to read."""

    def read(self) -> bytes | None:
        """What has come; b"" for nothing yet. None: the other side is gone. Raises OSError likewise."""

    def write(self, data: bytes) -> bool:
        """Send without blocking. False: not sent (nobody there, or the way is full). Raises OSError when broken."""

    def wants_write(self) -> bool:
        """Whether bytes wait until the descriptor can take them."""

    def flush(self) -> None:
        """Send what waits. Raises OSError when broken."""

    def port(self) -> int:
        """The local port, 0 where there is none."""

    def close(self) -> None:
        """Let go."""


def open_channel(address: Address) -> Channel:
    """Open the way that `address` names. Raises LinkError, in words."""
    try:
        if address.kind == "serial":
            return over_serial(address)
        if address.kind == "tcp":
            return over_tcp(socket.create_connection((address.host, address.port), timeout=1.0))
        if address.kind == "tcpin":
            return Listener(_bound(address, socket.SOCK_STREAM))
        if address.kind == "udpin":
            return UdpIn(_bound(address, socket.SOCK_DGRAM))
        return UdpOut(address)
    except OSError as error:
        raise LinkError(_sentence(address, error)) from error


def _sentence(address: Address, error: OSError) -> str:
    url = address.url
    if isinstance(error, socket.gaierror):
        return f"MAVLink link {url}: no machine is called {address.host!r}; write an address such as 127.0.0.1"
    if error.errno == errno.EADDRINUSE:
        return (
            f"MAVLink link {url}: port {address.port} is in use; end the program that listens there or change the port"
        )
    if error.errno == errno.EADDRNOTAVAIL:
        return f"MAVLink link {url}: {address.host} is no address of this machine; listen on 0.0.0.0 for all of its own"
    if error.errno == errno.ENOENT:
        return f"MAVLink link {url}: there is no device {address.host}; plug it in or correct mavlink.url"
    if error.errno == errno.EACCES:
        return f"MAVLink link {url}: no permission to open {address.host}; add the user to the group of the device"
    return f"MAVLink link {url}: {error.strerror or error}; correct mavlink.url or mend the connection"


def _bound(address: Address, kind: socket.SocketKind) -> socket.socket:
    found = socket.getaddrinfo(address.host, address.port, socket.AF_INET, kind)
    sock = socket.socket(socket.AF_INET, kind)
    try:
        if kind == socket.SOCK_STREAM:
            sock.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
        sock.setblocking(False)
        sock.bind(found[0][4])
        if kind == socket.SOCK_STREAM:
            sock.listen(1)
    except OSError:
        sock.close()
        raise
    return sock
