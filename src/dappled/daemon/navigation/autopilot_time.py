"""Know the autopilot's clock against ours: one piecewise map, each piece begun by a reboot or a step."""

from __future__ import annotations

import math
from bisect import bisect_left
from collections import deque
from collections.abc import Callable, Sequence
from dataclasses import replace

from dappled.daemon.navigation import samples as telemetry_samples
from dappled.daemon.navigation.autopilot_utc import AutopilotUtc
from dappled.daemon.navigation.clocks import (
    BootClock,
    TimesyncAnswer,
    from_arrivals,
    from_few,
    from_timesync,
    stepped_since,
)
from dappled.daemon.navigation.samples import Epoch, Sample, between, latest, prune
from dappled.drivers.mavlink import MavlinkMessage
from dappled.findings import FRAME, Code, finding

TIMESYNC_WINDOW_NS, ARRIVAL_WINDOW_NS = 120 * 10**9, 60 * 10**9
REBOOT_BACK_NS, REBOOT_CONFIRM_NS = 2 * 10**9, 500_000_000
UNSTEADY_NS = 10 * 10**9  # two steps within this time: the clock does not run steadily
MOST_BOOT_NS = 2**62  # differences of such times fit 64 bits
_REQUESTS_KEPT = 64
_KNOWN_NS = 500_000_000  # a clock at another rate steps sooner, by what the answers can tell
_TOLD_NS = 20_000_000  # a step that doesn't matter to a frame: σ contains it
_ANSWERS_COME_NS = 10**9
_SILENT_NS = 10 * 10**9  # an autopilot that has answered within this time shows its steps by its answers
_LOOKED_AT = 64  # answers: more than come in the ten seconds that `stepped_since` looks back
_FEW = 3
_FitKey = tuple[str | int, ...]  # what a fit was made from: its kind, the epoch's first packet, the last packets


class AutopilotTime:
    """The autopilot's reboots and the steps of its clock, its answers to TIMESYNC, and what it says of UTC.

    Each reboot and each step begins an epoch. An instant is placed by the answers and samples of its own epoch.

    `component_id` is our own: a TIMESYNC request from it whose `ts1` is our UTC is ours, and an answer with the same
    `ts1` answers it; all others belong to other programs.

    The clock depends only on the packets below a limit. The last fit is kept, so asking again costs nothing while no
    better observation has arrived.
    """

    def __init__(self, component_id: int) -> None:
        self._component_id = component_id
        self._answers: list[TimesyncAnswer] = []
        self._requests: dict[int, int] = {}
        self._epochs = [Epoch(0, 0, 0)]
        self._arrivals = telemetry_samples.ArrivalSteps()
        self._back_since_ns: int | None = None
        self._fitted: tuple[_FitKey | None, BootClock | None] = (None, None)
        self.now_boot_ns: int | None = None
        self.unix_minus_boot_ns: int | None = None  # as the autopilot has it, for other messages with its UTC
        self._unix: deque[tuple[int, int]] = deque(maxlen=8)  # when it came, and what `unix_minus_boot_ns` was then
        self.utc = AutopilotUtc()
        self.reboots = 0

    def believe(self, number: int, stamp_ns: int, boot_ns: int) -> bool:
        """Whether a packet's time since boot is plausible.

        A reboot is a time more than 2 s behind for half a second without a packet to the contrary; a late packet on a
        slow second link is not a reboot.
        """
        if self.now_boot_ns is not None and boot_ns < self.now_boot_ns - REBOOT_BACK_NS:
            if self._back_since_ns is None:
                self._back_since_ns = stamp_ns
            if stamp_ns - self._back_since_ns < REBOOT_CONFIRM_NS:
                return False
            self._epochs.append(Epoch(number, self._back_since_ns, self._back_since_ns))
            self.reboots += 1
            self._requests.clear()
            self._arrivals.forget()
            self.unix_minus_boot_ns = None
            self._unix.clear()
            self.utc = AutopilotUtc()
            self.now_boot_ns = boot_ns
        self._back_since_ns = None
        self.now_boot_ns = boot_ns if self.now_boot_ns is None else max(self.now_boot_ns, boot_ns)
        if not (self._answers and stamp_ns - self._answers[-1].stamp_ns < _SILENT_NS):
            before_ns = self._arrivals.last_ns
            by_ns = self._arrivals.sooner_ns(stamp_ns, boot_ns)
            if by_ns is not None:
                self._step(Epoch(number, before_ns, stamp_ns, -by_ns), -by_ns)
        return True

    def _step(self, epoch: Epoch, by_ns: int, uncertain_ns: int = 0) -> None:
        """Begin an epoch. The autopilot's UTC didn't step with its clock: SYSTEM_TIME says so a second later, and until
        then the step does, as far as it is known."""
        self._epochs.append(epoch)
        old_ns = next((offset for stamp_ns, offset in reversed(self._unix) if stamp_ns <= epoch.before_ns), None)
        now_ns = self.unix_minus_boot_ns
        if old_ns is not None and now_ns is not None and abs(now_ns - old_ns) < abs(by_ns) / 2:
            self.unix_minus_boot_ns = old_ns + by_ns if uncertain_ns < _TOLD_NS else None

    def first(self, limit: int) -> int:
        """The packet number at which the epoch began that was current below `limit`."""
        return self._epochs[self._place(limit)].number

    def boot_first(self, limit: int) -> int:
        """The packet number at which the boot began that was current below `limit`."""
        at = self._place(limit)
        while at > 0 and self._epochs[at].step_ns is not None:
            at -= 1
        return self._epochs[at].number

    def span(self, limit: int, utc_ns: int) -> tuple[int, int]:
        """The packets of an instant's epoch, as known below `limit`: from the first to before the second."""
        return self._packets_of(self._place(limit, utc_ns), limit)

    def _packets_of(self, at: int, limit: int) -> tuple[int, int]:
        """The packets below `limit` of one epoch: from the first to before the second."""
        return self._epochs[at].number, min([limit, *(one.number for one in self._epochs[at + 1 : at + 2])])

    def certain_ns(self, limit: int, utc_ns: int) -> int | None:
        """Until when the clock of an instant's epoch held for certain; None where it is the present one."""
        end = self._packets_of(self._place(limit, utc_ns), limit)[1]
        return next((one.before_ns for one in self._epochs if one.number == end < limit), None)

    def is_past(self, utc_ns: int) -> bool:
        """Whether an instant was before the present epoch: nothing that arrives can say more about it."""
        return utc_ns <= self._epochs[-1].before_ns

    def awaits_answer(self, utc_ns: int) -> bool:
        """Whether an answer to TIMESYNC from after an instant is still to come, which may show a step before it."""
        last_ns = next((one.stamp_ns for one in reversed(self._answers[-_LOOKED_AT:]) if not one.held), 0)
        return last_ns < utc_ns <= last_ns + _ANSWERS_COME_NS

    @property
    def heard_ns(self) -> int:
        """When the last message came that shows how the clock runs; 0: none did."""
        return max(self._answers[-1].stamp_ns if self._answers else 0, self._arrivals.last_ns)

    def last_step(self) -> Epoch | None:
        """The last step of the clock that is remembered."""
        return next((one for one in reversed(self._epochs) if one.step_ns is not None), None)

    def is_unsteady(self) -> bool:
        """Whether the clock has stepped again and again until now."""
        last = self.last_step()
        return last is not None and len(self._steps_near(last.since_ns, len(self._epochs))) > 1

    def _place(self, limit: int, utc_ns: int | None = None) -> int:
        """Which epoch: the last one below `limit`, or that of an instant; between two, where either may be right, the
        later one."""
        at = max(0, bisect_left(self._epochs, limit, key=lambda one: one.number) - 1)
        while utc_ns is not None and at > 0 and utc_ns <= self._epochs[at].before_ns:
            at -= 1
        return at

    def _steps_near(self, utc_ns: int, end: int) -> list[int]:
        """The sizes of the steps around an instant, among the first `end` epochs."""
        return [
            abs(one.step_ns)
            for one in self._epochs[:end]
            if one.step_ns is not None and abs(one.since_ns - utc_ns) <= UNSTEADY_NS
        ]

    def system_time(self, stamp_ns: int, message: MavlinkMessage) -> bool:
        """Take a SYSTEM_TIME of the autopilot. Whether its date can't be true."""
        if message.time_unix_usec <= telemetry_samples.EPOCH_US or message.time_boot_ms <= 0:
            return False
        unix_ns, boot_ns = message.time_unix_usec * 1000, message.time_boot_ms * 10**6 + telemetry_samples.HALF_MS_NS
        self.unix_minus_boot_ns = unix_ns - boot_ns
        self._unix.append((stamp_ns, unix_ns - boot_ns))
        return not self.utc.take(unix_ns, boot_ns, stamp_ns)

    def timesync(self, number: int, stamp_ns: int, message: MavlinkMessage, *, from_autopilot: bool) -> bool:
        """Take a TIMESYNC, request or answer. Whether it is an answer to us that can't be true."""
        if message.tc1 == 0:
            if message.get_srcComponent() == self._component_id and 0 <= stamp_ns - message.ts1 < 10**9:
                self._requests[message.ts1] = stamp_ns
                if len(self._requests) > _REQUESTS_KEPT:
                    self._requests.pop(next(iter(self._requests)))
            return False
        if message.ts1 not in self._requests or not from_autopilot:
            return False
        answer = TimesyncAnswer(number, message.ts1, stamp_ns, message.tc1)
        if answer.delay_ns < 0 or not 0 < message.tc1 < MOST_BOOT_NS:
            return True
        if self.now_boot_ns is not None and message.tc1 < self.now_boot_ns - REBOOT_BACK_NS:
            return False  # from before or after a reboot that the telemetry has yet to show
        del self._requests[message.ts1]  # the same answer on a second link is not a second observation
        known = between(self._answers[-_LOOKED_AT:], self._epochs[-1].number, number)
        old = stepped_since(known, answer)
        if old is not None:
            by_ns = answer.offset_ns - old.offset_ns
            self._step(Epoch(number, old.stamp_ns, stamp_ns, by_ns), by_ns, (old.delay_ns + answer.delay_ns) // 2)
        self._answers.append(answer)
        return False

    def clock(self, limit: int, histories: Sequence[Sequence[Sample]], utc_ns: int | None = None) -> BootClock | None:
        """The autopilot's clock against ours at an instant (now), from the packets below `limit`; None while unknown.

        By TIMESYNC where there are answers, else by when the samples of `histories` arrived. Where it isn't known
        whether an instant is before or after a step, sigma contains the step, and where the clock steps again and again
        between few answers, the largest of these steps. It says so where that matters.
        """
        at = self._place(limit, utc_ns)
        found = self._epoch_clock(at, limit, histories)
        epoch = self._epochs[at]
        if found is None or utc_ns is None:
            return found
        near = self._steps_near(utc_ns, self._place(limit) + 1)
        inside = at > 0 and epoch.step_ns is not None and utc_ns < epoch.since_ns
        answers = between(self._answers, *self._packets_of(at, limit))
        known = len(answers) >= _FEW and answers[-1].stamp_ns - answers[0].stamp_ns >= _KNOWN_NS
        unsteady = len(near) > 1 and not known
        if not (inside or unsteady):
            return found
        widest_ns = max([abs(epoch.step_ns or 0)] * inside + near * unsteady)
        told = finding(Code.CLOCK_STEPPED, FRAME, steps=max(1, len(near)), by_s=widest_ns / 1e9)
        stepped = told if unsteady or widest_ns >= _TOLD_NS else None
        return replace(found, sigma_ns=math.hypot(found.sigma_ns, widest_ns), stepped=stepped)

    def _epoch_clock(self, at: int, limit: int, histories: Sequence[Sequence[Sample]]) -> BootClock | None:
        """The clock by the packets of one epoch alone."""
        first, limit = self._packets_of(at, limit)
        answers = between(self._answers, first, limit)
        if answers:
            few = len(answers) < _FEW and self._epochs[at].step_ns is not None
            by_timesync: _FitKey = ("timesync", first, answers[-1].number)
            clock = self._fit(
                by_timesync, lambda: from_few(answers) if few else from_timesync(latest(answers, TIMESYNC_WINDOW_NS))
            )
            if clock is not None:
                return clock
        tails = [latest(between(one, first, limit), ARRIVAL_WINDOW_NS) for one in histories]
        key: _FitKey = ("arrival", first, *(tail[-1].number for tail in tails if tail))
        return self._fit(key, lambda: from_arrivals([(one.boot_ns, one.stamp_ns) for tail in tails for one in tail]))

    def _fit(self, key: _FitKey, make: Callable[[], BootClock | None]) -> BootClock | None:
        if self._fitted[0] != key:
            self._fitted = (key, make())
        return self._fitted[1]

    def last_fit(self, limit: int) -> BootClock | None:
        """The clock as it was last fitted, perhaps from older packets of this boot: a hint that costs nothing."""
        key, fitted = self._fitted
        return fitted if key is not None and key[1] == self.first(limit) else None

    def prune(self, before_ns: int) -> None:
        """Forget what came before."""
        prune(self._answers, before_ns)
        del self._epochs[: max(0, bisect_left(self._epochs, before_ns, key=lambda one: one.since_ns) - 1)]
