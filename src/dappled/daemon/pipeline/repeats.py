"""Recognise repeated messages: the rules and their time limits. A message that no rule matches is new.

1. Packet. A packet with the same sender, sequence number, message and payload within 0.5 s over the same link, or
   within 2.5 s over another link, is one packet (`PacketDedup`).
2. Retry. A capture request of the same source, kind and sequence within 1.2 s of the last such message, and within
   2.4 s of the first, is a retry of it. With `confirmation` above 0 (the sender itself says that it repeats) 10 s
   instead of both. Holds for messages that are acknowledged (their sender repeats when it misses the answer), that
   carry a sequence, or whose `confirmation` is above 0 (`RecentRequests`).
3. One trigger, several messages. PX4 sends CAMERA_TRIGGER, IMAGE_START_CAPTURE and DO_DIGICAM_CONTROL for one trigger,
   and a vehicle on two links sends each of them twice. Within 0.3 s of a shot's first message, a message of the same
   source belongs to that shot if the shot has none of this kind from this link yet, and none of this kind with another
   sequence; the oldest such shot takes it (`RecentRequests`). The same holds for a request that was refused: it is
   refused once, however many messages carried it. A retry of it is judged anew.
4. Echo. An autopilot that we command to fire the camera (a servo, a relay, its own trigger) reports that:
   CAMERA_TRIGGER, CAMERA_FEEDBACK, or the command for cameras. One message of each kind on each link within 2 s of our
   command is its echo and not a request, else every shot would ask for the next (`AutopilotCommands`).
5. Same instant. CAMERA_TRIGGER and CAMERA_FEEDBACK carry the autopilot's time in microseconds, CAMERA_IMAGE_CAPTURED in
   milliseconds. One of the same source with the same time (not 0) and number as one of the last 256 is that trigger,
   however late it comes: delayed on a link, or replayed by somebody (`RecentRequests`). Commands carry no time, and
   their numbers start again with their sender, so a command that comes again after the windows above can't be told
   from a new one.

6. Forwarded. A ground station's capture request to all components also reaches the autopilot, which executes it: its
   version follows, from another sender, with another number and often as another command. An autopilot's request within
   0.25 s of a ground station's broadcast, or the other way round, is that broadcast. Each message of one side is paired
   with one message of the other, the oldest first (`ForwardedRequests`). An autopilot's own trigger within 0.25 s of a
   broadcast is therefore joined with it; no body here takes two photographs within 0.25 s. For intervals see `Shutter`.

A series (an interval, a step of the zoom) is a different request than a single shot and than a series with other
numbers: only a retry with the same numbers is the same, and nothing else belongs to its first shot.

So a second press with the same sequence (most ground stations: always 0) inside 1.2 s is lost; and triggers from one
source less than 0.3 s apart may be joined if some of their messages were lost on the way.
"""

from __future__ import annotations

from collections import deque
from dataclasses import dataclass, field

from dappled.drivers.mavlink import Framed, Packet
from dappled.findings import Finding

SAME_LINK_NS = 500_000_000
OTHER_LINK_NS = 2_500_000_000  # a radio may be seconds behind a cable
RETRY_NS = 1_200_000_000
RETRY_LIMIT_NS = 2_400_000_000
CONFIRMED_RETRY_NS = 10 * 10**9
TRIGGER_NS = 300_000_000
ECHO_NS = 2 * 10**9
FORWARDED_NS = 250_000_000
_UNPAIRED_KEPT = 64
_NO_SHOT = -1
_PACKETS_KEPT = 1024
_REQUESTS_KEPT = 256
_COMMANDS_KEPT = 32
_PacketKey = tuple[int, int, int, int, bytes]
_RequestKey = tuple[str, str, int | None, tuple[float, ...] | None]


@dataclass(frozen=True, slots=True)
class CaptureRequest:
    """One message, or one act of a person, that asks for a shot.

    `source` is "mavlink:255/190", "console" …; `kind` the message or command; `sequence` the sender's own number,
    None where the kind has none; `acknowledged`: the sender gets an answer, and repeats when it misses it. `series`:
    the numbers of what is more than one shot now (an interval's seconds and count).
    """

    source: str
    kind: str
    sequence: int | None = None
    confirmation: int = 0
    link: int | None = None
    acknowledged: bool = True
    series: tuple[float, ...] | None = None
    time_us: int = 0  # the sender's own time of it; 0: the kind has none
    happened: bool = False  # it reports an exposure: that can't be refused
    broadcast: bool = False  # to all components: the autopilot may execute it too
    autopilot: bool = False  # an autopilot sent it


@dataclass(slots=True)
class _Remembered:
    index: int
    source: str
    kind: str
    sequence: int | None
    series: tuple[float, ...] | None
    first_ns: int
    last_ns: int
    parts: dict[tuple[str, int | None], int | None]  # (kind, link): sequence; shared by all names of a shot

    def key(self) -> _RequestKey:
        return self.source, self.kind, self.sequence, self.series


class RecentRequests:
    """The capture requests of the last ten seconds (at most 256), and the image index that each one got."""

    def __init__(self) -> None:
        self._requests: list[_Remembered] = []
        self._refused: deque[tuple[_Remembered, Finding]] = deque(maxlen=_UNPAIRED_KEPT)
        self._instants: dict[tuple[str, str, int | None, int], int] = {}  # of triggers with a time; the oldest first

    def same(self, request: CaptureRequest, now_ns: int) -> int | None:
        """The image index of the shot that this request already has; None for a new one. Times are monotonic."""
        if (index := self._instants.get(_instant(request))) is not None:
            return index
        self._requests = [one for one in self._requests if now_ns - one.last_ns <= CONFIRMED_RETRY_NS][-_REQUESTS_KEPT:]
        found = self._retry(request, now_ns) or self._part(request, now_ns)
        if found is None:
            return None
        self._note_instant(request, found.index)
        found.parts[request.kind, request.link] = request.sequence
        if (request.kind, request.sequence) == (found.kind, found.sequence):
            found.last_ns = max(found.last_ns, now_ns)
        else:  # a part that may itself be retried: remembered under its own name
            self._requests.append(
                _Remembered(
                    found.index, request.source, request.kind, request.sequence, None, now_ns, now_ns, found.parts
                )
            )
        return found.index

    def add(self, request: CaptureRequest, now_ns: int, index: int) -> None:
        """A new request became shot `index`."""
        self._note_instant(request, index)
        parts = {(request.kind, request.link): request.sequence}
        self._requests.append(
            _Remembered(index, request.source, request.kind, request.sequence, request.series, now_ns, now_ns, parts)
        )

    def refusal(self, request: CaptureRequest, now_ns: int) -> Finding | None:
        """Why this request was refused, where another message has brought it: of another kind, or over another link.
        None for a new one, and for a retry."""
        for known, reason in self._refused:
            if _belongs(known, request, now_ns):
                known.parts[request.kind, request.link] = request.sequence
                return reason
        return None

    def refuse(self, request: CaptureRequest, now_ns: int, reason: Finding) -> None:
        """A request was refused."""
        parts = {(request.kind, request.link): request.sequence}
        known = _Remembered(
            _NO_SHOT, request.source, request.kind, request.sequence, request.series, now_ns, now_ns, parts
        )
        self._refused.append((known, reason))

    def forget(self, request: CaptureRequest) -> None:
        """The next message like this is a new request."""
        self._requests = [known for known in self._requests if known.key() != _request_key(request)]

    def _note_instant(self, request: CaptureRequest, index: int) -> None:
        if request.time_us:
            self._instants[_instant(request)] = index
            if len(self._instants) > _REQUESTS_KEPT:
                del self._instants[next(iter(self._instants))]

    def _retry(self, request: CaptureRequest, now_ns: int) -> _Remembered | None:
        if not request.acknowledged and request.sequence is None and request.confirmation == 0:
            return None
        for known in reversed(self._requests):
            if known.key() != _request_key(request):
                continue
            if request.confirmation > 0:
                return known if now_ns - known.last_ns <= CONFIRMED_RETRY_NS else None
            recent = now_ns - known.last_ns <= RETRY_NS and now_ns - known.first_ns <= RETRY_LIMIT_NS
            return known if recent else None
        return None

    def _part(self, request: CaptureRequest, now_ns: int) -> _Remembered | None:
        if request.series is not None:
            return None
        return next((known for known in self._requests if _belongs(known, request, now_ns)), None)


def _belongs(known: _Remembered, request: CaptureRequest, now_ns: int) -> bool:
    """Whether a message is one more of a known request (rule 3)."""
    if (known.series, known.source) != (request.series, request.source) or now_ns - known.first_ns > TRIGGER_NS:
        return False
    if (request.kind, request.link) in known.parts:
        return False
    return all(sequence == request.sequence for (kind, _), sequence in known.parts.items() if kind == request.kind)


@dataclass(frozen=True, slots=True)
class _Unpaired:
    at_ns: int
    autopilot: bool
    index: int | None = None
    refused: Finding | None = None


class ForwardedRequests:
    """Ground stations' broadcasts and autopilots' requests of the last 0.25 s (at most 64) that have no partner yet:
    those that became a shot, and those that were refused."""

    def __init__(self) -> None:
        self._shots: deque[_Unpaired] = deque(maxlen=_UNPAIRED_KEPT)
        self._refused: deque[_Unpaired] = deque(maxlen=_UNPAIRED_KEPT)

    def partner(self, request: CaptureRequest, now_ns: int) -> int | None:
        """The image index of the shot that the other side's message got; None where there is none. It has its partner
        then. Times are monotonic."""
        found = _pair(self._shots, request, now_ns)
        return None if found is None else found.index

    def refusal(self, request: CaptureRequest, now_ns: int) -> Finding | None:
        """Why the other side's message was refused; None where none was. It has its partner then."""
        found = _pair(self._refused, request, now_ns)
        return None if found is None else found.refused

    def refuse(self, request: CaptureRequest, now_ns: int, reason: Finding) -> None:
        """A request was refused; so is its partner, which is not counted."""
        if request.autopilot or request.broadcast:
            self._refused.append(_Unpaired(now_ns, request.autopilot, refused=reason))

    def add(self, request: CaptureRequest, now_ns: int, index: int) -> None:
        """A request that belongs to shot `index` may have a partner that comes later."""
        if request.autopilot or request.broadcast:
            self._shots.append(_Unpaired(now_ns, request.autopilot, index))


def _pair(waiting: deque[_Unpaired], request: CaptureRequest, now_ns: int) -> _Unpaired | None:
    """Take the oldest message of the other side; older ones than the window are forgotten."""
    while waiting and now_ns - waiting[0].at_ns > FORWARDED_NS:
        waiting.popleft()
    if not (request.autopilot or request.broadcast):
        return None
    found = next((one for one in waiting if one.autopilot != request.autopilot), None)
    if found is not None:
        waiting.remove(found)
    return found


class PacketDedup:
    """Packets of the last seconds (at most 1024), by sender, sequence number, message and payload.

    What a link adds (version, signature) doesn't count. The window of one link is short because the sequence number has
    one byte: on a busy link it soon starts again.
    """

    def __init__(self) -> None:
        self._seen: dict[_PacketKey, dict[int, int]] = {}  # when it last arrived on each link; the oldest packet first

    def is_duplicate(self, packet: Packet, now_ns: int) -> bool:
        """Whether this packet was received before; remembers it. Times are monotonic."""
        while self._seen:
            oldest = next(iter(self._seen))
            if now_ns - max(self._seen[oldest].values()) <= OTHER_LINK_NS and len(self._seen) < _PACKETS_KEPT:
                break
            del self._seen[oldest]
        key = _packet_key(packet)
        arrived = self._seen.pop(key, {})
        known = any(
            now_ns - at_ns <= (SAME_LINK_NS if link == packet.link else OTHER_LINK_NS)
            for link, at_ns in arrived.items()
        )
        self._seen[key] = arrived | {packet.link: now_ns}
        return known


@dataclass(slots=True)
class _Sent:
    at_ns: int
    echoes: set[tuple[str, int]] = field(default_factory=set)


class AutopilotCommands:
    """Commands of ours to the autopilot in the last two seconds, and their echoes. Times are monotonic."""

    def __init__(self) -> None:
        self.numbers: set[int] = set()
        self._sent: deque[_Sent] = deque(maxlen=_COMMANDS_KEPT)

    def sent(self, command: int, now_ns: int) -> None:
        """A command was sent to the autopilot."""
        self.numbers.add(command)
        self._sent.append(_Sent(now_ns))

    def is_echo(self, kind: str, link: int, now_ns: int) -> bool:
        """Whether a message of this kind from our autopilot is an echo: of the oldest command that has none yet."""
        for command in list(self._sent):
            if now_ns - command.at_ns <= ECHO_NS and (kind, link) not in command.echoes:
                command.echoes.add((kind, link))
                return True
        return False


def _packet_key(packet: Packet) -> _PacketKey:
    message = packet.message
    seq, payload = Framed(packet.raw, message).numbered()
    return message.get_srcSystem(), message.get_srcComponent(), seq, message.get_msgId(), payload


def _instant(request: CaptureRequest) -> tuple[str, str, int | None, int]:
    return request.source, request.kind, request.sequence, request.time_us


def _request_key(request: CaptureRequest) -> _RequestKey:
    return request.source, request.kind, request.sequence, request.series
