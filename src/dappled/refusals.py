"""Count refusals of peers: each peer and reason is said once at first, then as a count for each interval."""

from __future__ import annotations

import logging
import re
import threading
from dataclasses import dataclass
from typing import Self

from dappled.clock import Clock, SystemClock
from dappled.errors import without_numbers

INTERVAL_S = 60.0
PEERS = 20  # for each reason; all further ones count as one
OTHERS = "other peers"
_TEXT = re.compile(
    r"(?P<peer>.+?)(?:, (?P<count>\d{1,18}) (?:times|more times in (?P<seconds>\d+) s))?: (?P<reason>.*)", re.DOTALL
)


@dataclass(frozen=True, slots=True)
class Refusals:
    """Refusals of one peer for one reason: the first (`seconds` is None), or how many more came in so many seconds.

    >>> Refusals("console from console", "no camera", 512, 60.0).text()
    'console from console, 512 more times in 60 s: no camera'
    """

    peer: str
    reason: str
    count: int
    seconds: float | None = None

    def text(self) -> str:
        """As an event of the ledger holds it."""
        first = "" if self.count == 1 else f", {self.count} times"
        times = first if self.seconds is None else f", {self.count} more times in {self.seconds:.0f} s"
        return f"{self.peer}{times}: {self.reason}"

    @classmethod
    def of_text(cls, text: str) -> Self | None:
        """What such an event counts; None for another text."""
        found = _TEXT.fullmatch(text)
        if found is None:
            return None
        seconds = None if found["seconds"] is None else float(found["seconds"])
        return cls(found["peer"], found["reason"], int(found["count"] or 1), seconds)


_LOST = re.compile(r"triggers? (?P<first>\d{1,10})(?: to (?P<last>\d{1,10}))? (?P<where>.*)", re.DOTALL)


@dataclass(frozen=True, slots=True)
class LostTriggers:
    """Triggers of the autopilot that became no shot, by its own numbers, the last included; `where` and when it was
    noticed.

    >>> LostTriggers(13, 15, "noticed at 10:15:03Z").text()
    'triggers 13 to 15 noticed at 10:15:03Z'
    """

    first: int
    last: int
    where: str

    @property
    def count(self) -> int:
        """How many."""
        return self.last - self.first + 1

    def text(self) -> str:
        """As an event of the ledger holds it."""
        numbers = f"trigger {self.first}" if self.first == self.last else f"triggers {self.first} to {self.last}"
        return f"{numbers} {self.where}"

    @classmethod
    def of_text(cls, text: str) -> Self | None:
        """What such an event says; None for another text."""
        found = _LOST.fullmatch(text)
        if found is None:
            return None
        return cls(int(found["first"]), int(found["last"] or found["first"]), found["where"])


@dataclass(slots=True)
class _Repeated:
    since_ns: int
    reason: str
    more: int = 0


class RefusalLog:
    """Writes the warnings. A peer is whatever the reader can find it by: an address, a link, a ground station. Reasons
    that differ in their numbers alone are one.

    `refused` may be called from any thread. `settle` writes the counts whose interval is over: the owner calls it from
    a loop, so that the end of a flood is logged too. Both return what was written.
    """

    def __init__(self, log: logging.Logger, clock: Clock | None = None) -> None:
        self._log, self._clock = log, clock or SystemClock()
        self._lock = threading.Lock()
        self._repeated: dict[tuple[str, str], _Repeated] = {}

    def refused(self, peer: str, reason: str, count: int = 1) -> list[Refusals]:
        """Log one refusal, or `count` of them; `reason` is a sentence without a full stop."""
        written = self.settle()
        now_ns = self._clock.monotonic_ns()
        kind = without_numbers(reason)
        with self._lock:
            known = self._repeated.get((peer, kind))
            if known is None and sum(why == kind for _, why in self._repeated) >= PEERS:
                peer = OTHERS
                known = self._repeated.get((peer, kind))
            if known is not None:
                known.more, known.reason = known.more + count, reason
                return written
            self._repeated[peer, kind] = _Repeated(now_ns, reason)
        times = "" if count == 1 else f" {count} times"
        self._log.warning("%s: refused%s: %s", peer, times, reason)
        return [*written, Refusals(peer, reason, count)]

    def settle(self, *, all_of_them: bool = False) -> list[Refusals]:
        """Log how many more there were, where the interval is over, or of `all_of_them`; forget those that came no
        more."""
        now_ns = self._clock.monotonic_ns()
        written = []
        with self._lock:
            for (peer, kind), known in list(self._repeated.items()):
                if not all_of_them and now_ns - known.since_ns < INTERVAL_S * 1e9:
                    continue
                if known.more:
                    written.append(Refusals(peer, known.reason, known.more, (now_ns - known.since_ns) / 1e9))
                    self._repeated[peer, kind] = _Repeated(now_ns, known.reason)
                else:
                    del self._repeated[peer, kind]
        for one in written:
            self._log.warning("%s: refused %d more times in %.0f s: %s", one.peer, one.count, one.seconds, one.reason)
        return written
