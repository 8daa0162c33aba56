"""Collect the telemetry of one vehicle, packet by packet: samples, the gimbal, the hot shoe.

The state is a fold over packets (number, stamp, message), so a replay that feeds the same packets has the same state.
"""

from __future__ import annotations

from bisect import bisect_left
from collections.abc import Callable, Sequence
from dataclasses import replace
from itertools import pairwise
from typing import Any, Generic, TypeVar

from dappled.daemon.navigation import samples as telemetry_samples
from dappled.daemon.navigation.autopilot_time import ARRIVAL_WINDOW_NS, MOST_BOOT_NS, UNSTEADY_NS, AutopilotTime
from dappled.daemon.navigation.clocks import BootClock, from_arrivals
from dappled.daemon.navigation.ground_height import ground_sample
from dappled.daemon.navigation.jumps import JumpFinder, ReceiverTrack
from dappled.daemon.navigation.samples import (
    NEAREST_NS,
    Around,
    AttitudeSample,
    Feedback,
    GimbalSample,
    GnssSample,
    GroundSample,
    Jump,
    PositionDoubt,
    PositionSample,
    Sample,
    TelemetryCounts,
    around_instant,
    beside,
    between,
    keep,
    latest,
    prune,
)
from dappled.decode.geometry import norm
from dappled.decode.geometry.camera_pose import matrix_of
from dappled.drivers.mavlink import MavlinkMessage
from dappled.drivers.mavlink.sample_judge import (
    OF_ATTITUDES,
    OF_PLACES,
    OF_VELOCITIES,
    Motion,
    Track,
    Tracks,
    point_m,
)

POSITION_GAP_NS, ATTITUDE_GAP_NS, GIMBAL_GAP_NS = 2_500_000_000, 1_500_000_000, 1_500_000_000
_REPEATS = 64
_TOGETHER_NS, _AT_ONCE_NS, _COMPARED_NS = 200_000_000, 1_000_000, 300_000_000
_PART_NS, _FAST = 2 * 10**9, 0.2
_ALIVE_NS = 5 * 10**9
_AUTOPILOT, _FIX_3D = 1, 3


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
S = TypeVar("S", bound=Sample)


class Steady(Generic[M]):
    """Holds back samples that leave those before them faster than any vehicle, until their track is certain.

    They count from the packet that makes it so: a pose depends on the packets below its limit alone.
    """

    def __init__(self, counts: TelemetryCounts, *motions: Motion) -> None:
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
    AutopilotTime), `cam_idx` our camera's number at the autopilot, `doubt` is from before. Not thread-safe.
    """

    def __init__(
        self,
        system_id: int,
        component_id: int,
        counts: TelemetryCounts,
        *,
        cam_idx: int = 0,
        doubt: PositionDoubt | None = None,
    ) -> None:
        self.system_id, self.counts, self._cam_idx = system_id, counts, cam_idx
        self.time = AutopilotTime(component_id)
        self.gimbals = Gimbals()
        self._positions: list[PositionSample] = []
        self._finder, self._receiver_track, self._jumps = JumpFinder(), ReceiverTrack(), list[Jump]()
        if doubt is not None and doubt.system_id == system_id:
            self._finder = JumpFinder(doubt.standing_m)
            self._jumps.append(Jump(0, 0, 0, (0.0, 0.0, 0.0), doubt.standing_m))
            counts.jump_m = norm(doubt.standing_m)
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

    def feedbacks(self, limit: int, utc_ns: int, *, beside: bool) -> Sequence[Feedback]:
        """Messages about the hot shoe, from the packets below `limit` of the epoch of an instant, as far as it is
        certain: a later one may have a time of the next one's clock. `beside`: contacts of those beside it too."""
        first, end = self.time.span(limit, utc_ns)
        if not beside:
            certain = _until(between(self._feedbacks, first, end), self.time.certain_ns(limit, utc_ns))
            return telemetry_samples.with_commands(certain)
        known = telemetry_samples.with_commands(between(self._feedbacks, self.time.boot_first(first + 1), limit))
        return [one for one in known if one.contact or first <= one.number < end]

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

    @property
    def position_doubt(self) -> PositionDoubt:
        """By how much its position is in doubt until there is evidence."""
        return PositionDoubt(self.system_id, self._finder.standing_m)

    def rate(self) -> float | None:
        """How many times as fast as ours its clock runs, where each two of the last ten seconds say that it is another
        one than ours; else None."""
        known = latest(self._positions, UNSTEADY_NS)
        if not known or known[-1].stamp_ns - known[0].stamp_ns < UNSTEADY_NS - _PART_NS:
            return None
        begins = range(known[-1].stamp_ns - UNSTEADY_NS + _PART_NS, known[-1].stamp_ns, _PART_NS)
        places = [bisect_left(known, since, key=lambda one: one.stamp_ns) for since in begins]
        marks = [known[0], *(known[place] for place in places), known[-1]]
        whole, *rates = [
            (b.boot_ns - a.boot_ns) / (b.stamp_ns - a.stamp_ns)
            for a, b in ((known[0], known[-1]), *pairwise(marks))
            if b.stamp_ns > a.stamp_ns
        ]
        return whole if min(rates) > 1 + _FAST or max(rates) < 1 / (1 + _FAST) else None

    def reached(self, boot_ns: int) -> bool:
        """Whether samples from after this instant of the present epoch have arrived. Attitude counts only if some
        arrived in the last five seconds."""
        first = self.time.first(MOST_BOOT_NS)
        if not (self._positions and _is_after(self._positions[-1], first, boot_ns)):
            return False
        alive = bool(self._attitudes) and self._attitudes[-1].stamp_ns >= self.placed_ns - _ALIVE_NS
        return not alive or _is_after(self._attitudes[-1], first, boot_ns)

    def late_ns(self, heard_ns: int, limit: int, clock: BootClock) -> int | None:
        """How late a message without a time came that was heard then: as late as the samples that came with it, whose
        time is known. None where none did. Of those that came at once, as from a link that has held them, the first."""
        histories: tuple[Sequence[Sample], ...] = (self._positions, self._attitudes)
        first = self.time.boot_first(self.time.span(limit, heard_ns)[0] + 1)
        late = list[int]()
        for known in (between(history, first, limit) for history in histories):
            for near in beside(known, heard_ns + 1, _AT_ONCE_NS)[:1] or beside(known, heard_ns + 1, _TOGETHER_NS):
                one = known[bisect_left(known, near.stamp_ns, key=lambda sample: sample.stamp_ns)]
                late.append(one.stamp_ns - clock.utc_ns(one.boot_ns))
        return min(late, default=None)

    def around(self, utc_ns: int, boot_ns: int, sigma_ns: float, limit: int, *, placed: bool = True) -> Around:
        """The samples around an instant (`boot_ns` ± σ on the autopilot's clock), from the packets below `limit`."""
        upto, certain_ns = limit, self.time.certain_ns(limit, utc_ns)
        first, limit = self.time.span(limit, utc_ns)
        boot_first = self.time.boot_first(first + 1)
        heard, other = (
            min(
                (one for one in between(history, boot_first, upto) if abs(one.stamp_ns - utc_ns) <= NEAREST_NS),
                key=lambda sample: abs(sample.stamp_ns - utc_ns),
                default=None,
            )
            for history in (self._receiver, self._second)
        )

        def samples(history: Sequence[M]) -> Sequence[M]:
            """Those of its epoch, as far as it is certain; where there are none, the nearest one, as it came."""
            known = _until(between(history, first, limit), certain_ns)
            if known:
                return known
            near = beside(between(history, 0, upto), utc_ns, NEAREST_NS)
            nearest = sorted(near, key=lambda one: abs(one.stamp_ns - utc_ns))[:1]
            return [replace(one, boot_ns=boot_ns + one.stamp_ns - utc_ns) for one in nearest]

        gimbals, gimbal_boot_ns = self.gimbals.around(utc_ns, boot_ns, first, limit)
        return Around(
            utc_ns,
            boot_ns,
            sigma_ns,
            around_instant(samples(self._positions), boot_ns, gap_ns=POSITION_GAP_NS),
            around_instant(samples(self._attitudes), boot_ns, gap_ns=ATTITUDE_GAP_NS),
            other if other and _fixed(other) and not (heard and _fixed(heard)) else heard,
            gimbals,
            gimbal_boot_ns,
            placed,
            [
                one if first <= one.number < limit else replace(one, boot_ns=boot_ns + one.stamp_ns - utc_ns)
                for one in between(self._jumps, 0, upto)
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
        first, matrix = self.time.first(number + 1), matrix_of(sample.attitude).ravel().tolist()
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
        if abs(heard.stamp_ns - estimate.stamp_ns) > _COMPARED_NS:
            return
        first, doubt_m = self.time.boot_first(heard.number + 1), self._finder.standing_m
        if self._receiver_track.confirms(heard, estimate, first, self._finder.begun, doubt_m) and self.displaced:
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
        if any((one.kind, one.time_us) == (found.kind, found.time_us) for one in told):
            return  # a copy, or another camera's report: this one's last time, with the number of a trigger to come
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


def _until(samples: Sequence[S], stamp_ns: int | None) -> Sequence[S]:
    """Those that came until then; None: all."""
    return samples if stamp_ns is None else samples[: bisect_left(samples, stamp_ns + 1, key=lambda one: one.stamp_ns)]


def _is_after(sample: Sample, first: int, boot_ns: int) -> bool:
    """Whether it is of the epoch that began with packet `first`, and not from before an instant."""
    return sample.number >= first and sample.boot_ns >= boot_ns


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
    "CAMERA_IMAGE_CAPTURED": VehicleHistory._feedback,
}
USED_MESSAGES = frozenset(_HANDLERS)
