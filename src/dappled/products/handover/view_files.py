"""Write a frame's views as pictures, a folder for each view, and the record of their cameras; read records back."""

from __future__ import annotations

import re
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

from dappled import durable
from dappled.bounds.claims import ClaimError
from dappled.bounds.parsing import read_log
from dappled.errors import DappledError
from dappled.products.handover import photo_files, view_cameras
from dappled.products.handover.view_cameras import FrameCameras
from dappled.products.maps import cog
from dappled.products.maps.eye import through
from dappled.products.maps.photographs import Photograph, Station

RECORDS = "frames"
_VIEW = re.compile(r"mean|v\d+u\d+")


def write_frame(
    folder: Path, one: Photograph, grid: tuple[int, int], station: Station, *, focus_m: float, utc_ns: int | None
) -> list[Path]:
    """Write images/<view>/<frame>.jpg for each view, then frames/<frame>.json; returns their paths.

    `one` has the views, `grid` is how many stand below and beside each other in the aperture. Raises DappledError,
    also for a frame without views, and OSError.
    """
    if one.views is None or one.apertures_m is None:
        raise DappledError(
            f"{station.frame.name} has no views, only slices: decode it with a calibration (--calibration)"
        )
    names = [f"v{v}u{u}" for v in range(grid[0]) for u in range(grid[1])]
    record = view_cameras.of_photograph(one, names, station, focus_m, utc_ns)
    gain = cog.gain_of([one.image])
    written = []
    for name, image, (y, x) in zip(names, one.views, one.apertures_m, strict=True):
        view = replace(one, image=image, eye=through(one.eye, (float(y), float(x)), focus_m))
        path = folder / picture(name, record.name)
        durable.make_folder(path.parent)
        durable.write_file(path, photo_files.jpeg(view, station, utc_ns, gain))
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
