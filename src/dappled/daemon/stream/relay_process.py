"""The process that takes viewers' TCP connections and relays their bytes to the daemon's own ipc endpoints.

`python -m dappled.daemon.stream.relay_process CHANNEL_FD (LISTENER_FD PATH)...`. It decrypts nothing and keeps no
message: a viewer that does not read holds up its own connection, and with it the queue that ZeroMQ has for it in the
daemon. It ends with the daemon.
"""

from __future__ import annotations

import contextlib
import errno
import os
import selectors
import signal
import socket
import sys
from collections import Counter
from collections.abc import Mapping
from typing import Any

from dappled.clock import Clock, SystemClock
from dappled.daemon.stream import admission
from dappled.daemon.stream.admission import ConnectionLimits, Handshake, OpeningConnection
from dappled.drivers.child_process import ChannelError, ProcessChannel
from dappled.findings import Code
from dappled.shown import guard_output

NICENESS = 12  # as ZeroMQ's own thread in the daemon
_CHUNK_BYTES = 1 << 18
_CHUNKS = 8  # of one connection, before the others have their turn
_ACCEPTED = 64
_PAUSE_NS = 10**8
_REPORT_NS = 10**9
_REPORTED = 64  # lines of one report; the rest is one number
_DRAIN_NS = 2 * 10**9
_TURN_S = 0.2
_USER_TIMEOUT_MS = 30_000
_FULL = (errno.EMFILE, errno.ENFILE, errno.ENOBUFS, errno.ENOMEM)


class Flow:
    """One direction of a connection: what was read and not yet written is at most one chunk."""

    def __init__(self, source: socket.socket, sink: socket.socket, waiting: bytes = b"") -> None:
        self.source, self.sink, self.waiting = source, sink, waiting
        self.ended = False
        self.read_bytes = len(waiting)

    def pump(self, scratch: memoryview, handshake: Handshake | None = None) -> bool:
        """Move what can be moved without waiting; whether anything was. Raises OSError where one end is gone."""
        moved = False
        with contextlib.suppress(BlockingIOError):
            for _ in range(_CHUNKS):
                if self.waiting:
                    self.waiting = self.waiting[self.sink.send(self.waiting) :]
                    moved = True
                elif not self.ended:
                    moved = self._read(scratch, handshake) or moved
                else:
                    break
        return moved

    def _read(self, scratch: memoryview, handshake: Handshake | None) -> bool:
        count = self.source.recv_into(scratch)
        self.ended = not count
        self.read_bytes += count
        read = scratch[:count]
        if handshake is not None:
            handshake.feed(read)
        sent = 0
        try:
            sent = self.sink.send(read) if count else 0
        finally:
            self.waiting = bytes(read[sent:])
        return bool(count)


class ViewerConnection:
    """One viewer's connection, and from its greeting on the one to the daemon."""

    def __init__(self, number: int, viewer: socket.socket, path: str, address: str, now_ns: int) -> None:
        self.number, self.viewer, self.path, self.address = number, viewer, path, address
        self.network = admission.network_of(address)
        self.began_ns = self.read_ns = now_ns
        self._begin = b""
        self.handshake = Handshake()
        self.daemon: socket.socket | None = None
        self.inward: Flow | None = None
        self.outward: Flow | None = None

    @property
    def opening(self) -> OpeningConnection | None:
        """What the limits go by, until the handshake is complete."""
        if self.handshake.complete:
            return None
        return OpeningConnection(self.number, self.network, self.daemon is not None)

    def greet(self) -> Code | None:
        """Connect to the daemon when the viewer's ZeroMQ signature has come. Returns why it is refused. Raises
        OSError."""
        read = self.viewer.recv(admission.SIGNATURE_BYTES - len(self._begin))
        self._begin += read
        if not read:
            return Code.PEER_SILENT
        if len(self._begin) < admission.SIGNATURE_BYTES:
            return None
        if not admission.is_zeromq(self._begin):
            return Code.PEER_NOT_ZEROMQ
        daemon = socket.socket(socket.AF_UNIX, socket.SOCK_STREAM)
        try:
            daemon.setblocking(False)
            daemon.connect(self.path)
        except OSError:  # it ends, or takes no more connections now: the viewer tries again by itself
            daemon.close()
            return Code.PEER_NOT_TAKEN
        self.daemon = daemon
        self.inward, self.outward = Flow(self.viewer, daemon, self._begin), Flow(daemon, self.viewer)
        return None

    def close(self) -> None:
        """Close both ends."""
        self.viewer.close()
        if self.daemon is not None:
            self.daemon.close()


class Relay:
    """Accepts connections and relays them, in one thread. `routes`: the listening sockets, and the daemon's endpoint of
    each."""

    def __init__(
        self, routes: Mapping[socket.socket, str], *, limits: ConnectionLimits | None = None, clock: Clock | None = None
    ) -> None:
        self._routes, self._limits = dict(routes), limits or ConnectionLimits()
        self._clock = clock or SystemClock()
        self._ready = selectors.DefaultSelector()
        self._kept: dict[int, ViewerConnection] = {}
        self._number = 0
        self._paused_until_ns: int | None = None
        self._scratch = memoryview(bytearray(_CHUNK_BYTES))
        self._refused: Counter[tuple[str, Code]] = Counter()
        for listener in self._routes:
            listener.setblocking(False)
        self._listen(True)

    @property
    def busy(self) -> bool:
        """Whether any connection is open."""
        return bool(self._kept)

    def watch(self, channel: socket.socket) -> None:
        """Let `turn` return when this socket has something to read."""
        self._ready.register(channel, selectors.EVENT_READ)

    def refusals(self) -> dict[str, Any]:
        """What was refused since the last call: [address, reason, count] of the most frequent, and how many others."""
        counted, self._refused = self._refused, Counter()
        most = counted.most_common(_REPORTED)
        told = [[address, reason, count] for (address, reason), count in most]
        return {"refused": told, "others": counted.total() - sum(count for _, count in most)}

    def turn(self, timeout_s: float) -> None:
        """Wait for events, for so long at most, and serve them."""
        for key, _ in self._ready.select(timeout_s):
            if isinstance(key.data, int):
                if (one := self._kept.get(key.data)) is not None:
                    self._serve(one)
            elif key.fileobj in self._routes:
                self._accept(key.fileobj)
        self._look_at_times()

    def drain(self) -> None:
        """Accept no more; close all whose handshake is not complete."""
        self._listen(False)
        for listener in self._routes:
            listener.close()
        self._routes.clear()
        for one in [one for one in self._kept.values() if one.opening is not None]:
            self._close(one)

    def close(self) -> None:
        """Close all connections."""
        for one in list(self._kept.values()):
            self._close(one)
        self._ready.close()

    def _listen(self, on: bool) -> None:
        for listener in self._routes:
            if on:
                self._ready.register(listener, selectors.EVENT_READ)
            elif listener in self._ready.get_map():
                self._ready.unregister(listener)

    def _accept(self, listener: socket.socket) -> None:
        for _ in range(_ACCEPTED):
            try:
                viewer, address = listener.accept()
            except OSError as error:
                if error.errno in _FULL and self._paused_until_ns is None:
                    self._paused_until_ns = self._clock.monotonic_ns() + _PAUSE_NS
                    self._listen(False)
                return
            self._admit(viewer, str(address[0]), self._routes[listener])

    def _admit(self, viewer: socket.socket, address: str, path: str) -> None:
        viewer.setblocking(False)
        viewer.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
        viewer.setsockopt(socket.IPPROTO_TCP, socket.TCP_USER_TIMEOUT, _USER_TIMEOUT_MS)
        self._number += 1
        one = ViewerConnection(self._number, viewer, path, address, self._clock.monotonic_ns())
        if self._is_over(one.network, 1):
            self._refused[address, Code.PEER_TOO_MANY] += 1
            viewer.close()
            return
        self._kept[one.number] = one
        self._ready.register(viewer, selectors.EVENT_READ, one.number)
        opening = [each for other in self._kept.values() if (each := other.opening) is not None]
        if (victim := admission.surplus(opening, self._limits)) is not None:
            self._close(self._kept[victim.number], Code.PEER_DISPLACED)

    def _serve(self, one: ViewerConnection) -> None:
        try:
            reason = one.greet() if one.daemon is None else None
            if reason:
                self._close(one, reason)
            elif one.inward is not None and one.outward is not None:
                self._relay(one, one.inward, one.outward)
        except BlockingIOError:  # nothing has come after all
            return
        except OSError:
            self._close(one, None if one.handshake.complete else Code.PEER_HANDSHAKE_FAILED)

    def _relay(self, one: ViewerConnection, inward: Flow, outward: Flow) -> None:
        was_open, was_waiting = one.handshake.complete, bool(outward.waiting)
        moved = outward.pump(self._scratch, None if was_open else one.handshake)
        inward.pump(self._scratch)
        if moved or not was_waiting:
            one.read_ns = self._clock.monotonic_ns()
        if self._says_too_much(one, inward):
            self._close(one, Code.PEER_SAYS_TOO_MUCH)
        elif inward.ended or (outward.ended and not outward.waiting):
            self._close(one, None if one.handshake.complete else Code.PEER_HANDSHAKE_FAILED)
        elif one.handshake.complete and not was_open and self._is_over(one.network, 0):
            self._close(one, Code.PEER_TOO_MANY)
        else:
            self._await(one, inward, outward)

    def _says_too_much(self, one: ViewerConnection, inward: Flow) -> bool:
        age_s = (self._clock.monotonic_ns() - one.began_ns) / 1e9
        return inward.read_bytes > self._limits.said_bytes + self._limits.said_b_s * age_s

    def _is_over(self, network: str, more: int) -> bool:
        """Whether so many more open connections, and of a network, are too many."""
        networks = [one.network for one in self._kept.values() if one.opening is None]
        limits = self._limits
        return len(networks) + more > limits.open or networks.count(network) + more > limits.open_per_address

    def _await(self, one: ViewerConnection, inward: Flow, outward: Flow) -> None:
        for sock, reads, writes in ((inward.source, inward, outward), (outward.source, outward, inward)):
            wanted = 0 if reads.waiting or reads.ended else selectors.EVENT_READ
            wanted |= selectors.EVENT_WRITE if writes.waiting else 0
            key = self._ready.get_map().get(sock)
            if key is None:
                if wanted:
                    self._ready.register(sock, wanted, one.number)
            elif not wanted:  # a socket that has ended would be reported again and again
                self._ready.unregister(sock)
            elif key.events != wanted:
                self._ready.modify(sock, wanted, one.number)

    def _close(self, one: ViewerConnection, reason: Code | None = None) -> None:
        if reason:
            self._refused[one.address, reason] += 1
        del self._kept[one.number]
        for sock in (one.viewer, one.daemon):
            if sock is not None and sock in self._ready.get_map():
                self._ready.unregister(sock)
        one.close()

    def _look_at_times(self) -> None:
        now_ns, limits = self._clock.monotonic_ns(), self._limits
        if self._paused_until_ns is not None and now_ns >= self._paused_until_ns:
            self._paused_until_ns = None
            self._listen(True)
        for one in list(self._kept.values()):
            if one.opening is not None and now_ns - one.began_ns > limits.handshake_s * 1e9:
                self._close(one, Code.PEER_HANDSHAKE_SLOW if one.daemon is not None else Code.PEER_SILENT)
            elif one.outward is not None and one.outward.waiting and now_ns - one.read_ns > limits.unread_s * 1e9:
                self._close(one, Code.PEER_READS_NOTHING)


def main() -> int:
    """Relay until the daemon ends or closes the channel; then let open connections read what they have."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # the daemon handles ^C
    guard_output()
    os.nice(NICENESS)
    near = socket.socket(fileno=int(sys.argv[1]))
    given = iter(sys.argv[3:])  # after the parent's process id
    relay = Relay({socket.socket(fileno=int(fd)): path for fd, path in zip(given, given, strict=True)})
    relay.watch(near)
    clock = SystemClock()
    run(relay, ProcessChannel(near), clock)
    relay.drain()
    until_ns = clock.monotonic_ns() + _DRAIN_NS
    while relay.busy and clock.monotonic_ns() < until_ns:
        relay.turn(0.05)
    relay.close()
    return 0


def run(relay: Relay, channel: ProcessChannel, clock: Clock) -> None:
    """Relay, and report refusals once a second, until the channel is closed."""
    report_ns = clock.monotonic_ns()
    while True:
        relay.turn(_TURN_S)
        try:
            channel.receive(0.0)
            if clock.monotonic_ns() >= report_ns:
                report_ns = clock.monotonic_ns() + _REPORT_NS
                report = relay.refusals()
                if report["refused"]:
                    channel.send(report, timeout_s=0.05)
        except ChannelError:
            return


if __name__ == "__main__":
    sys.exit(main())
