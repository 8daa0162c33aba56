"""Ground stations that misbehave."""

from __future__ import annotations

import math
import os
import sys
from collections.abc import Sequence
from typing import ClassVar

from dappled.daemon.camera_protocol.ground_client import ACK_TRIES, GroundClient
from dappled.drivers.mavlink import MavlinkMessage, mavlink
from dappled.mocks.autopilot.ground_station import GroundStation, main
from tests.simulated.vehicle import process_of

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


def station(manners: Sequence[str]) -> type[GroundStation]:
    """A ground station with these manners, as a process. See MANNERS."""

    class Rude(GroundStation):
        COMMAND: ClassVar = [*process_of(__name__), *manners]

    return Rude


def run() -> None:
    """The process."""
    manners = [word for word in sys.argv[1:] if word in MANNERS]
    words = [word for word in sys.argv[1:] if word not in MANNERS]
    sys.exit(main(words, lambda url: RudeClient(url, manners)))
