"""Lines for the pilot: STATUSTEXT, in pieces where a sentence is longer, and not the same one again and again."""

from __future__ import annotations

import itertools
import re
import threading
from collections import deque
from collections.abc import Sequence

from dappled.drivers.mavlink.links import Message, mavlink

PIECE_BYTES = 50
LONGEST_BYTES = 4 * PIECE_BYTES
AGAIN_NS = 10 * 10**9
AWAY_NS = 60 * 10**9
_REMEMBERED = 32
_NUMBER = re.compile(r"\d+")  # a problem whose numbers change is still the same


class PilotLines:
    """Sentences to messages. The same sentence is said at most once in ten seconds."""

    def __init__(self) -> None:
        self._numbers = itertools.cycle(range(1, 65536))
        self._said: deque[tuple[str, int]] = deque(maxlen=_REMEMBERED)

    def messages(self, text: str, severity: int, now_ns: int) -> list[Message]:
        """The messages that say it; none where it was just said. Time is monotonic."""
        if any(said == text and now_ns - at_ns < AGAIN_NS for said, at_ns in list(self._said)):
            return []
        self._said.append((text, now_ns))
        return list(_pieces(text, severity, next(self._numbers)))


class Alarms:
    """Tells each problem once, when it comes up; and when the last has gone."""

    def __init__(self) -> None:
        self._known: set[str] = set()

    @property
    def troubled(self) -> bool:
        """Whether there is any, as told last."""
        return bool(self._known)

    def lines(self, problems: Sequence[str], *, again: bool = False) -> list[tuple[str, int]]:
        """What is to be said now, and how severe it is. `again`: also what was said before, as long as it lasts."""
        now = {_NUMBER.sub("#", text) for text in problems}
        told = set() if again else self._known
        said = [(text, mavlink.MAV_SEVERITY_WARNING) for text in problems if _NUMBER.sub("#", text) not in told]
        if self._known and not now:
            said.append(("all is well again", mavlink.MAV_SEVERITY_INFO))
        self._known = now
        return said


class Audience:
    """The ground stations that read the lines. A daemon starts with the machine, long before anybody listens: who comes
    later, or back after a minute, has missed what still lasts. Times are monotonic."""

    def __init__(self) -> None:
        self._lock = threading.Lock()
        self._heard_ns: dict[tuple[int, int], int] = {}
        self._due_ns: int | None = None

    def heard(self, message: Message, now_ns: int) -> None:
        """A heartbeat."""
        if message.type != mavlink.MAV_TYPE_GCS:
            return
        station = (message.get_srcSystem(), message.get_srcComponent())
        with self._lock:  # each link has a thread
            before_ns = self._heard_ns.pop(station, None)
            self._heard_ns[station] = now_ns
            if len(self._heard_ns) > _REMEMBERED:
                del self._heard_ns[next(iter(self._heard_ns))]
        if before_ns is None or now_ns - before_ns > AWAY_NS:
            self._due_ns = now_ns + AGAIN_NS  # what was said a moment ago would not be said again

    def has_grown(self, now_ns: int) -> bool:
        """Whether somebody new listens; True once."""
        due_ns = self._due_ns
        if due_ns is None or now_ns < due_ns:
            return False
        self._due_ns = None
        return True


def _pieces(text: str, severity: int, number: int) -> list[Message]:
    """One message up to 50 bytes; more carry a number and count up, and the last one is not full."""
    raw = text.encode("ascii", "replace")  # what ground stations can be trusted to show
    if len(raw) <= PIECE_BYTES:
        return [mavlink.MAVLink_statustext_message(severity, raw)]
    if len(raw) >= LONGEST_BYTES:
        raw = raw[: LONGEST_BYTES - 4] + b"..."
    pieces = [raw[start : start + PIECE_BYTES] for start in range(0, len(raw), PIECE_BYTES)]
    if len(pieces[-1]) == PIECE_BYTES:
        pieces.append(b"")
    return [mavlink.MAVLink_statustext_message(severity, piece, number, at) for at, piece in enumerate(pieces)]
