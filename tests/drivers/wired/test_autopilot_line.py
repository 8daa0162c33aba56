"""The autopilot presses the shutter, asked over MAVLink: all that a driver must do."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from contextlib import ExitStack
from pathlib import Path

import pytest

from dappled.clock import SystemClock
from dappled.drivers.camera import Identity
from dappled.drivers.mavlink import MavlinkLinks, Packet, mavlink
from dappled.drivers.wired.composed import ComposedCamera, ComposedSettings
from dappled.drivers.wired.shutter_line import parse_line
from dappled.drivers.wired.sources import FolderSource
from dappled.testing import CameraContract, Rig
from tests.simulated.finepix import FinePix, picture

T0 = 1_700_000_000.0
OPEN_US = 1500
"""A servo's pulse above this closes the contact."""


class Pixhawk:
    """An autopilot whose outputs are wired to a body's contact: camera trigger, relay 0, servo 9."""

    def __init__(self, body: FinePix) -> None:
        self._body = body
        self.links = links("udpin:127.0.0.1:0")

    def log_packet(self, stamp_us: int, raw: bytes) -> None:
        return

    def on_packet(self, packet: Packet) -> None:
        message = packet.message
        if packet.sent or message.get_type() != "COMMAND_LONG":
            return
        if message.command == mavlink.MAV_CMD_DO_DIGICAM_CONTROL:
            self._body.contact(message.param5 == 1)
        elif message.command == mavlink.MAV_CMD_DO_SET_RELAY:
            self._body.contact((message.param1, message.param2) == (0, 1))
        elif message.command == mavlink.MAV_CMD_DO_SET_SERVO:
            self._body.contact(message.param1 == 9 and message.param2 > OPEN_US)


class Companion:
    """The camera's side of the link: gives the autopilot orders."""

    def __init__(self, port: int) -> None:
        self.links = links(f"udpout:127.0.0.1:{port}", component=100)

    def log_packet(self, stamp_us: int, raw: bytes) -> None:
        return

    def on_packet(self, packet: Packet) -> None:
        return

    def order(self, command: int, parameters: Sequence[float]) -> str | None:
        """See `shutter_line.Order`."""
        seven = (*parameters, *[0.0] * (7 - len(parameters)))
        sent = self.links.sender.send(mavlink.MAVLink_command_long_message(1, 1, command, 0, *seven))
        return None if sent else "the link is down"


def links(url: str, component: int = 1) -> MavlinkLinks:
    return MavlinkLinks([url], system_id=1, component_id=component, clock=SystemClock())


class TestContractOfTheAutopilotAndAFolder(CameraContract):
    @pytest.fixture(params=["autopilot", "relay:0", "servo:9:1900:1100"])
    def rig(self, request: pytest.FixtureRequest, tmp_path: Path) -> Iterator[Rig]:
        body = FinePix(tmp_path, write_s=0.0, wall_s=lambda: T0)
        with ExitStack() as stack:
            pixhawk = Pixhawk(body)
            pixhawk.links.start(pixhawk)
            stack.callback(pixhawk.links.stop)
            companion = Companion(pixhawk.links.port(0))
            companion.links.start(companion)
            stack.callback(companion.links.stop)
            plan = ComposedSettings(hold_s=0.01, poll_s=0.02)
            identity = Identity("FUJIFILM", "FinePix S5200", "", request.param)
            camera = ComposedCamera(identity, parse_line(request.param), FolderSource(body.card), plan)
            camera.use_autopilot(companion.order)
            stack.callback(camera.stop)
            yield Rig(camera, lambda number: picture(number, 6.3, T0), loose=True)
