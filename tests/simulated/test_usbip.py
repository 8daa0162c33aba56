"""The USB/IP server, spoken to by a client that plays the part of a kernel, and shares no code with it."""

from __future__ import annotations

import contextlib
import errno
import itertools
import socket
import struct
from collections.abc import Iterator

import pytest

from dappled.clock import SystemClock
from dappled.mocks.body.body import pattern
from dappled.mocks.body.eos450d import Eos450d
from dappled.mocks.body.faults import BodyFaults
from tests.simulated.usbip import UsbIpResponder

OK = 0x2001
SIZE = 300_000
BULK_IN, BULK_OUT, INTERRUPT = 1, 2, 3
ADDED, STATUS = 0xC181, 0xC18B


class Bus:
    """A host that has imported the body."""

    def __init__(self, port: int, bus_id: bytes = b"1-1") -> None:
        self.link = socket.create_connection(("127.0.0.1", port), timeout=60)
        self.link.sendall(struct.pack(">HHI", 0x0111, 0x8003, 0) + bus_id.ljust(32, b"\0"))
        _version, code, self.status = struct.unpack(">HHI", self.exactly(8))
        assert code == 3
        if self.status:
            self.link.close()
        else:
            self.exactly(312)
        self.numbers = itertools.count(1)
        self.transactions = itertools.count(1)
        self.rest = b""

    def exactly(self, size: int) -> bytes:
        data = b""
        while len(data) < size:
            piece = self.link.recv(size - len(data))
            if not piece:
                raise ConnectionError("the body left the bus")
            data += piece
        return data

    def submit(self, endpoint: int, *, room: int = 0, data: bytes = b"", setup: bytes = bytes(8)) -> int:
        number = next(self.numbers)
        inward = int(bool(room))
        head = struct.pack(">5I", 1, number, 0x10002, inward, endpoint)
        self.link.sendall(head + struct.pack(">Iiiii", 0, room or len(data), 0, 0, 0) + setup + data)
        return number

    def unlink(self, number: int) -> None:
        self.link.sendall(struct.pack(">5II24x", 2, next(self.numbers), 0x10002, 0, 0, number))

    def reply(self, *, inward: bool = False) -> tuple[int, int, int, bytes]:
        """Command, number, status and data of the next answer."""
        command, number, _, _, _, status, length = struct.unpack(">5Iii", self.exactly(28))
        self.exactly(20)
        return command, number, status, self.exactly(length) if command == 3 and inward else b""

    def control(self, kind: int, request: int, value: int = 0, index: int = 0, room: int = 0) -> tuple[int, bytes]:
        self.submit(0, room=room, setup=struct.pack("<BBHHH", kind, request, value, index, room))
        _, _, status, data = self.reply(inward=bool(room))
        return status, data

    def read(self, room: int = 512) -> bytes:
        self.submit(BULK_IN, room=room)
        _, _, status, data = self.reply(inward=True)
        if status:
            raise OSError(-status, "transfer")
        return data

    def send(self, kind: int, code: int, transaction: int, payload: bytes) -> None:
        whole = struct.pack("<IHHI", 12 + len(payload), kind, code, transaction) + payload
        self.submit(BULK_OUT, data=whole)
        assert self.reply()[2] == 0

    def ask(self, code: int, *parameters: int, data: bytes | None = None, room: int = 4096) -> tuple[int, bytes]:
        """One transaction: response code, and the data that came; read as libgphoto2 does, a packet first."""
        transaction = next(self.transactions)
        self.send(1, code, transaction, struct.pack(f"<{len(parameters)}I", *parameters))
        if data is not None:
            self.send(2, code, transaction, data)
        got = b""
        while True:
            first = self.read()
            length, kind, answered, of = struct.unpack_from("<IHHI", first)
            assert of == transaction
            if kind == 3:
                return answered, got
            assert (kind, answered) == (2, code)
            got = first[12:]
            short = len(first) < 512
            while not short:
                piece = self.read(room)
                got += piece
                short = len(piece) < room
            assert len(got) == length - 12

    def picture(self) -> int:
        """Take one; returns its handle once the body is done."""
        assert self.ask(0x910F)[0] == OK
        handle: int | None = None
        while True:
            _, records = self.ask(0x9116)
            at = 0
            while at < len(records):
                size, kind = struct.unpack_from("<II", records, at)
                if kind == ADDED:
                    (handle,) = struct.unpack_from("<I", records, at + 8)
                if kind == STATUS and records[at + 8 : at + 12] == bytes(4) and handle is not None:
                    return handle
                at += size


@pytest.fixture
def faults() -> BodyFaults:
    return BodyFaults(SystemClock())


@pytest.fixture
def responder(faults: BodyFaults) -> Iterator[UsbIpResponder]:
    eos = Eos450d(lambda _ns, number: (pattern(number, SIZE), "cr2"), faults, SystemClock())
    made = UsbIpResponder(eos, faults)
    yield made
    made.close()


def imported(responder: UsbIpResponder) -> Bus:
    while (bus := Bus(responder.ports[0])).status:
        pass  # the last link is being ended
    return bus


@pytest.fixture
def bus(responder: UsbIpResponder) -> Iterator[Bus]:
    made = imported(responder)
    assert made.control(0x00, 9, 1) == (0, b"")
    assert made.ask(0x1002, 1)[0] == OK
    yield made
    made.link.close()


def test_the_list_and_the_descriptors_are_those_of_a_450d(responder: UsbIpResponder) -> None:
    with socket.create_connection(("127.0.0.1", responder.ports[0]), timeout=60) as link:
        link.sendall(struct.pack(">HHI", 0x0111, 0x8005, 0))
        listed = link.makefile("rb").read(12 + 312 + 4)
    assert struct.unpack_from(">HHII", listed) == (0x0111, 5, 0, 1)
    assert listed[12 + 256 :].startswith(b"1-1\0")
    assert struct.unpack_from(">IIIHH", listed, 12 + 288)[2:] == (3, 0x04A9, 0x3145)
    assert listed[-4:-1] == bytes((6, 1, 1))
    host = Bus(responder.ports[0])
    status, device = host.control(0x80, 6, 0x0100, room=18)
    assert (status, struct.unpack_from("<HH", device, 8), device[16]) == (0, (0x04A9, 0x3145), 0)  # no serial number
    _, configuration = host.control(0x80, 6, 0x0200, room=255)
    assert len(configuration) == struct.unpack_from("<H", configuration, 2)[0]
    assert [configuration[at + 2] for at in (18, 25, 32)] == [0x81, 0x02, 0x83]
    assert host.control(0x80, 6, 0x0302, room=255)[1][2:].decode("utf-16-le") == "Canon Digital Camera"
    assert host.control(0x80, 6, 0x0F00, room=64)[0] == -errno.EPIPE
    host.link.close()


def test_a_body_in_the_mode_of_mass_storage_says_so(responder: UsbIpResponder, faults: BodyFaults) -> None:
    faults.command("storage")
    host = Bus(responder.ports[0])
    assert host.control(0x80, 6, 0x0200, room=255)[1][14:17] == bytes((8, 6, 0x50))
    host.link.close()


@pytest.mark.parametrize("bus_id", [b"1-2", b"1-1"])
def test_one_host_has_the_body_and_no_other(responder: UsbIpResponder, bus: Bus, bus_id: bytes) -> None:
    assert Bus(responder.ports[0], bus_id).status == 1
    assert bus.ask(0x1004)[0] == OK


@pytest.mark.parametrize("room", [512, 4096, 1 << 20])
def test_a_picture_comes_byte_for_byte_however_it_is_read(bus: Bus, room: int) -> None:
    handle = bus.picture()
    assert bus.ask(0x1009, handle, room=room) == (OK, pattern(1, SIZE))
    for size in (499, 500, 501, 1012):  # with the head of 12 bytes: one short of a packet, a packet, one more, two
        assert bus.ask(0x101B, handle, 7, size, room=room) == (OK, pattern(1, SIZE)[7 : 7 + size])
    assert bus.ask(0x9110, data=struct.pack("<III", 12, 0xD11C, 4))[0] == OK


def test_a_read_that_is_taken_back_is_answered_and_the_next_one_has_the_data(bus: Bus) -> None:
    number = bus.submit(BULK_IN, room=512)
    bus.unlink(number)
    assert bus.reply()[::2] == (4, -errno.ECONNRESET)
    bus.submit(INTERRUPT, room=8)  # stays with the body: it has no events to tell there
    assert bus.ask(0x1004)[0] == OK
    done = bus.submit(0, room=1, setup=struct.pack("<BBHHH", 0x80, 8, 0, 0, 1))
    bus.unlink(done)
    assert bus.reply(inward=True)[1] == done
    assert bus.reply()[::2] == (4, 0)  # it was done before


@pytest.mark.parametrize(("fault", "error"), [("stall", errno.EPIPE), ("babble", errno.EOVERFLOW)])
def test_a_transfer_breaks_off_and_the_next_one_is_whole(bus: Bus, faults: BodyFaults, fault: str, error: int) -> None:
    handle = bus.picture()
    faults.command(fault)
    with pytest.raises(OSError, match="transfer") as broken:
        bus.ask(0x1009, handle)
    assert broken.value.errno == error
    if fault == "stall":
        with pytest.raises(OSError, match="transfer"):
            bus.read()
        assert bus.control(0x82, 0, 0, 0x81, room=2) == (0, b"\1\0")
        assert bus.control(0x02, 1, 0, 0x81) == (0, b"")
    assert bus.control(0xA1, 0x67, room=4) == (0, struct.pack("<HH", 4, OK))
    assert bus.ask(0x1009, handle) == (OK, pattern(1, SIZE))


def test_a_body_that_leaves_in_a_download_comes_back_with_its_card(
    responder: UsbIpResponder, bus: Bus, faults: BodyFaults
) -> None:
    handle = bus.picture()
    faults.command("unplug-transfer")
    with pytest.raises(ConnectionError):
        bus.ask(0x1009, handle)
    assert Bus(responder.ports[0]).status == 1
    faults.command("clear")
    again = imported(responder)
    assert again.ask(0x1004)[0] == 0x2003  # the session went with the link
    assert again.ask(0x1002, 1)[0] == OK
    assert again.ask(0x1009, handle) == (OK, pattern(1, SIZE))
    again.link.close()


def test_a_reset_of_the_port_ends_the_session_and_what_was_under_way(bus: Bus) -> None:
    handle = bus.picture()
    bus.send(1, 0x1009, 90, struct.pack("<I", handle))
    assert len(bus.read()) == 512
    assert bus.control(0x00, 9, 1) == (0, b"")
    assert bus.ask(0x1002, 1)[0] == OK
    assert bus.ask(0x1009, handle) == (OK, pattern(1, SIZE))


def test_a_slow_body_sends_all_of_it(bus: Bus, faults: BodyFaults) -> None:
    handle = bus.picture()
    faults.command("crawl 0.1")
    assert bus.ask(0x1009, handle) == (OK, pattern(1, SIZE))


def test_garbage_ends_the_link_and_not_the_server(responder: UsbIpResponder) -> None:
    for raw in (
        b"GET / HTTP/1.0\r\n\r\n",
        struct.pack(">HHI", 0x0111, 0x8003, 0) + b"1-1".ljust(32, b"\0") + b"x" * 48,
    ):
        with (
            socket.create_connection(("127.0.0.1", responder.ports[0]), timeout=60) as link,
            contextlib.suppress(OSError),
        ):
            link.sendall(raw)
            link.shutdown(socket.SHUT_WR)
            while link.recv(4096):
                pass
    imported(responder).link.close()
