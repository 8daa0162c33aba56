"""Camera commands and events as messages between two processes: JSON in packets, file descriptors beside them.

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
from dataclasses import asdict, dataclass
from typing import Any

from dappled.drivers.camera import (
    Arrival,
    Blob,
    CameraEvent,
    Companion,
    Deferred,
    Fired,
    Identity,
    Setting,
    SettingsChanged,
    ShotFailed,
    StateChanged,
)

_MESSAGE_BYTES = 65536
_FDS = 4
_INT = struct.Struct("i")


class ChannelError(Exception):
    """The other process is gone, doesn't take messages, or sent nonsense."""


@dataclass(frozen=True, slots=True)
class Message:
    """One message: a JSON object, and the descriptors that came with it (the receiver's to close)."""

    body: Mapping[str, Any]
    fds: tuple[int, ...] = ()


class Channel:
    """One end of the pair. Messages may be sent from any thread; one thread receives."""

    def __init__(self, sock: socket.socket) -> None:
        self._socket = sock
        sock.setblocking(False)

    @classmethod
    def pair(cls) -> tuple[Channel, socket.socket]:
        """A channel and the socket of its other end, to be handed to a child process."""
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

    def receive(self, timeout_s: float) -> Message | None:
        """The next message; None when there was none for that long. Raises ChannelError at the other end's end."""
        try:
            if not _wait(self._socket, select.POLLIN, timeout_s):
                return None
            raw, fds, flags = _received(self._socket)
        except BlockingIOError:
            return None
        except (OSError, ValueError) as error:
            raise ChannelError(f"the other process is gone ({error})") from error
        try:
            return Message(_parsed(raw, flags), fds)
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
    """One packet: bytes, descriptors (not inherited: `socket.recv_fds` ignores the flag for that), flags."""
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
        raise ChannelError(f"a message was no JSON: {error}") from error
    if not isinstance(body, dict):
        raise ChannelError(f"a message must be an object, not {type(body).__name__}")
    return body


def event_message(event: CameraEvent) -> Message:
    """An event as a message; a file's blob travels as the message's only descriptor (still the caller's)."""
    match event:
        case StateChanged(state, reason, at_ns, identity):
            who = None if identity is None else asdict(identity)
            return Message({"is": "state", "state": state, "reason": reason, "ns": at_ns, "identity": who})
        case Fired(shot, called_ns, returned_ns):
            return Message({"is": "fired", "shot": shot, "called_ns": called_ns, "returned_ns": returned_ns})
        case ShotFailed(shot, reason, at_ns):
            return Message({"is": "failed", "shot": shot, "reason": reason, "ns": at_ns})
        case Deferred(shot, reason, at_ns):
            return Message({"is": "deferred", "shot": shot, "reason": reason, "ns": at_ns})
        case SettingsChanged(settings, at_ns, refused):
            each = [asdict(one) for one in settings]
            return Message({"is": "settings", "settings": each, "ns": at_ns, "refused": refused})
        case Arrival(shot_or_none, name, blob, at_ns, facts) | Companion(shot_or_none, name, blob, at_ns, facts):
            kind = "arrival" if isinstance(event, Arrival) else "companion"
            body = {"is": kind, "shot": shot_or_none, "name": name, "size": blob.size, "ns": at_ns}
            return Message({**body, "facts": dict(facts)}, (blob.fd,))


def message_event(message: Message) -> CameraEvent:
    """The event that a message carries. Raises ChannelError for anything else; its descriptors are closed then."""
    try:
        return _event(message.body, message.fds)
    except (KeyError, TypeError, ValueError) as error:
        for fd in message.fds:
            os.close(fd)
        raise ChannelError(f"a message could not be understood: {error!r}") from error


def _event(body: Mapping[str, Any], fds: tuple[int, ...]) -> CameraEvent:
    match body["is"]:
        case "state":
            who = None if body["identity"] is None else Identity(**body["identity"])
            return StateChanged(body["state"], body["reason"], body["ns"], who)
        case "fired":
            return Fired(body["shot"], body["called_ns"], body["returned_ns"])
        case "failed":
            return ShotFailed(body["shot"], body["reason"], body["ns"])
        case "deferred":
            return Deferred(body["shot"], body["reason"], body["ns"])
        case "settings":
            read = tuple(Setting(each["name"], each["value"], tuple(each["choices"])) for each in body["settings"])
            return SettingsChanged(read, body["ns"], body["refused"])
        case "arrival" | "companion" as kind:
            (fd,) = fds
            made = Arrival if kind == "arrival" else Companion
            return made(body["shot"], body["name"], Blob(fd, body["size"]), body["ns"], body["facts"])
        case other:
            raise ValueError(f"nothing is called {other!r}")
