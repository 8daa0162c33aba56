"""Links over real sockets on loopback, and a pseudo terminal."""

from __future__ import annotations

import contextlib
import errno
import os
import pty
import socket
import threading
import time
from collections.abc import Callable
from pathlib import Path

import pytest
from hypothesis import given
from hypothesis import strategies as st

from dappled.clock import Clock, SystemClock
from dappled.drivers.mavlink import channels
from dappled.drivers.mavlink.channels import Address, LinkError
from dappled.drivers.mavlink.framing import Framer, PacketParser, mavlink, pack
from dappled.drivers.mavlink.links import MavlinkLinks, Packet
from dappled.drivers.mavlink.streams import ByteStream
from tests.needs import without
from tests.waiting import eventually


class Side:
    """One end of a link, with all packets that it saw and logged."""

    def __init__(self, url: str, *, system_id: int = 1, on_packet: Callable[[Packet], None] | None = None) -> None:
        self.packets: list[Packet] = []
        self.logged: list[bytes] = []
        self.changed = threading.Condition()
        self.log_fails = False
        self._act = on_packet
        self.links = MavlinkLinks([url], system_id=system_id, component_id=1, clock=SystemClock())

    def start(self) -> None:
        self.links.start(self)

    def log_packet(self, stamp_us: int, raw: bytes) -> int:
        if self.log_fails:
            raise OSError("disk full")
        assert abs(stamp_us - time.time_ns() // 1000) < 10**8
        self.logged.append(raw)
        return len(self.logged) - 1

    def on_packet(self, packet: Packet) -> None:
        with self.changed:
            self.packets.append(packet)
            self.changed.notify_all()
        if self._act:
            self._act(packet)

    def received(self, count: int, timeout_s: float = 10.0) -> list[Packet]:
        with self.changed:
            assert self.changed.wait_for(lambda: sum(not p.sent for p in self.packets) >= count, timeout_s)
            return [p for p in self.packets if not p.sent]

    def __enter__(self) -> Side:
        self.start()
        return self

    def __exit__(self, *_: object) -> None:
        self.links.stop()


def heartbeat() -> object:
    return mavlink.MAVLink_heartbeat_message(2, 3, 0, 0, 4, 3)


def send_until_received(sender: Side, receiver: Side, count: int = 1) -> list[Packet]:
    deadline = time.monotonic() + 60
    while sum(not p.sent for p in list(receiver.packets)) < count and time.monotonic() < deadline:
        sender.links.sender.send(heartbeat())
        with receiver.changed:
            receiver.changed.wait(0.1)
    return receiver.received(count)


@pytest.mark.parametrize(("listen", "connect"), [("udpin", "udpout"), ("tcpin", "tcp")])
def test_both_ways_and_logged_before_acted_on(listen: str, connect: str) -> None:
    with Side(f"{listen}:127.0.0.1:0") as server:
        with Side(f"{connect}:127.0.0.1:{server.links.port(0)}", system_id=7) as client:
            first = send_until_received(client, server)[0]
            assert first.message.get_srcSystem() == 7
            assert server.logged[first.number or 0] == first.raw
            back = send_until_received(server, client)[0]
            assert back.message.get_srcSystem() == 1
            sent = next(p for p in server.packets if p.sent)
            assert server.logged[sent.number or 0] == sent.raw == back.raw
        assert [p.number for p in server.packets] == list(range(len(server.packets)))


def test_mavlink_1_is_understood_and_answered_in_kind() -> None:
    with Side("udpin:127.0.0.1:0") as server, socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as old:
        old.settimeout(60)
        packer = mavlink.MAVLink(None, srcSystem=9, srcComponent=1)
        old.sendto(heartbeat().pack(packer, force_mavlink1=True), ("127.0.0.1", server.links.port(0)))  # type: ignore[attr-defined]  # pymavlink's messages are untyped
        assert server.received(1)[0].raw[0] == 0xFE
        server.links.sender.send(heartbeat())
        assert old.recv(300)[0] == 0xFE
        server.links.sender.send(mavlink.MAVLink_camera_settings_message(0, 0, 0, 0))
        assert old.recv(300)[0] == 0xFD


def test_a_tcp_link_comes_back_after_its_server_was_gone() -> None:
    server = Side("tcpin:127.0.0.1:0")
    server.start()
    port = server.links.port(0)
    with Side(f"tcp:127.0.0.1:{port}") as client:
        send_until_received(client, server)
        server.links.stop()
        with Side(f"tcpin:127.0.0.1:{port}") as again:
            send_until_received(client, again)
            assert client.links.statistics()[0].error is None


def test_a_client_that_fell_silent_does_not_keep_the_next_one_waiting() -> None:
    with Side("tcpin:127.0.0.1:0") as server:
        address = ("127.0.0.1", server.links.port(0))
        with socket.create_connection(address) as vanished, socket.create_connection(address) as second:
            packer = mavlink.MAVLink(None, srcSystem=9, srcComponent=1)
            second.sendall(heartbeat().pack(packer))  # type: ignore[attr-defined]  # as above
            assert server.received(1)[0].message.get_srcSystem() == 9
            server.links.sender.send(heartbeat())
            second.settimeout(60)
            assert second.recv(300)[0] == 0xFD
            vanished.settimeout(60)
            assert vanished.recv(300) == b""  # closed: a client that is still there connects again


@pytest.mark.filterwarnings("ignore::pytest.PytestUnhandledThreadExceptionWarning")  # what it provokes
def test_a_receiving_thread_that_ended_is_named() -> None:
    class Broken:
        def descriptors(self) -> list[int]:
            raise SystemExit  # a bug that no handler foresaw

        def close(self) -> None:
            return

    side = Side("udpin:127.0.0.1:0")
    with side:
        assert side.links.dead_threads() == []
        open_one = side.links._links[0].channel
        assert open_one is not None
        side.links._links[0].channel = Broken()  # type: ignore[assignment]  # all that the thread asks
        eventually(lambda: side.links.dead_threads() == ["mavlink 0"], "the dead thread is told")
        open_one.close()
    assert side.links.dead_threads() == []  # it was asked to end


def test_what_receives_goes_before_the_other_threads() -> None:
    """Those that compute would keep an acknowledgement waiting."""
    own, wanted = os.getpriority(os.PRIO_PROCESS, threading.get_native_id()), list[int]()

    def most() -> None:
        me = threading.get_native_id()
        with contextlib.suppress(PermissionError):
            os.setpriority(os.PRIO_PROCESS, me, own - 5)
        wanted.append(os.getpriority(os.PRIO_PROCESS, me))

    allowed = threading.Thread(target=most)
    allowed.start()
    allowed.join()
    before = set(threading.enumerate())
    with Side("udpin:127.0.0.1:0") as server, Side(f"udpout:127.0.0.1:{server.links.port(0)}") as client:
        send_until_received(client, server)
        send_until_received(server, client)
        new = set(threading.enumerate()) - before
        found = [os.getpriority(os.PRIO_PROCESS, one.native_id or 0) for one in new if one.name == "mavlink 0"]
        assert found == wanted * 2


def test_a_channel_that_is_opened_after_the_end_is_closed(monkeypatch: pytest.MonkeyPatch) -> None:
    """A server that answers while `stop` gives up waiting for the thread that asked."""
    near, far = socket.socketpair()
    asked, answered = threading.Event(), threading.Event()

    def late(_: Address, __: Clock) -> ByteStream:
        asked.set()
        assert answered.wait(60)
        return ByteStream(near.fileno(), near.close)

    with socket.create_server(("127.0.0.1", 0)) as gone:
        port = gone.getsockname()[1]
    side = Side(f"tcp:127.0.0.1:{port}")
    side.links.open()  # no server is there yet
    monkeypatch.setattr(channels, "open_channel", late)
    side.start()
    assert asked.wait(60)
    side.links.stop()
    answered.set()
    far.settimeout(60)
    assert far.recv(1) == b""
    assert side.links.port(0) == 0
    far.close()


def terminals() -> tuple[int, int]:
    """Both ends of a pseudo terminal."""
    try:
        return pty.openpty()
    except OSError as error:
        without(f"there are no pseudo terminals here ({error}): mount devpts at /dev/pts")


def test_a_serial_device() -> None:
    near, far = terminals()
    try:
        with Side(f"{os.ttyname(far)},57600") as side:
            packer = mavlink.MAVLink(None, srcSystem=3, srcComponent=1)
            os.write(near, b"noise" + heartbeat().pack(packer))  # type: ignore[attr-defined]  # as above
            assert side.received(1)[0].message.get_srcSystem() == 3
            side.links.sender.send(heartbeat())
            assert os.read(near, 300)[0] == 0xFD
            assert side.links.statistics()[0].packets_bad >= 1
    finally:
        os.close(near)
        os.close(far)


def test_a_port_in_use_is_reported_in_one_sentence() -> None:
    with Side("udpin:127.0.0.1:0") as server, pytest.raises(LinkError, match="in use"):
        Side(f"udpin:127.0.0.1:{server.links.port(0)}").start()


@pytest.mark.parametrize(
    ("url", "words"),
    [
        ("/dev/null", "is not a serial device"),
        ("/dev/null,12345", "a serial port can't run at 12345 baud"),
    ],
)
def test_a_link_that_can_not_be_opened_is_reported_in_one_sentence(url: str, words: str) -> None:
    with pytest.raises(LinkError, match=words):
        Side(url).start()


@pytest.mark.parametrize(
    ("url", "words"),
    [
        ("/dev/ttyNowhere7", "there is no device /dev/ttyNowhere7"),
        ("udpin:203.0.113.7:0", "is not an address of this machine"),
    ],
)
def test_a_device_or_an_address_that_is_not_there_yet_is_waited_for(url: str, words: str) -> None:
    with Side(url) as side:
        assert words in (side.links.statistics()[0].error or "")


def test_a_serial_device_that_comes_late_is_opened(tmp_path: Path) -> None:
    device = tmp_path / "ttyLate"
    far, near = terminals()
    try:
        with Side(f"{device},57600") as side:
            assert side.links.statistics()[0].error is not None
            device.symlink_to(os.ttyname(near))
            eventually(lambda: side.links.statistics()[0].error is None, "the link is open")
    finally:
        os.close(near)
        os.close(far)


@pytest.mark.parametrize(
    ("number", "words"), [(errno.EACCES, "add the user to the group"), (errno.EPERM, "restart the service")]
)
def test_a_serial_device_that_may_not_be_opened_yet_is_waited_for(
    number: int, words: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    """udev gives a device to its group after it has appeared; systemd keeps from a service what came after it."""
    far, near = terminals()
    device, real, shut = os.ttyname(near), os.open, [True]

    def opened(path: str, *how: int, **more: int) -> int:
        if path == device and shut:
            raise PermissionError(number, os.strerror(number), path)
        return real(path, *how, **more)

    monkeypatch.setattr(os, "open", opened)
    try:
        with Side(device) as side:
            assert words in (side.links.statistics()[0].error or "")
            shut.clear()
            eventually(lambda: side.links.statistics()[0].error is None, "the link is open")
    finally:
        os.close(near)
        os.close(far)


def test_a_log_that_fails_and_a_handler_that_raises_do_not_end_the_link() -> None:
    def fail(packet: Packet) -> None:
        raise RuntimeError("unforeseen")

    with Side("udpin:127.0.0.1:0", on_packet=fail) as server:
        server.log_fails = True
        with Side(f"udpout:127.0.0.1:{server.links.port(0)}") as client:
            packets = send_until_received(client, server, 2)
            assert {p.number for p in packets} == {None}
            statistics = server.links.statistics()[0]
            assert statistics.packets_unlogged >= 2
            assert statistics.failures >= 1


# --- bytes to packets


def sound_packets(count: int, *, version_1: bool = False) -> list[bytes]:
    packer = mavlink.MAVLink(None, srcSystem=1, srcComponent=1)
    return [
        pack(mavlink.MAVLink_attitude_message(i + 1, 0.1, 0.2, 0.3, 0.4, 0.5, 0.6), packer, version_1=version_1)
        for i in range(count)
    ]


@given(st.lists(st.integers(1, 40), min_size=1, max_size=40), st.booleans())
def test_a_stream_cut_anywhere_gives_the_same_sound_packets(cuts: list[int], version_1: bool) -> None:
    wanted = sound_packets(8, version_1=version_1)
    data, framer, got = b"".join(wanted), Framer(), []
    for cut in cuts:
        got += [framed.raw for framed in framer.feed(data[:cut])]
        data = data[cut:]
    got += [framed.raw for framed in framer.feed(data)]
    assert got == wanted
    assert framer.bad == 0


@given(st.lists(st.binary(max_size=30), min_size=4, max_size=4))
def test_garbage_between_datagrams_packets_costs_no_sound_packet_that_stands_alone(noise: list[bytes]) -> None:
    framer = Framer()
    for raw, garbage in zip(sound_packets(4), noise, strict=True):
        list(framer.datagram(garbage))
        assert [framed.raw for framed in framer.datagram(raw)] == [raw]


@given(st.integers(0, 39), st.integers(1, 255))
def test_one_changed_byte_never_gives_a_different_known_message(place: int, change: int) -> None:
    raw = bytearray(sound_packets(1)[0])
    raw[place % len(raw)] ^= change
    for framed in Framer().datagram(bytes(raw)):
        assert isinstance(framed.message, mavlink.MAVLink_unknown)


def test_a_stream_finds_its_way_after_garbage_and_counts_it() -> None:
    first, second, third = sound_packets(3)
    framer = Framer()
    got = [f.raw for f in framer.feed(first + b"\xfe\x05garbage" + second + third + bytes(300))]
    assert got == [first, second, third]
    assert framer.bad >= 1


def test_the_parser_refuses_bytes_that_are_no_packet() -> None:
    decode = PacketParser()
    assert decode(b"") is None
    assert decode(sound_packets(1)[0][:-1]) is None
    message = decode(sound_packets(1)[0])
    assert message is not None
    assert message.get_type() == "ATTITUDE"
