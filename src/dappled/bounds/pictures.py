"""Open PNG, JPEG and TIFF files whose claimed size was judged first; no other kind is tried."""

from __future__ import annotations

import math
import os
import zlib
from typing import Any, BinaryIO

from PIL import Image, JpegImagePlugin, PngImagePlugin, TiffImagePlugin, UnidentifiedImageError

from dappled.bounds import claims
from dappled.bounds.claims import ClaimError

MOST_PIXELS = 500_000_000
"""Of one picture. Survey cameras have up to 280 million."""
FREE_PIXELS = 32_000_000  # need no proof: a white card packs to nearly nothing
_CHANNELS = {"I;16": 2, "I;16B": 2, "I": 4, "F": 4, "RGB": 3, "RGBA": 4, "CMYK": 4, "YCbCr": 3, "LAB": 3, "LA": 2}
_JPEG = b"\xff\xd8\xff"
_MARKS = (
    (b"\x89PNG", PngImagePlugin.PngImageFile),
    (_JPEG, JpegImagePlugin.JpegImageFile),
    (b"II*\0", TiffImagePlugin.TiffImageFile),
    (b"MM\0*", TiffImagePlugin.TiffImageFile),
)
_DEFLATED = (8, 32946)
_MOST_CHUNKS = 200_000  # of a PNG: 500 million pixels in chunks of 8 kB
_MOST_SEGMENTS, _MOST_LOOSE = 4096, 4096  # of a JPEG's head, and bytes beside them; profiles take some hundred segments
_LAST = (0xD9, 0xDA)  # the end, and the scan, behind which there is no head
_PLAIN = (1, 5, 32773, *_DEFLATED)  # none, LZW, PackBits, deflate: what they unpack to is limited


def open_picture(file: BinaryIO, *, ratio: int = claims.RATIO, free_pixels: int = FREE_PIXELS) -> Image.Image:
    """Open a picture without unpacking its pixels. The file must stay open until they are.

    Raises ClaimError for a size that its bytes don't bear out, UnidentifiedImageError for another kind of file.
    """
    start = file.read(4)
    file.seek(0)
    kind = next((kind for mark, kind in _MARKS if start.startswith(mark)), None)
    if kind is None:
        raise UnidentifiedImageError("it is neither PNG, nor JPEG, nor TIFF")
    if start == b"\x89PNG":
        _check_png_chunks(file)
    elif start.startswith(_JPEG):
        _check_jpeg_head(file)
    try:
        # Not Image.open: its limit of pixels is a global of Pillow, below the size of today's survey cameras.
        picture: Image.Image = kind(file)
    except (SyntaxError, zlib.error) as error:
        raise UnidentifiedImageError(f"it can't be read: {error}") from error
    check_pixels(picture.size, _CHANNELS.get(picture.mode, 1), _length(file), ratio=ratio, free_pixels=free_pixels)
    return picture


def check_pixels(
    size: tuple[int, int],
    sample_bytes: int,
    stored: int,
    *,
    ratio: int = claims.RATIO,
    free_pixels: int = FREE_PIXELS,
) -> None:
    """Check a claimed width and height, of `sample_bytes` a pixel, against `stored` bytes. Raises ClaimError."""
    pixels = claims.count(size, "picture")
    if pixels > MOST_PIXELS:
        raise ClaimError(
            f"it claims {size[0]} × {size[1]} pixels, more than the {MOST_PIXELS // 10**6} million of the largest "
            "picture that is read: cut it into parts"
        )
    claims.check_size(
        pixels * sample_bytes, stored, f"{size[0]} × {size[1]} pixels", free=free_pixels * sample_bytes, ratio=ratio
    )


def check_tiff_page(page: Any, file: BinaryIO, *, ratio: int = claims.RATIO, free_pixels: int = FREE_PIXELS) -> None:
    """Check a page of tifffile's before its pixels are unpacked; `file` is its file. Raises ClaimError."""
    stored = min(sum(page.databytecounts), _length(file))
    if page.compression not in _PLAIN:
        raise ClaimError(
            f"its pixels are packed by TIFF's method {int(page.compression)}; "
            "known are none, deflate, LZW and PackBits: save it so"
        )
    sample_bytes = page.dtype.itemsize * (page.samplesperpixel or 1)
    size = page.imagewidth, page.imagelength
    check_pixels(size, sample_bytes, stored, ratio=ratio, free_pixels=free_pixels)
    if page.shape and claims.count(page.shape, "picture") > page.imagewidth * page.imagelength * page.samplesperpixel:
        raise ClaimError("it is a volume, not a picture: save one layer of it")
    if max(page.databytecounts, default=0) > stored:
        raise ClaimError(
            "one of its strips or tiles ends after the file does: it is damaged or cut short; make it anew"
        )
    part = math.prod(page.chunks) * page.dtype.itemsize
    claims.check_size(part, stored, "strips or tiles", ratio=ratio)
    if page.compression in _DEFLATED:
        for at, length in zip(page.dataoffsets, page.databytecounts, strict=False):
            file.seek(at)
            claims.check_inflated(file.read(min(length, stored)), part, "strip or tile")
        file.seek(0)


def _check_png_chunks(file: BinaryIO) -> None:
    """Check that each chunk ends inside the file: Pillow takes memory for what its length claims. Raises ClaimError."""
    size, at, count = _length(file), 8, 0
    while at + 8 <= size:
        count += 1
        if count > _MOST_CHUNKS:
            raise ClaimError(f"it has more than {_MOST_CHUNKS} chunks, made to take time: save it anew")
        file.seek(at)
        at += 12 + int.from_bytes(file.read(4), "big")
        if at > size:
            raise ClaimError("one of its chunks ends after the file does: it is damaged or cut short; make it anew")
    file.seek(0)


def _check_jpeg_head(file: BinaryIO) -> None:
    """Check that little stands before a JPEG's scan: Pillow reads what is in no segment byte by byte, and loads each
    segment. Raises ClaimError."""
    size, at, loose = _length(file), 2, 0
    for _ in range(_MOST_SEGMENTS):
        file.seek(at)
        head = file.read(_MOST_LOOSE + 4)
        rest = head[head.find(b"\xff") :].lstrip(b"\xff") if b"\xff" in head else b""
        loose += len(head) - len(rest)
        if loose > _MOST_LOOSE + _MOST_SEGMENTS or (not rest and at + len(head) < size):
            break
        if not rest or rest[0] in _LAST:
            file.seek(0)
            return
        segment = JpegImagePlugin.MARKER.get(0xFF00 | rest[0], ("", "", None))[2] is not None
        at += len(head) - len(rest) + 1 + (int.from_bytes(rest[1:3], "big") if segment else 0)
    raise ClaimError("its head has more segments or fill bytes than a picture's, made to take time: save it anew")


def _length(file: BinaryIO) -> int:
    place = file.tell()
    size = file.seek(0, os.SEEK_END)
    file.seek(place)
    return size
