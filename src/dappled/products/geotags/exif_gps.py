"""Write EXIF GPS into copies of frames: TIFF-like raws (CR2, DNG, NEF, ARW), TIFF, JPEG, PNG, and Fujifilm's RAF.

The GPS directory, and a new first directory that points to it, are appended to a TIFF. Nothing else moves, so every
offset in it, also a maker note's, stays right. A JPEG's EXIF and a PNG's eXIf chunk are such TIFFs; a RAF holds EXIF in
its JPEG preview.
"""

from __future__ import annotations

import re
import struct
from collections.abc import Sequence
from dataclasses import dataclass
from datetime import UTC, datetime

from dappled.decode.geometry import Pose
from dappled.decode.geometry.camera_pose import CameraPose
from dappled.errors import DappledError
from dappled.products import png_files

_GPS_IFD = 0x8825
_BYTE, _ASCII, _LONG, _RATIONAL = 1, 2, 4, 5
Entry = tuple[int, int, int, bytes]
"""Tag, type, count and value (in the file's byte order) of a directory."""
_RAF = b"FUJIFILMCCD-RAW"
_RAF_JPEG = 84
_RAF_ALIGNED, _RAF_NOT_SET = 4, 0x8000
_EXIF = b"Exif\0\0"
_SOI, _APP0, _APP1, _SOS = 0xD8, 0xE0, 0xE1, 0xDA
_SEGMENT = 0xFFFF
_FILL = re.compile(rb"\xff+")
EMPTY = b"II*\0" + struct.pack("<IHI", 8, 0, 0)
"""A TIFF without an entry, little endian."""


class ExifError(DappledError):
    """EXIF can't be written into a file."""


@dataclass(frozen=True, slots=True)
class Place:
    """The content of the GPS directory. Altitude is above mean sea level; None is left out."""

    latitude_deg: float
    longitude_deg: float
    altitude_m: float
    utc_ns: int | None = None
    direction_deg: float | None = None
    error_m: float | None = None
    dop: float | None = None
    satellites: int | None = None


def place(camera: CameraPose, utc_ns: int | None, pose: Pose) -> Place:
    """The place of a camera, with the direction of the image's top (true north is 0), and what the pose's receiver
    says."""
    return Place(
        camera.latitude_deg,
        camera.longitude_deg,
        camera.altitude_msl_m,
        utc_ns,
        None if camera.pix4d is None else camera.pix4d.yaw_deg,
        pose.position_sigma_m,
        None if pose.gnss is None else pose.gnss.hdop,
        None if pose.gnss is None else pose.gnss.satellites,
    )


def tagged(data: bytes, where: Place) -> bytes:
    """A copy of a file with its position. Raises ExifError for an unknown format or a damaged file."""
    try:
        if data[:4] in (b"II*\0", b"MM\0*"):
            return _tiff(data, where)
        if data[:2] == bytes((0xFF, _SOI)):
            return _jpeg(data, where)
        if data.startswith(png_files.SIGNATURE):
            return _png(data, where)
        if data.startswith(_RAF):
            offset, length = struct.unpack_from(">II", data, _RAF_JPEG)
            return _with_preview(data, _jpeg(data[offset : offset + length], where))
    except (struct.error, IndexError) as error:
        raise ExifError(f"its EXIF is damaged ({error}): no position can be written into a copy") from None
    raise ExifError("it is not a TIFF-like raw, TIFF, JPEG, PNG or RAF: only the sidecar has its position")


def _with_preview(data: bytes, preview: bytes) -> bytes:
    """A RAF with another preview, behind all else. ExifTool takes no file for a RAF whose preview's offset has bit 15
    set (ProcessRAF)."""
    at = -(-len(data) // _RAF_ALIGNED) * _RAF_ALIGNED
    if at & _RAF_NOT_SET:
        at = (at | _RAF_NOT_SET - 1) + 1
    header = data[:_RAF_JPEG] + struct.pack(">II", at, len(preview))
    return header + data[_RAF_JPEG + 8 :].ljust(at - len(header), b"\0") + preview


def _tiff(data: bytes, where: Place) -> bytes:
    order = "<" if data[:2] == b"II" else ">"
    return with_directory(data, _GPS_IFD, _entries(order, where))


def with_directory(data: bytes, tag: int, inner: Sequence[Entry], first_too: Sequence[Entry] = ()) -> bytes:
    """A TIFF whose first directory has these entries besides its own, and points to a further directory by `tag`.

    Both are appended, sorted by their tags. Raises struct.error and IndexError for a damaged TIFF."""
    order = "<" if data[:2] == b"II" else ">"
    (first,) = struct.unpack_from(order + "I", data, 4)
    (count,) = struct.unpack_from(order + "H", data, first)
    body = data[first + 2 : first + 2 + 12 * count + 4]
    if len(body) != 12 * count + 4:
        raise IndexError("its first directory is cut off")
    entries = [body[12 * i : 12 * i + 12] for i in range(count)]
    new = {tag, *(entry[0] for entry in first_too)}
    kept = [entry for entry in entries if struct.unpack_from(order + "H", entry)[0] not in new]
    data += b"\0" * (len(data) % 2)
    pointer = struct.pack(order + "HHII", tag, _LONG, 1, len(data))
    data += directory(order, len(data), sorted(inner))
    rows, values = _rows(order, len(data), first_too)
    data += values
    kept = sorted([*kept, *rows, pointer], key=lambda entry: int(struct.unpack_from(order + "H", entry)[0]))
    made = struct.pack(order + "H", len(kept)) + b"".join(kept) + body[-4:]
    return data[:4] + struct.pack(order + "I", len(data)) + data[8:] + made


def _jpeg(data: bytes, where: Place) -> bytes:
    """APP1 stays where it was; a new one follows the start and a JFIF header. Fill bytes (any number of FF before a
    marker) stay."""
    at, insert = 2, 2
    while data[at] == 0xFF:
        marker = at + len(_FILL.match(data, at)[0]) - 1  # type: ignore[index]  # one is there
        if data[marker + 1] in (_SOS, 0xD9):
            break
        (length,) = struct.unpack_from(">H", data, marker + 2)
        end = marker + 2 + length
        if data[marker + 1] == _APP1 and data[marker + 4 : marker + 10] == _EXIF:
            return data[:marker] + _segment(_tiff(data[marker + 10 : end], where)) + data[end:]
        if at == 2 and data[marker + 1] == _APP0:
            insert = end
        at = end
    return data[:insert] + _segment(_tiff(EMPTY, where)) + data[insert:]


def _png(data: bytes, where: Place) -> bytes:
    """The eXIf chunk (PNG 1.5 extensions) stays in its place; a new one precedes the pixels. No other byte changes."""
    at, first = len(png_files.SIGNATURE), dict[bytes, tuple[int, int]]()
    while b"IEND" not in first and at + 12 <= len(data):
        end = at + 12 + int(struct.unpack_from(">I", data, at)[0])
        first.setdefault(data[at + 4 : at + 8], (at, end))
        at = end
    if at > len(data) or not {b"IDAT", b"IEND"} <= first.keys():
        raise ExifError("the PNG is cut short: no position can be written into a copy")
    pixels, _ = first[b"IDAT"]
    start, end = first.get(b"eXIf", (pixels, pixels))
    present = data[start + 8 : end - 4] if start < end else EMPTY
    return data[:start] + png_files.chunk(b"eXIf", _tiff(present, where)) + data[end:]


def _segment(tiff: bytes) -> bytes:
    if len(tiff) + 8 > _SEGMENT:
        raise ExifError("its EXIF has no room left for a position: only the sidecar has it")
    return struct.pack(">BBH", 0xFF, _APP1, len(tiff) + 8) + _EXIF + tiff


def directory(order: str, start: int, entries: Sequence[Entry]) -> bytes:
    """An image file directory for the offset `start`, followed by its longer values."""
    rows, values = _rows(order, start + 2 + 12 * len(entries) + 4, entries)
    return struct.pack(order + "H", len(entries)) + b"".join(rows) + bytes(4) + values


def text_entry(tag: int, words: str) -> Entry:
    """An entry of ASCII, other letters as question marks."""
    coded = words.encode("ascii", "replace") + b"\0"
    return tag, _ASCII, len(coded), coded


def ratio_entry(tag: int, above: int, below: int) -> Entry:
    """A fraction in a little-endian file."""
    return tag, _RATIONAL, 1, struct.pack("<II", above, below)


def _rows(order: str, behind: int, entries: Sequence[Entry]) -> tuple[list[bytes], bytes]:
    """The entries' rows, and their longer values, which begin at the offset `behind`."""
    rows, values = [], b""
    for tag, kind, count, value in entries:
        if len(value) <= 4:
            field = value.ljust(4, b"\0")
        else:
            field = struct.pack(order + "I", behind + len(values))
            values += value + b"\0" * (len(value) % 2)
        rows.append(struct.pack(order + "HHI", tag, kind, count) + field)
    return rows, values


def _entries(order: str, where: Place) -> list[Entry]:
    """(tag, type, count, value) in the order of their tags (EXIF 2.3, GPS attributes)."""

    def ratios(*parts: tuple[int, int]) -> bytes:
        return b"".join(struct.pack(order + "II", *part) for part in parts)

    def angle(degrees: float) -> bytes:
        units = round(abs(degrees) * 3600 * 10**6)
        minutes, rest = divmod(units, 60 * 10**6)
        return ratios((minutes // 60, 1), (minutes % 60, 1), (rest, 10**6))

    entries: list[Entry] = [
        (0x00, _BYTE, 4, bytes((2, 3, 0, 0))),
        (0x01, _ASCII, 2, b"S\0" if where.latitude_deg < 0 else b"N\0"),
        (0x02, _RATIONAL, 3, angle(where.latitude_deg)),
        (0x03, _ASCII, 2, b"W\0" if where.longitude_deg < 0 else b"E\0"),
        (0x04, _RATIONAL, 3, angle(where.longitude_deg)),
        (0x05, _BYTE, 1, bytes((where.altitude_m < 0,))),
        (0x06, _RATIONAL, 1, ratios((round(abs(where.altitude_m) * 1000), 1000))),
        text_entry(0x12, "WGS-84"),
    ]
    if where.utc_ns is not None:
        taken = datetime.fromtimestamp(where.utc_ns // 10**9, UTC)
        seconds = (taken.second * 10**6 + where.utc_ns % 10**9 // 1000, 10**6)
        entries.append((0x07, _RATIONAL, 3, ratios((taken.hour, 1), (taken.minute, 1), seconds)))
        entries.append(text_entry(0x1D, taken.strftime("%Y:%m:%d")))
    if where.satellites is not None:
        entries.append(text_entry(0x08, str(where.satellites)))
    if where.dop is not None:
        entries.append((0x0B, _RATIONAL, 1, ratios((round(where.dop * 100), 100))))
    if where.direction_deg is not None:
        entries.append((0x10, _ASCII, 2, b"T\0"))
        entries.append((0x11, _RATIONAL, 1, ratios((round(where.direction_deg * 100) % 36000, 100))))
    if where.error_m is not None:
        entries.append((0x1F, _RATIONAL, 1, ratios((round(where.error_m * 1000), 1000))))
    return entries
