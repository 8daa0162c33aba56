"""A bad radio: a UDP relay between one ground station and a camera that loses, doubles, delays and spoils packets.

It does so both ways, by a seed: the same packets in the same order fare alike.
"""

from __future__ import annotations

import heapq
import random
import selectors
import socket
import threading
import time
from dataclasses import dataclass


@dataclass(frozen=True, slots=True)
class LinkFaults:
    """What happens to a packet, as shares of 1. `late_s`: at most so late, each by its own chance, so that packets
    overtake each other. `garbage`: random bytes come before it; `torn`: only its beginning arrives."""

    loss: float = 0.0
    doubles: float = 0.0
    late_s: float = 0.0
    garbage: float = 0.0
    torn: float = 0.0


class BadLink:
    """The relay in a thread of its own; use as a context manager. `port` is where the ground station connects to."""

    def __init__(self, camera_port: int, faults: LinkFaults, seed: int = 1) -> None:
        self._faults = faults
        self._random = random.Random(seed)  # noqa: S311  # a simulation
        self._near, self._far = (socket.socket(socket.AF_INET, socket.SOCK_DGRAM) for _ in range(2))
        self._near.bind(("127.0.0.1", 0))
        self._far.connect(("127.0.0.1", camera_port))
        self.port: int = self._near.getsockname()[1]
        self._station: tuple[str, int] | None = None
        self._way: list[tuple[float, int, bool, bytes]] = []  # when, order, towards the camera, bytes
        self._order = 0
        self._stop = threading.Event()
        self._thread = threading.Thread(target=self._run, name="bad link", daemon=True)

    def __enter__(self) -> BadLink:
        self._thread.start()
        return self

    def __exit__(self, *_: object) -> None:
        self._stop.set()
        self._thread.join(2.0)
        self._near.close()
        self._far.close()

    def _run(self) -> None:
        with selectors.DefaultSelector() as ready:
            for sock in (self._near, self._far):
                sock.setblocking(False)
                ready.register(sock, selectors.EVENT_READ)
            while not self._stop.is_set():
                wait_s = 0.05 if not self._way else min(0.05, max(0.0, self._way[0][0] - time.monotonic()))
                for key, _ in ready.select(wait_s):
                    self._read(key.fileobj is self._near)
                while self._way and self._way[0][0] <= time.monotonic():
                    _, _, towards_camera, data = heapq.heappop(self._way)
                    self._deliver(towards_camera, data)

    def _read(self, from_station: bool) -> None:
        try:
            data, peer = (self._near if from_station else self._far).recvfrom(65536)
        except OSError:  # nothing after all, or nobody listens there
            return
        if from_station:
            self._station = peer
        chance, faults = self._random.random, self._faults
        if chance() < faults.garbage:
            self._put(from_station, self._random.randbytes(self._random.randrange(1, 300)))
        if chance() < faults.loss:
            return
        if chance() < faults.torn:
            data = data[: self._random.randrange(1, len(data) + 1)]
        self._put(from_station, data)
        if chance() < faults.doubles:
            self._put(from_station, data)

    def _put(self, towards_camera: bool, data: bytes) -> None:
        self._order += 1
        at = time.monotonic() + self._random.uniform(0, self._faults.late_s)
        heapq.heappush(self._way, (at, self._order, towards_camera, data))

    def _deliver(self, towards_camera: bool, data: bytes) -> None:
        try:
            if towards_camera:
                self._far.send(data)
            elif self._station is not None:
                self._near.sendto(data, self._station)
        except OSError:  # that side is gone: lost, as on a radio
            return
