"""Packets against the layouts of CIPA DC-005, unpacked by hand."""

from __future__ import annotations

import struct

import pytest
from hypothesis import given
from hypothesis import strategies as st

from dappled.mocks.body import ptp

u32 = st.integers(0, 2**32 - 1)


@given(st.integers(0, 0xFFFF), u32, st.lists(u32, max_size=5))
def test_a_request_is_read_as_it_was_written(code: int, transaction: int, parameters: list[int]) -> None:
    raw = struct.pack(f"<IHI{len(parameters)}I", 1, code, transaction, *parameters)
    request = ptp.parse_request(raw)
    assert request == ptp.Request(code, transaction, tuple(parameters))
    assert request.parameter(5, 17) == 17


@given(st.binary(max_size=40))
def test_bytes_are_a_request_or_refused(raw: bytes) -> None:
    if len(raw) in (10, 14, 18, 22, 26, 30):
        assert len(ptp.parse_request(raw).parameters) == (len(raw) - 10) // 4
    else:
        with pytest.raises(ptp.MalformedPacketError):
            ptp.parse_request(raw)


@given(st.sampled_from(ptp.Packet), st.binary(max_size=50))
def test_a_packet_s_header_says_its_type_and_length(kind: ptp.Packet, payload: bytes) -> None:
    raw = ptp.packet(kind, payload)
    assert ptp.header(raw[:8]) == (kind, len(payload))
    assert raw[8:] == payload


@pytest.mark.parametrize("raw", [b"", b"\x08\0\0\0\x01\0\0", b"\x07\0\0\0\x01\0\0\0"])
def test_a_header_that_is_none_is_refused(raw: bytes) -> None:
    with pytest.raises(ptp.MalformedPacketError):
        ptp.header(raw)


def test_a_data_phase_is_announced_and_closed_with_its_size() -> None:
    assert ptp.start_data(7, 5) == struct.pack("<IIIQ", 20, 9, 7, 5)
    assert ptp.end_data_header(7, 5) == struct.pack("<III", 17, 12, 7)
