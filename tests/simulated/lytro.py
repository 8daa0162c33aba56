"""Lytro files for tests and simulations: containers with their JSON parts, and packed pixels."""

from __future__ import annotations

import hashlib
import json
from collections.abc import Mapping
from typing import Any

import numpy as np
from numpy.typing import NDArray

_CORNER = {"bggr": "b", "grbg": "gr", "rggb": "r", "gbrg": "gb"}
_COLOURS = ("r", "gr", "gb", "b")


def metadata(
    shape: tuple[int, int],
    *,
    model: str = "F01",
    bits: int = 12,
    endianness: str = "big",
    pattern: str = "bggr",
    black: int = 168,
    focal_length_m: float = 0.00645,
    nested: bool = True,
) -> dict[str, Any]:
    """What such a camera says of a frame (H, W); `nested`: the raw's details in an object of their own, as the first
    camera has them, and the Illum not."""
    details = {
        "pixelFormat": {
            "rightShift": 0,
            "black": dict.fromkeys(_COLOURS, black),
            "white": dict.fromkeys(_COLOURS, 2**bits - 1),
        },
        "pixelPacking": {"endianness": endianness, "bitsPerPixel": bits},
        "mosaic": {"tile": "r,gr:gb,b", "upperLeftPixel": _CORNER[pattern]},
    }
    colour = {"whiteBalanceGain": {"r": 1.4, "gr": 1.0, "gb": 1.0, "b": 1.2}}
    image: dict[str, Any] = {"width": shape[1], "height": shape[0], "orientation": 1, "iso": 80, "color": colour}
    image |= {"rawDetails": details} if nested else details
    return {
        "camera": {"make": "Lytro, Inc.", "model": model},
        "devices": {
            "lens": {"focalLength": focal_length_m, "fNumber": 2.0},
            "shutter": {"pixelExposureDuration": 0.004},
            "clock": {"zuluTime": "2013-05-04T10:11:12.000Z"},
        },
        "image": image,
    }


def packed(values: NDArray[np.uint16], bits: int, endianness: str) -> bytes:
    """Pixels as the cameras pack them; see `drivers.raw.lytro.unpacked`."""
    flat = values.reshape(-1).astype(np.uint32)
    if bits == 16:
        return flat.astype(">u2" if endianness == "big" else "<u2").tobytes()
    if bits == 12:
        a, b = flat[0::2], flat[1::2]
        if endianness == "big":
            parts = [a >> 4, ((a & 15) << 4) | (b >> 8), b & 255]
        else:
            parts = [a & 255, (a >> 8) | ((b & 15) << 4), b >> 4]
        return np.stack(parts, axis=1).astype(np.uint8).tobytes()
    quads = flat.reshape(-1, 4)
    shifts = np.array([0, 2, 4, 6] if endianness == "little" else [6, 4, 2, 0])
    low = ((quads & 3) << shifts).sum(axis=1)
    return np.column_stack([quads >> 2, low]).astype(np.uint8).tobytes()


def container(values: NDArray[np.uint16], told: Mapping[str, Any], *, frames_key: str = "picture") -> bytes:
    """An .lfp file; `frames_key` "frames" lays the table out as the Illum's .lfr does."""
    image = told["image"]
    packing = image.get("rawDetails", image)["pixelPacking"]
    pixels = packed(values, packing["bitsPerPixel"], packing["endianness"])
    text = json.dumps(told).encode()
    frame = {"metadataRef": _sha1(text), "imageRef": _sha1(pixels), "privateMetadataRef": _sha1(b"{}")}
    table: dict[str, Any] = {"picture": {"frameArray": [{"frame": frame}]}}
    if frames_key == "frames":
        table = {"frames": [{"frame": frame}], "thumbnails": []}
    whole = b"\x89LFP\r\n\x1a\n" + (1).to_bytes(4, "big") + (0).to_bytes(4, "big")
    for kind, data in ((b"M", json.dumps(table).encode()), (b"C", text), (b"C", pixels), (b"C", b"{}")):
        whole += b"\x89LF" + kind + b"\r\n\x1a\n" + (0).to_bytes(4, "big") + len(data).to_bytes(4, "big")
        whole += _sha1(data).encode().ljust(80, b"\0") + data
        whole += b"\0" * (-len(whole) % 16)
    return whole


def _sha1(data: bytes) -> str:
    return "sha1-" + hashlib.sha1(data, usedforsecurity=False).hexdigest()
