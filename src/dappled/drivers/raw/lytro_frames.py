"""Frames of Lytro cameras: in containers, which say so, and as bare pixels, which say nothing."""

from __future__ import annotations

import json
import os
from collections.abc import Mapping
from pathlib import Path
from typing import Any, BinaryIO

from dappled.drivers.raw import lytro
from dappled.drivers.raw.exif import Exposure
from dappled.drivers.raw.raw_file import RawFile, Source, made


def find(source: Source, label: str, file: BinaryIO, *, pixels: bool = True) -> lytro.Lytro | None:
    """A Lytro camera's frame, without `pixels` only what it says; None for other files."""
    start = file.read(len(lytro.START))
    size = file.seek(0, os.SEEK_END)
    file.seek(0)
    if start == lytro.START:
        return (lytro.read_container if pixels else lytro.read_container_metadata)(file.read())
    told = _beside(source) or lytro.BARE.get(size) if label.lower().endswith(".raw") else None
    if told is None:
        return None
    return lytro.read_bare(file.read(), told) if pixels else lytro.read_bare_metadata(told)


def _beside(source: Source) -> Mapping[str, Any] | None:
    """The JSON beside a bare .raw file, of the same name and .json or .txt; None without."""
    if not isinstance(source, Path | str):
        return None
    for suffix in (".json", ".JSON", ".txt", ".TXT"):
        path = Path(source).with_suffix(suffix)
        if path.is_file():
            told = json.loads(path.read_bytes())
            return told if isinstance(told, dict) else None
    return None


def frame_of(found: lytro.Lytro) -> RawFile:
    """As every other frame."""
    return made(
        exposure_of(found),
        found.mosaic,
        black=found.black[0] if len(set(found.black)) == 1 else found.black,
        white=found.white,
        cfa=found.cfa,
        colour_names=found.colour_names,
        balance=found.balance,
    )


def exposure_of(found: lytro.Lytro) -> Exposure:
    """What it says of the exposure."""
    return Exposure(
        found.make, found.model, found.focal_length_mm, found.f_number, found.exposure_s, found.iso, found.taken_utc
    )
