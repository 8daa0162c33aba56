"""Write and read files of printed masks: PNG and TIFF with their physical resolution, and CSV of measurements."""

from __future__ import annotations

import struct
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any, BinaryIO

import numpy as np
import tifffile
from numpy.typing import NDArray

from dappled import durable
from dappled.bounds.pictures import check_tiff_page, open_picture
from dappled.decode.optics.film import DensityCurve, density_curve
from dappled.errors import DappledError, first_line
from dappled.products import csv_tables, png_files
from dappled.products.whole_files import whole
from dappled.workers import spans

Levels = NDArray[np.unsignedinteger]
Tile = Callable[[slice, slice], Levels]
_TILE = 512  # of a TIFF, in pixels a side
_STRIP = 64  # rows of a PNG at a time
_MASK_RATIO, _MASK_FREE_PIXELS = 1000, 100_000_000  # a periodic pattern packs as well as deflate can


@dataclass(frozen=True, slots=True)
class _Picture:
    """The picture to write: shape, bits, (vertical, horizontal) pixels per mm, and the function of its levels."""

    shape: tuple[int, int]
    bits: int
    px_per_mm: tuple[float, float]
    tile: Tile
    progress: Callable[[int], object]


def write(
    path: Path,
    shape: tuple[int, int],
    bits: int,
    px_per_mm: tuple[float, float],
    tile: Tile,
    *,
    progress: Callable[[int], object] = lambda rows: None,
) -> None:
    """Write a grey image of `shape` to .png or .tif by asking `tile(rows, columns)` for its levels, strip by strip.

    `px_per_mm` (vertical, horizontal) goes into the file (pHYs, or resolution tags). `progress` gets the rows done.
    Memory stays at a few strips. The file appears whole or not at all. Raises DappledError.
    """
    writers = {".png": _write_png, ".tif": _write_tiff, ".tiff": _write_tiff}
    writer = writers.get(path.suffix.lower())
    if writer is None:
        raise DappledError(f"{path}: the name of a mask image must end in .png or .tif")
    with whole(path) as part:
        writer(part, _Picture(shape, bits, px_per_mm, tile, progress))


def _write_png(path: Path, picture: _Picture) -> None:
    rows, columns = picture.shape

    def strips() -> Iterator[Levels]:
        for these in spans(rows, _STRIP):
            yield picture.tile(these, slice(0, columns))
            picture.progress(these.stop - these.start)

    per_m = (round(density * 1000) for density in reversed(picture.px_per_mm))
    resolution = png_files.chunk(b"pHYs", struct.pack(">IIB", *per_m, 1))
    png_files.write(path, picture.shape, picture.bits, strips(), more=resolution)


def _write_tiff(path: Path, picture: _Picture) -> None:
    rows, columns = picture.shape

    def tiles() -> Iterator[Levels]:
        for these in spans(rows, _TILE):
            picture.progress(these.stop - these.start)  # before the last tile: the writer asks for no more after it
            for across in spans(columns, _TILE):
                yield np.ascontiguousarray(picture.tile(these, across))

    with tifffile.TiffWriter(path) as writer:
        writer.write(
            tiles(),
            shape=picture.shape,
            dtype=np.uint8 if picture.bits == 8 else np.uint16,
            tile=(_TILE, _TILE),
            photometric="minisblack",
            compression="zlib",
            compressionargs={"level": 1},
            resolution=(picture.px_per_mm[1] * 10, picture.px_per_mm[0] * 10),
            resolutionunit="CENTIMETER",
            metadata=None,
        )


def read(path: Path) -> tuple[NDArray[np.float32], tuple[float, float]]:
    """Read a grey mask image: float32 (H, W) from 0 to 1, and its (vertical, horizontal) pixels per mm.

    Raises DappledError for a file that is not a grey image, or has no resolution.
    """
    try:
        with open(path, "rb", opener=durable.plain_file) as file:
            values, density = _read_png(file) if path.suffix.lower() == ".png" else _read_tiff(file)
    except Exception as error:  # the readers raise anything on damaged bytes
        raise DappledError(f"{path} can't be read as an image: {first_line(error)}") from error
    if density is None:
        raise DappledError(f"{path} does not say its physical resolution: write it with `dappled mask make`")
    if values.ndim != 2 or (values.dtype.kind != "u" and values.dtype != np.int32):
        raise DappledError(f"{path} is not a grey image of 8 or 16 bits")
    top = 255 if values.dtype == np.uint8 else 65535
    return values.astype(np.float32) / np.float32(top), density


def _read_png(file: BinaryIO) -> tuple[NDArray[Any], tuple[float, float] | None]:
    image = open_picture(file, ratio=_MASK_RATIO, free_pixels=_MASK_FREE_PIXELS)
    values, dpi = np.asarray(image), image.info.get("dpi")
    return values, None if dpi is None else (float(dpi[1]) / 25.4, float(dpi[0]) / 25.4)


def _read_tiff(file: BinaryIO) -> tuple[NDArray[Any], tuple[float, float]]:
    with tifffile.TiffFile(file) as tiff:
        page = tiff.pages.first
        check_tiff_page(page, file, ratio=_MASK_RATIO, free_pixels=_MASK_FREE_PIXELS)
        x, y = page.get_resolution("MILLIMETER")
        return page.asarray(), (float(y), float(x))


def read_density_curve(path: Path) -> DensityCurve:
    """Read a film's curve from CSV: columns `level` (0 to 255) and `density`. Raises DappledError."""
    rows = _numbers(path, ("level", "density"))
    try:
        return density_curve([r[0] for r in rows], [r[1] for r in rows])
    except ValueError as error:
        raise DappledError(f"{path}: {error}") from None


def read_spots(path: Path) -> list[tuple[float, float]]:
    """Read measured spots (x, y), in mm from the centre of the pattern, from CSV: columns `x_mm` and `y_mm`.

    Rows with an empty field or a dash are spots that were not seen; they are left out. Raises DappledError.
    """
    return [(r[0], r[1]) for r in _numbers(path, ("x_mm", "y_mm"))]


def _numbers(path: Path, wanted: tuple[str, ...]) -> list[tuple[float, ...]]:
    found = []
    for number, row in csv_tables.rows(path, wanted):
        if any(row[name] in ("", "-") for name in wanted):
            continue
        try:
            found.append(tuple(float(row[name]) for name in wanted))
        except ValueError as error:
            raise DappledError(f"{path}, line {number}: {first_line(error)}") from None
    return found
