"""Camera raws (RAF, CR2, DNG …) through LibRaw."""

from __future__ import annotations

from dataclasses import replace
from datetime import datetime
from typing import Any, BinaryIO

import numpy as np
import rawpy
from numpy.typing import NDArray

from dappled.drivers.raw import exif
from dappled.drivers.raw.exif import Exposure, positive
from dappled.drivers.raw.raw_file import RawFile, made


def read(file: BinaryIO) -> RawFile:
    """A raw file with a mosaic. Raises what LibRaw and EXIF raise, and ValueError for one without."""
    with rawpy.imread(file) as raw:
        if raw.raw_type != rawpy.RawType.Flat:
            raise ValueError("it holds no mosaic (linear or demosaiced raws have no masked light field to decode)")
        mosaic = np.array(raw.raw_image_visible)
        cfa = None if raw.num_colors == 1 or raw.raw_pattern is None else _visible_pattern(raw)
        count = 1 if cfa is None else int(cfa.max()) + 1
        blacks = tuple(float(level) for level in raw.black_level_per_channel[:count])
        names = "W" if cfa is None else raw.color_desc.decode("ascii", "replace")[:count]
        return made(
            _exposure(file, raw),
            mosaic,
            black=blacks[0] if len(set(blacks)) == 1 else blacks,
            white=float(raw.white_level),
            cfa=cfa,
            colour_names=tuple(names),
            balance=None if cfa is None else _balance(raw.camera_whitebalance, names),
        )


def read_metadata(file: BinaryIO) -> Exposure:
    """What it says of the exposure. Raises what LibRaw raises."""
    with rawpy.imread(file) as raw:
        return _exposure(file, raw)


def _exposure(file: BinaryIO, raw: Any) -> Exposure:
    """EXIF first; LibRaw's own reading where EXIF is silent (CRW, ORF variants …)."""
    file.seek(0)
    told = exif.read(file)
    other = raw.other
    stamp = other.timestamp
    taken = stamp.isoformat() if isinstance(stamp, datetime) and stamp.year > 1970 else None
    return replace(
        told,
        focal_length_mm=told.focal_length_mm or _short(other.focal_length),
        f_number=told.f_number or _short(other.aperture),
        exposure_s=told.exposure_s or _short(other.shutter_speed),
        iso=told.iso or _short(other.iso_speed),
        taken=told.taken or taken,
    )


def _short(value: float) -> float | None:
    """LibRaw's single-precision numbers as the decimal that was meant: 14.8, not 14.800000190734863."""
    return positive(str(np.float32(value)))


def _visible_pattern(raw: Any) -> NDArray[np.int64]:
    """LibRaw's pattern, which starts at the first masked pixel, as the smallest block that repeats over the mosaic."""
    pattern = np.asarray(raw.raw_pattern, dtype=np.int64)
    visible = np.roll(pattern, (-raw.sizes.top_margin, -raw.sizes.left_margin), axis=(0, 1))

    def period(lines: NDArray[np.int64]) -> int:
        count = len(lines)
        return next(n for n in range(1, count + 1) if count % n == 0 and np.array_equal(lines, np.roll(lines, n, 0)))

    return visible[: period(visible), : period(visible.T)].copy()


def _balance(gains: list[float], names: str) -> tuple[float, ...] | None:
    """By colour index, green 1; LibRaw gives 0 for a second green that is as the first."""
    known = [float(gain) for gain in gains[: len(names)]]
    green = names.find("G")
    if green < 0 or positive(known[green]) is None:
        return None
    filled = [known[green] if name == "G" and gain == 0 else gain for name, gain in zip(names, known, strict=True)]
    if any(positive(gain) is None for gain in filled):
        return None
    return tuple(gain / known[green] for gain in filled)
