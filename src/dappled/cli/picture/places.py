"""Where frames were taken: by the ledger of their flight, or by the EXIF of their own file."""

from __future__ import annotations

from functools import cache
from pathlib import Path

from dappled.cli.frame_arguments import flight_of
from dappled.flight import layout
from dappled.products.geotags import exif_gps, geotags
from dappled.products.handover import picture_files
from dappled.products.mounting import Mounting


def place_of(frame: Path) -> exif_gps.Place | None:
    """Where a frame was taken: as its flight has it, else as its own EXIF does."""
    flight = flight_of(frame.resolve())
    placed = {} if flight is None else _placed(flight)
    return placed.get(frame.name) or picture_files.place_in(frame)


@cache
def _placed(flight: Path) -> dict[str, exif_gps.Place]:
    """The positions of a flight's frames by their names."""
    facts = layout.read_facts(layout.open_folder(flight))
    found, _ = geotags.read(flight, geotags.PlacedBy(Mounting.of(facts)))
    return {
        one.file_name: exif_gps.place(one.camera, one.utc_ns, one.tag.pose) for one in found if one.camera is not None
    }
