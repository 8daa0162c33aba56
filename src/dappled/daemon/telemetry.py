"""Where the vehicle was and how it pointed: a fold over the packets of the telemetry log.

The state depends on nothing but the packets fed (number, stamp, message), and a pose on nothing but the packets whose
number is below the limit that it was asked with: a replay that passes a recorded `telemetry_packets` as `upto_packet`
gets the very same floats, also when it has read on already (by less than a minute of flight).
"""

from __future__ import annotations

import threading
from collections import deque
from collections.abc import Iterable, Sequence
from dataclasses import dataclass

from dappled.daemon import feedback, telemetry_pose, telemetry_samples
from dappled.daemon.boot_clock import BootClock
from dappled.daemon.feedback import Feedback
from dappled.daemon.tagger import Exposure
from dappled.daemon.telemetry_clock import TIMESYNC_WINDOW_NS, AutopilotTime
from dappled.daemon.telemetry_gimbal import Gimbals
from dappled.daemon.telemetry_history import around, between, prune
from dappled.daemon.telemetry_pose import NEAREST_NS, Around
from dappled.daemon.telemetry_samples import AttitudeSample, GnssSample, PositionSample
from dappled.drivers.mavlink import Message
from dappled.flight.records import Pose

HISTORY_NS = TIMESYNC_WINDOW_NS + 60 * 10**9
POSITION_GAP_NS = 2_500_000_000
ATTITUDE_GAP_NS = 1_500_000_000
_ALIVE_NS = 5 * 10**9
_HINT_NS = 50_000_000  # more than a clock is fitted anew by while one frame waits
_PRUNE_EVERY = 256


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
    gimbals: int = 0


@dataclass(frozen=True, slots=True)
class UtcCorrection:
    """What is to be added to this machine's UTC to have the autopilot's (from its satellites), ± 1 σ."""

    correction_ns: int
    sigma_ns: int
    source: str


class Telemetry:
    """History of one vehicle: the one of `follow`; until that is told, the first autopilot (component 1) heard.

    `vehicles` are (packet number, system id) in order, as `follow` gave them in a flight that is folded again.
    `component_id` is our own (see AutopilotTime). `attitude_sigma_rad` is how well the autopilot knows its attitude,
    where it doesn't tell; 0 is not known. All methods may be called from any thread.
    """

    def __init__(
        self, *, vehicles: Sequence[tuple[int, int]] = (), component_id: int = 100, attitude_sigma_rad: float = 0.0
    ) -> None:
        self._system_id: int | None = None
        self._turns = deque(vehicles)
        self._component_id, self._attitude_sigma_rad = component_id, attitude_sigma_rad
        self._lock = threading.Lock()
        self._packets = 0
        self._forget()
        self._positions_seen = self._attitudes_seen = self._feedbacks_seen = 0
        self._out_of_order = 0

    def feed(self, number: int, stamp_us: int, message: Message) -> None:
        """Fold in one packet. Numbers must rise. Messages of no interest only count."""
        with self._lock:
            while self._turns and self._turns[0][0] <= number:
                self._turn_to(self._turns.popleft()[1])
            self._packets = number + 1
            handler = _HANDLERS.get(message.get_type())
            if handler is not None:
                handler(self, number, stamp_us * 1000, message)
                if number % _PRUNE_EVERY == 0:
                    self._prune(stamp_us * 1000 - HISTORY_NS)

    def follow(self, system_id: int) -> int:
        """Whose history this is from the next packet on; what was known of another vehicle is forgotten then.

        Returns the number of that packet: with it, a replay turns at the same place.
        """
        with self._lock:
            self._turns.append((self._packets, system_id))
            return self._packets

    def boot_clock(self, upto_packet: int | None = None) -> BootClock | None:
        """The autopilot's clock against ours, as known from the packets below the limit; None while unknown."""
        with self._lock:
            return self._clock(self._packets if upto_packet is None else upto_packet)

    def bracketed(self, utc_ns: int) -> bool:
        """Whether samples from after this instant have arrived: waiting longer would not make its pose better.

        Attitude counts only if there was any in the last five seconds.
        """
        with self._lock:
            hint = self._time.lately(self._packets)
            if hint is not None and not self._reached(hint.boot_ns(utc_ns) - _HINT_NS):
                return False  # far from it: no new fit for every packet that comes while somebody waits
            clock = self._clock(self._packets)
            return clock is not None and self._reached(clock.boot_ns(utc_ns))

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
            events = between(self._feedbacks, self._time.first(limit), limit)
        event = None if clock is None else feedback.choose(events, exposure, clock)
        if clock is None or event is None:
            return exposure, self.pose_at(exposure.utc_ns, exposure.sigma_ns, upto_packet=limit)
        better, boot_ns = feedback.refined(exposure, event, clock)
        return better, self.pose_at(better.utc_ns, feedback.CONTACT_SIGMA_NS, upto_packet=limit, boot_ns=boot_ns)

    def pose_at(
        self, utc_ns: int, utc_sigma_ns: float, *, upto_packet: int | None = None, boot_ns: int | None = None
    ) -> Pose:
        """The pose at mid-exposure, UTC ± one sigma (nanoseconds), from the packets below `upto_packet` (all so far).

        Positions are interpolated over gaps up to 2.5 s, attitudes over gaps up to 1.5 s. Outside of that the nearest
        sample up to 10 s away stands, marked "nearest", with its age in the sigma; else what is missing is None, and
        without a position the source is "none". See `telemetry_pose.pose`.

        `boot_ns`, where given, is the same instant as the autopilot itself told it; sigma is then of that.
        """
        with self._lock:
            limit = self._packets if upto_packet is None else upto_packet
            clock = self._clock(limit)
            if clock is None:
                return telemetry_pose.nothing(utc_ns, limit)
            if boot_ns is None:
                boot_ns, sigma_ns = clock.boot_ns(utc_ns), (utc_sigma_ns**2 + clock.sigma_ns**2) ** 0.5
            else:
                sigma_ns = utc_sigma_ns
            at = self._around(utc_ns, boot_ns, sigma_ns, limit)
        return telemetry_pose.pose(at, packets=limit, attitude_sigma_rad=self._attitude_sigma_rad)

    def utc_correction(self) -> UtcCorrection | None:
        """This machine's UTC against that of the autopilot's satellites; None while either is not known."""
        with self._lock:
            clock = self._clock(self._packets)
            unix_minus_boot_ns, now_boot_ns = self._time.unix_minus_boot_ns, self._time.now_boot_ns
        if clock is None or unix_minus_boot_ns is None or now_boot_ns is None:
            return None
        correction_ns = unix_minus_boot_ns + now_boot_ns - clock.utc_ns(now_boot_ns)
        return UtcCorrection(correction_ns, round(clock.sigma_ns), f"SYSTEM_TIME, clocks by {clock.source}")

    def statistics(self) -> TelemetryStatistics:
        """Counters."""
        with self._lock:
            return TelemetryStatistics(
                self._packets,
                self._positions_seen,
                self._attitudes_seen,
                self._time.answers_seen,
                self._time.reboots,
                self._out_of_order,
                self._feedbacks_seen,
                self._gimbals.seen,
            )

    def _turn_to(self, system_id: int) -> None:
        if system_id != self._system_id:
            self._system_id = system_id
            self._forget()

    def _forget(self) -> None:
        self._time = AutopilotTime(self._component_id)
        self._positions: list[PositionSample] = []
        self._attitudes: list[AttitudeSample] = []
        self._receiver: list[GnssSample] = []
        self._gimbals = Gimbals()
        self._feedbacks: list[Feedback] = []

    def _feed_position(self, number: int, stamp_ns: int, message: Message) -> None:
        sample = telemetry_samples.position(number, stamp_ns, message)
        if sample is not None and self._believed(sample, message, self._positions):
            self._positions_seen += 1
            self._positions.append(sample)

    def _feed_attitude(self, number: int, stamp_ns: int, message: Message) -> None:
        sample = telemetry_samples.attitude(number, stamp_ns, message)
        if sample is not None and self._believed(sample, message, self._attitudes):
            self._attitudes_seen += 1
            self._attitudes.append(sample)

    def _feed_gnss(self, number: int, stamp_ns: int, message: Message) -> None:
        if self._ours(message):
            self._receiver.append(telemetry_samples.gnss(number, stamp_ns, message))

    def _feed_gimbal(self, number: int, stamp_ns: int, message: Message) -> None:
        if message.get_srcSystem() == self._system_id:
            self._gimbals.feed(number, stamp_ns, message)

    def _feed_system_time(self, number: int, stamp_ns: int, message: Message) -> None:
        if self._ours(message):
            self._time.system_time(message)

    def _feed_feedback(self, number: int, stamp_ns: int, message: Message) -> None:
        if not self._ours(message):
            return
        boot_ns, now_ns = feedback.boot_ns(message, self._time.unix_minus_boot_ns), self._time.now_boot_ns
        if boot_ns is None or now_ns is None or abs(boot_ns - now_ns) > NEAREST_NS:
            return
        self._feedbacks_seen += 1
        self._feedbacks.append(Feedback(number, stamp_ns, boot_ns, message.get_type()))

    def _feed_timesync(self, number: int, stamp_ns: int, message: Message) -> None:
        self._time.timesync(number, stamp_ns, message, from_autopilot=self._ours(message))

    def _ours(self, message: Message) -> bool:
        if message.get_srcComponent() != 1:
            return False
        if self._system_id is None and message.get_type() != "TIMESYNC":
            self._system_id = message.get_srcSystem()
        return bool(message.get_srcSystem() == self._system_id)

    def _believed(
        self,
        sample: PositionSample | AttitudeSample,
        message: Message,
        samples: list[PositionSample] | list[AttitudeSample],
    ) -> bool:
        """Not another vehicle's, not from before a reboot, not a copy, not out of order."""
        if not self._ours(message) or not self._time.believe(sample.number, sample.stamp_ns, sample.boot_ns):
            return False
        if samples and samples[-1].number >= self._time.first(sample.number + 1):
            before_ns = samples[-1].boot_ns
            self._out_of_order += sample.boot_ns < before_ns
            return sample.boot_ns > before_ns
        return True

    def _clock(self, limit: int) -> BootClock | None:
        return self._time.clock(limit, (self._positions, self._attitudes))

    def _reached(self, boot_ns: int) -> bool:
        positions, attitudes = self._positions[-1:], self._attitudes[-1:]
        if not positions or positions[0].boot_ns < boot_ns:
            return False
        alive = bool(attitudes) and attitudes[0].boot_ns >= positions[0].boot_ns - _ALIVE_NS
        return not alive or attitudes[0].boot_ns >= boot_ns

    def _around(self, utc_ns: int, boot_ns: int, sigma_ns: float, limit: int) -> Around:
        first = self._time.first(limit)
        receiver = between(self._receiver, first, limit)
        nearest = min(receiver, key=lambda sample: abs(sample.stamp_ns - utc_ns), default=None)
        if nearest is not None and abs(nearest.stamp_ns - utc_ns) > NEAREST_NS:
            nearest = None
        gimbals, gimbal_boot_ns = self._gimbals.around(utc_ns, boot_ns, first, limit)
        return Around(
            utc_ns,
            boot_ns,
            sigma_ns,
            around(between(self._positions, first, limit), boot_ns, gap_ns=POSITION_GAP_NS, nearest_ns=NEAREST_NS),
            around(between(self._attitudes, first, limit), boot_ns, gap_ns=ATTITUDE_GAP_NS, nearest_ns=NEAREST_NS),
            nearest,
            gimbals,
            gimbal_boot_ns,
        )

    def _prune(self, before_ns: int) -> None:
        prune(self._positions, before_ns)
        prune(self._attitudes, before_ns)
        prune(self._receiver, before_ns)
        prune(self._feedbacks, before_ns)
        self._gimbals.prune(before_ns)
        self._time.prune(before_ns)


def first_position_utc_ns(packets: Iterable[tuple[int, int, Message]]) -> int | None:
    """When the first known position of a log arrived (its stamp), from (number, stamp_us, message); None without."""
    for _, stamp_us, message in packets:
        if message.get_type() == "GLOBAL_POSITION_INT" and (message.lat or message.lon):
            return stamp_us * 1000
    return None


_HANDLERS = {
    "GLOBAL_POSITION_INT": Telemetry._feed_position,
    "ATTITUDE_QUATERNION": Telemetry._feed_attitude,
    "ATTITUDE_QUATERNION_COV": Telemetry._feed_attitude,
    "ATTITUDE": Telemetry._feed_attitude,
    "GPS_RAW_INT": Telemetry._feed_gnss,
    "GIMBAL_DEVICE_ATTITUDE_STATUS": Telemetry._feed_gimbal,
    "MOUNT_ORIENTATION": Telemetry._feed_gimbal,
    "TIMESYNC": Telemetry._feed_timesync,
    "SYSTEM_TIME": Telemetry._feed_system_time,
    "CAMERA_FEEDBACK": Telemetry._feed_feedback,
    "CAMERA_TRIGGER": Telemetry._feed_feedback,
}
