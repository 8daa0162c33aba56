"""Write a raw file that LibRaw opens: an uncompressed DNG with one Bayer plane and the EXIF of the shot.

No library is used, because the EXIF values must be in their own directory, as in files of real cameras. Adobe DNG 1.4,
TIFF 6, EXIF 2.3; little endian.
"""

from __future__ import annotations

import struct
from dataclasses import dataclass
from datetime import UTC, datetime
from fractions import Fraction

import numpy as np
from numpy.typing import NDArray

from dappled.products.geotags.exif_gps import Entry, directory, text_entry

BYTE, ASCII, SHORT, LONG, RATIONAL, UNDEFINED, SRATIONAL = 1, 2, 3, 4, 5, 7, 10
COLOUR_FILTERS, LINEAR_RAW = 32803, 34892
_OF_COLOUR = {33421, 33422, 50710, 50711, 50721, 50728, 50778}  # tags of a colour filter array and its colours
RGGB = bytes((0, 1, 1, 2))
# XYZ to linear sRGB: the simulated sensor has sRGB's primaries.
COLOUR_MATRIX = (3.2406, -1.5372, -0.4986, -0.9689, 1.8758, 0.0415, 0.0557, -0.2040, 1.0570)


@dataclass(frozen=True, slots=True)
class Exif:
    """What a camera body records about a shot. `taken_utc_ns` is cut to whole seconds, as bodies do."""

    make: str
    model: str
    serial: str
    focal_length_mm: float
    f_number: float
    exposure_s: float
    iso: int
    taken_utc_ns: int


def encode(raw: NDArray[np.uint16], *, black: int, white: int, exif: Exif, mono: bool = False) -> bytes:
    """A DNG file of an RGGB plane (H, W), or of one without colours. Raises ValueError for a plane of another shape."""
    if raw.ndim != 2 or raw.shape[0] % 2 or raw.shape[1] % 2:
        raise ValueError(f"a Bayer plane has two even sides, not shape {raw.shape}")
    height, width = raw.shape
    taken = datetime.fromtimestamp(exif.taken_utc_ns // 1_000_000_000, UTC).strftime("%Y:%m:%d %H:%M:%S")

    def folder(strip: int, exif_at: int) -> list[Entry]:
        entries = [
            _numbers(254, LONG, 0),  # NewSubfileType: the main image
            _numbers(256, LONG, width),
            _numbers(257, LONG, height),
            _numbers(258, SHORT, 16),  # BitsPerSample
            _numbers(259, SHORT, 1),  # Compression: none
            _numbers(262, SHORT, LINEAR_RAW if mono else COLOUR_FILTERS),  # Photometric
            text_entry(271, exif.make),
            text_entry(272, exif.model),
            _numbers(273, LONG, strip),
            _numbers(274, SHORT, 1),  # Orientation
            _numbers(277, SHORT, 1),  # SamplesPerPixel
            _numbers(278, LONG, height),  # RowsPerStrip
            _numbers(279, LONG, raw.size * 2),  # StripByteCounts
            _numbers(284, SHORT, 1),  # PlanarConfiguration
            text_entry(305, "dappled simulator"),
            text_entry(306, taken),
            _numbers(33421, SHORT, 2, 2),  # CFARepeatPatternDim
            (33422, BYTE, 4, RGGB),  # CFAPattern
            _numbers(34665, LONG, exif_at),  # the EXIF folder
            (50706, BYTE, 4, bytes((1, 4, 0, 0))),  # DNGVersion
            (50707, BYTE, 4, bytes((1, 1, 0, 0))),  # DNGBackwardVersion
            text_entry(50708, f"{exif.make} {exif.model}"),  # UniqueCameraModel
            (50710, BYTE, 3, bytes((0, 1, 2))),  # CFAPlaneColor
            _numbers(50711, SHORT, 1),  # CFALayout: rectangular
            _numbers(50714, SHORT, black),
            _numbers(50717, SHORT, white),
            _fractions(50721, SRATIONAL, *(Fraction(round(c * 10000), 10000) for c in COLOUR_MATRIX)),
            _fractions(50728, RATIONAL, *(Fraction(1),) * 3),  # AsShotNeutral
            _numbers(50778, SHORT, 21),  # CalibrationIlluminant1: D65
        ]
        return [entry for entry in entries if not (mono and entry[0] in _OF_COLOUR)]

    shot = [
        _fractions(33434, RATIONAL, Fraction(exif.exposure_s).limit_denominator(100_000)),
        _fractions(33437, RATIONAL, Fraction(round(exif.f_number * 100), 100)),
        _numbers(34855, SHORT, exif.iso),
        (36864, UNDEFINED, 4, b"0230"),  # ExifVersion
        text_entry(36867, taken),  # DateTimeOriginal
        text_entry(36868, taken),  # DateTimeDigitized
        _fractions(37386, RATIONAL, Fraction(round(exif.focal_length_mm * 10), 10)),
        text_entry(42033, exif.serial),  # BodySerialNumber
    ]
    first = 8
    exif_at = first + len(directory("<", first, folder(0, 0)))
    exif_folder = directory("<", exif_at, shot)
    strip = exif_at + len(exif_folder)
    strip += -strip % 16
    head = struct.pack("<2sHI", b"II", 42, first) + directory("<", first, folder(strip, exif_at)) + exif_folder
    return b"".join((head.ljust(strip, b"\0"), raw.astype("<u2", copy=False).tobytes()))


def _numbers(tag: int, kind: int, *values: int) -> Entry:
    return (tag, kind, len(values), struct.pack(f"<{len(values)}{'H' if kind == SHORT else 'I'}", *values))


def _fractions(tag: int, kind: int, *values: Fraction) -> Entry:
    sign = "i" if kind == SRATIONAL else "I"
    return (tag, kind, len(values), b"".join(struct.pack(f"<2{sign}", v.numerator, v.denominator) for v in values))
