"""The relay with real sockets, turn by turn, between viewers and a stand-in for the daemon."""

from __future__ import annotations

import contextlib
import os
import socket
from collections import Counter
from collections.abc import Iterator
from pathlib import Path

import pytest

from dappled.clock import RecordedClock
from dappled.daemon.stream import relay_process
from dappled.daemon.stream.admission import ConnectionLimits
from dappled.daemon.stream.relay_process import Relay
from dappled.findings import Code
from tests.daemon.stream.test_admission import GREETING, READY

LIMITS = ConnectionLimits(opening=6, opening_per_address=4, open=3, open_per_address=2)


class Rig:
    """A relay with one route; `accept` takes the relay's next connection as the daemon."""

    def __init__(self, folder: Path) -> None:
        self.inner = socket.socket(socket.AF_UNIX)
        self.inner.bind(str(folder / "inner"))
        self.inner.listen(64)
        self.inner.settimeout(60)
        listener = socket.create_server(("0.0.0.0", 0), backlog=64)  # noqa: S104  # to be reached by several addresses
        self.port = listener.getsockname()[1]
        self.clock = RecordedClock(10**18)
        self.relay = Relay({listener: str(folder / "inner")}, limits=LIMITS, clock=self.clock)
        self._sockets = [self.inner, listener]

    def viewer(self, says: bytes = b"", source: str = "127.0.0.1") -> socket.socket:
        one = socket.create_connection(("127.0.0.1", self.port), 5, (source, 0))
        self._sockets.append(one)
        one.sendall(says)
        self.turn()
        return one

    def accept(self) -> socket.socket:
        one, _ = self.inner.accept()
        one.settimeout(60)
        self._sockets.append(one)
        return one

    def let_in(self, source: str = "127.0.0.1") -> tuple[socket.socket, socket.socket]:
        """A viewer whose handshake is complete, and the daemon's end."""
        viewer = self.viewer(GREETING, source)
        daemon = self.accept()
        daemon.sendall(GREETING + READY)
        self.turn()
        return viewer, daemon

    def turn(self) -> None:
        for _ in range(6):
            self.relay.turn(0.01)

    def reasons(self) -> dict[str, int]:
        found: Counter[str] = Counter()
        for _, reason, count in self.relay.refusals()["refused"]:
            found[reason] += count
        return dict(found)

    def close(self) -> None:
        self.relay.close()
        for one in self._sockets:
            one.close()


@pytest.fixture
def rig(tmp_path: Path) -> Iterator[Rig]:
    one = Rig(tmp_path)
    yield one
    one.close()


def closed(one: socket.socket) -> bool:
    one.setblocking(False)
    try:
        return one.recv(1) == b""
    except BlockingIOError:
        return False
    except ConnectionResetError:
        return True


def test_bytes_pass_both_ways_unchanged(rig: Rig) -> None:
    viewer, daemon = rig.let_in()
    assert daemon.recv(1000) == GREETING
    assert viewer.recv(1000) == GREETING + READY
    picture = os.urandom(3_000_000)
    daemon.setblocking(False)
    sent, got = 0, bytearray()
    viewer.setblocking(False)
    for _ in range(10_000):
        with contextlib.suppress(BlockingIOError):
            sent += daemon.send(picture[sent:])
        rig.relay.turn(0.0)
        with contextlib.suppress(BlockingIOError):
            got += viewer.recv(1 << 20)
        if len(got) == len(picture):
            break
    assert got == picture
    viewer.setblocking(True)
    viewer.sendall(b"question")
    rig.turn()
    assert daemon.recv(1000) == b"question"


def test_the_silent_and_what_is_not_zeromq_never_reach_the_daemon(rig: Rig) -> None:
    silent = [rig.viewer() for _ in range(3)]
    browser = rig.viewer(b"GET / HTTP/1.1\r\n")
    rig.inner.settimeout(0.0)
    with pytest.raises(BlockingIOError):
        rig.accept()
    assert closed(browser)
    assert not any(closed(one) for one in silent)
    rig.clock.advance(LIMITS.handshake_s + 1)
    rig.turn()
    assert all(closed(one) for one in silent)
    assert rig.reasons() == {Code.PEER_NOT_ZEROMQ: 1, Code.PEER_SILENT: 3}


def test_a_handshake_that_is_not_completed_in_time_frees_the_daemon_s_end(rig: Rig) -> None:
    viewer = rig.viewer(GREETING)
    daemon = rig.accept()
    rig.clock.advance(LIMITS.handshake_s + 1)
    rig.turn()
    assert closed(viewer)
    assert daemon.recv(1000) == GREETING
    assert closed(daemon)
    assert rig.reasons() == {Code.PEER_HANDSHAKE_SLOW: 1}


def test_strangers_displace_strangers_and_no_viewer(rig: Rig) -> None:
    viewer, daemon = rig.let_in()
    coming = rig.viewer(GREETING, "127.0.0.2")
    crowd = [rig.viewer(source="127.0.0.3") for _ in range(40)]
    assert sum(not closed(one) for one in crowd) == LIMITS.opening_per_address
    daemon.sendall(b"more")
    rig.turn()
    assert viewer.recv(1000).endswith(b"more")
    assert not closed(coming)
    assert rig.reasons() == {Code.PEER_DISPLACED: 40 - LIMITS.opening_per_address}


def test_open_connections_have_a_limit_for_each_address_and_for_all(rig: Rig) -> None:
    viewers = [rig.let_in("127.0.0.2") for _ in range(2)]
    assert closed(rig.viewer(GREETING, "127.0.0.2"))
    viewers.append(rig.let_in("127.0.0.3"))
    assert closed(rig.viewer(GREETING, "127.0.0.4"))
    assert rig.reasons() == {Code.PEER_TOO_MANY: 2}
    viewers[0][0].close()
    rig.turn()
    rig.let_in("127.0.0.4")


def test_who_reads_nothing_holds_up_the_daemon_s_end_and_is_closed(rig: Rig) -> None:
    viewer, daemon = rig.let_in()
    daemon.setblocking(False)
    taken, stuck = 0, 0
    while stuck < 20:
        try:
            taken += daemon.send(bytes(1 << 16))
            stuck = 0
        except BlockingIOError:
            stuck += 1
        rig.relay.turn(0.0)
    (one,) = rig.relay._kept.values()
    assert one.outward is not None
    assert 0 < len(one.outward.waiting) <= relay_process._CHUNK_BYTES
    rig.clock.advance(LIMITS.unread_s - 1)
    rig.turn()
    assert rig.reasons() == {}
    rig.clock.advance(2)
    rig.turn()
    assert rig.reasons() == {Code.PEER_READS_NOTHING: 1}
    assert not rig.relay.busy
    viewer.close()


def test_who_sends_more_than_questions_take_is_closed(rig: Rig) -> None:
    """ZeroMQ keeps the parts of a message that never ends."""
    viewer, daemon = rig.let_in()
    part = b"\x03\xff" + bytes(255)  # one more follows
    daemon.setblocking(False)
    for _ in range(LIMITS.said_bytes // len(part) // 2):
        viewer.sendall(part)
        rig.relay.turn(0.0)
        with contextlib.suppress(BlockingIOError):
            daemon.recv(1 << 20)
    assert rig.reasons() == {}
    viewer.setblocking(False)
    with contextlib.suppress(ConnectionError):
        for _ in range(100_000):
            with contextlib.suppress(BlockingIOError):
                viewer.send(part * 100)
            rig.relay.turn(0.0)
            with contextlib.suppress(BlockingIOError):
                daemon.recv(1 << 20)
            if not rig.relay.busy:
                break
    assert rig.reasons() == {Code.PEER_SAYS_TOO_MUCH: 1}


def test_what_the_daemon_sent_last_still_arrives(rig: Rig) -> None:
    viewer, daemon = rig.let_in()
    stranger = rig.viewer()
    daemon.sendall(b"end")
    daemon.close()
    rig.relay.drain()
    rig.turn()
    assert viewer.recv(1000).endswith(b"end")
    assert closed(stranger)
    assert not rig.relay.busy


def test_a_wrong_key_is_reported_with_its_address(rig: Rig) -> None:
    rig.viewer(GREETING, "127.0.0.9")
    rig.accept().close()
    rig.turn()
    assert rig.relay.refusals()["refused"] == [["127.0.0.9", Code.PEER_HANDSHAKE_FAILED, 1]]
