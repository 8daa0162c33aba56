"""A frame's file as numbers: the sensor's values as they were stored, and what they mean.

What the bytes are decides, not the name: camera raws (RAF, CR2, DNG …) through LibRaw, Lytro's containers, TIFF, PNG,
JPEG and NPY by their own readers. (Lytro's bare .raw files hold nothing but pixels: there the name and the size decide,
or metadata that lies beside them.) Values are not made linear, scaled or balanced here. A colour image has no mosaic;
its values become (R + 2G + B)/4, the mean of a Bayer cell.
"""

from __future__ import annotations

import io
import os
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import BinaryIO

import numpy as np
import rawpy
from PIL import Image, UnidentifiedImageError

from dappled.drivers.raw import exif, libraw, lytro_frames, pictures
from dappled.drivers.raw.exif import Exposure
from dappled.drivers.raw.raw_file import RawFile, Source
from dappled.errors import DappledError

__all__ = ["RawFile", "RawFileError", "Source", "read", "read_metadata"]

_TIFF_STARTS = (b"II*\0", b"MM\0*", b"II+\0", b"MM\0+")


class RawFileError(DappledError):
    """A file can't be read as a frame; one sentence with its name."""


def read(source: Source, name: str | None = None) -> RawFile:
    """Read a frame from a path, or from bytes (`name` stands for the file in error sentences).

    Raises RawFileError when it is missing, empty, truncated, damaged or of a kind that holds no frame.
    """
    label = _label(source, name)
    with _open(source, label) as file, _sentences(label):
        start = file.read(16)
        file.seek(0)
        if start.startswith(b"\x93NUMPY"):
            return pictures.plain(np.load(file, allow_pickle=False), Exposure())
        if start.startswith((b"\x89PNG", b"\xff\xd8\xff")):
            return pictures.read_picture(file)
        if start.startswith(_TIFF_STARTS) and pictures.is_plain_tiff(file, label):
            return pictures.read_tiff(file)
        frame = lytro_frames.find(source, label, file)
        return libraw.read(file) if frame is None else lytro_frames.frame_of(frame)


def read_metadata(source: Source, name: str | None = None) -> Exposure:
    """Camera and exposure alone, without unpacking the pixels (milliseconds). Raises RawFileError as `read` does for
    a file that can't be opened; a file of a kind that has no metadata gives None throughout."""
    label = _label(source, name)
    with _open(source, label) as file, _sentences(label):
        start = file.read(16)
        file.seek(0)
        if start.startswith(b"\x93NUMPY"):
            return Exposure()
        if start.startswith((b"\x89PNG", b"\xff\xd8\xff")):
            Image.open(file)  # refuses what is no picture
            file.seek(0)
            return exif.read(file)
        if start.startswith(_TIFF_STARTS) and pictures.is_plain_tiff(file, label):
            return exif.read(file)
        frame = lytro_frames.find(source, label, file, pixels=False)
        told = exif.read(file) if frame is None else lytro_frames.exposure_of(frame)
        if told.make is not None:
            return told
        file.seek(0)
        return libraw.read_metadata(file)


def _label(source: Source, name: str | None) -> str:
    return name or (str(source) if isinstance(source, Path | str) else "the frame")


@contextmanager
def _open(source: Source, label: str) -> Iterator[BinaryIO]:
    try:
        if isinstance(source, Path | str):
            file: BinaryIO = open(source, "rb")  # noqa: SIM115  closed by the with below
            size = os.fstat(file.fileno()).st_size
        else:
            file = io.BytesIO(source)
            size = len(source)
    except OSError as error:
        raise RawFileError(f"cannot open the frame {label}: {error.strerror}; check the path") from error
    with file:
        if size == 0:
            raise RawFileError(f"the frame {label} is empty; fetch it from the camera again")
        yield file


@contextmanager
def _sentences(label: str) -> Iterator[None]:
    try:
        yield
    except (rawpy.LibRawFileUnsupportedError, UnidentifiedImageError) as error:
        raise RawFileError(
            f"{label} is not a frame that can be read (camera raw, DNG, Lytro, TIFF, PNG, JPEG or NPY), or is cut short"
        ) from error
    except Image.DecompressionBombError as error:
        raise RawFileError(f"{label} claims to be larger than any frame: {error}") from error
    except Exception as error:  # the readers raise whatever damaged bytes lead them into
        raise RawFileError(
            f"{label} can't be read as a frame, it may be damaged or cut short: {_words(error)}"
        ) from error


def _words(error: BaseException) -> str:
    text = error.args[0] if error.args else type(error).__name__
    return text.decode("ascii", "replace") if isinstance(text, bytes) else str(text)
