"""Streams under a MAVLink link: TCP, as client or server, and serial devices."""

from __future__ import annotations

import errno
import os
import socket
import termios
import threading
from collections.abc import Callable, Sequence

from dappled.drivers.mavlink.address import Address, LinkError

_CHUNK = 65536
_OUTBOX_LIMIT = 65536
_GONE_S = 5
_NOBODY = (errno.EAGAIN, errno.EWOULDBLOCK, errno.ECONNABORTED, errno.EPROTO, errno.ENETDOWN, errno.ENETUNREACH,
           errno.EHOSTDOWN, errno.EHOSTUNREACH, errno.ENONET)  # fmt: skip
"""Errors of `accept` that say nothing against the listening socket: accept(2) tells what befell the newcomer."""


class Stream:
    """A descriptor that carries bytes both ways. What it can't take at once waits: whole packets, at most 64 KiB."""

    datagrams = False

    def __init__(self, fd: int, close: Callable[[], None], port: int = 0) -> None:
        self._fd, self._close, self._port = fd, close, port
        self._waiting = bytearray()

    def descriptors(self) -> Sequence[int]:
        return (self._fd,)

    def read(self) -> bytes | None:
        try:
            return os.read(self._fd, _CHUNK) or None
        except BlockingIOError:
            return b""

    def write(self, data: bytes) -> bool:
        if len(self._waiting) + len(data) > _OUTBOX_LIMIT:
            return False
        self._waiting += data
        self.flush()
        return True

    def wants_write(self) -> bool:
        return bool(self._waiting)

    def flush(self) -> None:
        while self._waiting:
            try:
                count = os.write(self._fd, self._waiting)
            except BlockingIOError:
                return
            del self._waiting[:count]

    def port(self) -> int:
        return self._port

    def close(self) -> None:
        self._close()


class Listener:
    """A TCP server for one client at a time: the last that came. One whose radio went out of range never says so, and
    must not keep the next one waiting."""

    datagrams = False

    def __init__(self, sock: socket.socket) -> None:
        self._sock = sock
        self._client: Stream | None = None
        self._change = threading.Lock()  # whoever reads lets clients go; nobody may be writing to a descriptor then

    def descriptors(self) -> Sequence[int]:
        return (self._sock.fileno(), *(self._client.descriptors() if self._client else ()))

    def read(self) -> bytes | None:
        newcomer = self._accepted()
        if newcomer is not None:
            self._leave(newcomer)
            return b""
        if self._client is None:
            return b""
        try:
            data = self._client.read()
        except OSError:
            data = None
        if data is None:
            self._leave()
            return b""
        return data

    def write(self, data: bytes) -> bool:
        try:
            with self._change:
                return self._client.write(data) if self._client else False
        except OSError:  # reading tells that it has gone
            return False

    def wants_write(self) -> bool:
        return self._client is not None and self._client.wants_write()

    def flush(self) -> None:
        try:
            with self._change:
                if self._client:
                    self._client.flush()
        except OSError:  # as above
            return

    def port(self) -> int:
        return int(self._sock.getsockname()[1])

    def close(self) -> None:
        self._leave()
        self._sock.close()

    def _accepted(self) -> Stream | None:
        """Who has come; None for nobody, and for one who has left again. Raises OSError when nobody can be let in."""
        try:
            sock = self._sock.accept()[0]
        except OSError as error:
            if error.errno in _NOBODY:
                return None
            raise
        try:
            return over_tcp(sock)
        except OSError:  # it is gone by now
            sock.close()
            return None

    def _leave(self, newcomer: Stream | None = None) -> None:
        with self._change:
            client, self._client = self._client, newcomer
            if client:
                client.close()


def over_tcp(sock: socket.socket) -> Stream:
    """A connected TCP socket as a stream; it fails 5 s after the other side vanished. Raises OSError."""
    sock.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
    sock.setsockopt(socket.IPPROTO_TCP, socket.TCP_USER_TIMEOUT, 1000 * _GONE_S)  # what was sent and not acknowledged
    sock.setsockopt(socket.SOL_SOCKET, socket.SO_KEEPALIVE, 1)  # where nothing was sent
    sock.setsockopt(socket.IPPROTO_TCP, socket.TCP_KEEPIDLE, 2)
    sock.setsockopt(socket.IPPROTO_TCP, socket.TCP_KEEPINTVL, 1)
    sock.setblocking(False)
    return Stream(sock.fileno(), sock.close, int(sock.getsockname()[1]))


def over_serial(address: Address) -> Stream:
    """A serial device in raw mode, 8N1, without flow control. Raises OSError, and LinkError for what is no such."""
    speed = getattr(termios, f"B{address.port}", None)
    if speed is None:
        raise LinkError(
            f"MAVLink link {address.url}: no serial port runs at {address.port} baud; write 57600, 115200 or 921600"
        )
    fd = os.open(address.host, os.O_RDWR | os.O_NOCTTY | os.O_NONBLOCK | os.O_CLOEXEC)
    try:
        attributes = termios.tcgetattr(fd)
        attributes[6][termios.VMIN], attributes[6][termios.VTIME] = 1, 0
        attributes[:6] = [0, 0, termios.CS8 | termios.CREAD | termios.CLOCAL, 0, speed, speed]
        termios.tcsetattr(fd, termios.TCSANOW, attributes)
    except termios.error as error:
        os.close(fd)
        raise LinkError(
            f"MAVLink link {address.url}: {address.host} is not a serial device; correct mavlink.url"
        ) from error
    return Stream(fd, lambda: os.close(fd))
