#!/usr/bin/env python3
"""What the service takes: start to READY, processor and memory while it waits, time to end. With a body and without.

    python benchmarks/service.py [--json] [--seconds 10]

`ready_s` is from exec to systemd's READY=1; `ready_of_import` the same as a multiple of the time that a bare
interpreter takes to import NumPy, SciPy's FFT and pymavlink in this run. Memory is the proportional set size (PSS) of
the daemon and its children: shared pages count once.
"""

from __future__ import annotations

import argparse
import os
import re
import signal
import socket
import statistics
import subprocess
import sys
import tempfile
import time
from collections.abc import Sequence
from pathlib import Path

import tomli_w
from limits import show
from tests.soak.supervised import children_of

from dappled.config import settings as configuration
from dappled.mocks.simulation import Simulation, World

REPEATS = 5


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawTextHelpFormatter)
    parser.add_argument("--json", action="store_true")
    parser.add_argument("--seconds", type=float, default=10.0, help="how long it is watched while it waits")
    wanted = parser.parse_args()
    told = {"imports_s": imports_s()}
    with tempfile.TemporaryDirectory(prefix="svc-") as name:
        folder = Path(name)
        bare = folder / "bare.toml"
        bare.write_text(f'[record]\ndirectory = "{folder}/flights"\n[publish]\nslices = "ipc://{folder}/s"\n')
        told |= measure("alone", bare, folder, wanted.seconds)
        with Simulation(World(), configuration.load(bare), folder) as settings:
            full = folder / "full.toml"
            full.write_text(tomli_w.dumps(configuration.to_tables(settings)), encoding="utf-8")
            told |= measure("with_camera_and_link", full, folder, wanted.seconds)
    for where in ("alone", "with_camera_and_link"):
        told[f"{where}_ready_of_import"] = told[f"{where}_ready_s"] / told["imports_s"]
    show("service", told, as_json=wanted.json)
    return 0


def imports_s() -> float:
    """Median time of a bare interpreter that imports the heavy libraries, warm."""
    times = []
    for _ in range(REPEATS):
        began = time.perf_counter()
        subprocess.run([sys.executable, "-c", "import numpy, scipy.fft, pymavlink.dialects.v20.all"], check=True)
        times.append(time.perf_counter() - began)
    return statistics.median(times)


def measure(where: str, config: Path, folder: Path, seconds: float) -> dict[str, float]:
    """Start, watch and end the daemon; the last of the starts is the one watched."""
    ready, ending = [], []
    told: dict[str, float] = {}
    for turn in range(REPEATS):
        address = folder / f"notify-{where}-{turn}"
        with socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM) as manager:
            manager.bind(str(address))
            manager.settimeout(30)
            began = time.perf_counter()
            daemon = subprocess.Popen(
                [sys.executable, "-m", "dappled", "run", "--config", str(config)],
                env=os.environ | {"NOTIFY_SOCKET": str(address)},
                stdout=subprocess.DEVNULL,
                stderr=subprocess.DEVNULL,
            )
            try:
                while manager.recv(4096) != b"READY=1":
                    pass
                ready.append(time.perf_counter() - began)
                if turn == REPEATS - 1:
                    time.sleep(5.0)  # children start, the decoder warms up
                    before, at = cpu_s(daemon.pid), time.perf_counter()
                    time.sleep(seconds)
                    share = (cpu_s(daemon.pid) - before) / (time.perf_counter() - at)
                    told[f"{where}_idle_core_share"] = share
                    told[f"{where}_idle_pss_mb"] = sum(pss_mb(pid) for pid in family(daemon.pid))
                began = time.perf_counter()
                daemon.send_signal(signal.SIGTERM)
                daemon.wait(20)
                ending.append(time.perf_counter() - began)
            finally:
                daemon.kill()
                daemon.wait(20)
    return {f"{where}_ready_s": statistics.median(ready), f"{where}_end_s": statistics.median(ending), **told}


def family(pid: int) -> Sequence[int]:
    """A process and its children."""
    return [pid, *children_of(pid)]


def cpu_s(pid: int) -> float:
    """Processor time of the family so far."""
    ticks = os.sysconf("SC_CLK_TCK")
    total = 0
    for one in family(pid):
        fields = Path(f"/proc/{one}/stat").read_text(encoding="ascii").rpartition(")")[2].split()
        total += int(fields[11]) + int(fields[12])
    return total / ticks


def pss_mb(pid: int) -> float:
    """Proportional set size."""
    text = Path(f"/proc/{pid}/smaps_rollup").read_text(encoding="ascii")
    found = re.search(r"^Pss:\s+(\d+) kB", text, re.MULTILINE)
    return int(found[1]) / 1e3 if found else 0.0


if __name__ == "__main__":
    sys.exit(main())
