"""PTP/IP as bytes: codes, packets, requests, responses, and the data sets of a Canon EOS. Pure; no sockets.

Sources: PIMA 15740 (operation and response codes), CIPA DC-005 (packets). The Canon EOS extension is undocumented; its
codes are those that libgphoto2 reads.
"""

from __future__ import annotations

import struct
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass
from enum import IntEnum
from typing import TypeAlias


class PtpPacket(IntEnum):
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
    EOS_GET_VIEWFINDER_DATA = 0x9153
    EOS_AF_CANCEL = 0x9160


WITH_DATA_OUT = frozenset({Op.SET_DEVICE_PROP_VALUE, Op.EOS_SET_DEVICE_PROP_VALUE_EX})
"""Operations whose data come from the initiator; libgphoto2 doesn't say so in the request's data phase field."""


class ResponseCode(IntEnum):
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
class PtpRequest:
    """An operation request: code, transaction, at most five parameters."""

    code: int
    transaction: int
    parameters: tuple[int, ...]

    def parameter(self, index: int, default: int = 0) -> int:
        """A parameter, or the default where the initiator sent fewer."""
        return self.parameters[index] if index < len(self.parameters) else default


@dataclass(frozen=True, slots=True)
class PtpResponse:
    """What a body says to a request: response code, response parameters, data (None: no data phase)."""

    code: int = ResponseCode.OK
    parameters: tuple[int, ...] = ()
    data: bytes | memoryview | None = None


Handler: TypeAlias = Callable[[PtpRequest, bytes], PtpResponse]
"""What answers one operation; the bytes are those that came with the request."""


def packet(kind: PtpPacket, payload: bytes = b"") -> bytes:
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


def parse_request(payload: bytes) -> PtpRequest:
    """The payload of a REQUEST packet. Raises MalformedPacketError."""
    if len(payload) < 10 or (len(payload) - 10) % 4 or len(payload) > 30:
        raise MalformedPacketError(f"an operation request has 10 to 30 bytes in steps of 4, not {len(payload)}")
    _phase, code, transaction = struct.unpack_from("<IHI", payload)
    count = (len(payload) - 10) // 4
    return PtpRequest(code, transaction, struct.unpack_from(f"<{count}I", payload, 10))


def response(code: int, transaction: int, parameters: Sequence[int] = ()) -> bytes:
    """A RESPONSE packet."""
    return packet(PtpPacket.RESPONSE, struct.pack(f"<HI{len(parameters)}I", code, transaction, *parameters))


def start_data(transaction: int, size: int) -> bytes:
    """The packet that opens a data phase of `size` bytes."""
    return packet(PtpPacket.START_DATA, struct.pack("<IQ", transaction, size))


def end_data_header(transaction: int, size: int) -> bytes:
    """The head of the one packet that carries all `size` bytes of a data phase; the bytes follow."""
    return struct.pack("<III", 12 + size, PtpPacket.END_DATA, transaction)


def init_command_ack(connection: int, guid: bytes, name: str) -> bytes:
    """The responder's answer to a connection: number, 16-byte GUID, friendly name, protocol version 1.0."""
    text = name.encode("utf-16-le") + b"\0\0"
    return packet(PtpPacket.INIT_COMMAND_ACK, struct.pack("<I", connection) + guid + text + struct.pack("<HH", 0, 1))


_CANON = 0x0000000B
ROOT = 0xFFFFFFFF


def string(text: str) -> bytes:
    """A PTP string: count of UTF-16 units with the closing zero, then the units; one zero byte when empty.

    Raises MalformedPacketError over 254 units.
    """
    if not text:
        return b"\0"
    units = text.encode("utf-16-le") + b"\0\0"
    if len(units) // 2 > 255:
        raise MalformedPacketError(f"a PTP string holds at most 254 characters, not {len(units) // 2 - 1}")
    return bytes([len(units) // 2]) + units


def array16(values: Iterable[int]) -> bytes:
    """A counted array of 16-bit numbers."""
    items = tuple(values)
    return struct.pack(f"<I{len(items)}H", len(items), *items)


def array32(values: Iterable[int]) -> bytes:
    """A counted array of 32-bit numbers."""
    items = tuple(values)
    return struct.pack(f"<I{len(items)}I", len(items), *items)


def device_info(
    *,
    model: str,
    version: str,
    serial: str,
    operations: Iterable[int],
    events: Iterable[int],
    properties: Iterable[int],
    formats: Iterable[int],
) -> bytes:
    """The DeviceInfo data set of a Canon."""
    return b"".join(
        (
            struct.pack("<HIH", 100, _CANON, 200),
            string(""),
            struct.pack("<H", 0),
            array16(operations),
            array16(events),
            array16(properties),
            array16((Format.JPEG,)),
            array16(formats),
            string("Canon Inc."),
            string(model),
            string(version),
            string(serial),
        )
    )


def storage_info(capacity: int, free: int) -> bytes:
    """The StorageInfo data set of an SD card with a DCIM tree; sizes in bytes."""
    return struct.pack("<HHHQQI", 4, 3, 0, capacity, free, 0xFFFFFFFF) + string("SD") + string("None")


def object_info(*, storage: int, code: int, size: int, parent: int, name: str, taken: str) -> bytes:
    """The ObjectInfo data set; `taken` is a PTP date (YYYYMMDDThhmmss)."""
    return b"".join(
        (
            struct.pack("<IHHI", storage, code, 0, size),
            struct.pack("<HIII", 0, 0, 0, 0),
            struct.pack("<IIIIHII", 0, 0, 0, parent, 1 if code == Format.FOLDER else 0, 0, 0),
            string(name),
            string(taken),
            string(taken),
            string(""),
        )
    )


# --- of Canon EOS bodies --------------------------------------------------------------------------------------------


def eos_device_info(events: Iterable[int], properties: Iterable[int]) -> bytes:
    """The EOS DeviceInfoEx data set."""
    body = array32(events) + array32(properties) + array32((0, 1, 2, 4, 8))
    return struct.pack("<I", len(body) + 4) + body


def _record(kind: int, payload: bytes = b"") -> bytes:
    return struct.pack("<II", 8 + len(payload), kind) + payload


def eos_events(records: Iterable[bytes]) -> bytes:
    """Records as one GetEvent data set, closed by the empty record without which the last is not read."""
    return b"".join(records) + _record(0)


def eos_property(prop: int, value: bytes) -> bytes:
    """A property has this value (already encoded, at least four bytes)."""
    return _record(EosEvent.PROPERTY_CHANGED, struct.pack("<I", prop) + value.ljust(4, b"\0"))


def eos_choices(prop: int, count: int, words: Sequence[int]) -> bytes:
    """A property may have these `count` values, each of one word or more."""
    return _record(EosEvent.CHOICES_CHANGED, struct.pack(f"<III{len(words)}I", prop, 3, count, *words))


def eos_status(status: int) -> bytes:
    """The camera's status: 1 while it works on a capture, 0 when done."""
    return _record(EosEvent.CAMERA_STATUS_CHANGED, struct.pack("<I", status))


def eos_object_added(*, handle: int, storage: int, code: int, size: int, parent: int, name: str) -> bytes:
    """A new object on the card."""
    head = struct.pack("<IIIIIIII", handle, storage, code, 0, 0, size, parent, handle)
    return _record(EosEvent.OBJECT_ADDED, head + _name(name))


def eos_object_transfer(*, handle: int, code: int, size: int, name: str) -> bytes:
    """A new object in the camera's memory waits to be fetched."""
    return _record(EosEvent.REQUEST_OBJECT_TRANSFER, struct.pack("<IIIII", handle, code, 0, size, 0) + _name(name))


def eos_folder(entries: Iterable[tuple[int, int, int, int, int, str, int]]) -> bytes:
    """The GetObjectInfoEx data set. Entries: handle, storage, format, size, parent, name (15 bytes), Unix time."""
    rows = []
    for handle, storage, code, size, parent, name, seconds in entries:
        fields = struct.pack("<IIIIIIII", handle, storage, code, 0, 0x20, size, parent, handle)
        rows.append(
            struct.pack("<I", 56) + fields + name.encode("ascii")[:15].ljust(16, b"\0") + struct.pack("<I", seconds)
        )
    return struct.pack("<I", len(rows)) + b"".join(rows)


def _name(name: str) -> bytes:
    raw = name.encode("ascii") + b"\0"
    return raw.ljust((len(raw) + 3) // 4 * 4, b"\0")
