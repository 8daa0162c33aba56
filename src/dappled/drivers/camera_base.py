"""What drivers have in common: a queue of events, and, for cameras that only shoot, settings that aren't there."""

from __future__ import annotations

import queue

from dappled.drivers.camera import Arrival, Companion, Event, Setting, SettingName, check_change


class QueuedCamera:
    """The receiver's half of a driver (`drivers.camera.Arrivals`): any thread puts events, the receiver takes them."""

    def __init__(self) -> None:
        self._events: queue.SimpleQueue[Event] = queue.SimpleQueue()

    def next_event(self, timeout_s: float) -> Event | None:
        """See Camera; also after `stop`, until there are none."""
        try:
            return self._events.get(timeout=timeout_s) if timeout_s > 0 else self._events.get_nowait()
        except queue.Empty:
            return None


class PlainCamera(QueuedCamera):
    """A camera whose settings nobody can read, and whose own copies of its files are never touched."""

    def release(self, arrival: Arrival | Companion) -> None:
        """See Camera: what was picked up stays where it is."""

    def settings(self) -> tuple[Setting, ...]:
        """See Camera: there are none."""
        return ()

    def change(self, name: SettingName, value: str) -> None:
        """See Camera."""
        check_change((), name, value)
