"""A simulated autopilot that flies `FlightPath`, with its own boot clock, over real MAVLink.

`python -m dappled.mocks.autopilot.autopilot --url udpout:127.0.0.1:14550 --seed 1 --start-monotonic-ns N`
"""

from __future__ import annotations

import argparse
import math
import select
import socket
import subprocess
import sys
import threading
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import ClassVar

from dappled.clock import Clock, SystemClock, TimeOfDayClock
from dappled.drivers.child_process import end_child
from dappled.drivers.mavlink import LinkError, MavlinkLinks, MavlinkMessage, Packet, mavlink
from dappled.drivers.python_command import python_module
from dappled.mocks.autopilot import shot_times
from dappled.mocks.autopilot.path import SPEED_M_S, FlightPath, TruePose
from dappled.workers import Loop

RATES_HZ: dict[int, float] = {
    mavlink.MAVLINK_MSG_ID_HEARTBEAT: 1.0,
    mavlink.MAVLINK_MSG_ID_GLOBAL_POSITION_INT: 10.0,
    mavlink.MAVLINK_MSG_ID_ATTITUDE_QUATERNION: 50.0,
    mavlink.MAVLINK_MSG_ID_ATTITUDE: 50.0,
    mavlink.MAVLINK_MSG_ID_GPS_RAW_INT: 5.0,
    mavlink.MAVLINK_MSG_ID_SYSTEM_TIME: 1.0,
}
BATTERY = mavlink.MAVLINK_MSG_ID_SYS_STATUS
_FASTEST_HZ = 100.0
_CELLS, _CHARGED_PERCENT, _DRAIN_S = 6, 96.0, 20.0  # of a lithium polymer battery; a percent each so many seconds


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
        kind, mode = mavlink.MAV_TYPE_QUADROTOR, 81 | mavlink.MAV_MODE_FLAG_SAFETY_ARMED
        return mavlink.MAVLink_heartbeat_message(
            kind, mavlink.MAV_AUTOPILOT_ARDUPILOTMEGA, mode, 3, mavlink.MAV_STATE_ACTIVE, 3
        )
    raise ValueError(f"the simulated autopilot has no message {message_id}")


def battery_status(percent: int) -> MavlinkMessage:
    """SYS_STATUS of a vehicle with this much left; below 10 percent the battery is not healthy."""
    watched = mavlink.MAV_SYS_STATUS_SENSOR_BATTERY
    voltage_mv = _CELLS * (3300 + 9 * percent)
    health = watched if percent >= 10 else 0
    return mavlink.MAVLink_sys_status_message(
        watched, watched, health, 300, voltage_mv, 1800, percent, 0, 0, 0, 0, 0, 0
    )


@dataclass(slots=True)
class Flyer:
    """The running autopilot: sends what is due, answers TIMESYNC and requests for message intervals. On request it
    sends the state of its battery."""

    path: FlightPath
    start_monotonic_ns: int
    boot: BootTime
    send: Callable[[MavlinkMessage], object]
    clock: Clock = field(default_factory=TimeOfDayClock)
    due_ns: dict[int, int] = field(default_factory=dict)
    interval_ns: dict[int, int] = field(default_factory=dict)
    lock: threading.Lock = field(default_factory=threading.Lock)

    def __post_init__(self) -> None:
        for message_id, rate in RATES_HZ.items():
            self.interval_ns[message_id] = round(1e9 / min(rate, self.most_hz(message_id)))
            self.due_ns[message_id] = 0

    def most_hz(self, _number: int) -> float:
        """How often it can send a message."""
        return _FASTEST_HZ

    def has(self, number: float) -> bool:
        """Whether it can send this message."""
        return number in RATES_HZ or number == BATTERY

    def message(self, number: int, pose: TruePose, now_ns: int) -> MavlinkMessage:
        """One that it has, of this moment."""
        if number == BATTERY:
            return battery_status(max(0, round(_CHARGED_PERCENT - self.flown_s(now_ns) / _DRAIN_S)))
        return telemetry_message(number, pose, self.boot_ns(now_ns), self.unix_us(now_ns))

    def flown_s(self, monotonic_ns: int) -> float:
        """Simulation time at a moment of this machine's."""
        return (monotonic_ns - self.start_monotonic_ns) / 1e9

    def boot_ns(self, monotonic_ns: int) -> int:
        """The boot clock at a moment of this machine's."""
        return self.boot.ns(self.flown_s(monotonic_ns))

    def unix_us(self, monotonic_ns: int) -> int:
        """UTC at a moment of this machine's: UTC and boot time of one message are of one moment."""
        return (self.clock.utc_ns() - self.clock.monotonic_ns() + monotonic_ns) // 1000

    def step(self, now_ns: int) -> float:
        """Send what is due; returns the seconds until the next message."""
        with self.lock:
            due = [number for number, at_ns in self.due_ns.items() if now_ns >= at_ns]
            for number in due:
                on_time_ns = self.due_ns[number] + self.interval_ns[number]
                self.due_ns[number] = on_time_ns if on_time_ns > now_ns else now_ns + self.interval_ns[number]
        if due:
            pose = self.path.pose(self.flown_s(now_ns))
            for number in due:
                self.send(self.message(number, pose, now_ns))
        with self.lock:
            next_ns = min(self.due_ns.values())
        return max(0.0, (next_ns - self.clock.monotonic_ns()) / 1e9)

    def log_packet(self, _stamp_us: int, _raw: bytes) -> None:
        """Write a packet to the telemetry log. The simulated autopilot keeps no log."""

    def on_packet(self, packet: Packet) -> None:
        """Take a packet that was logged, received or sent. Answer what came in."""
        message = packet.message
        if packet.sent:
            return
        if message.get_type() == "TIMESYNC" and message.tc1 == 0 and self._asks_us(packet.raw):
            self.send(mavlink.MAVLink_timesync_message(self.boot_ns(self.clock.monotonic_ns()), message.ts1))
        if message.get_type() == "COMMAND_LONG" and message.target_system in (0, 1):
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
        return system in (0, 1) and component in (0, 1)

    def _set_interval(self, number: float, interval_us: float) -> int:
        if not self.has(number):
            return int(mavlink.MAV_RESULT_UNSUPPORTED)
        if not (math.isfinite(interval_us) and interval_us > 0):
            return int(mavlink.MAV_RESULT_DENIED)
        with self.lock:
            self.interval_ns[int(number)] = max(round(interval_us * 1e3), round(1e9 / self.most_hz(int(number))))
            self.due_ns.setdefault(int(number), 0)
        return int(mavlink.MAV_RESULT_ACCEPTED)


class Autopilot:
    """The autopilot as a process of its own, which ends with this one."""

    COMMAND: ClassVar = python_module("dappled.mocks.autopilot.autopilot")

    def __init__(self, process: subprocess.Popen[bytes]) -> None:
        self._process = process

    @classmethod
    def start(
        cls,
        url: str,
        *,
        seed: int,
        start_monotonic_ns: int,
        booted_s: float = BootTime().offset_s,
        more: Sequence[str] = (),
    ) -> Autopilot:
        """Start one that flies `FlightPath(seed)` since `start_monotonic_ns` and speaks on `url` (udpout:HOST:PORT).

        It was booted `booted_s` before the flight began; less than zero: in flight. `more` are options of the
        process."""
        command = [*cls.COMMAND, f"--url={url}", f"--seed={seed}", f"--start-monotonic-ns={start_monotonic_ns}"]
        command += [f"--booted={booted_s}", *more]
        return cls(subprocess.Popen(command, stdin=subprocess.PIPE, process_group=0))

    def running(self) -> bool:
        """Whether the process lives."""
        return self._process.poll() is None

    def stop(self) -> None:
        """End it."""
        assert self._process.stdin is not None
        self._process.stdin.close()
        end_child(self._process, 3.0)


def _euler(pose: TruePose) -> tuple[float, float, float]:
    w, x, y, z = pose.attitude
    roll = math.atan2(2 * (w * x + y * z), 1 - 2 * (x * x + y * y))
    pitch = math.asin(max(-1.0, min(1.0, 2 * (w * y - z * x))))
    return roll, pitch, math.atan2(2 * (w * z + x * y), 1 - 2 * (y * y + z * z))


def options() -> argparse.ArgumentParser:
    """The options of the process."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--url", required=True, action="append", help="a port of it; several: it sends on each")
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--start-monotonic-ns", type=int, default=time.monotonic_ns(), help="when the flight began")
    parser.add_argument("--booted", type=float, default=BootTime().offset_s, help="seconds before the flight began")
    parser.add_argument("--speed", type=float, default=SPEED_M_S, help="m/s over ground")
    return parser


def main(
    wanted: argparse.Namespace, flyer: Callable[[FlightPath, int, BootTime, Callable[..., object]], Flyer] = Flyer
) -> int:
    """Run the process until its input is closed."""
    links = MavlinkLinks(wanted.url, system_id=1, component_id=1, clock=SystemClock())
    path = FlightPath(wanted.seed, speed_m_s=wanted.speed)
    flying = flyer(path, wanted.start_monotonic_ns, BootTime(wanted.booted), links.sender.send)
    try:
        links.start(flying)
    except LinkError as error:
        print(f"autopilot: {error}", file=sys.stderr)  # noqa: T201 (a process that speaks to a person)
        return 1
    try:
        while True:
            readable, _, _ = select.select([sys.stdin], [], [], flying.step(time.monotonic_ns()))
            if readable and not sys.stdin.buffer.read(1):
                return 0
    except KeyboardInterrupt:
        return 0
    finally:
        links.stop()


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
                        times = shot_times.read(path)
                    except ValueError:
                        continue  # it is still written
                    reported.add(path.name)
                    self._report(int(path.stem), times.trigger_t_s + times.latency_s)

    def _report(self, number: int, opened_t_s: float) -> None:
        boot_us = BootTime().ns(opened_t_s) // 1000
        message = mavlink.MAVLink_camera_feedback_message(boot_us, 1, 0, number, 0, 0, 0.0, 0.0, 0, 0, 0, 0, 0, number)
        self._socket.send(message.pack(self._speech))


if __name__ == "__main__":
    sys.exit(main(options().parse_args()))
