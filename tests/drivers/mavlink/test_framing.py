"""Bytes to packets: whatever comes in between, sound packets come out whole, and nothing else does."""

from __future__ import annotations

from hypothesis import given
from hypothesis import strategies as st

from dappled.drivers.mavlink.framing import Decoder, Framer, mavlink, pack


def packets(count: int, *, version_1: bool = False) -> list[bytes]:
    packer = mavlink.MAVLink(None, srcSystem=1, srcComponent=1)
    return [
        pack(mavlink.MAVLink_attitude_message(i + 1, 0.1, 0.2, 0.3, 0.4, 0.5, 0.6), packer, version_1=version_1)
        for i in range(count)
    ]


@given(st.lists(st.integers(1, 40), min_size=1, max_size=40), st.booleans())
def test_a_stream_cut_anywhere_gives_the_same_packets(cuts: list[int], version_1: bool) -> None:
    wanted = packets(8, version_1=version_1)
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
    for raw, garbage in zip(packets(4), noise, strict=True):
        list(framer.datagram(garbage))
        assert [framed.raw for framed in framer.datagram(raw)] == [raw]


@given(st.integers(0, 39), st.integers(1, 255))
def test_one_changed_byte_never_gives_a_different_known_message(place: int, change: int) -> None:
    raw = bytearray(packets(1)[0])
    raw[place % len(raw)] ^= change
    for framed in Framer().datagram(bytes(raw)):
        assert isinstance(framed.message, mavlink.MAVLink_unknown)


def test_a_stream_finds_its_way_after_garbage_and_counts_it() -> None:
    first, second, third = packets(3)
    framer = Framer()
    got = [f.raw for f in framer.feed(first + b"\xfe\x05garbage" + second + third + bytes(300))]
    assert got == [first, second, third]
    assert framer.bad >= 1


def test_the_decoder_refuses_what_is_no_packet() -> None:
    decode = Decoder()
    assert decode(b"") is None
    assert decode(packets(1)[0][:-1]) is None
    message = decode(packets(1)[0])
    assert message is not None
    assert message.get_type() == "ATTITUDE"
