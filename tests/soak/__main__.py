"""Run a soak: a long simulated flight in which something goes wrong every few seconds.

python -m tests.soak --minutes 30 --seed 1
"""

from __future__ import annotations

import argparse
import json
import signal
import sys
import tempfile
import time
from collections.abc import Sequence
from pathlib import Path

from dappled import codec
from dappled.flight import FlightError
from tests.soak.soak import SoakPlan, SoakReport, soak


def main(arguments: Sequence[str] | None = None) -> int:
    """The process' entry point: exit code 1 where a shot is missing or the daemon has grown."""
    parser = argparse.ArgumentParser(prog="python -m tests.soak", description=__doc__.partition("\n")[0])
    parser.add_argument("--minutes", type=float, default=30.0)
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--keep", type=Path, help="folder for flights and the daemon's log (default: a temporary one)")
    wanted = parser.parse_args(arguments)
    signal.signal(signal.SIGTERM, signal.default_int_handler)
    with tempfile.TemporaryDirectory(prefix="soak-") as temporary:
        folder = wanted.keep or Path(temporary)
        folder.mkdir(parents=True, exist_ok=True)
        began = time.monotonic()
        result = soak(
            SoakPlan(wanted.minutes * 60, wanted.seed),
            folder.absolute(),
            lambda text: print(f"{time.monotonic() - began:7.1f} s  {text}", file=sys.stderr),  # noqa: T201  # a tool that prints
        )
    report = {name: getattr(result, name) for name in SoakReport.__slots__ if name not in ("before", "after")}
    report |= {"before": codec.plain(result.before), "after": codec.plain(result.after)}
    print(json.dumps(report, indent=1))  # noqa: T201  # as above
    return 1 if result.problems else 0


if __name__ == "__main__":
    try:
        sys.exit(main())
    except FlightError as error:
        sys.exit(f"soak: {error}")
