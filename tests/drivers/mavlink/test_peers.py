"""Who is at the other end of a port: nothing is sent to those who have not shown who they are."""

from __future__ import annotations

import socket
import threading
import time
from collections.abc import Iterator
from pathlib import Path

import pytest

from dappled.clock import SystemClock
from dappled.drivers.mavlink import MavlinkLinks, Packet, make_key, mavlink, open_signing, pack, read_key
from dappled.drivers.mavlink.channels import UdpIn
from dappled.drivers.mavlink.peers import CREDIT_BYTES, MOST, Peers
from dappled.drivers.mavlink.signature_book import UNITS_PER_S
from dappled.drivers.mavlink.signing import EPOCH_UNIX_S
from dappled.drivers.mavlink.streams import TcpServer
from tests.drivers.mavlink.strangers import Strangers

S = 10**9


class Log:
    """A telemetry log of which only the numbers are wanted."""

    def __init__(self) -> None:
        self.count = 0

    def log_packet(self, _stamp_us: int, _raw: bytes) -> int:
        self.count += 1
        return self.count - 1

    def on_packet(self, packet: Packet) -> None:
        """What was logged, received or sent."""


class Port:
    """A link that listens, signed or not, and counts what it heard."""

    def __init__(self, folder: Path, *, signed: bool, scheme: str = "udpin") -> None:
        self.key = None
        signing = None
        if signed:
            make_key(folder / "key")
            self.key = read_key(folder / "key")
            signing = open_signing([folder / "key"], folder / "time", SystemClock())
        self.links = MavlinkLinks(
            [f"{scheme}:127.0.0.1:0"], system_id=1, component_id=100, clock=SystemClock(), signing=signing
        )
        self.heard = threading.Semaphore(0)
        self.known = self.strange = 0

    def start(self) -> None:
        self.links.start(Log(), self)

    def on_packet(self, packet: Packet) -> None:
        if packet.trusted:
            self.known += 1
            self.heard.release()
        else:
            self.strange += 1

    def send(self) -> bool:
        return self.links.sender.send(mavlink.MAVLink_heartbeat_message(30, 8, 0, 0, 4, 3))

    def refused(self) -> int:
        one = self.links.statistics()[0]
        return one.packets_bad + (one.signing.refused if one.signing else 0)

    def until_refused(self, count: int) -> None:
        deadline = time.monotonic() + 60
        while self.refused() < count:
            assert time.monotonic() < deadline, f"{self.refused()} of {count} were refused"
            threading.Event().wait(0.005)


class Station:
    """A program with a socket of its own."""

    def __init__(self, port: Port, host: str = "127.0.0.1") -> None:
        self.packer = mavlink.MAVLink(None, srcSystem=255, srcComponent=190)
        if port.key is not None:
            signing = self.packer.signing
            signing.secret_key, signing.sign_outgoing = port.key, True
            signing.timestamp = round((time.time() - EPOCH_UNIX_S) * UNITS_PER_S)
        self.socket = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
        self.socket.bind((host, 0))
        self.socket.connect(("127.0.0.1", port.links.port(0)))
        self.socket.settimeout(60)

    def packet(self) -> bytes:
        return pack(mavlink.MAVLink_heartbeat_message(6, 8, 0, 0, 4, 3), self.packer, version_1=False)

    def received(self) -> int:
        """Bytes that have come by now, after everything that was sent on loopback."""
        self.socket.setblocking(False)
        count = 0
        while True:
            try:
                count += len(self.socket.recv(65536))
            except BlockingIOError:
                return count


@pytest.fixture(params=[False, True], ids=["unsigned", "signed"])
def port(request: pytest.FixtureRequest, tmp_path: Path) -> Iterator[Port]:
    made = Port(tmp_path, signed=request.param)
    made.start()
    yield made
    made.links.stop()


def test_seventeen_strangers_who_send_a_byte_each_hear_nothing_and_displace_nobody(port: Port) -> None:
    station, strangers = Station(port), [Station(port) for _ in range(17)]
    station.socket.send(station.packet())
    assert port.heard.acquire(timeout=60)
    for stranger in strangers:
        stranger.socket.send(b"x")
    port.until_refused(17 if port.key else 1)  # what no packet begins in is one bad place
    assert port.send()
    assert station.socket.recv(300)
    assert [stranger.received() for stranger in strangers] == [0] * 17
    for each in (station, *strangers):
        each.socket.close()


def test_a_packet_that_is_recorded_and_sent_again_makes_no_peer(tmp_path: Path) -> None:
    port = Port(tmp_path, signed=True)
    port.start()
    station, stranger = Station(port), Station(port)
    recorded = station.packet()
    station.socket.send(recorded)
    assert port.heard.acquire(timeout=60)
    for _ in range(3):
        stranger.socket.send(recorded)
    port.until_refused(3)
    for _ in range(50):
        assert port.send()
    assert stranger.received() <= 3 * len(recorded)
    assert station.received() > 30 * len(recorded)
    port.links.stop()
    station.socket.close()
    stranger.socket.close()


def test_a_sound_packet_proves_for_five_seconds_and_a_signed_one_for_a_minute() -> None:
    peers = Peers()
    peers.shown(("a", 1), 20, "sound", 0)
    peers.shown(("b", 1), 20, "signed", 0)
    assert peers.receivers(1000, 4 * S) == [("a", 1), ("b", 1)]
    assert peers.receivers(1000, 6 * S) == [("b", 1)]
    assert peers.receivers(1000, 61 * S) == []


def test_a_full_table_refuses_newcomers_until_somebody_has_gone() -> None:
    peers = Peers()
    for number in range(MOST):
        peers.shown((f"a{number}", 1), 20, "sound", 0)
    peers.shown(("late", 1), 20, "signed", 4 * S)
    assert ("late", 1) not in peers.receivers(21, 4 * S)
    peers.shown(("a0", 1), 20, "sound", 4 * S)
    peers.shown(("late", 1), 20, "signed", 6 * S)
    assert peers.receivers(20, 6 * S) == [("a0", 1), ("late", 1)]


def test_one_host_without_a_signature_keeps_no_other_host_out() -> None:
    peers = Peers()
    for at in range(20):
        for number in range(2 * MOST):
            peers.shown(("stranger", number), 20, "sound", at * S)
    peers.shown(("station", 1), 20, "sound", 19 * S)
    receivers = peers.receivers(CREDIT_BYTES + 1, 19 * S)
    assert ("station", 1) in receivers
    assert len(receivers) == MOST - 3


def test_sixteen_hosts_on_an_unsigned_port_keep_nobody_from_an_answer(tmp_path: Path) -> None:
    port = Port(tmp_path, signed=False)
    port.start()
    hosts = [Station(port, host=f"127.0.0.{2 + number}") for number in range(2 * MOST)]
    station = Station(port, host="127.0.0.99")
    try:
        for each in (*hosts, station):
            each.socket.send(each.packet())
            assert port.heard.acquire(timeout=60)
        for _ in range(3):
            assert port.send()
        assert station.socket.recv(300)
        heard = [each.received() for each in (station, *hosts)]
        assert [count > 0 for count in heard] == [False, *[True] * MOST, False, *[True] * (MOST - 1)]
    finally:
        port.links.stop()
        for each in (station, *hosts):
            each.socket.close()


def test_calls_of_a_script_that_signs_have_a_port_each_and_none_waits_a_minute() -> None:
    peers = Peers()
    for number in range(2 * MOST):
        peers.shown(("script", number), 20, "signed", number * S)
        peers.shown(("station", 1), 20, "signed", number * S)
        assert {("script", number), ("station", 1)} <= set(peers.receivers(20, number * S))


def test_a_known_peer_that_floods_keeps_no_newcomer_waiting() -> None:
    known, newcomer, at = (socket.socket(socket.AF_INET, socket.SOCK_DGRAM) for _ in range(3))
    with known, newcomer, at:
        at.bind(("127.0.0.1", 0))
        port = UdpIn(at, SystemClock())
        known.sendto(b"k", at.getsockname())
        assert port.read() == b"k"
        port.shown("sound")
        known.sendto(b"k", at.getsockname())
        newcomer.sendto(b"n", at.getsockname())
        read = list[bytes | None]()
        for _ in range(100):
            read.append(port.read())
            known.sendto(b"k", at.getsockname())
        assert read.count(b"n") == 1


def test_a_datagram_without_bytes_leaves_nobody_waiting() -> None:
    with (
        socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as one,
        socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as at,
    ):
        at.bind(("127.0.0.1", 0))
        port = UdpIn(at, SystemClock())
        for data in (b"a", b"", b"b"):
            one.sendto(data, at.getsockname())
        assert [port.read(), port.read(), port.read()] == [b"a", b"b", b""]


def test_who_is_only_heard_is_sent_at_most_as_much_as_it_sent() -> None:
    peers = Peers()
    peers.shown(("a", 1), 50, "old", 0)
    assert peers.receivers(51, S) == []
    assert peers.receivers(50, S) == [("a", 1)]
    assert peers.receivers(1, S) == []
    for number in range(2000):  # of many addresses few are kept
        peers.shown(("b", number), 50, "old", S)
    assert len(peers.receivers(1, S)) == MOST


def test_what_strangers_send_to_a_signed_port_costs_the_station_nothing(tmp_path: Path) -> None:
    """Random, mutated, replayed, foreign and unsigned packets, between the station's own."""
    port = Port(tmp_path, signed=True)
    port.start()
    station, crowd = Station(port), [Station(port) for _ in range(20)]
    own = [station.packet() for _ in range(60)]
    sent = [0] * len(crowd)
    strangers = Strangers(own[:20], 3)
    try:
        for raw in own[:20]:
            station.socket.send(raw)
            assert port.heard.acquire(timeout=60)
        for number, raw in enumerate(own[20:]):
            for at in range(10):
                who = (10 * number + at) % len(crowd)
                sent[who] += crowd[who].socket.send(strangers.datagram())
            station.socket.send(raw)
            assert port.heard.acquire(timeout=60), number
            assert port.send()
        port.until_refused(300)
        one = port.links.statistics()[0]
        assert one.signing is not None
        assert one.signing.good == 60
        assert port.known == 60
        assert port.strange == one.signing.unsigned_taken <= 400 // 6  # radios' reports, some of them
        assert one.signing.replayed > 20
        assert one.signing.forged > 20
        came = [each.received() for each in crowd]
        assert [more for more, went in zip(came, sent, strict=True) if more > went] == []
        assert station.received() >= 40 * 34
    finally:
        port.links.stop()
        for each in (station, *crowd):
            each.socket.close()


class TcpStation(Station):
    """The same over a connection."""

    def __init__(self, port: Port) -> None:
        super().__init__(port)
        self.socket.close()
        self.socket = socket.create_connection(("127.0.0.1", port.links.port(0)), 20)


def test_a_stranger_on_a_signed_tcp_port_hears_nothing_and_displaces_nobody(tmp_path: Path) -> None:
    port = Port(tmp_path, signed=True, scheme="tcpin")
    port.start()
    station, strangers = TcpStation(port), list[TcpStation]()
    recorded = station.packet()
    try:
        station.socket.sendall(recorded)
        assert port.heard.acquire(timeout=60)
        for _ in range(6):
            strangers.append(TcpStation(port))
            strangers[-1].socket.sendall(recorded)
            refused = len(strangers)
            port.until_refused(refused)
        for _ in range(20):
            assert port.send()
        whole = station.packet()
        strangers[-1].socket.sendall(b"\xfd\xff")  # as if a packet began, which is no part of the station's
        station.socket.sendall(whole)
        assert port.heard.acquire(timeout=60)
        assert sum(len(one.socket.recv(300)) for one in strangers[-1:]) <= len(recorded)
        assert strangers[0].socket.recv(300) == b""  # of those who wait for nothing four are kept
        heard = 0
        while heard < 20 * len(recorded):
            heard += len(station.socket.recv(300))
        successor = TcpStation(port)
        strangers.append(successor)
        successor.socket.sendall(station.packet())
        assert port.heard.acquire(timeout=60)
        assert station.socket.recv(300) == b""
    finally:
        port.links.stop()
        for each in (station, *strangers):
            each.socket.close()


def test_a_stranger_who_always_sends_keeps_no_client_of_a_signed_tcp_port_waiting() -> None:
    listening = socket.create_server(("127.0.0.1", 0))
    listening.setblocking(False)
    server = TcpServer(listening)
    server.ask_proof()
    try:
        with (
            socket.create_connection(listening.getsockname(), 20) as station,
            socket.create_connection(listening.getsockname(), 20) as stranger,
        ):
            station.sendall(b"signed")
            while server.read() != b"signed":
                pass
            server.shown("signed")
            stranger.sendall(bytes(50_000))
            while not server.read():
                pass
            station.sendall(b"command")
            read = [server.read() for _ in range(3)]
            assert b"command" in read
            assert {len(one or b"") for one in read} == {len(b"command"), 1024}
    finally:
        server.close()
