"""MAVLink FTP: files are read whole, whatever a client repeats or invents; nothing is ever written."""

from __future__ import annotations

import struct
import time
from collections import deque
from pathlib import Path

import pytest
from hypothesis import given
from hypothesis import strategies as st
from pymavlink import mavftp

from dappled.daemon.camera_protocol.ftp_server import FtpServer
from dappled.drivers.mavlink import MavlinkMessage, mavlink

DATA = bytes(range(256)) * 40
NONE, TERMINATE, RESET, LIST, OPEN, READ, CREATE, CRC32, BURST = 0, 1, 2, 3, 4, 5, 6, 14, 15
ACK, NAK = 128, 129


def files() -> dict[str, bytes]:
    """One file."""
    return {"camera.xml": DATA}


class Client:
    """Speaks the protocol by hand: what it sends and hears are bytes."""

    def __init__(self, server: FtpServer | None = None, component: int = 190) -> None:
        self.server = server or FtpServer(files)
        self.packer = mavlink.MAVLink(None, srcSystem=255, srcComponent=component)
        self.sequence = 0
        self.now_ns = 0

    def send(self, payload: bytes) -> list[bytes]:
        message = mavlink.MAVLink_file_transfer_protocol_message(0, 1, 100, list(payload.ljust(251, b"\0")))
        heard: MavlinkMessage = mavlink.MAVLink(None).decode(bytearray(message.pack(self.packer)))
        replies = self.server.answer(heard, self.now_ns)
        for reply in replies:
            assert (reply.target_system, reply.target_component) == (255, self.packer.srcComponent)
            reply.pack(mavlink.MAVLink(None))
        return [bytes(reply.payload) for reply in replies]

    def ask(
        self, opcode: int, data: bytes = b"", *, session: int = 0, offset: int = 0, size: int | None = None
    ) -> bytes:
        """The data of the only answer; an AssertionError says why it was refused."""
        (reply,) = self.asked(opcode, data, session=session, offset=offset, size=size)
        return reply

    def asked(
        self, opcode: int, data: bytes = b"", *, session: int = 0, offset: int = 0, size: int | None = None
    ) -> list[bytes]:
        self.sequence += 1
        size = len(data) if size is None else size
        header = struct.pack("<HBBBBBxI", self.sequence, session, opcode, size, 0, 0, offset)
        replies = self.send(header + data)
        found = []
        for at, raw in enumerate(replies):
            sequence, _, answer, length, to, _, _ = struct.unpack_from("<HBBBBBxI", raw)
            assert (sequence, to) == (self.sequence + 1 + at, opcode)
            assert answer == ACK, f"refused: {raw[12]}"
            found.append(raw[12 : 12 + length])
        return found


def test_a_file_is_read_whole_by_parts_and_by_bursts() -> None:
    client = Client()
    assert client.ask(OPEN, b"/camera.xml") == struct.pack("<I", len(DATA))
    parts = [client.ask(READ, offset=start, size=100) for start in range(0, len(DATA), 100)]
    assert b"".join(parts) == DATA
    got = b""
    while len(got) < len(DATA):
        got += b"".join(client.asked(BURST, offset=len(got), size=239))
    assert got == DATA
    with pytest.raises(AssertionError, match="refused: 6"):
        client.ask(READ, offset=len(DATA), size=239)
    client.ask(TERMINATE)
    with pytest.raises(AssertionError, match="refused: 4"):
        client.ask(READ)


def test_a_burst_says_where_it_ends() -> None:
    client = Client()
    client.ask(OPEN, b"camera.xml")
    raws = client.send(struct.pack("<HBBBBBxI", 9, 0, BURST, 239, 0, 0, 0))
    assert [raw[6] for raw in raws] == [0] * (len(raws) - 1) + [1]


def test_a_retry_gets_the_same_answer_and_opens_nothing_twice() -> None:
    client = Client()
    request = struct.pack("<HBBBBBxI", 1, 0, OPEN, 10, 0, 0, 0) + b"camera.xml"
    assert client.send(request) == client.send(request)
    assert len(client.server._sessions) == 1


@pytest.mark.parametrize("end", ["terminate", "idle"])
def test_the_same_open_after_its_session_ended_opens_another_one(end: str) -> None:
    client = Client()
    client.ask(OPEN, b"camera.xml", session=5)
    request = struct.pack("<HBBBBBxI", 2, 5, OPEN, 10, 0, 0, 0) + b"camera.xml"  # a client may number from 1 again
    session = client.send(request)[0][2]
    client.sequence = 50
    if end == "terminate":
        client.ask(TERMINATE, session=session)
    else:
        client.now_ns = 61 * 10**9
    again = client.send(request)[0][2]
    assert client.ask(READ, session=again, size=10) == DATA[:10]


def test_listing_and_checksum() -> None:
    client = Client()
    assert client.ask(LIST, b"/") == b"Fcamera.xml\t%d\0" % len(DATA)
    with pytest.raises(AssertionError, match="refused: 6"):
        client.ask(LIST, b"/", offset=1)
    expected = 0
    for byte in DATA:
        expected ^= byte
        for _ in range(8):
            expected = expected >> 1 ^ (0xEDB88320 if expected & 1 else 0)
    assert client.ask(CRC32, b"camera.xml") == struct.pack("<I", expected)


@pytest.mark.parametrize(("opcode", "reason"), [(CREATE, 9), (7, 9), (8, 9), (13, 9), (99, 7)])
def test_nothing_can_be_written(opcode: int, reason: int) -> None:
    with pytest.raises(AssertionError, match=f"refused: {reason}"):
        Client().ask(opcode, b"camera.xml")


def test_sessions_are_few_end_by_themselves_and_belong_to_their_client() -> None:
    client = Client()
    for _ in range(8):
        client.ask(OPEN, b"camera.xml")
    with pytest.raises(AssertionError, match="refused: 5"):
        client.ask(OPEN, b"camera.xml")
    other = Client(client.server, component=191)
    with pytest.raises(AssertionError, match="refused: 4"):
        other.ask(READ, size=10)
    client.now_ns = 61 * 10**9
    client.ask(OPEN, b"camera.xml")
    client.ask(RESET)
    with pytest.raises(AssertionError, match="refused: 10"):
        client.ask(OPEN, b"../../etc/passwd")
    assert client.ask(NONE) == b""


@given(st.lists(st.binary(max_size=251), max_size=8))
def test_no_bytes_crash_it_or_make_it_hold_more(payloads: list[bytes]) -> None:
    client = Client()
    for payload in payloads:
        assert len(client.send(payload)) <= 32
    assert len(client.server._sessions) <= 8


class Link:
    """What pymavlink's client takes for a connection: packets go to a server and its answers come back. Answers whose
    number is in `lost` do not arrive."""

    source_system, source_component = 255, 190

    def __init__(self, server: FtpServer, lost: set[int]) -> None:
        self.server, self.lost, self.number = server, lost, 0
        self.waiting: deque[MavlinkMessage] = deque()
        self.packer = mavlink.MAVLink(None, srcSystem=self.source_system, srcComponent=self.source_component)
        self.mav = self

    def file_transfer_protocol_send(self, network: int, system: int, component: int, payload: bytearray) -> None:
        message = mavlink.MAVLink_file_transfer_protocol_message(network, system, component, list(payload))
        heard: MavlinkMessage = mavlink.MAVLink(None).decode(bytearray(message.pack(self.packer)))
        for reply in self.server.answer(heard, time.monotonic_ns()):
            self.number += 1
            if self.number not in self.lost:
                back = reply.pack(mavlink.MAVLink(None, srcSystem=system, srcComponent=component))
                self.waiting.append(mavlink.MAVLink(None).decode(bytearray(back)))

    def recv_match(self, **_: object) -> MavlinkMessage | None:
        if self.waiting:
            return self.waiting.popleft()
        time.sleep(0.002)  # as a connection waits for packets
        return None


@pytest.mark.parametrize("lost", [set(), {2, 9, 10, 30}])
def test_pymavlink_s_client_reads_a_file(tmp_path: Path, lost: set[int]) -> None:
    """Listing, checksum, and the whole file in bursts, also where answers are lost."""
    link = Link(FtpServer(files), set())
    client = mavftp.MAVFTP(link, 1, 100)
    client.ftp_settings.retry_time = client.ftp_settings.read_retry_time = 0.2
    client.ftp_settings.idle_detection_time = 1.0
    assert client.cmd_list(["/"]).error_code == 0
    assert [(one.name, one.size_b) for one in client.list_result] == [("camera.xml", len(DATA))]
    assert client.cmd_crc(["camera.xml"]).error_code == 0
    link.lost = {link.number + one for one in lost}
    assert client.cmd_get(["camera.xml", str(tmp_path / "got.xml")]).error_code == 0
    assert client.process_ftp_reply("OpenFileRO", timeout=20).error_code == 0
    assert (tmp_path / "got.xml").read_bytes() == DATA
    assert link.number > len(DATA) / 239
