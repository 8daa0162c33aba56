"""Encode a frame's picture as 16-bit TIFF and as JPEG, with place, time, lens and exposure in EXIF and XMP."""

from __future__ import annotations

import math
import struct
from collections.abc import Sequence
from contextlib import suppress
from datetime import UTC, datetime
from pathlib import Path
from statistics import StatisticsError, median

import numpy as np
from numpy.typing import NDArray

from dappled import durable
from dappled.config import profiles
from dappled.decode import srgb
from dappled.decode.optics.lenses import ground_sample_m
from dappled.errors import DappledError
from dappled.flight import Frame, Tag
from dappled.products.geotags import exif_gps, geotags, sidecars
from dappled.products.geotags.exif_gps import Entry, ratio_entry, text_entry
from dappled.products.geotags.geotags import Placed
from dappled.products.handover import exif_settings
from dappled.products.handover.exif_settings import EXIF_IFD, UNDEFINED, ExifSettings, short_entry
from dappled.products.maps import cog
from dappled.products.maps.photographs import Photograph, Station

SUFFIXES = {"tiff": ".tif", "jpeg": ".jpg"}
_LONG = 4
_XMP_TAG = 700
_XMP_HEAD = b"http://ns.adobe.com/xap/1.0/\0"
_FIRST_OF_JPEG: list[Entry] = [
    ratio_entry(0x011A, 72, 1),
    ratio_entry(0x011B, 72, 1),
    short_entry(0x0128, 2),
    short_entry(0x0213, 1),
]


def ground_words(placed: Sequence[Placed]) -> str:
    """What a pixel of a flight's pictures covers on the ground, in the middle one."""
    heights = [h for one in placed if one.camera is not None and (h := one.camera.height_above_home_m) is not None]
    lengths = [length for one in placed if (length := one.tag.focal_length_mm) is not None]
    with suppress(StatisticsError, DappledError):  # none is known; another camera's profile, or taken on the ground
        height_m, sensor = median(heights), profiles.camera(placed[0].tag.camera).raw[0].sensor
        sample_m = ground_sample_m(sensor.size_mm[1] / sensor.shape[1], median(lengths), height_m)
        return f"pictures: {100 * sample_m:.2g} cm of ground per pixel from {height_m:.3g} m above home"
    return "pictures: how much ground a pixel covers is unknown: focal length or height above home is"


def encoded(one: Photograph, station: Station, utc_ns: int | None) -> dict[str, bytes]:
    """The files by kind, "tiff" and "jpeg": the picture in sRGB's curve, its brightest hundredth at 0.9 of white.

    `utc_ns` is mid-exposure, corrected; None where UTC was never known.
    """
    gain = cog.gain_of([one.image])
    shown = srgb.sixteen(one.image * gain)
    xmp = sidecars.text(station.tag, station.camera, utc_ns).encode()
    first, inner = _settings(one, station.tag, utc_ns)
    plain = exif_settings.tiff(shown, (_XMP_TAG, 1, len(xmp), xmp, True))
    tiff = exif_gps.with_directory(plain, EXIF_IFD, inner, first)
    return {"tiff": exif_gps.tagged(tiff, _place(station, utc_ns)), "jpeg": jpeg(one, station, utc_ns, shown)}


def jpeg(one: Photograph, station: Station, utc_ns: int | None, shown: NDArray[np.uint16]) -> bytes:
    """The picture as it is `shown`, in sRGB's curve, as JPEG with EXIF and XMP."""
    first, inner = _settings(one, station.tag, utc_ns)
    settings = exif_gps.with_directory(exif_gps.EMPTY, EXIF_IFD, inner, [*first, *_FIRST_OF_JPEG])
    plain = exif_settings.jpeg(srgb.eight(shown), b"Exif\0\0" + settings)
    made = exif_gps.tagged(plain, _place(station, utc_ns))
    packet = _XMP_HEAD + sidecars.text(station.tag, station.camera, utc_ns).encode()
    return made[:2] + struct.pack(">BBH", 0xFF, 0xE1, len(packet) + 2) + packet + made[2:]


def _place(station: Station, utc_ns: int | None) -> exif_gps.Place:
    return exif_gps.place(station.camera, utc_ns, station.tag.pose)


def paths(folder: Path, frame: Frame) -> list[Path]:
    """Where the pictures of a frame stand, one of each kind."""
    return [folder / form / (Path(frame.name).stem + suffix) for form, suffix in SUFFIXES.items()]


def write_lists(folder: Path, placed: Sequence[Placed]) -> None:
    """Write geo.txt beside the pictures of each kind, which names them. Raises OSError."""
    for form, suffix in SUFFIXES.items():
        durable.write_file(folder / form / "geo.txt", geotags.odm(placed, suffix).encode())


def _settings(one: Photograph, tag: Tag, utc_ns: int | None) -> tuple[list[Entry], list[Entry]]:
    """Entries of the first directory and of EXIF's."""
    rows, columns = one.eye.shape
    taken = fraction = ""
    if utc_ns is not None:
        taken = datetime.fromtimestamp(utc_ns // 10**9, UTC).strftime("%Y:%m:%d %H:%M:%S")
        fraction = f"{utc_ns % 10**9 // 1000:06d}"
    length_mm = tag.focal_length_mm
    across, down = (float(np.linalg.norm(one.eye.matrix[:2, axis])) / (length_mm or math.inf) for axis in (0, 1))
    lens = tag.f_number, tag.iso, length_mm, (across, down), columns
    first, inner = ExifSettings("dappled", tag.camera, taken, fraction, tag.exposure_s, *lens).entries()
    inner += [
        (0x9101, UNDEFINED, 4, bytes((1, 2, 3, 0))),
        (0xA000, UNDEFINED, 4, b"0100"),
        short_entry(0xA001, 1),  # sRGB
        (0xA002, _LONG, 1, struct.pack("<I", columns)),
        (0xA003, _LONG, 1, struct.pack("<I", rows)),
    ]
    return first, inner + ([text_entry(0x9011, "+00:00")] if taken else [])
