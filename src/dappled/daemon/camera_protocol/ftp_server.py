"""Serve a few small files from memory over MAVLink FTP (FILE_TRANSFER_PROTOCOL, message 110), read-only.

The payload (mavlink.io, "File Transfer Protocol"): sequence u16, session, opcode, size, the answered opcode,
burst complete, padding (u8 each), offset u32, 239 bytes of data.
"""

from __future__ import annotations

import re
import struct
import zlib
from collections.abc import Callable, Mapping
from dataclasses import dataclass

from dappled.drivers.mavlink import MavlinkMessage, mavlink

DATA_BYTES = 239
SESSIONS = 8
IDLE_NS = 60 * 10**9
BURST = 32  # packets of one burst: 7.5 kB, which fits a radio's buffer
_HEADER = struct.Struct("<HBBBBBxI")
_PAYLOAD_BYTES = 251
_ADDRESS = re.compile(r"^\[;comp=\d+\]")
_Client = tuple[int, int]


_ACK, _NAK = 128, 129
_WRITES = (6, 7, 8, 9, 10, 11, 12, 13)  # create, write, remove, make folder, remove folder, open, truncate, rename
_INVALID_DATA, _INVALID_SESSION, _NO_SESSIONS, _END, _UNKNOWN, _PROTECTED, _NOT_FOUND = 3, 4, 5, 6, 7, 9, 10


@dataclass(frozen=True, slots=True)
class _Request:
    sequence: int
    session: int
    opcode: int
    size: int
    offset: int
    data: bytes


@dataclass(slots=True)
class _Session:
    """An open file, as it was when it was opened."""

    client: _Client
    data: bytes
    used_ns: int


@dataclass(frozen=True, slots=True)
class _Answered:
    """The last request of a client, its answer, and the session that it opened."""

    request: _Request
    messages: list[MavlinkMessage]
    opened: _Session | None


class FtpServer:
    """Serves `files`, their content by name, without folders, as it is when they are asked for.

    At most eight files are open; one that is idle for a minute is closed.
    """

    def __init__(self, files: Callable[[], Mapping[str, bytes]]) -> None:
        self._files = files
        self._sessions: dict[int, _Session] = {}
        self._last: dict[tuple[_Client, int], _Answered] = {}  # a retry gets the same answer

    def answer(self, message: MavlinkMessage, now_ns: int) -> list[MavlinkMessage]:
        """What to send back for a FILE_TRANSFER_PROTOCOL message. Time is monotonic."""
        client: _Client = (message.get_srcSystem(), message.get_srcComponent())
        request = _parse(bytes(message.payload))
        if request is None or request.opcode >= _ACK:  # an answer needs no answer
            return []
        self._sessions = {at: one for at, one in self._sessions.items() if now_ns - one.used_ns < IDLE_NS}
        known = self._last.get((client, request.session))
        if known is not None and known.request == request and self._is_valid(known.opened):
            return known.messages
        replies = self._act(request, client, now_ns)
        messages = [
            mavlink.MAVLink_file_transfer_protocol_message(message.target_network, *client, _bytes(request, at, reply))
            for at, reply in enumerate(replies)
        ]
        self._last.pop((client, request.session), None)
        opened = next((self._sessions[reply.session] for reply in replies if reply.session is not None), None)
        self._last[client, request.session] = _Answered(request, messages, opened)
        if len(self._last) > SESSIONS:
            self._last.pop(next(iter(self._last)))
        return messages

    def _is_valid(self, session: _Session | None) -> bool:
        """Whether an answer that opened this session is still valid. An answer that opened none is valid."""
        return session is None or any(session is one for one in self._sessions.values())

    def _act(self, request: _Request, client: _Client, now_ns: int) -> list[_Reply]:
        handler = _OPERATIONS.get(request.opcode)
        if handler is None:
            return [_refusal(_PROTECTED if request.opcode in _WRITES else _UNKNOWN)]
        return handler(self, request, client, now_ns)

    def _nothing(self, request: _Request, client: _Client, now_ns: int) -> list[_Reply]:
        return [_Reply()]

    def _terminate(self, request: _Request, client: _Client, now_ns: int) -> list[_Reply]:
        if self._held(request, client, now_ns) is None:
            return [_refusal(_INVALID_SESSION)]
        del self._sessions[request.session]
        return [_Reply()]

    def _reset(self, request: _Request, client: _Client, now_ns: int) -> list[_Reply]:
        self._sessions = {at: one for at, one in self._sessions.items() if one.client != client}
        return [_Reply()]

    def _checksum(self, request: _Request, client: _Client, now_ns: int) -> list[_Reply]:
        data = self._files().get(_name(request.data))
        return [_refusal(_NOT_FOUND) if data is None else _Reply(data=struct.pack("<I", _crc32(data)))]

    def _list(self, request: _Request, client: _Client, now_ns: int) -> list[_Reply]:
        names = [f"F{name}\t{len(data)}\0".encode() for name, data in sorted(self._files().items())]
        if _name(request.data) not in ("", "."):
            return [_refusal(_NOT_FOUND)]
        text = b""
        for entry in names[request.offset :]:
            if len(text) + len(entry) > DATA_BYTES:
                break
            text += entry
        return [_Reply(data=text) if text else _refusal(_END)]

    def _open(self, request: _Request, client: _Client, now_ns: int) -> list[_Reply]:
        data = self._files().get(_name(request.data))
        if data is None:
            return [_refusal(_NOT_FOUND)]
        if len(self._sessions) >= SESSIONS:
            return [_refusal(_NO_SESSIONS)]
        # By the protocol the server numbers a session; MAVProxy, like ArduPilot, has numbered it already.
        free = next(at for at in (request.session, *range(SESSIONS)) if at not in self._sessions)
        self._sessions[free] = _Session(client, data, now_ns)
        return [_Reply(session=free, data=struct.pack("<I", len(data)))]

    def _read(self, request: _Request, client: _Client, now_ns: int) -> list[_Reply]:
        session = self._held(request, client, now_ns)
        if session is None:
            return [_refusal(_INVALID_SESSION)]
        part = session.data[request.offset : request.offset + min(request.size or DATA_BYTES, DATA_BYTES)]
        return [_Reply(data=part, offset=request.offset) if part else _refusal(_END)]

    def _burst(self, request: _Request, client: _Client, now_ns: int) -> list[_Reply]:
        session = self._held(request, client, now_ns)
        if session is None:
            return [_refusal(_INVALID_SESSION)]
        size = min(request.size or DATA_BYTES, DATA_BYTES)
        starts = range(request.offset, len(session.data), size)[:BURST]
        if not starts:
            return [_refusal(_END)]
        return [
            _Reply(data=session.data[start : start + size], offset=start, complete=start == starts[-1])
            for start in starts
        ]

    def _held(self, request: _Request, client: _Client, now_ns: int) -> _Session | None:
        session = self._sessions.get(request.session)
        if session is None or session.client != client:
            return None
        session.used_ns = now_ns
        return session


@dataclass(frozen=True, slots=True)
class _Reply:
    data: bytes = b""
    session: int | None = None
    offset: int | None = None
    complete: bool = False
    refused: bool = False


_OPERATIONS: dict[int, Callable[[FtpServer, _Request, _Client, int], list[_Reply]]] = {
    0: FtpServer._nothing,
    1: FtpServer._terminate,
    2: FtpServer._reset,
    3: FtpServer._list,
    4: FtpServer._open,
    5: FtpServer._read,
    14: FtpServer._checksum,
    15: FtpServer._burst,
}


def _refusal(reason: int) -> _Reply:
    return _Reply(data=bytes([reason]), refused=True)


def _parse(payload: bytes) -> _Request | None:
    if len(payload) < _HEADER.size:
        return None
    sequence, session, opcode, size, _, _, offset = _HEADER.unpack_from(payload)
    return _Request(sequence, session, opcode, size, offset, payload[_HEADER.size : _HEADER.size + size])


def _bytes(request: _Request, at: int, reply: _Reply) -> bytes:
    sequence = (request.sequence + 1 + at) % 65536
    session = request.session if reply.session is None else reply.session
    offset = request.offset if reply.offset is None else reply.offset
    opcode = _NAK if reply.refused else _ACK
    header = _HEADER.pack(sequence, session, opcode, len(reply.data), request.opcode, reply.complete, offset)
    return (header + reply.data).ljust(_PAYLOAD_BYTES, b"\0")


def _name(data: bytes) -> str:
    """The file's name in a path: there are no folders. MAVSDK leaves the address "[;comp=100]" in front of it."""
    path = data.split(b"\0", 1)[0].decode("utf-8", "replace")
    return _ADDRESS.sub("", path).lstrip("/")


def _crc32(data: bytes) -> int:
    """CRC-32 as the peers compute it: started from 0 and without the final inversion."""
    return ~zlib.crc32(data, 0xFFFFFFFF) & 0xFFFFFFFF
