"""RAF containers: a header, a JPEG with the EXIF, and the sensor's bytes. Pure."""

from __future__ import annotations

import io
import struct

from PIL import Image

_HEADER = 160
_MAKE, _MODEL, _EXIF = 0x010F, 0x0110, 0x8769
_F_NUMBER, _ISO, _TAKEN, _EXPOSURE, _FOCAL = 0x829D, 0x8827, 0x9003, 0x829A, 0x920A


def raf(
    sensor: bytes,
    *,
    taken: str,
    focal_length_mm: float,
    model: str = "FinePix S5200",
    f_number: float = 3.2,
    exposure_s: float = 1 / 500,
) -> bytes:
    """A RAF of these sensor bytes. `taken` is EXIF's "2026:11:21 10:15:03". Layout: dcraw's parse_fuji."""
    exif = Image.Exif()
    exif[_MAKE], exif[_MODEL] = "FUJIFILM", model
    exif.get_ifd(_EXIF).update(
        {_F_NUMBER: f_number, _ISO: 64, _TAKEN: taken, _EXPOSURE: exposure_s, _FOCAL: focal_length_mm}
    )
    file = io.BytesIO()
    Image.new("L", (16, 12), 128).save(file, "JPEG", exif=exif)
    jpeg = file.getvalue()
    head = b"FUJIFILMCCD-RAW 0201FF389501" + model.encode("ascii")[:31].ljust(32, b"\0")
    at = _HEADER + len(jpeg)
    offsets = struct.pack(">IIIIII", _HEADER, len(jpeg), at, 0, at, len(sensor))
    return head.ljust(84, b"\0") + offsets.ljust(_HEADER - 84, b"\0") + jpeg + sensor
