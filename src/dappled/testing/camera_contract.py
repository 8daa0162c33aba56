"""The contract of every camera driver as a test class: inherit `CameraContract` and define its fixture `rig`.

The helpers use only events and descriptors, so that they can't share a fault with the driver.
"""

from __future__ import annotations

import os
import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass

import pytest

from dappled.drivers.camera import (
    Arrival,
    Camera,
    CameraError,
    CameraEvent,
    Companion,
    Deferred,
    Fired,
    Noticed,
    SettingsChanged,
    ShotFailed,
    StateChanged,
)

_PATIENCE_S = 30.0


@dataclass(frozen=True, slots=True)
class Rig:
    """A driver that was not started, and the file that its camera makes of its n-th exposure (from 1).

    `follows`: files come after their shots were deferred. `recorded`: times are those of a recording. `loose`: a shot
    may be fired before the file of the last one arrived, so that the events of several shots may be interleaved.
    """

    camera: Camera
    picture: Callable[[int], bytes]
    follows: bool = False
    recorded: bool = False
    loose: bool = False


def until(camera: Camera, wanted: Callable[[CameraEvent], bool], patience_s: float = _PATIENCE_S) -> list[CameraEvent]:
    """Return all events up to and including the first wanted one. Fails when it doesn't come."""
    events: list[CameraEvent] = []
    deadline = time.monotonic() + patience_s
    while time.monotonic() < deadline:
        event = camera.next_event(deadline - time.monotonic())
        if event is not None:
            events.append(event)
            if wanted(event):
                return events
    pytest.fail(f"the expected event never came; these came: {events}")


def until_state(camera: Camera, state: str) -> StateChanged:
    """Return the first change into this state."""
    found = until(camera, lambda event: isinstance(event, StateChanged) and event.state == state)[-1]
    assert isinstance(found, StateChanged)
    return found


def until_shot_ends(camera: Camera, shot: int) -> list[CameraEvent]:
    """Return all events up to and including the one that ends this shot."""
    return until(camera, lambda event: isinstance(event, Arrival | ShotFailed) and event.shot == shot)


def arrived(camera: Camera, shot: int) -> Arrival:
    """Return the file of this shot. Fails where the shot ends in another way."""
    end = until_shot_ends(camera, shot)[-1]
    assert isinstance(end, Arrival), end
    return end


def failed(camera: Camera, shot: int) -> str:
    """Return why this shot failed. Fails where it did not."""
    end = until_shot_ends(camera, shot)[-1]
    assert isinstance(end, ShotFailed), end
    return end.reason


def until_quiet(camera: Camera) -> None:
    """Wait until no event came for 0.3 s: a camera may report its settings after it is ready."""
    deadline = time.monotonic() + _PATIENCE_S
    while camera.next_event(0.3) is not None:
        assert time.monotonic() < deadline, "events without end"


def content(arrival: Arrival | Companion) -> bytes:
    """Return the bytes behind an arrival's descriptor, read with pread, and close the descriptor."""
    data = os.pread(arrival.blob.fd, arrival.blob.size + 1, 0)
    arrival.blob.close()
    return data


def of_shots(events: list[CameraEvent], *, deferred: bool = True) -> list[tuple[type[CameraEvent], int | None]]:
    """Return kind and shot of the events that belong to shots."""
    others = (StateChanged, SettingsChanged, Noticed, *(() if deferred else (Deferred,)))
    return [(type(event), event.shot) for event in events if not isinstance(event, others)]  # type: ignore[union-attr]


class CameraContract:
    """What every driver must do. Inherit it and define the fixture `rig` with your driver."""

    @pytest.fixture
    def rig(self) -> Iterator[Rig]:
        """The driver under test. The fixture that overrides this stops the driver after the test."""
        raise NotImplementedError

    def test_becomes_ready_and_says_who_it_is(self, rig: Rig) -> None:
        rig.camera.start()
        ready = until_state(rig.camera, "ready")
        assert ready.identity is not None
        assert ready.identity.make
        assert ready.identity.model
        assert rig.camera.identity == ready.identity

    def test_a_shot_is_fired_and_its_file_arrives(self, rig: Rig) -> None:
        rig.camera.start()
        until_state(rig.camera, "ready")
        before_ns = time.monotonic_ns()
        rig.camera.fire(7)
        events = until_shot_ends(rig.camera, 7)
        assert any(isinstance(event, Deferred) for event in events) == rig.follows
        fired, arrival = [event for event in events if isinstance(event, Fired | Arrival)]
        assert isinstance(fired, Fired)
        assert isinstance(arrival, Arrival)
        assert fired.shot == arrival.shot == 7
        assert fired.called_monotonic_ns <= fired.returned_monotonic_ns <= arrival.monotonic_ns
        if not rig.recorded:
            assert before_ns <= fired.called_monotonic_ns
            assert arrival.monotonic_ns <= time.monotonic_ns()
        assert arrival.name
        assert content(arrival) == rig.picture(1)

    def test_shots_asked_for_at_once_come_one_by_one_in_order(self, rig: Rig) -> None:
        rig.camera.start()
        until_state(rig.camera, "ready")
        for shot in (3, 4, 5):
            rig.camera.fire(shot)
        events = until_shot_ends(rig.camera, 5)
        reported = of_shots(events, deferred=False)
        in_order: list[tuple[type[CameraEvent], int | None]] = [
            (kind, shot) for shot in (3, 4, 5) for kind in (Fired, Arrival)
        ]
        assert reported == in_order or (rig.loose and sorted(reported, key=in_order.index) == in_order)
        arrivals = [event for event in events if isinstance(event, Arrival)]
        assert [content(each) for each in arrivals] == [rig.picture(number) for number in (1, 2, 3)]
        assert len({each.name for each in arrivals}) == 3

    def test_a_map_outlives_blob_release_and_camera(self, rig: Rig) -> None:
        rig.camera.start()
        until_state(rig.camera, "ready")
        rig.camera.fire(1)
        arrival = until_shot_ends(rig.camera, 1)[-1]
        assert isinstance(arrival, Arrival)
        whole = arrival.blob.map()
        arrival.blob.close()
        rig.camera.release(arrival)
        rig.camera.stop()
        assert whole[:] == rig.picture(1)

    def test_an_idle_camera_has_no_events(self, rig: Rig) -> None:
        rig.camera.start()
        until_state(rig.camera, "ready")
        until_quiet(rig.camera)
        assert rig.camera.next_event(0.3) is None
        assert rig.camera.next_event(0.0) is None
        assert rig.camera.identity is not None

    def test_an_unknown_setting_or_choice_is_refused_with_a_sentence(self, rig: Rig) -> None:
        with pytest.raises(CameraError, match="iso"):
            rig.camera.change("iso", "no such ISO")  # not started: nothing is known
        rig.camera.start()
        until_state(rig.camera, "ready")
        until_quiet(rig.camera)
        for each in rig.camera.settings():
            with pytest.raises(CameraError, match=each.name):
                rig.camera.change(each.name, "no such value")

    def test_each_setting_can_be_set_to_its_last_choice(self, rig: Rig) -> None:
        rig.camera.start()
        until_state(rig.camera, "ready")
        until_quiet(rig.camera)
        for each in [one for one in rig.camera.settings() if one.choices]:
            rig.camera.change(each.name, each.choices[-1])
            reported = until(rig.camera, lambda event: isinstance(event, SettingsChanged))[-1]
            assert isinstance(reported, SettingsChanged)
            assert not reported.refused
            assert reported.settings == rig.camera.settings()
            now = {one.name: one.value for one in reported.settings}
            assert now[each.name] == each.choices[-1], each.name

    def test_a_shot_without_a_camera_fails_with_a_sentence(self, rig: Rig) -> None:
        rig.camera.fire(1)  # not started
        (failed,) = until_shot_ends(rig.camera, 1)
        assert isinstance(failed, ShotFailed)
        assert failed.reason

    def test_stop_ends_every_shot_and_may_be_repeated(self, rig: Rig) -> None:
        rig.camera.start()
        until_state(rig.camera, "ready")
        for shot in range(3):
            rig.camera.fire(shot)
        rig.camera.stop()
        rig.camera.stop()
        rig.camera.fire(9)
        events: list[CameraEvent] = []
        while (event := rig.camera.next_event(0.0)) is not None:
            events.append(event)
        ends = [event for event in events if isinstance(event, Arrival | ShotFailed | Deferred)]
        assert sorted({event.shot for event in ends if event.shot is not None}) == [0, 1, 2, 9]
        assert rig.follows or len(ends) == 4
        for event in ends:
            if isinstance(event, Arrival):
                event.blob.close()
