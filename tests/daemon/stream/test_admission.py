"""Which connection gives way where there are too many, and when a handshake counts as complete."""

from __future__ import annotations

import pytest
from hypothesis import given
from hypothesis import strategies as st

from dappled.daemon.stream.admission import (
    ConnectionLimits,
    Handshake,
    OpeningConnection,
    is_zeromq,
    network_of,
    surplus,
)

LIMITS = ConnectionLimits(opening=6, opening_per_address=4)
GREETING = b"\xff" + bytes(8) + b"\x7f\x03\x01CURVE".ljust(55, b"\0")
WELCOME = b"\x04\xa8\x07WELCOME" + bytes(160)
READY = b"\x04\x26\x05READY" + bytes(32)


def opening(*each: tuple[str, bool]) -> list[OpeningConnection]:
    return [OpeningConnection(number, network, speaks) for number, (network, speaks) in enumerate(each)]


@pytest.mark.parametrize(
    ("connections", "closed"),
    [
        ([], None),
        ([("a", False)] * 4, None),
        ([("a", False)] * 5, 0),
        ([("a", True), *[("a", False)] * 4], 1),
        ([("a", True)] * 5, 0),
        ([("b", False), *[("a", False)] * 4, ("b", False)], None),
        ([("b", False), *[("a", False)] * 4, ("b", False), ("b", True)], 1),
    ],
)
def test_of_the_address_with_most_a_silent_one_gives_way_first(
    connections: list[tuple[str, bool]], closed: int | None
) -> None:
    victim = surplus(opening(*connections), LIMITS)
    assert (victim.number if victim else None) == closed


@given(st.lists(st.tuples(st.sampled_from("abc"), st.booleans()), max_size=40))
def test_one_at_a_time_the_limits_hold_and_the_only_one_of_its_address_stays(arrivals: list[tuple[str, bool]]) -> None:
    kept: list[OpeningConnection] = [OpeningConnection(-1, "lone", False)]
    for one in opening(*arrivals):
        kept.append(one)
        if (victim := surplus(kept, LIMITS)) is not None:
            kept.remove(victim)
        assert len(kept) <= LIMITS.opening
    assert kept[0].network == "lone"


@pytest.mark.parametrize("chunk", [1, 7, 64, 1000])
def test_a_handshake_is_complete_with_ready_however_it_is_cut(chunk: int) -> None:
    handshake = Handshake()
    sent = GREETING + WELCOME + READY
    for start in range(0, len(GREETING + WELCOME), chunk):
        handshake.feed(sent[start : min(start + chunk, len(GREETING + WELCOME))])
    assert not handshake.complete
    handshake.feed(READY)
    assert handshake.complete


@pytest.mark.parametrize("sent", [GREETING + b"\x04\x0a\x05ERROR\x03400", GREETING + b"\x00\x06\x05READY"])
def test_nothing_else_completes_it(sent: bytes) -> None:
    handshake = Handshake()
    handshake.feed(sent)
    handshake.feed(bytes(100_000))
    assert not handshake.complete


@pytest.mark.parametrize(
    ("begin", "speaks"), [(GREETING[:10], True), (b"GET / HTTP", False), (GREETING[:9], False), (b"", False)]
)
def test_what_speaks_zeromq(begin: bytes, speaks: bool) -> None:
    assert is_zeromq(begin) is speaks


@pytest.mark.parametrize(
    ("address", "network"),
    [
        ("10.0.0.5", "10.0.0.5"),
        ("::ffff:10.0.0.5", "10.0.0.5"),
        ("fd00:0:0:1::5", "fd00:0:0:1::/64"),
        ("fe80::1%eth0", "fe80::/64"),
        ("testclient", "testclient"),
    ],
)
def test_addresses_that_one_machine_has_count_as_one(address: str, network: str) -> None:
    assert network_of(address) == network
