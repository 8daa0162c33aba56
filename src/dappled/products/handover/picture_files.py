"""Write pictures of full resolution: DNG for raw developers, 16-bit TIFF, JPEG, PNG, with lens, time and place in EXIF.

A DNG holds the linear values: the colour mosaic of a Bayer chip with its own pattern, else values in every pixel
(LinearRaw). Its white level leaves room for what is brighter behind a dark part of the mask. The other files are what
LibRaw makes of the mosaic, with the camera's white balance and matrix, in sRGB.
"""

from __future__ import annotations

import io
import math
import struct
from pathlib import Path

import numpy as np
import rawpy
import tifffile
from numpy.typing import NDArray
from PIL import Image

from dappled import __version__, durable
from dappled.decode import srgb
from dappled.decode.array_types import Floats, Singles
from dappled.decode.picture.picture import interpolated
from dappled.drivers.raw.picture_maker import MadePicture
from dappled.products.geotags import exif_gps
from dappled.products.geotags.exif_gps import Entry, ratio_entry, text_entry

SUFFIXES = (".dng", ".tif", ".tiff", ".jpg", ".jpeg", ".png")
_EXIF_IFD, _GPS_IFD = 0x8769, 0x8825
_BYTE, _ASCII, _SHORT, _LONG, _UNDEFINED, _SRATIONAL = 1, 2, 3, 4, 7, 10
_RATIONAL = 5
_CFA, _LINEAR_RAW = 32803, 34892  # photometric interpretations
_BLACK, _WHITE = 1024, 1024 + 16384  # almost two stops of room above white
_QUALITY = 95
_D65 = 21
_FILM_MM = 36.0
_SRGB_OF_XYZ = np.array(
    [[3.2404542, -1.5371385, -0.4985314], [-0.9692660, 1.8760108, 0.0415560], [0.0556434, -0.2040259, 1.0572252]]
)


def encoded(made: MadePicture, suffix: str, where: exif_gps.Place | None) -> bytes:
    """The bytes of a picture's file of this kind; `where` is its position, where known."""
    kind = suffix.lower()
    first, inner = _settings(made)
    if kind == ".dng":
        if made.raw.cfa is None:
            first.append((0x0106, _SHORT, 1, struct.pack("<H", _LINEAR_RAW)))
        data = exif_gps.with_directory(_dng(made), _EXIF_IFD, inner, first)
        return data if where is None else exif_gps.tagged(data, where)
    shown = _developed(made)
    buffer = io.BytesIO()
    if kind in (".tif", ".tiff"):
        colours = "rgb" if shown.ndim == 3 else "minisblack"
        tifffile.imwrite(buffer, shown, byteorder="<", photometric=colours, metadata=None, software=False)
        data = exif_gps.with_directory(buffer.getvalue(), _EXIF_IFD, inner, first)
    else:
        exif = b"Exif\0\0" + exif_gps.with_directory(exif_gps.EMPTY, _EXIF_IFD, inner, first)
        if kind == ".png":
            # Pillow writes no 16-bit colours: 8 bits are what a PNG is looked at with.
            eight = shown if shown.ndim == 2 else _eight(shown)
            Image.fromarray(eight).save(buffer, "PNG", exif=exif, compress_level=1)
        else:
            Image.fromarray(_eight(shown)).save(buffer, "JPEG", quality=_QUALITY, subsampling=0, exif=exif)
        data = buffer.getvalue()
    return data if where is None else exif_gps.tagged(data, where)


def sigma_file(made: MadePicture) -> bytes:
    """The standard error of each value of the plane, as shares of white, float32 TIFF; NaN where it is not trusted."""
    buffer = io.BytesIO()
    picture = made.picture
    sigma = np.where(picture.trusted, picture.sigma, np.float32(np.nan))
    tifffile.imwrite(buffer, sigma, byteorder="<", photometric="minisblack", metadata=None, software=False)
    return buffer.getvalue()


def _eight(shown: NDArray[np.uint16]) -> NDArray[np.uint8]:
    return np.asarray((shown.astype(np.uint32) * 255 + 32767) // 65535, dtype=np.uint8)


def _developed(made: MadePicture) -> NDArray[np.uint16]:
    """uint16 (H, W) or (H, W, 3) in sRGB's curve."""
    if _bayer(made) is None:
        image = interpolated(made.picture)
        if image.ndim == 3:
            image = np.asarray(_in_srgb(image[..., _rgb(made)], made), dtype=np.float32)
        return np.asarray(np.round(srgb.encoded(np.clip(image, 0, 1)) * 65535), dtype=np.uint16)
    with rawpy.imread(io.BytesIO(_dng(made))) as raw:
        return np.asarray(
            raw.postprocess(
                use_camera_wb=True,
                no_auto_bright=True,
                adjust_maximum_thr=0,
                output_bps=16,
                gamma=(2.4, 12.92),
                user_flip=0,
            )
        )


def _in_srgb(image: Singles, made: MadePicture) -> Floats:
    """Balanced, and by the camera's matrix, to linear sRGB."""
    matrix = _matrix(made) @ np.linalg.inv(_SRGB_OF_XYZ)  # from sRGB to the camera
    matrix /= matrix.sum(axis=1, keepdims=True)
    return np.asarray((image / _neutral(made)) @ np.linalg.inv(matrix).T)


def _rgb(made: MadePicture) -> list[int]:
    """The indices of red, green and blue."""
    names = made.raw.colour_names
    return [names.index(name) for name in "RGB"]


def _bayer(made: MadePicture) -> bytes | None:
    """The pattern as DNG has it, 0 red, 1 green, 2 blue; None for other chips."""
    pattern, names = made.picture.pattern, made.raw.colour_names
    if pattern.shape != (2, 2) or set(names) != set("RGB") or pattern.min() < 0:
        return None
    return bytes("RGB".index(names[index]) for index in pattern.ravel())


def _matrix(made: MadePicture) -> Floats:
    return _SRGB_OF_XYZ if made.colour_matrix is None else made.colour_matrix


def _neutral(made: MadePicture) -> Floats:
    """Red, green and blue of something white: by the file's own balance, else as grey as the whole frame."""
    rgb = _rgb(made)
    if made.raw.balance is not None:
        return 1 / np.array(made.raw.balance)[rgb]
    plane, pattern = made.picture.plane, made.picture.pattern
    first = [made.raw.colour_names.index(name) for name in made.raw.colour_names]
    means = []
    for colour in rgb:
        places = [place for place, index in np.ndenumerate(pattern) if index >= 0 and first[index] == colour]
        a, b = pattern.shape
        means.append(float(np.mean([plane[row::a, column::b].mean() for row, column in places])))
    return np.maximum(means, 1e-6) / max(*means, 1e-6)


def _dng(made: MadePicture) -> bytes:
    """The linear values as DNG, without EXIF."""
    pattern = _bayer(made)
    image = made.picture.plane if pattern is not None else interpolated(made.picture)
    colours = pattern is not None or image.ndim == 3
    if image.ndim == 3:
        image = image[..., _rgb(made)]
    values = np.clip(np.round(image * (_WHITE - _BLACK) + _BLACK), 0, 65535).astype(np.uint16)
    samples = 1 if values.ndim == 2 else values.shape[2]
    tags: list[tuple[int, int, int, object, bool]] = [
        (50706, _BYTE, 4, bytes((1, 4, 0, 0)), True),
        (50707, _BYTE, 4, bytes((1, 2, 0, 0)), True),
        (50708, _ASCII, 0, made.raw.camera_model or "dappled", True),
        (50714, _SHORT, samples, (_BLACK,) * samples if samples > 1 else _BLACK, True),
        (50717, _SHORT, samples, (_WHITE,) * samples if samples > 1 else _WHITE, True),
    ]
    if colours:
        matrix = [part for value in _matrix(made).ravel() for part in (round(value * 10000), 10000)]
        neutral = [part for value in _neutral(made) for part in (round(value * 10**6), 10**6)]
        tags += [
            (50721, _SRATIONAL, 9, tuple(matrix), True),
            (50728, _RATIONAL, 3, tuple(neutral), True),
            (50778, _SHORT, 1, _D65, True),
        ]
    if pattern is not None:
        tags += [
            (33421, _SHORT, 2, (2, 2), True),
            (33422, _BYTE, 4, pattern, True),
            (50710, _BYTE, 3, bytes((0, 1, 2)), True),
            (50711, _SHORT, 1, 1, True),
        ]
    buffer = io.BytesIO()
    grey = samples == 1 and pattern is None  # tifffile wants three samples of LinearRaw
    tifffile.imwrite(
        buffer,
        values,
        byteorder="<",
        photometric="minisblack" if grey else _LINEAR_RAW if pattern is None else _CFA,
        planarconfig="contig" if samples > 1 else None,
        metadata=None,
        software=False,
        extratags=tags,
    )
    return buffer.getvalue()


def _settings(made: MadePicture) -> tuple[list[Entry], list[Entry]]:
    """Entries of the first directory and of EXIF's, little endian; unknown ones are left out."""
    raw = made.raw
    first = [text_entry(0x0131, f"dappled {__version__}"), (0x0112, _SHORT, 1, struct.pack("<H", 1))]
    for tag, words in ((0x010F, raw.camera_make), (0x0110, raw.camera_model)):
        first += [text_entry(tag, words)] if words else []
    inner: list[Entry] = [(0x9000, _UNDEFINED, 4, b"0231")]
    if raw.taken:
        whole, _, fraction = raw.taken.partition(".")
        taken = whole.replace("-", ":").replace("T", " ")
        first.append(text_entry(0x0132, taken))
        inner += [text_entry(0x9003, taken), text_entry(0x9004, taken)]
        inner += [text_entry(0x9291, fraction)] if fraction else []
    if raw.exposure_s:
        inner.append(ratio_entry(0x829A, round(raw.exposure_s * 1e6), 10**6))
    if made.f_number:
        inner.append(ratio_entry(0x829D, round(made.f_number * 100), 100))
    if raw.iso:
        inner.append((0x8827, _SHORT, 1, struct.pack("<H", min(65535, round(raw.iso)))))
    down, across = (1 / math.hypot(*step) for step in (made.sensor.row_mm, made.sensor.column_mm))
    inner += [
        ratio_entry(0x920A, round(made.focal_length_mm * 1000), 1000),
        ratio_entry(0xA20E, round(across * 10 * 10**4), 10**4),  # pixels in a centimetre of the chip
        ratio_entry(0xA20F, round(down * 10 * 10**4), 10**4),
        (0xA210, _SHORT, 1, struct.pack("<H", 3)),
    ]
    film = _FILM_MM * made.focal_length_mm * across / made.sensor.shape[1]
    inner.append((0xA405, _SHORT, 1, struct.pack("<H", min(65535, round(film)))))
    return first, inner


def place_in(path: Path) -> exif_gps.Place | None:
    """The position that a file's own EXIF has; None where it has none."""
    try:
        with open(path, "rb", opener=durable.plain_file) as file:
            exif = Image.Exif()
            if file.read(4) in (b"II*\0", b"MM\0*"):
                file.seek(0)
                exif.load_from_fp(file)
            else:
                file.seek(0)
                exif = Image.open(file).getexif()
            gps = exif.get_ifd(_GPS_IFD)
            sides = [
                sum(float(part) / 60**n for n, part in enumerate(gps[tag])) * (-1 if gps[tag - 1][:1] == letter else 1)
                for tag, letter in ((2, "S"), (4, "W"))
            ]
            height = float(gps.get(6, 0.0)) * (-1 if gps.get(5, b"\0") in (1, b"\1") else 1)
    except (OSError, KeyError, ValueError, TypeError, IndexError, ZeroDivisionError, SyntaxError, struct.error):
        return None
    return exif_gps.Place(sides[0], sides[1], height) if all(map(math.isfinite, (*sides, height))) else None
