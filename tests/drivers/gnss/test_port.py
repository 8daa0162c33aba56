"""A receiver behind a pseudo terminal: what is logged of it, and what is said when it goes."""

from __future__ import annotations

import contextlib
import os
import pty
import tty
from collections.abc import Iterator

import pytest
from hypothesis import given
from hypothesis import strategies as st

from dappled.clock import RecordedClock, SystemClock
from dappled.drivers.gnss import recorded
from dappled.drivers.gnss.port import GnssPort, address
from dappled.drivers.gnss.ubx import Edge
from dappled.drivers.mavlink import LinkError, MavlinkMessage, mavlink, pack
from dappled.errors import DappledError
from dappled.findings import text, told
from tests.drivers.gnss.test_ubx import GPS_MS, NEW_FALLING, SATURDAY_S, VALID, WEEK, mark, message
from tests.needs import without
from tests.waiting import eventually

MARK = message((0x0D, 0x03), mark(NEW_FALLING | VALID | 0x08, rising=(0, 0, 0), falling=(WEEK, GPS_MS, 500_000)))
RAW = message((0x02, 0x15), bytes(range(256)) * 4)


class Book:
    """Packs what is noted, as the telemetry log has it. `full`: the disk is."""

    def __init__(self) -> None:
        self.packets: list[bytes] = []
        self.marks: list[MavlinkMessage] = []
        self.full = False
        self._packer = mavlink.MAVLink(None, srcSystem=1, srcComponent=recorded.COMPONENT)

    def note(self, message: MavlinkMessage) -> None:
        if self.full:
            raise DappledError("cannot log telemetry: the disk is full; free some space")
        self.packets.append(pack(message, self._packer, version_1=False))
        if message.get_type() == "CAMERA_TRIGGER":
            self.marks.append(message)

    def bytes(self) -> bytes:
        return b"".join(recorded.stream(list(self.packets)))


@pytest.fixture
def terminal() -> Iterator[tuple[int, str]]:
    """(the receiver's end, the device)."""
    try:
        near, far = pty.openpty()
    except OSError as error:
        without(f"there are no pseudo terminals here ({error}): mount devpts at /dev/pts")
    tty.setraw(far)  # what comes before the port is open is not changed either
    yield near, os.ttyname(far)
    for descriptor in (near, far):
        with contextlib.suppress(OSError):  # a test closed it
            os.close(descriptor)


def said(port: GnssPort) -> str:
    return "" if (found := port.problem()) is None else str(text(found))


def reading(device: str, book: Book, edge: Edge = "falling") -> GnssPort:
    port = GnssPort(address(f"{device},115200"), edge, book, SystemClock())
    port.start()
    return port


def test_every_byte_is_logged_and_each_mark(terminal: tuple[int, str]) -> None:
    near, device = terminal
    book = Book()
    port = reading(device, book)
    sent = b"$GNGGA,101503*00\r\n" + RAW + MARK + RAW[:77]
    for at in range(0, len(sent), 100):
        os.write(near, sent[at : at + 100])
    eventually(lambda: book.bytes() == sent, "every byte")
    assert port.problem() is None
    (found,) = book.marks
    assert (found.time_usec, found.seq) == (SATURDAY_S * 10**6 + 500, 7)
    port.stop()
    assert port.dead_threads() == []


@pytest.mark.parametrize(
    ("early", "known", "off_weeks", "said"),
    [
        (1024, True, 0, None),
        (2048, True, 0, None),
        (1024, False, 1024, "which 1024 weeks later would be 2026-11-21 10:15"),
        (2048, False, 2048, "which 2048 weeks later would be 2026-11-21 10:15"),
        (-1100, True, None, "its date is 2047-12-21 10:15, which can't be true"),
    ],
)
def test_a_date_that_rolled_over_is_mended_by_this_machine_s_clock_or_told(
    terminal: tuple[int, str], early: int, known: bool, off_weeks: int | None, said: str | None
) -> None:
    near, device = terminal
    book = Book()
    clock = RecordedClock(SATURDAY_S * 10**9 if known else 3600 * 10**9, 0)
    port = GnssPort(address(device), "falling", book, clock)
    port.start()
    at = (WEEK - early, GPS_MS, 500_000)
    os.write(near, message((0x0D, 0x03), mark(NEW_FALLING | VALID | 0x08, rising=(0, 0, 0), falling=at)))
    eventually(lambda: book.packets, "the mark's bytes")
    port.stop()
    if said is None:
        assert port.problem() is None
    else:
        problem = port.problem()
        assert problem is not None
        assert said in str(told(problem))
    offs_us = [SATURDAY_S * 10**6 + 500 - found.time_usec for found in book.marks]
    week_us = 7 * 86400 * 10**6
    assert [round(off_us / week_us) for off_us in offs_us] == ([] if off_weeks is None else [off_weeks])
    assert off_weeks != 0 or offs_us == [0]


def test_the_other_edge_s_marks_are_left_alone(terminal: tuple[int, str]) -> None:
    near, device = terminal
    book = Book()
    port = reading(device, book, "rising")
    os.write(near, MARK)
    eventually(lambda: book.bytes() == MARK, "every byte")
    port.stop()
    assert book.marks == []


def test_a_device_that_is_not_there_is_told_and_waited_for(terminal: tuple[int, str], tmp_path: object) -> None:
    near, device = terminal
    link = f"{tmp_path}/receiver"
    book = Book()
    port = reading(link, book)
    eventually(lambda: "there is no such device" in said(port), "the problem")
    os.symlink(device, link)
    eventually(lambda: port.problem() is None, "the device")
    os.write(near, MARK)
    eventually(lambda: book.bytes() == MARK, "every byte")
    port.stop()


def test_a_full_disk_is_told_and_what_comes_later_is_logged(terminal: tuple[int, str]) -> None:
    near, device = terminal
    book = Book()
    book.full = True
    port = reading(device, book)
    os.write(near, RAW)
    eventually(lambda: "the disk is full" in said(port), "the problem")
    book.full = False
    os.write(near, MARK)
    eventually(lambda: book.bytes().endswith(MARK), "what came later")
    eventually(lambda: port.problem() is None, "no problem")
    port.stop()


def test_a_receiver_that_goes_is_told(terminal: tuple[int, str]) -> None:
    near, device = terminal
    port = reading(device, Book())
    os.write(near, MARK)
    eventually(lambda: port.marks == 1, "a mark")
    os.close(near)
    eventually(lambda: port.problem() is not None, "the problem")
    port.stop()


@pytest.mark.parametrize(("text", "words"), [("COM3", "gnss.port"), ("/dev/ttyS0,1", "can't run at 1 baud")])
def test_a_port_that_can_not_be_is_refused(text: str, words: str) -> None:
    with pytest.raises(LinkError, match=words):
        address(text)


def test_a_file_that_is_no_device_is_told(tmp_path: object) -> None:
    path = f"{tmp_path}/file"
    with open(path, "wb"):
        pass
    port = reading(path, Book())
    eventually(lambda: "is not a serial device" in said(port), "the problem")
    port.stop()


@given(st.lists(st.binary(min_size=1, max_size=recorded.CHUNK), max_size=10))
def test_bytes_come_back_with_the_zeros_that_mavlink_cuts_off(pieces: list[bytes]) -> None:
    book = Book()
    for piece in pieces:
        book.note(recorded.bytes_message(piece))
    assert book.bytes() == b"".join(pieces)


def test_silence_is_told(terminal: tuple[int, str]) -> None:
    class Later(SystemClock):
        ahead_ns = 0

        def monotonic_ns(self) -> int:
            return super().monotonic_ns() + self.ahead_ns

    near, device = terminal
    clock = Later()
    port = GnssPort(address(device), "falling", Book(), clock)
    port.start()
    os.write(near, b"$GNGGA")
    eventually(lambda: port._heard_ns is not None, "some bytes")
    assert port.problem() is None
    clock.ahead_ns = 6 * 10**9
    assert "nothing was heard for 5 s" in said(port)
    os.write(near, b"$GNGGA")
    eventually(lambda: "no UBX message" in said(port), "NMEA alone is of no use")
    port.stop()
