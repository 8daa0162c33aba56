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

from dappled.daemon.navigation import hot_shoe, pose
from dappled.daemon.navigation.autopilot_time import TIMESYNC_WINDOW_NS
from dappled.daemon.navigation.boot_clock import BootClock
from dappled.daemon.navigation.vehicle_history import Counts, VehicleHistory
from dappled.daemon.pipeline.tagger import ExposureTime
from dappled.decode.geometry.pose import Pose
from dappled.drivers.mavlink.links import Message

HISTORY_NS = TIMESYNC_WINDOW_NS + 60 * 10**9
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
        self._turns = deque(vehicles)
        self._component_id, self._attitude_sigma_rad = component_id, attitude_sigma_rad
        self._lock = threading.Lock()
        self._packets = self._prune_at = 0
        self._counts = Counts()
        self._history = VehicleHistory(None, component_id, self._counts)

    def feed(self, number: int, stamp_us: int, message: Message) -> None:
        """Fold in one packet. Numbers must rise. Messages of no interest only count."""
        with self._lock:
            while self._turns and self._turns[0][0] <= number:
                _, system_id = self._turns.popleft()
                if system_id != self._history.system_id:
                    self._history = VehicleHistory(system_id, self._component_id, self._counts)
            self._packets = number + 1
            heeded = self._history.feed(number, stamp_us * 1000, message)
            if heeded and number >= self._prune_at:  # by packets that a replay decodes as well
                self._prune_at = number + _PRUNE_EVERY
                self._history.prune(stamp_us * 1000 - HISTORY_NS)

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
            return self._history.clock(self._packets if upto_packet is None else upto_packet)

    def bracketed(self, utc_ns: int) -> bool:
        """Whether samples from after this instant have arrived: waiting longer would not make its pose better.

        Attitude counts only if there was any in the last five seconds.
        """
        with self._lock:
            hint = self._history.time.lately(self._packets)
            if hint is not None and not self._history.reached(hint.boot_ns(utc_ns) - _HINT_NS):
                return False  # far from it: no new fit for every packet that comes while somebody waits
            clock = self._history.clock(self._packets)
            return clock is not None and self._history.reached(clock.boot_ns(utc_ns))

    def settled(self, exposure: ExposureTime) -> bool:
        """Whether waiting longer would not make this exposure's pose better: samples from after it are there; from an
        autopilot that tells of the hot shoe, also all that it could tell of this exposure."""
        later_ns = hot_shoe.reach_ns(exposure) if self._counts.feedbacks else 0
        return self.bracketed(exposure.utc_ns + later_ns)

    def locate(self, exposure: ExposureTime, *, upto_packet: int | None = None) -> tuple[ExposureTime, Pose]:
        """When and where a frame was exposed, from the packets below `upto_packet` (all so far).

        Where the autopilot saw the hot shoe close, its word replaces the expectation (see `feedback`): that time is on
        the autopilot's own clock, as the poses are, so the clocks between the two machines don't count.
        """
        with self._lock:
            limit = self._packets if upto_packet is None else upto_packet
            clock = self._history.clock(limit)
            events = self._history.feedbacks(limit)
        event = None if clock is None else hot_shoe.choose(events, exposure, clock)
        if clock is None or event is None:
            return exposure, self.pose_at(exposure.utc_ns, exposure.sigma_ns, upto_packet=limit)
        better, boot_ns = hot_shoe.refined(exposure, event, clock)
        return better, self.pose_at(better.utc_ns, hot_shoe.CONTACT_SIGMA_NS, upto_packet=limit, boot_ns=boot_ns)

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
            clock = self._history.clock(limit)
            if clock is None:
                return pose.nothing(utc_ns, limit)
            if boot_ns is None:
                boot_ns, sigma_ns = clock.boot_ns(utc_ns), (utc_sigma_ns**2 + clock.sigma_ns**2) ** 0.5
            else:
                sigma_ns = utc_sigma_ns
            at = self._history.around(utc_ns, boot_ns, sigma_ns, limit)
        return pose.pose(at, packets=limit, attitude_sigma_rad=self._attitude_sigma_rad)

    def utc_correction(self) -> UtcCorrection | None:
        """This machine's UTC against that of the autopilot's satellites; None while either is not known."""
        with self._lock:
            clock = self._history.clock(self._packets)
            unix_minus_boot_ns, now_boot_ns = self._history.time.unix_minus_boot_ns, self._history.time.now_boot_ns
        if clock is None or unix_minus_boot_ns is None or now_boot_ns is None:
            return None
        correction_ns = unix_minus_boot_ns + now_boot_ns - clock.utc_ns(now_boot_ns)
        return UtcCorrection(correction_ns, round(clock.sigma_ns), f"SYSTEM_TIME, clocks by {clock.source}")

    def statistics(self) -> TelemetryStatistics:
        """Counters."""
        with self._lock:
            counts, history = self._counts, self._history
            return TelemetryStatistics(
                self._packets,
                counts.positions,
                counts.attitudes,
                history.time.answers_seen,
                history.time.reboots,
                counts.out_of_order,
                counts.feedbacks,
                history.gimbals.seen,
            )


def first_position_utc_ns(packets: Iterable[tuple[int, int, Message]]) -> int | None:
    """When the first known position of a log arrived (its stamp), from (number, stamp_us, message); None without."""
    for _, stamp_us, message in packets:
        if message.get_type() == "GLOBAL_POSITION_INT" and (message.lat or message.lon):
            return stamp_us * 1000
    return None
