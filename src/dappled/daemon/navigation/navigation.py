"""Compute where the vehicle was and how it pointed, by interpolation between the packets of the telemetry log.

The state depends only on the packets fed (number, stamp, message), and a pose only on the packets whose number is below
the limit that it was asked with. So a replay that passes a recorded `telemetry_packets` as `upto_packet` gets the same
floats, also when it has read on already (by less than a minute of flight).
"""

from __future__ import annotations

import logging
import math
import threading
from collections import deque
from collections.abc import Sequence
from dataclasses import replace

from dappled.clock import Clock
from dappled.daemon.live_settings import LiveSettings
from dappled.daemon.navigation.autopilot_time import TIMESYNC_WINDOW_NS
from dappled.daemon.navigation.clocks import (
    BootClock,
    ExposureTime,
    UtcLearner,
    by_trigger,
    choose_feedback,
    in_doubt,
    own_feedback,
    reach_ns,
    refine,
    unseen,
)
from dappled.daemon.navigation.doubts import doubts
from dappled.daemon.navigation.ground_height import ground_height
from dappled.daemon.navigation.samples import (
    HALF_MS_NS,
    Around,
    AttitudeSample,
    PositionDoubt,
    PositionSample,
    TelemetryCounts,
    UtcCorrection,
)
from dappled.daemon.navigation.vehicle_history import USED_MESSAGES, VehicleHistory
from dappled.decode.geometry import (
    Gnss,
    Pose,
    Quaternion,
    Symmetric,
    Vector3,
    displacement,
    hermite,
    hermite_doubt,
    metres_per_radian,
    norm,
    slerp,
    slerp_doubt,
    turn_rad,
    turn_rates,
    turned_by_heading,
)
from dappled.drivers.mavlink import MavlinkMessage, Packet
from dappled.errors import DappledError
from dappled.findings import Finding
from dappled.flight import LedgerReader, Recording

log = logging.getLogger(__name__)

HISTORY_NS = TIMESYNC_WINDOW_NS + 60 * 10**9
AHEAD_NS = 10**9  # a body's latency and half an exposure; an exposure further ahead is not waited for
RATES_GAP_NS, TURN_GAP_NS = 150_000_000, 60_000_000  # a multicopter sways within more; without rates in the messages
JUMP_BEFORE_NS = 10 * 10**9  # so long before a jump a position is in doubt
_DOUBT, _DOUBT_BEFORE = "position_doubt", "position_doubt_before"  # the ledger's facts, PositionDoubt
_VEHICLES = "vehicles"  # the ledger's fact: [number of the first packet, system id] of each vehicle followed
_HINT_NS = 50_000_000  # a new fit while one frame waits changes the clock by less
_PRUNE_EVERY, _LOOK_S = 256, 0.005
_NOBODY, _MOST_CANDIDATES = -1, 8
_MARK_COMES_NS = 1_100_000_000  # a receiver sends its marks with the next solution, at 1 Hz up to 1 s later
# A single-frequency receiver under open sky, where it reports a dilution only; GPS_FIX_TYPE → metres for each unit.
METRES_PER_DOP = {2: 2.5, 3: 2.5, 4: 1.0, 5: 0.3, 6: 0.02, 7: 0.02, 8: 0.05}


class Telemetry:
    """Telemetry of one vehicle: the one given to `follow`; until then the only one heard (component 1), of several
    none.

    `vehicles` are (packet number, system id) in order, as a recorded flight followed them. `component_id` is our own
    (see AutopilotTime), `cam_idx` our camera's number in CAMERA_FEEDBACK. `attitude_sigma_rad` is how well the
    autopilot knows its attitude, where it doesn't say; 0 is not known. `doubt` is how far a vehicle's position was in
    doubt before. All methods may be called from any thread.
    """

    def __init__(
        self,
        *,
        vehicles: Sequence[tuple[int, int]] = (),
        component_id: int = 100,
        cam_idx: int = 0,
        attitude_sigma_rad: float = 0.0,
        doubt: PositionDoubt | None = None,
    ) -> None:
        self._turns, self._doubt = deque(vehicles), doubt
        self._component_id, self._cam_idx, self._attitude_sigma_rad = component_id, cam_idx, attitude_sigma_rad
        self._lock = threading.Lock()
        self._packets = self._prune_at = 0
        self._counts = TelemetryCounts()
        self._candidates: dict[int, VehicleHistory] | None = {}  # by system id; None: it is known which one counts
        self._history = self._of(_NOBODY)

    def feed(self, number: int, stamp_us: int, message: MavlinkMessage) -> None:
        """Take one packet. Numbers must rise. Messages that are not used only count."""
        with self._lock:
            while self._turns and self._turns[0][0] <= number:
                _, system_id = self._turns.popleft()
                if self._candidates is not None:
                    self._history = self._candidates.get(system_id) or self._of(system_id)
                    self._candidates, self._counts = None, self._history.counts
                elif system_id != self._history.system_id:
                    self._history = self._of(system_id, self._counts)
            self._packets = number + 1
            kind = message.get_type()
            if kind not in USED_MESSAGES:
                return
            histories = [self._history] if self._candidates is None else self._heard(message)
            for history in histories:
                history.feed(number, stamp_us * 1000, message)
            if number >= self._prune_at:  # by packets that the flight used as well
                self._prune_at = number + _PRUNE_EVERY
                for history in histories:
                    history.prune(stamp_us * 1000 - HISTORY_NS)

    def _of(self, system_id: int, counts: TelemetryCounts | None = None) -> VehicleHistory:
        return VehicleHistory(
            system_id, self._component_id, counts or TelemetryCounts(), cam_idx=self._cam_idx, doubt=self._doubt
        )

    def _heard(self, message: MavlinkMessage) -> list[VehicleHistory]:
        """All vehicles that may be the camera's, while that is not known; the only one counts for now."""
        assert self._candidates is not None
        known, system_id = self._candidates, message.get_srcSystem()
        of_autopilot = message.get_srcComponent() == 1 and message.get_type() != "TIMESYNC"
        if of_autopilot and system_id not in known and len(known) < _MOST_CANDIDATES:
            known[system_id] = self._of(system_id)
            self._history = known[system_id] if len(known) == 1 else self._of(_NOBODY)
            self._counts = self._history.counts
        return list(known.values())

    def follow(self, system_id: int) -> int:
        """Follow this vehicle from the next packet on, and forget then what was known of another vehicle.

        Returns the number of that packet: a replay changes vehicles at the same packet. What was heard of it before it
        was known which one counts is not lost.
        """
        with self._lock:
            self._turns.append((self._packets, system_id))
            return self._packets

    def boot_clock(self) -> BootClock | None:
        """The autopilot's clock against ours, as known from the packets below the limit; None while unknown."""
        with self._lock:
            return self._history.clock(self._packets)

    def bracketed(self, utc_ns: int) -> bool:
        """Whether samples from after this instant have arrived: waiting longer would not improve its pose.

        Attitude counts only if some arrived in the last five seconds. Where the autopilot answers TIMESYNC, so has an
        answer: one that arrives later may show that its clock has stepped before.
        """
        with self._lock:
            if self._history.time.is_past(utc_ns):
                return True
            hint = self._history.time.last_fit(self._packets)
            if hint is not None and not self._history.reached(hint.boot_ns(utc_ns) - _HINT_NS):
                return False  # far from it: no new fit for every packet that arrives while a frame waits
            clock = self._history.clock(self._packets)
            if clock is None or self._history.time.awaits_answer(utc_ns):
                return False
            return self._history.reached(clock.boot_ns(utc_ns))

    def settled(self, exposure: ExposureTime) -> bool:
        """Whether waiting longer would not improve this exposure's pose.

        Samples from after it have arrived, and everything that an autopilot which reports the hot shoe, or a receiver
        that sends marks, could report about this exposure.
        """
        later_ns = reach_ns(exposure) if self._counts.feedbacks else 0
        here = not self._counts.marks or self.locate(exposure)[0].source.contact
        return self.bracketed(exposure.utc_ns + (later_ns if here else max(later_ns, _MARK_COMES_NS)))

    def locate(self, exposure: ExposureTime, *, upto_packet: int | None = None) -> tuple[ExposureTime, Pose]:
        """When and where a frame was exposed, from the packets below `upto_packet` (all so far).

        Where the autopilot saw the hot shoe close, its time replaces the expected one (see `clocks.choose_feedback`);
        a shot that the autopilot's message created has that message's time, and no other's.
        That time is on the autopilot's own clock, as the poses are: the error between the machines' clocks doesn't
        count.
        """
        with self._lock:
            limit = self._packets if upto_packet is None else upto_packet
            clock = self._history.clock(limit, exposure.utc_ns)
            either = exposure.trigger is not None and clock is not None and clock.stepped is not None
            events = self._history.feedbacks(limit, exposure.utc_ns, beside=either)
            late_ns = None
            if clock is not None and exposure.asked_utc_ns is not None:
                late_ns = self._history.late_ns(exposure.asked_utc_ns, limit, clock)
        event, trigger = None, exposure.trigger
        if clock is not None:
            event = own_feedback(events, trigger) if trigger else choose_feedback(events, exposure, clock)
        if clock is None or event is None:
            exposure = unseen(exposure) if trigger else exposure
            pose = self.pose_at(exposure.utc_ns, exposure.sigma_ns, upto_packet=limit)
            return in_doubt(exposure, clock, late_ns), pose
        sigma_ns = event.sigma_ns
        if trigger:
            better, boot_ns, sigma_ns = by_trigger(exposure, trigger, event, clock, events)
        else:
            better, boot_ns = refine(exposure, event, clock)
        if not clock.stepped:  # the better time may be next to a step, where the expected one was not
            with self._lock:
                clock = self._history.clock(limit, better.utc_ns) or clock
        pose = self.pose_at(better.utc_ns, sigma_ns, upto_packet=limit, boot_ns=boot_ns, clock=clock)
        return in_doubt(better, clock, late_ns), pose

    def pose_at(
        self,
        utc_ns: int,
        utc_sigma_ns: float,
        *,
        upto_packet: int | None = None,
        boot_ns: int | None = None,
        clock: BootClock | None = None,
    ) -> Pose:
        """The pose at mid-exposure, UTC ± one sigma (nanoseconds), from the packets below `upto_packet` (all so far).

        Positions are interpolated over gaps up to 2.5 s, attitudes over gaps up to 1.5 s. Outside of that the nearest
        sample up to 10 s away is used, marked "nearest", with its age in the sigma; else what is missing is None, and
        without a position the source is "none". See `pose_around`.

        `boot_ns`, where given, is the instant on the autopilot's own clock; sigma is then of that. `clock` is the one
        that placed it.
        """
        with self._lock:
            limit = self._packets if upto_packet is None else upto_packet
            clock = clock or self._history.clock(limit, utc_ns)
            if clock is None:
                return Pose.unknown(utc_ns, limit)
            if boot_ns is None:
                boot_ns, sigma_ns = clock.boot_ns(utc_ns), (utc_sigma_ns**2 + clock.sigma_ns**2) ** 0.5
            else:  # where the clock stepped, the samples around that time may not be those of the exposure
                sigma_ns = math.hypot(utc_sigma_ns, clock.sigma_ns if clock.stepped else 0.0)
            at = self._history.around(utc_ns, boot_ns, sigma_ns, limit, placed=not clock.stepped)
        return pose_around(at, packets=limit, attitude_sigma_rad=self._attitude_sigma_rad)

    def rates(self, pose: Pose) -> Vector3 | None:
        """The body's turn rates at a pose, rad/s about its own axes, from the packets that the pose was made from; None
        where attitudes are missing, or too far apart to say how it turned between them."""
        boot_ns = (pose.boot_us or 0) * 1000
        with self._lock:
            found = self._history.around(pose.utc_ns, boot_ns, 0.0, pose.telemetry_packets).attitudes
        if pose.boot_us is None or len(found) != 2:
            return None
        a, b = found
        span_ns, rates = b.boot_ns - a.boot_ns, (a.rates_rad_s, b.rates_rad_s)
        if span_ns > (TURN_GAP_NS if None in rates else RATES_GAP_NS):
            return None
        return turn_rates((a.attitude, b.attitude), rates, span_ns / 1e9, (boot_ns - a.boot_ns) / span_ns)

    def doubts(self) -> tuple[Finding, ...]:
        """What was in the last minute of telemetry, for which poses are in doubt."""
        with self._lock:
            return tuple(doubts(self._history))

    def position_doubt(self) -> PositionDoubt | None:
        """How far the vehicle's position is in doubt now; the doubt from before while it isn't known which vehicle
        counts."""
        with self._lock:
            return self._doubt if self._history.system_id == _NOBODY else self._history.position_doubt

    def utc_correction(self) -> UtcCorrection | None:
        """This machine's UTC against that of the autopilot's satellites; None while either is unknown."""
        with self._lock:
            clock = self._history.clock(self._packets)
            unix_minus_boot_ns, now_boot_ns = self._history.time.utc.offset_ns, self._history.time.now_boot_ns
            by_fix = self._history.has_fix()
        if clock is None or unix_minus_boot_ns is None or now_boot_ns is None:
            return None
        correction_ns = unix_minus_boot_ns + now_boot_ns - clock.utc_ns(now_boot_ns)
        return UtcCorrection(correction_ns, round(clock.sigma_ns), f"SYSTEM_TIME, clocks by {clock.source}", by_fix)

    def statistics(self) -> TelemetryCounts:
        """Counters, as they are now."""
        with self._lock:
            reboots, gimbals = self._history.time.reboots, self._history.gimbals.seen
            return replace(self._counts, packets=self._packets, reboots=reboots, gimbals=gimbals)


class Navigation:
    """Live navigation of one flight: logs packets, gives poses, and records whose telemetry counts and UTC.

    It is the PacketLog of the flight's links. `pose.wait_ms` of the settings may change in flight.
    """

    def __init__(self, settings: LiveSettings, clock: Clock, recording: Recording, *, utc_known: bool) -> None:
        now = settings.now
        self._settings, self._clock, self._recording = settings, clock, recording
        self._never = threading.Event()
        self.telemetry = Telemetry(
            component_id=now.mavlink.component_id,
            cam_idx=now.mavlink.cam_idx,
            attitude_sigma_rad=math.radians(now.pose.attitude_sigma_deg),
            doubt=self._doubt_before(),
        )
        self.utc = UtcLearner(recording.learn_utc, known=utc_known)
        self._vehicles, self._vehicles_noted = list[tuple[int, int]](), 0
        self._doubt_noted: PositionDoubt | None = None

    def log_packet(self, stamp_us: int, raw: bytes) -> int | None:
        """Write a packet to the telemetry log."""
        return self._recording.telemetry.append(stamp_us, raw)

    def on_packet(self, packet: Packet) -> None:
        """Take a packet, received or sent. One outside the telemetry log is ignored: a replay wouldn't have it."""
        if packet.number is not None:
            self.telemetry.feed(packet.number, packet.stamp_us, packet.message)

    def belongs_to(self, system_id: int | None) -> None:
        """Follow the system that the camera belongs to now; None while that is undecided.

        Each change is recorded for a replay. Raises DappledError when it can't be; the next call tries again.
        """
        if system_id is not None and (not self._vehicles or self._vehicles[-1][1] != system_id):
            self._vehicles.append((self.telemetry.follow(system_id), system_id))
        if self._vehicles_noted != len(self._vehicles):
            self._recording.ledger.set_fact(_VEHICLES, self._vehicles)
            self._vehicles_noted = len(self._vehicles)

    def note_doubt(self) -> None:
        """Record how far the position is in doubt: the next flight begins with that. Raises DappledError when it can't
        be recorded; the next call tries again."""
        doubt, noted = self.telemetry.position_doubt(), self._doubt_noted
        if doubt is not None and doubt != noted and (noted is not None or any(doubt.standing_m)):
            self._recording.ledger.set_fact(_DOUBT, doubt)
            self._doubt_noted = doubt

    def _doubt_before(self) -> PositionDoubt | None:
        """The doubt with which the flight before ended, in order or not; recorded for a replay."""
        before = self._recording.before
        if before is None:
            return None
        try:
            with LedgerReader.open(self._recording.index.flight(before).ledger) as ledger:
                doubt = ledger.fact(PositionDoubt, _DOUBT)
        except DappledError as error:
            log.warning("whether the position was in doubt before is not known: %s", error)
            return None
        if doubt is None or not any(doubt.standing_m):
            return None
        self._recording.ledger.set_fact(_DOUBT_BEFORE, doubt)
        return doubt

    def look_for_utc(self) -> None:
        """Learn UTC from the autopilot if it is known by now. Raises DappledError when it can't be recorded; the next
        call tries again."""
        self.utc.look(self.telemetry.utc_correction())

    def pose(self, index: int, exposure: ExposureTime) -> tuple[ExposureTime, Pose]:
        """The pose, once telemetry from after the exposure has arrived, or at the latest `pose.wait_ms` after it."""
        wait_ns = round(self._settings.now.pose.wait_ms * 1e6)
        give_up_ns = min(exposure.utc_ns, self._clock.utc_ns() + AHEAD_NS) + wait_ns
        while not self.telemetry.settled(exposure) and self._clock.utc_ns() < give_up_ns:
            self._clock.wait(self._never, _LOOK_S)
        return self.telemetry.locate(exposure)

    def rates(self, pose: Pose) -> Vector3 | None:
        return self.telemetry.rates(pose)

    def pose_now(self) -> Pose:
        """The vehicle's pose at this moment."""
        return self.telemetry.pose_at(self._clock.utc_ns(), 0.0)


def recorded_vehicles(ledger: LedgerReader) -> list[tuple[int, int]]:
    """The vehicles that a flight followed, (number of the first telemetry packet, system id), for `Telemetry`."""
    return ledger.fact(list[tuple[int, int]], _VEHICLES) or []


def recorded_doubt(ledger: LedgerReader) -> PositionDoubt | None:
    """The doubt of the position that a flight began with, for `Telemetry`."""
    return ledger.fact(PositionDoubt, _DOUBT_BEFORE)


def pose_around(at: Around, *, packets: int, attitude_sigma_rad: float = 0.0) -> Pose:
    """The pose at an instant, from `packets` packets.

    Position: cubic Hermite with the reported velocities. Attitude and gimbal: slerp. With one sample only, that one,
    marked "nearest". Sigmas: time (exposure and clocks) × speed and × turn rate, with the age of a single sample; the
    uncertainty of the interpolation; jumps of the position near to it; the receiver's accuracy (without one the
    position's sigmas are None); the attitude's own, as the autopilot reports it or `attitude_sigma_rad`, the larger
    (without either the attitude's are None).
    """
    sigma_s = math.hypot(at.sigma_ns, HALF_MS_NS / math.sqrt(3)) / 1e9
    attitude, attitude_sigma, attitude_covariance = _attitude(at, sigma_s, attitude_sigma_rad)
    gimbal, gimbal_source = _gimbal(at, attitude)
    made = replace(
        Pose.unknown(at.utc_ns, packets),
        boot_us=at.boot_ns // 1000,
        attitude=attitude,
        attitude_sigma_rad=attitude_sigma,
        gnss=_gnss(at),
        gimbal_attitude=gimbal,
        gimbal_source=gimbal_source,
        attitude_covariance_rad2=attitude_covariance,
        ground=ground_height(at.ground, at.utc_ns, attitude, None) if at.ground else None,
    )
    if not at.positions:
        return made
    found, *doubts_m = position_at(at.positions, at.boot_ns)
    across_doubt_m, upright_doubt_m = map(math.hypot, doubts_m, _jumped_m(at))
    age_s = min(abs(sample.boot_ns - at.boot_ns) for sample in at.positions) / 1e9
    blur_s = sigma_s if len(at.positions) == 2 else math.hypot(sigma_s, age_s)
    north, east, down = found.velocity_ned_m_s
    receiver = at.gnss.reported if at.gnss else None
    across_m = _receiver_sigma_m(receiver, receiver.horizontal_accuracy_m, receiver.hdop) if receiver else None
    upright_m = _receiver_sigma_m(receiver, receiver.vertical_accuracy_m, receiver.vdop) if receiver else None
    across_sigma_m = covariance = None
    if across_m is not None:
        across_sigma_m = math.hypot(across_m, math.hypot(north, east) * blur_s, across_doubt_m)
    if across_m is not None and upright_m is not None:
        across = (across_m**2 + across_doubt_m**2) / 2  # of each axis
        covariance = _symmetric(found.velocity_ned_m_s, blur_s, (across, across, upright_m**2 + upright_doubt_m**2))
    return replace(
        made,
        source="interpolated" if at.placed and len(at.positions) == 2 and len(at.attitudes) != 1 else "nearest",
        latitude_rad=found.latitude_rad,
        longitude_rad=found.longitude_rad,
        altitude_msl_m=found.altitude_msl_m,
        height_above_home_m=found.height_above_home_m,
        velocity_ned_m_s=found.velocity_ned_m_s,
        position_sigma_m=across_sigma_m,
        vertical_sigma_m=None if upright_m is None else math.hypot(upright_m, down * blur_s, upright_doubt_m),
        position_covariance_m2=covariance,
        age_ms=age_s * 1e3,
        ground=ground_height(at.ground, at.utc_ns, attitude, down) if at.ground else None,
    )


def position_at(samples: Sequence[PositionSample], boot_ns: int) -> tuple[PositionSample, float, float]:
    """The position at `boot_ns` from one or two samples, and its interpolation error (1 σ, metres), horizontal and
    vertical."""
    a = samples[0]
    if len(samples) == 1:
        return a, 0.0, 0.0
    b = samples[1]
    span_s = (b.boot_ns - a.boot_ns) / 1e9
    share = (boot_ns - a.boot_ns) / (b.boot_ns - a.boot_ns)
    north_m, east_m = metres_per_radian(a.latitude_rad, a.altitude_msl_m)
    va, vb = a.velocity_ned_m_s, b.velocity_ned_m_s
    to_b = displacement(a, b)
    north, east, down = (hermite((0.0, to_b[i]), (va[i], vb[i]), span_s, share) for i in range(3))
    height = b.height_above_home_m - a.height_above_home_m
    vn, ve, vd = ((1 - share) * va[i] + share * vb[i] for i in range(3))
    found = replace(
        b,
        boot_ns=boot_ns,
        latitude_rad=a.latitude_rad + north / north_m,
        longitude_rad=math.remainder(a.longitude_rad + east / east_m, 2 * math.pi),
        altitude_msl_m=a.altitude_msl_m - down,
        height_above_home_m=a.height_above_home_m + hermite((0.0, height), (-va[2], -vb[2]), span_s, share),
        velocity_ned_m_s=(vn, ve, vd),
    )
    errors_m = [hermite_doubt(to_b[i], (va[i], vb[i]), span_s, share) for i in range(3)]
    return found, math.hypot(errors_m[0], errors_m[1]), errors_m[2]


def _jumped_m(at: Around) -> tuple[float, float]:
    """How far the position of an instant is in doubt, metres horizontally and vertically: by the jumps before it that
    are not over, and by those up to `JUMP_BEFORE_NS` after it. A jump there and back is one of them."""
    before = [one for one in at.jumps if one.boot_ns <= at.boot_ns]
    north, east, down = before[-1].standing_m if before else (0.0, 0.0, 0.0)
    across_m, upright_m = math.hypot(north, east), abs(down)
    north = east = down = 0.0
    for one in at.jumps:
        if at.boot_ns < one.boot_ns < at.boot_ns + JUMP_BEFORE_NS:
            north, east, down = north + one.by_m[0], east + one.by_m[1], down + one.by_m[2]
            across_m, upright_m = max(across_m, math.hypot(north, east)), max(upright_m, abs(down))
    return across_m, upright_m


def attitude_at(samples: Sequence[AttitudeSample], boot_ns: int) -> tuple[Quaternion, float]:
    """The attitude at `boot_ns` from one or two samples, and its interpolation error (1 σ, radians)."""
    a = samples[0]
    if len(samples) == 1:
        return a.attitude, 0.0
    b = samples[1]
    share = (boot_ns - a.boot_ns) / (b.boot_ns - a.boot_ns)
    span_s = (b.boot_ns - a.boot_ns) / 1e9
    doubt = (
        0.0
        if a.rates_rad_s is None or b.rates_rad_s is None
        else slerp_doubt((a.attitude, b.attitude), (a.rates_rad_s, b.rates_rad_s), span_s, share)
    )
    return slerp(a.attitude, b.attitude, share), doubt


def _attitude(at: Around, sigma_s: float, own_rad: float) -> tuple[Quaternion | None, float | None, Symmetric | None]:
    """Attitude, σ of the whole rotation, and the covariance where the body's rates are known."""
    samples = at.attitudes
    if not samples:
        return None, None, None
    found, doubt = attitude_at(samples, at.boot_ns)
    # a filter doesn't know of its compass's error, the user may
    reported_rad = max(own_rad, *(sample.sigma_rad or 0.0 for sample in samples))
    if reported_rad <= 0:
        return found, None, None  # the error of the interpolation alone says nothing about the autopilot's own
    rates = max((s.rates_rad_s for s in samples if s.rates_rad_s is not None), key=norm, default=None)
    if len(samples) == 1:
        sigma_s = math.hypot(sigma_s, abs(samples[0].boot_ns - at.boot_ns) / 1e9)
    if rates is not None:
        each = (doubt**2 + reported_rad**2) / 3  # of each axis
        covariance = _symmetric(rates, sigma_s, (each, each, each))
        return found, math.hypot(norm(rates) * sigma_s, doubt, reported_rad), covariance
    if len(samples) == 1:
        return found, None, None
    span_s = (samples[1].boot_ns - samples[0].boot_ns) / 1e9
    rate = turn_rad(samples[0].attitude, samples[1].attitude) / span_s
    return found, math.hypot(rate * sigma_s, doubt, reported_rad), None


def _symmetric(way: Vector3, sigma_s: float, own: Vector3) -> Symmetric:
    """The covariance of a quantity that moves along `way` (per second), for a time known to `sigma_s`, plus its own
    variances."""
    x, y, z = (part * sigma_s for part in way)
    return x * x + own[0], x * y, x * z, y * y + own[1], y * z, z * z + own[2]


def _gimbal(at: Around, vehicle: Quaternion | None) -> tuple[Quaternion | None, str | None]:
    """The head's attitude to north-east-down; None where it follows a vehicle of unknown heading."""
    if not at.gimbals:
        return None, None
    a, b = at.gimbals[0], at.gimbals[-1]
    share = 0.0 if a is b else (at.gimbal_boot_ns - a.boot_ns) / (b.boot_ns - a.boot_ns)
    head = slerp(a.attitude, b.attitude, share)
    if not a.follows_vehicle:
        return head, a.kind
    return (None, None) if vehicle is None else (turned_by_heading(head, vehicle), a.kind)


def _gnss(at: Around) -> Gnss | None:
    return None if at.gnss is None else replace(at.gnss.reported, age_ms=abs(at.utc_ns - at.gnss.stamp_ns) / 1e6)


def _receiver_sigma_m(receiver: Gnss, accuracy_m: float | None, dilution: float | None) -> float | None:
    """The receiver's own accuracy, else what its dilution of precision suggests."""
    each_m = METRES_PER_DOP.get(receiver.fix_type)
    return accuracy_m or (None if dilution is None or each_m is None else dilution * each_m)
