"""Read a frame's file: the sensor's values as they are stored, and what they mean.

The content decides how a file is read, not its name: camera raws (RAF, CR2, DNG …) through LibRaw; Lytro's containers,
TIFF, PNG, JPEG and NPY by readers of their own. (Lytro's bare .raw files hold only pixels: for them the name and the
size decide, or metadata that lies beside them.) Values are not made linear, scaled or balanced here. A colour image has
no mosaic; its values become (R + 2G + B)/4, the mean of a Bayer cell.
"""

from __future__ import annotations

import io
import os
import traceback
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import replace
from datetime import datetime
from pathlib import Path
from typing import Any, BinaryIO

import numpy as np
import rawpy
import tifffile
from numpy.typing import NDArray
from PIL import Image, UnidentifiedImageError

from dappled.bounds.arrays import read_npy
from dappled.bounds.claims import ClaimError
from dappled.bounds.parsing import check_stored
from dappled.bounds.pictures import FREE_PIXELS, check_pixels, check_tiff_page, open_picture
from dappled.drivers.raw import lytro
from dappled.drivers.raw.exposure_settings import ExposureSettings
from dappled.drivers.raw.raw_file import RawFile, RawSource, positive, read_exif
from dappled.durable import plain_file
from dappled.errors import DappledError
from dappled.findings import FRAME, Code, Finding, finding

_TIFF_STARTS = (b"II*\0", b"MM\0*", b"II+\0", b"MM\0+")
_DNG_VERSION, _MAX_SAMPLE = 50706, 281  # TIFF tags
_LINEAR_FROM = 0.95  # a PNG's gamma: 1 is linear, 0.45455 is usual


class UnfitFileError(ValueError):
    """A file is whole, and what it holds is no frame."""


def read(source: RawSource, name: str | None = None) -> RawFile:
    """Read a frame from a path, or from bytes (`name` stands for the file in error sentences).

    Raises DappledError when it is missing, empty, truncated, damaged or of a kind that holds no frame.
    """
    label = _label(source, name)
    with _open(source, label) as file, _sentences(label):
        start = file.read(16)
        file.seek(0)
        if start.startswith(b"\x93NUMPY"):
            return _plain(read_npy(file, _length(file), "array"), ExposureSettings())
        if start.startswith((b"\x89PNG", b"\xff\xd8\xff")):
            return _read_picture(file)
        if start.startswith(_TIFF_STARTS) and _is_plain_tiff(file, label):
            return _read_tiff(file)
        frame = _find_lytro(source, label, file, start)
        return _read_libraw(file) if frame is None else frame


def read_metadata(source: RawSource, name: str | None = None) -> ExposureSettings:
    """Read camera and exposure alone, without unpacking the pixels (milliseconds).

    A kind of file without metadata gives None throughout. Raises DappledError as `read` does.
    """
    label = _label(source, name)
    with _open(source, label) as file, _sentences(label):
        start = file.read(16)
        file.seek(0)
        if start.startswith(b"\x93NUMPY"):
            return ExposureSettings()
        if start.startswith((b"\x89PNG", b"\xff\xd8\xff")):
            open_picture(file)  # raises for a file that is not a picture
            file.seek(0)
            return read_exif(file)
        if start.startswith(_TIFF_STARTS) and _is_plain_tiff(file, label):
            return read_exif(file)
        frame = _find_lytro(source, label, file, start, pixels=False)
        settings = read_exif(file) if frame is None else frame.exposure_settings()
        if settings.make is not None:
            return settings
        file.seek(0)
        return _read_libraw_settings(file)


def _find_lytro(source: RawSource, label: str, file: BinaryIO, start: bytes, *, pixels: bool = True) -> RawFile | None:
    """Read a Lytro container, or a bare file that is named .raw; None for other files."""
    if start.startswith(lytro.START):
        return lytro.read_container(file.read(), pixels=pixels)
    return lytro.find_bare(source, file, pixels=pixels) if label.lower().endswith(".raw") else None


def _label(source: RawSource, name: str | None) -> str:
    return name or (str(source) if isinstance(source, Path | str) else "the frame")


@contextmanager
def _open(source: RawSource, label: str) -> Iterator[BinaryIO]:
    try:
        if isinstance(source, Path | str):
            file: BinaryIO = open(source, "rb", opener=plain_file)  # noqa: SIM115  closed by the with below
        else:
            file = io.BytesIO(source)
    except OSError as error:
        raise DappledError(f"cannot open the frame {label}: {error.strerror}; check the path") from error
    with file:
        try:
            size = _length(file) if isinstance(file, io.BytesIO) else check_stored(file.fileno())
        except ClaimError as error:
            raise DappledError(_sentence(label, error)) from error
        if size == 0:
            raise DappledError(f"the frame {label} is empty; fetch it from the camera again")
        yield file


@contextmanager
def _sentences(label: str) -> Iterator[None]:
    """Word whatever a reader raises. What its frames hold goes at once: the whole file, which the error would keep."""
    try:
        yield
    except Exception as error:  # the readers raise anything on damaged bytes
        traceback.clear_frames(error.__traceback__)
        raise DappledError(_sentence(label, error)) from error


def _sentence(label: str, error: Exception) -> str:
    """Why a file can't be read as a frame."""
    match error:
        case rawpy.LibRawFileUnsupportedError() | UnidentifiedImageError():
            kinds = "camera raw, DNG, Lytro, TIFF, PNG, JPEG or NPY"
            return f"{label} is not a frame that can be read ({kinds}), or is cut short"
        case ClaimError() | UnfitFileError():
            return f"{label} can't be read as a frame: {error}"
        case MemoryError():
            return f"{label} needs more memory than is free: close other programs"
        case _:
            return f"{label} can't be read as a frame, it may be damaged or cut short: {_words(error)}"


def _length(file: BinaryIO) -> int:
    size = file.seek(0, os.SEEK_END)
    file.seek(0)
    return size


def _words(error: BaseException) -> str:
    text = error.args[0] if error.args else type(error).__name__
    return text.decode("ascii", "replace") if isinstance(text, bytes) else str(text)


# --- camera raws (RAF, CR2, DNG …), through LibRaw


def _read_libraw(file: BinaryIO) -> RawFile:
    """Read a raw file with a mosaic. Raises what LibRaw and EXIF raise, and UnfitFileError for one without."""
    stored = _length(file)
    with rawpy.imread(file) as raw:
        if (size := (raw.sizes.raw_width, raw.sizes.raw_height))[0] * size[1] > FREE_PIXELS:
            check_pixels(size, 2, stored)
        if raw.raw_type != rawpy.RawType.Flat:
            raise UnfitFileError("it holds no mosaic (linear or demosaiced raws have no masked light field to decode)")
        mosaic = np.array(raw.raw_image_visible)
        cfa = None if raw.num_colors == 1 or raw.raw_pattern is None else _visible_pattern(raw)
        count = 1 if cfa is None else int(cfa.max()) + 1
        blacks = tuple(float(level) for level in raw.black_level_per_channel[:count])
        names = "W" if cfa is None else raw.color_desc.decode("ascii", "replace")[:count]
        return RawFile.of(
            _libraw_settings(file, raw),
            mosaic,
            black=blacks[0] if len(set(blacks)) == 1 else blacks,
            white=float(raw.white_level),
            cfa=cfa,
            colour_names=tuple(names),
            balance=None if cfa is None else _balance(raw.camera_whitebalance, names),
        )


def _read_libraw_settings(file: BinaryIO) -> ExposureSettings:
    """Read camera and exposure. Raises what LibRaw raises."""
    with rawpy.imread(file) as raw:
        return _libraw_settings(file, raw)


def _libraw_settings(file: BinaryIO, raw: Any) -> ExposureSettings:
    """Return what EXIF has, and LibRaw's own values where EXIF has none (CRW, ORF variants …)."""
    file.seek(0)
    known = read_exif(file)
    other = raw.other
    stamp = other.timestamp
    taken = stamp.isoformat() if isinstance(stamp, datetime) and stamp.year > 1970 else None
    return replace(
        known,
        focal_length_mm=known.focal_length_mm or _short(other.focal_length),
        f_number=known.f_number or _short(other.aperture),
        exposure_s=known.exposure_s or _short(other.shutter_speed),
        iso=known.iso or _short(other.iso_speed),
        taken=known.taken or taken,
    )


def _short(value: float) -> float | None:
    """Return LibRaw's single-precision number as the shortest decimal: 14.8, not 14.800000190734863."""
    return positive(str(np.float32(value)))


def _visible_pattern(raw: Any) -> NDArray[np.int64]:
    """Return LibRaw's pattern, which starts at the first masked pixel, as the smallest block that repeats."""
    pattern = np.asarray(raw.raw_pattern, dtype=np.int64)
    visible = np.roll(pattern, (-raw.sizes.top_margin, -raw.sizes.left_margin), axis=(0, 1))

    def period(lines: NDArray[np.int64]) -> int:
        count = len(lines)
        return next(n for n in range(1, count + 1) if count % n == 0 and np.array_equal(lines, np.roll(lines, n, 0)))

    return visible[: period(visible), : period(visible.T)].copy()


def _balance(gains: list[float], names: str) -> tuple[float, ...] | None:
    """Return gains by colour index, green 1. LibRaw gives 0 for a second green that is equal to the first."""
    known = [float(gain) for gain in gains[: len(names)]]
    green = names.find("G")
    if green < 0 or positive(known[green]) is None:
        return None
    filled = [known[green] if name == "G" and gain == 0 else gain for name, gain in zip(names, known, strict=True)]
    if any(positive(gain) is None for gain in filled):
        return None
    return tuple(gain / known[green] for gain in filled)


# --- pictures without a mosaic: PNG, JPEG, TIFF, NPY


def _read_picture(file: BinaryIO) -> RawFile:
    """Read a PNG or a JPEG. Raises what Pillow raises, and UnfitFileError for one that holds no frame."""
    image = open_picture(file)
    developed = _developed(image)
    if image.format == "PNG" and image.mode != "I;16" and _png_is_deep_colour(file):
        raise UnfitFileError(
            "it is a colour PNG of 16 bits, which would lose its lower 8; save it as TIFF or as grey PNG"
        )
    if image.mode in ("P", "PA", "CMYK", "YCbCr", "LAB", "HSV"):
        image = image.convert("RGB")
    elif image.mode in ("1", "LA"):
        image = image.convert("L")
    values = np.asarray(image)
    if values.dtype == np.int32:  # Pillow's mode "I": a 16-bit PNG in some versions
        values = values.astype(np.uint16)
    file.seek(0)
    return replace(_plain(values, read_exif(file)), developed=developed)


def _developed(image: Image.Image) -> Finding | None:
    """By what a picture is known not to be linear; None where its file says nothing of the kind."""
    if image.format == "JPEG":
        return finding(Code.TONES_JPEG, FRAME)
    gamma = image.info.get("gamma")
    if "srgb" in image.info:
        return finding(Code.TONES_SRGB, FRAME)
    if gamma is not None and 0 < gamma < _LINEAR_FROM:
        return finding(Code.TONES_GAMMA, FRAME, inverse=1 / gamma)
    return None


def _png_is_deep_colour(file: BinaryIO) -> bool:
    place = file.tell()
    file.seek(24)  # IHDR: bit depth, colour type
    depth, colour_type = file.read(2)
    file.seek(place)
    return depth == 16 and colour_type in (2, 6)


def _is_plain_tiff(file: BinaryIO, label: str) -> bool:
    """Whether tifffile reads it: it is named a TIFF, and is not a DNG. Others that begin as TIFF are camera raws."""
    if not label.lower().endswith((".tif", ".tiff")):
        return False
    try:
        with tifffile.TiffFile(file) as tiff:
            return _DNG_VERSION not in tiff.pages.first.tags
    finally:
        file.seek(0)


def _read_tiff(file: BinaryIO) -> RawFile:
    """Read the first page of a TIFF. Raises what tifffile raises, and UnfitFileError."""
    with tifffile.TiffFile(file) as tiff:
        page = tiff.pages.first
        check_tiff_page(page, file)
        values = page.asarray()
        tag = page.tags.get(_MAX_SAMPLE)
        limit = positive(None if tag is None else tag.value)
        if page.planarconfig == 2 and values.ndim == 3:
            values = np.moveaxis(values, 0, -1)
    file.seek(0)
    frame = _plain(values, read_exif(file))
    return frame if limit is None or values.dtype.kind != "u" else replace(frame, white=limit)


def _plain(values: NDArray[Any], settings: ExposureSettings) -> RawFile:
    """Make a frame of an array without a mosaic; white is the largest integer of its type, or 1. Raises
    UnfitFileError."""
    if values.dtype.kind == "b":
        values = values.astype(np.uint8) * np.uint8(255)
    kind = values.dtype.kind
    if kind == "f" and values.dtype not in (np.float32, np.float64):  # half or long ones, or of the other byte order
        values = values.astype(np.float32 if values.dtype.itemsize <= 4 else np.float64)
    elif kind in "iu" and values.dtype not in (np.uint8, np.uint16) and values.size:
        low, high = int(values.min()), int(values.max())
        if low < 0 or high > np.iinfo(np.uint16).max:
            raise UnfitFileError(f"its values are {low} to {high}; a frame has 8 or 16 bits unsigned, or floats")
        values = values.astype(np.uint16)
    if values.dtype not in (np.uint8, np.uint16, np.float32, np.float64):
        raise UnfitFileError(f"its values are {values.dtype}; a frame has 8 or 16 bits unsigned, or floats")
    white = 1.0 if values.dtype.kind == "f" else float(np.iinfo(values.dtype).max)
    if values.ndim == 3 and values.shape[2] in (3, 4):
        values = values[..., :3].astype(np.float32) @ np.array([0.25, 0.5, 0.25], dtype=np.float32)
    if values.ndim != 2 or 0 in values.shape:
        raise UnfitFileError(f"its shape is {values.shape}; a frame has rows and columns, and 3 colours at most")
    return RawFile.of(settings, np.array(values), black=0.0, white=white, cfa=None, colour_names=("W",), balance=None)
