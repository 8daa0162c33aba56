"""Lytro's own files: containers (.lfp, .lfr) and bare packed sensors (.raw), of the first camera and of the Illum.

A container is a table in JSON that names other parts by their SHA-1: one part is the packed mosaic, another the
metadata that says how it is packed. Layout and packing as in LFToolbox and lfpsplitter. A bare file holds pixels only:
its metadata lies beside it, or its size says which camera made it. Every error is a ValueError with a sentence.
"""

from __future__ import annotations

import math
import os
import re
from collections import deque
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any, BinaryIO

import numpy as np
from numpy.typing import NDArray

from dappled.bounds.parsing import MOST_BYTES, parse_json, read_bytes
from dappled.drivers.raw.exposure_settings import ExposureSettings
from dappled.drivers.raw.raw_file import RawFile, RawSource

START = b"\x89LFP\r\n\x1a\n"
_PART = re.compile(rb"\x89LF[A-Z]\r\n\x1a\n")
_HEAD = 16  # start, version and length, both big-endian
_NAME = 80  # of a part: "sha1-…", filled with zeros
_MOST_PARTS = 10_000
_MOST_PIXELS = 200_000_000
_COLOURS = ("r", "gr", "b", "gb")
_NAMES = {"r": "R", "gr": "G", "gb": "G", "b": "B"}

# Bare .raw files name nothing; the cameras' own sizes in bytes tell them apart.
_FIRST = {
    "camera": {"make": "Lytro, Inc.", "model": "F01"},
    "image": {
        "width": 3280,
        "height": 3280,
        "pixelFormat": {"black": dict.fromkeys(_COLOURS, 168), "white": dict.fromkeys(_COLOURS, 4095)},
        "pixelPacking": {"endianness": "big", "bitsPerPixel": 12},
        "mosaic": {"tile": "r,gr:gb,b", "upperLeftPixel": "b"},
    },
}
_ILLUM = {
    "camera": {"make": "Lytro, Inc.", "model": "ILLUM"},
    "image": {
        "width": 7728,
        "height": 5368,
        "pixelFormat": {"black": dict.fromkeys(_COLOURS, 64), "white": dict.fromkeys(_COLOURS, 1023)},
        "pixelPacking": {"endianness": "little", "bitsPerPixel": 10},
        "mosaic": {"tile": "r,gr:gb,b", "upperLeftPixel": "gr"},
    },
}
_BARE: dict[int, Mapping[str, Any]] = {3280 * 3280 * 3 // 2: _FIRST, 7728 * 5368 * 5 // 4: _ILLUM}


def read_container(data: bytes, *, pixels: bool = True) -> RawFile:
    """The frame of an .lfp or .lfr file; without `pixels` its mosaic has the shape (0, 0).

    Raises ValueError where the file is cut short or holds no raw frame.
    """
    metadata, packed = _parts(data)
    return _frame(metadata, packed if pixels else None)


def find_bare(source: RawSource, file: BinaryIO, *, pixels: bool = True) -> RawFile | None:
    """The frame of a bare .raw file; None where neither metadata beside it nor its size names a Lytro camera.

    Raises ValueError as `read_container`.
    """
    size = file.seek(0, os.SEEK_END)
    file.seek(0)
    metadata = _beside(source) or _BARE.get(size)
    return None if metadata is None else _frame(_imaging(metadata), file.read() if pixels else None)


def _beside(source: RawSource) -> Mapping[str, Any] | None:
    """Return the JSON file beside a bare .raw file, of the same name with .json or .txt; None without."""
    if not isinstance(source, Path | str):
        return None
    for suffix in (".json", ".JSON", ".txt", ".TXT"):
        path = Path(source).with_suffix(suffix)
        if path.is_file():
            metadata = parse_json(read_bytes(path))
            return metadata if isinstance(metadata, dict) else None
    return None


def _parts(data: bytes | memoryview) -> tuple[Mapping[str, Any], memoryview]:
    """Return (metadata, packed pixels)."""
    view = memoryview(data)
    named = dict(_walk(view))
    tables = [table for table in map(_json, named.values()) if table is not None]
    frame = next(
        (found for table in tables for found in _dicts(table) if {"imageRef", "metadataRef"} <= found.keys()), None
    )
    if frame is None:
        raise ValueError("it holds no raw frame, only finished pictures (a stack): take the camera's own file")
    missing = [str(frame[key])[:60] for key in ("metadataRef", "imageRef") if str(frame[key]) not in named]
    if missing:
        raise ValueError(f"its part {missing[0]} is missing; fetch it from the camera again")
    metadata = _json(named[str(frame["metadataRef"])])
    if metadata is None:
        raise ValueError("its metadata is not JSON")
    return _imaging(metadata), named[str(frame["imageRef"])]


def _walk(view: memoryview) -> Iterator[tuple[str, memoryview]]:
    """Yield the parts of a container with their names."""
    if bytes(view[: len(START)]) != START:
        raise ValueError("it is not a Lytro container")
    at = _HEAD
    for _ in range(_MOST_PARTS):
        if at + _HEAD > len(view):
            return
        if _PART.match(view[at : at + 8]) is None:
            raise ValueError(f"its part at byte {at} has no beginning; it may be damaged")
        length = int.from_bytes(view[at + 12 : at + 16], "big")
        name = bytes(view[at + _HEAD : at + _HEAD + _NAME]).split(b"\0")[0].decode("ascii", "replace")
        start = at + _HEAD + _NAME
        if start + length > len(view):
            raise ValueError(f"its part {name or at} ends after the file does; it is cut short")
        yield name, view[start : start + length]
        at = start + length
        at += -at % 16
    raise ValueError("it has too many parts")


def _json(part: memoryview) -> Any:
    """Parse a part that is JSON; None for others."""
    if bytes(part[:1]) != b"{" or len(part) > MOST_BYTES:
        return None
    try:
        return parse_json(bytes(part).rstrip(b"\0"))
    except ValueError:
        return None


def _dicts(value: Any) -> Iterator[Mapping[str, Any]]:
    """Yield all objects in a JSON value, outer ones first."""
    waiting = deque([value])
    while waiting:
        one = waiting.popleft()
        if isinstance(one, dict):
            yield one
            waiting.extend(one.values())
        elif isinstance(one, list):
            waiting.extend(one)


def _imaging(metadata: Any) -> Mapping[str, Any]:
    """Return the object that describes camera and image; calibration files wrap it in others."""
    for found in _dicts(metadata):
        if isinstance(found.get("image"), dict) and "width" in found["image"]:
            return found
    raise ValueError("its metadata doesn't say how wide the image is")


def _frame(metadata: Mapping[str, Any], packed: bytes | memoryview | None) -> RawFile:
    image = metadata["image"]
    details = image.get("rawDetails") if isinstance(image.get("rawDetails"), dict) else image
    width, height = _whole(image, "width"), _whole(image, "height")
    if not 0 < width * height <= _MOST_PIXELS:
        raise ValueError(f"it claims {height} × {width} pixels")
    packing = _object(details, "pixelPacking")
    bits, order = _whole(packing, "bitsPerPixel"), str(packing.get("endianness", "big"))
    corner = str(_object(details, "mosaic").get("upperLeftPixel", ""))
    cfa = _pattern(corner)
    levels = _object(details, "pixelFormat")
    black = _levels(levels, "black")
    white = min(_levels(levels, "white"))
    devices = _maybe(metadata, "devices")
    lens, shutter, clock = (_maybe(devices, key) for key in ("lens", "shutter", "clock"))
    camera = _maybe(metadata, "camera")
    metres = _number(lens.get("focalLength"))
    mosaic = np.empty((0, 0), dtype=np.uint16)
    if packed is not None:
        mosaic = unpacked(packed, width * height, bits, order).reshape(height, width)
    settings = ExposureSettings(
        make=_text(camera.get("make")),
        model=_text(camera.get("model")),
        focal_length_mm=None if metres is None else float(f"{metres * 1e3:.6g}"),
        f_number=_number(lens.get("fNumber")),
        exposure_s=_number(shutter.get("pixelExposureDuration")) or _number(shutter.get("frameExposureDuration")),
        iso=_number(image.get("iso")),
        taken=_time(clock.get("zuluTime")),
    )
    return RawFile.of(
        settings,
        mosaic,
        black=black[0] if len(set(black)) == 1 else black,
        white=white,
        cfa=cfa,
        colour_names=tuple(_NAMES[colour] for colour in _COLOURS),
        balance=_gains(_maybe(_maybe(details, "color") or _maybe(image, "color"), "whiteBalanceGain")),
    )


def unpacked(packed: bytes | memoryview, count: int, bits: int, endianness: str) -> NDArray[np.uint16]:
    """Unpack `count` pixels of 10, 12 or 16 bits. "big": a pixel's higher bits come first, "little": its lower ones.

    Ten bits pack four pixels into five bytes: the four high bytes, then the four pairs of low bits, the first pixel's
    in the byte's low end for "little". Raises ValueError for another packing or too few bytes.
    """
    if endianness not in ("big", "little"):
        raise ValueError(f"its pixels are packed {endianness!r}, neither big nor little")
    group = {10: (4, 5), 12: (2, 3), 16: (1, 2)}.get(bits)
    if group is None:
        raise ValueError(f"its pixels have {bits} bits; known are 10, 12 and 16")
    pixels, size = group
    if count % pixels or count // pixels * size > len(packed):
        raise ValueError(f"its {len(packed)} bytes don't hold {count} pixels of {bits} bits; it is cut short")
    parts = np.frombuffer(packed, np.uint8, count // pixels * size).reshape(-1, size)
    out = np.empty((len(parts), pixels), dtype=np.uint16)
    if bits == 16:
        high, low = (0, 1) if endianness == "big" else (1, 0)
        out[:, 0] = (parts[:, high].astype(np.uint16) << 8) | parts[:, low]
    elif bits == 12:
        first, middle, last = (parts[:, i].astype(np.uint16) for i in range(3))
        if endianness == "big":
            out[:, 0], out[:, 1] = (first << 4) | (middle >> 4), ((middle & 15) << 8) | last
        else:
            out[:, 0], out[:, 1] = first | ((middle & 15) << 8), (middle >> 4) | (last << 4)
    else:
        low_bits = parts[:, 4]
        for i in range(4):
            shift = 2 * i if endianness == "little" else 6 - 2 * i
            out[:, i] = (parts[:, i].astype(np.uint16) << 2) | ((low_bits >> shift) & 3)
    return out.reshape(-1)


def _pattern(corner: str) -> NDArray[np.int64]:
    """Return (2, 2) indices into `_COLOURS`, by the name of the upper left pixel of the tile r,gr:gb,b."""
    tile = np.array([[0, 1], [3, 2]], dtype=np.int64)
    at = {"r": (0, 0), "gr": (0, 1), "gb": (1, 0), "b": (1, 1)}.get(corner)
    if at is None:
        raise ValueError(f"its upper left pixel is {corner!r}; known are r, gr, gb and b")
    return np.roll(tile, (-at[0], -at[1]), axis=(0, 1))


def _levels(levels: Mapping[str, Any], key: str) -> tuple[float, ...]:
    known = _object(levels, key)
    found = [known.get(colour) for colour in _COLOURS]
    if not all(isinstance(level, int | float) and math.isfinite(level) and level >= 0 for level in found):
        raise ValueError(f"its {key} levels are {found}")
    return tuple(float(level) for level in found if level is not None)


def _gains(gains: Mapping[str, Any]) -> tuple[float, ...] | None:
    known = [_number(gains.get(colour)) for colour in _COLOURS]
    green = known[1]
    if green is None or any(gain is None for gain in known):
        return None
    return tuple(gain / green for gain in known if gain is not None)


def _object(parent: Any, key: str) -> Mapping[str, Any]:
    found = _maybe(parent, key)
    if not found:
        raise ValueError(f"its metadata doesn't say {key}")
    return found


def _maybe(parent: Any, key: str) -> Mapping[str, Any]:
    found = parent.get(key) if isinstance(parent, dict) else None
    return found if isinstance(found, dict) else {}


def _whole(parent: Mapping[str, Any], key: str) -> int:
    found = parent.get(key)
    if not isinstance(found, int) or isinstance(found, bool) or not 0 < found < 100_000:
        raise ValueError(f"its {key} is {found!r}")
    return found


def _number(value: Any) -> float | None:
    """Return a number above zero, else None."""
    if isinstance(value, bool) or not isinstance(value, int | float) or not (math.isfinite(value) and value > 0):
        return None
    return float(value)


def _text(value: Any) -> str | None:
    return value.strip() or None if isinstance(value, str) else None


def _time(value: Any) -> str | None:
    match = re.match(r"\d{4}-\d\d-\d\dT\d\d:\d\d:\d\d(\.\d{1,6})?", value) if isinstance(value, str) else None
    return match[0] if match else None
