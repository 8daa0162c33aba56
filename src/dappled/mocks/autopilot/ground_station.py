"""A simulated ground station in a process of its own: requests photographs, prints the result of each.

    python -m dappled.mocks.autopilot.ground_station --url udpout:127.0.0.1:14550 --count 8

exits 0 if all photographs were taken.
"""

from __future__ import annotations

import argparse
import json
import signal
import subprocess
import sys
from collections.abc import Callable
from typing import ClassVar, Self

from dappled.daemon.camera_protocol.ground_client import GroundClient, GroundStationError, Outcome
from dappled.drivers.mavlink import LinkError
from dappled.drivers.python_command import python_module


class GroundStation:
    """The ground station as a process; `wait` returns the results."""

    COMMAND: ClassVar = python_module("dappled.mocks.autopilot.ground_station")

    def __init__(self, process: subprocess.Popen[str]) -> None:
        self._process = process

    @classmethod
    def start(cls, url: str, count: int, interval_s: float = 0.0, timeout_s: float = 60.0) -> Self:
        """Start one that asks for `count` photographs; its lines (JSON) are read by `wait`."""
        command = [*cls.COMMAND, "--url", url, "--count", str(count)]
        command += ["--interval", str(interval_s), "--timeout", str(timeout_s)]
        return cls(
            subprocess.Popen(command, stdout=subprocess.PIPE, stdin=subprocess.DEVNULL, text=True, process_group=0)
        )

    def running(self) -> bool:
        """Whether it is still running."""
        return self._process.poll() is None

    def wait(self, timeout_s: float) -> tuple[int, list[dict[str, object]]]:
        """Exit code, and one mapping a photograph. Raises subprocess.TimeoutExpired."""
        out, _ = self._process.communicate(timeout=timeout_s)
        return self._process.returncode, [json.loads(line) for line in out.splitlines()]

    def stop(self) -> None:
        """End it now."""
        if self.running():
            self._process.terminate()
        self._process.communicate(timeout=5)


def _line(outcome: Outcome) -> str:
    facts = {"sequence": outcome.sequence, "index": outcome.index, "ok": outcome.ok}
    return json.dumps(facts | {"reason": outcome.reason, "ack_ms": outcome.ack_ms})


def main(arguments: list[str] | None = None, client: Callable[[str], GroundClient] = GroundClient) -> int:
    """The process."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--url", required=True)
    parser.add_argument("--count", type=int, required=True)
    parser.add_argument("--interval", type=float, default=0.0, help="seconds between requests, at least")
    parser.add_argument(
        "--timeout", type=float, default=60.0, help="seconds to wait for the camera, and for each photo"
    )
    wanted = parser.parse_args(arguments)
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # a ^C reaches the whole group; the starter ends us
    try:
        with client(wanted.url) as asking:
            asking.find_camera(wanted.timeout)
            outcomes = asking.capture(
                wanted.count,
                wanted.interval,
                timeout_s=wanted.timeout,
                on_outcome=lambda outcome: print(_line(outcome), flush=True),  # noqa: T201 (a process that prints)
            )
    except (GroundStationError, LinkError) as error:
        print(f"ground station: {error}", file=sys.stderr)  # noqa: T201 (as above)
        return 1
    return 0 if all(outcome.ok for outcome in outcomes) else 1


if __name__ == "__main__":
    sys.exit(main())
