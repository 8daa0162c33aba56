"""UBX messages out of a receiver's bytes, and time marks, against bytes worked out by hand from the interface
description."""

from __future__ import annotations

from datetime import UTC, datetime

import pytest
from hypothesis import given
from hypothesis import strategies as st

from dappled.drivers.gnss.ubx import Edge, TimeMark, UbxMessage, UbxStream, checksum, time_mark

# CFG-MSG that switches TIM-TM2 on, as u-center prints it, with its checksum.
KNOWN = bytes.fromhex("b562060103000d03011b6d")


def message(kind: tuple[int, int], payload: bytes) -> bytes:
    body = bytes(kind) + len(payload).to_bytes(2, "little") + payload
    return b"\xb5\x62" + body + checksum(body)


def mark(flags: int, *, count: int = 7, rising: tuple[int, int, int], falling: tuple[int, int, int]) -> bytes:
    """The payload of a TIM-TM2, field by field; edges are (week, ms of week, ns)."""
    fields = [(0, 1), (flags, 1), (count, 2), (rising[0], 2), (falling[0], 2)]
    fields += [(rising[1], 4), (rising[2], 4), (falling[1], 4), (falling[2], 4), (30, 4)]
    return b"".join(value.to_bytes(size, "little") for value, size in fields)


def test_a_checksum_is_the_one_of_a_known_message() -> None:
    """06 01 03 00 0d 03 01: sums by hand 06 07 0a 0a 17 1a 1b; 06 0d 17 21 38 52 6d."""
    assert checksum(KNOWN[2:-2]).hex() == "1b6d"


@given(
    st.lists(st.tuples(st.binary(min_size=2, max_size=2), st.binary(max_size=40)), max_size=6),
    st.lists(st.binary(max_size=20), min_size=7, max_size=7),
    st.integers(1, 50),
)
def test_messages_come_out_whole_whatever_lies_between_and_however_they_are_cut(
    told: list[tuple[bytes, bytes]], between: list[bytes], piece: int
) -> None:
    between = [noise.replace(b"\xb5", b"$") for noise in between]
    wanted = [UbxMessage((kind[0], kind[1]), payload) for kind, payload in told]
    data = between[-1]
    for one, noise in zip(wanted, between, strict=False):
        data += noise + message(one.kind, one.payload)
    stream = UbxStream()
    found = [one for at in range(0, len(data), piece) for one in stream.feed(data[at : at + piece])]
    assert found == wanted
    assert stream.bad == 0


def test_a_damaged_message_is_counted_and_the_next_one_comes() -> None:
    whole = message((0x0D, 0x03), bytes(28))
    damaged = whole[:20] + b"\xff" + whole[21:]
    stream = UbxStream()
    assert len(list(stream.feed(damaged + whole))) == 1
    assert stream.bad == 1


def test_a_length_that_no_receiver_sends_holds_nothing_up() -> None:
    stream = UbxStream()
    found = list(stream.feed(b"\xb5\x62\x02\x15\xff\xff" + bytes(20) + message((1, 7), b"abc")))
    assert found == [UbxMessage((1, 7), b"abc")]


@given(st.lists(st.binary(max_size=300), max_size=20))
def test_any_bytes_are_survived(pieces: list[bytes]) -> None:
    stream = UbxStream()
    for piece in pieces:
        list(stream.feed(piece))
    assert len(stream._left) <= 8192 + 8 + 300


SATURDAY_S = int(datetime(2026, 11, 21, 10, 15, 3, tzinfo=UTC).timestamp())
# 2026-11-21 is a Saturday, 2445 weeks and 6 days after 1980-01-06; GPS time is 18 s ahead of UTC since 2017.
WEEK, GPS_MS = 2445, (6 * 86400 + 10 * 3600 + 15 * 60 + 3 + 18) * 1000
UTC_MS = GPS_MS - 18_000
NEW_FALLING, NEW_RISING, VALID, GNSS_BASE, UTC_BASE = 0x04, 0x80, 0x40, 0x08, 0x10


@pytest.mark.parametrize(
    ("edge", "flags", "ms"),
    [
        ("falling", NEW_FALLING | VALID | GNSS_BASE, GPS_MS),
        ("rising", NEW_RISING | VALID | GNSS_BASE, GPS_MS),
        ("falling", NEW_FALLING | NEW_RISING | VALID | UTC_BASE, UTC_MS),
    ],
)
def test_a_mark_is_its_edge_in_utc(edge: Edge, flags: int, ms: int) -> None:
    this, other = (WEEK, ms + 250, 123_456), (WEEK, ms + 999, 1)
    falling, rising = (this, other) if edge == "falling" else (other, this)
    payload = mark(flags, falling=falling, rising=rising)
    assert time_mark(UbxMessage((0x0D, 0x03), payload), edge) == TimeMark(7, SATURDAY_S * 10**9 + 250_123_456, 30)


@pytest.mark.parametrize(
    "flags",
    [NEW_RISING | VALID | GNSS_BASE, NEW_FALLING | GNSS_BASE, NEW_FALLING | VALID],
    ids=["only the other edge is new", "the time is not valid", "the receiver's own time"],
)
def test_what_is_no_exposure_in_utc_is_no_mark(flags: int) -> None:
    at = (WEEK, GPS_MS, 0)
    assert time_mark(UbxMessage((0x0D, 0x03), mark(flags, rising=at, falling=at)), "falling") is None


@pytest.mark.parametrize("at", [(WEEK, 604_800_000, 0), (WEEK, 0, 10**6)], ids=["beyond the week", "beyond the ms"])
def test_times_that_can_not_be_are_no_mark(at: tuple[int, int, int]) -> None:
    payload = mark(NEW_FALLING | VALID | GNSS_BASE, rising=at, falling=at)
    assert time_mark(UbxMessage((0x0D, 0x03), payload), "falling") is None


def test_other_messages_and_lengths_are_no_mark() -> None:
    assert time_mark(UbxMessage((0x0D, 0x01), bytes(28)), "falling") is None
    assert time_mark(UbxMessage((0x0D, 0x03), bytes(27)), "falling") is None
