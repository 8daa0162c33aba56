"""Which messages are the same wish. The rules, with their numbers; a wish that none of them matches is a new one.

1. Retry. The same source, kind and sequence within 1.2 s of the last such message, and within 2.4 s of the first, is
   a retry of it. With `confirmation` above 0 (the sender says itself that it repeats) 10 s instead of both. Holds for
   messages that are acknowledged (their sender repeats when it misses the answer) or that carry a sequence.
2. One trigger, several messages. PX4 says CAMERA_TRIGGER, IMAGE_START_CAPTURE and DO_DIGICAM_CONTROL for one
   trigger, and a vehicle on two links says each of them twice. Within 0.3 s of a shot's first message, a message of
   the same source belongs to that shot if the shot has none of this kind from this link yet, and none of this kind
   with another sequence; the oldest such shot takes it.
3. A series (an interval, a step of the zoom) is another wish than a single shot and than a series with other numbers:
   only a retry in all its numbers is the same, and nothing else belongs to its first shot.

So a second press with the same sequence (most ground stations: always 0) inside 1.2 s is lost; and triggers from one
source less than 0.3 s apart may be joined if some of their messages were lost on the way.
"""

from __future__ import annotations

from dataclasses import dataclass

RETRY_NS = 1_200_000_000
RETRY_LIMIT_NS = 2_400_000_000
CONFIRMED_RETRY_NS = 10 * 10**9
TRIGGER_NS = 300_000_000
_REMEMBERED = 256
_Key = tuple[str, str, int | None, tuple[float, ...] | None]


@dataclass(frozen=True, slots=True)
class CaptureRequest:
    """Somebody wants a shot: one message, or one act.

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

    def key(self) -> _Key:
        return self.source, self.kind, self.sequence, self.series


class Recent:
    """The wishes of the last ten seconds (at most 256), and the image index that each one got."""

    def __init__(self) -> None:
        self._requests: list[_Remembered] = []

    def same(self, request: CaptureRequest, now_ns: int) -> int | None:
        """The image index of the shot that this wish already has; None for a new wish. Times are monotonic."""
        self._requests = [w for w in self._requests if now_ns - w.last_ns <= CONFIRMED_RETRY_NS][-_REMEMBERED:]
        found = self._retry(request, now_ns) or self._part(request, now_ns)
        if found is None:
            return None
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
        """A new wish became shot `index`."""
        parts = {(request.kind, request.link): request.sequence}
        self._requests.append(
            _Remembered(index, request.source, request.kind, request.sequence, request.series, now_ns, now_ns, parts)
        )

    def forget(self, request: CaptureRequest) -> None:
        """The next message like it is a new wish."""
        self._requests = [known for known in self._requests if known.key() != _key(request)]

    def _retry(self, request: CaptureRequest, now_ns: int) -> _Remembered | None:
        if not request.acknowledged and request.sequence is None:
            return None
        for known in reversed(self._requests):
            if known.key() != _key(request):
                continue
            if request.confirmation > 0:
                return known if now_ns - known.last_ns <= CONFIRMED_RETRY_NS else None
            recent = now_ns - known.last_ns <= RETRY_NS and now_ns - known.first_ns <= RETRY_LIMIT_NS
            return known if recent else None
        return None

    def _part(self, request: CaptureRequest, now_ns: int) -> _Remembered | None:
        if request.series is not None:
            return None
        for known in self._requests:
            if known.series is not None or known.source != request.source or now_ns - known.first_ns > TRIGGER_NS:
                continue
            if (request.kind, request.link) in known.parts:
                continue
            if all(sequence == request.sequence for (kind, _), sequence in known.parts.items() if kind == request.kind):
                return known
        return None


def _key(request: CaptureRequest) -> _Key:
    return request.source, request.kind, request.sequence, request.series
