"""Frames faster than they can be decoded, for minutes: is each one recorded, and does memory stay flat?

python benchmarks/sustained.py [--json] [--directory DIR] [--seconds 300] [--rate 4] [--megabytes 11] [--decode-s 2]

A flight of two hours at a frame a second, 24 times as fast: --seconds 300 --rate 24 --megabytes 0.1 --decode-s 0.02

The pipeline of a live flight (shutter, journal, recorder, ledger, tagger, decode queue) in front of a camera that
brings a new file for every shot. Decoding is too slow on purpose. Afterwards the whole flight is read back and
compared.
"""

from __future__ import annotations

import argparse
import mmap
import os
import queue
import shutil
import statistics
import sys
import tempfile
import threading
import time
from pathlib import Path

sys.path.insert(0, str(Path(__file__).parents[1]))  # sink and poses are the tests' own

from limits import show
from tests.daemon.fakes import FlightSink, NoPoses

from dappled.clock import SystemClock
from dappled.config.settings import PoseSettings
from dappled.daemon.navigation import BodyLatency
from dappled.daemon.pipeline.capture import Observer, PendingShot, PendingShots, ShotEnds
from dappled.daemon.pipeline.decode_process import DecodedFrame
from dappled.daemon.pipeline.flight_writer import LedgerWriter
from dappled.daemon.pipeline.pipeline import Decoding, Pipeline
from dappled.daemon.pipeline.recipes import Names
from dappled.daemon.pipeline.repeats import CaptureRequest
from dappled.daemon.pipeline.shutter import Shutter
from dappled.daemon.pipeline.verdicts import Judge
from dappled.drivers.camera import Arrival, Blob, CameraEvent, Fired, Identity, PlainCamera, StateChanged
from dappled.findings import Code
from dappled.flight import flight_report, recording
from dappled.flight.checks import flight_check
from dappled.flight.records import LEFT

QUEUE = 4
_SEEN = {"resident_mb": "resident_growth_mb", "memfd_mb": "memfd_growth_mb", "handles": "handles_growth"}


class SteadyCamera(PlainCamera):
    """Brings a file of `size` bytes for each shot, different each time; it is made when the pipeline looks for it."""

    identity = Identity("benchmark", "steady", "", "")

    def __init__(self, size: int) -> None:
        super().__init__()
        self._picture = bytearray(os.urandom(size))
        self._shots: queue.SimpleQueue[int] = queue.SimpleQueue()

    def start(self) -> None:
        self.report(StateChanged("ready", "", time.monotonic_ns(), self.identity))

    def fire(self, shot: int) -> None:
        self._shots.put(shot)

    def next_event(self, timeout_s: float) -> CameraEvent | None:
        event = super().next_event(0.0)
        if event is not None:
            return event
        try:
            shot = self._shots.get(timeout=timeout_s)
        except queue.Empty:
            return None
        now_ns = time.monotonic_ns()
        self._picture[:8] = shot.to_bytes(8, "big")
        self.report(Arrival(shot, f"IMG_{shot:04d}.CR2", Blob.of(memoryview(self._picture)), now_ns))
        return Fired(shot, now_ns, now_ns)

    def stop(self) -> None: ...


class SlowDecoder:
    """Takes its time over every frame; gives as much as 13 slices of a small frame."""

    def __init__(self, seconds: float) -> None:
        self._seconds = seconds

    def decode(
        self, path: str, focal_length_mm: float | None, f_number: float | None, *, index: int, look: bool = False
    ) -> DecodedFrame:
        time.sleep(self._seconds)
        body = mmap.mmap(-1, 1 << 20)
        unit = [[1.0, 0.0, 0.0], [0.0, 1.0, 0.0]]
        return DecodedFrame(body, "0" * 64, [], [[0.0] * 4], "predicted", 1, 1, "geometric", unit, b"", (0, 0))


class Ends(Observer):
    """Passes the end of each shot to the shutter and counts it."""

    def __init__(self, shutter: Shutter) -> None:
        self.shutter, self.over = shutter, threading.Semaphore(0)
        self.record_ms: list[float] = []

    def settled(self, index: int, ok: bool) -> None:
        self.shutter.settled(index, ok)

    def finished(self, pending: PendingShot) -> None:
        self.record_ms.append(pending.ms.get("record", 0.0))
        self.over.release()


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--json", action="store_true")
    parser.add_argument("--directory", type=Path, default=None, help="a folder on the disk to measure")
    parser.add_argument("--seconds", type=float, default=300.0)
    parser.add_argument("--rate", type=float, default=4.0, help="frames a second")
    parser.add_argument("--megabytes", type=float, default=11.0)
    parser.add_argument("--decode-s", type=float, default=2.0)
    wanted = parser.parse_args()
    with tempfile.TemporaryDirectory(dir=wanted.directory) as folder:
        size = round(wanted.megabytes * 1e6)
        figures = measure(Path(folder), wanted.seconds, wanted.rate, size, decode_s=wanted.decode_s)
    show("sustained", figures, as_json=wanted.json)


def measure(root: Path, seconds: float, rate: float, size: int, *, decode_s: float) -> dict[str, float]:
    """Counts, milliseconds and megabytes, as the names say. `lost` counts shots without an intact frame, and frames
    neither decoded nor noted as not decoded. Memory and file handles: the growth from the second quarter to the last;
    `ledger_growth`: the ledger's bytes a frame in the last quarter over those in the second."""
    clock, notes_ms = SystemClock(), []
    flight = recording.begin(root, clock, {})
    camera = SteadyCamera(size)
    shots = PendingShots(camera)
    shutter = Shutter(FlightSink(flight, shots), clock, next_index=0, capacity=1000)
    ends = Ends(shutter)
    judge, stages = Judge(PoseSettings().mount, on_gimbal=False), ShotEnds(shots, LedgerWriter(flight, clock), ends)
    decoding = Decoding(stages, SlowDecoder(decode_s), None, capacity=QUEUE, judge=judge)
    pipeline = Pipeline(decoding, NoPoses(), BodyLatency(60.0, 15.0), Names("benchmark", "mask", "geometric"))

    memory = Memory(flight.folder.ledger)
    pipeline.start()
    count = round(seconds * rate)
    start = time.monotonic()
    for number in range(count):
        time.sleep(max(0.0, start + number / rate - time.monotonic()))
        began = time.perf_counter()
        shutter.request(CaptureRequest("benchmark", "console", number))
        notes_ms.append((time.perf_counter() - began) * 1e3)
        memory.look()
    behind_s = time.monotonic() - start - (count - 1) / rate
    for _ in range(count):
        ends.over.acquire(timeout=60 + decode_s * (QUEUE + 2))
    pipeline.stop(10.0)
    flight.close()
    return {
        **_account(flight.folder.path, count),
        **_times(notes_ms, ends.record_ms),
        "behind_s": behind_s,
        **memory.growth(),
    }


class Memory:
    """Memory of this process, resident and in memfds (MB), its file handles, and the bytes of the ledger on disk."""

    def __init__(self, ledger: Path) -> None:
        self._ledger = ledger
        self._seen: list[tuple[float, float, int, int]] = []

    def look(self) -> None:
        resident = int(Path("/proc/self/statm").read_text().split()[1]) * os.sysconf("SC_PAGE_SIZE") / 1e6
        handles = list(Path("/proc/self/fd").iterdir())
        held = sum(_memfd_bytes(path) for path in handles) / 1e6
        self._seen.append((resident, held, len(handles), self._ledger.stat().st_size))

    def growth(self) -> dict[str, float]:
        quarter = max(1, len(self._seen) // 4)
        early, late = self._seen[quarter : 2 * quarter], self._seen[-quarter:]
        rows = {}
        for place, (name, growth) in enumerate(_SEEN.items()):
            rows[name] = statistics.median(one[place] for one in late)
            rows[growth] = rows[name] - statistics.median(one[place] for one in early)
        grown = [part[-1][3] - part[0][3] for part in (early, late)]
        rows["ledger_bytes_a_frame"] = grown[1] / quarter
        rows["ledger_growth"] = grown[1] / max(1, grown[0])
        return rows


def _memfd_bytes(path: Path) -> int:
    """What a file handle holds where it is that of a memfd, else 0."""
    try:
        return path.stat().st_size if os.readlink(path).startswith("/memfd:") else 0
    except OSError:  # closed in the meantime
        return 0


def _account(flight: Path, count: int) -> dict[str, float]:
    balance, found = flight_report.balance(flight), flight_check.check(flight)
    told = [event.finding for event in flight_report.show(flight).events if event.kind == LEFT]
    skipped = sum(one is not None and one.code is Code.FRAME_UNDECODED for one in told)
    missing = count - balance.safe + max(0, balance.frames - balance.decoded - skipped)
    shutil.rmtree(flight / "frames")
    return {
        "shots": count,
        "frames": balance.frames,
        "decoded": balance.decoded,
        "left_undecoded": skipped,
        "lost": missing + len(found.problems),
        "gigabytes": balance.size / 1e9,
    }


def _times(notes_ms: list[float], record_ms: list[float]) -> dict[str, float]:
    def share(values: list[float], part: float) -> float:
        return sorted(values)[min(len(values) - 1, int(part * len(values)))]

    rows: dict[str, float] = {}
    for name, values in (("note", notes_ms), ("record", record_ms)):
        rows |= {f"{name}_median_ms": share(values, 0.5), f"{name}_p99_ms": share(values, 0.99)}
    return rows


if __name__ == "__main__":
    main()
