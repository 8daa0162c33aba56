"""A frame as its file gives it: the sensor's values and how they are exposed, camera and exposure settings from EXIF.

EXIF is read from TIFF-like raws, RAF, JPEG, PNG and TIFF. Zero, infinite and negative values mean "unknown" there, and
are None here.
"""

from __future__ import annotations

import io
import math
import mmap
import re
import struct
from dataclasses import dataclass, fields
from pathlib import Path
from typing import Any, BinaryIO

import numpy as np
from numpy.typing import NDArray
from PIL import Image

from dappled.bounds.pictures import open_picture
from dappled.drivers.raw.exposure_settings import ExposureSettings
from dappled.findings import FRAME, Code, Finding, Subject, finding

RawSource = Path | str | bytes | memoryview | mmap.mmap
Values = NDArray[np.uint8] | NDArray[np.uint16] | NDArray[np.float32] | NDArray[np.float64]

MOST_CLIPPED = 0.01  # of all pixels
WHITE_SHARE = 0.99  # of white: a pixel of so much light is clipped
BLACK_SHARE = 0.004  # of white: a pixel of less light is black
STEPS = 64
_EVERY = 5  # odd, so that the colours of a mosaic take turns
_EXIF_IFD = 0x8769
_MAKE, _MODEL, _DATETIME = 0x010F, 0x0110, 0x0132
_EXPOSURE, _F_NUMBER, _ISO, _TAKEN, _SUBSECONDS, _FOCAL = 0x829A, 0x829D, 0x8827, 0x9003, 0x9291, 0x920A
_MAKER_NOTE, _SHOT_INFO, _TEMPERATURE, _FOOTER = 0x927C, 4, 12, 8
_RAF_JPEG = 84  # offset and length of the embedded JPEG, big-endian, in a Fujifilm RAF header
_BAD = (
    OSError, ValueError, SyntaxError, KeyError, TypeError, IndexError, struct.error, EOFError, ArithmeticError,
    AttributeError, MemoryError, RecursionError,
)  # fmt: skip


def _values(settings: ExposureSettings) -> dict[str, Any]:
    return {one.name: getattr(settings, one.name) for one in fields(ExposureSettings)}


@dataclass(frozen=True, slots=True, kw_only=True)
class RawFile(ExposureSettings):
    """A frame's values and what its file records about them; unknown is None.

    `mosaic` (H, W), uint8, uint16 or float, the visible part of the sensor, a copy. `black` and `white` in the same
    units; `black` is one number, or one for each colour index. `cfa` is an int array (a, b) of colour indices that
    repeats over the mosaic from its pixel (0, 0), or None for a single colour; `colour_names[i]` names index i.
    `balance` are the file's own white balance gains by colour index, green 1. `developed` says by
    what it is known that a camera or a program has bent the values, None where nothing tells.
    """

    mosaic: Values
    black: float | tuple[float, ...]
    white: float
    cfa: NDArray[np.int64] | None
    colour_names: tuple[str, ...]
    balance: tuple[float, ...] | None
    developed: Finding | None = None

    @classmethod
    def of(cls, settings: ExposureSettings, mosaic: Values, **known: Any) -> RawFile:
        """Make a frame of these values and exposure settings; `known` are the other fields."""
        return cls(mosaic=mosaic, **_values(settings), **known)

    def levels(self) -> dict[str, Any]:
        """Return what makes the mosaic linear, as plain values: colour pattern, black level of each place, white.

        `cfa` holds the rows of the pattern in letters, as ["RG", "GB"], None for a single colour; `black` its levels in
        the same rows, [[level]] for a single colour.
        """
        by_index = np.broadcast_to(np.asarray(self.black, dtype=np.float64), (max(1, len(self.colour_names)),))
        if self.cfa is None:
            return {"cfa": None, "black": [[float(by_index[0])]], "white_level": self.white}
        rows = ["".join(self.colour_names[index] for index in row) for row in self.cfa.tolist()]
        return {"cfa": rows, "black": by_index[self.cfa].tolist(), "white_level": self.white}

    def exposure_settings(self) -> ExposureSettings:
        """Return camera and exposure alone."""
        return ExposureSettings(**_values(self))

    def colour_pattern(self) -> tuple[NDArray[np.int64] | None, float | tuple[float, ...]]:
        """Return colour pattern and black levels, with both greens as one colour where their black levels agree.

        LibRaw gives a Bayer pattern's second green an index of its own; it is then no longer the commonest colour.
        """
        if self.cfa is None:
            return None, self.black
        levels = self.black if isinstance(self.black, tuple) else (self.black,) * len(self.colour_names)
        first = [self.colour_names.index(name) for name in self.colour_names]
        if any(levels[index] != levels[one] for index, one in enumerate(first)):
            return self.cfa, self.black
        return np.array(first, dtype=np.int64)[self.cfa], self.black


@dataclass(frozen=True, slots=True)
class Exposure:
    """`histogram`: shares of the pixels in STEPS equal steps of the square root of the linear value, black to white.
    `clipped_share` of them are white, `black_share` black; `mean_share` is the mean as a share of white."""

    histogram: tuple[float, ...]
    clipped_share: float
    mean_share: float
    black_share: float


def shares_of_white(raw: RawFile, every: int) -> NDArray[np.float32]:
    """One pixel of `every` × `every`, linear: 0 is black, 1 is white."""
    black = float(np.mean(raw.black))
    values = raw.mosaic[::every, ::every].astype(np.float32)
    return np.asarray((values - black) / (raw.white - black))


def exposure(raw: RawFile, every: int = _EVERY) -> Exposure:
    """Measure one pixel of `every` × `every`."""
    share = shares_of_white(raw, every)
    steps = np.minimum(np.sqrt(np.clip(share, 0, 1)) * STEPS, STEPS - 1).astype(np.uint8)
    counts = np.bincount(steps.ravel(), minlength=STEPS)
    shares = tuple(float(one) for one in counts / share.size)
    clipped, black = (float(np.mean(found)) for found in (share >= WHITE_SHARE, share < BLACK_SHARE))
    return Exposure(shares, clipped, float(np.mean(share)), black)


def not_linear(raw: RawFile, exposed: Exposure, *, masked: bool = True, of: Subject = FRAME) -> list[Finding]:
    """Return why a frame's values do not follow the light; empty where nothing speaks against it. Behind
    lenslets, not `masked`, what is clipped spoils its own place alone."""
    found = []
    if raw.developed:
        found.append(finding(Code.FRAME_DEVELOPED, of, why=raw.developed))
    if masked and exposed.clipped_share > MOST_CLIPPED:
        found.append(finding(Code.FRAME_CLIPPED, of, share=exposed.clipped_share))
    return found


def read_exif(file: BinaryIO) -> ExposureSettings:
    """Read the EXIF of an open file, from its start. Damaged or missing EXIF is not an error: its values are None."""
    try:
        start = file.read(16)
        file.seek(0)
        if start.startswith(b"FUJIFILMCCD-RAW"):
            file.seek(_RAF_JPEG)
            offset, length = struct.unpack(">II", file.read(8))
            file.seek(offset)
            return _from(open_picture(io.BytesIO(file.read(length))).getexif())
        if start[:4] in (b"II*\0", b"MM\0*"):
            exif = Image.Exif()
            exif.load_from_fp(file)
            return _from(exif)
        image = open_picture(file)
        if image.format == "PNG" and "exif" not in image.info:
            return ExposureSettings()  # getexif would unpack all pixels to look behind them
        return _from(image.getexif())
    except _BAD:
        return ExposureSettings()  # a frame without EXIF is still a frame


def _from(exif: Image.Exif) -> ExposureSettings:
    try:
        detail = exif.get_ifd(_EXIF_IFD)
    except _BAD:
        detail = {}
    return ExposureSettings(
        make=_text(exif.get(_MAKE)),
        model=_text(exif.get(_MODEL)),
        focal_length_mm=positive(detail.get(_FOCAL, exif.get(_FOCAL))),
        f_number=positive(detail.get(_F_NUMBER, exif.get(_F_NUMBER))),
        exposure_s=positive(detail.get(_EXPOSURE, exif.get(_EXPOSURE))),
        iso=positive(detail.get(_ISO, exif.get(_ISO))),
        taken=_time(detail.get(_TAKEN) or exif.get(_TAKEN) or exif.get(_DATETIME), detail.get(_SUBSECONDS)),
        focal_sigma_mm=_rounding(detail.get(_FOCAL, exif.get(_FOCAL))),
        temperature_c=_canon_temperature_c(detail.get(_MAKER_NOTE)),
    )


def _canon_temperature_c(note: object) -> float | None:
    """The temperature inside a Canon EOS body: number 12 of ShotInfo in its maker note, 0 for unknown, less 128.

    The note is a TIFF directory, whose offsets count from the file's header; its last eight bytes, "II*\\0" and a
    number, say at which offset the body wrote it.
    """
    if not (isinstance(note, bytes) and len(note) > _FOOTER and note[-_FOOTER:-4] == b"II*\0"):
        return None
    (begins,) = struct.unpack("<I", note[-4:])
    for at in range(2, 2 + 12 * min(struct.unpack("<H", note[:2])[0], (len(note) - 2) // 12), 12):
        tag, kind, count, offset = struct.unpack("<HHII", note[at : at + 12])
        if (tag, kind) == (_SHOT_INFO, 3) and count > _TEMPERATURE:
            place = offset - begins + 2 * _TEMPERATURE
            raw = note[place : place + 2] if place >= 0 else b""
            value = int.from_bytes(raw, "little", signed=True) if len(raw) == 2 else 0
            return float(value - 128) if 0 < value < 256 else None
    return None


def _rounding(focal: object) -> float | None:
    """Return half of the last decimal that a body writes: 0.5 mm for 33/1, 0.05 mm for 148/10, not below 0.05 mm.

    Bodies step their zoom more coarsely than finer fractions suggest. None for an unknown length.
    """
    if positive(focal) is None:
        return None
    denominator = getattr(focal, "denominator", 1)
    return 0.5 if denominator == 1 else 0.05


def positive(value: object) -> float | None:
    """Return a number above zero, else None. Of several numbers the first counts."""
    if isinstance(value, tuple | list):
        value = value[0] if value else None
    try:
        number = float(value)  # type: ignore[arg-type]  # EXIF may hold anything; what is not a number is caught
    except (TypeError, ValueError, ZeroDivisionError, OverflowError):
        return None
    return number if math.isfinite(number) and number > 0 else None


def _text(value: object) -> str | None:
    if isinstance(value, bytes):
        value = value.decode("ascii", "replace")
    return (value.split("\0")[0].strip() or None) if isinstance(value, str) else None


def _time(value: object, subseconds: object) -> str | None:
    match = re.match(r"(\d{4}):(\d\d):(\d\d) (\d\d:\d\d:\d\d)", _text(value) or "")
    if match is None or match[1] == "0000":
        return None
    fraction = _text(subseconds) or ""
    return f"{match[1]}-{match[2]}-{match[3]}T{match[4]}" + (
        f".{fraction}" if fraction.isascii() and fraction.isdigit() else ""
    )
