"""A simulated autopilot that flies `FlightPath`, with its own boot clock, over real MAVLink.

`python -m dappled.mocks.autopilot.autopilot --url udpout:127.0.0.1:14550 --seed 1 --start-monotonic-ns N`
"""

from __future__ import annotations

import argparse
import json
import math
import random
import select
import socket
import subprocess
import sys
import threading
import time
from collections import deque
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from dappled.clock import Clock, SystemClock, TimeOfDayClock
from dappled.drivers.mavlink import LinkError, MavlinkLinks, MavlinkMessage, Packet, mavlink
from dappled.drivers.python_command import python_module
from dappled.mocks.autopilot.on_request import OnRequest
from dappled.mocks.autopilot.path import SPEED_M_S, FlightPath, TruePose
from dappled.mocks.autopilot.personality import PERSONALITIES, CameraPort, CameraTriggers
from dappled.workers import Loop

RATES_HZ: dict[int, float] = {
    mavlink.MAVLINK_MSG_ID_HEARTBEAT: 1.0,
    mavlink.MAVLINK_MSG_ID_GLOBAL_POSITION_INT: 10.0,
    mavlink.MAVLINK_MSG_ID_ATTITUDE_QUATERNION: 50.0,
    mavlink.MAVLINK_MSG_ID_ATTITUDE: 50.0,
    mavlink.MAVLINK_MSG_ID_GPS_RAW_INT: 5.0,
    mavlink.MAVLINK_MSG_ID_SYSTEM_TIME: 1.0,
}
_FASTEST_HZ = 100.0
_LATENCY_NS = 60_000_000  # from a trigger over a wire to the contact


@dataclass(frozen=True, slots=True)
class BootTime:
    """The autopilot's clock: it was booted `offset_s` before the simulation began, and runs fast by `drift`.

    `jumps` are (simulation time, seconds gained), as of a simulator that stalls.
    """

    offset_s: float = 41.7
    drift: float = 50e-6
    jumps: tuple[tuple[float, float], ...] = ()

    def ns(self, t_s: float) -> int:
        """Time since boot at simulation time `t_s`."""
        gained_s = sum(by_s for at_s, by_s in self.jumps if t_s >= at_s)
        return round(((self.offset_s + t_s) * (1 + self.drift) + gained_s) * 1e9)


def _jump(text: str) -> tuple[float, float]:
    """From "AT:BY", both in seconds. Raises ValueError."""
    at_s, _, by_s = text.partition(":")
    return float(at_s), float(by_s)


def telemetry_message(message_id: int, pose: TruePose, boot_ns: int, unix_us: int = 0) -> MavlinkMessage:
    """One message of the vehicle's state, in the units, steps and whole milliseconds of MAVLink."""
    boot_ms, v = boot_ns // 10**6, pose.velocity_ned_m_s
    latitude, longitude = round(pose.latitude_deg * 1e7), round(pose.longitude_deg * 1e7)
    altitude = round(pose.altitude_msl_m * 1e3)
    if message_id == mavlink.MAVLINK_MSG_ID_GLOBAL_POSITION_INT:
        vn, ve, vd = (round(part * 100) for part in v)
        height = round(-pose.position_ned_m[2] * 1e3)
        heading = round(math.degrees(_euler(pose)[2]) * 100) % 36000
        return mavlink.MAVLink_global_position_int_message(
            boot_ms, latitude, longitude, altitude, height, vn, ve, vd, heading
        )
    if message_id == mavlink.MAVLINK_MSG_ID_ATTITUDE_QUATERNION:
        return mavlink.MAVLink_attitude_quaternion_message(boot_ms, *pose.attitude, *pose.rates_body_rad_s)
    if message_id == mavlink.MAVLINK_MSG_ID_ATTITUDE:
        return mavlink.MAVLink_attitude_message(boot_ms, *_euler(pose), *pose.rates_body_rad_s)
    if message_id == mavlink.MAVLINK_MSG_ID_GPS_RAW_INT:
        speed = round(math.hypot(v[0], v[1]) * 100)
        course = round(math.degrees(math.atan2(v[1], v[0])) * 100) % 36000
        return mavlink.MAVLink_gps_raw_int_message(
            boot_ns // 1000, 6, latitude, longitude, altitude, 70, 110, speed, course, 17, 0, 20, 30, 50, 0, 0
        )
    if message_id == mavlink.MAVLINK_MSG_ID_SYSTEM_TIME:
        return mavlink.MAVLink_system_time_message(unix_us, boot_ms)
    if message_id == mavlink.MAVLINK_MSG_ID_HEARTBEAT:
        return heartbeat(armed=True)
    raise ValueError(f"the simulated autopilot has no message {message_id}")


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


@dataclass(slots=True)
class Flyer:
    """The running autopilot: sends what is due, answers TIMESYNC and message interval requests, delays telemetry.

    `cameras` are those that it triggers itself, on command; none: it leaves these commands to cameras. `relay` sends
    what is not for it alone on its other ports, as ArduPilot does; None: it forwards nothing. `has` is what it sends
    on request alone. It is armed from `arms_s` after the flight's beginning on, and sends a message no
    more often than `fastest_hz` says.
    """

    path: FlightPath
    start_monotonic_ns: int
    boot: BootTime
    send: Callable[[MavlinkMessage], object]
    jitter_s: float = 0.0
    system_id: int = 1
    cameras: CameraTriggers | None = None
    relay: Callable[[Forwarded, int], object] | None = None
    has: OnRequest = field(default_factory=OnRequest)
    arms_s: float = 0.0
    due_ns: dict[int, int] = field(default_factory=dict)
    interval_ns: dict[int, int] = field(default_factory=dict)
    lock: threading.Lock = field(default_factory=threading.Lock)
    delayed: deque[tuple[int, MavlinkMessage]] = field(default_factory=deque)
    contacts: deque[int] = field(default_factory=deque)
    random: random.Random = field(default_factory=lambda: random.Random(0))  # noqa: S311 (a simulation)
    clock: Clock = field(default_factory=TimeOfDayClock)
    fastest_hz: Mapping[int, float] = field(default_factory=dict)

    def __post_init__(self) -> None:
        for message_id, rate in RATES_HZ.items():
            self.interval_ns[message_id] = round(1e9 / min(rate, self.fastest_hz.get(message_id, rate)))
            self.due_ns[message_id] = 0

    def boot_ns(self, monotonic_ns: int) -> int:
        """The boot clock at a moment of this machine's."""
        return self.boot.ns((monotonic_ns - self.start_monotonic_ns) / 1e9)

    def unix_us(self, monotonic_ns: int) -> int:
        """UTC at a moment of this machine's: UTC and boot time of one message are of one moment."""
        return (self.clock.utc_ns() - self.clock.monotonic_ns() + monotonic_ns) // 1000

    def step(self, now_ns: int) -> float:
        """Send what is due; returns the seconds until the next message."""
        pose: TruePose | None = None
        with self.lock:
            due = [number for number, at_ns in self.due_ns.items() if now_ns >= at_ns]
            for number in due:
                on_time_ns = self.due_ns[number] + self.interval_ns[number]
                self.due_ns[number] = on_time_ns if on_time_ns > now_ns else now_ns + self.interval_ns[number]
        for number in due:
            if pose is None:
                pose = self.path.pose((now_ns - self.start_monotonic_ns) / 1e9)
            boot_ns = self.boot_ns(now_ns)
            flown_s = (now_ns - self.start_monotonic_ns) / 1e9
            if self.has.has(number):
                message = self.has.message(number, pose, boot_ns, flown_s)
            elif number == mavlink.MAVLINK_MSG_ID_HEARTBEAT:
                armed = flown_s >= self.arms_s
                message = heartbeat(
                    armed=armed, personality="ardupilot" if self.cameras is None else self.cameras.personality
                )
            else:
                message = telemetry_message(number, pose, boot_ns, self.unix_us(now_ns))
            self._later(message, now_ns)
        if self.cameras is not None:
            with self.lock:
                triggered = self.cameras.due(self.boot_ns(now_ns) // 1000, self.unix_us(now_ns))
            self._triggered(triggered, now_ns)
        while self.contacts and self.contacts[0] <= now_ns:
            assert self.cameras is not None
            for message in self.cameras.contact(self.boot_ns(self.contacts.popleft()) // 1000):
                self.send(message)
        while self.delayed and self.delayed[0][0] <= now_ns:
            self.send(self.delayed.popleft()[1])
        with self.lock:
            next_ns = min(self.due_ns.values())
        if self.delayed:
            next_ns = min(next_ns, self.delayed[0][0])
        return max(0.0, (next_ns - self.clock.monotonic_ns()) / 1e9)

    def log_packet(self, _stamp_us: int, _raw: bytes) -> None:
        """Write a packet to the telemetry log. The simulated autopilot keeps no log."""

    def on_packet(self, packet: Packet) -> None:
        """Take a packet that was logged, received or sent. Answer what came in."""
        message = packet.message
        if packet.sent:
            return
        target = getattr(message, "target_system", 0), getattr(message, "target_component", 0)
        if self.relay is not None and target != (self.system_id, 1) and message.get_type() != "TIMESYNC":
            self.relay(Forwarded(packet), packet.link)
        if message.get_type() == "TIMESYNC" and message.tc1 == 0 and self._asks_us(packet.raw):
            self.send(mavlink.MAVLink_timesync_message(self.boot_ns(self.clock.monotonic_ns()), message.ts1))
        if message.get_type() == "COMMAND_LONG" and message.target_system in (0, self.system_id):
            if self.cameras is not None:
                now_ns = self.clock.monotonic_ns()
                with self.lock:
                    triggered = self.cameras.command(message, self.boot_ns(now_ns) // 1000, self.unix_us(now_ns))
                self._triggered(triggered, now_ns)
            if message.command != mavlink.MAV_CMD_SET_MESSAGE_INTERVAL or message.target_component not in (0, 1):
                return
            result = self._set_interval(message.param1, message.param2)
            sender = (message.get_srcSystem(), message.get_srcComponent())
            self.send(mavlink.MAVLink_command_ack_message(message.command, result, 0, 0, *sender))

    def _asks_us(self, request: bytes) -> bool:
        """Whether a TIMESYNC is for this component: its target is an extension of version 2 that pymavlink leaves
        out."""
        payload = request[10 : 10 + request[1]] if request[0] == 0xFD else b""
        system, component = (*payload[16:18], 0, 0)[:2]
        return system in (0, self.system_id) and component in (0, 1)

    def _set_interval(self, number: float, interval_us: float) -> int:
        if number not in RATES_HZ and not self.has.has(number):
            return int(mavlink.MAV_RESULT_UNSUPPORTED)
        if not (math.isfinite(interval_us) and interval_us > 0):
            return int(mavlink.MAV_RESULT_DENIED)
        with self.lock:
            self.interval_ns[int(number)] = max(
                round(interval_us * 1e3), round(1e9 / self.fastest_hz.get(int(number), _FASTEST_HZ))
            )
            self.due_ns.setdefault(int(number), 0)
        return int(mavlink.MAV_RESULT_ACCEPTED)

    def _triggered(self, messages: list[MavlinkMessage], now_ns: int) -> None:
        """Send what a trigger makes it send; the hot shoe of the first camera closes a little later."""
        for message in messages:
            self.send(message)
        if messages and self.cameras is not None and self.cameras.cameras[0].pin:
            self.contacts.append(now_ns + _LATENCY_NS)

    def _later(self, message: MavlinkMessage, now_ns: int) -> None:
        if self.jitter_s <= 0 and not self.delayed:
            self.send(message)
            return
        at_ns = now_ns + round(self.random.uniform(0, self.jitter_s) * 1e9)
        if self.delayed:
            at_ns = max(at_ns, self.delayed[-1][0])
        self.delayed.append((at_ns, message))


class Autopilot:
    """The autopilot as a process of its own, which ends with this one."""

    def __init__(self, process: subprocess.Popen[bytes]) -> None:
        self._process = process

    @classmethod
    def start(
        cls,
        url: str,
        *,
        seed: int,
        start_monotonic_ns: int,
        jitter_s: float = 0.0,
        booted_s: float = BootTime().offset_s,
        more: Sequence[str] = (),
    ) -> Autopilot:
        """Start one that flies `FlightPath(seed)` since `start_monotonic_ns` and speaks on `url` (udpout:HOST:PORT).

        It was booted `booted_s` before the flight began; less than zero: in flight. `more` are options of the
        process, such as `--forward` and further ports (`--url=…`)."""
        command = python_module("dappled.mocks.autopilot.autopilot", "--with-parent", "--url", url, "--seed", str(seed))
        command += ["--start-monotonic-ns", str(start_monotonic_ns), "--jitter", str(jitter_s)]
        command += [f"--booted={booted_s}", *more]
        return cls(subprocess.Popen(command, stdin=subprocess.PIPE, process_group=0))

    def running(self) -> bool:
        """Whether the process lives."""
        return self._process.poll() is None

    def stop(self) -> None:
        """End it."""
        assert self._process.stdin is not None
        self._process.stdin.close()
        try:
            self._process.wait(3)
        except subprocess.TimeoutExpired:
            self._process.kill()
            self._process.wait(3)


def _euler(pose: TruePose) -> tuple[float, float, float]:
    w, x, y, z = pose.attitude
    roll = math.atan2(2 * (w * x + y * z), 1 - 2 * (x * x + y * y))
    pitch = math.asin(max(-1.0, min(1.0, 2 * (w * y - z * x))))
    return roll, pitch, math.atan2(2 * (w * z + x * y), 1 - 2 * (y * y + z * z))


def main(arguments: list[str] | None = None) -> int:
    """Run the process."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--url", required=True, action="append", help="a port of it; several: it sends on each")
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--start-monotonic-ns", type=int, default=None, help="when the flight began; default now")
    parser.add_argument("--system-id", type=int, default=1)
    parser.add_argument("--jitter", type=float, default=0.0, help="seconds that telemetry may be late")
    parser.add_argument("--booted", type=float, default=BootTime().offset_s, help="seconds before the flight began")
    parser.add_argument("--personality", choices=PERSONALITIES, default="ardupilot", help="whose messages it sends")
    parser.add_argument(
        "--camera",
        action="append",
        type=CameraPort.of,
        default=[],
        help="a camera that it triggers on command: mavlink, broadcast or wire, and :pin for a wired hot shoe",
    )
    parser.add_argument("--drift", type=float, default=BootTime().drift, help="share by which its clock runs fast")
    parser.add_argument("--jump", action="append", type=_jump, default=[], help="AT:BY, seconds its clock gains at AT")
    parser.add_argument("--arms", type=float, default=0.0, help="seconds from the flight's beginning until it is armed")
    parser.add_argument("--battery", type=float, default=96.0, help="percent left at the flight's beginning")
    parser.add_argument("--gimbal", action="store_true", help="it has a gimbal, and sends its attitude on request")
    parser.add_argument("--ground", type=float, help="ground above the take-off place, m, for a rangefinder")
    parser.add_argument("--speed", type=float, default=SPEED_M_S, help="m/s over ground")
    parser.add_argument("--forward", action="store_true", help="forward between its ports, as ArduPilot does")
    parser.add_argument("--with-parent", action="store_true", help="end when standard input is closed")
    wanted = parser.parse_args(arguments)
    start_ns = time.monotonic_ns() if wanted.start_monotonic_ns is None else wanted.start_monotonic_ns
    links = MavlinkLinks(wanted.url, system_id=wanted.system_id, component_id=1, clock=SystemClock())
    boot = BootTime(wanted.booted, wanted.drift, tuple(wanted.jump))
    cameras = CameraTriggers(wanted.personality, tuple(wanted.camera), wanted.system_id) if wanted.camera else None
    path = FlightPath(wanted.seed, speed_m_s=wanted.speed)
    flyer = Flyer(path, start_ns, boot, links.sender.send, wanted.jitter, wanted.system_id, cameras)
    flyer.has, flyer.arms_s = OnRequest(wanted.gimbal, wanted.battery, wanted.ground), wanted.arms
    if wanted.forward:
        flyer.relay = PortRelay(len(wanted.url), links.sender.send)
    try:
        links.start(flyer)
    except LinkError as error:
        print(f"autopilot: {error}", file=sys.stderr)  # noqa: T201 (a process that speaks to a person)
        return 1
    watched = [sys.stdin] if wanted.with_parent else []
    try:
        while True:
            wait_s = flyer.step(time.monotonic_ns())
            readable, _, _ = select.select(watched, [], [], wait_s)
            if readable and not sys.stdin.buffer.read(1):
                return 0
    except KeyboardInterrupt:
        return 0
    finally:
        links.stop()


if __name__ == "__main__":
    sys.exit(main())


_LOOK_S = 0.005


class HotShoe:
    """At work until `close`. `url` is the daemon's own "udpin:HOST:PORT"."""

    def __init__(self, truth: Path, url: str) -> None:
        _, host, port = url.split(":")
        self._truth = truth
        self._socket = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
        self._socket.connect((host, int(port)))
        self._speech = mavlink.MAVLink(None, srcSystem=1, srcComponent=1)
        self._loop = Loop("hot shoe", self._run)
        self._loop.start()

    def close(self) -> None:
        """Stop reporting."""
        self._loop.stop(5)
        self._socket.close()

    def _run(self) -> None:
        reported: set[str] = set()
        while not self._loop.stopping.wait(_LOOK_S):
            for path in sorted(self._truth.glob("*.json")):
                if path.name not in reported:
                    try:
                        times = json.loads(path.read_text())
                    except ValueError:
                        continue  # it is still written
                    reported.add(path.name)
                    self._report(int(path.stem), times["trigger_t_s"] + times["latency_s"])

    def _report(self, number: int, opened_t_s: float) -> None:
        boot_us = BootTime().ns(opened_t_s) // 1000
        message = mavlink.MAVLink_camera_feedback_message(boot_us, 1, 0, number, 0, 0, 0.0, 0.0, 0, 0, 0, 0, 0, number)
        self._socket.send(message.pack(self._speech))
