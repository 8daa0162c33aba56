from __future__ import annotations

import os
import socket
from collections.abc import Iterator

import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from dappled.drivers.camera import (
    Arrival,
    Blob,
    CameraEvent,
    Companion,
    Fired,
    Identity,
    Noticed,
    Setting,
    SettingsChanged,
    ShotFailed,
    StateChanged,
)
from dappled.drivers.child_process import ChannelError, ChannelMessage, ProcessChannel
from dappled.drivers.gphoto2.messages import EventSender, event_message, lost_file, message_event
from dappled.findings import Code, Finding, Subject

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
    st.builds(Noticed, st.builds(Finding, st.sampled_from(Code), st.builds(Subject, st.text(), numbers)), numbers),
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


@pytest.mark.parametrize(
    ("event", "shot", "stays"),
    [
        (Arrival(7, "a.cr2", Blob(3, 1), 5, {"folder": "/DCIM", "name": "IMG_7.CR2"}), 7, True),
        (Arrival(7, "a.cr2", Blob(3, 1), 5, {"folder": "/", "name": "capt0000.cr2"}), 7, False),
        (Arrival(None, "a.cr2", Blob(3, 1), 5, {}), None, False),
        (Companion(7, "a.jpg", Blob(3, 1), 5, {"folder": "/DCIM", "name": "IMG_7.CR2"}), None, True),
    ],
)
def test_a_file_that_was_lost_on_the_way_fails_the_shot_that_waited_for_it(
    event: CameraEvent, shot: int | None, stays: bool
) -> None:
    failing, reason = lost_file(ChannelMessage(event_message(event).body, (), "dappled has run out of something"))
    assert failing == shot
    assert "could not be received: dappled has run out of something" in reason
    assert reason.endswith("; it stays on the card as /DCIM/IMG_7.CR2") is stays


@pytest.mark.parametrize("body", [{}, {"is": "fired", "shot": 1}, {"is": "arrival", "shot": 1, "facts": 5}])
def test_a_lost_message_that_is_no_event_is_refused(body: dict[str, object]) -> None:
    with pytest.raises(ChannelError):
        lost_file(ChannelMessage(body, (), "gone"))


def test_an_event_that_is_too_long_costs_its_shot_alone(ends: Ends) -> None:
    sender = EventSender(ends[0])
    blob = Blob.of(b"x")
    setting = Setting("iso", "100", tuple(str(number) for number in range(50_000)))
    sender.send(Arrival(1, "a.cr2", blob, 5, {"note": "x" * 200_000}), SettingsChanged((setting,), 6), Fired(2, 7, 8))
    with pytest.raises(OSError, match="Bad file descriptor"):
        os.fstat(blob.fd)
    events = []
    while (message := ends[1].receive(0.0)) is not None:
        events.append(message_event(message))
    failed, settings, fired = events
    assert isinstance(failed, ShotFailed)
    assert isinstance(settings, SettingsChanged)
    assert (failed.shot, settings.settings, fired) == (1, (), Fired(2, 7, 8))
    assert "longer than a message may be" in failed.reason
    assert "longer than a message may be" in settings.refused
