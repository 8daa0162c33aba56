"""What publishing costs: bytes over ipc against memcpy, a frame's way to a subscriber, and ten subscribers.

python benchmarks/publish.py [--json] [--rounds 25] [--frames 8] [--directory DIR]
"""

from __future__ import annotations

import argparse
import contextlib
import multiprocessing
import os
import signal
import socket
import statistics
import tempfile
import threading
import time
import weakref
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field
from multiprocessing.connection import Connection
from multiprocessing.process import BaseProcess
from pathlib import Path
from typing import Any

import numpy as np
from limits import show
from numpy.typing import NDArray

from dappled.clock import TimeOfDayClock
from dappled.config.settings import PublishSettings, RecordSettings, Settings
from dappled.daemon.stream import wire
from dappled.daemon.stream.publisher import Publisher
from dappled.daemon.stream.subscriber import Subscriber
from dappled.daemon.stream.wire import Message
from dappled.large_blocks import reuse_large_blocks

SHAPE = (13, 572, 566)
HUNG = 3
RAW_BYTES = 17_000_000
DEADLINE_S = 60.0
SPAWN = multiprocessing.get_context("spawn")
UNIT_NICENESS = -5  # systemd/dappled.service


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--json", action="store_true")
    parser.add_argument("--rounds", type=int, default=25, help="of each measurement")
    parser.add_argument("--frames", type=int, default=8, help="of the simulated flight")
    parser.add_argument("--directory", type=Path, default=None, help="a folder on the disk to record to")
    arguments = parser.parse_args()
    with tempfile.TemporaryDirectory(prefix="dpl-", dir=arguments.directory) as folder:
        root = Path(folder)
        figures = {
            **throughput(root, arguments.rounds),
            **hung(root, arguments.rounds),
            **latency(root, arguments.frames),
        }
    show("publish", figures, as_json=arguments.json)


def stack(seed: int) -> NDArray[np.complex64]:
    """Slices as a frame of the thesis' camera has them, in memory of their own."""
    made = np.random.default_rng(seed).standard_normal((*SHAPE, 2), dtype=np.float32)
    return made.view(np.complex64)[..., 0]


def throughput(root: Path, rounds: int) -> dict[str, float]:
    """Publish to received in another process, against one memcpy of the same bytes; they take turns.

    The copy goes to memory that was in use before, which is the fastest there is, and to new memory, as a receiver's
    must. What a bare UNIX socket does is the most that ipc can.
    """
    source = stack(1)
    target = np.empty_like(source)
    copies, news, bare, sends = [], [], [], []
    with publisher(root) as one, reader(root) as pipe, bare_socket() as send_bare:
        greet(one, pipe)
        for number in range(rounds):
            began = time.perf_counter()
            np.copyto(target, source)
            copies.append(time.perf_counter() - began)
            began = time.perf_counter()
            body = source.copy()  # a fresh buffer a frame, as the decoder hands them over
            news.append(time.perf_counter() - began)
            began = time.perf_counter()
            send_bare(body)
            bare.append(time.perf_counter() - began)
            began = time.perf_counter()
            one.publish("slices", header(number, body), body.data.cast("B"))
            pipe.recv()
            sends.append(time.perf_counter() - began)
    megabytes = source.nbytes / 1e6
    return {
        "slices_MB": megabytes,
        "memcpy_GB_s": megabytes / min(copies) / 1e3,
        "ipc_GB_s": megabytes / min(sends) / 1e3,
        "unix_socket_GB_s": megabytes / min(bare) / 1e3,
        "ipc_over_memcpy": min(copies) / min(sends),
        "ipc_over_copy_to_new_memory": min(news) / min(sends),
        "unix_socket_over_memcpy": min(copies) / min(bare),
        "ipc_over_unix_socket": min(bare) / min(sends),
        "ipc_over_memcpy_medians": statistics.median(copies) / statistics.median(sends),
    }


@contextmanager
def bare_socket() -> Iterator[Callable[[NDArray[np.complex64]], None]]:
    """Sends an array through a bare UNIX socket, with room for a megabyte, to another process' warm memory: the most
    that ipc can do."""
    here, there = socket.socketpair()
    pipe, other = SPAWN.Pipe()
    here.setsockopt(socket.SOL_SOCKET, socket.SO_SNDBUF, 1 << 20)
    process = SPAWN.Process(target=_read_bare, args=[there, other], daemon=True)
    process.start()
    there.close()

    def send(array: NDArray[np.complex64]) -> None:
        here.sendall(array.data.cast("B"))
        pipe.recv()

    try:
        yield send
    finally:
        process.kill()
        process.join()
        here.close()


def _read_bare(there: socket.socket, pipe: Connection) -> None:
    view = memoryview(np.ones(stack(0).nbytes, np.uint8).data)
    while True:
        got = 0
        while got < len(view):
            got += there.recv_into(view[got:])
        pipe.send(None)


def hung(root: Path, rounds: int) -> dict[str, float]:
    """Durable frames of 17 MB recorded while slices go out: to none, and to ten subscribers of which three hang.

    The two take turns, with the niceness that the service's unit gives where this may be had. A frame comes at any
    time after the slices of the one before. Also how many stacks of slices the publisher keeps alive at the most; the
    hung ones subscribed to slices alone, which is the worst case.
    """
    with contextlib.suppress(PermissionError):
        os.setpriority(os.PRIO_PROCESS, 0, UNIT_NICENESS)
    when = np.random.default_rng(1)
    from dappled.drivers.camera import Blob  # noqa: PLC0415  # the subscribers' processes load none of it
    from dappled.flight import Cause, Shot, recording  # noqa: PLC0415  # as above

    flight = recording.begin(root / "flights", TimeOfDayClock())
    data = os.urandom(RAW_BYTES)
    times: dict[str, list[float]] = {"alone": [], "crowd": []}
    notes: dict[str, list[float]] = {"alone": [], "crowd": []}
    alive: set[int] = set()
    most = index = 0
    lone = Publisher(f"ipc://{root}/lone", "")
    lone.start("lone", _no_answer)
    with publisher(root) as one, crowd(root, one) as readers:
        for sleeper in readers[:HUNG]:
            os.kill(sleeper.pid or 0, signal.SIGSTOP)
        for turn in range(2 * rounds):
            name, through = ("crowd", one) if turn % 2 else ("alone", lone)
            body = stack(turn % 4)
            if name == "crowd":
                alive.add(index)
                weakref.finalize(body, alive.discard, index)
            if turn % 8 < 2:  # once a second
                through.publish("health", {})
            through.publish("frame", {"frame": index})
            through.publish("slices", header(index, body), body.data.cast("B"))
            del body
            time.sleep(when.uniform(0.0, 0.25))
            shot = Shot(index, Cause("benchmark", "frame"), time.time_ns(), time.monotonic_ns())
            blob = Blob.of(data)
            began = time.perf_counter()
            flight.journal.note(shot)
            notes[name].append(time.perf_counter() - began)
            flight.ledger.add_shot(shot)
            began = time.perf_counter()
            flight.recorder.record(index, "IMG.CR2", blob, arrived_utc_ns=time.time_ns())
            times[name].append(time.perf_counter() - began)
            blob.close()
            time.sleep(0.3)  # until all have read what they want
            most = max(most, len(alive))
            index += 1
        for sleeper in readers[:HUNG]:
            os.kill(sleeper.pid or 0, signal.SIGCONT)
    lone.stop(0.0)
    flight.close()
    return {
        "record_ms_alone": statistics.median(times["alone"]) * 1e3,
        "record_ms_ten_subscribers_three_hung": statistics.median(times["crowd"]) * 1e3,
        "record_crowd_over_alone": statistics.median(times["crowd"]) / statistics.median(times["alone"]),
        "shot_note_crowd_over_alone": statistics.median(notes["crowd"]) / statistics.median(notes["alone"]),
        "most_frames_kept_for_the_hung": float(most),
    }


@dataclass
class Ears:
    """What two subscribers of a flight heard, and what the daemon said of each shot. Times are monotonic."""

    endpoint: str
    frames: int
    safe_ns: dict[int, int] = field(default_factory=dict)
    decode_ms: dict[int, float] = field(default_factory=dict)
    received_ns: dict[int, int] = field(default_factory=dict)
    again: set[int] = field(default_factory=set)
    over: threading.Event = field(default_factory=threading.Event)

    def settled(self, index: int, _ok: bool) -> None:
        self.safe_ns[index] = time.monotonic_ns()

    def finished(self, pending: Any) -> None:
        self.decode_ms[pending.shot.index] = pending.ms.get("decode", float("nan"))

    def listen(self) -> None:
        with Subscriber(self.endpoint, topics=["slices"]) as subscriber:
            while not self.over.is_set():
                message = subscriber.receive(0.1)
                if message is not None:
                    self.received_ns.setdefault(message.header["frame"], time.monotonic_ns())

    def listen_die_and_come_back(self) -> None:
        """Takes one message and dies; comes back late and asks for all."""
        with Subscriber(self.endpoint, topics=["slices"]) as subscriber:
            subscriber.receive(DEADLINE_S)
        _wait(lambda: len(self.decode_ms) >= self.frames)
        with Subscriber(self.endpoint, f"{self.endpoint}.ask", from_start=True) as subscriber:
            until = time.monotonic() + DEADLINE_S
            while not self.whole() and time.monotonic() < until:
                message = subscriber.receive(0.2)
                if message is not None and message.topic == "slices":
                    self.again.add(message.header["frame"])

    def whole(self) -> bool:
        return self.again >= set(range(self.frames))


def latency(root: Path, frames: int) -> dict[str, float]:
    """A simulated flight: from "safe on disk" to "received by a subscriber", less the decode; and what a subscriber
    that was killed and started again has at the end."""
    from dappled.config import settings as configuration  # noqa: PLC0415  # the subscribers' processes load none of it
    from dappled.daemon.pipeline.capture import Observer  # noqa: PLC0415  # as above
    from dappled.daemon.pipeline.repeats import CaptureRequest  # noqa: PLC0415  # as above
    from dappled.daemon.service import Service  # noqa: PLC0415  # as above
    from dappled.mocks.simulation import Simulation, World  # noqa: PLC0415  # as above

    ears = Ears(f"ipc://{root}/flight", frames)
    settings = configuration.resolve(
        Settings(
            record=RecordSettings(directory=str(root / "simulated"), min_free_mb=0),
            publish=PublishSettings(slices=ears.endpoint),
        )
    )

    class Reports(Observer):
        def settled(self, index: int, ok: bool) -> None:
            ears.settled(index, ok)

        def finished(self, pending: Any) -> None:
            ears.finished(pending)

    with Simulation(World(seed=2), settings, root) as simulated:
        service = Service(simulated, observer=Reports())
        service.start()
        threads = [threading.Thread(target=work) for work in (service.run, ears.listen, ears.listen_die_and_come_back)]
        for thread in threads:
            thread.start()
        try:
            _wait(lambda: service.health()["camera"]["state"] == "ready")
            for number in range(frames + 1):  # by the last one's seq who came late sees what there was before
                service.request(CaptureRequest("benchmark", "console", number))
                _wait(lambda: len(ears.decode_ms) > number)  # noqa: B023  # it is called before the next round
            threads[2].join(DEADLINE_S)
        finally:
            ears.over.set()
            service.ask_to_stop()
            for thread in threads:
                thread.join(5)
            service.stop()
    beside = [
        (at_ns - ears.safe_ns[index]) / 1e6 - ears.decode_ms[index] for index, at_ns in sorted(ears.received_ns.items())
    ]
    return {
        "safe_to_received_less_decode_median_ms": statistics.median(beside),
        "safe_to_received_less_decode_worst_ms": max(beside),
        "frames_of_a_subscriber_started_again": len(ears.again & set(range(frames))) / frames,
    }


def header(number: int, body: NDArray[np.complex64]) -> dict[str, Any]:
    return {"frame": number, "arrays": [wire.describe_array("slices", body, "1.0 = sensor white")]}


def _no_answer(_: object, reply: Callable[[Message], None]) -> None:
    reply(Message("error", {"error": "this benchmark has no record"}))


@contextmanager
def publisher(root: Path) -> Iterator[Publisher]:
    """A publisher on `root`/s with the settings' high-water mark."""
    mark = PublishSettings().high_water_mark
    one = Publisher(f"ipc://{root}/s", "", high_water_mark=mark)
    one.start("benchmark", _no_answer)
    try:
        yield one
    finally:
        one.stop(0.0)


@contextmanager
def reader(root: Path) -> Iterator[Connection]:
    """A subscriber in a process of its own, that says through the pipe when a message has come."""
    here, there = SPAWN.Pipe()
    process = SPAWN.Process(target=_read, args=[f"ipc://{root}/s", there, list(wire.TOPICS)], daemon=True)
    process.start()
    try:
        yield here
    finally:
        process.kill()
        process.join()


@contextmanager
def crowd(root: Path, one: Publisher) -> Iterator[list[BaseProcess]]:
    """Ten subscribers, each in a process of its own, all of them connected."""
    pipes, processes = [], []
    for number in range(10):
        here, there = SPAWN.Pipe()
        topics = ["slices"] if number < HUNG else list(wire.TOPICS)
        process = SPAWN.Process(target=_read, args=[f"ipc://{root}/s", there, topics, True], daemon=True)
        process.start()
        pipes.append(here)
        processes.append(process)
    try:
        for pipe in pipes:
            greet(one, pipe)
        yield list(processes)
    finally:
        for process in processes:
            process.kill()
            process.join()


def greet(one: Publisher, pipe: Connection) -> None:
    """Publish until the reader has heard something, and nothing of that is left in the pipe."""
    until = time.monotonic() + DEADLINE_S
    while not pipe.poll(0.05):
        if time.monotonic() > until:
            raise TimeoutError("a subscriber never came")
        one.publish("slices", {"frame": 0, "arrays": []}, b"")
    while pipe.poll(0.2):
        pipe.recv()


def _read(endpoint: str, pipe: Connection, topics: list[str], once: bool = False) -> None:
    said = False
    reuse_large_blocks()
    if os.getpriority(os.PRIO_PROCESS, 0) < 0:
        os.setpriority(os.PRIO_PROCESS, 0, 0)  # a reader is not part of the service
    with Subscriber(endpoint, topics=topics) as subscriber:
        while True:
            message = subscriber.receive(60.0)
            if message is not None and not (once and said):
                pipe.send(message.topic)
                said = True


def _wait(condition: Callable[[], bool]) -> None:
    until = time.monotonic() + DEADLINE_S
    while not condition():
        if time.monotonic() > until:
            raise TimeoutError("the simulated flight stands still")
        time.sleep(0.002)


if __name__ == "__main__":
    main()
