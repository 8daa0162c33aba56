"""The simulated autopilot as real ones are: it triggers cameras, forwards between its ports, has a gimbal and a
rangefinder. Its process takes the options of `dappled.mocks.autopilot.autopilot`, and `--forward` and `--camera`."""

from __future__ import annotations

import sys
from collections import deque
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, ClassVar

from dappled.drivers.mavlink import MavlinkMessage, Packet, mavlink
from dappled.mocks.autopilot.autopilot import RATES_HZ, Autopilot, BootTime, Flyer, main, options, telemetry_message
from dappled.mocks.autopilot.path import FlightPath, TruePose
from tests.simulated.on_request import OnRequest
from tests.simulated.personality import CameraPort, CameraTriggers

_LATENCY_NS = 60_000_000  # from a trigger over a wire to the contact


def process_of(module: str) -> list[str]:
    """The command that calls `run` of a module of the tests, from whatever folder."""
    root = str(Path(__file__).parents[2])
    return [sys.executable, "-c", f"import sys; sys.path.insert(0, {root!r}); import {module} as it; it.run()"]


def heartbeat(*, armed: bool, personality: str = "ardupilot") -> MavlinkMessage:
    """The autopilot's heartbeat, in flight (armed) or on the ground."""
    make = mavlink.MAV_AUTOPILOT_PX4 if personality == "px4" else mavlink.MAV_AUTOPILOT_ARDUPILOTMEGA
    mode = 81 | (mavlink.MAV_MODE_FLAG_SAFETY_ARMED if armed else 0)
    state = mavlink.MAV_STATE_ACTIVE if armed else mavlink.MAV_STATE_STANDBY
    return mavlink.MAVLink_heartbeat_message(mavlink.MAV_TYPE_QUADROTOR, make, mode, 3, state, 3)


def flight(path: FlightPath, boot: BootTime, start_s: float, stop_s: float) -> Iterator[tuple[float, MavlinkMessage]]:
    """All telemetry of a stretch of flight, (simulation time, message) in order, without a link."""
    events = sorted(
        (start_s + step / rate, message_id)
        for message_id, rate in RATES_HZ.items()
        for step in range(int((stop_s - start_s) * rate))
    )
    for t_s, message_id in events:
        yield t_s, telemetry_message(message_id, path.pose(t_s), boot.ns(t_s))


class Forwarded:
    """A packet of another component's, which is sent on as it came."""

    def __init__(self, packet: Packet) -> None:
        self._packet = packet

    @property
    def source(self) -> tuple[int, int]:
        """System and component of its sender."""
        return self._packet.message.get_srcSystem(), self._packet.message.get_srcComponent()

    def __getattr__(self, name: str) -> Any:
        """What pymavlink's message of the packet has."""
        return getattr(self._packet.message, name)

    def pack(self, _packer: object, force_mavlink1: bool = False) -> bytes:
        """Its bytes."""
        return self._packet.raw


@dataclass(slots=True)
class PortRelay:
    """Forwards between ports as ArduPilot does (MAVLink_routing): never to the port that a packet came on, and no
    heartbeat to a port that is known as a source of its sender."""

    ports: int
    send: Callable[[MavlinkMessage, int], object]
    sources: set[tuple[int, int, int]] = field(default_factory=set)  # system, component, port

    def __call__(self, message: Forwarded, link: int) -> None:
        self.sources.add((*message.source, link))
        for port in range(self.ports):
            known = message.get_msgId() == mavlink.MAVLINK_MSG_ID_HEARTBEAT and (*message.source, port) in self.sources
            if port != link and not known:
                self.send(message, port)


@dataclass
class Vehicle(Flyer):
    """`cameras` are those that it triggers itself, on command; none: it leaves these commands to cameras. `relay` sends
    what is not for it alone on its other ports, as ArduPilot does; None: it forwards nothing. `request` is what it
    sends on request alone. It sends a message no more often than `fastest_hz` says."""

    cameras: CameraTriggers | None = None
    relay: Callable[[Forwarded, int], object] | None = None
    request: OnRequest = field(default_factory=OnRequest)
    fastest_hz: Mapping[int, float] = field(default_factory=dict)
    contacts: deque[int] = field(default_factory=deque)

    def most_hz(self, number: int) -> float:
        return self.fastest_hz.get(number, super().most_hz(number))

    def has(self, number: float) -> bool:
        return super().has(number) or self.request.has(number)

    def message(self, number: int, pose: TruePose, now_ns: int) -> MavlinkMessage:
        if self.request.has(number):
            return self.request.message(number, pose, self.boot_ns(now_ns))
        if number == mavlink.MAVLINK_MSG_ID_HEARTBEAT and self.cameras is not None:
            return heartbeat(armed=True, personality=self.cameras.personality)
        return super().message(number, pose, now_ns)

    def step(self, now_ns: int) -> float:
        wait_s = super().step(now_ns)
        if self.cameras is not None:
            with self.lock:
                triggered = self.cameras.due(self.boot_ns(now_ns) // 1000, self.unix_us(now_ns))
            self._triggered(triggered, now_ns)
        while self.contacts and self.contacts[0] <= now_ns:
            assert self.cameras is not None
            for message in self.cameras.contact(self.boot_ns(self.contacts.popleft()) // 1000):
                self.send(message)
        return wait_s

    def on_packet(self, packet: Packet) -> None:
        message = packet.message
        target = getattr(message, "target_system", 0), getattr(message, "target_component", 0)
        if packet.sent:
            return
        if self.relay is not None and target != (1, 1) and message.get_type() != "TIMESYNC":
            self.relay(Forwarded(packet), packet.link)
        if message.get_type() == "COMMAND_LONG" and message.target_system in (0, 1) and self.cameras is not None:
            now_ns = self.clock.monotonic_ns()
            with self.lock:
                triggered = self.cameras.command(message, self.boot_ns(now_ns) // 1000, self.unix_us(now_ns))
            self._triggered(triggered, now_ns)
        super().on_packet(packet)

    def _triggered(self, messages: list[MavlinkMessage], now_ns: int) -> None:
        """Send what a trigger makes it send; the hot shoe of the first camera closes a little later."""
        for message in messages:
            self.send(message)
        if messages and self.cameras is not None and self.cameras.cameras[0].pin:
            self.contacts.append(now_ns + _LATENCY_NS)


class VehicleProcess(Autopilot):
    """Such a vehicle as a process of its own."""

    COMMAND: ClassVar = process_of(__name__)


def run() -> None:
    """The process."""
    parser = options()
    parser.add_argument("--forward", action="store_true", help="forward between its ports, as ArduPilot does")
    parser.add_argument("--camera", action="append", type=CameraPort.of, default=[], help="one that it triggers")
    wanted = parser.parse_args()

    def vehicle(path: FlightPath, start_ns: int, boot: BootTime, send: Callable[..., object]) -> Vehicle:
        cameras = CameraTriggers(cameras=tuple(wanted.camera)) if wanted.camera else None
        relay = PortRelay(len(wanted.url), send) if wanted.forward else None
        return Vehicle(path, start_ns, boot, send, cameras=cameras, relay=relay)

    sys.exit(main(wanted, vehicle))
