"""Relate the clocks of this machine, the autopilot and the camera: when a frame was exposed.

The expected time is the trigger call's plus the body's latency. The autopilot's hot-shoe feedback replaces it; the
camera's own clock stands in where the trigger call is unknown. Pure functions of what was observed, so a replay gets
the same numbers.

Hot-shoe feedback is CAMERA_FEEDBACK with a time since boot (ArduPilot with a feedback pin), and CAMERA_IMAGE_CAPTURED
(PX4 with CAM_CAP_FBACK). CAMERA_FEEDBACK with a GPS time, and CAMERA_TRIGGER (PX4), have the time of the command to
fire. A contact counts if it is after our own trigger call: nothing exposes before that.

Where the autopilot fires the body, its message comes before we know of the shot. Such a shot has the time of the
message that created it (`TriggerMessage`). No other message is considered, and no call of ours is compared with it.
"""

from __future__ import annotations

import logging
import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from datetime import UTC, datetime
from typing import Literal, Self

import numpy as np

from dappled.config.settings import CameraSettings
from dappled.daemon.navigation.samples import CAPTURED, MARK, Feedback, UtcCorrection
from dappled.decode.array_types import Floats
from dappled.findings import FRAME, Code, Finding, Subject, finding
from dappled.flight import Shot, TimeSource

log = logging.getLogger(__name__)

_UTC_AGREES_NS = 10**9  # clocks that differ by less are not reported
DRIFT_SIGMA = 50e-6  # crystals of autopilots: some tens of ppm between two machines
_UNSEEN_NS = 10**9  # how late a trigger call may be, where not even the file's arrival bounds it
_REACH_SIGMAS = 4
_REACH_NS = 10_000_000  # with the default 30 ms in all 130 ms: at 5 Hz the next shot's contact is farther away
_AFTER_CALL_NS = 3_000_000
_HEARD_NS = 300_000_000
_OWN_NS = 2_500_000_000  # a message that a slow link repeats is the same until then
_HELD_NS = 10**9  # no link that works delays a request so long
_OF_AUTOPILOT, _ASKED_HERE = "/1", ("interval", "distance")
_BOUNCE_NS = 100_000_000  # no body here takes two photographs within this time
_CAMERA_SHOTS_KEPT = 256
_CAMERA_SHOTS_LEAST = 3
_PRIOR = np.diag([0.0, 1 / (DRIFT_SIGMA * 1e9) ** 2])  # of level (ns) and slope (ns/s)
_TIMESYNC_FLOOR_NS = 50_000.0
_TIMESYNC_ASYMMETRY = 0.05  # share of the least round trip by which the two ways may differ; not observable
_STEADY = 600e-6
_HELD_ANSWER_NS = 200_000_000
_STEP_LOOK_NS = 10 * 10**9
_STEP_FLOOR_NS = 500_000
_RECENT_NS = 5 * 10**9
_ARRIVAL_FLOOR_NS = 5e6  # the shortest way through radio, UART and scheduler; not observable from one side


@dataclass(frozen=True, slots=True)
class BodyLatency:
    """From the trigger call to the start of the exposure: mean and 1 σ, and where the figure comes from."""

    mean_ms: float
    sigma_ms: float
    source: TimeSource = TimeSource.TRIGGER_CALL
    fired_outside: bool = False  # something else fires the body: the time counts from its trigger, not from our call

    @classmethod
    def of(cls, settings: CameraSettings) -> Self:
        """As configured."""
        return cls(settings.latency_ms, settings.latency_sigma_ms, fired_outside=settings.fired_outside)


@dataclass(frozen=True, slots=True)
class TriggerMessage:
    """The autopilot's message that created a shot: its type and number, when it was heard, and the body's latency.

    The latency counts only where the message has the time of the command, not of the contact (`Feedback.contact`).
    """

    kind: str
    number: int
    heard_utc_ns: int
    latency: BodyLatency


@dataclass(frozen=True, slots=True)
class ExposureTime:
    """Mid-exposure in UTC with its 1 σ, and where it comes from.

    `half_ns` is half the exposure as far as known. `called_utc_ns` is when the trigger call was made: nothing exposes
    before it; None where that is unknown. `trigger` is the message whose time the shot owns, where there is one.
    `doubts` are those about the time. `asked_utc_ns` is when the autopilot's request was heard that made the shot.
    """

    utc_ns: int
    sigma_ns: int
    source: TimeSource
    half_ns: int = 0
    called_utc_ns: int | None = None
    trigger: TriggerMessage | None = None
    doubts: tuple[Finding, ...] = ()
    asked_utc_ns: int | None = None


def asked(exposure: ExposureTime, shot: Shot) -> ExposureTime:
    """The exposure with when the autopilot's request was heard, where the shot has no message with a time of its own:
    a link may have held it."""
    by_request = exposure.trigger is None and shot.cause.source.endswith(_OF_AUTOPILOT)
    known = by_request and shot.cause.kind not in _ASKED_HERE
    return replace(exposure, asked_utc_ns=shot.wished_utc_ns) if known else exposure


def owned(exposure: ExposureTime, shot: Shot, latency: BodyLatency) -> ExposureTime:
    """The expected exposure with the autopilot's message that created the shot, where that message is about it."""
    cause = shot.cause
    kinds = ("CAMERA_FEEDBACK", "CAMERA_TRIGGER", CAPTURED)
    if not latency.fired_outside or cause.kind not in kinds or cause.sequence is None:
        return exposure
    return replace(exposure, trigger=TriggerMessage(cause.kind, cause.sequence, shot.wished_utc_ns, latency))


def called_utc_ns(shot: Shot, called_monotonic_ns: int) -> int:
    """When the trigger call was made, on the clock of the capture request: the same to the nanosecond in a replay."""
    return called_monotonic_ns + shot.wished_utc_ns - shot.wished_monotonic_ns


def mid_exposure(fired_utc_ns: int, latency: BodyLatency, exposure_s: float | None) -> ExposureTime:
    """The trigger call's time plus the body's latency plus half the exposure (none, where it is not known)."""
    half_ns = round((exposure_s or 0.0) / 2 * 1e9)
    return ExposureTime(
        fired_utc_ns + round(latency.mean_ms * 1e6) + half_ns,
        round(latency.sigma_ms * 1e6),
        latency.source,
        half_ns,
        fired_utc_ns,
    )


def mid_exposure_by_request(
    requested_utc_ns: int, arrived_utc_ns: int | None, latency: BodyLatency, exposure_s: float | None
) -> ExposureTime:
    """The capture request's time plus the body's latency, where the time of the trigger call is unknown.

    The call may have been made at any time up to the file's arrival: sigma contains this as a uniform distribution.
    """
    exposure = mid_exposure(requested_utc_ns, latency, exposure_s)
    late_ns = _UNSEEN_NS if arrived_utc_ns is None else max(0, arrived_utc_ns - exposure.utc_ns - exposure.half_ns)
    sigma_ns = round(math.hypot(exposure.sigma_ns, late_ns / math.sqrt(3)))
    return replace(exposure, sigma_ns=sigma_ns, source=TimeSource.REQUEST)


@dataclass(frozen=True, slots=True)
class TimesyncAnswer:
    """One answer to our TIMESYNC request: the autopilot's time, between our sending and our receiving."""

    number: int
    sent_utc_ns: int
    received_utc_ns: int
    boot_ns: int

    @property
    def stamp_ns(self) -> int:
        """When it arrived."""
        return self.received_utc_ns

    @property
    def delay_ns(self) -> int:
        """Round trip."""
        return self.received_utc_ns - self.sent_utc_ns

    @property
    def held(self) -> bool:
        """Whether the link has held it, or the request."""
        return self.delay_ns > _HELD_ANSWER_NS

    @property
    def offset_ns(self) -> int:
        """UTC minus boot time, if both ways took equally long."""
        return (self.sent_utc_ns + self.received_utc_ns) // 2 - self.boot_ns


@dataclass(frozen=True, slots=True)
class BootClock:
    """UTC = boot time + offset + drift × (boot time − reference). Sigma is one standard deviation of UTC.

    `stepped`: that the clock stepped near the time that it is used for.
    """

    source: Literal["timesync", "arrival"]
    reference_boot_ns: int
    offset_ns: int
    drift: float
    sigma_ns: float
    stepped: Finding | None = None

    def utc_ns(self, boot_ns: int) -> int:
        """UTC at a boot time."""
        return boot_ns + self.offset_ns + round(self.drift * (boot_ns - self.reference_boot_ns))

    def boot_ns(self, utc_ns: int) -> int:
        """Boot time at a UTC."""
        near = utc_ns - self.offset_ns
        return near - round(self.drift / (1 + self.drift) * (near - self.reference_boot_ns))


def from_timesync(answers: Sequence[TimesyncAnswer]) -> BootClock | None:
    """Fit a line through the answers, with most weight on quick ones; None from fewer than three.

    An answer that took `e` longer than the quickest one is wrong by at most e/2, if all of that was lost on one way.
    Its weight is 1 / (s² + (e/2)²). `s` is half the lower quartile of e, so that on a link where delays spread evenly
    (no answer is much better than the next) all answers count. The slope has a prior of 0 ± 50 ppm. Sigma comes from
    the residuals, each at its own weight (White's estimate), so it is right even where the weights are not.
    """
    if len(answers) < 3:
        return None
    reference = answers[-1]
    times = np.array([(answer.sent_utc_ns, answer.received_utc_ns, answer.boot_ns) for answer in answers])
    sent, received, boot = times.T  # 64 bits: a sum of two times is right until 2116
    delay = (received - sent).astype(np.float64)
    x = (boot - reference.boot_ns).astype(np.float64) / 1e9
    y = ((sent + received) // 2 - boot - reference.offset_ns).astype(np.float64)
    half = (delay - delay.min()) / 2
    weight = 1 / (max(_TIMESYNC_FLOOR_NS, float(np.sort(half)[len(half) // 4])) ** 2 + half**2)
    freedom = len(answers) - 2
    _, _, left = _line(x, y, weight)
    weight /= max(float(weight @ left**2) / freedom, 1e-4)  # now in the prior's own measure
    (level, slope), inverse, left = _line(x, y, weight)
    sides = np.stack([np.ones_like(x), x]) * (weight * left)
    scatter = sides @ sides.T * (len(answers) / freedom) + _PRIOR
    variance = max(float((inverse @ scatter @ inverse)[0, 0]), 0.1 * float(inverse[0, 0]))
    return BootClock(
        "timesync",
        reference.boot_ns,
        reference.offset_ns + round(level),
        float(slope) / 1e9,
        math.hypot(math.sqrt(variance), _TIMESYNC_ASYMMETRY * float(delay.min())),
    )


def from_few(answers: Sequence[TimesyncAnswer]) -> BootClock:
    """The clock by the quickest of one or two answers, without a slope: it is wrong by at most half its round trip."""
    best = min(answers, key=lambda answer: answer.delay_ns)
    sigma_ns = math.hypot(best.delay_ns / 2 / math.sqrt(3), _TIMESYNC_FLOOR_NS)
    return BootClock("timesync", best.boot_ns, best.offset_ns, 0.0, sigma_ns)


def stepped_since(answers: Sequence[TimesyncAnswer], new: TimesyncAnswer) -> TimesyncAnswer | None:
    """The last of `answers` after which the clock has stepped, as a steady one can't give both it and `new`; else None.
    Later ones took so long that they may be from before the step or after it. One that the link has held shows a step
    only where that is longer: the next ones tell how large a shorter one is.

    An answer is wrong by at most half its round trip, so two differ by at most half of both, plus what crystals and
    a machine clock under correction (0.06 %) can drift in between. Answers of the last ten seconds count, and the
    last one however old it is: an autopilot that was stopped for a while steps in its silence.
    """
    for old in reversed(answers):
        apart_ns = new.stamp_ns - old.stamp_ns
        if apart_ns > _STEP_LOOK_NS and old is not answers[-1]:
            break
        most_ns = (old.delay_ns + new.delay_ns) / 2 + _STEADY * apart_ns + _STEP_FLOOR_NS
        most_ns += sum(one.delay_ns for one in (old, new) if one.held) / 2
        if abs(new.offset_ns - old.offset_ns) > most_ns:
            return old
    return None


def _line(x: Floats, y: Floats, weight: Floats) -> tuple[Floats, Floats, Floats]:
    """Weighted least squares with the prior: (level, slope), the inverse of the normal matrix, the residuals."""
    sides = np.stack([np.ones_like(x), x])
    inverse = np.asarray(np.linalg.inv((sides * weight) @ sides.T + _PRIOR), dtype=np.float64)
    found = inverse @ (sides @ (weight * y))
    return found, inverse, y - found @ sides


def from_arrivals(arrivals: Sequence[tuple[int, int]]) -> BootClock | None:
    """Take the least of (arrival − boot time) over `arrivals`, pairs (boot_ns, received_utc_ns); None from none.

    It is late by the delay of the quickest packet, which can't be observed: sigma allows 5 ms for it, and a tenth of
    the median excess; and all of what the quickest packet of the last five seconds came later: the autopilot's clock
    may have lost that much.
    """
    if not arrivals:
        return None
    offsets = sorted(received - boot for boot, received in arrivals)
    since_ns = max(received for _, received in arrivals) - _RECENT_NS
    later_ns = min(received - boot for boot, received in arrivals if received >= since_ns) - offsets[0]
    median_excess = offsets[len(offsets) // 2] - offsets[0]
    sigma_ns = math.hypot(_ARRIVAL_FLOOR_NS, 0.1 * median_excess, later_ns)
    return BootClock("arrival", arrivals[-1][0], offsets[0], 0.0, sigma_ns)


def reach_ns(exposure: ExposureTime) -> int:
    """How far from its expected time an exposure may be."""
    return _REACH_SIGMAS * exposure.sigma_ns + _REACH_NS


def choose_feedback(events: Sequence[Feedback], exposure: ExposureTime, clock: BootClock) -> Feedback | None:
    """Choose the contact of this exposure; None where there is none.

    It is the one nearest to when the exposure was expected to begin, within 4 σ + 10 ms of that (σ of the body and of
    the clocks), and after the trigger call. None also where two are so near that either may be it (half the nearer
    one's distance + 5 ms): a wrong time would be worse than a wide one. A contact that closes again is one contact.

    Contacts that the clocks can't tell from the trigger call are not chosen, but compete: without them the next shot's
    would be the nearest. By a clock in doubt none is chosen.
    """
    if exposure.called_utc_ns is None or clock.stepped:
        return None
    within_ns = reach_ns(exposure) + _REACH_SIGMAS * clock.sigma_ns
    expected_ns = clock.boot_ns(exposure.utc_ns - exposure.half_ns)
    # command and contact can be told apart no better than the clocks agree
    called_ns = clock.boot_ns(exposure.called_utc_ns)
    earliest_ns = called_ns + max(_AFTER_CALL_NS, 3 * clock.sigma_ns)
    told = _contacts(events, earliest_ns, expected_ns + within_ns)
    since_ns = called_ns + _AFTER_CALL_NS - 3 * clock.sigma_ns
    told += [one for one in events if one.contact and since_ns <= one.boot_ns < earliest_ns]
    near = sorted(
        (abs(event.boot_ns - expected_ns), event.number, event)
        for event in told
        if abs(event.boot_ns - expected_ns) <= within_ns
    )
    if not near:
        return None
    doubtful_ns = near[0][0] * 1.5 + 5_000_000
    if any(distance <= doubtful_ns and not event.is_contact_of(near[0][2]) for distance, _, event in near[1:]):
        return None
    return near[0][2] if near[0][2].boot_ns >= earliest_ns else None


def _contacts(events: Sequence[Feedback], earliest_ns: float, latest_ns: float) -> list[Feedback]:
    """The contacts between two times since boot. Where one is reported again as it bounces, only its first."""
    near = [one for one in events if one.contact and earliest_ns <= one.boot_ns <= latest_ns]
    return [
        one
        for one in near
        if not any(one.repeats(other) and 0 < one.boot_ns - other.boot_ns <= _BOUNCE_NS for other in near)
    ]


def own_feedback(events: Sequence[Feedback], trigger: TriggerMessage) -> Feedback | None:
    """The message that created a shot, among those of the log; None where it had no time that can be used.

    The last time with its number: while ArduPilot waits for a contact, another camera's report repeats the number of
    the new trigger with the time of the contact before. Of a contact that bounces, the first one.
    """
    mine = sorted(
        (event.boot_ns, event.number, event)
        for event in events
        if (event.kind, event.image) == (trigger.kind, trigger.number)
        and abs(event.stamp_ns - trigger.heard_utc_ns) < _OWN_NS
    )
    return next((event for boot_ns, _, event in mine if mine[-1][0] - boot_ns <= _BOUNCE_NS), None)


def unseen(exposure: ExposureTime) -> ExposureTime:
    """The exposure of a shot whose message had no time: it was before the message was heard, by an unknown delay."""
    return replace(
        exposure,
        sigma_ns=round(math.hypot(exposure.sigma_ns, _HEARD_NS)),
        source=TimeSource.REQUEST,
        doubts=(*exposure.doubts, finding(Code.TIME_TRIGGER_UNUSABLE, FRAME)),
    )


def by_trigger(
    exposure: ExposureTime, trigger: TriggerMessage, event: Feedback, clock: BootClock, events: Sequence[Feedback] = ()
) -> tuple[ExposureTime, int, int]:
    """The exposure by the message that created its shot: the exposure, mid-exposure in time since boot, and 1 σ of the
    latter alone. Where the message is no contact, a receiver's mark among `events` is, or PX4's report of one; without
    them the body's latency is added."""
    if event.contact:
        return *refine(exposure, event, clock), event.sigma_ns
    start_boot_ns = event.boot_ns + round(trigger.latency.mean_ms * 1e6)
    own_ns = round(trigger.latency.sigma_ms * 1e6)
    middle_boot_ns = start_boot_ns + exposure.half_ns
    better = replace(
        exposure,
        utc_ns=clock.utc_ns(middle_boot_ns),
        sigma_ns=round(math.hypot(own_ns, clock.sigma_ns)),
        source=TimeSource.AUTOPILOT_TRIGGER,
        called_utc_ns=clock.utc_ns(event.boot_ns),
    )
    mark = choose_feedback([one for one in events if one.kind in (MARK, CAPTURED)], better, clock)
    return (better, middle_boot_ns, own_ns) if mark is None else (*refine(better, mark, clock), mark.sigma_ns)


def refine(exposure: ExposureTime, event: Feedback, clock: BootClock) -> tuple[ExposureTime, int]:
    """The exposure as the hot shoe timed it, and mid-exposure in time since boot."""
    middle_boot_ns = event.boot_ns + exposure.half_ns
    sigma_ns = round(math.hypot(event.sigma_ns, clock.sigma_ns))
    source = TimeSource.RECEIVER_MARK if event.kind == MARK else TimeSource.HOT_SHOE
    return replace(exposure, utc_ns=clock.utc_ns(middle_boot_ns), sigma_ns=sigma_ns, source=source), middle_boot_ns


@dataclass(frozen=True, slots=True)
class CameraClock:
    """The camera's own clock, which EXIF gives in whole seconds and without a zone.

    `shots` are (camera time − UTC, its 1 σ, its step) in nanoseconds, from shots with a better time. Each offset is
    early by a part of the clock's step that is uniform over it.
    """

    shots: tuple[tuple[int, int, int], ...] = ()

    def learnt(self, shown_ns: int, step_ns: int, exposure: ExposureTime) -> CameraClock:
        """With one more shot, whose start is known otherwise. The last 256 count; only this one where it contradicts
        them: then the camera's clock was set in between."""
        offset_ns = shown_ns - (exposure.utc_ns - exposure.half_ns)
        shots = (*self.shots, (offset_ns, exposure.sigma_ns, step_ns))[-_CAMERA_SHOTS_KEPT:]
        return CameraClock(shots if _agree(shots) else shots[-1:])

    def offset_ns(self) -> tuple[int, int] | None:
        """The camera's time minus UTC with 1 σ; None from fewer than three shots."""
        if len(self.shots) < _CAMERA_SHOTS_LEAST:
            return None
        centre, (sigma, step) = self.shots[-1][0], _spread(self.shots)
        shifts = [offset - centre for offset, _, _ in self.shots]
        # A cut-off time is uniform over one step: its mean is half a step early, with step / √12 a shot.
        mean = sum(shifts) / len(shifts) + step / 2
        by_mean = math.hypot(sigma, step / math.sqrt(12)) / math.sqrt(len(shifts))
        return centre + round(mean), round(by_mean)


def _spread(shots: tuple[tuple[int, int, int], ...]) -> tuple[float, int]:
    """(1 σ of their times, the clock's step)."""
    return math.sqrt(sum(s * s for _, s, _ in shots) / len(shots)), max(step for _, _, step in shots)


def _agree(shots: tuple[tuple[int, int, int], ...]) -> bool:
    sigma, step = _spread(shots)
    offsets = [offset for offset, _, _ in shots]
    return max(offsets) - min(offsets) <= step + 8 * sigma


def exposure_from_camera(
    clock: CameraClock, shown_ns: int, step_ns: int, exposure_s: float | None
) -> ExposureTime | None:
    """Mid-exposure by the camera's clock: the middle of the second (or `step_ns`) that it shows. None while the clock's
    offset is unknown."""
    offset = clock.offset_ns()
    if offset is None:
        return None
    half_ns = round((exposure_s or 0.0) / 2 * 1e9)
    sigma_ns = round(math.hypot(offset[1], step_ns / math.sqrt(12)))
    return ExposureTime(shown_ns - offset[0] + step_ns // 2 + half_ns, sigma_ns, TimeSource.CAMERA_CLOCK, half_ns)


def camera_time(taken: str | None) -> tuple[int, int] | None:
    """(time, step) in nanoseconds of an EXIF time, ISO 8601 without a zone, read as if it were UTC."""
    if taken is None:
        return None
    whole, _, fraction = taken.partition(".")
    if fraction and not (fraction.isascii() and fraction.isdigit()):
        return None
    try:
        seconds = round(datetime.fromisoformat(whole).replace(tzinfo=UTC).timestamp())
    except ValueError:
        return None
    digits = fraction[:9]
    return seconds * 10**9 + int(digits.ljust(9, "0") or 0), 10 ** (9 - len(digits))


def in_doubt(exposure: ExposureTime, clock: BootClock | None, late_ns: int | None = None) -> ExposureTime:
    """The exposure with the doubts of the clock that places it, and of a request that came `late_ns` (None: unknown)
    after it was sent."""
    if clock is None:
        return exposure
    found = [] if clock.stepped is None else [clock.stepped]
    if late_ns is not None and late_ns > _HELD_NS + 3 * clock.sigma_ns:
        found.append(finding(Code.FRAME_REQUEST_LATE, FRAME, late_s=late_ns / 1e9))
    return replace(exposure, doubts=(*exposure.doubts, *found)) if found else exposure


class UtcLearner:
    """Records the autopilot's UTC once it is known, and again when it is twice as precise, or contradicts what was
    recorded: an early value of a real-time clock is given up, but not one by satellites for one without.

    Where the machine's own clock is believed nothing is recorded; `doubt` reports a difference. `record` takes the
    correction and its sigma, ns, and the source.
    """

    def __init__(self, record: Callable[[int, int, str], None], *, known: bool) -> None:
        self._known, self._record = known, record
        self.learnt: UtcCorrection | None = None
        self._last: UtcCorrection | None = None

    @property
    def known(self) -> bool:
        """Whether the stamps of this flight can be converted to UTC."""
        return self._known or self.learnt is not None

    def look(self, found: UtcCorrection | None) -> None:
        """Take what telemetry says now. Raises DappledError when it can't be recorded; the next call tries again."""
        self._last = found or self._last
        if self._known or found is None:
            return
        if self.learnt is None or found.replaces(self.learnt):
            log.info("UTC is %+.3f s from this machine's, by %s", found.correction_ns / 1e9, found.source)
            self._record(found.correction_ns, found.sigma_ns, found.source)
            self.learnt = found

    def doubt(self) -> Finding | None:
        """That the machine's clock is believed, and the autopilot's satellites say something else; else None."""
        last = self._last
        if not self._known or last is None or abs(last.correction_ns) <= 3 * last.sigma_ns + _UTC_AGREES_NS:
            return None
        return finding(Code.TIME_MACHINE_DIFFERS, Subject("machine"), off_s=-last.correction_ns / 1e9)

    def utc_ns(self, utc_ns: int) -> int | None:
        """A stamp of this flight as UTC; None while that is not known."""
        if self.learnt is not None:
            return utc_ns + self.learnt.correction_ns
        return utc_ns if self._known else None
