"""Where the vehicle was and how it pointed: a fold over the packets of the telemetry log.

The state depends on nothing but the packets fed (number, stamp, message), and a pose on nothing but the packets whose
number is below the limit that it was asked with: a replay that passes a recorded `telemetry_packets` as `upto_packet`
gets the very same floats, also when it has read on already (by less than a minute of flight).
"""

from __future__ import annotations

import math
import threading
from bisect import bisect_left
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from typing import Protocol, TypeVar

from dappled.daemon import feedback
from dappled.daemon.boot_clock import Answer, BootClock, from_arrivals, from_timesync
from dappled.daemon.feedback import Feedback
from dappled.daemon.interpolation import hermite, metres_per_radian, norm, normalised, slerp, turn_rad
from dappled.daemon.tagger import Exposure
from dappled.drivers.mavlink import Message
from dappled.flight.records import Pose, Quaternion, Vector3

HISTORY_NS = 120 * 10**9
CLOCK_WINDOW_NS = 60 * 10**9
POSITION_GAP_NS = 2_500_000_000
ATTITUDE_GAP_NS = 1_500_000_000
NEAREST_NS = 10 * 10**9
REBOOT_BACK_NS = 2 * 10**9
REBOOT_CONFIRM_NS = 500_000_000
METRES_PER_HDOP = 2.5  # a single-frequency receiver under open sky, where it reports HDOP only
_HALF_MS_NS = 500_000  # time_boot_ms is cut to whole milliseconds: its middle is meant
_PRUNE_EVERY = 256


class _Sample(Protocol):
    @property
    def number(self) -> int: ...

    @property
    def stamp_ns(self) -> int: ...

    @property
    def boot_ns(self) -> int: ...


S = TypeVar("S", bound=_Sample)


@dataclass(frozen=True, slots=True)
class PositionSample:
    """One GLOBAL_POSITION_INT."""

    number: int
    stamp_ns: int
    boot_ns: int
    latitude_rad: float
    longitude_rad: float
    altitude_msl_m: float
    height_above_home_m: float
    velocity_ned_m_s: Vector3


@dataclass(frozen=True, slots=True)
class AttitudeSample:
    """One ATTITUDE_QUATERNION or ATTITUDE. Rates are of the body, None where the autopilot gave none."""

    number: int
    stamp_ns: int
    boot_ns: int
    attitude: Quaternion
    rates_rad_s: Vector3 | None


@dataclass(frozen=True, slots=True)
class AccuracySample:
    """One GPS_RAW_INT: horizontal accuracy, one sigma; None where the receiver gave neither accuracy nor HDOP."""

    number: int
    stamp_ns: int
    boot_ns: int
    horizontal_sigma_m: float | None


@dataclass(frozen=True, slots=True)
class TelemetryStatistics:
    """What was folded so far."""

    packets: int
    positions: int
    attitudes: int
    timesync_answers: int
    reboots: int
    out_of_order: int
    feedbacks: int = 0


class Telemetry:
    """History of one vehicle: `system_id`, or the first autopilot (component 1) that sends a position or attitude.

    `component_id` is our own: a TIMESYNC request from it whose `ts1` is our UTC is ours, and an answer that carries
    the same `ts1` is meant for us; all others are somebody else's. All methods may be called from any thread.
    """

    def __init__(self, *, system_id: int | None = None, component_id: int = 100) -> None:
        self._system_id = system_id
        self._component_id = component_id
        self._lock = threading.Lock()
        self._packets = 0
        self._positions: list[PositionSample] = []
        self._attitudes: list[AttitudeSample] = []
        self._accuracies: list[AccuracySample] = []
        self._feedbacks: list[Feedback] = []
        self._unix_minus_boot_ns: int | None = None
        self._answers: list[Answer] = []
        self._requests: dict[int, int] = {}
        self._boots: list[int] = [0]  # packet numbers at which the autopilot's time began anew
        self._boot_ns: int | None = None
        self._back_since_ns: int | None = None
        self._positions_seen = self._attitudes_seen = self._answers_seen = self._out_of_order = self._reboots = 0
        self._feedbacks_seen = 0

    def feed(self, number: int, stamp_us: int, message: Message) -> None:
        """Fold in one packet. Numbers must rise. Messages of no interest only count."""
        with self._lock:
            self._packets = number + 1
            handler = _HANDLERS.get(message.get_type())
            if handler is not None:
                handler(self, number, stamp_us * 1000, message)
                if number % _PRUNE_EVERY == 0:
                    self._prune(stamp_us * 1000 - HISTORY_NS)

    def boot_clock(self, upto_packet: int | None = None) -> BootClock | None:
        """The autopilot's clock against ours, as known from the packets below the limit; None while unknown."""
        with self._lock:
            return self._clock(self._packets if upto_packet is None else upto_packet)

    def bracketed(self, utc_ns: int) -> bool:
        """Whether samples from after this instant have arrived: waiting longer would not make its pose better.

        Attitude counts only if there was any in the last five seconds.
        """
        with self._lock:
            clock = self._clock(self._packets)
            if clock is None:
                return False
            boot_ns = clock.boot_ns(utc_ns)
            positions, attitudes = self._positions[-1:], self._attitudes[-1:]
            if not positions or positions[0].boot_ns < boot_ns:
                return False
            alive = bool(attitudes) and attitudes[0].boot_ns >= positions[0].boot_ns - 5 * 10**9
            return not alive or attitudes[0].boot_ns >= boot_ns

    def settled(self, exposure: Exposure) -> bool:
        """Whether waiting longer would not make this exposure's pose better: samples from after it are there; from an
        autopilot that tells of the hot shoe, also all that it could tell of this exposure."""
        later_ns = feedback.reach_ns(exposure) if self._feedbacks_seen else 0
        return self.bracketed(exposure.utc_ns + later_ns)

    def locate(self, exposure: Exposure, *, upto_packet: int | None = None) -> tuple[Exposure, Pose]:
        """When and where a frame was exposed, from the packets below `upto_packet` (all so far).

        Where the autopilot saw the hot shoe close, its word replaces the expectation (see `feedback`): that time is on
        the autopilot's own clock, as the poses are, so the clocks between the two machines don't count.
        """
        with self._lock:
            limit = self._packets if upto_packet is None else upto_packet
            clock = self._clock(limit)
            events = self._feedbacks[_index(self._feedbacks, self._first(limit)) : _index(self._feedbacks, limit)]
        event = None if clock is None else feedback.choose(events, exposure, clock)
        if clock is None or event is None:
            return exposure, self.pose_at(exposure.utc_ns, exposure.sigma_ns, upto_packet=limit)
        better, boot_ns = feedback.refined(exposure, event, clock)
        return better, self.pose_at(better.utc_ns, feedback.CONTACT_SIGMA_NS, upto_packet=limit, boot_ns=boot_ns)

    def pose_at(
        self, utc_ns: int, utc_sigma_ns: float, *, upto_packet: int | None = None, boot_ns: int | None = None
    ) -> Pose:
        """The pose at mid-exposure, UTC ± one sigma (nanoseconds), from the packets below `upto_packet` (all so far).

        Position: cubic Hermite with the reported velocities, over gaps up to 2.5 s. Attitude: slerp, over gaps up to
        1.5 s. Outside of that the nearest sample up to 10 s away stands, marked "nearest", with its age in the sigma;
        else what is missing is None, and without a position the source is "none".

        Sigmas: time (exposure and clocks) × speed and × turn rate; for the position also the receiver's horizontal
        accuracy (h_acc, else HDOP × 2.5 m); None without either. The autopilot reports no accuracy of its attitude, so
        `attitude_sigma_rad` holds what time contributes, and nothing else.

        `boot_ns`, where given, is the same instant as the autopilot itself told it; sigma is then of that.
        """
        with self._lock:
            limit = self._packets if upto_packet is None else upto_packet
            clock = self._clock(limit)
            if clock is None:
                return _no_pose(utc_ns, limit)
            clock_sigma_ns = clock.sigma_ns if boot_ns is None else 0.0
            boot_ns = clock.boot_ns(utc_ns) if boot_ns is None else boot_ns
            positions = _around(self._positions, self._first(limit), limit, boot_ns, POSITION_GAP_NS)
            attitudes = _around(self._attitudes, self._first(limit), limit, boot_ns, ATTITUDE_GAP_NS)
            accuracy = self._accuracy(limit)
        sigma_s = math.hypot(utc_sigma_ns, clock_sigma_ns, _HALF_MS_NS / math.sqrt(3)) / 1e9
        attitude, attitude_sigma = _attitude(attitudes, boot_ns, sigma_s)
        if not positions:
            return _no_pose(utc_ns, limit, boot_ns, attitude, attitude_sigma)
        at = _position(positions, boot_ns)
        age_s = min(abs(p.boot_ns - boot_ns) for p in positions) / 1e9
        blur_s = sigma_s if len(positions) == 2 else math.hypot(sigma_s, age_s)
        certain = len(positions) == 2 and len(attitudes) != 1
        return Pose(
            source="interpolated" if certain else "nearest",
            utc_ns=utc_ns,
            boot_us=boot_ns // 1000,
            latitude_rad=at.latitude_rad,
            longitude_rad=at.longitude_rad,
            altitude_msl_m=at.altitude_msl_m,
            height_above_home_m=at.height_above_home_m,
            velocity_ned_m_s=at.velocity_ned_m_s,
            attitude=attitude,
            position_sigma_m=None if accuracy is None else math.hypot(accuracy, norm(at.velocity_ned_m_s) * blur_s),
            attitude_sigma_rad=attitude_sigma,
            age_ms=age_s * 1e3,
            telemetry_packets=limit,
        )

    def statistics(self) -> TelemetryStatistics:
        """Counters."""
        with self._lock:
            return TelemetryStatistics(
                self._packets,
                self._positions_seen,
                self._attitudes_seen,
                self._answers_seen,
                self._reboots,
                self._out_of_order,
                self._feedbacks_seen,
            )

    def _feed_position(self, number: int, stamp_ns: int, message: Message) -> None:
        if message.lat == 0 and message.lon == 0:  # the autopilot has no position yet
            return
        boot_ns = self._time(number, stamp_ns, message, self._positions)
        if boot_ns is None:
            return
        self._positions_seen += 1
        self._positions.append(
            PositionSample(
                number,
                stamp_ns,
                boot_ns,
                math.radians(message.lat / 1e7),
                math.radians(message.lon / 1e7),
                message.alt / 1e3,
                message.relative_alt / 1e3,
                (message.vx / 100, message.vy / 100, message.vz / 100),
            )
        )

    def _feed_attitude(self, number: int, stamp_ns: int, message: Message) -> None:
        if message.get_type() == "ATTITUDE":
            attitude = _from_euler(message.roll, message.pitch, message.yaw)
        else:
            attitude = (message.q1, message.q2, message.q3, message.q4)
        try:
            attitude = normalised(*attitude)
        except ValueError:  # NaN or zeros: the autopilot has no attitude yet
            return
        boot_ns = self._time(number, stamp_ns, message, self._attitudes)
        if boot_ns is None:
            return
        rates = (message.rollspeed, message.pitchspeed, message.yawspeed)
        known = all(math.isfinite(rate) for rate in rates)
        self._attitudes_seen += 1
        self._attitudes.append(AttitudeSample(number, stamp_ns, boot_ns, attitude, rates if known else None))

    def _feed_accuracy(self, number: int, stamp_ns: int, message: Message) -> None:
        if not self._ours(message):
            return
        sigma = None
        if 0 < message.h_acc < 2**32 - 1:
            sigma = message.h_acc / 1e3
        elif 0 < message.eph < 2**16 - 1:
            sigma = message.eph / 100 * METRES_PER_HDOP
        self._accuracies.append(AccuracySample(number, stamp_ns, 0, sigma))

    def _feed_system_time(self, number: int, stamp_ns: int, message: Message) -> None:
        if self._ours(message) and message.time_unix_usec > feedback.EPOCH_US and message.time_boot_ms > 0:
            self._unix_minus_boot_ns = message.time_unix_usec * 1000 - (message.time_boot_ms * 10**6 + _HALF_MS_NS)

    def _feed_feedback(self, number: int, stamp_ns: int, message: Message) -> None:
        if not self._ours(message):
            return
        boot_ns = feedback.boot_ns(message, self._unix_minus_boot_ns)
        if boot_ns is None or self._boot_ns is None or abs(boot_ns - self._boot_ns) > NEAREST_NS:
            return
        self._feedbacks_seen += 1
        self._feedbacks.append(Feedback(number, stamp_ns, boot_ns, message.get_type()))

    def _feed_timesync(self, number: int, stamp_ns: int, message: Message) -> None:
        if message.tc1 == 0:
            if message.get_srcComponent() == self._component_id and 0 <= stamp_ns - message.ts1 < 10**9:
                self._requests[message.ts1] = stamp_ns
                if len(self._requests) > 64:
                    self._requests.pop(next(iter(self._requests)))
            return
        if message.ts1 not in self._requests or not self._ours(message):
            return
        answer = Answer(number, message.ts1, stamp_ns, message.tc1)
        if answer.delay_ns < 0:
            return
        if self._boot_ns is not None and message.tc1 < self._boot_ns - REBOOT_BACK_NS:
            return  # from before or after a reboot that the telemetry has yet to show
        del self._requests[message.ts1]  # the same answer on a second link is no second observation
        self._answers_seen += 1
        self._answers.append(answer)

    def _ours(self, message: Message) -> bool:
        if message.get_srcComponent() != 1:
            return False
        if self._system_id is None and message.get_type() != "TIMESYNC":
            self._system_id = message.get_srcSystem()
        return bool(message.get_srcSystem() == self._system_id)

    def _time(self, number: int, stamp_ns: int, message: Message, samples: Sequence[_Sample]) -> int | None:
        """The sample's boot time; None where it is another's, a copy, out of order, or a reboot not yet believed.

        A reboot is believed when time stood more than 2 s behind for half a second without a packet to the contrary:
        a late packet on a slow second link is none.
        """
        if not self._ours(message):
            return None
        boot_ns = int(message.time_boot_ms) * 10**6 + _HALF_MS_NS
        if self._boot_ns is not None and boot_ns < self._boot_ns - REBOOT_BACK_NS:
            if self._back_since_ns is None:
                self._back_since_ns = stamp_ns
            if stamp_ns - self._back_since_ns < REBOOT_CONFIRM_NS:
                return None
            self._boots.append(number)
            self._reboots += 1
            self._requests.clear()
            self._unix_minus_boot_ns = None
            self._boot_ns = boot_ns
        self._back_since_ns = None
        self._boot_ns = boot_ns if self._boot_ns is None else max(self._boot_ns, boot_ns)
        last = samples[-1] if samples and samples[-1].number >= self._boots[-1] else None
        if last is not None and boot_ns <= last.boot_ns:
            self._out_of_order += boot_ns < last.boot_ns
            return None
        return boot_ns

    def _first(self, limit: int) -> int:
        """The packet number at which the boot began that was current below `limit`."""
        return self._boots[max(0, bisect_left(self._boots, limit) - 1)]

    def _clock(self, limit: int) -> BootClock | None:
        first = self._first(limit)
        answers = self._answers[_index(self._answers, first) : _index(self._answers, limit)]
        if answers:
            since = answers[-1].received_utc_ns - CLOCK_WINDOW_NS
            clock = from_timesync([a for a in answers if a.received_utc_ns >= since])
            if clock is not None:
                return clock
        samples = [
            (s.boot_ns, s.stamp_ns)
            for history in (self._positions, self._attitudes)
            for s in _tail(history, first, limit, CLOCK_WINDOW_NS)
        ]
        return from_arrivals(samples)

    def _accuracy(self, limit: int) -> float | None:
        place = _index(self._accuracies, limit)
        if place == 0 or self._accuracies[place - 1].number < self._first(limit):
            return None
        return self._accuracies[place - 1].horizontal_sigma_m

    def _prune(self, before_ns: int) -> None:
        for history in (self._positions, self._attitudes, self._accuracies, self._feedbacks):
            keep = bisect_left(history, before_ns, key=lambda s: s.stamp_ns)
            del history[:keep]
        del self._answers[: bisect_left(self._answers, before_ns, key=lambda a: a.received_utc_ns)]
        del self._boots[:-8]


def first_position_utc_ns(packets: Iterable[tuple[int, int, Message]]) -> int | None:
    """When the first known position of a log arrived (its stamp), from (number, stamp_us, message); None without."""
    for _, stamp_us, message in packets:
        if message.get_type() == "GLOBAL_POSITION_INT" and (message.lat or message.lon):
            return stamp_us * 1000
    return None


_HANDLERS = {
    "GLOBAL_POSITION_INT": Telemetry._feed_position,
    "ATTITUDE_QUATERNION": Telemetry._feed_attitude,
    "ATTITUDE": Telemetry._feed_attitude,
    "GPS_RAW_INT": Telemetry._feed_accuracy,
    "TIMESYNC": Telemetry._feed_timesync,
    "SYSTEM_TIME": Telemetry._feed_system_time,
    "CAMERA_FEEDBACK": Telemetry._feed_feedback,
    "CAMERA_TRIGGER": Telemetry._feed_feedback,
}


class _Numbered(Protocol):
    @property
    def number(self) -> int: ...


def _index(history: Sequence[_Numbered], number: int) -> int:
    return bisect_left(history, number, key=lambda sample: sample.number)


def _tail(history: Sequence[S], first: int, limit: int, window_ns: int) -> Sequence[S]:
    """The samples with first <= number < limit of the last `window_ns` among them."""
    low, high = _index(history, first), _index(history, limit)
    if low >= high:
        return ()
    since = history[high - 1].stamp_ns - window_ns
    low = bisect_left(history, since, low, high, key=lambda sample: sample.stamp_ns)
    return history[low:high]


def _around(history: Sequence[S], first: int, limit: int, boot_ns: int, gap_ns: int) -> tuple[S, ...]:
    """The two samples around an instant; or the nearest one, if it is near enough; or none."""
    low, high = _index(history, first), _index(history, limit)
    place = bisect_left(history, boot_ns, low, high, key=lambda sample: sample.boot_ns)
    sides = tuple(history[max(low, place - 1) : min(high, place + 1)])
    if len(sides) == 2 and sides[1].boot_ns - sides[0].boot_ns <= gap_ns:
        return sides
    nearest = min(sides, key=lambda sample: abs(sample.boot_ns - boot_ns), default=None)
    if nearest is None or abs(nearest.boot_ns - boot_ns) > NEAREST_NS:
        return ()
    return (nearest,)


def _position(samples: Sequence[PositionSample], boot_ns: int) -> PositionSample:
    a = samples[0]
    if len(samples) == 1:
        return a
    b = samples[1]
    span_s = (b.boot_ns - a.boot_ns) / 1e9
    share = (boot_ns - a.boot_ns) / (b.boot_ns - a.boot_ns)
    north_m, east_m = metres_per_radian(a.latitude_rad, a.altitude_msl_m)
    va, vb = a.velocity_ned_m_s, b.velocity_ned_m_s
    to_b = (
        (b.latitude_rad - a.latitude_rad) * north_m,
        math.remainder(b.longitude_rad - a.longitude_rad, 2 * math.pi) * east_m,
        a.altitude_msl_m - b.altitude_msl_m,
    )
    north, east, down = (hermite((0.0, to_b[i]), (va[i], vb[i]), span_s, share) for i in range(3))
    height = b.height_above_home_m - a.height_above_home_m
    vn, ve, vd = ((1 - share) * va[i] + share * vb[i] for i in range(3))
    return PositionSample(
        b.number,
        b.stamp_ns,
        boot_ns,
        a.latitude_rad + north / north_m,
        math.remainder(a.longitude_rad + east / east_m, 2 * math.pi),
        a.altitude_msl_m - down,
        a.height_above_home_m + hermite((0.0, height), (-va[2], -vb[2]), span_s, share),
        (vn, ve, vd),
    )


def _attitude(
    samples: Sequence[AttitudeSample], boot_ns: int, sigma_s: float
) -> tuple[Quaternion | None, float | None]:
    if not samples:
        return None, None
    a = samples[0]
    if len(samples) == 1:
        age_s = abs(a.boot_ns - boot_ns) / 1e9
        sigma = None if a.rates_rad_s is None else norm(a.rates_rad_s) * math.hypot(sigma_s, age_s)
        return a.attitude, sigma
    b = samples[1]
    share = (boot_ns - a.boot_ns) / (b.boot_ns - a.boot_ns)
    rates = [norm(s.rates_rad_s) for s in samples if s.rates_rad_s is not None]
    rate = max(rates, default=turn_rad(a.attitude, b.attitude) / ((b.boot_ns - a.boot_ns) / 1e9))
    return slerp(a.attitude, b.attitude, share), rate * sigma_s


def _no_pose(
    utc_ns: int,
    packets: int,
    boot_ns: int | None = None,
    attitude: Quaternion | None = None,
    attitude_sigma_rad: float | None = None,
) -> Pose:
    return Pose(
        source="none",
        utc_ns=utc_ns,
        boot_us=None if boot_ns is None else boot_ns // 1000,
        latitude_rad=None,
        longitude_rad=None,
        altitude_msl_m=None,
        height_above_home_m=None,
        velocity_ned_m_s=None,
        attitude=attitude,
        position_sigma_m=None,
        attitude_sigma_rad=attitude_sigma_rad,
        age_ms=None,
        telemetry_packets=packets,
    )


def _from_euler(roll: float, pitch: float, yaw: float) -> Quaternion:
    cr, sr = math.cos(roll / 2), math.sin(roll / 2)
    cp, sp = math.cos(pitch / 2), math.sin(pitch / 2)
    cy, sy = math.cos(yaw / 2), math.sin(yaw / 2)
    return (
        cr * cp * cy + sr * sp * sy,
        sr * cp * cy - cr * sp * sy,
        cr * sp * cy + sr * cp * sy,
        cr * cp * sy - sr * sp * cy,
    )
