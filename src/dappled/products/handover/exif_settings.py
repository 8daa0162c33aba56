"""EXIF's entries of how a picture was taken, and TIFF and JPEG to put them into."""

from __future__ import annotations

import io
import struct
from dataclasses import dataclass
from typing import Any

import numpy as np
import tifffile
from numpy.typing import NDArray

from dappled import __version__
from dappled.encoded_pictures import file_of
from dappled.products.geotags.exif_gps import Entry, ratio_entry, text_entry

EXIF_IFD = 0x8769
UNDEFINED = 7
_SHORT, _FILM_MM, _PER_CM = 3, 36.0, 10 * 10**4


@dataclass(frozen=True, slots=True)
class ExifSettings:
    """How a picture was taken; what is None, 0 or "" is unknown. `taken` is "YYYY:MM:DD HH:MM:SS", `fraction` the
    digits after it; `px_per_mm` are pixels of the picture on the chip across and down, of `columns` across."""

    make: str | None
    model: str | None
    taken: str = ""
    fraction: str = ""
    exposure_s: float | None = None
    f_number: float | None = None
    iso: float | None = None
    focal_length_mm: float | None = None
    px_per_mm: tuple[float, float] = (0.0, 0.0)
    columns: int = 1

    def entries(self) -> tuple[list[Entry], list[Entry]]:
        """Entries of the first directory and of EXIF 2.31's, little endian; unknown ones are left out."""
        names = ((0x010F, self.make), (0x0110, self.model), (0x0131, f"dappled {__version__}"), (0x0132, self.taken))
        times = ((0x9003, self.taken), (0x9004, self.taken), (0x9291, self.fraction))
        inner: list[Entry] = [(0x9000, UNDEFINED, 4, b"0231")]
        inner += [text_entry(tag, words) for tag, words in times if words]
        if self.exposure_s:
            inner.append(ratio_entry(0x829A, round(self.exposure_s * 1e6), 10**6))
        if self.f_number:
            inner.append(ratio_entry(0x829D, round(self.f_number * 100), 100))
        if self.iso:
            inner.append(short_entry(0x8827, round(self.iso)))
        if self.focal_length_mm:
            across, down = self.px_per_mm
            inner += [
                ratio_entry(0x920A, round(self.focal_length_mm * 1000), 1000),
                ratio_entry(0xA20E, round(across * _PER_CM), 10**4),  # pixels in a centimetre of the chip
                ratio_entry(0xA20F, round(down * _PER_CM), 10**4),
                short_entry(0xA210, 3),
                short_entry(0xA405, round(_FILM_MM * self.focal_length_mm * across / self.columns)),
            ]
        return [text_entry(tag, words) for tag, words in names if words], inner


def short_entry(tag: int, value: int) -> Entry:
    """A number of 16 bits in a little-endian file, or the largest one."""
    return tag, _SHORT, 1, struct.pack("<H", min(65535, value))


def tiff(values: NDArray[Any], *more: tuple[int, int, int, bytes, bool]) -> bytes:
    """A little-endian TIFF of (h, w) or (h, w, 3) values, with `more` entries, as tifffile takes them."""
    buffer, colours = io.BytesIO(), "rgb" if values.ndim == 3 else "minisblack"
    tifffile.imwrite(buffer, values, byteorder="<", photometric=colours, metadata=None, software=False, extratags=more)
    return buffer.getvalue()


def jpeg(values: NDArray[np.uint8], exif: bytes) -> bytes:
    """A JPEG of (h, w) or (h, w, 3) values, as good as the first copy should be, with this EXIF."""
    return file_of(values, "JPEG", quality=95, subsampling=0, exif=exif)
