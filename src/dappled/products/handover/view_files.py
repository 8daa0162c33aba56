"""Write a frame's views as pictures, a folder for each view, and the record of their cameras; read records back."""

from __future__ import annotations

import re
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np

from dappled import durable
from dappled.bounds.claims import ClaimError
from dappled.bounds.parsing import read_log
from dappled.decode import srgb
from dappled.errors import DappledError
from dappled.products.handover import photo_files, view_cameras
from dappled.products.handover.view_cameras import FrameCameras
from dappled.products.maps import cog
from dappled.products.maps.photographs import Photograph, Station

RECORDS = "frames"
PICTURE = "picture"  # its name among the views: the frame as a whole, at the sensor's own resolution
_VIEW = re.compile(rf"{PICTURE}|v\d+u\d+")


def write_frame(
    folder: Path, one: Photograph, grid: tuple[int, ...] | None, station: Station, *, focus_m: float, utc_ns: int | None
) -> list[Path]:
    """Write images/<view>/<frame>.jpg for each view, or the one picture, then frames/<frame>.json; returns their paths.

    `grid` is how many views of `one` stand below and beside each other in the aperture; None: its picture is wanted.
    Raises DappledError, also for a frame without views, and OSError.
    """
    if grid is not None and one.views is None:
        raise DappledError(
            f"{station.frame.name} has no views, only slices: decode it with a calibration (--calibration)"
        )
    names = [PICTURE] if grid is None else [f"v{v}u{u}" for v, u in np.ndindex(*grid)]
    record = view_cameras.of_photograph(one, names, station, focus_m, utc_ns)
    gain = cog.gain_of([one.image])
    written = []
    for name, (image, eye) in zip(names, one.layers(focus_m), strict=True):
        view = replace(one, image=image, eye=eye)
        path = folder / picture(name, record.name)
        durable.make_folder(path.parent)
        durable.write_file(path, photo_files.jpeg(view, station, utc_ns, srgb.sixteen(view.image * gain)))
        written.append(path)
    return [*written, write_record(folder, record)]


def write_record(folder: Path, record: FrameCameras) -> Path:
    """Write frames/<frame>.json; returns its path. Raises OSError."""
    path = folder / RECORDS / f"{record.name}.json"
    durable.make_folder(path.parent)
    durable.write_file(path, record.encoded())
    return path


def picture(view: str, frame: str) -> str:
    """Where a view's picture stands in the form's folder."""
    return f"images/{view}/{frame}.jpg"


def read_frames(folder: Path, names: Sequence[str]) -> list[FrameCameras]:
    """The records of frames, in this order. Raises DappledError."""
    frames = []
    for name in names:
        path = folder / RECORDS / f"{name}.json"
        try:
            record = view_cameras.decoded(read_log(path), str(path))
        except (OSError, ClaimError) as error:
            raise DappledError(f"{path} can't be read ({error}): run the batch again") from None
        if record.name != name or not all(_VIEW.fullmatch(view.name) for view in record.views):
            raise DappledError(f"{path} is the record of another frame: remove it, and run the batch again")
        frames.append(record)
    return frames
