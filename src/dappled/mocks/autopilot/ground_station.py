"""A simulated ground station in a process of its own: requests photographs, prints the result of each.

    python -m dappled.mocks.autopilot.ground_station --url udpout:127.0.0.1:14550 --count 8

exits 0 if all photographs were taken. It can misbehave: see `MANNERS`.
"""

from __future__ import annotations

import argparse
import json
import math
import os
import signal
import subprocess
import sys
from collections.abc import Sequence

from dappled.daemon.camera_protocol.ground_client import ACK_TRIES, GroundClient, GroundStationError, Outcome
from dappled.drivers.mavlink import LinkError, MavlinkMessage, mavlink
from dappled.drivers.python_command import python_module

MANNERS = {
    "deaf": "hears no answer: it sends each command four times, always with confirmation 0",
    "nan": "sets parameters that a command doesn't need to NaN",
    "dies": "ends as soon as it has requested a photograph",
}


class RudeClient(GroundClient):
    """A ground station with these manners."""

    def __init__(self, url: str, manners: Sequence[str]) -> None:
        super().__init__(url)
        self._manners = manners

    def send_command(self, message: MavlinkMessage) -> None:
        """Send a command, spoilt by these manners (`MANNERS`)."""
        if "nan" in self._manners:
            for name in ("param5", "param6", "param7"):
                setattr(message, name, math.nan)
        if "deaf" in self._manners:
            message.confirmation = 0
        for _ in range(ACK_TRIES if "deaf" in self._manners else 1):
            super().send_command(message)
        if "dies" in self._manners and message.command == mavlink.MAV_CMD_IMAGE_START_CAPTURE:
            os._exit(9)


class GroundStation:
    """The ground station as a process; `wait` returns the results."""

    def __init__(self, process: subprocess.Popen[str]) -> None:
        self._process = process

    @classmethod
    def start(
        cls, url: str, count: int, interval_s: float = 0.0, timeout_s: float = 60.0, manners: Sequence[str] = ()
    ) -> GroundStation:
        """Start one that asks for `count` photographs; its lines (JSON) are read by `wait`. See MANNERS."""
        command = python_module("dappled.mocks.autopilot.ground_station", "--url", url, "--count", str(count))
        command += ["--interval", str(interval_s), "--timeout", str(timeout_s)]
        command += [text for one in manners for text in ("--manners", one)]
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


def main(arguments: list[str] | None = None) -> int:
    """The process."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--url", required=True)
    parser.add_argument("--count", type=int, required=True)
    parser.add_argument("--interval", type=float, default=0.0, help="seconds between requests, at least")
    parser.add_argument(
        "--timeout", type=float, default=60.0, help="seconds to wait for the camera, and for each photo"
    )
    parser.add_argument("--manners", action="append", choices=list(MANNERS), default=[], help="how it misbehaves")
    wanted = parser.parse_args(arguments)
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # a ^C reaches the whole group; the starter ends us
    try:
        with RudeClient(wanted.url, wanted.manners) as client:
            client.find_camera(wanted.timeout)
            outcomes = client.capture(
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
