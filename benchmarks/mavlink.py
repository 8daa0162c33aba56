"""What the MAVLink side answers in: acknowledgements while both cores decode and while the camera hangs, the way from
a request to the driver's call, and what 1000 messages a second cost.

python benchmarks/mavlink.py [--json] [--seconds 30] [--nice -5]

The daemon runs in processes of its own, as a user starts it. An acknowledgement is timed from the moment before a
command is sent to the kernel's stamp on the answer's arrival, so that a busy machine is not held against the answer
where only this program was late to read it. `echo_ms` is the same of a program that does nothing but return each
datagram, with the daemon's niceness, asked in turn with the daemon: what the machine's scheduler takes alone.
"""

from __future__ import annotations

import argparse
import math
import os
import socket
import statistics
import struct
import subprocess
import sys
import tempfile
import threading
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import replace
from pathlib import Path

import tomli_w
from limits import show

from dappled.config import settings as configuration
from dappled.config.settings import Settings
from dappled.drivers.mavlink import MavlinkMessage, mavlink, pack
from dappled.flight import flight_report
from dappled.mocks.simulation import Simulation, World, free_port

SO_TIMESTAMPNS = 35
RATE_HZ = 200


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--json", action="store_true")
    parser.add_argument("--seconds", type=float, default=30.0, help="of each measurement")
    parser.add_argument("--nice", type=int, default=0, help="of the daemon; the systemd unit has -5")
    wanted = parser.parse_args()
    figures: dict[str, float] = {"load_before": os.getloadavg()[0]}
    with tempfile.TemporaryDirectory(prefix="dpl-") as folder:
        figures |= idle_share(Path(folder) / "share", wanted.seconds)
        figures |= under_load(Path(folder) / "load", wanted.seconds, wanted.nice)
    show("mavlink", figures, as_json=wanted.json)


def idle_share(folder: Path, seconds: float) -> dict[str, float]:
    """Share of one core that the daemon's process takes without a camera, at no and at 1000 messages a second."""
    folder.mkdir()
    port = free_port()
    settings = replace(
        _settings(folder), mavlink=replace(configuration.Settings().mavlink, url=(f"udpin:127.0.0.1:{port}",))
    )
    figures = {}
    with daemon(settings, folder) as process, Station(port) as station:
        station.find()
        for rate in (0, 1000):
            stop = threading.Event()
            sender = threading.Thread(target=station.telemetry, args=(rate, stop))
            sender.start()
            time.sleep(1)
            began, used = time.monotonic(), cpu_s(process.pid)
            time.sleep(seconds)
            figures[f"cpu_share_at_{rate}_per_s"] = (cpu_s(process.pid) - used) / (time.monotonic() - began)
            stop.set()
            sender.join()
    return figures


def under_load(folder: Path, seconds: float, nice: int) -> dict[str, float]:
    """Acknowledgements (ms) at 200 messages a second: while frames are decoded on both cores, then with a camera that
    answers nothing; and how long requests took to the driver's trigger call."""
    folder.mkdir()
    port = free_port()
    base = _settings(folder)
    base = replace(
        base,
        mavlink=replace(base.mavlink, url=(f"udpin:127.0.0.1:{port}",)),
        decode=replace(base.decode, workers=2),
        camera=replace(base.camera, max_pending=1),
    )
    simulation = Simulation(World(), base, folder)
    with (
        simulation as settings,
        daemon(settings, folder, nice) as process,
        echoing(nice) as echo,
        Station(port, echo) as station,
    ):
        station.find()
        stop = threading.Event()
        sender = threading.Thread(target=station.telemetry, args=(RATE_HZ, stop))
        sender.start()
        station.ready(folder)
        station.command(mavlink.MAV_CMD_IMAGE_START_CAPTURE, 0, 0.5, 0, 1)  # faster than two cores decode
        time.sleep(3)
        share = cores_busy()
        decoding = station.acknowledgements(seconds)
        busy = share()
        station.command(mavlink.MAV_CMD_IMAGE_STOP_CAPTURE)
        simulation.body.fault("silence")
        hung = station.acknowledgements(seconds, fire_every_s=2.0)
        simulation.body.fault("clear")
        stop.set()
        sender.join()
        end(process)
        (flight,) = (path for path in (folder / "flights").iterdir() if path.is_dir())
        rows = [line.row for line in flight_report.show(flight).lines]
    calls = sorted(
        (row.fired_called_monotonic_ns - row.shot.wished_monotonic_ns) / 1e6
        for row in rows
        if row.fired_called_monotonic_ns is not None
    )
    return {
        **_spread("ack_ms_decoding", decoding),
        "cores_busy_meanwhile": busy,
        **_spread("ack_ms_camera_hung", hung),
        **_spread("echo_ms", station.echoes),
        **_spread("request_to_trigger_call_ms", calls),
    }


class Station:
    """A ground station at one port of the daemon's: raw bytes, kernel's times."""

    def __init__(self, port: int, echo: int = 0) -> None:
        self._socket, self._echo = _stamped(port), _stamped(echo)
        self.echoes: list[float] = []
        self._packer = mavlink.MAVLink(None, srcSystem=255, srcComponent=190)
        self._vehicle = mavlink.MAVLink(None, srcSystem=1, srcComponent=1)
        self._decode = mavlink.MAVLink(None).decode
        self._sequence = 100

    def __enter__(self) -> Station:
        return self

    def __exit__(self, *_: object) -> None:
        self._socket.close()
        self._echo.close()

    def find(self) -> None:
        """Wait for the camera's heartbeat."""
        until = time.monotonic() + 60
        while time.monotonic() < until:
            self._send(mavlink.MAVLink_heartbeat_message(6, 8, 0, 0, 4, 3))
            if self._hear(0.5, "HEARTBEAT") is not None:
                return
        raise SystemExit("no camera was heard for 60 s")

    def ready(self, folder: Path) -> None:
        """Wait until the camera takes photographs, and for the first one."""
        until = time.monotonic() + 60
        while time.monotonic() < until:
            self.command(mavlink.MAV_CMD_IMAGE_START_CAPTURE, 0, 0, 1, self._next())
            if self._hear(5, "CAMERA_IMAGE_CAPTURED") is not None:
                return
        raise SystemExit(f"no photograph within 60 s; see {folder}")

    def command(self, name: int, *parameters: float) -> float | None:
        """Milliseconds until it was acknowledged; None where it was not within a second."""
        padded = (*parameters, *[0.0] * (7 - len(parameters)))
        message = mavlink.MAVLink_command_long_message(1, 100, name, 0, *padded)
        raw = pack(message, self._packer, version_1=False)
        asked_ns = time.time_ns()
        self._socket.send(raw)
        while (heard := self._hear(1.0, "COMMAND_ACK")) is not None:
            at_ns, ack = heard
            if ack.command == name and ack.target_system == 255:
                return (at_ns - asked_ns) / 1e6
        return None

    def acknowledgements(self, seconds: float, fire_every_s: float = math.inf) -> list[float]:
        """Times of commands, 20 a second; one that never was answered counts as a second."""
        times = []
        began = fired = time.monotonic()
        while time.monotonic() - began < seconds:
            if time.monotonic() - fired > fire_every_s:
                fired = time.monotonic()
                took = self.command(mavlink.MAV_CMD_IMAGE_START_CAPTURE, 0, 0, 1, self._next())
            else:
                took = self.command(mavlink.MAV_CMD_REQUEST_CAMERA_CAPTURE_STATUS, 1)
            times.append(1000.0 if took is None else took)
            time.sleep(0.025)
            self._ask_echo()
            time.sleep(0.025)
        return times

    def _ask_echo(self) -> None:
        asked_ns = time.time_ns()
        self._echo.send(b"echo")
        self._echo.settimeout(1.0)
        try:
            _, extra, _, _ = self._echo.recvmsg(64, 64)
        except TimeoutError:
            self.echoes.append(1000.0)
            return
        self.echoes.append((_arrival_ns(extra) - asked_ns) / 1e6)

    def telemetry(self, rate: int, stop: threading.Event) -> None:
        """Attitude and position of system 1, so many a second."""
        began, sent = time.monotonic(), 0
        while not stop.wait(0.005):
            while sent < rate * (time.monotonic() - began):
                boot_ms = 10_000 + int(sent * 1000 / rate)
                message = mavlink.MAVLink_attitude_message(boot_ms, 0.1, 0.2, 0.3, 0, 0, 0)
                if sent % 10 == 0:
                    message = mavlink.MAVLink_scaled_imu_message(boot_ms, 1, 2, 3, 4, 5, 6, 7, 8, 9)
                self._socket.send(pack(message, self._vehicle, version_1=False))
                sent += 1

    def _next(self) -> int:
        self._sequence += 1
        return self._sequence

    def _send(self, message: MavlinkMessage) -> None:
        self._socket.send(pack(message, self._packer, version_1=False))

    def _hear(self, timeout_s: float, kind: str) -> tuple[int, MavlinkMessage] | None:
        """The next message of this type with the kernel's time of its arrival (ns UTC)."""
        until = time.monotonic() + timeout_s
        while (left := until - time.monotonic()) > 0:
            self._socket.settimeout(left)
            try:
                data, extra, _, _ = self._socket.recvmsg(65536, 64)
            except (TimeoutError, ConnectionRefusedError):
                continue
            message = self._decode(bytearray(data))
            if message.get_type() == kind:
                return _arrival_ns(extra), message
        return None


def _stamped(port: int) -> socket.socket:
    """A UDP socket to a port of loopback, on whose datagrams the kernel stamps their arrival."""
    made = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
    made.setsockopt(socket.SOL_SOCKET, SO_TIMESTAMPNS, 1)
    made.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, 1 << 20)
    made.connect(("127.0.0.1", port))
    return made


def _arrival_ns(extra: Sequence[tuple[int, int, bytes]]) -> int:
    ((_, _, stamp),) = extra
    seconds, nanoseconds = struct.unpack("qq", stamp)
    return int(seconds * 10**9 + nanoseconds)


ECHO = """
import socket, sys
port = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
port.bind(("127.0.0.1", int(sys.argv[1])))
while True:
    data, sender = port.recvfrom(64)
    port.sendto(data, sender)
"""


@contextmanager
def echoing(nice: int) -> Iterator[int]:
    """A program that returns each datagram; its port."""
    port = free_port()
    process = subprocess.Popen(["/usr/bin/nice", "-n", str(nice), sys.executable, "-c", ECHO, str(port)])
    try:
        yield port
    finally:
        end(process)


@contextmanager
def daemon(settings: Settings, folder: Path, nice: int = 0) -> Iterator[subprocess.Popen[bytes]]:
    """`dappled run` with these settings."""
    file = folder / "dappled.toml"
    file.write_text(tomli_w.dumps(configuration.to_tables(settings)), encoding="utf-8")
    log = (folder / "log").open("wb")
    process = subprocess.Popen(
        ["/usr/bin/nice", "-n", str(nice), sys.executable, "-m", "dappled", "run", "--config", str(file)],
        stdout=log,
        stderr=subprocess.STDOUT,
    )
    try:
        yield process
    finally:
        end(process)
        log.close()


def end(process: subprocess.Popen[bytes]) -> None:
    """By SIGTERM, in order."""
    process.terminate()
    try:
        process.wait(20)
    except subprocess.TimeoutExpired:
        process.kill()
        process.wait()


def cpu_s(pid: int) -> float:
    """Processor time of one process so far, without its children."""
    fields = Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()
    return (int(fields[11]) + int(fields[12])) / os.sysconf("SC_CLK_TCK")


def cores_busy() -> Callable[[], float]:
    """Call the answer later: how many cores were at work since."""

    def read() -> tuple[float, float]:
        ticks = [int(word) for word in Path("/proc/stat").read_text().splitlines()[0].split()[1:9]]
        return sum(ticks), ticks[3] + ticks[4]

    total, idle = read()

    def since() -> float:
        now, resting = read()
        return (os.cpu_count() or 1) * (1 - (resting - idle) / max(1.0, now - total))

    return since


def _settings(folder: Path) -> Settings:
    tables = {
        "record": {"directory": str(folder / "flights"), "min_free_mb": 0},
        "publish": {"slices": f"ipc://{folder}/s"},
        "camera": {"port": "ptpip:127.0.0.1:1:1"},
    }
    return configuration.resolve(configuration.of_tables(tables, "benchmark"))


def _spread(name: str, times: Sequence[float]) -> dict[str, float]:
    ordered = sorted(times)
    p99 = ordered[min(len(ordered) - 1, math.ceil(0.99 * len(ordered)) - 1)]
    return {
        f"{name}_median": statistics.median(ordered),
        f"{name}_p99": p99,
        f"{name}_max": ordered[-1],
        f"{name}_count": float(len(ordered)),
    }


if __name__ == "__main__":
    main()
