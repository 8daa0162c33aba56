"""The forms in which a flight is handed to other programs: what is written of each frame, and what of the whole flight.

A frame's files may be written by any process, again and again; a flight's are written once its frames are there.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

from dappled.products.handover import colmap, mcap_file, nerfstudio, stac, view_files
from dappled.products.maps import cog, georeference
from dappled.products.maps.earth import Projection
from dappled.products.maps.georeference import Options
from dappled.products.maps.laboratory import MEAN, FlightFrame
from dappled.products.maps.photographs import Station

MAPPED = ("stac",)  # what needs the height of the ground
_RIGS = ("colmap", "nerfstudio")


@dataclass(frozen=True, slots=True, eq=False)
class HandedFrame:
    """One frame with its place and what it is drawn with. `level_m` is the height of flat ground, needed for
    maps; `utc_ns` mid-exposure, corrected, None where UTC was never known."""

    flight: str
    station: Station
    frame: FlightFrame
    projection: Projection
    options: Options
    level_m: float | None
    utc_ns: int | None


def write_frame(form: str, folder: Path, frame: HandedFrame) -> list[Path]:
    """Write the files of one frame into the form's folder; returns their paths. Raises DappledError and OSError."""
    station, options, made = frame.station, frame.options, frame.frame
    view = "ground" if form in _RIGS and (options.view != MEAN or made.laboratory.pictures is None) else MEAN
    one = made.photograph(station, frame.projection, view=view, focus_m=options.focus_m)
    if form in _RIGS:
        grid = None if view == MEAN else made.decoded.light_field.views.shape[:2]
        return view_files.write_frame(folder, one, grid, station, focus_m=options.focus_m, utc_ns=frame.utc_ns)
    if form == "mcap":
        return mcap_file.write_parts(folder, one, made.decoded.light_field, station, frame.utc_ns)
    assert frame.level_m is not None
    survey = georeference.on_ground(
        frame.flight, [one], [], projection=frame.projection, level_m=frame.level_m, options=options
    )
    return stac.write_item(folder, survey, one, station, gain=cog.gain_of([one.image]), utc_ns=frame.utc_ns)


def finish(form: str, folder: Path, flight: str, names: Sequence[str]) -> list[Path]:
    """Write the files of the whole flight, of the frames `names` in this order; returns their paths.

    Raises DappledError and OSError."""
    if form == "stac":
        return stac.write_collection(folder, flight, names)
    frames = view_files.read_frames(folder, names)
    if form == "colmap":
        return colmap.write_model(folder, frames)
    if form == "nerfstudio":
        return nerfstudio.write_transforms(folder, frames)
    return mcap_file.write(folder, flight, frames)
