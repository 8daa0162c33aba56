"""How often a process that dies may be started again."""

from __future__ import annotations

from collections import deque


class RestartBudget:
    """At most `limit` starts in any `window_s`. Not thread-safe: one owner."""

    def __init__(self, limit: int, window_s: float) -> None:
        self._limit = limit
        self._window_ns = round(window_s * 1e9)
        self._spent_ns: deque[int] = deque()

    def wait_ns(self, now_ns: int) -> int:
        """How long until the next start is allowed; 0: now."""
        while self._spent_ns and now_ns - self._spent_ns[0] >= self._window_ns:
            self._spent_ns.popleft()
        if len(self._spent_ns) < self._limit:
            return 0
        return self._spent_ns[0] + self._window_ns - now_ns

    def spend(self, now_ns: int) -> None:
        """A start was made."""
        self._spent_ns.append(now_ns)
