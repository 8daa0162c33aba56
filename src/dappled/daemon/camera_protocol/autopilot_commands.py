"""What we ordered the autopilot to do, and which of its messages are only the echo of that.

A camera that the autopilot fires for us (a servo, a relay, its own trigger) makes the autopilot say so: CAMERA_TRIGGER,
CAMERA_FEEDBACK, or the command for cameras. Each order has one of each kind on each link within two seconds; that is no
new wish, else every shot would ask for the next.
"""

from __future__ import annotations

from collections import deque
from dataclasses import dataclass, field

ECHO_NS = 2 * 10**9
_KEPT = 32


@dataclass(slots=True)
class _Order:
    at_ns: int
    echoes: set[tuple[str, int]] = field(default_factory=set)


class Orders:
    """Orders of the last two seconds. Times are monotonic."""

    def __init__(self) -> None:
        self.commands: set[int] = set()
        self._orders: deque[_Order] = deque(maxlen=_KEPT)

    def given(self, command: int, now_ns: int) -> None:
        """A command goes to the autopilot."""
        self.commands.add(command)
        self._orders.append(_Order(now_ns))

    def is_echo(self, kind: str, link: int, now_ns: int) -> bool:
        """Whether a message of this kind from our autopilot tells of an order of ours; the oldest that has none yet."""
        for order in list(self._orders):
            if now_ns - order.at_ns <= ECHO_NS and (kind, link) not in order.echoes:
                order.echoes.add((kind, link))
                return True
        return False
