"""`dappled trigger`: ask for photographs over MAVLink, as a ground station does."""

from __future__ import annotations

import argparse
import json
import math
from dataclasses import dataclass
from pathlib import Path

from dappled.cli.arguments import seconds, whole
from dappled.cli.terminal import waiting_for
from dappled.config import settings
from dappled.daemon.camera_protocol.ground_client import GroundClient, Outcome
from dappled.daemon.pipeline.spacing import MOST_M
from dappled.drivers.mavlink import LinkError, parse

DEFAULT_URL = "udpout:127.0.0.1:14550"
_CALLED_AT = {"udpin": "udpout", "tcpin": "tcp"}


@dataclass(frozen=True, slots=True)
class Distance:
    """What --distance asks for: metres, 0 for an end; None: as the camera's settings say."""

    metres: float | None

    def __str__(self) -> str:
        return "settings" if self.metres is None else f"{self.metres:g}"

    @property
    def told(self) -> str:
        if self.metres is None:
            return "photographs by the camera's own settings: they go on until --distance off"
        return f"a photograph every {self.metres:g} m, until --distance off" if self.metres else "no more photographs"


def _distance(text: str) -> Distance:
    if text in ("settings", "off"):
        return Distance(None if text == "settings" else 0.0)
    try:
        metres = float(text)
    except ValueError:
        metres = math.nan
    if not 0 < metres <= MOST_M:
        raise argparse.ArgumentTypeError(f"{text!r} is neither a distance of up to {MOST_M:g} m, nor settings, nor off")
    return Distance(metres)


def configure(parser: argparse.ArgumentParser) -> None:
    parser.epilog = "example: dappled trigger --url udpout:127.0.0.1:14550 --count 3 --interval 2"
    where = parser.add_mutually_exclusive_group()
    where.add_argument("--url", help=f"pymavlink connection string (default: {DEFAULT_URL})")
    where.add_argument(
        "--config",
        type=Path,
        metavar="FILE",
        help="the daemon's settings file, which names its link",
    )
    parser.add_argument(
        "--distance",
        type=_distance,
        metavar="M",
        help="have the camera take a photograph every M metres over ground; settings: as its settings say, by distance "
        "or overlap; off: no more",
    )
    parser.add_argument("--count", type=whole, default=1, metavar="N", help="number of photographs (default: 1)")
    parser.add_argument(
        "--interval", type=seconds, default=0.0, metavar="S", help="least time between them (default: 0)"
    )
    parser.add_argument(
        "--timeout",
        type=seconds,
        default=60.0,
        metavar="S",
        help="how long to wait for the camera, and for each photograph (default: 60)",
    )
    parser.add_argument("--key", type=Path, metavar="FILE", help="the link's signing key (dappled mavlink key)")
    parser.add_argument("--json", action="store_true", help="print one JSON object per photograph")


def run(arguments: argparse.Namespace) -> int:
    url, key = _link(arguments)
    with GroundClient(url, key_file=key) as client:
        with waiting_for(f"a camera on {url}"):
            client.find_camera(arguments.timeout)
        if arguments.distance is not None:
            client.by_distance(arguments.distance.metres)
            print(json.dumps({"distance": str(arguments.distance)}) if arguments.json else arguments.distance.told)
            return 0
        outcomes = client.capture(
            arguments.count,
            arguments.interval,
            timeout_s=arguments.timeout,
            on_outcome=lambda one: print(_json(one) if arguments.json else _line(one), flush=True),
        )
    return 0 if all(one.ok for one in outcomes) else 1


def _link(arguments: argparse.Namespace) -> tuple[str, Path | None]:
    """The url to call at, and its key. Raises LinkError where the settings file names no link that can be called."""
    if arguments.config is None:
        return arguments.url or DEFAULT_URL, arguments.key
    mavlink = settings.load(arguments.config).mavlink
    for number, url in enumerate(mavlink.url):
        at = parse(url)
        if at.kind in _CALLED_AT:
            key = mavlink.link_keys[number]
            host = "127.0.0.1" if at.host == "0.0.0.0" else at.host  # noqa: S104  # nothing is bound to it here
            return f"{_CALLED_AT[at.kind]}:{host}:{at.port}", arguments.key or (Path(key) if key else None)
    raise LinkError(
        f"{arguments.config} names no link that listens: a ground station reaches the daemon by udpin: or tcpin: in "
        "mavlink.url, or on the autopilot's network; give --url"
    )


def _line(one: Outcome) -> str:
    ack = "" if one.ack_ms is None else f", acknowledged after {one.ack_ms:.1f} ms"
    if one.ok:
        return f"image {one.index}{ack}"
    return f"no image: {one.reason}{ack}"


def _json(one: Outcome) -> str:
    return json.dumps({"index": one.index, "ok": one.ok, "reason": one.reason, "ack_ms": one.ack_ms})
