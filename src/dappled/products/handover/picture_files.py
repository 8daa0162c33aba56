"""Write pictures of full resolution: DNG for raw developers, 16-bit TIFF, JPEG, PNG, with lens, time and place in EXIF.

A DNG holds the linear values: the colour mosaic of a Bayer chip with its own pattern, else values in every pixel
(LinearRaw). Its white level leaves room for what is brighter behind a dark part of the mask. The other files are what
LibRaw makes of the mosaic, with the camera's white balance and matrix, in sRGB.
"""

from __future__ import annotations

import math
import struct
from pathlib import Path

import numpy as np
from PIL import Image

from dappled import durable
from dappled.decode import srgb
from dappled.drivers.raw import developing
from dappled.drivers.raw.picture_maker import MadePicture
from dappled.encoded_pictures import file_of
from dappled.products.geotags import exif_gps
from dappled.products.geotags.exif_gps import Entry, text_entry
from dappled.products.handover import exif_settings
from dappled.products.handover.exif_settings import EXIF_IFD, ExifSettings, short_entry
from dappled.products.handover.reflectance import ReflectancePicture

SUFFIXES = (".dng", ".tif", ".tiff", ".jpg", ".jpeg", ".png")
_GPS_IFD = 0x8825


def encoded(
    made: MadePicture, suffix: str, where: exif_gps.Place | None, reflected: ReflectancePicture | None = None
) -> bytes:
    """The bytes of a picture's file of this kind; `where` is its position, where known. A TIFF may show it in
    reflectances."""
    kind = suffix.lower()
    first, inner = _settings(made)
    if kind == ".dng":
        if made.raw.cfa is None:
            first.append(short_entry(0x0106, developing.LINEAR_RAW))
        data = exif_gps.with_directory(developing.dng(made), EXIF_IFD, inner, first)
        return data if where is None else exif_gps.tagged(data, where)
    if reflected is not None:
        first.append(text_entry(0x010E, reflected.description))
    shown = developing.developed(made) if reflected is None else reflected.values
    if kind in (".tif", ".tiff"):
        data = exif_gps.with_directory(exif_settings.tiff(shown), EXIF_IFD, inner, first)
    else:
        exif = b"Exif\0\0" + exif_gps.with_directory(exif_gps.EMPTY, EXIF_IFD, inner, first)
        if kind == ".png":
            # Pillow writes no 16-bit colours: 8 bits are what a PNG is looked at with.
            eight = shown if shown.ndim == 2 else srgb.eight(shown)
            data = file_of(eight, "PNG", exif=exif, compress_level=1)
        else:
            data = exif_settings.jpeg(srgb.eight(shown), exif)
    return data if where is None else exif_gps.tagged(data, where)


def sigma_file(made: MadePicture) -> bytes:
    """The standard error of each value of the plane, as shares of white, float32 TIFF; NaN where it is not trusted."""
    picture = made.picture
    return exif_settings.tiff(np.where(picture.trusted, picture.sigma, np.float32(np.nan)))


def _settings(made: MadePicture) -> tuple[list[Entry], list[Entry]]:
    """Entries of the first directory and of EXIF's."""
    raw = made.raw
    whole, _, fraction = (raw.taken or "").partition(".")
    down, across = (1 / math.hypot(*step) for step in (made.sensor.row_mm, made.sensor.column_mm))
    taken = whole.replace("-", ":").replace("T", " ")
    lens = made.f_number, raw.iso, made.focal_length_mm, (across, down), made.sensor.shape[1]
    settings = ExifSettings(raw.make, raw.model, taken, fraction, raw.exposure_s, *lens)
    first, inner = settings.entries()
    return [*first, short_entry(0x0112, 1)], inner


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
