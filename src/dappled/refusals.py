"""Count refusals of peers: each peer and reason is said once at first, then as a count for each interval."""

from __future__ import annotations

import logging
import threading
from dataclasses import dataclass, replace

from dappled import findings
from dappled.clock import Clock, SystemClock
from dappled.findings import Code, Finding, Subject

INTERVAL_S = 60.0
SHOTS_INTERVAL_S = 3.0  # of refused shots, which are in the flight's books: a power cut takes what was only counted
SHOTS_BEHIND_S = 6.0
"""How far the flight's books may be behind refused shots. Counts are looked for each half second, and written by the
service's loop, which waits for the disk: a second was too little for that beside other programs."""
PEERS = 20  # for each reason; all further ones count as one
OTHERS = "other peers"


@dataclass(slots=True)
class _Repeated:
    since_ns: int
    last: Finding
    more: int = 0


class RefusalLog:
    """Writes the warnings. A finding's subject is whom the reader can find it by: an address, a link, a ground station.

    `refused` may be called from any thread. `settle` writes the counts whose interval is over: the owner calls it from
    a loop, so that the end of a flood is logged too. Both return what was written: the reason, whose facts have the
    number of `times`, and within how many seconds (`within_s`; none for the first).
    """

    def __init__(self, log: logging.Logger, clock: Clock | None = None, interval_s: float = INTERVAL_S) -> None:
        self._log, self._clock, self._interval_s = log, clock or SystemClock(), interval_s
        self._lock = threading.Lock()
        self._repeated: dict[tuple[Code, Subject], _Repeated] = {}

    def refused(self, why: Finding, times: int = 1) -> list[Finding]:
        """Log one refusal, or several."""
        written = self.settle()
        now_ns = self._clock.monotonic_ns()
        with self._lock:
            known = self._repeated.get(why.kind)
            if known is None and sum(code == why.code for code, _ in self._repeated) >= PEERS:
                why = replace(why, subject=Subject(why.subject.kind, OTHERS))
                known = self._repeated.get(why.kind)
            if known is not None:
                known.more, known.last = known.more + times, why
                return written
            self._repeated[why.kind] = _Repeated(now_ns, why)
        said = "" if times == 1 else f" {times} times"
        self._log.warning("%s: refused%s: %s", why.subject.which, said, findings.text(why))
        return [*written, why.with_facts(times=times)]

    def settle(self, *, all_of_them: bool = False) -> list[Finding]:
        """Log how many more there were, where the interval is over, or of `all_of_them`; forget those that came no
        more."""
        now_ns = self._clock.monotonic_ns()
        written = []
        with self._lock:
            for kind, known in list(self._repeated.items()):
                within_s = (now_ns - known.since_ns) / 1e9
                if not all_of_them and within_s < self._interval_s:
                    continue
                if known.more:
                    written.append(known.last.with_facts(times=known.more, within_s=within_s))
                    self._repeated[kind] = _Repeated(now_ns, known.last)
                else:
                    del self._repeated[kind]
        for one in written:
            said = one.subject.which, one.facts["times"], one.facts["within_s"], findings.text(one)
            self._log.warning("%s: refused %d more times in %.0f s: %s", *said)
        return written
