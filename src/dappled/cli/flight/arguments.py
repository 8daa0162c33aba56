"""Words of `dappled flight coverage`, `gnss`, `pickup`, `report --log`: apart from what they do, which loads slowly."""

from __future__ import annotations

import argparse
from pathlib import Path

from dappled.cli.arguments import add_overwrite, positive, whole

COVERAGE_HELP = (
    "which ground the frames have seen, and the mission that flies the holes again; exits 1 where there are holes"
)
COVERAGE_EXAMPLES = (
    "dappled flight coverage ~/flights/20261121T101503Z-0a1b2c3d --area field.kml",
    "dappled flight coverage --area field.plan --least 2 --refly again.plan",
)
GNSS_HELP = "write the GNSS receiver's stream that a flight recorded (.ubx), for PPK"
GNSS_EXAMPLES = ("dappled flight gnss ~/flights/20261121T101503Z-0a1b2c3d -o rover.ubx",)
PICKUP_HELP = "fetch the files that stayed in the camera; exits 1 if shots still lack files"
PICKUP_EXAMPLES = (
    "dappled flight pickup --from /media/card/DCIM --dry-run",
    "dappled flight pickup ~/flights/20261121T101503Z-0a1b2c3d --from usb: --pair 17=DSCF0042.RAF",
)


def configure_report(parser: argparse.ArgumentParser) -> None:
    parser.add_argument(
        "--log",
        action="append",
        default=[],
        type=Path,
        metavar="FILE",
        help="compare with the autopilot's own log (.bin, .ulg); again for each of its starts in the flight",
    )


def configure_gnss(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("-o", "--output", type=Path, metavar="FILE", help="the file (default: the flight's name.ubx)")
    add_overwrite(parser)


def configure_coverage(parser: argparse.ArgumentParser) -> None:
    parser.add_argument(
        "--area", type=Path, metavar="FILE", help="the planned area: GeoJSON, KML, or a QGroundControl .plan"
    )
    parser.add_argument(
        "--least", type=whole, default=1, metavar="N", help="ground seen by fewer frames is a hole (default: 1)"
    )
    parser.add_argument("--refly", type=Path, metavar="FILE", help="write a mission over the holes (.plan)")
    parser.add_argument(
        "--overlap", type=float, default=0.8, metavar="SHARE", help="of the mission, along a line (default: 0.8)"
    )
    parser.add_argument(
        "--sidelap", type=float, default=0.6, metavar="SHARE", help="of the mission, between lines (default: 0.6)"
    )
    parser.add_argument(
        "-o", "--output", type=Path, metavar="DIR", help="write coverage.tif, .geojson and .png into this folder"
    )
    parser.add_argument("--cell", type=positive, metavar="M", help="side of a map cell (default: 1/500 of the map)")
    parser.add_argument("--ground", type=float, metavar="M", help="height of flat ground (default: home's)")
    parser.add_argument("--terrain", type=Path, metavar="FILE", help="terrain raster: DTED, GeoTIFF …")
    parser.add_argument("--count-bad", action="store_true", help="also count frames that were judged bad in flight")
    parser.add_argument(
        "--count-doubtful", action="store_true", help="also count frames whose place or time is in doubt"
    )
    add_overwrite(parser)


def configure_pickup(parser: argparse.ArgumentParser) -> None:
    parser.add_argument(
        "--from", dest="source", required=True, metavar="SOURCE", help="folder, storage, usb: or a libgphoto2 port"
    )
    parser.add_argument("--offset", type=float, metavar="S", help="the camera's clock minus UTC, if you know it")
    parser.add_argument("--any-clock", action="store_true", help="the camera's clock may be off by more than a day")
    parser.add_argument(
        "--by-order", action="store_true", help="pair files and shots in order, if there are as many of both"
    )
    parser.add_argument(
        "--pair", action="append", default=[], type=_pair, metavar="INDEX=NAME", help="this file belongs to this shot"
    )
    parser.add_argument("--anyway", action="store_true", help="exit 0 also where something is in doubt")
    parser.add_argument("--dry-run", action="store_true", help="only say what would be done")


def _pair(text: str) -> tuple[int, str]:
    index, equals, name = text.partition("=")
    if not equals or not index.isdecimal() or not name:
        raise argparse.ArgumentTypeError(f"{text!r} is not INDEX=NAME, as in 17=DSCF0042.RAF")
    return int(index), name
