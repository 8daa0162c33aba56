"""A Fujifilm RAF that LibRaw unpacks as a FinePix S5200's: the Super CCD's samples on their native 45° lattice.

Layout as in the bodies' files: a head with three places (JPEG with the EXIF, table of tags, samples), big-endian; the
samples 16 bits, little-endian, row by row.
"""

from __future__ import annotations

import io
import struct
from datetime import UTC, datetime

import numpy as np
from numpy.typing import NDArray
from PIL import Image
from PIL.TiffImagePlugin import IFDRational

from dappled.mocks.body.dng import Exif

SHAPE = (2948, 1856)
WHITE = 15_564
PATTERN = np.array([[2, 0, 2, 0], [1, 1, 1, 1], [0, 2, 0, 2], [1, 1, 1, 1]])  # red 0, green 1, blue 2
_HEAD = 148
_EXIF_IFD = 0x8769


def encode(raw: NDArray[np.uint16], exif: Exif) -> bytes:
    """The file of a mosaic (2948, 1856) in `PATTERN`'s colours. Raises ValueError for another shape."""
    if raw.shape != SHAPE:
        raise ValueError(f"a FinePix S5200 has {SHAPE[0]} × {SHAPE[1]} samples, not {raw.shape}")
    jpeg = _jpeg(exif)
    tags = [
        (0x100, struct.pack(">HH", *SHAPE)),
        (0x121, struct.pack(">HH", 1444, 3696)),
        (0x130, bytes((0x8C, 0, 0, 0))),  # the lattice's direction
        (0x2FF0, struct.pack(">4H", 320, 521, 320, 379)),  # white balance: green, red, green, blue
    ]
    table = struct.pack(">I", len(tags)) + b"".join(struct.pack(">HH", tag, len(v)) + v for tag, v in tags)
    samples = raw.astype("<u2").tobytes()
    at_table = _HEAD + len(jpeg)
    at_samples = at_table + len(table)
    places = (_HEAD, len(jpeg), at_table, len(table), at_samples, len(samples))
    head = b"FUJIFILMCCD-RAW 0201FF389501" + b"FinePix S5200".ljust(32, b"\0") + b"0100"
    head = head.ljust(84, b"\0") + struct.pack(">6I", *places)
    return head.ljust(_HEAD, b"\0") + jpeg + table + samples


def _jpeg(exif: Exif) -> bytes:
    taken = datetime.fromtimestamp(exif.taken_utc_ns // 1_000_000_000, UTC).strftime("%Y:%m:%d %H:%M:%S")
    told = Image.Exif()
    told.endian = "<"  # LibRaw reads the samples in this order, too
    told[0x010F], told[0x0110], told[0x0132] = exif.make, exif.model, taken
    detail = told.get_ifd(_EXIF_IFD)
    detail[0x829A] = IFDRational(round(exif.exposure_s * 1e6), 1_000_000)
    detail[0x829D] = IFDRational(round(exif.f_number * 10), 10)
    detail[0x8827] = exif.iso
    detail[0x9003] = taken
    detail[0x920A] = IFDRational(round(exif.focal_length_mm * 10), 10)
    body = told.tobytes()
    file = io.BytesIO()
    Image.new("RGB", (64, 48), (90, 100, 90)).save(file, "JPEG")
    # LibRaw looks for the EXIF twelve bytes on: before the JFIF segment that Pillow begins with.
    return b"\xff\xd8\xff\xe1" + struct.pack(">H", len(body) + 2) + body + file.getvalue()[2:]
