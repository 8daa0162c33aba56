"""The responder and the 450D behind it, spoken to by a small initiator that shares no code with them."""

from __future__ import annotations

import contextlib
import socket
import struct
import threading
import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field

import pytest

from dappled.clock import SystemClock
from dappled.mocks.body.eos450d import Eos450d
from dappled.mocks.body.faults import BodyFaults
from dappled.mocks.body.ptpip import Responder

OK, GENERAL_ERROR, NOT_OPEN, NOT_SUPPORTED, BAD_HANDLE, BUSY = 0x2001, 0x2002, 0x2003, 0x2005, 0x2009, 0x2019
FULL = 0x200C
EVENT_ADDED, EVENT_TRANSFER, EVENT_STATUS = 0xC181, 0xC186, 0xC18B
DESTINATION = 0xD11C


@dataclass
class Bench:
    """A body whose exposures end when the test says so."""

    faults: BodyFaults
    eos: Eos450d
    responder: Responder
    exposed: threading.Event
    triggers: list[tuple[int, int]] = field(default_factory=list)


@pytest.fixture
def bench() -> Iterator[Bench]:
    exposed = threading.Event()
    triggers: list[tuple[int, int]] = []

    def expose(trigger_monotonic_ns: int, shot_number: int) -> tuple[bytes, str]:
        triggers.append((trigger_monotonic_ns, shot_number))
        assert exposed.wait(60)
        return f"picture {shot_number}".encode() * 10000, "dng"

    faults = BodyFaults(SystemClock())
    eos = Eos450d(expose, faults, SystemClock())
    responder = Responder(eos, faults)
    yield Bench(faults, eos, responder, exposed, triggers)
    exposed.set()
    responder.close()


class Initiator:
    def __init__(self, port: int) -> None:
        self.command = socket.create_connection(("127.0.0.1", port), timeout=60)
        self.command.sendall(struct.pack("<II", 30, 1) + bytes(16) + b"x\0\0\0" + struct.pack("<H", 1))
        self.kind, self.ack = self.packet(self.command)
        self.transaction = 0
        self.event: socket.socket | None = None
        if self.kind == 2:
            self.event = socket.create_connection(("127.0.0.1", port), timeout=60)
            self.event.sendall(struct.pack("<II", 12, 3) + self.ack[:4])
            assert self.packet(self.event) == (4, b"")

    def packet(self, link: socket.socket) -> tuple[int, bytes]:
        length, kind = struct.unpack("<II", self.exactly(link, 8))
        return kind, self.exactly(link, length - 8)

    @staticmethod
    def exactly(link: socket.socket, size: int) -> bytes:
        data = b""
        while len(data) < size:
            piece = link.recv(size - len(data))
            if not piece:
                raise ConnectionError(f"cut after {len(data)} of {size}")
            data += piece
        return data

    def ask(self, code: int, *parameters: int, data: bytes | None = None) -> tuple[int, tuple[int, ...], bytes]:
        self.transaction += 1
        count = len(parameters)
        head = struct.pack("<IIIHI", 18 + 4 * count, 6, 1, code, self.transaction)
        self.command.sendall(head + struct.pack(f"<{count}I", *parameters))
        if data is not None:
            self.command.sendall(struct.pack("<IIIQ", 20, 9, self.transaction, len(data)))
            self.command.sendall(struct.pack("<III", 12 + len(data), 12, self.transaction) + data)
        answer = b""
        while True:
            kind, payload = self.packet(self.command)
            if kind == 9:
                assert struct.unpack("<IQ", payload)[0] == self.transaction
            elif kind == 12:
                answer += payload[4:]
            else:
                assert kind == 7
                response, transaction = struct.unpack_from("<HI", payload)
                assert transaction == self.transaction
                return response, struct.unpack(f"<{(len(payload) - 6) // 4}I", payload[6:]), answer

    def events(self) -> list[tuple[int, bytes]]:
        _, _, data = self.ask(0x9116)
        records: list[tuple[int, bytes]] = []
        at = 0
        while True:
            size, kind = struct.unpack_from("<II", data, at)
            if kind == 0:
                assert at + size == len(data)
                return records
            records.append((kind, data[at + 8 : at + size]))
            at += size

    def until_event(self, wanted: Callable[[int, bytes], bool]) -> bytes:
        deadline = time.monotonic() + 60
        while time.monotonic() < deadline:
            for kind, payload in self.events():
                if wanted(kind, payload):
                    return payload
            time.sleep(0.005)
        pytest.fail("the event never came")

    def close(self) -> None:
        self.command.close()
        if self.event is not None:
            self.event.close()


@pytest.fixture
def initiator(bench: Bench) -> Iterator[Initiator]:
    made = Initiator(bench.responder.port)
    assert made.ask(0x1002, 1)[0] == OK
    yield made
    made.close()


def set_destination(initiator: Initiator, value: int) -> None:
    assert initiator.ask(0x9110, data=struct.pack("<III", 12, DESTINATION, value))[0] == OK


def test_device_info_names_a_450d_that_has_the_old_release_only(initiator: Initiator) -> None:
    _, _, info = initiator.ask(0x1001)
    assert struct.unpack_from("<HI", info) == (100, 0x0B)
    assert "Canon EOS 450D".encode("utf-16-le") in info
    count = struct.unpack_from("<I", info, 11)[0]
    operations = struct.unpack_from(f"<{count}H", info, 15)
    assert 0x910F in operations
    assert 0x9128 not in operations


def test_nothing_is_answered_before_a_session_is_open(bench: Bench) -> None:
    fresh = Initiator(bench.responder.port)
    assert fresh.ask(0x1004)[0] == NOT_OPEN
    assert fresh.ask(0x1001)[0] == OK
    fresh.close()


def test_an_unknown_operation_is_not_supported(initiator: Initiator) -> None:
    assert initiator.ask(0x9999)[0] == NOT_SUPPORTED


def test_a_second_initiator_is_turned_away(bench: Bench, initiator: Initiator) -> None:
    second = Initiator(bench.responder.port)
    assert (second.kind, second.ack) == (5, b"\2\0\0\0")
    second.close()
    assert initiator.ask(0x1004)[0] == OK


def test_a_capture_to_the_card_is_announced_sent_and_deleted(bench: Bench, initiator: Initiator) -> None:
    before_ns = time.monotonic_ns()
    assert initiator.ask(0x910F)[:2] == (OK, (0,))
    assert initiator.ask(0x910F)[0] == BUSY  # it works on the first
    bench.exposed.set()
    added = initiator.until_event(lambda kind, _: kind == EVENT_ADDED)
    (trigger,) = bench.triggers
    assert before_ns <= trigger[0] <= time.monotonic_ns()
    assert trigger[1] == 1
    handle = struct.unpack_from("<I", added)[0]
    picture = b"picture 1" * 10000
    assert struct.unpack_from("<I", added, 0x1C - 8)[0] == len(picture)
    assert initiator.ask(0x1009, handle) == (OK, (), picture)
    assert initiator.ask(0x101B, handle, 5, 7) == (OK, (7,), picture[5:12])
    assert initiator.ask(0x101B, handle, len(picture) - 3, 100) == (OK, (3,), picture[-3:])
    _, _, info = initiator.ask(0x1008, handle)
    assert "IMG_0001.DNG".encode("utf-16-le") in info
    assert initiator.ask(0x100B, handle)[0] == OK
    assert initiator.ask(0x1009, handle)[0] == BAD_HANDLE


def test_a_capture_to_memory_needs_room_on_the_computer(bench: Bench, initiator: Initiator) -> None:
    bench.exposed.set()
    set_destination(initiator, 4)
    assert initiator.ask(0x910F)[0] == FULL  # no room announced
    assert initiator.ask(0x911A, 0x0FFFFFFF, 0x1000, 1)[0] == OK
    assert initiator.ask(0x910F)[1] == (0,)
    transfer = initiator.until_event(lambda kind, _: kind == EVENT_TRANSFER)
    handle = struct.unpack_from("<I", transfer)[0]
    assert initiator.ask(0x101B, handle, 0, 1 << 20)[2] == b"picture 1" * 10000
    assert initiator.ask(0x9117, handle)[0] == OK
    assert initiator.ask(0x1009, handle)[0] == BAD_HANDLE
    assert bench.eos.names == []


def test_a_full_card_refuses_to_shoot_until_something_is_deleted(bench: Bench) -> None:
    bench.exposed.set()
    eos = Eos450d(lambda _ns, number: (bytes(1000), "cr2"), bench.faults, SystemClock(), card_bytes=2500)
    responder = Responder(eos, bench.faults)
    initiator = Initiator(responder.port)
    assert initiator.ask(0x1002, 1)[0] == OK
    handles: list[int] = []

    def added(kind: int, payload: bytes) -> bool:
        if kind == EVENT_ADDED:
            handles.append(struct.unpack_from("<I", payload)[0])
        return kind == EVENT_STATUS and payload == b"\0\0\0\0"

    for _ in range(2):
        assert initiator.ask(0x910F)[0] == OK
        initiator.until_event(added)
    assert initiator.ask(0x910F)[0] == FULL
    assert initiator.ask(0x100B, handles[0])[0] == OK
    assert initiator.ask(0x910F)[0] == OK
    initiator.close()
    responder.close()


def test_a_wrong_property_value_is_refused(initiator: Initiator) -> None:
    assert initiator.ask(0x9110, data=struct.pack("<III", 12, DESTINATION, 77))[0] == GENERAL_ERROR
    assert initiator.ask(0x9110, data=b"short")[0] == GENERAL_ERROR


def test_the_card_outlives_the_link(bench: Bench, initiator: Initiator) -> None:
    initiator.ask(0x910F)
    bench.faults.command("drop")
    with pytest.raises(ConnectionError):
        initiator.ask(0x1004)
    bench.exposed.set()
    deadline = time.monotonic() + 60
    while (again := Initiator(bench.responder.port)).kind != 2:
        again.close()
        assert time.monotonic() < deadline
    assert again.ask(0x1002, 1)[0] == OK
    while bench.eos.names != ["IMG_0001.DNG"]:
        assert time.monotonic() < deadline
        time.sleep(0.005)
    again.close()


@pytest.mark.parametrize(("fault", "code"), [("busy", BUSY), ("error", GENERAL_ERROR)])
def test_a_release_can_fail(bench: Bench, initiator: Initiator, fault: str, code: int) -> None:
    bench.faults.command(fault)
    assert initiator.ask(0x910F)[0] == code
    bench.faults.command("clear")
    assert initiator.ask(0x910F)[0] == OK
    assert bench.eos.releases == 1


def test_no_event_keeps_quiet_about_one_object(bench: Bench, initiator: Initiator) -> None:
    bench.exposed.set()
    bench.faults.command("no-event")
    initiator.ask(0x910F)
    seen: list[int] = []

    def done(kind: int, payload: bytes) -> bool:
        seen.append(kind)
        return kind == EVENT_STATUS and payload == b"\0\0\0\0"

    initiator.until_event(done)
    assert EVENT_ADDED not in seen
    assert bench.eos.names == ["IMG_0001.DNG"]


def test_short_and_drop_transfer_spoil_the_data(bench: Bench, initiator: Initiator) -> None:
    bench.exposed.set()
    initiator.ask(0x910F)
    handle = struct.unpack_from("<I", initiator.until_event(lambda kind, _: kind == EVENT_ADDED))[0]
    bench.faults.command("short")
    assert len(initiator.ask(0x1009, handle)[2]) == 90000 - 1024
    assert len(initiator.ask(0x1009, handle)[2]) == 90000
    bench.faults.command("drop-transfer")
    with pytest.raises(ConnectionError, match="cut after 450"):
        initiator.ask(0x1009, handle)


def test_silence_is_silence_until_it_ends(bench: Bench, initiator: Initiator) -> None:
    bench.faults.command("silence")
    initiator.command.settimeout(0.2)
    with pytest.raises(TimeoutError):
        initiator.ask(0x1004)
    bench.faults.command("clear")
    initiator.command.settimeout(60)
    assert initiator.packet(initiator.command)[0] == 9  # the late answer: one transaction behind, as with a real body


def test_garbage_ends_the_link_and_not_the_responder(bench: Bench) -> None:
    for raw in (b"GET / HTTP/1.0\r\n\r\n", struct.pack("<II", 3, 6), struct.pack("<II", 0xFFFFFFFF, 1)):
        with socket.create_connection(("127.0.0.1", bench.responder.port), timeout=60) as link:
            link.sendall(raw)
            with contextlib.suppress(OSError):  # it may have been cut before all was sent
                link.shutdown(socket.SHUT_WR)
                assert link.recv(1) == b""
    fine = Initiator(bench.responder.port)
    assert fine.kind == 2
    fine.close()
