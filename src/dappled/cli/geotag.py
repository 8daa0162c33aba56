"""`dappled geotag`: write where each frame was taken, for other programs."""

from __future__ import annotations

import argparse
import json
import sys
from contextlib import nullcontext
from dataclasses import replace
from pathlib import Path
from typing import Any

from tqdm import tqdm

from dappled.cli import sealing
from dappled.cli.arguments import system_id
from dappled.clock import TimeOfDayClock
from dappled.daemon.replay import late_tags
from dappled.daemon.replay.vehicle_choice import VehicleError
from dappled.decode.geometry import Vector3, camera_pose
from dappled.errors import DappledError, counted
from dappled.findings import Code, Finding, Subject, finding, to_rows, told
from dappled.flight import Tag, layout, seals
from dappled.flight.layout import LockHeldError
from dappled.flight.seal_key import SealKey
from dappled.products.geotags import geotags, marks
from dappled.products.geotags.marks import Marked
from dappled.products.maps import earth
from dappled.products.maps.earth import EarthError, Geoid
from dappled.products.mounting import Mounting


def configure(parser: argparse.ArgumentParser) -> None:
    parser.epilog = (
        "examples:\n"
        "  dappled geotag ~/flights/20261121T101503Z-0a1b2c3d\n"
        "  dappled geotag FLIGHT --pos rover_events.pos --mark-lever-arm 0.05 0 0.12\n"
        "Writes name.ext.xmp beside each frame, and in geotags/\n"
        "geo.txt (OpenDroneMap), pix4d.csv and track.geojson.\n"
        "The frames themselves are not changed."
    )
    parser.add_argument("flight", type=Path, metavar="FLIGHT", help="flight folder")
    parser.add_argument("-o", "--output", type=Path, metavar="DIR", help="write everything into this folder instead")
    parser.add_argument(
        "--pos", type=Path, metavar="FILE",
        help="positions of the camera's marks after PPK (*_events.pos of RTKLIB or Emlid Studio), in place of the "
        "autopilot's",
    )  # fmt: skip
    add_mark_arm(parser)
    parser.add_argument("--lightroom", action="store_true", help="name sidecars name.xmp instead of name.ext.xmp")
    parser.add_argument("--force", action="store_true", help="replace sidecars that another program wrote")
    parser.add_argument(
        "--lever-arm", nargs=3, type=float, metavar=("F", "R", "D"),
        help="antenna to camera, metres forward, right, down (default: the flight's pose.lever_arm_m)",
    )  # fmt: skip
    parser.add_argument(
        "--mount", nargs=9, type=float, metavar="M",
        help="camera axes (right, down, forward) to body, row by row (default: the flight's pose.mount, or nadir)",
    )  # fmt: skip
    parser.add_argument(
        "--on-gimbal", action=argparse.BooleanOptionalAction, default=None,
        help="the camera is mounted on the gimbal (default: the flight's pose.on_gimbal)",
    )  # fmt: skip
    parser.add_argument(
        "--geoid", metavar="FILE|M",
        help="mean sea level above the ellipsoid: a grid, or metres (default: PROJ's EGM grid, if installed)",
    )  # fmt: skip
    parser.add_argument(
        "--copies", type=Path, metavar="DIR", help="also write copies of the frames with their position in EXIF"
    )
    parser.add_argument(
        "--vehicle", type=system_id, metavar="SYSID",
        help="system id of the vehicle that carried the camera (default: the one that the flight followed)",
    )  # fmt: skip
    parser.add_argument("--anyway", action="store_true", help="exit with 0 though results are in doubt")
    parser.add_argument("--config", type=Path, metavar="FILE", help="settings file, for record.seal_key")
    parser.add_argument("--json", action="store_true", help="print JSON")


def run(arguments: argparse.Namespace) -> int:
    facts = layout.read_facts(layout.open_folder(arguments.flight))
    key = sealing.key_of(arguments.config)
    into_flight = arguments.output is None
    tagged_late = _tag_late(arguments.flight, key, arguments.vehicle, into_flight=into_flight)
    tags, doubts = _vehicle(arguments)
    mounting, geoid = _mounting(arguments, facts), _geoid(arguments.geoid)
    marked = None
    if arguments.pos:
        marked = marks.find(arguments.flight, arguments.pos, geoid, mark_arm(arguments, mounting))
    folder = layout.open_folder(arguments.flight)
    clock = TimeOfDayClock()
    with seals.work(folder, clock, "geotag", "geotags flights in", key) if into_flight else nullcontext():
        written = geotags.write(
            arguments.flight,
            mounting,
            geoid=geoid,
            marked=marked,
            tags=tags,
            output=arguments.output,
            replace_extension=arguments.lightroom,
            force=arguments.force,
        )
    copies_of = (arguments.flight, arguments.copies, mounting, geoid, marked)
    made = geotags.copies(*copies_of, tags=tags) if arguments.copies else ()
    found = dict(tqdm(made, unit="frame", disable=None, delay=1.0, leave=False, file=sys.__stderr__))
    copied = [str(path) for path in found.values() if isinstance(path, Path)]
    without_copy = {name: reason for name, reason in found.items() if isinstance(reason, str)}
    doubts += geotags.doubts(arguments.flight)
    if arguments.json:
        print(
            json.dumps(
                {
                    "files": [str(path) for path in written.files],
                    "placed": written.placed,
                    "without_position": written.without_position,
                    "without_tag": written.without_tag,
                    "tagged_late": tagged_late,
                    "copies": copied,
                    "without_copy": without_copy,
                    "geoid": geoid.name if geoid else None,
                    "doubts": to_rows(doubts),
                    "marks": _marks_json(marked) if marked else None,
                },
                indent=2,
            )
        )
    else:
        words = f"{counted(written.placed, 'frame')} placed, {counted(len(written.files), 'file')} written"
        if folders := dict.fromkeys(str(path.parent) for path in written.files):
            words += f" to {' and '.join(folders)}"
        print(
            words
            + (f", {len(copied)} {'copy' if len(copied) == 1 else 'copies'} with EXIF" if arguments.copies else "")
        )
    for text in marks.sentences(marked) if marked else ():
        print(text, file=sys.stderr)
    for name in written.without_position:
        print(f"no position is known for {name}", file=sys.stderr)
    for name in written.without_tag:
        print(f"{name} was never tagged", file=sys.stderr)
    for name, reason in without_copy.items():
        if name not in (*written.without_position, *written.without_tag):
            print(f"no copy of {name}: {reason}", file=sys.stderr)
    for one in doubts:
        print(f"in doubt: {told(one)}", file=sys.stderr)
    doubted = bool(doubts or (marked and marked.doubts))
    return 1 if doubted and not arguments.anyway else 0


def add_mark_arm(parser: argparse.ArgumentParser) -> None:
    """Add the argument that says where the antenna of the marks is."""
    parser.add_argument(
        "--mark-lever-arm", nargs=3, type=float, metavar=("F", "R", "D"),
        help="with --pos: its antenna to camera, metres forward, right, down (default: the autopilot's lever arm)",
    )  # fmt: skip


def mark_arm(arguments: argparse.Namespace, mounting: Mounting) -> Vector3:
    """From the autopilot's antenna to that of the marks; says so on stderr where the two were taken to be one."""
    forward, right, down = mounting.lever_m
    if arguments.mark_lever_arm is None:
        arm = f"({forward:g}, {right:g}, {down:g}) m, as of the autopilot's antenna"
        print(f"lever arm of the marks' antenna: {arm}; another is given with --mark-lever-arm", file=sys.stderr)
        return (0.0, 0.0, 0.0)
    own = arguments.mark_lever_arm
    return (forward - own[0], right - own[1], down - own[2])


def _vehicle(arguments: argparse.Namespace) -> tuple[dict[int, Tag] | None, list[Finding]]:
    """The tags by another vehicle than the flight followed, where one is named or evidence says so, and doubts."""
    try:
        tags, found = late_tags.by_vehicle(arguments.flight, arguments.vehicle)
    except VehicleError as error:
        if arguments.vehicle is not None:
            raise
        return None, [finding(Code.FLIGHT_VEHICLE_UNDECIDED, Subject("flight"), why=str(error))]
    for one in found:
        print(f"{one.level.word}: {told(one)}", file=sys.stderr)
    return tags, []


def _tag_late(flight: Path, key: SealKey | None, vehicle: int | None, *, into_flight: bool) -> list[int]:
    """Tag the frames that a crash left untagged. If that fails, print why, and go on with the others. Raises
    LockHeldError, which no sidecar could be written under either."""
    try:
        added = late_tags.add_missing(flight, TimeOfDayClock(), key, vehicle)
    except DappledError as error:
        if into_flight and isinstance(error, LockHeldError):
            raise
        print(f"frames without a tag stay without one: {error}", file=sys.stderr)
        return []
    if added:
        print(f"tagged {counted(len(added), 'frame')} that the recording had left without a tag", file=sys.stderr)
    return added


def _marks_json(marked: Marked) -> dict[str, Any]:
    return {
        "placed": sorted(marked.marks),
        "lost": list(marked.lost),
        "extra": to_rows(marked.extra),
        "doubts": to_rows(marked.doubts),
        "offset_s": marked.offset_s,
        "spread_s": marked.spread_s,
        "shift_m": None if marked.shift_m is None else dict(zip(("north", "east", "up"), marked.shift_m, strict=True)),
    }


def _mounting(arguments: argparse.Namespace, facts: dict[str, Any]) -> Mounting:
    """The flight's mounting, with the values that the arguments replace. Raises DappledError for a wrong one."""
    mounting = Mounting.of(facts)
    if arguments.lever_arm is not None:
        forward, right, down = arguments.lever_arm
        mounting = replace(mounting, lever_m=(forward, right, down))
    if arguments.mount is not None:
        camera_pose.mount(mount := tuple(arguments.mount))
        mounting = replace(mounting, mount=mount)
    if arguments.on_gimbal is not None:
        mounting = replace(mounting, on_gimbal=arguments.on_gimbal)
    return mounting


def _geoid(given: str | None) -> Geoid | None:
    try:
        return earth.geoid(given)
    except EarthError as error:
        if given is not None:
            raise
        print(f"heights stay above mean sea level: {error}", file=sys.stderr)
        return None
