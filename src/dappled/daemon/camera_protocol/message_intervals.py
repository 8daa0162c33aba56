"""Which of the camera's messages somebody wants at an interval (MAV_CMD_SET_MESSAGE_INTERVAL)."""

from __future__ import annotations

import threading

SHORTEST_NS = 100_000_000  # 10 Hz: nothing here changes faster
LONGEST_US = 3.6e9


class MessageIntervals:
    """Intervals by message id; one set for all links, as a link has no name of its own in the protocol."""

    def __init__(self) -> None:
        self._lock = threading.Lock()
        self._intervals: dict[int, tuple[int, int]] = {}  # message id: (interval_ns, due_ns)

    def set(self, message_id: int, interval_us: float, now_ns: int) -> None:
        """Every `interval_us` microseconds, at most 10 Hz; 0 or less: not any more."""
        with self._lock:
            self._intervals.pop(message_id, None)
            if interval_us > 0:
                interval_ns = max(SHORTEST_NS, round(min(interval_us, LONGEST_US) * 1e3))
                self._intervals[message_id] = (interval_ns, now_ns + interval_ns)

    def interval_us(self, message_id: int) -> int:
        """The interval in microseconds; 0 where there is none."""
        with self._lock:
            return self._intervals.get(message_id, (0, 0))[0] // 1000

    def due(self, now_ns: int) -> list[int]:
        """The messages that are due by now; the next of each is due an interval later."""
        with self._lock:
            due = [number for number, (_, due_ns) in self._intervals.items() if now_ns >= due_ns]
            for number in due:
                interval_ns = self._intervals[number][0]
                self._intervals[number] = (interval_ns, now_ns + interval_ns)
        return due
