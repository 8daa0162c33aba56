"""Byte streams that never block: a serial line's, a TCP connection's, and those of a TCP server's clients."""

from __future__ import annotations

import contextlib
import errno
import os
import socket
import threading
from collections.abc import Callable, Sequence
from dataclasses import dataclass

from dappled.drivers.mavlink.peers import CREDIT_BYTES, OnePeer, Shown

_CHUNK = 65536
_CANDIDATES = 4
_CANDIDATE_CHUNK = 1024  # a client waits no longer than for so many bytes of theirs
_OUTBOX_LIMIT = 65536
_GONE_S = 5
_NO_CLIENT = (errno.EAGAIN, errno.EWOULDBLOCK, errno.ECONNABORTED, errno.EPROTO, errno.ENETDOWN, errno.ENETUNREACH,
              errno.EHOSTDOWN, errno.EHOSTUNREACH, errno.ENONET)  # fmt: skip
"""Errors of `accept` that are the client's and not the listening socket's: see accept(2)."""


class ByteStream(OnePeer):
    """A descriptor that carries bytes both ways. What it can't take at once waits: whole packets, at most 64 KiB."""

    datagrams = False

    def __init__(self, fd: int, close: Callable[[], None], port: int = 0) -> None:
        self._fd, self._close, self._port = fd, close, port
        self._waiting = bytearray()

    def descriptors(self) -> Sequence[int]:
        return (self._fd,)

    def read(self, most: int = _CHUNK) -> bytes | None:
        try:
            return os.read(self._fd, most) or None
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


def over_tcp(sock: socket.socket) -> ByteStream:
    """Make a connected TCP socket a stream that fails 5 s after the other side vanished. Raises OSError."""
    sock.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
    sock.setsockopt(socket.IPPROTO_TCP, socket.TCP_USER_TIMEOUT, 1000 * _GONE_S)  # what was sent and not acknowledged
    sock.setsockopt(socket.SOL_SOCKET, socket.SO_KEEPALIVE, 1)  # where nothing was sent
    sock.setsockopt(socket.IPPROTO_TCP, socket.TCP_KEEPIDLE, 2)
    sock.setsockopt(socket.IPPROTO_TCP, socket.TCP_KEEPINTVL, 1)
    sock.setblocking(False)
    return ByteStream(sock.fileno(), sock.close, int(sock.getsockname()[1]))


@dataclass(slots=True, eq=False)
class _Candidate:
    """A client that has not proven itself. `credit` is how many bytes it may be sent meanwhile."""

    stream: ByteStream
    number: int
    credit: int = 0


class TcpServer:
    """A TCP server for one client at a time, the newest. A client whose radio went out of range never closes its
    connection, and must not keep the next one waiting.

    Where proof is asked for, a newcomer is no client before a packet of it was obeyed, and neither hears anything nor
    displaces anybody; at most four are listened to, the newest.
    """

    datagrams = False

    def __init__(self, sock: socket.socket) -> None:
        self._sock = sock
        self._client: ByteStream | None = None
        self._change = threading.Lock()  # the reading thread closes clients; no other may write to one meanwhile
        self._asks_proof = False
        self._candidates: list[_Candidate] = []
        self._accepted_so_far = 0
        self._client_number = 0
        self._last: _Candidate | None = None
        self._last_size = 0

    @property
    def origin(self) -> int:
        """Whose bytes were read last: a number for each client."""
        return self._client_number if self._last is None else self._last.number

    def ask_proof(self) -> None:
        """Serve only who has proven itself."""
        self._asks_proof = True

    def descriptors(self) -> Sequence[int]:
        waiting = [one.stream for one in self._candidates]
        streams = [self._client, *waiting] if self._client else waiting
        return (self._sock.fileno(), *(descriptor for one in streams for descriptor in one.descriptors()))

    def read(self) -> bytes | None:
        newcomer = self._accepted()
        if newcomer is not None:
            self._welcome(newcomer)
            return b""
        self._last = None
        if self._client is not None:  # before strangers, who may always have sent something
            data = _read(self._client)
            if data is None:
                self._replace_client()
            elif data:
                return data
        for one in list(self._candidates):
            data = _read(one.stream, _CANDIDATE_CHUNK)
            if data is None:
                self._drop(one)
            elif data:
                self._candidates.remove(one)  # the others' turn comes first next time
                self._candidates.append(one)
                self._last, self._last_size = one, len(data)
                return data
        return b""

    def shown(self, evidence: Shown) -> None:
        one = self._last
        if one is None:
            return
        if evidence == "old":
            one.credit = min(one.credit + self._last_size, CREDIT_BYTES)
            self._last_size = 0
            return
        with self._change:
            self._candidates.remove(one)
        self._last, self._client_number = None, one.number
        self._replace_client(one.stream)

    def write(self, data: bytes) -> bool:
        try:
            with self._change:
                for one in self._candidates:
                    if len(data) <= one.credit:
                        one.credit -= len(data)
                        with contextlib.suppress(OSError):  # the next `read` finds that it has gone
                            one.stream.write(data)
                return self._client.write(data) if self._client else False
        except OSError:  # as above
            return False

    def source(self) -> str:
        return ""

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
        for one in list(self._candidates):
            self._drop(one)
        self._replace_client()
        self._sock.close()

    def _welcome(self, newcomer: ByteStream) -> None:
        self._accepted_so_far += 1
        if not self._asks_proof:
            self._client_number = self._accepted_so_far
            self._replace_client(newcomer)
            return
        while len(self._candidates) >= _CANDIDATES:
            self._drop(self._candidates[0])
        with self._change:
            self._candidates.append(_Candidate(newcomer, self._accepted_so_far))

    def _drop(self, one: _Candidate) -> None:
        with self._change:
            self._candidates.remove(one)
            one.stream.close()

    def _accepted(self) -> ByteStream | None:
        """Accept a client; None where none is there, or it has left again. Raises OSError when the socket is broken."""
        try:
            sock = self._sock.accept()[0]
        except OSError as error:
            if error.errno in _NO_CLIENT:
                return None
            raise
        try:
            return over_tcp(sock)
        except OSError:  # it has left by now
            sock.close()
            return None

    def _replace_client(self, newcomer: ByteStream | None = None) -> None:
        with self._change:
            client, self._client = self._client, newcomer
            if client:
                client.close()


def _read(stream: ByteStream, most: int = _CHUNK) -> bytes | None:
    """What has come; None where the other side is gone."""
    try:
        return stream.read(most)
    except OSError:
        return None
