"""How fast the camera is fired and its files become safe: against the PTP/IP body, through the real libgphoto2.

    .venv/bin/python benchmarks/camera.py [--json]

Trigger: from the shutter's `fire` to libgphoto2's trigger call, while processes that decode keep both cores busy. The
priorities are the service's own (Nice=-5 and CPUWeight=400 in its unit, the camera's process before it), and the body,
which stands for hardware, goes before all; where this user may not have them, it says so.
File: a 17.6 MB raw file from the body to safe on disk, against a plain copy of it with fsync, taken in turns; what
share of that passes until the camera's process has the whole file (from a body that is itself a program on these cores;
USB 2 would take half a second), written and hashed while it came; and what
the driver's process holds in memory at most, above what it holds before. Stall: the longest time for which the daemon
side doesn't answer while the body is silent.
"""

from __future__ import annotations

import argparse
import contextlib
import math
import os
import statistics
import subprocess
import sys
import tempfile
import threading
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any

from limits import show

from dappled import durable
from dappled.clock import SystemClock
from dappled.drivers.camera import Arrival, Fired, ShotFailed, StateChanged
from dappled.drivers.gphoto2.client import GPhoto2Camera, open_camera
from dappled.flight import Cause, Shot, recording
from dappled.mocks.body.body import BodyOptions, SimulatedBody

SIZE = 17_582_091  # of a real EOS 450D's CR2
_SESSION_NICE = -6  # 1.25 ** 6 is 3.8: CPUWeight=400 of 100
_BURN = """
import os, numpy as np
os.setpriority(os.PRIO_PROCESS, 0, 10)
a = np.random.default_rng(1).normal(size=(2776, 1844)).astype(np.float32)
while True:
    np.fft.irfft2(np.fft.rfft2(a))
"""


@contextlib.contextmanager
def camera_at(body: SimulatedBody, folder: Path | None = None, **settings: Any) -> Iterator[GPhoto2Camera]:
    """A driver that is ready, whose files may come into a folder."""
    camera = open_camera({"port": body.port, **settings})
    if folder is not None:
        camera.receive_into(folder)
    camera.start()
    try:
        until(camera, lambda event: isinstance(event, StateChanged) and event.state == "ready")
        yield camera
    finally:
        camera.stop()


def until(camera: GPhoto2Camera, wanted: Any, patience_s: float = 60.0) -> Any:
    """The first wanted event; blobs of others are closed."""
    deadline = time.monotonic() + patience_s
    while time.monotonic() < deadline:
        event = camera.next_event(0.2)
        if event is not None and wanted(event):
            return event
        if isinstance(event, ShotFailed):
            sys.exit(f"a shot failed: {event.reason}")
        if isinstance(event, Arrival):
            event.blob.close()
    sys.exit("the camera did not answer")


@contextlib.contextmanager
def loaded(processes: int) -> Iterator[None]:
    """Both cores busy with transforms, at the decoder's own niceness."""
    burning = [subprocess.Popen([sys.executable, "-c", _BURN]) for _ in range(processes)]
    try:
        time.sleep(2.0)
        yield
    finally:
        for process in burning:
            process.kill()
            process.wait()


def trigger(shots: int) -> dict[str, Any]:
    """Milliseconds from `fire` to the trigger call."""
    times = []
    with (
        SimulatedBody.start(BodyOptions(picture="pattern:20000:cr2")) as body,
        camera_at(body, capture_target="ram") as camera,
        loaded(os.cpu_count() or 2),
    ):
        _before(body)
        for shot in range(shots):
            time.sleep(0.2 + (shot % 10) * 0.053)  # the body is idle again; at any phase of the driver's own polling
            asked_ns = time.monotonic_ns()
            camera.fire(shot)
            fired = until(camera, lambda event: isinstance(event, Fired))
            times.append((fired.called_monotonic_ns - asked_ns) / 1e6)
            until(camera, lambda event: isinstance(event, Arrival)).blob.close()
    times.sort()
    p99 = times[math.ceil(0.99 * len(times)) - 1]
    return {"shots": shots, "median_ms": statistics.median(times), "p99_ms": p99, "worst_ms": times[-1]}


def file_move(repeats: int, place: Path) -> dict[str, Any]:
    """Seconds of both ways, in turns; the ratio is that of the medians."""
    clock = SystemClock()
    source = place / "source.cr2"
    source.write_bytes(os.urandom(SIZE))
    flight = recording.begin(place / "flights", clock, {})
    fetched: list[float] = []
    ours: list[float] = []
    plain: list[float] = []
    with (
        SimulatedBody.start(BodyOptions(picture=str(source))) as body,
        camera_at(body, flight.folder.frames, delete_after_download=True) as camera,
    ):
        _before(body)
        before = peak = _memory(camera)
        for shot in range(repeats):
            flight.ledger.add_shot(Shot(shot, Cause("benchmark", "shot"), clock.utc_ns(), clock.monotonic_ns()))
            camera.fire(shot)
            arrival = until(camera, lambda event: isinstance(event, Arrival))
            began = time.perf_counter()
            flight.recorder.record(shot, arrival.name, arrival.blob, arrived_utc_ns=clock.utc_ns())
            fetched.append(arrival.facts["fetch_ms"] / 1e3)
            ours.append(time.perf_counter() - began + fetched[-1])
            arrival.blob.close()
            camera.release(arrival)
            peak = max(peak, _memory(camera))
            plain.append(_plain_copy(source, place / f"plain-{shot}.cr2"))
    flight.close()
    move, copy = statistics.median(ours), statistics.median(plain)
    return {
        "repeats": repeats,
        "body_to_safe_mb_s": SIZE / move / 1e6,
        "plain_copy_mb_s": SIZE / copy / 1e6,
        "ratio": copy / move,
        "transfer_share": statistics.median(fetched) / move,
        "memory_per_file_size": max(0, peak - before) / SIZE,
    }


def _weigh_session() -> None:
    """Have a session of our own, with the unit's weight: a kernel that weighs sessions asks niceness only inside."""
    with contextlib.suppress(OSError):  # of a shell, the process leads the shell's job: it stays there
        os.setsid()
        Path("/proc/self/autogroup").write_text(str(_SESSION_NICE), encoding="ascii")


def _before(body: SimulatedBody) -> None:
    """The body is hardware: it waits for no core. (Each thread has a priority of its own.)"""
    with contextlib.suppress(PermissionError):
        for thread in Path(f"/proc/{body._process.pid}/task").iterdir():
            os.setpriority(os.PRIO_PROCESS, int(thread.name), -15)


def _plain_copy(source: Path, target: Path) -> float:
    began = time.perf_counter()
    with source.open("rb") as one, target.open("wb") as other:
        while piece := one.read(1 << 20):
            other.write(piece)
        other.flush()
        os.fsync(other.fileno())
    durable.sync_folder(target.parent)
    return time.perf_counter() - began


def _memory(camera: GPhoto2Camera) -> int:
    """The most that the driver's process ever held, in bytes (VmHWM), memory files included."""
    process = camera._process
    assert process is not None
    status = Path(f"/proc/{process.pid}/status").read_text()
    return next(int(line.split()[1]) * 1024 for line in status.splitlines() if line.startswith("VmHWM"))


def stall() -> dict[str, Any]:
    """The longest pause of a thread beside the driver, while the body is silent in the middle of a shot."""
    with SimulatedBody.start(BodyOptions(picture="pattern:20000:cr2")) as body, camera_at(body) as camera:
        _before(body)
        longest_s, done = 0.0, threading.Event()

        def beat() -> None:
            nonlocal longest_s
            last = time.monotonic()
            while not done.wait(0.001):
                now = time.monotonic()
                longest_s, last = max(longest_s, now - last), now

        beating = threading.Thread(target=beat)
        body.fault("silence 6")
        beating.start()
        camera.fire(1)
        deadline = time.monotonic() + 8
        while time.monotonic() < deadline:
            event = camera.next_event(0.1)
            if isinstance(event, Arrival):
                event.blob.close()
        done.set()
        beating.join()
    return {"silence_s": 6, "longest_ms": longest_s * 1e3}


def main() -> None:
    """Measure all, and print."""
    parser = argparse.ArgumentParser(description=__doc__.partition("\n")[0])
    parser.add_argument("--json", action="store_true")
    parser.add_argument("--shots", type=int, default=300, help="of the trigger's measurement")
    parser.add_argument("--repeats", type=int, default=15, help="of the file's measurement")
    arguments = parser.parse_args()
    _weigh_session()
    with contextlib.suppress(PermissionError):
        os.setpriority(os.PRIO_PROCESS, 0, -5)
    with tempfile.TemporaryDirectory(dir=".", prefix=".benchmark-") as place:
        told: dict[str, Any] = {
            "load": os.getloadavg()[0],
            "niceness": os.getpriority(os.PRIO_PROCESS, 0),
            "file": file_move(arguments.repeats, Path(place)),
            "stall": stall(),
            "trigger": trigger(arguments.shots),
        }
    show("camera", told, as_json=arguments.json)


if __name__ == "__main__":
    main()
