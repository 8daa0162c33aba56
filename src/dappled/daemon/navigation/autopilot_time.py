"""The autopilot's time as its packets tell it: its reboots, its answers to TIMESYNC, and what it says of UTC."""

from __future__ import annotations

from bisect import bisect_left
from collections.abc import Callable, Sequence

from dappled.daemon.navigation import history
from dappled.daemon.navigation.boot_clock import Answer, BootClock, from_arrivals, from_timesync
from dappled.daemon.navigation.history import Sample
from dappled.daemon.navigation.hot_shoe import EPOCH_US
from dappled.daemon.navigation.samples import HALF_MS_NS
from dappled.drivers.mavlink.links import Message

TIMESYNC_WINDOW_NS = 120 * 10**9
ARRIVAL_WINDOW_NS = 60 * 10**9
REBOOT_BACK_NS = 2 * 10**9
REBOOT_CONFIRM_NS = 500_000_000
_REQUESTS_KEPT = 64
_BOOTS_KEPT = 8
_Key = tuple[str | int, ...]  # what a fit was made from: its kind, the boot's first packet, the last packets


class AutopilotTime:
    """Folds in what concerns time. `component_id` is our own: a TIMESYNC request from it whose `ts1` is our UTC is
    ours, and an answer that carries the same `ts1` is meant for us; all others are somebody else's.

    The clock is a function of the packets below a limit alone; the last one fitted is kept, so that asking again
    costs nothing while no better observation has come.
    """

    def __init__(self, component_id: int) -> None:
        self._component_id = component_id
        self._answers: list[Answer] = []
        self._requests: dict[int, int] = {}
        self._boots: list[int] = [0]  # packet numbers at which the autopilot's time began anew
        self._back_since_ns: int | None = None
        self._fitted: tuple[_Key | None, BootClock | None] = (None, None)
        self.now_boot_ns: int | None = None
        self.unix_minus_boot_ns: int | None = None
        self.answers_seen = self.reboots = 0

    def believe(self, number: int, stamp_ns: int, boot_ns: int) -> bool:
        """Whether a packet's time since boot is to be believed. A reboot is when time stood more than 2 s behind for
        half a second without a packet to the contrary: a late packet on a slow second link is none."""
        if self.now_boot_ns is not None and boot_ns < self.now_boot_ns - REBOOT_BACK_NS:
            if self._back_since_ns is None:
                self._back_since_ns = stamp_ns
            if stamp_ns - self._back_since_ns < REBOOT_CONFIRM_NS:
                return False
            self._boots.append(number)
            self.reboots += 1
            self._requests.clear()
            self.unix_minus_boot_ns = None
            self.now_boot_ns = boot_ns
        self._back_since_ns = None
        self.now_boot_ns = boot_ns if self.now_boot_ns is None else max(self.now_boot_ns, boot_ns)
        return True

    def first(self, limit: int) -> int:
        """The packet number at which the boot began that was current below `limit`."""
        return self._boots[max(0, bisect_left(self._boots, limit) - 1)]

    def system_time(self, message: Message) -> None:
        """A SYSTEM_TIME of the autopilot."""
        if message.time_unix_usec > EPOCH_US and message.time_boot_ms > 0:
            self.unix_minus_boot_ns = message.time_unix_usec * 1000 - (message.time_boot_ms * 10**6 + HALF_MS_NS)

    def timesync(self, number: int, stamp_ns: int, message: Message, *, from_autopilot: bool) -> None:
        """A TIMESYNC, either way."""
        if message.tc1 == 0:
            if message.get_srcComponent() == self._component_id and 0 <= stamp_ns - message.ts1 < 10**9:
                self._requests[message.ts1] = stamp_ns
                if len(self._requests) > _REQUESTS_KEPT:
                    self._requests.pop(next(iter(self._requests)))
            return
        if message.ts1 not in self._requests or not from_autopilot:
            return
        answer = Answer(number, message.ts1, stamp_ns, message.tc1)
        if answer.delay_ns < 0:
            return
        if self.now_boot_ns is not None and message.tc1 < self.now_boot_ns - REBOOT_BACK_NS:
            return  # from before or after a reboot that the telemetry has yet to show
        del self._requests[message.ts1]  # the same answer on a second link is no second observation
        self.answers_seen += 1
        self._answers.append(answer)

    def clock(self, limit: int, histories: Sequence[Sequence[Sample]]) -> BootClock | None:
        """The autopilot's clock against ours, from the packets below `limit`: by TIMESYNC, else by when the samples of
        `histories` arrived; None while unknown."""
        first = self.first(limit)
        answers = history.between(self._answers, first, limit)
        if answers:
            told: _Key = ("timesync", first, answers[-1].number)
            clock = self._fit(told, lambda: from_timesync(history.last(answers, TIMESYNC_WINDOW_NS)))
            if clock is not None:
                return clock
        tails = [history.last(history.between(one, first, limit), ARRIVAL_WINDOW_NS) for one in histories]
        key: _Key = ("arrival", first, *(tail[-1].number for tail in tails if tail))
        return self._fit(key, lambda: from_arrivals([(one.boot_ns, one.stamp_ns) for tail in tails for one in tail]))

    def _fit(self, key: _Key, make: Callable[[], BootClock | None]) -> BootClock | None:
        if self._fitted[0] != key:
            self._fitted = (key, make())
        return self._fitted[1]

    def lately(self, limit: int) -> BootClock | None:
        """The clock as it was last fitted, perhaps from older packets of this boot: a hint that costs nothing."""
        key, fitted = self._fitted
        return fitted if key is not None and key[1] == self.first(limit) else None

    def prune(self, before_ns: int) -> None:
        """Forget what came before."""
        history.prune(self._answers, before_ns)
        del self._boots[:-_BOOTS_KEPT]
