from __future__ import annotations

from collections.abc import Iterator

import pytest

from dappled.drivers.process_channel import ChannelError, ProcessChannel

Ends = tuple[ProcessChannel, ProcessChannel]


@pytest.fixture
def ends() -> Iterator[Ends]:
    here, there = ProcessChannel.pair()
    other = ProcessChannel(there)
    yield here, other
    here.close()
    other.close()


def test_nothing_to_receive_is_none(ends: Ends) -> None:
    assert ends[0].receive(0.0) is None


def test_the_end_of_the_other_end_is_reported(ends: Ends) -> None:
    ends[1].close()
    with pytest.raises(ChannelError, match="ended"):
        ends[0].receive(5.0)
    with pytest.raises(ChannelError, match="gone"):
        ends[0].send({"do": "ping"})


def test_a_full_channel_does_not_block(ends: Ends) -> None:
    def fill() -> None:
        for number in range(100_000):
            ends[0].send({"do": "fire", "shot": number})

    with pytest.raises(ChannelError, match="no more"):
        fill()
