from __future__ import annotations

import os
import socket
from collections.abc import Iterator

import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from dappled.drivers.camera import Arrival, Blob, CameraEvent, Fired, Identity, ShotFailed, StateChanged
from dappled.drivers.gphoto2.channel import Channel, ChannelError, Message, event_message, message_event

Ends = tuple[Channel, Channel]


@pytest.fixture
def ends() -> Iterator[Ends]:
    here, there = Channel.pair()
    other = Channel(there)
    yield here, other
    here.close()
    other.close()


numbers = st.integers(0, 2**63)
identities = st.none() | st.builds(Identity, st.text(), st.text(), st.text(), st.text())
states = st.sampled_from(["absent", "starting", "ready", "busy", "faulted"])
events = st.one_of(
    st.builds(StateChanged, states, st.text(), numbers, identities),
    st.builds(Fired, numbers, numbers, numbers),
    st.builds(ShotFailed, numbers, st.text(), numbers),
)


@given(events)
def test_events_survive_the_journey(event: CameraEvent) -> None:
    assert message_event(event_message(event)) == event


@given(st.none() | numbers, st.text(), st.dictionaries(st.text(), st.integers() | st.text()), st.binary(min_size=1))
@settings(suppress_health_check=[HealthCheck.function_scoped_fixture])
def test_an_arrival_brings_its_bytes(
    ends: Ends, shot: int | None, name: str, facts: dict[str, object], data: bytes
) -> None:
    blob = Blob.of(data)
    message = event_message(Arrival(shot, name, blob, 5, facts))
    ends[0].send(message.body, message.fds)
    blob.close()
    received = ends[1].receive(5.0)
    assert received is not None
    event = message_event(received)
    assert isinstance(event, Arrival)
    assert (event.shot, event.name, event.facts, event.monotonic_ns) == (shot, name, facts, 5)
    assert not os.get_inheritable(event.blob.fd)
    assert event.blob.map()[:] == data
    event.blob.close()


def test_nothing_to_receive_is_none(ends: Ends) -> None:
    assert ends[0].receive(0.0) is None


def test_the_other_end_s_end_is_told(ends: Ends) -> None:
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


@given(st.binary(min_size=1, max_size=200))
@settings(suppress_health_check=[HealthCheck.function_scoped_fixture])
def test_nonsense_is_refused_and_never_crashes(raw: bytes) -> None:
    here, there = socket.socketpair(socket.AF_UNIX, socket.SOCK_SEQPACKET)
    channel = Channel(there)
    with here:
        here.send(raw)
        try:
            message = channel.receive(5.0)
        except ChannelError:
            return
        else:
            assert message is not None
            with pytest.raises(ChannelError):
                message_event(message)
        finally:
            channel.close()


@pytest.mark.parametrize(
    "body",
    [
        {},
        {"is": "party"},
        {"is": "fired", "shot": 1},
        {"is": "state", "state": "ready", "reason": "", "ns": 1, "identity": {"maker": "x"}},
        {"is": "arrival", "shot": 1, "name": "a", "size": 1, "ns": 1, "facts": {}},
    ],
)
def test_messages_that_are_no_events_are_refused(body: dict[str, object]) -> None:
    with pytest.raises(ChannelError):
        message_event(Message(body))


def test_descriptors_of_a_refused_message_are_closed() -> None:
    blob = Blob.of(b"x")
    with pytest.raises(ChannelError):
        message_event(Message({"is": "party"}, (blob.fd,)))
    with pytest.raises(OSError, match="Bad file descriptor"):
        os.fstat(blob.fd)
