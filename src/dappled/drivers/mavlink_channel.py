"""The bytes under a MAVLink link: UDP, TCP and serial, never blocking, made again after they were lost."""

from __future__ import annotations

import errno
import os
import socket
import termios
import time
from typing import Protocol

from dappled.drivers.mavlink_address import Address, LinkError

_CHUNK = 65536
_OUTBOX_LIMIT = 65536
_PEERS_LIMIT = 16
_PEER_SILENT_S = 60.0
_BUSY = (errno.EAGAIN, errno.EWOULDBLOCK)


class Channel(Protocol):
    """One open way in and out. One thread reads; `write` is called under the link's lock."""

    datagrams: bool  # what `read` gives holds whole packets

    def fileno(self) -> int:
        """The descriptor to wait on."""

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
            return _Serial(address)
        if address.kind == "tcp":
            return _Stream(_connect(address))
        if address.kind == "tcpin":
            return _Listener(_bound(address, socket.SOCK_STREAM))
        if address.kind == "udpin":
            return _UdpIn(_bound(address, socket.SOCK_DGRAM))
        return _UdpOut(address)
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


def _connect(address: Address) -> socket.socket:
    sock = socket.create_connection((address.host, address.port), timeout=1.0)
    sock.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
    sock.setblocking(False)
    return sock


class _UdpIn:
    """Listens; answers everybody who was heard in the last minute (at most 16)."""

    datagrams = True

    def __init__(self, sock: socket.socket) -> None:
        self._sock = sock
        self._peers: dict[tuple[str, int], float] = {}

    def fileno(self) -> int:
        return self._sock.fileno()

    def read(self) -> bytes | None:
        try:
            data, peer = self._sock.recvfrom(_CHUNK)
        except OSError as error:
            if error.errno in (*_BUSY, errno.ECONNREFUSED):
                return b""
            raise
        self._peers.pop(peer, None)
        self._peers[peer] = time.monotonic()
        if len(self._peers) > _PEERS_LIMIT:
            self._peers.pop(next(iter(self._peers)))
        return data

    def write(self, data: bytes) -> bool:
        now = time.monotonic()
        sent = False
        for peer, heard in list(self._peers.items()):
            if now - heard > _PEER_SILENT_S and len(self._peers) > 1:
                self._peers.pop(peer, None)
                continue
            try:
                self._sock.sendto(data, peer)
                sent = True
            except OSError:  # that peer can't be reached now; the others can
                continue
        return sent

    def wants_write(self) -> bool:
        return False

    def flush(self) -> None:
        return

    def port(self) -> int:
        return int(self._sock.getsockname()[1])

    def close(self) -> None:
        self._sock.close()


class _UdpOut:
    """Speaks first, to one address."""

    datagrams = True

    def __init__(self, address: Address) -> None:
        found = socket.getaddrinfo(address.host, address.port, socket.AF_INET, socket.SOCK_DGRAM)
        self._to = found[0][4]
        self._sock = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
        if address.kind == "udpbcast":
            self._sock.setsockopt(socket.SOL_SOCKET, socket.SO_BROADCAST, 1)
        self._sock.setblocking(False)
        self._sock.bind(("0.0.0.0" if address.kind == "udpbcast" or not _loopback(self._to) else "127.0.0.1", 0))  # noqa: S104 (a client's own port: answers come back to it)

    def fileno(self) -> int:
        return self._sock.fileno()

    def read(self) -> bytes | None:
        try:
            return self._sock.recv(_CHUNK)
        except OSError as error:
            if error.errno in (*_BUSY, errno.ECONNREFUSED):
                return b""
            raise

    def write(self, data: bytes) -> bool:
        try:
            self._sock.sendto(data, self._to)
        except OSError:  # nobody listens yet, or the network is away: UDP tries again with the next packet
            return False
        return True

    def wants_write(self) -> bool:
        return False

    def flush(self) -> None:
        return

    def port(self) -> int:
        return int(self._sock.getsockname()[1])

    def close(self) -> None:
        self._sock.close()


class _Outbox:
    """Bytes that a stream could not take yet: whole packets, at most 64 KiB."""

    def __init__(self) -> None:
        self._waiting = bytearray()

    def __bool__(self) -> bool:
        return bool(self._waiting)

    def put(self, fd: int, data: bytes) -> bool:
        if len(self._waiting) + len(data) > _OUTBOX_LIMIT:
            return False
        self._waiting += data
        self.flush(fd)
        return True

    def flush(self, fd: int) -> None:
        while self._waiting:
            try:
                count = os.write(fd, self._waiting)
            except BlockingIOError:
                return
            del self._waiting[:count]


class _Stream:
    """A connected TCP socket."""

    datagrams = False

    def __init__(self, sock: socket.socket) -> None:
        self._sock = sock
        self._outbox = _Outbox()

    def fileno(self) -> int:
        return self._sock.fileno()

    def read(self) -> bytes | None:
        try:
            return self._sock.recv(_CHUNK) or None
        except BlockingIOError:
            return b""

    def write(self, data: bytes) -> bool:
        return self._outbox.put(self._sock.fileno(), data)

    def wants_write(self) -> bool:
        return bool(self._outbox)

    def flush(self) -> None:
        self._outbox.flush(self._sock.fileno())

    def port(self) -> int:
        return int(self._sock.getsockname()[1])

    def close(self) -> None:
        self._sock.close()


class _Listener:
    """A TCP server for one client at a time; a new client takes the place of the old."""

    datagrams = False

    def __init__(self, sock: socket.socket) -> None:
        self._sock = sock
        self._client: _Stream | None = None

    def fileno(self) -> int:
        return self._client.fileno() if self._client else self._sock.fileno()

    def read(self) -> bytes | None:
        if self._client is None:
            try:
                client, _ = self._sock.accept()
            except BlockingIOError:
                return b""
            client.setblocking(False)
            self._client = _Stream(client)
            return b""
        try:
            data = self._client.read()
        except OSError:
            data = None
        if data is None:
            self._client.close()
            self._client = None
            return b""
        return data

    def write(self, data: bytes) -> bool:
        return self._client.write(data) if self._client else False

    def wants_write(self) -> bool:
        return self._client is not None and self._client.wants_write()

    def flush(self) -> None:
        if self._client:
            self._client.flush()

    def port(self) -> int:
        return int(self._sock.getsockname()[1])

    def close(self) -> None:
        if self._client:
            self._client.close()
        self._sock.close()


class _Serial:
    """A serial device in raw mode, 8N1, without flow control."""

    datagrams = False

    def __init__(self, address: Address) -> None:
        speed = getattr(termios, f"B{address.port}", None)
        if speed is None:
            raise LinkError(
                f"MAVLink link {address.url}: no serial port runs at {address.port} baud; write 57600, 115200 or 921600"
            )
        self._outbox = _Outbox()
        self._fd = os.open(address.host, os.O_RDWR | os.O_NOCTTY | os.O_NONBLOCK | os.O_CLOEXEC)
        try:
            _make_raw(self._fd, speed)
        except termios.error as error:
            os.close(self._fd)
            raise LinkError(
                f"MAVLink link {address.url}: {address.host} is not a serial device; correct mavlink.url"
            ) from error

    def fileno(self) -> int:
        return self._fd

    def read(self) -> bytes | None:
        try:
            return os.read(self._fd, _CHUNK) or None
        except BlockingIOError:
            return b""

    def write(self, data: bytes) -> bool:
        return self._outbox.put(self._fd, data)

    def wants_write(self) -> bool:
        return bool(self._outbox)

    def flush(self) -> None:
        self._outbox.flush(self._fd)

    def port(self) -> int:
        return 0

    def close(self) -> None:
        os.close(self._fd)


def _make_raw(fd: int, speed: int) -> None:
    attributes = termios.tcgetattr(fd)
    attributes[6][termios.VMIN], attributes[6][termios.VTIME] = 1, 0
    attributes[:6] = [0, 0, termios.CS8 | termios.CREAD | termios.CLOCAL, 0, speed, speed]
    termios.tcsetattr(fd, termios.TCSANOW, attributes)


def _loopback(address: tuple[object, ...]) -> bool:
    return str(address[0]).startswith("127.")
