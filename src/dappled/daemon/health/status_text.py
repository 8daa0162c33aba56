"""Make STATUSTEXT messages for the pilot: sentences in pieces, none repeated at once, findings that begin and end."""

from __future__ import annotations

import itertools
import threading
from collections import deque
from collections.abc import Mapping
from typing import Any

from dappled.daemon.health.standing import NewFindings, in_record, unasked
from dappled.drivers.mavlink import MavlinkMessage, mavlink
from dappled.findings import Finding, Level, Subject, above_note, named, told

PIECE_BYTES = 50
LONGEST_BYTES = 4 * PIECE_BYTES
AGAIN_NS = 10 * 10**9
AWAY_NS = 60 * 10**9
LISTENS_NS = 5 * 10**9
_REMEMBERED = 32
_SEVERITIES = {Level.CAUTION: mavlink.MAV_SEVERITY_WARNING, Level.STOP: mavlink.MAV_SEVERITY_ERROR}


class PilotMessages:
    """Turns sentences into messages. The same sentence is sent at most once in ten seconds, unless it is `news`."""

    def __init__(self) -> None:
        self._numbers = itertools.cycle(range(1, 65536))
        self._sent: deque[tuple[str, int]] = deque(maxlen=_REMEMBERED)

    def messages(self, text: str, severity: int, now_ns: int, *, news: bool = False) -> list[MavlinkMessage]:
        """The messages of a sentence; none where it was sent just before and isn't `news`. Time is monotonic."""
        if not news and any(sent == text and now_ns - at_ns < AGAIN_NS for sent, at_ns in list(self._sent)):
            return []
        self._sent.append((text, now_ns))
        return list(_pieces(text, severity, next(self._numbers)))


class Alarms:
    """Warns of each finding above a note once, when it begins, and says when a stop or the last one has ended."""

    def __init__(self) -> None:
        self._new = NewFindings()
        self._lasting = False  # whether something that was told has not ended
        self._stops: dict[Subject, Finding] = {}

    @property
    def troubled(self) -> bool:
        """Whether there was a stop at the last call of `lines`."""
        return bool(self._stops)

    def lines(self, health: Mapping[str, Any], *, again: bool = False) -> list[tuple[str, int]]:
        """The sentences of a health record to send now, each with its severity. `again` repeats those that last."""
        found = unasked(health)
        standing = {one.kind for one in above_note(in_record(health))}  # those that may settle are not over
        before, new = self._lasting, self._new.among(found, again=again)
        self._lasting = bool(standing) and (before or bool(self._new))
        before_stops, self._stops = self._stops, {one.subject: one for one in found if one.level is Level.STOP}
        lines = [(_words(one), _SEVERITIES[one.level]) for one in new]
        if before and not standing:
            return [("all is well again", mavlink.MAV_SEVERITY_INFO)]
        ended = [
            one for subject, one in before_stops.items() if subject not in self._stops and one.kind not in standing
        ]
        return lines + [(f"over: {named(one)}", mavlink.MAV_SEVERITY_INFO) for one in ended]


class GroundStations:
    """Notices ground stations that are new, or back after a minute: they have not received the problems that last.

    The daemon starts with the machine, often long before a ground station listens. Times are monotonic.
    """

    def __init__(self) -> None:
        self._lock = threading.Lock()
        self._heard_ns: dict[tuple[int, int], int] = {}
        self._due_ns: int | None = None

    def heard(self, message: MavlinkMessage, now_ns: int) -> None:
        """Take note of a heartbeat."""
        if message.type != mavlink.MAV_TYPE_GCS:
            return
        station = (message.get_srcSystem(), message.get_srcComponent())
        with self._lock:  # each link has its own thread
            before_ns = self._heard_ns.pop(station, None)
            self._heard_ns[station] = now_ns
            if len(self._heard_ns) > _REMEMBERED:
                del self._heard_ns[next(iter(self._heard_ns))]
        if before_ns is None or now_ns - before_ns > AWAY_NS:
            self._due_ns = now_ns + AGAIN_NS  # `PilotMessages` would leave out what was sent a moment ago

    def listening(self, now_ns: int) -> bool:
        """Whether a ground station was heard in the last five seconds."""
        with self._lock:
            return any(now_ns - heard_ns <= LISTENS_NS for heard_ns in self._heard_ns.values())

    def new_one(self, now_ns: int) -> bool:
        """Whether a new one listens since a while; True once for each."""
        due_ns = self._due_ns
        if due_ns is None or now_ns < due_ns:
            return False
        self._due_ns = None
        return True


def _words(one: Finding) -> str:
    """What was found and what to do, cut so that the code behind it has room."""
    words, code = str(told(one)), f" [{one.code}]"
    most = LONGEST_BYTES - 1 - len(code)
    return (words if len(words) <= most else words[: most - 3] + "...") + code


def _pieces(text: str, severity: int, number: int) -> list[MavlinkMessage]:
    """One message up to 50 bytes; else several with one number, of which the last is not full."""
    raw = text.encode("ascii", "replace")  # all ground stations show ASCII
    if len(raw) <= PIECE_BYTES:
        return [mavlink.MAVLink_statustext_message(severity, raw)]
    if len(raw) >= LONGEST_BYTES:
        raw = raw[: LONGEST_BYTES - 4] + b"..."
    pieces = [raw[start : start + PIECE_BYTES] for start in range(0, len(raw), PIECE_BYTES)]
    if len(pieces[-1]) == PIECE_BYTES:
        pieces.append(b"")
    return [mavlink.MAVLink_statustext_message(severity, piece, number, at) for at, piece in enumerate(pieces)]
