"""How many large bodies ZeroMQ may hold for those who have not read them yet."""

from __future__ import annotations

import weakref


class Kept:
    """Counts bodies that were handed over and are not let go of. One thread calls it.

    ZeroMQ drops its hold on a body when everybody it went to has read it, or was cut off.
    """

    def __init__(self, most: int) -> None:
        self._most = most
        self._bodies: list[weakref.ref[memoryview]] = []

    def take(self, body: memoryview) -> bool:
        """Whether there is room for one more; then `body` counts as long as somebody holds it."""
        self._bodies = [one for one in self._bodies if one() is not None]
        if len(self._bodies) >= self._most:
            return False
        self._bodies.append(weakref.ref(body))
        return True
