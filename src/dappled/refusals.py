"""Log refusals of peers at a limited rate: each peer and reason once at first, then as a count for each interval."""

from __future__ import annotations

import logging
import threading
from dataclasses import dataclass

from dappled.clock import Clock, SystemClock

INTERVAL_S = 60.0
PEERS = 20  # for each reason; all further ones are logged as one
_OTHERS = "other peers"


@dataclass(slots=True)
class _Repeated:
    since_ns: int
    more: int = 0


class RefusalLog:
    """Writes the warnings. A peer is whatever the reader can find it by: an address, a link, a ground station.

    `refused` may be called from any thread. `settle` writes the counts whose interval is over: the owner calls it from
    a loop, so that the end of a flood is logged too.
    """

    def __init__(self, log: logging.Logger, clock: Clock | None = None) -> None:
        self._log, self._clock = log, clock or SystemClock()
        self._lock = threading.Lock()
        self._repeated: dict[tuple[str, str], _Repeated] = {}

    def refused(self, peer: str, reason: str, count: int = 1) -> None:
        """Log one refusal, or `count` of them; `reason` is a sentence without a full stop."""
        self.settle()
        now_ns = self._clock.monotonic_ns()
        with self._lock:
            known = self._repeated.get((peer, reason))
            if known is None and sum(why == reason for _, why in self._repeated) >= PEERS:
                peer = _OTHERS
                known = self._repeated.get((peer, reason))
            if known is not None:
                known.more += count
                return
            self._repeated[peer, reason] = _Repeated(now_ns)
        times = "" if count == 1 else f" {count} times"
        self._log.warning("%s: refused%s: %s", peer, times, reason)

    def settle(self) -> None:
        """Log how many more there were, where the interval is over; forget those that came no more."""
        now_ns = self._clock.monotonic_ns()
        lines = []
        with self._lock:
            for (peer, reason), known in list(self._repeated.items()):
                if now_ns - known.since_ns < INTERVAL_S * 1e9:
                    continue
                if known.more:
                    lines.append((peer, known.more, (now_ns - known.since_ns) / 1e9, reason))
                    self._repeated[peer, reason] = _Repeated(now_ns)
                else:
                    del self._repeated[peer, reason]
        for peer, more, seconds, reason in lines:
            self._log.warning("%s: refused %d more times in %.0f s: %s", peer, more, seconds, reason)
