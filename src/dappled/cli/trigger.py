"""`dappled trigger`: ask for photographs over MAVLink, as a ground station does."""

from __future__ import annotations

import argparse
import json
from pathlib import Path

from dappled.cli.arguments import seconds, whole
from dappled.cli.terminal import waiting_for
from dappled.daemon.camera_protocol.ground_client import GroundClient, Outcome


def configure(parser: argparse.ArgumentParser) -> None:
    parser.epilog = "example: dappled trigger --url udpout:127.0.0.1:14550 --count 3 --interval 2"
    parser.add_argument(
        "--url", default="udpout:127.0.0.1:14550", help="pymavlink connection string (default: %(default)s)"
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
    with GroundClient(arguments.url, key_file=arguments.key) as client:
        with waiting_for(f"a camera on {arguments.url}"):
            client.find_camera(arguments.timeout)
        outcomes = client.capture(
            arguments.count,
            arguments.interval,
            timeout_s=arguments.timeout,
            on_outcome=lambda one: print(_json(one) if arguments.json else _line(one), flush=True),
        )
    return 0 if all(one.ok for one in outcomes) else 1


def _line(one: Outcome) -> str:
    ack = "" if one.ack_ms is None else f", acknowledged after {one.ack_ms:.1f} ms"
    if one.ok:
        return f"image {one.index}{ack}"
    return f"no image: {one.reason}{ack}"


def _json(one: Outcome) -> str:
    return json.dumps({"index": one.index, "ok": one.ok, "reason": one.reason, "ack_ms": one.ack_ms})
