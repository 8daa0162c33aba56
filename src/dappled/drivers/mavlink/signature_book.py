"""Which signed packets were accepted with one key, over all links: each one is accepted once.

The timestamp of a packet must be later than the last one of its stream (system, component, link id) on the link that
brings it. What another link accepted within the last 2 s is a copy (one station on two links, an autopilot on two
ports) and no attack; a packet that a faster link overtook within 2 s, and did not bring, is accepted. A stream that is
heard for the first time may be at most a minute behind. Timestamps are in units of 10 µs since 2015.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field
from typing import Literal, Protocol, TypeAlias

from dappled.findings import Code, Finding, Subject, finding

UNITS_PER_S = 100_000
NEW_STREAM_UNITS = 60 * UNITS_PER_S
COPY_NS = 2 * 10**9
Stream: TypeAlias = tuple[int, int, int]  # system, component, link id of the sender
Heard = Literal["new", "copy", "old"]
_STREAMS = 256
_TAKEN = 8192  # of a stream in 2 s; of more the oldest count as spent
_BEHIND_UNITS = 5 * UNITS_PER_S
_BEHIND_PACKETS = 3
_BEHIND_KEPT = 64


class SignedTimes(Protocol):
    """The part of `SigningTime` that is needed here."""

    def oldest(self) -> int:
        """Return the time that a stream heard for the first time must be later than."""

    def ahead(self, timestamp: int) -> int:
        """Return by how much a time is ahead of this machine's; 0 while that is not known, or by less than a minute."""

    def accepted(self, timestamp: int) -> None:
        """Take note of an accepted packet's timestamp."""

    def monotonic_ns(self) -> int:
        """The time of arrivals."""


@dataclass(slots=True)
class _Taken:
    signature: bytes
    at_ns: int
    links: set[int]


@dataclass(slots=True)
class _StreamTimes:
    """One stream: up to `spent` nothing is accepted any more; `taken` are those of the last 2 s, as they arrived."""

    spent: int
    last: int
    by_link: dict[int, int] = field(default_factory=dict)
    taken: dict[int, _Taken] = field(default_factory=dict)

    def forget(self, now_ns: int) -> None:
        while self.taken:
            first = next(iter(self.taken))
            if now_ns - self.taken[first].at_ns <= COPY_NS and len(self.taken) <= _TAKEN:
                return
            del self.taken[first]
            self.spent = max(self.spent, first)


@dataclass(slots=True)
class _Behind:
    """Rightly signed packets that were too old, each later than the one before."""

    packets: int
    latest: int
    units: int


class SignatureBook:
    """The streams of one key. Used under the links' lock; `streams` and `findings` by any thread. Times of arrival are
    monotonic."""

    def __init__(self, streams: Mapping[Stream, int]) -> None:
        """`streams`: the last timestamps that were accepted before a restart."""
        self._streams = {stream: _StreamTimes(last, last) for stream, last in streams.items()}
        self._forgotten = 0  # what was accepted of streams that had to be forgotten
        self._behind: dict[Stream, _Behind] = {}
        self._ahead: dict[Stream, int] = {}

    def judge(self, times: SignedTimes, stream: Stream, timestamp: int, signature: bytes, link: int) -> Heard:
        """Judge a rightly signed packet, and remember it where it is accepted."""
        now_ns = times.monotonic_ns()
        known = self._streams.pop(stream, None)
        if known is None:
            oldest = max(times.oldest(), self._forgotten)
            if timestamp <= oldest:
                self._note_behind(stream, timestamp, oldest + NEW_STREAM_UNITS)
                return "old"
            known = _StreamTimes(oldest, oldest)
            if len(self._streams) >= _STREAMS:
                self._forgotten = max(self._forgotten, self._streams.pop(next(iter(self._streams))).last)
        self._streams[stream] = known
        known.forget(now_ns)
        twin = known.taken.get(timestamp)
        if twin is not None and twin.signature == signature and link not in twin.links:
            twin.links.add(link)
            return "copy"
        if twin is not None or timestamp <= max(known.spent, known.by_link.get(link, 0)):
            self._note_behind(stream, timestamp, known.last)
            return "old"
        known.by_link[link], known.last = timestamp, max(known.last, timestamp)
        known.taken[timestamp] = _Taken(signature, now_ns, {link})
        self._note_accepted(times, stream, timestamp)
        return "new"

    def streams(self) -> dict[Stream, int]:
        """The last timestamp of each stream."""
        return {stream: one.last for stream, one in list(self._streams.items())}

    def findings(self) -> Iterator[Finding]:
        """Whose clock went back, is behind, or is ahead of this machine's."""
        for (system, component, _), one in list(self._behind.items()):
            if one.packets >= _BEHIND_PACKETS:
                yield finding(
                    Code.LINK_CLOCK_BEHIND, Subject("link", f"{system}/{component}"), off_s=one.units // UNITS_PER_S
                )
        for (system, component, _), units in list(self._ahead.items()):
            yield finding(Code.LINK_CLOCK_AHEAD, Subject("link", f"{system}/{component}"), off_s=units // UNITS_PER_S)

    def _note_accepted(self, times: SignedTimes, stream: Stream, timestamp: int) -> None:
        times.accepted(timestamp)
        self._behind.pop(stream, None)
        if ahead := times.ahead(timestamp):
            self._ahead[stream] = ahead
        else:
            self._ahead.pop(stream, None)

    def _note_behind(self, stream: Stream, timestamp: int, expected: int) -> None:
        """A packet that comes again shows nothing about a clock; those that follow each other do."""
        behind = expected - timestamp
        if behind <= _BEHIND_UNITS:
            return
        known = self._behind.pop(stream, None) or _Behind(0, 0, 0)
        if timestamp > known.latest:
            known = _Behind(known.packets + 1, timestamp, behind)
        self._behind[stream] = known
        if len(self._behind) > _BEHIND_KEPT:
            del self._behind[next(iter(self._behind))]
