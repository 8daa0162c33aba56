"""The data sets that a Canon EOS sends over PTP, as bytes. Pure.

Sources: PIMA 15740. The Canon EOS extension is undocumented; its layouts are those that libgphoto2 reads.
"""

from __future__ import annotations

import struct
from collections.abc import Iterable, Sequence

from dappled.mocks.body.ptp import EosEvent, Format, MalformedPacketError

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
