"""A camera body in a process of its own: a PTP/IP Canon EOS 450D whose pictures come from a simulated camera.

    python -m dappled.mocks.body.body_process --seed 1 --scale 0.25

prints `port N` once it listens, then obeys lines on its standard input: a fault of `mocks.faults` ("busy 2"), or
"releases", "contact", "card", "move". Every line is answered by one line, `ok …` or `error …`. The end of its input is
its own end, so it never outlives the process that started it.
"""

from __future__ import annotations

import argparse
import os
import signal
import sys
import time
from collections.abc import Iterable, Sequence
from pathlib import Path

from dappled.mocks.body.body import BodyOptions
from dappled.mocks.body.eos450d import SERIAL, Eos450d
from dappled.mocks.body.eos_card import CARD_BYTES
from dappled.mocks.body.faults import Faults
from dappled.mocks.body.pictures import exposer
from dappled.mocks.body.ptpip import Responder


def _obey(line: str, eos: Eos450d, responder: Responder, faults: Faults) -> str:
    if line == "releases":
        return f"ok {eos.releases}"
    if line == "contact":
        return f"ok {int(eos.contact())}"
    if line == "card":
        return f"ok {' '.join(eos.names)}"
    if line == "move":
        responder.move()
        return "ok"
    try:
        faults.command(line)
    except ValueError as error:
        return f"error {error}"
    return "ok"


def _options(arguments: Sequence[str] | None) -> BodyOptions:
    parser = argparse.ArgumentParser(
        prog="python -m dappled.mocks.body.body_process", description=__doc__.partition("\n")[0]
    )
    parser.add_argument("--picture", default="simulated", help="simulated, pattern:SIZE:EXT, or a file")
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--scale", type=float, default=1.0, help="share of the reference sensor's side")
    parser.add_argument("--scene", default="terrain", help="terrain, bench, white, or a folder of views")
    parser.add_argument("--law", default="geometric", help="geometric or fd: where the carriers stand")
    parser.add_argument("--f-number", type=float, help="the simulated lens' aperture; open without it")
    parser.add_argument("--start-monotonic-ns", type=int, help="CLOCK_MONOTONIC at the simulation's start")
    parser.add_argument("--truth", type=Path, help="folder for what the simulation knows of each shot")
    parser.add_argument("--delay", dest="delay_s", type=float, default=0.0, help="seconds that a pattern or file takes")
    parser.add_argument("--serial", default=SERIAL)
    parser.add_argument("--card-bytes", type=int, default=CARD_BYTES, help="the card lies in memory")
    parser.add_argument("--clock-offset", dest="clock_offset_s", type=float, default=0.0, help="s the body is wrong by")
    parser.add_argument("--pairs", action="store_true", help="raw and JPEG of each picture")
    parser.add_argument("--addresses", type=int, default=1, help="ports that it can be moved between")
    parser.add_argument("--fault", dest="faults", action="append", default=[], help='in force from the start: "busy 2"')
    found = vars(parser.parse_args(arguments))
    return BodyOptions(**{**found, "faults": tuple(found["faults"])})


def _say(text: str) -> None:
    sys.stdout.write(text + "\n")
    sys.stdout.flush()


def serve(options: BodyOptions, lines: Iterable[str]) -> None:
    """Be a body until the lines end."""
    faults = Faults(time.monotonic_ns)
    for fault in options.faults:
        faults.command(fault)
    eos = Eos450d(
        exposer(options),
        faults,
        serial=options.serial,
        card_bytes=options.card_bytes,
        wall_s=lambda: time.time() + options.clock_offset_s,
        pairs=options.pairs,
    )
    responder = Responder(eos, faults, addresses=options.addresses)
    _say(f"port {' '.join(map(str, responder.ports))}")
    for line in lines:
        _say(_obey(line.strip(), eos, responder, faults))
    responder.close()


def main(arguments: Sequence[str] | None = None) -> None:
    """The process' entry point."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # ctrl-C reaches the whole group; the starter ends us by our input
    try:
        serve(_options(arguments), sys.stdin)
    except ValueError as error:
        sys.exit(f"body: {error}")
    except BrokenPipeError:
        os._exit(0)  # the starter is gone; nothing is left to be said, not even at the exit


if __name__ == "__main__":
    main()
