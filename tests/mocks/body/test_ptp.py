"""Packets against the layouts of CIPA DC-005, data sets against PIMA 15740 and libgphoto2, unpacked by hand."""

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
    assert request == ptp.PtpRequest(code, transaction, tuple(parameters))
    assert request.parameter(5, 17) == 17


@given(st.binary(max_size=40))
def test_bytes_are_a_request_or_refused(raw: bytes) -> None:
    if len(raw) in (10, 14, 18, 22, 26, 30):
        assert len(ptp.parse_request(raw).parameters) == (len(raw) - 10) // 4
    else:
        with pytest.raises(ptp.MalformedPacketError):
            ptp.parse_request(raw)


@given(st.sampled_from(ptp.PtpPacket), st.binary(max_size=50))
def test_a_packet_s_header_says_its_type_and_length(kind: ptp.PtpPacket, payload: bytes) -> None:
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


@given(st.text(st.characters(exclude_categories=["Cs"], exclude_characters="\0"), min_size=1, max_size=120))
def test_a_string_counts_its_units_with_the_closing_zero(text: str) -> None:
    raw = ptp.string(text)
    assert raw[0] * 2 == len(raw) - 1
    assert raw[1:-2].decode("utf-16-le") == text
    assert raw.endswith(b"\0\0")


def test_strings_at_their_limits() -> None:
    assert ptp.string("") == b"\0"
    assert ptp.string("x" * 254)[0] == 255
    with pytest.raises(ptp.MalformedPacketError):
        ptp.string("x" * 255)


@given(st.lists(u32, max_size=20))
def test_arrays_are_counted(values: list[int]) -> None:
    assert struct.unpack(f"<I{len(values)}I", ptp.array32(values)) == (len(values), *values)


def test_eos_events_stand_where_libgphoto2_reads_them() -> None:
    added = ptp.eos_object_added(handle=1, storage=2, code=0xB103, size=4, parent=5, name="IMG_0001.CR2")
    assert struct.unpack_from("<II", added) == (len(added), 0xC181)
    assert [struct.unpack_from("<I", added, at)[0] for at in (0x08, 0x0C, 0x10, 0x1C, 0x20)] == [1, 2, 0xB103, 4, 5]
    assert added[0x28:].rstrip(b"\0") == b"IMG_0001.CR2"
    assert added.endswith(b"\0")

    transfer = ptp.eos_object_transfer(handle=1, code=0xB103, size=4, name="IMG_0001.CR2")
    assert struct.unpack_from("<II", transfer) == (len(transfer), 0xC186)
    assert [struct.unpack_from("<I", transfer, at)[0] for at in (0x08, 0x0C, 0x14)] == [1, 0xB103, 4]
    assert transfer[0x1C:].rstrip(b"\0") == b"IMG_0001.CR2"

    both = ptp.eos_events([added, transfer])
    assert both == added + transfer + struct.pack("<II", 8, 0)


def test_an_eos_folder_entry_has_52_bytes_behind_its_size() -> None:
    raw = ptp.eos_folder([(11, 12, 0xB103, 13, 14, "IMG_0001.CR2", 15)])
    assert struct.unpack_from("<II", raw) == (1, 56)
    entry = raw[8:]
    assert len(entry) == 52
    assert [struct.unpack_from("<I", entry, at)[0] for at in (0, 4, 8, 20, 24, 48)] == [11, 12, 0xB103, 13, 14, 15]
    assert entry[32:48].rstrip(b"\0") == b"IMG_0001.CR2"
