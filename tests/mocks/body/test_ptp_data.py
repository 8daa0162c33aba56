"""Data sets against the layouts of PIMA 15740 and libgphoto2, unpacked by hand."""

from __future__ import annotations

import struct

import pytest
from hypothesis import given
from hypothesis import strategies as st

from dappled.mocks.body import ptp_data
from dappled.mocks.body.ptp import MalformedPacketError

u32 = st.integers(0, 2**32 - 1)


@given(st.text(st.characters(codec="utf-16", exclude_characters="\0"), min_size=1, max_size=120))
def test_a_string_counts_its_units_with_the_closing_zero(text: str) -> None:
    raw = ptp_data.string(text)
    assert raw[0] * 2 == len(raw) - 1
    assert raw[1:-2].decode("utf-16-le") == text
    assert raw.endswith(b"\0\0")


def test_strings_at_their_limits() -> None:
    assert ptp_data.string("") == b"\0"
    assert ptp_data.string("x" * 254)[0] == 255
    with pytest.raises(MalformedPacketError):
        ptp_data.string("x" * 255)


@given(st.lists(u32, max_size=20))
def test_arrays_are_counted(values: list[int]) -> None:
    assert struct.unpack(f"<I{len(values)}I", ptp_data.array32(values)) == (len(values), *values)


def test_eos_events_stand_where_libgphoto2_reads_them() -> None:
    added = ptp_data.eos_object_added(handle=1, storage=2, code=0xB103, size=4, parent=5, name="IMG_0001.CR2")
    assert struct.unpack_from("<II", added) == (len(added), 0xC181)
    assert [struct.unpack_from("<I", added, at)[0] for at in (0x08, 0x0C, 0x10, 0x1C, 0x20)] == [1, 2, 0xB103, 4, 5]
    assert added[0x28:].rstrip(b"\0") == b"IMG_0001.CR2"
    assert added.endswith(b"\0")

    transfer = ptp_data.eos_object_transfer(handle=1, code=0xB103, size=4, name="IMG_0001.CR2")
    assert struct.unpack_from("<II", transfer) == (len(transfer), 0xC186)
    assert [struct.unpack_from("<I", transfer, at)[0] for at in (0x08, 0x0C, 0x14)] == [1, 0xB103, 4]
    assert transfer[0x1C:].rstrip(b"\0") == b"IMG_0001.CR2"

    both = ptp_data.eos_events([added, transfer])
    assert both == added + transfer + struct.pack("<II", 8, 0)


def test_an_eos_folder_entry_has_52_bytes_behind_its_size() -> None:
    raw = ptp_data.eos_folder([(11, 12, 0xB103, 13, 14, "IMG_0001.CR2", 15)])
    assert struct.unpack_from("<II", raw) == (1, 56)
    entry = raw[8:]
    assert len(entry) == 52
    assert [struct.unpack_from("<I", entry, at)[0] for at in (0, 4, 8, 20, 24, 48)] == [11, 12, 0xB103, 13, 14, 15]
    assert entry[32:48].rstrip(b"\0") == b"IMG_0001.CR2"
