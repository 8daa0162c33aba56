"""Pictures that claim more than they hold, and kinds of files that are not tried."""

from __future__ import annotations

import io
import struct
import zlib

import numpy as np
import pytest
from PIL import Image, UnidentifiedImageError

from dappled.bounds.claims import ClaimError
from dappled.bounds.pictures import open_picture


def png() -> bytes:
    file = io.BytesIO()
    Image.fromarray(np.arange(12, dtype=np.uint8).reshape(3, 4)).save(file, "PNG")
    return file.getvalue()


def test_an_honest_picture_opens() -> None:
    assert np.asarray(open_picture(io.BytesIO(png()))).shape == (3, 4)


@pytest.mark.parametrize("length", [b"\xff\xff\xff\xff", b"\x7f\xff\xff\xff", b"\x00\x01\x00\x00"])
def test_a_chunk_that_ends_after_the_file(length: bytes) -> None:
    data = png()
    at = data.index(b"IDAT")
    with pytest.raises(ClaimError, match="ends after the file does"):
        open_picture(io.BytesIO(data[: at - 4] + length + data[at:]))


@pytest.mark.parametrize("data", [b"%!PS-Adobe-3.0 EPSF-3.0\n", b"GIF89a", b"BM", b"", b"\x89PNG", b"\xff\xd8\xff\xe0"])
def test_other_kinds_are_not_tried(data: bytes) -> None:
    with pytest.raises(UnidentifiedImageError):
        open_picture(io.BytesIO(data))


def jpeg(between: bytes) -> bytes:
    file = io.BytesIO()
    Image.new("RGB", (16, 16), "red").save(file, "JPEG")
    return file.getvalue()[:2] + between + file.getvalue()[2:]


@pytest.mark.parametrize(
    "between", [b"", b"\xff" * 4000, b"\xff\xe1\0\x08Exif\0\0" * 4000, b"\xff\xfe\xff\xff" + bytes(65533)]
)
def test_a_long_head_of_a_jpeg_opens(between: bytes) -> None:
    assert open_picture(io.BytesIO(jpeg(between))).size == (16, 16)


@pytest.mark.parametrize(
    "between",
    [
        b"\xff" * 1_000_000,
        (b"\xff" * 60 + b"\xe2\0\x02") * 4000,
        b"\xff\xe1\0\x08Exif\0\0" * 100_000,
        b"\xff\xf0\xff\xff" + bytes(1_000_000),  # a marker whose length nobody reads
        b"\xff\xd0" * 100_000,
        b"\xff\0" * 100_000,
    ],
    ids=["fill", "fills", "segments", "extension", "alone", "escaped"],
)
def test_a_head_of_a_jpeg_that_is_made_to_take_time_is_refused(between: bytes) -> None:
    """Pillow takes 4 µs for a byte of it, and more for a segment: minutes for a file that is believed."""
    with pytest.raises(ClaimError, match="made to take time"):
        open_picture(io.BytesIO(jpeg(between)))


def test_a_png_of_empty_chunks_is_refused() -> None:
    chunk = struct.pack(">I4sI", 0, b"tEXt", zlib.crc32(b"tEXt"))
    with pytest.raises(ClaimError, match="made to take time"):
        open_picture(io.BytesIO(png()[:33] + chunk * 300_000 + png()[33:]))
