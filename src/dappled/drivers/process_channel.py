"""Pass messages between two processes: JSON in packets, with file descriptors beside them.

The socket is an AF_UNIX SOCK_SEQPACKET pair: the kernel keeps message boundaries and passes descriptors, so a file
moves between the processes without a copy. Nothing is ever unpickled.
"""

from __future__ import annotations

import json
import os
import select
import socket
import struct
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

_MESSAGE_BYTES = 65536
_FDS = 4
_INT = struct.Struct("i")


class ChannelError(Exception):
    """The other process is gone, takes no messages, or sent something that is no message."""


@dataclass(frozen=True, slots=True)
class ChannelMessage:
    """A JSON object and the descriptors that came with it, which the receiver closes."""

    body: Mapping[str, Any]
    fds: tuple[int, ...] = ()


class ProcessChannel:
    """One end of the pair. Messages may be sent from any thread; one thread receives."""

    def __init__(self, sock: socket.socket) -> None:
        self._socket = sock
        sock.setblocking(False)

    @classmethod
    def pair(cls) -> tuple[ProcessChannel, socket.socket]:
        """Make a channel, and the socket of its other end for a child process."""
        here, there = socket.socketpair(socket.AF_UNIX, socket.SOCK_SEQPACKET)
        return cls(here), there

    def send(self, body: Mapping[str, Any], fds: tuple[int, ...] = (), timeout_s: float = 0.0) -> None:
        """Send one message, waiting at most `timeout_s` for room. Raises ChannelError."""
        raw = json.dumps(body).encode()
        try:
            if timeout_s:
                _wait(self._socket, select.POLLOUT, timeout_s)
            if fds:
                socket.send_fds(self._socket, [raw], list(fds))
            else:
                self._socket.send(raw)
        except BlockingIOError as error:
            raise ChannelError("the other process takes no more messages") from error
        except (OSError, ValueError) as error:  # ValueError: closed here
            raise ChannelError(f"the other process is gone ({error})") from error

    def receive(self, timeout_s: float) -> ChannelMessage | None:
        """Return the next message, or None when there was none for that long. Raises ChannelError when the other
        end is closed."""
        try:
            if not _wait(self._socket, select.POLLIN, timeout_s):
                return None
            raw, fds, flags = _received(self._socket)
        except BlockingIOError:
            return None
        except (OSError, ValueError) as error:
            raise ChannelError(f"the other process is gone ({error})") from error
        try:
            return ChannelMessage(_parsed(raw, flags), fds)
        except ChannelError:
            for fd in fds:
                os.close(fd)
            raise

    def close(self) -> None:
        """Close this end."""
        self._socket.close()


def _wait(sock: socket.socket, event: int, timeout_s: float) -> bool:
    poll = select.poll()  # unlike select(2) it knows descriptors above 1023
    poll.register(sock, event)
    return bool(poll.poll(timeout_s * 1e3))


def _received(sock: socket.socket) -> tuple[bytes, tuple[int, ...], int]:
    """Receive one packet: bytes, descriptors, flags. `socket.recv_fds` would ignore MSG_CMSG_CLOEXEC."""
    raw, ancillary, flags, _ = sock.recvmsg(_MESSAGE_BYTES, socket.CMSG_LEN(_FDS * _INT.size), socket.MSG_CMSG_CLOEXEC)
    fds = tuple(
        fd
        for level, kind, data in ancillary
        if (level, kind) == (socket.SOL_SOCKET, socket.SCM_RIGHTS)
        for (fd,) in _INT.iter_unpack(data[: len(data) - len(data) % _INT.size])
    )
    return raw, fds, flags


def _parsed(raw: bytes, flags: int) -> dict[str, Any]:
    if not raw:
        raise ChannelError("the other process has ended")
    if flags & (socket.MSG_TRUNC | socket.MSG_CTRUNC):
        raise ChannelError("a message was longer than a message may be")
    try:
        body = json.loads(raw)
    except ValueError as error:
        raise ChannelError(f"a message was not JSON: {error}") from error
    if not isinstance(body, dict):
        raise ChannelError(f"a message must be an object, not {type(body).__name__}")
    return body
