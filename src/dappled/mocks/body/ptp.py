"""PTP/IP as bytes: its codes, its packets, a request and its answer. Pure; no sockets.

Sources: PIMA 15740 (operation and response codes), CIPA DC-005 (packets). The Canon EOS extension is undocumented; its
codes are those that libgphoto2 reads.
"""

from __future__ import annotations

import struct
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from enum import IntEnum
from typing import TypeAlias


class Packet(IntEnum):
    """PTP/IP packet types (CIPA DC-005, table 4)."""

    INIT_COMMAND_REQUEST = 1
    INIT_COMMAND_ACK = 2
    INIT_EVENT_REQUEST = 3
    INIT_EVENT_ACK = 4
    INIT_FAIL = 5
    REQUEST = 6
    RESPONSE = 7
    EVENT = 8
    START_DATA = 9
    DATA = 10
    CANCEL = 11
    END_DATA = 12
    PROBE_REQUEST = 13
    PROBE_RESPONSE = 14


class Op(IntEnum):
    """Operation codes that the body answers."""

    GET_DEVICE_INFO = 0x1001
    OPEN_SESSION = 0x1002
    CLOSE_SESSION = 0x1003
    GET_STORAGE_IDS = 0x1004
    GET_STORAGE_INFO = 0x1005
    GET_NUM_OBJECTS = 0x1006
    GET_OBJECT_HANDLES = 0x1007
    GET_OBJECT_INFO = 0x1008
    GET_OBJECT = 0x1009
    GET_THUMB = 0x100A
    DELETE_OBJECT = 0x100B
    GET_DEVICE_PROP_DESC = 0x1014
    GET_DEVICE_PROP_VALUE = 0x1015
    SET_DEVICE_PROP_VALUE = 0x1016
    GET_PARTIAL_OBJECT = 0x101B
    EOS_GET_STORAGE_IDS = 0x9101
    EOS_GET_STORAGE_INFO = 0x9102
    EOS_GET_OBJECT = 0x9104
    EOS_DELETE_OBJECT = 0x9105
    EOS_GET_PARTIAL_OBJECT = 0x9107
    EOS_GET_DEVICE_INFO_EX = 0x9108
    EOS_GET_OBJECT_INFO_EX = 0x9109
    EOS_REMOTE_RELEASE = 0x910F
    EOS_SET_DEVICE_PROP_VALUE_EX = 0x9110
    EOS_SET_REMOTE_MODE = 0x9114
    EOS_SET_EVENT_MODE = 0x9115
    EOS_GET_EVENT = 0x9116
    EOS_TRANSFER_COMPLETE = 0x9117
    EOS_PC_HDD_CAPACITY = 0x911A
    EOS_SET_UI_LOCK = 0x911B
    EOS_RESET_UI_LOCK = 0x911C
    EOS_KEEP_DEVICE_ON = 0x911D
    EOS_REQUEST_DEVICE_PROP_VALUE = 0x9127
    EOS_AF_CANCEL = 0x9160


WITH_DATA_OUT = frozenset({Op.SET_DEVICE_PROP_VALUE, Op.EOS_SET_DEVICE_PROP_VALUE_EX})
"""Operations whose data come from the initiator; libgphoto2 doesn't say so in the request's data phase field."""


class Code(IntEnum):
    """Response codes."""

    OK = 0x2001
    GENERAL_ERROR = 0x2002
    SESSION_NOT_OPEN = 0x2003
    OPERATION_NOT_SUPPORTED = 0x2005
    INVALID_STORAGE_ID = 0x2008
    INVALID_OBJECT_HANDLE = 0x2009
    DEVICE_PROP_NOT_SUPPORTED = 0x200A
    STORE_FULL = 0x200C
    NO_THUMBNAIL_PRESENT = 0x2010
    DEVICE_BUSY = 0x2019
    SESSION_ALREADY_OPEN = 0x201E


class EosEvent(IntEnum):
    """Records of the EOS GetEvent data set."""

    OBJECT_ADDED = 0xC181
    OBJECT_REMOVED = 0xC182
    REQUEST_OBJECT_TRANSFER = 0xC186
    PROPERTY_CHANGED = 0xC189
    CHOICES_CHANGED = 0xC18A
    CAMERA_STATUS_CHANGED = 0xC18B


class Format(IntEnum):
    """Object formats: a folder, a JPEG, a Canon raw file."""

    UNDEFINED = 0x3000
    FOLDER = 0x3001
    JPEG = 0x3801
    RAW = 0xB103


class MalformedPacketError(ValueError):
    """Bytes that aren't what they should be; one sentence."""


@dataclass(frozen=True, slots=True)
class Request:
    """An operation request: code, transaction, at most five parameters."""

    code: int
    transaction: int
    parameters: tuple[int, ...]

    def parameter(self, index: int, default: int = 0) -> int:
        """A parameter, or the default where the initiator sent fewer."""
        return self.parameters[index] if index < len(self.parameters) else default


@dataclass(frozen=True, slots=True)
class Answer:
    """What a body says to a request: response code, response parameters, data (None: no data phase)."""

    code: int = Code.OK
    parameters: tuple[int, ...] = ()
    data: bytes | memoryview | None = None


Handler: TypeAlias = Callable[[Request, bytes], Answer]
"""What answers one operation; the bytes are those that came with the request."""


def packet(kind: Packet, payload: bytes = b"") -> bytes:
    """A whole packet: length (with this header), type, payload."""
    return struct.pack("<II", 8 + len(payload), kind) + payload


def header(data: bytes) -> tuple[int, int]:
    """Type and payload length from a packet's eight header bytes. Raises MalformedPacketError."""
    if len(data) != 8:
        raise MalformedPacketError(f"a PTP/IP header has 8 bytes, not {len(data)}")
    length, kind = struct.unpack("<II", data)
    if length < 8:
        raise MalformedPacketError(f"a PTP/IP packet says it is {length} bytes long, shorter than its own header")
    return kind, length - 8


def parse_request(payload: bytes) -> Request:
    """The payload of a REQUEST packet. Raises MalformedPacketError."""
    if len(payload) < 10 or (len(payload) - 10) % 4 or len(payload) > 30:
        raise MalformedPacketError(f"an operation request has 10 to 30 bytes in steps of 4, not {len(payload)}")
    _phase, code, transaction = struct.unpack_from("<IHI", payload)
    count = (len(payload) - 10) // 4
    return Request(code, transaction, struct.unpack_from(f"<{count}I", payload, 10))


def response(code: int, transaction: int, parameters: Sequence[int] = ()) -> bytes:
    """A RESPONSE packet."""
    return packet(Packet.RESPONSE, struct.pack(f"<HI{len(parameters)}I", code, transaction, *parameters))


def start_data(transaction: int, size: int) -> bytes:
    """The packet that opens a data phase of `size` bytes."""
    return packet(Packet.START_DATA, struct.pack("<IQ", transaction, size))


def end_data_header(transaction: int, size: int) -> bytes:
    """The head of the one packet that carries all `size` bytes of a data phase; the bytes follow."""
    return struct.pack("<III", 12 + size, Packet.END_DATA, transaction)


def init_command_ack(connection: int, guid: bytes, name: str) -> bytes:
    """The responder's answer to a connection: number, 16-byte GUID, friendly name, protocol version 1.0."""
    text = name.encode("utf-16-le") + b"\0\0"
    return packet(Packet.INIT_COMMAND_ACK, struct.pack("<I", connection) + guid + text + struct.pack("<HH", 0, 1))
