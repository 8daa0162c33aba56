"""What recording costs: a durable frame against plain write + fsync, a note in the shot journal, a ledger row.

python benchmarks/record.py [--json] [--directory DIR] [--megabytes 17] [--rounds 15]
python benchmarks/record.py --sustained 300 [--json] [--directory DIR]      4 frames/s of 11 MB: see sustained.py
"""

from __future__ import annotations

import argparse
import os
import statistics
import tempfile
import threading
import time
from collections.abc import Callable
from functools import partial
from pathlib import Path

import sustained
from limits import show

from dappled.clock import TimeOfDayClock
from dappled.drivers.camera import Blob
from dappled.flight import Cause, Shot, recording


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--json", action="store_true")
    parser.add_argument("--directory", type=Path, default=None, help="a folder on the disk to measure")
    parser.add_argument("--megabytes", type=int, default=17)
    parser.add_argument("--rounds", type=int, default=15)
    parser.add_argument(
        "--pause", type=float, default=0.5, help="seconds between writes, so that a disk's cache recovers"
    )
    parser.add_argument("--sustained", type=float, metavar="SECONDS", help="frames faster than they can be decoded")
    arguments = parser.parse_args()
    with tempfile.TemporaryDirectory(dir=arguments.directory) as folder:
        if arguments.sustained:
            figures = sustained.measure(Path(folder), arguments.sustained, 4.0, 11_000_000, decode_s=2.0)
        else:
            figures = measure(Path(folder), arguments.megabytes * 1_000_000, arguments.rounds, arguments.pause)
    show("sustained" if arguments.sustained else "record", figures, as_json=arguments.json)


def measure(root: Path, size: int, rounds: int, pause_s: float) -> dict[str, float]:
    """Medians, in the units that the names say.

    Plain and durable writes take turns in being first, each to a new file. Nothing is deleted between them: a disk that
    discards deleted blocks does so in the next fsync.
    """
    data = os.urandom(size)
    flight = recording.begin(root, TimeOfDayClock())
    plain: list[int] = []
    durable: list[int] = []
    row, note = [], []
    for index in range(rounds):
        shot = Shot(index, Cause("benchmark", "frame"), time.time_ns(), time.monotonic_ns())
        flight.journal.note(shot)
        start = time.perf_counter_ns()
        flight.ledger.add_shot(shot)
        row.append(time.perf_counter_ns() - start)

        blob = Blob.of(data)
        writes: list[tuple[Callable[[], object], list[int]]] = [
            (partial(_plain, root / f"plain-{index}", data), plain),
            (partial(flight.recorder.record, index, "IMG.CR2", blob, arrived_utc_ns=time.time_ns()), durable),
        ]
        for write, times in writes if index % 2 else reversed(writes):
            time.sleep(pause_s)
            Blob.of(data).close()  # both find memory that was in use: a virtual machine's first touch costs 2 µs/KiB
            start = time.perf_counter_ns()
            write()
            times.append(time.perf_counter_ns() - start)
        blob.close()

    stop = threading.Event()
    writer = threading.Thread(target=_frames_until, args=(root / "busy", data, stop))
    writer.start()
    for index in range(rounds, rounds + 500):
        shot = Shot(index, Cause("benchmark", "note"), time.time_ns(), time.monotonic_ns())
        start = time.perf_counter_ns()
        flight.journal.note(shot)
        note.append(time.perf_counter_ns() - start)
        time.sleep(0.004)
    stop.set()
    writer.join()
    flight.close()
    return {
        "plain_write_fsync_ms": statistics.median(plain) / 1e6,
        "durable_frame_ms": statistics.median(durable) / 1e6,
        "durable_over_plain": statistics.median(durable) / statistics.median(plain),
        "ledger_row_ms": statistics.median(row) / 1e6,
        "journal_note_median_us": statistics.median(note) / 1e3,
        "journal_note_p99_us": sorted(note)[-len(note) // 100] / 1e3,
        "journal_note_worst_us": max(note) / 1e3,
    }


def _plain(path: Path, data: bytes) -> None:
    fd = os.open(path, os.O_WRONLY | os.O_CREAT | os.O_TRUNC)
    view = memoryview(data)
    while view:
        view = view[os.write(fd, view) :]
    os.fsync(fd)
    os.close(fd)


def _frames_until(path: Path, data: bytes, stop: threading.Event) -> None:
    """Keeps the disk busy beside the notes, as durable frames do."""
    while not stop.is_set():
        _plain(path, data)


if __name__ == "__main__":
    main()
