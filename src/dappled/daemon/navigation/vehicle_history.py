"""Collect the telemetry of one vehicle, packet by packet: samples, the autopilot's time, the gimbal.

The state is a fold over packets (number, stamp, message), so a replay that feeds the same packets has the same state.
"""

from __future__ import annotations

import math
from bisect import bisect_left
from collections.abc import Callable, Sequence
from dataclasses import replace
from itertools import pairwise
from typing import Any, Generic, TypeVar

from dappled.daemon.navigation import samples as telemetry_samples
from dappled.daemon.navigation.autopilot_utc import AutopilotUtc
from dappled.daemon.navigation.clocks import (
    BootClock,
    TimesyncAnswer,
    from_arrivals,
    from_few,
    from_timesync,
    step_ns,
)
from dappled.daemon.navigation.excerpts import around_instant, beside, between, latest
from dappled.daemon.navigation.ground_height import ground_sample
from dappled.daemon.navigation.jumps import JumpFinder, ReceiverTrack
from dappled.daemon.navigation.samples import (
    NEAREST_NS,
    Around,
    AttitudeSample,
    Counts,
    Epoch,
    Feedback,
    GimbalSample,
    GnssSample,
    GroundSample,
    Jump,
    PositionSample,
    Sample,
    keep,
    prune,
)
from dappled.decode.geometry import norm
from dappled.drivers.mavlink import MavlinkMessage
from dappled.drivers.mavlink.sample_judge import (
    OF_ATTITUDES,
    OF_PLACES,
    OF_VELOCITIES,
    Motion,
    Track,
    Tracks,
    point_m,
    turned,
)
from dappled.findings import FRAME, Code, finding

POSITION_GAP_NS, ATTITUDE_GAP_NS, GIMBAL_GAP_NS = 2_500_000_000, 1_500_000_000, 1_500_000_000
TIMESYNC_WINDOW_NS, ARRIVAL_WINDOW_NS = 120 * 10**9, 60 * 10**9
REBOOT_BACK_NS, REBOOT_CONFIRM_NS = 2 * 10**9, 500_000_000
_REQUESTS_KEPT = _REPEATS = 64
_UNSTEADY_NS = 10 * 10**9  # two steps within this time: the clock does not run steadily
_TOGETHER_NS = 200_000_000
_PART_NS, _FAST = 2 * 10**9, 0.2
_ALIVE_NS, _ANSWERS_COME_NS = 5 * 10**9, 10**9
_SILENT_NS = 10 * 10**9  # an autopilot that has answered within this time shows its steps by its answers
_LOOKED_AT = 64  # answers: more than come in the ten seconds that `step_ns` looks back
_MOST_BOOT_NS = 2**62  # differences of such times fit 64 bits
_FEW, _AUTOPILOT, _FIX_3D = 3, 1, 3
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
            self.utc = AutopilotUtc()
            self.now_boot_ns = boot_ns
        self._back_since_ns = None
        self.now_boot_ns = boot_ns if self.now_boot_ns is None else max(self.now_boot_ns, boot_ns)
        if not (self._answers and stamp_ns - self._answers[-1].stamp_ns < _SILENT_NS):
            before_ns = self._arrivals.last_ns
            by_ns = self._arrivals.sooner_ns(stamp_ns, boot_ns)
            if by_ns is not None:
                self._epochs.append(Epoch(number, before_ns, stamp_ns, -by_ns))
        return True

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

    def is_past(self, utc_ns: int) -> bool:
        """Whether an instant was before the present epoch: nothing that arrives can say more about it."""
        return utc_ns <= self._epochs[-1].before_ns

    def awaits_answer(self, utc_ns: int) -> bool:
        """Whether an answer to TIMESYNC from after an instant is still to come, which may show a step before it."""
        last_ns = self._answers[-1].stamp_ns if self._answers else 0
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
            if one.step_ns is not None and abs(one.since_ns - utc_ns) <= _UNSTEADY_NS
        ]

    def system_time(self, stamp_ns: int, message: MavlinkMessage) -> bool:
        """Take a SYSTEM_TIME of the autopilot. Whether its date can't be true."""
        if message.time_unix_usec <= telemetry_samples.EPOCH_US or message.time_boot_ms <= 0:
            return False
        unix_ns, boot_ns = message.time_unix_usec * 1000, message.time_boot_ms * 10**6 + telemetry_samples.HALF_MS_NS
        self.unix_minus_boot_ns = unix_ns - boot_ns
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
        if answer.delay_ns < 0 or not 0 < message.tc1 < _MOST_BOOT_NS:
            return True
        if self.now_boot_ns is not None and message.tc1 < self.now_boot_ns - REBOOT_BACK_NS:
            return False  # from before or after a reboot that the telemetry has yet to show
        del self._requests[message.ts1]  # the same answer on a second link is not a second observation
        known = between(self._answers[-_LOOKED_AT:], self._epochs[-1].number, number)
        by_ns = step_ns(known, answer)
        if by_ns is not None:
            self._epochs.append(Epoch(number, known[-1].stamp_ns, stamp_ns, by_ns))
        self._answers.append(answer)
        return False

    def clock(self, limit: int, histories: Sequence[Sequence[Sample]], utc_ns: int | None = None) -> BootClock | None:
        """The autopilot's clock against ours at an instant (now), from the packets below `limit`; None while unknown.

        By TIMESYNC where there are answers, else by when the samples of `histories` arrived. Next to a step, and while
        the clock steps again and again, its sigma contains the largest step, and it says so.
        """
        at = self._place(limit, utc_ns)
        found = self._epoch_clock(at, limit, histories)
        epoch = self._epochs[at]
        if found is None or utc_ns is None:
            return found
        near = self._steps_near(utc_ns, self._place(limit) + 1)
        between = at > 0 and epoch.step_ns is not None and utc_ns < epoch.since_ns
        if not between and len(near) < 2:
            return found
        widest_ns = max([*near, abs(epoch.step_ns or 0) if between else 0])
        stepped = finding(Code.CLOCK_STEPPED, FRAME, steps=max(1, len(near)), by_s=widest_ns / 1e9)
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


class Gimbals:
    """Attitudes of the first gimbal heard."""

    def __init__(self) -> None:
        self._samples: list[GimbalSample] = []
        self.seen = 0

    def feed(self, number: int, stamp_ns: int, message: MavlinkMessage) -> None:
        """Take a packet of the vehicle's system."""
        sample = telemetry_samples.next_gimbal(self._samples[-1] if self._samples else None, number, stamp_ns, message)
        if sample is not None:
            self.seen += 1
            keep(self._samples, sample)

    def around(self, utc_ns: int, boot_ns: int, first: int, limit: int) -> tuple[tuple[GimbalSample, ...], int]:
        """The samples around an instant from the packets below `limit`, and the instant on the gimbal's clock.

        `boot_ns` is the instant on the autopilot's clock, which began at packet `first`. A gimbal's clock need not be
        the autopilot's.
        """
        known = between(self._samples, 0, limit)
        if not known:
            return (), boot_ns
        if known[-1].component == _AUTOPILOT:
            known = between(known, first, limit)
        samples = [sample for sample in known if sample.epoch == known[-1].epoch]
        if samples and samples[0].component != _AUTOPILOT:
            arrivals = [(one.boot_ns, one.stamp_ns) for one in latest(samples, ARRIVAL_WINDOW_NS)]
            clock = from_arrivals(arrivals)
            assert clock is not None
            boot_ns = clock.boot_ns(utc_ns)
        return around_instant(samples, boot_ns, gap_ns=GIMBAL_GAP_NS), boot_ns

    def prune(self, before_ns: int) -> None:
        """Forget what came before."""
        prune(self._samples, before_ns)


M = TypeVar("M", PositionSample, AttitudeSample)


class Steady(Generic[M]):
    """Holds back samples that leave those before them faster than any vehicle, until their track is certain.

    They count from the packet that makes it so: a pose depends on the packets below its limit alone.
    """

    def __init__(self, counts: Counts, *motions: Motion) -> None:
        self._counts, self._motions = counts, motions
        self._tracks, self._first = Tracks(*motions), -1
        self._begun: Track | None = None
        self._held: dict[Track, list[M]] = {}

    def take(self, sample: M, values: Sequence[Sequence[float]], first: int) -> list[M]:
        """The samples that count now, in order. `first` is the first packet of this epoch of the autopilot's clock."""
        if first != self._first:
            self._tracks, self._first, self._begun, self._held = Tracks(*self._motions), first, None, {}
        track = self._tracks.of(sample.boot_ns / 1e9, values)
        self._begun = self._begun or track
        if not (track is self._begun or track.certain):
            self._held.setdefault(track, []).append(sample)
            self._counts.refuse(sample.stamp_ns)
            return []
        held: list[M] = self._held.pop(track, [])
        self._counts.impossible -= len(held)
        self._held = {other: row for other, row in self._held.items() if other.last_s >= track.since_s}
        held.append(sample)
        return [replace(one, number=sample.number) for one in held]


class VehicleHistory:
    """Samples of position, attitude, receiver, gimbal and hot shoe of one vehicle.

    `system_id` is the vehicle's, and its autopilot is component 1. `component_id` is our own (see
    AutopilotTime), `cam_idx` our camera's number at the autopilot. Not thread-safe.
    """

    def __init__(
        self,
        system_id: int,
        component_id: int,
        counts: Counts,
        *,
        cam_idx: int = 0,
    ) -> None:
        self.system_id, self.counts, self._cam_idx = system_id, counts, cam_idx
        self.time = AutopilotTime(component_id)
        self.gimbals = Gimbals()
        self._positions: list[PositionSample] = []
        self._finder, self._receiver_track, self._jumps = JumpFinder(), ReceiverTrack(), list[Jump]()
        self._attitudes: list[AttitudeSample] = []
        self._receiver: list[GnssSample] = []
        self._second: list[GnssSample] = []  # of another receiver: it counts while the first one has no fix
        self._ground: list[GroundSample] = []
        self._feedbacks: list[Feedback] = []
        self._histories: tuple[list[Any], ...] = (self._positions, self._attitudes, self._receiver, self._second,
                                                  self._ground, self._feedbacks)  # fmt: skip
        self._steady_positions = Steady[PositionSample](counts, OF_PLACES, OF_VELOCITIES)
        self._steady_attitudes = Steady[AttitudeSample](counts, OF_ATTITUDES)
        self._attitude_sigma: tuple[float | None, int] = (None, 0)  # as the autopilot told it, and when

    def feed(self, number: int, stamp_ns: int, message: MavlinkMessage) -> None:
        """Take a packet whose message is one of `USED_MESSAGES`. A packet of another vehicle changes nothing."""
        _HANDLERS[message.get_type()](self, number, stamp_ns, message)

    def prune(self, before_ns: int) -> None:
        """Forget what came before."""
        for history in self._histories:
            prune(history, before_ns)
        del self._jumps[: max(0, bisect_left(self._jumps, before_ns, key=lambda one: one.stamp_ns) - 1)]
        self.gimbals.prune(before_ns)
        self.time.prune(before_ns)

    def clock(self, limit: int, utc_ns: int | None = None) -> BootClock | None:
        """The autopilot's clock against ours at an instant (now), from packets below `limit`; None while unknown."""
        return self.time.clock(limit, (self._positions, self._attitudes), utc_ns)

    def feedbacks(self, limit: int, utc_ns: int) -> Sequence[Feedback]:
        """Messages about the hot shoe, from the packets below `limit` of the epoch of an instant."""
        return between(self._feedbacks, *self.time.span(limit, utc_ns))

    def has_fix(self) -> bool:
        """Whether a receiver's last message says a fix: then UTC is the satellites'."""
        return any(_fixed(history[-1]) for history in (self._receiver, self._second) if history)

    @property
    def placed_ns(self) -> int:
        """When the last position came; 0: none did."""
        return self._positions[-1].stamp_ns if self._positions else 0

    @property
    def displaced(self) -> bool:
        """Whether a jump of the position is not over."""
        return norm(self._finder.standing_m) > 0

    def rate(self) -> float | None:
        """How many times as fast as ours its clock runs, where each two of the last ten seconds say that it is another
        one than ours; else None."""
        known = latest(self._positions, _UNSTEADY_NS)
        if not known or known[-1].stamp_ns - known[0].stamp_ns < _UNSTEADY_NS - _PART_NS:
            return None
        begins = range(known[-1].stamp_ns - _UNSTEADY_NS + _PART_NS, known[-1].stamp_ns, _PART_NS)
        places = [bisect_left(known, since, key=lambda one: one.stamp_ns) for since in begins]
        marks = [known[0], *(known[place] for place in places), known[-1]]
        whole, *rates = [
            (b.boot_ns - a.boot_ns) / (b.stamp_ns - a.stamp_ns)
            for a, b in ((known[0], known[-1]), *pairwise(marks))
            if b.stamp_ns > a.stamp_ns
        ]
        return whole if min(rates) > 1 + _FAST or max(rates) < 1 / (1 + _FAST) else None

    def reached(self, boot_ns: int) -> bool:
        """Whether samples from after this instant have arrived. Attitude counts only if some arrived in the last five
        seconds."""
        positions, attitudes = self._positions[-1:], self._attitudes[-1:]
        if not positions or positions[0].boot_ns < boot_ns:
            return False
        alive = bool(attitudes) and attitudes[0].boot_ns >= positions[0].boot_ns - _ALIVE_NS
        return not alive or attitudes[0].boot_ns >= boot_ns

    def late_ns(self, heard_ns: int, limit: int, clock: BootClock) -> int | None:
        """How late a message without a time came that was heard then: as late as the samples that came with it, whose
        time is known. None where none did."""
        histories: tuple[Sequence[Sample], ...] = (self._positions, self._attitudes)
        late = [
            one.stamp_ns - clock.utc_ns(one.boot_ns)
            for history in histories
            for one in beside(between(history, *self.time.span(limit, heard_ns)), heard_ns, _TOGETHER_NS)
        ]
        return min(late, default=None)

    def around(self, utc_ns: int, boot_ns: int, sigma_ns: float, limit: int, *, placed: bool = True) -> Around:
        """The samples around an instant (`boot_ns` ± σ on the autopilot's clock), from the packets below `limit`."""
        jumps = between(self._jumps, 0, limit)
        first, limit = self.time.span(limit, utc_ns)
        heard, other = (
            min(
                (one for one in between(history, first, limit) if abs(one.stamp_ns - utc_ns) <= NEAREST_NS),
                key=lambda sample: abs(sample.stamp_ns - utc_ns),
                default=None,
            )
            for history in (self._receiver, self._second)
        )
        gimbals, gimbal_boot_ns = self.gimbals.around(utc_ns, boot_ns, first, limit)
        return Around(
            utc_ns,
            boot_ns,
            sigma_ns,
            around_instant(between(self._positions, first, limit), boot_ns, gap_ns=POSITION_GAP_NS),
            around_instant(between(self._attitudes, first, limit), boot_ns, gap_ns=ATTITUDE_GAP_NS),
            other if other and _fixed(other) and not (heard and _fixed(heard)) else heard,
            gimbals,
            gimbal_boot_ns,
            placed,
            [
                one if first <= one.number < limit else replace(one, boot_ns=boot_ns + one.stamp_ns - utc_ns)
                for one in jumps
            ],
            between(self._ground, first, limit),
        )

    def _position(self, number: int, stamp_ns: int, message: MavlinkMessage) -> None:
        sample = None if self._refuses(stamp_ns, message) else telemetry_samples.position(number, stamp_ns, message)
        if sample is None or not self._believed(sample, message, self._positions):
            return
        self.counts.positions += 1
        first = self.time.first(number + 1)
        for one in self._steady_positions.take(sample, _moving(sample), first):
            if not _rises(self._positions, one, first):
                continue
            keep(self._positions, one)
            jump = self._finder.jump(one, self.time.boot_first(number + 1))
            if jump is not None:
                self.counts.jumped(stamp_ns, norm(jump.by_m))
                keep(self._jumps, jump)

    def _attitude(self, number: int, stamp_ns: int, message: MavlinkMessage) -> None:
        if self._refuses(stamp_ns, message):
            return
        sample = telemetry_samples.attitude(number, stamp_ns, message)
        told_rad, told_ns = self._attitude_sigma
        if sample is not None and sample.sigma_rad is None and stamp_ns - told_ns <= _ALIVE_NS:
            sample = replace(sample, sigma_rad=told_rad)
        if sample is None or not self._believed(sample, message, self._attitudes):
            return
        self.counts.attitudes += 1
        first, matrix = self.time.first(number + 1), turned(*sample.attitude)
        for one in self._steady_attitudes.take(sample, (matrix,), first):
            if _rises(self._attitudes, one, first):
                keep(self._attitudes, one)

    def _odometry(self, number: int, stamp_ns: int, message: MavlinkMessage) -> None:
        if self._ours(message):
            self._attitude_sigma = telemetry_samples.attitude_sigma_rad(message), stamp_ns

    def _gnss(self, number: int, stamp_ns: int, message: MavlinkMessage) -> None:
        if self._ours(message):
            first_one = message.get_type() == "GPS_RAW_INT"
            heard = telemetry_samples.gnss(number, stamp_ns, message)
            keep(self._receiver if first_one else self._second, heard)
            if first_one and _fixed(heard) and self._positions:
                self._compare(heard, self._positions[-1])

    def _compare(self, heard: GnssSample, estimate: PositionSample) -> None:
        """A doubt of the position is over where a receiver that has not jumped is."""
        if abs(heard.stamp_ns - estimate.stamp_ns) > _TOGETHER_NS:
            return
        confirms = self._receiver_track.confirms(heard, estimate, self.time.boot_first(heard.number + 1))
        if confirms and self.displaced:
            keep(self._jumps, self._finder.over(estimate, heard.number, heard.stamp_ns))

    def _height(self, number: int, stamp_ns: int, message: MavlinkMessage) -> None:
        if self._ours(message) and (sample := ground_sample(number, stamp_ns, message)):
            keep(self._ground, sample)

    def _gimbal(self, number: int, stamp_ns: int, message: MavlinkMessage) -> None:
        if message.get_srcSystem() == self.system_id:
            self.gimbals.feed(number, stamp_ns, message)

    def _system_time(self, number: int, stamp_ns: int, message: MavlinkMessage) -> None:
        if self._ours(message) and self.time.system_time(stamp_ns, message):
            self.counts.refuse(stamp_ns)

    def _timesync(self, number: int, stamp_ns: int, message: MavlinkMessage) -> None:
        if self.time.timesync(number, stamp_ns, message, from_autopilot=self._ours(message)):
            self.counts.refuse(stamp_ns)

    def _feedback(self, number: int, stamp_ns: int, message: MavlinkMessage) -> None:
        """ArduPilot reports every camera at each trigger of one: only our camera's message counts."""
        by_pin = message.get_type() == "CAMERA_FEEDBACK"
        mark = telemetry_samples.is_mark(message, self.system_id)
        if not (mark or self._ours(message)) or (by_pin and message.cam_idx != self._cam_idx):
            return
        clock = self.time
        found = telemetry_samples.feedback(
            number, stamp_ns, message, clock.now_boot_ns, clock.unix_minus_boot_ns, mark=mark
        )
        if found is None:
            return
        told = self._feedbacks[-_REPEATS:]
        if any(one.time_us == found.time_us and one.image != found.image for one in told):
            return  # the report of another camera repeats this one's last time, with the number of a trigger to come
        self.counts.feedbacks += 1
        self.counts.marks += mark
        keep(self._feedbacks, found)

    def _refuses(self, stamp_ns: int, message: MavlinkMessage) -> bool:
        """Whether it can't be true. Our own vehicle's are counted."""
        if not telemetry_samples.is_impossible(message):
            return False
        if self._ours(message):
            self.counts.refuse(stamp_ns)
        return True

    def _ours(self, message: MavlinkMessage) -> bool:
        return bool(message.get_srcComponent() == 1 and message.get_srcSystem() == self.system_id)

    def _believed(
        self,
        sample: PositionSample | AttitudeSample,
        message: MavlinkMessage,
        samples: list[PositionSample] | list[AttitudeSample],
    ) -> bool:
        """Whether a sample counts: our vehicle's, from after the last reboot, no copy, not out of order."""
        if not self._ours(message) or not self.time.believe(sample.number, sample.stamp_ns, sample.boot_ns):
            return False
        if samples and samples[-1].number >= self.time.first(sample.number + 1):
            before_ns = samples[-1].boot_ns
            self.counts.out_of_order += sample.boot_ns < before_ns
            return sample.boot_ns > before_ns
        return True


def _moving(sample: PositionSample) -> tuple[Sequence[float], Sequence[float]]:
    """What of a position has to be steady: its place with the height above home (m), and its velocity (m/s)."""
    point = point_m(sample.latitude_rad, sample.longitude_rad, sample.altitude_msl_m)
    return (*point, sample.height_above_home_m), sample.velocity_ned_m_s


def _rises(history: Sequence[Sample], sample: Sample, first: int) -> bool:
    """Whether a sample is later than the last one of its epoch."""
    return not history or history[-1].number < first or sample.boot_ns > history[-1].boot_ns


def _fixed(sample: GnssSample) -> bool:
    return sample.reported.fix_type >= _FIX_3D


_HANDLERS: dict[str, Callable[[VehicleHistory, int, int, MavlinkMessage], None]] = {
    "GLOBAL_POSITION_INT": VehicleHistory._position,
    "ATTITUDE_QUATERNION": VehicleHistory._attitude,
    "ATTITUDE_QUATERNION_COV": VehicleHistory._attitude,
    "ATTITUDE": VehicleHistory._attitude,
    "ODOMETRY": VehicleHistory._odometry,
    "GPS_RAW_INT": VehicleHistory._gnss,
    "GPS2_RAW": VehicleHistory._gnss,
    "DISTANCE_SENSOR": VehicleHistory._height,
    "TERRAIN_REPORT": VehicleHistory._height,
    "GIMBAL_DEVICE_ATTITUDE_STATUS": VehicleHistory._gimbal,
    "MOUNT_ORIENTATION": VehicleHistory._gimbal,
    "TIMESYNC": VehicleHistory._timesync,
    "SYSTEM_TIME": VehicleHistory._system_time,
    "CAMERA_FEEDBACK": VehicleHistory._feedback,
    "CAMERA_TRIGGER": VehicleHistory._feedback,
}
USED_MESSAGES = frozenset(_HANDLERS)
