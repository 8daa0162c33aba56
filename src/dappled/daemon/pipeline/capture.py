"""The camera's side of the street: its events in order, each file made safe, each shot without one given up."""

from __future__ import annotations

import logging
import threading
import time
from collections import deque
from collections.abc import Callable

from dappled.daemon.pipeline.pending_shot import FlightWriter, Observer, PendingShot
from dappled.daemon.pipeline.pending_shots import PendingShots
from dappled.drivers.camera import (
    Arrival,
    BodyState,
    Camera,
    CameraEvent,
    Companion,
    Deferred,
    Fired,
    SettingsChanged,
    ShotFailed,
    StateChanged,
)
from dappled.errors import report, sentence

log = logging.getLogger(__name__)
_LOOK_S = 0.1
_LAST_EVENTS_S = 1.0


class Capture:
    """One thread that pulls the camera's events. `hand_on` takes the stories that are ready to be tagged: their frame
    is safe, or its file stays at the camera."""

    def __init__(
        self,
        camera: Camera,
        writer: FlightWriter,
        shots: PendingShots,
        observer: Observer,
        hand_on: Callable[[PendingShot], object],
    ) -> None:
        self._camera, self._writer, self._shots, self._observer = camera, writer, shots, observer
        self._hand_on = hand_on
        self._unfired: deque[ShotFailed] = deque()
        self._stopping, self._give_up_at = threading.Event(), 0.0
        self._thread = threading.Thread(target=self._run, name="capture", daemon=True)
        self.state: BodyState = "starting"
        self.reason = ""

    def dead_threads(self) -> list[str]:
        """The thread's name where it has ended without being asked to: never, unless there is a bug."""
        return [] if self._stopping.is_set() or self._thread.is_alive() else [self._thread.name]

    def start(self) -> None:
        """Begin: the camera first."""
        self._camera.start()
        self._thread.start()

    def fire(self, index: int) -> None:
        """Hand an expected shot to the camera. Never raises: a shot that the driver won't take has failed."""
        try:
            self._camera.fire(index)
        except Exception as error:  # noqa: BLE001  # any driver's; the shot is written down already and must come to an end
            reason = f"the camera driver did not take the shot: {sentence(error)}"
            self._unfired.append(ShotFailed(index, reason, time.monotonic_ns()))

    def stop(self, timeout_s: float) -> None:
        """Wait for what is with the camera, at most `timeout_s`; let go of it. Shots without a file have failed."""
        self._give_up_at = time.monotonic() + timeout_s
        self._stopping.set()
        if self._thread.is_alive():
            self._thread.join(timeout_s + 1)
        self._shots.tell(self._camera.stop)
        if not self._thread.is_alive():
            self._last_events()

    def _run(self) -> None:
        while not self._stopping.is_set() or self._worth_waiting():
            self._take(_LOOK_S)

    def _worth_waiting(self) -> bool:
        return time.monotonic() < self._give_up_at and bool(self._shots.waiting())

    def _last_events(self) -> None:
        """What came while the camera was let go of; then every shot that is still open has failed."""
        until = time.monotonic() + _LAST_EVENTS_S
        while time.monotonic() < until and self._take(0.0):
            pass
        for index in self._shots.waiting():
            self._handle(ShotFailed(index, "the flight ended before its file came", time.monotonic_ns()))

    def _take(self, timeout_s: float) -> bool:
        """Pull one event and act on it; False where none came in time."""
        try:
            event = self._unfired.popleft() if self._unfired else self._camera.next_event(timeout_s)
        except Exception as error:  # noqa: BLE001  # any driver's; the capture goes on, at a pace that leaves others their time
            report(log, "the camera driver", error)
            time.sleep(_LOOK_S)
            return True
        if event is None:
            return False
        self._handle(event)
        return True

    def _handle(self, event: CameraEvent) -> None:
        try:
            if isinstance(event, StateChanged):
                self._state_changed(event)
            elif isinstance(event, Fired):
                self._fired(event)
            elif isinstance(event, ShotFailed):
                self._shot_failed(event.shot, event.reason)
            elif isinstance(event, Arrival):
                self._arrived(event)
            elif isinstance(event, Companion):
                self._accompanied(event)
            elif isinstance(event, Deferred):
                self._deferred(event)
            elif isinstance(event, SettingsChanged):
                self._shots.tell(self._observer.settings, event)
        except Exception as error:  # noqa: BLE001  # one event that goes wrong must not end the capture
            report(log, "capture", error)

    def _state_changed(self, change: StateChanged) -> None:
        self.state, self.reason = change.state, change.reason
        if not self._stopping.is_set():
            self._shots.tell(self._observer.camera, change)

    def _fired(self, event: Fired) -> None:
        self._writer.fired(event)  # raises for a second time, or one after the file: the first word counts
        if pending := self._shots.in_hand(event.shot):
            pending.fired = event
            pending.ms["wish to trigger"] = (event.called_monotonic_ns - pending.shot.wished_monotonic_ns) / 1e6
            pending.ms["trigger call"] = (event.returned_monotonic_ns - event.called_monotonic_ns) / 1e6

    def _shot_failed(self, index: int, reason: str) -> None:
        pending = self._shots.in_hand(index)
        if pending is not None and pending.frame is not None:
            self._shots.note("contradiction", f"its file is safe, and then the driver says: {reason}", index)
            return
        try:
            self._writer.failed(index, reason)
        finally:
            if pending is not None:
                self._shots.fail(pending, reason)

    def _arrived(self, arrival: Arrival) -> None:
        began = time.monotonic_ns()
        index = arrival.shot
        pending = None if index is None else self._shots.of_file(index)
        try:
            frame = self._writer.record(index, arrival.name, arrival.blob)
        except Exception as error:
            # The recorder has noted it as far as the disk lets it. A second file doesn't undo the first one.
            if pending is not None and pending.frame is None and not pending.over:
                self._shots.fail(pending, sentence(error))
            raise
        finally:
            arrival.blob.close()
        self._shots.tell(self._camera.release, arrival)
        if pending is None or pending.frame is not None:
            return
        pending = self._shots.safe(pending, frame)
        if doubt := arrival.facts.get("doubt"):
            pending.doubt = str(doubt)
            self._shots.note("doubt", pending.doubt, frame.index)
        if pending.fired:
            pending.ms["trigger to file"] = (arrival.monotonic_ns - pending.fired.returned_monotonic_ns) / 1e6
        pending.ms["record"] = (time.monotonic_ns() - began) / 1e6
        self._shots.welcome(pending, frame.index, arrival.name)
        self._shots.tell(self._observer.settled, frame.index, True)
        self._hand_on(pending)

    def _accompanied(self, companion: Companion) -> None:
        try:
            self._writer.companion(companion.shot, companion.name, companion.blob)
        finally:
            companion.blob.close()
        self._shots.tell(self._camera.release, companion)

    def _deferred(self, event: Deferred) -> None:
        """The end of a shot whose file comes later: where it was exposed can be told now."""
        try:
            self._writer.follows(event.shot, event.reason)
        finally:
            pending = self._shots.in_hand(event.shot)
            if pending is not None and pending.frame is None:
                self._shots.follow(pending, event.reason)
                self._hand_on(pending)
