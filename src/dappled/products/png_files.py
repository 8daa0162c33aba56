"""Write a PNG of 8 or 16 bits strip by strip, and its chunks: Pillow writes neither strips nor 16-bit colours."""

from __future__ import annotations

import struct
import zlib
from collections.abc import Iterable
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

SIGNATURE = b"\x89PNG\r\n\x1a\n"


def chunk(kind: bytes, data: bytes) -> bytes:
    """A chunk with its length and check sum."""
    return struct.pack(">I", len(data)) + kind + data + struct.pack(">I", zlib.crc32(kind + data))


def write(
    path: Path,
    shape: tuple[int, int],
    bits: int,
    strips: Iterable[NDArray[np.unsignedinteger[Any]]],
    *,
    rgb: bool = False,
    more: bytes = b"",
    effort: int = 1,
) -> None:
    """Write a grey or colour picture of `shape` whose strips (rows, columns(, 3)) come from the top; `more` are chunks
    for its head, `effort` is zlib's level. Raises OSError."""
    rows, columns = shape
    packer = zlib.compressobj(effort)
    head = struct.pack(">IIBBBBB", columns, rows, bits, 2 if rgb else 0, 0, 0, 0)
    with path.open("wb") as file:
        file.write(SIGNATURE + chunk(b"IHDR", head) + more)
        for strip in strips:
            raw = (strip.astype(">u2").view(np.uint8) if bits == 16 else strip).reshape(len(strip), -1)
            lines = np.pad(raw, ((0, 0), (1, 0)))  # filter 0 before each line
            if packed := packer.compress(lines.tobytes()):
                file.write(chunk(b"IDAT", packed))
        file.write(chunk(b"IDAT", packer.flush()) + chunk(b"IEND", b""))
