from __future__ import annotations

import os
import socket
from collections.abc import Iterator

import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from dappled.drivers.camera import Arrival, Blob, CameraEvent, Fired, Identity, ShotFailed, StateChanged
from dappled.drivers.child_process import ChannelError, ChannelMessage, ProcessChannel
from dappled.drivers.gphoto2.messages import event_message, message_event

Ends = tuple[ProcessChannel, ProcessChannel]


@pytest.fixture
def ends() -> Iterator[Ends]:
    here, there = ProcessChannel.pair()
    other = ProcessChannel(there)
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
def test_events_survive_encoding(event: CameraEvent) -> None:
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


@given(st.binary(min_size=1, max_size=200))
@settings(suppress_health_check=[HealthCheck.function_scoped_fixture])
def test_nonsense_is_refused_and_never_crashes(raw: bytes) -> None:
    here, there = socket.socketpair(socket.AF_UNIX, socket.SOCK_SEQPACKET)
    channel = ProcessChannel(there)
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
        message_event(ChannelMessage(body))


def test_descriptors_of_a_refused_message_are_closed() -> None:
    blob = Blob.of(b"x")
    with pytest.raises(ChannelError):
        message_event(ChannelMessage({"is": "party"}, (blob.fd,)))
    with pytest.raises(OSError, match="Bad file descriptor"):
        os.fstat(blob.fd)
