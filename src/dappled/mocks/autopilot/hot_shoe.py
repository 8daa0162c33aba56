"""The wire from a simulated body's hot shoe to a simulated autopilot, which tells of each contact by CAMERA_FEEDBACK.

The body writes what it did into a folder (`BodyOptions.truth`); this looks there and speaks as the autopilot does.
"""

from __future__ import annotations

import json
import socket
import threading
from pathlib import Path

from dappled.drivers.mavlink.links import mavlink
from dappled.mocks.autopilot.autopilot import BootTime

_LOOK_S = 0.005


class HotShoe:
    """At work until `close`. `url` is the daemon's own "udpin:HOST:PORT"."""

    def __init__(self, truth: Path, url: str) -> None:
        _, host, port = url.split(":")
        self._truth = truth
        self._socket = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
        self._socket.connect((host, int(port)))
        self._speech = mavlink.MAVLink(None, srcSystem=1, srcComponent=1)
        self._stop = threading.Event()
        self._thread = threading.Thread(target=self._run, name="hot shoe", daemon=True)
        self._thread.start()

    def close(self) -> None:
        """Cut the wire."""
        self._stop.set()
        self._thread.join(5)
        self._socket.close()

    def _run(self) -> None:
        told: set[str] = set()
        while not self._stop.wait(_LOOK_S):
            for path in sorted(self._truth.glob("*.json")):
                if path.name not in told:
                    try:
                        times = json.loads(path.read_text())
                    except ValueError:
                        continue  # it is still written
                    told.add(path.name)
                    self._tell(int(path.stem), times["trigger_t_s"] + times["latency_s"])

    def _tell(self, number: int, opened_t_s: float) -> None:
        boot_us = BootTime().ns(opened_t_s) // 1000
        message = mavlink.MAVLink_camera_feedback_message(boot_us, 1, 0, number, 0, 0, 0.0, 0.0, 0, 0, 0, 0, 0, number)
        self._socket.send(message.pack(self._speech))
