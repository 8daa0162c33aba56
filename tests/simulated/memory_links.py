"""UDP between the parts of one process: packets in memory, lost, doubled, spoilt and late by seed, under a virtual
clock. Each port is read through `UdpIn`, as a real one is."""

from __future__ import annotations

import heapq
import random
from collections.abc import Callable
from math import inf
from typing import cast

from dappled.drivers.mavlink.channels import Address, ByteChannel, UdpIn
from tests.simulated.bad_link import LinkFaults
from tests.simulated.virtual_clock import VirtualClock

_AWAY = 40_000  # the first port of those that call


class MemorySocket:
    """What `UdpIn` uses of a socket. Bytes that are due wait in order of their time."""

    def __init__(self, network: MemoryNetwork, port: int, to: int | None) -> None:
        self.network, self.port, self.to = network, port, to
        self.arrivals: list[tuple[int, int, bytes, int]] = []  # when, order, bytes, from which port
        self.closed = False

    def due_ns(self) -> float:
        return self.arrivals[0][0] if self.arrivals else inf

    def recvfrom(self, _size: int) -> tuple[bytes, tuple[str, int]]:
        if self.due_ns() > self.network.clock.monotonic_ns():
            raise BlockingIOError(11, "nothing yet")
        _, _, data, source = heapq.heappop(self.arrivals)
        return data, ("127.0.0.1", source)

    def sendto(self, data: bytes, to: tuple[str, int]) -> None:
        self.network.carry(self.port, to[1], data)

    def setblocking(self, blocking: bool) -> None:
        assert not blocking

    def setsockopt(self, *_: int) -> None:
        """It has room for everything."""

    def getsockname(self) -> tuple[str, int]:
        return "127.0.0.1", self.port

    def close(self) -> None:
        self.closed = True
        self.network.sockets.pop(self.port, None)


class _Calling(UdpIn):
    """The other end of a link: it sends to one port, and hears what comes back."""

    def write(self, data: bytes) -> bool:
        sock = cast(MemorySocket, self._sock)
        assert sock.to is not None
        sock.sendto(data, ("127.0.0.1", sock.to))
        return True


class MemoryNetwork:
    """See Transport. `faults` and `cuts` (begin and end, seconds from now) hold for each packet, either way;
    `sent` has every datagram that a part has sent, in order: when, from, to, bytes."""

    def __init__(
        self,
        clock: VirtualClock,
        seed: int,
        faults: LinkFaults,
        cuts: tuple[tuple[float, float], ...] = (),
    ) -> None:
        self.clock, self._faults = clock, faults
        self._random = random.Random(f"network {seed}")  # noqa: S311  # a simulation
        began_ns = clock.monotonic_ns()
        self._cuts = [(began_ns + round(start * 1e9), began_ns + round(end * 1e9)) for start, end in cuts]
        self.sockets: dict[int, MemorySocket] = {}
        self.sent: list[tuple[int, int, int, bytes]] = []
        self.watch: Callable[[int, bytes], object] = lambda source, data: None
        self._order = 0
        self._next_port = _AWAY

    def open(self, address: Address) -> ByteChannel:
        """See Transport."""
        if address.kind == "udpin":
            return UdpIn(self._socket(address.port, None), self.clock)  # type: ignore[arg-type]  # all that it uses
        self._next_port += 1
        return _Calling(self._socket(self._next_port, address.port), self.clock)  # type: ignore[arg-type]

    def wait(self, channel: ByteChannel, timeout_s: float) -> tuple[bool, bool]:
        """See Transport."""
        sock, now_ns = self.sockets.get(channel.port()), self.clock.monotonic_ns
        if sock is None:
            raise OSError(9, "closed")
        until_ns = now_ns() + round(timeout_s * 1e9)
        while (due_ns := sock.due_ns()) > now_ns() and now_ns() < until_ns and not sock.closed:
            next_ns = min(due_ns, until_ns)
            self.clock.until(lambda due_ns=due_ns: sock.due_ns() < due_ns or sock.closed, (next_ns - now_ns()) / 1e9)  # type: ignore[misc]
        return due_ns <= now_ns(), False

    def carry(self, source: int, to: int, data: bytes) -> None:
        """A datagram is sent."""
        now_ns = self.clock.monotonic_ns()
        self.watch(source, data)
        self.sent.append((now_ns, source, to, data))
        chance, faults = self._random.random, self._faults
        if to not in self.sockets or any(start <= now_ns < end for start, end in self._cuts):
            return
        if chance() < faults.garbage:
            self._put(source, to, self._random.randbytes(self._random.randrange(1, 300)))
        if chance() < faults.loss:
            return
        if chance() < faults.torn:
            data = data[: self._random.randrange(1, len(data) + 1)]
        self._put(source, to, data)
        if chance() < faults.doubles:
            self._put(source, to, data)

    def _put(self, source: int, to: int, data: bytes) -> None:
        late_s = self._random.uniform(0, self._faults.late_s) if self._faults.late_s else 0.0
        self._order += 1
        arrival = (self.clock.monotonic_ns() + round(late_s * 1e9), self._order, data, source)
        heapq.heappush(self.sockets[to].arrivals, arrival)

    def _socket(self, port: int, to: int | None) -> MemorySocket:
        sock = self.sockets[port] = MemorySocket(self, port, to)
        return sock
