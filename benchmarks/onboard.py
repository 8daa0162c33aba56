"""What a frame takes of the companion computer: CPU time of each process of the daemon, memory, time to the slices.

python benchmarks/onboard.py [--json] [--frames 12]

A daemon as a user starts it, with a simulated body (libgphoto2 over PTP/IP) and autopilot in processes of their own,
frames of 10 MP asked for one after the other by MAVLink, one subscriber of the slices. CPU time is counted when the
daemon is warm; what it takes while it waits, measured before, is taken off. Decoder and camera driver (libgphoto2) are
processes of their own; `daemon` is the rest: recorder, telemetry, tags, publishing. Memory is the peak of each (VmHWM).
`first_frame_s` is from the command `dappled run --simulate --frames 1` to its end, with the flight on the disk.
"""

from __future__ import annotations

import argparse
import os
import signal
import socket
import statistics
import subprocess
import sys
import tempfile
import time
from dataclasses import replace
from pathlib import Path

import tomli_w
import zmq
from limits import show
from service import family, imports_s

from dappled.config import settings as configuration
from dappled.config.settings import PublishSettings, RecordSettings, Settings
from dappled.mocks.simulation import Simulation, World

WARM, IDLE_S, PATIENCE_S = 3, 5.0, 60.0
"""Frames before counting; seconds of waiting that are measured; seconds that a frame may take."""


def used_s(pid: int) -> float:
    """CPU time of one process and its threads so far."""
    fields = Path(f"/proc/{pid}/stat").read_text(encoding="ascii").rpartition(")")[2].split()
    return (int(fields[11]) + int(fields[12])) / os.sysconf("SC_CLK_TCK")


def name_of(pid: int, daemon: int) -> str:
    """What a process of the daemon does."""
    words = Path(f"/proc/{pid}/cmdline").read_bytes()
    return "daemon" if pid == daemon else "decoder" if b"decode_worker" in words else "camera"


def peak_mb(pid: int) -> float:
    """Largest resident memory of a process so far."""
    text = Path(f"/proc/{pid}/status").read_text(encoding="ascii")
    return next(int(line.split()[1]) for line in text.splitlines() if line.startswith("VmHWM")) / 1e3


def started(config: Path, folder: Path) -> subprocess.Popen[bytes]:
    """A daemon that said READY."""
    address = folder / "notify"
    with socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM) as manager:
        manager.bind(str(address))
        manager.settimeout(PATIENCE_S)
        daemon = subprocess.Popen(
            [sys.executable, "-m", "dappled", "run", "--config", str(config)],
            env=os.environ | {"NOTIFY_SOCKET": str(address)},
            stdout=subprocess.DEVNULL,
            stderr=subprocess.DEVNULL,
        )
        while manager.recv(4096) != b"READY=1":
            pass
    return daemon


def received(stream: zmq.Socket[bytes]) -> float:
    """Wait for the slices of one frame; returns when they came. Raises SystemExit where none come."""
    if not stream.poll(round(PATIENCE_S * 1e3)):
        raise SystemExit(f"no slices within {PATIENCE_S:.0f} s")
    stream.recv_multipart()
    return time.perf_counter()


def measure(folder: Path, frames: int) -> dict[str, object]:
    """Fly so many frames, and some to warm up; what each took."""
    slices = f"ipc://{folder}/slices"
    given = replace(
        Settings(), record=RecordSettings(directory=str(folder / "flights")), publish=PublishSettings(slices=slices)
    )
    simulation = Simulation(World(scale=1.0), given, folder)
    with simulation as settings, zmq.Context() as context, context.socket(zmq.SUB) as stream:
        config = folder / "dappled.toml"
        config.write_text(tomli_w.dumps(configuration.to_tables(settings)), encoding="utf-8")
        stream.setsockopt(zmq.SUBSCRIBE, b"slices")
        stream.setsockopt(zmq.RCVHWM, 4)
        stream.connect(slices)
        daemon = started(config, folder)
        try:
            for _ in range(WARM):
                simulation.ground_station(1).wait(PATIENCE_S)
                received(stream)
            time.sleep(1.0)
            processes = family(daemon.pid)
            names = [name_of(pid, daemon.pid) for pid in processes]
            before = [used_s(pid) for pid in processes]
            time.sleep(IDLE_S)
            idle = [(used_s(pid) - at) / IDLE_S for pid, at in zip(processes, before, strict=True)]
            before, began = [used_s(pid) for pid in processes], time.perf_counter()
            waited = []
            for _ in range(frames):
                station = simulation.ground_station(1)
                station.wait(PATIENCE_S)
                done = time.perf_counter()
                waited.append(received(stream) - done)
            time.sleep(1.0)
            took_s = time.perf_counter() - began
            spent = [used_s(pid) - at - rate * took_s for pid, at, rate in zip(processes, before, idle, strict=True)]
            memory_mb = [peak_mb(pid) for pid in processes]
        finally:
            daemon.send_signal(signal.SIGTERM)
            daemon.wait(PATIENCE_S)
    taken = {name: (part, peak) for name, part, peak in zip(names, spent, memory_mb, strict=True)}
    return {
        "cpu_s_a_frame": sum(spent) / frames,
        **{f"{name}_share": part / sum(spent) for name, (part, _) in taken.items()},
        **{f"{name}_mb": peak for name, (_, peak) in taken.items()},
        "safe_to_slices_s": statistics.median(waited),
    }


def first_frame_s(folder: Path) -> float:
    """Seconds of `dappled run --simulate --frames 1`."""
    began = time.perf_counter()
    subprocess.run(
        [sys.executable, "-m", "dappled", "run", "--simulate", "--frames", "1"],
        cwd=folder, env=os.environ | {"XDG_DATA_HOME": str(folder), "XDG_STATE_HOME": str(folder)},
        stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL, check=False,
    )  # fmt: skip
    return time.perf_counter() - began


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--json", action="store_true", help="print JSON")
    parser.add_argument("--frames", type=int, default=12, help="frames that are counted")
    arguments = parser.parse_args()
    with tempfile.TemporaryDirectory(prefix="onb-") as name:
        folder = Path(name)
        first_s = statistics.median(first_frame_s(folder) for _ in range(3))
        figures = {"first_frame_s": first_s, "first_frame_of_import": first_s / imports_s()}
        show("onboard", {**figures, **measure(folder, arguments.frames)}, as_json=arguments.json)


if __name__ == "__main__":
    main()
