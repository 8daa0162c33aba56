"""`dappled geotag`: where each frame was taken, for other programs."""

from __future__ import annotations

import argparse
import json
import sys
from pathlib import Path
from typing import Any

from dappled.flight import layout
from dappled.products import camera_pose, geotags


def configure(parser: argparse.ArgumentParser) -> None:
    parser.epilog = (
        "example: dappled geotag ~/flights/20261121T101503Z-0a1b2c3d\n"
        "Writes name.ext.xmp beside each frame, and into geotags/\n"
        "geo.txt (OpenDroneMap), pix4d.csv and track.geojson.\n"
        "The frames themselves are never touched."
    )
    parser.add_argument("flight", type=Path, help="flight folder")
    parser.add_argument("-o", "--output", type=Path, metavar="DIR", help="write everything there instead")
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
    parser.add_argument("--json", action="store_true", help="as JSON")


def run(arguments: argparse.Namespace) -> int:
    facts = layout.read_facts(layout.open_folder(arguments.flight))
    recorded: dict[str, Any] = facts.get("settings", {}).get("pose", {})
    lever = arguments.lever_arm or recorded.get("lever_arm_m") or (0.0, 0.0, 0.0)
    values = arguments.mount or recorded.get("mount")
    written = geotags.write(
        arguments.flight,
        lever_m=(float(lever[0]), float(lever[1]), float(lever[2])),
        mount=camera_pose.NADIR if values is None else camera_pose.mount(tuple(values)),
        output=arguments.output,
        replace_extension=arguments.lightroom,
        force=arguments.force,
    )
    if arguments.json:
        print(
            json.dumps(
                {
                    "files": [str(path) for path in written.files],
                    "placed": written.placed,
                    "without_position": written.without_position,
                    "without_tag": written.without_tag,
                },
                indent=2,
            )
        )
    else:
        print(f"{written.placed} frames placed, {len(written.files)} files written")
    for name in written.without_position:
        print(f"no position is known for {name}", file=sys.stderr)
    for name in written.without_tag:
        print(f"{name} was never tagged", file=sys.stderr)
    return 0
