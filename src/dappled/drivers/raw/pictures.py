"""Frames that are pictures or arrays, without a mosaic: PNG, JPEG, TIFF, NPY."""

from __future__ import annotations

from dataclasses import replace
from typing import Any, BinaryIO

import numpy as np
import tifffile
from numpy.typing import NDArray
from PIL import Image

from dappled.drivers.raw import exif
from dappled.drivers.raw.exif import Exposure, positive
from dappled.drivers.raw.raw_file import RawFile, made

_DNG_VERSION, _MAX_SAMPLE = 50706, 281


def read_picture(file: BinaryIO) -> RawFile:
    """A PNG or a JPEG. Raises what Pillow raises, and ValueError for one that holds no frame."""
    image: Image.Image = Image.open(file)
    if image.format == "PNG" and image.mode != "I;16" and _png_is_deep_colour(file):
        raise ValueError("it is a colour PNG of 16 bits, which would lose its lower 8; save it as TIFF or as grey PNG")
    if image.mode in ("P", "PA", "CMYK", "YCbCr", "LAB", "HSV"):
        image = image.convert("RGB")
    elif image.mode in ("1", "LA"):
        image = image.convert("L")
    values = np.asarray(image)
    if values.dtype == np.int32:  # Pillow's mode "I": a 16-bit PNG in some versions
        values = values.astype(np.uint16)
    file.seek(0)
    return plain(values, exif.read(file))


def _png_is_deep_colour(file: BinaryIO) -> bool:
    place = file.tell()
    file.seek(24)  # IHDR: bit depth, colour type
    depth, colour_type = file.read(2)
    file.seek(place)
    return depth == 16 and colour_type in (2, 6)


def is_plain_tiff(file: BinaryIO, label: str) -> bool:
    """Whether tifffile should read it: named a TIFF, and no DNG. Other files that begin as TIFF are camera raws."""
    if not label.lower().endswith((".tif", ".tiff")):
        return False
    try:
        with tifffile.TiffFile(file) as tiff:
            if len(tiff.pages) == 0:
                raise ValueError("it has no pages")
            return _DNG_VERSION not in tiff.pages.first.tags
    finally:
        file.seek(0)


def read_tiff(file: BinaryIO) -> RawFile:
    """The first page of a TIFF. Raises what tifffile raises, and ValueError."""
    with tifffile.TiffFile(file) as tiff:
        page = tiff.pages.first
        values = page.asarray()
        tag = page.tags.get(_MAX_SAMPLE)
        limit = positive(None if tag is None else tag.value)
        if page.planarconfig == 2 and values.ndim == 3:
            values = np.moveaxis(values, 0, -1)
    file.seek(0)
    frame = plain(values, exif.read(file))
    return frame if limit is None or values.dtype.kind != "u" else replace(frame, white=limit)


def plain(values: NDArray[Any], exposure: Exposure) -> RawFile:
    """An array without a mosaic: whole numbers reach to their type's largest, floats to 1. Raises ValueError."""
    if values.dtype.kind == "b":
        values = values.astype(np.uint8) * np.uint8(255)
    if values.dtype not in (np.uint8, np.uint16, np.float32, np.float64):
        raise ValueError(f"its values are {values.dtype}; a frame has 8 or 16 bits unsigned, or floats")
    white = 1.0 if values.dtype.kind == "f" else float(np.iinfo(values.dtype).max)
    if values.ndim == 3 and values.shape[2] in (3, 4):
        values = values[..., :3].astype(np.float32) @ np.array([0.25, 0.5, 0.25], dtype=np.float32)
    if values.ndim != 2 or 0 in values.shape:
        raise ValueError(f"its shape is {values.shape}; a frame has rows and columns, and 3 colours at most")
    return made(exposure, np.array(values), black=0.0, white=white, cfa=None, colour_names=("W",), balance=None)
