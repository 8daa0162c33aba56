"""Turn each capture request into exactly one shot, or refuse it with a reason. Nothing here waits for the camera."""

from __future__ import annotations

import logging
import math
import threading
from dataclasses import dataclass, replace
from typing import Literal, Protocol

from dappled import findings
from dappled.clock import Clock
from dappled.daemon.pipeline.repeats import FORWARDED_NS, CaptureRequest, ForwardedRequests, RecentRequests
from dappled.errors import report
from dappled.findings import Code, Finding, Subject, finding
from dappled.flight import Cause, FlightError, Shot
from dappled.refusals import SHOTS_INTERVAL_S, RefusalLog
from dappled.workers import Loop, OneThread

log = logging.getLogger(__name__)
CANNOT_FIRE = finding(Code.CAMERA_FIRED_OUTSIDE, Subject("camera"))
_LONGEST_S = 86400
_IDLE_S = 60.0
_SHORTEST_S = 0.05
_AGAIN_S = 1.0
_SETTLE_S = 0.5  # how often refusals are looked for that were only counted
OWN_KINDS = ("interval", "distance")  # of requests that are made here: none of them is another one's repeat
IntervalEnd = Literal["stopped", "none ran", "began later"]


@dataclass(frozen=True, slots=True)
class ShotDecision:
    """What became of a request: a new shot, a message more of a known shot, or nothing, for a `reason`."""

    outcome: Literal["shot", "duplicate", "refused"]
    index: int | None = None
    reason: Finding | None = None

    @property
    def accepted(self) -> bool:
        """Whether there is a shot for the request."""
        return self.outcome != "refused"

    @property
    def words(self) -> str:
        """It as a person reads it."""
        if self.reason is not None:
            return f"no photo: {findings.text(self.reason)}"
        return f"{'already ' if self.outcome == 'duplicate' else ''}shot {self.index}"


@dataclass(frozen=True, slots=True)
class ShutterStatistics:
    """Counters of this flight. shots = pending + succeeded + failed.

    `interval_s` is None while no interval runs; else `interval_taken` of `interval_count` (None: for ever) are taken,
    `interval_refused` were refused instead, the next is due in `interval_next_s`, and it began at `interval_began_ns`
    (monotonic).
    """

    shots: int
    refused: int
    pending: int
    succeeded: int
    failed: int
    next_index: int
    interval_s: float | None
    interval_taken: int = 0
    interval_refused: int = 0
    interval_count: int | None = None
    interval_next_s: float | None = None
    interval_began_ns: int = 0


@dataclass(slots=True)
class _Interval:
    source: str
    interval_ns: int
    left: int | None
    due_ns: int
    command: CaptureRequest
    began_ns: int
    taken: int = 1  # or refused
    refused: int = 0
    driven: bool = False  # the autopilot runs the same interval, and sets its pace

    def took(self, *, accepted: bool = True) -> None:
        """One more shot of it was taken, or refused."""
        self.taken += 1
        self.refused += not accepted
        if self.left is not None:
            self.left -= 1


class ShotSink(Protocol):
    """What the shutter does with a capture request. Every method returns within a millisecond."""

    def obstacle(self) -> Finding | None:
        """Why no shot can be taken now (no camera, disk full); None where one can."""

    def note(self, shot: Shot) -> None:
        """Write a shot down before the camera is touched. Raises FlightError or OSError, which refuses the request."""

    def fire(self, shot: Shot) -> None:
        """Hand a noted shot to the camera."""

    def refused(self, why: Finding) -> None:
        """Requests became no shots: the first of a source for a reason, later how many more. See `RefusalLog`."""


class Shutter(OneThread):
    """Turn capture requests into shots.

    `next_index`: the image index of the next shot. At most `capacity` shots may be pending (fired, not yet settled);
    an exposure that has happened is taken in any case. `fires`: False where something else fires the camera, so that
    only exposures that have happened are shots.
    All methods may be called from any thread, and return within a millisecond as long as those of `sink` do.
    """

    def __init__(self, sink: ShotSink, clock: Clock, *, next_index: int, capacity: int = 8, fires: bool = True) -> None:
        self._sink, self.clock, self.fires = sink, clock, fires
        self._next_index = next_index
        self._capacity = capacity
        self._lock = threading.Lock()
        self._recent, self._forwarded = RecentRequests(), ForwardedRequests()
        self._refusals = RefusalLog(log, clock, SHOTS_INTERVAL_S)
        self._pending: set[int] = set()
        self._interval: _Interval | None = None
        self._shots = self._refused = self._succeeded = self._failed = 0
        self._wake = threading.Event()
        self._stopped = False
        self._loop = Loop("shutter intervals", self._run, clock=clock)

    def stop(self) -> None:
        """End intervals and refuse from now on."""
        with self._lock:
            self._stopped = True
            self._interval = None
        self._wake.set()
        self._loop.stop(2.0)

    def request(self, request: CaptureRequest) -> ShotDecision:
        """One message that asks for one shot."""
        with self._lock:
            return self._judge(request)

    def start_interval(self, request: CaptureRequest, interval_s: float, count: int) -> ShotDecision:
        """A shot now and then every `interval_s` (0: as soon as the last one is settled, or a second after one that was
        refused), `count` in all, 0 for ever.

        Takes the place of a running interval, unless it is a retry of the command that started it; ends at `count`
        shots taken or missed, or at `stop_interval`. A shot that can't be taken when it is due is counted as refused,
        and not made up for.

        An autopilot that heard the same broadcast runs the interval as well, and requests each shot. From its first
        request on these are the interval's shots where they come within 0.25 s of their time; one that is later is
        taken without it. That holds for intervals of 0.5 s and more.
        """
        if not (math.isfinite(interval_s) and 0 <= interval_s <= _LONGEST_S) or count < 0:
            with self._lock:
                bounds = finding(Code.SHOT_INTERVAL_BOUNDS, Subject("shot"), longest_s=_LONGEST_S)
                return self._refuse(request, bounds)
        request = replace(request, series=(interval_s, float(count)))
        with self._lock:
            now_ns = self.clock.monotonic_ns()
            if (known := self._recent.same(request, now_ns)) is not None:
                self._forwarded.add(request, now_ns, known)  # the autopilot begins again, with a trigger at once
                return ShotDecision("duplicate", index=known)
            decision = self._judge(request)  # a duplicate of the autopilot's first request begins the interval as well
            if decision.accepted and count != 1:
                step_ns = round(max(interval_s, _SHORTEST_S if interval_s > 0 else 0.0) * 1e9)
                left = None if count == 0 else count - 1
                self._end_interval(request.source)
                now_ns, driven = self.clock.monotonic_ns(), decision.outcome == "duplicate"
                due_ns = now_ns + step_ns + (FORWARDED_NS if driven else 0)
                self._interval = _Interval(request.source, step_ns, left, due_ns, request, now_ns, driven=driven)
                self._wake.set()
        return decision

    def stop_interval(self, source: str | None = None, *, asked_ns: int | None = None) -> IntervalEnd:
        """End a running interval, from any source; the same command from the same `source` then starts it again.

        `asked_ns` is when the stop was asked for (monotonic; None: now). An interval that began later goes on: a stop
        that a link held back is not meant for it.
        """
        with self._lock:
            if self._interval is None:
                return "none ran"
            if asked_ns is not None and self._interval.began_ns > asked_ns:
                return "began later"
            self._end_interval(source)
        return "stopped"

    def settled(self, index: int, ok: bool) -> None:
        """A shot's outcome is known: its frame is safe, or there will be none. A second call for a shot is ignored."""
        with self._lock:
            if index not in self._pending:
                return
            self._pending.discard(index)
            self._succeeded += ok
            self._failed += not ok
            if self._interval is not None and self._interval.interval_ns == 0:
                self._wake.set()

    def settle_refusals(self, *, all_of_them: bool = False) -> None:
        """Hand the refusals that were only counted to the sink, where five seconds are over; at the end of a flight
        `all_of_them`."""
        for one in self._refusals.settle(all_of_them=all_of_them):
            self._sink.refused(one)

    def serve(self) -> float:
        """Take the interval's shot if one is due; seconds until there is something to do. The thread's work."""
        with self._lock:
            now_ns = self.clock.monotonic_ns()
            interval = self._interval
            if interval is None or (interval.interval_ns == 0 and self._pending):
                return _IDLE_S
            if now_ns >= interval.due_ns:
                decision = self._judge(
                    CaptureRequest(
                        interval.source,
                        "interval",
                        interval.taken,
                        acknowledged=False,
                        broadcast=interval.command.broadcast,
                    )
                )
                interval.took(accepted=decision.accepted)
                if interval.left == 0:
                    self._interval = interval = None
                elif interval.interval_ns:
                    behind = (now_ns - interval.due_ns) // interval.interval_ns
                    interval.due_ns += (1 + behind) * interval.interval_ns  # late ticks are missed, not bunched
                else:
                    interval.due_ns = now_ns + round((_SHORTEST_S if decision.accepted else _AGAIN_S) * 1e9)
            return _IDLE_S if interval is None else max(0, interval.due_ns - now_ns) / 1e9

    def statistics(self) -> ShutterStatistics:
        """Counters."""
        with self._lock:
            interval = self._interval
            return ShutterStatistics(
                self._shots,
                self._refused,
                len(self._pending),
                self._succeeded,
                self._failed,
                self._next_index,
                None if interval is None else interval.interval_ns / 1e9,
                0 if interval is None else interval.taken - interval.refused,
                0 if interval is None else interval.refused,
                None if interval is None or interval.left is None else interval.taken + interval.left,
                None if interval is None else max(0, interval.due_ns - self.clock.monotonic_ns()) / 1e9,
                0 if interval is None else interval.began_ns,
            )

    def _end_interval(self, source: str | None) -> None:
        """What a sender ended itself it may start again at once; after another's stop its message is a retry."""
        if self._interval is not None and self._interval.command.source == source:
            self._recent.forget(self._interval.command)
        self._interval = None

    def _judge(self, request: CaptureRequest) -> ShotDecision:
        now_ns = self.clock.monotonic_ns()
        if request.kind not in OWN_KINDS:
            known = self._recent.same(request, now_ns)
            if known is not None:
                if not request.autopilot:
                    self._forwarded.add(request, now_ns, known)  # the autopilot executes a broadcast's retry as well
                return ShotDecision("duplicate", index=known)
        if (partner := self._forwarded.partner(request, now_ns)) is not None:
            if request.kind not in OWN_KINDS:
                self._recent.add(request, now_ns, partner)
            self._follow_autopilot(request, now_ns, new=False)
            return ShotDecision("duplicate", index=partner)
        if (refused := self._refused_before(request, now_ns)) is not None:
            return ShotDecision("refused", reason=refused)  # the same request, which was counted already
        reason = self._why_not(happened=request.happened)
        if reason is None:
            shot = Shot(
                self._next_index, Cause(request.source, request.kind, request.sequence), self.clock.utc_ns(), now_ns
            )
            try:
                self._sink.note(shot)
            except (OSError, FlightError) as error:
                reason = finding(Code.SHOT_NOT_NOTED, Subject("shot", shot.index), why=error)
        if reason is not None:
            self._note_refusal(request, now_ns, reason)
            self._follow_autopilot(request, now_ns, new=True)
            return self._refuse(request, reason)
        self._next_index += 1
        self._shots += 1
        self._pending.add(shot.index)
        if request.kind not in OWN_KINDS:
            self._recent.add(request, now_ns, shot.index)
        self._forwarded.add(request, now_ns, shot.index)
        self._follow_autopilot(request, now_ns, new=True)
        try:
            self._sink.fire(shot)
        except Exception:
            # The shot is noted, so it exists; the owner of the driver sees the exception and the failed count.
            self._pending.discard(shot.index)
            self._failed += 1
            raise
        return ShotDecision("shot", index=shot.index)

    def _refused_before(self, request: CaptureRequest, now_ns: int) -> Finding | None:
        """Why the same request was refused, where another message has brought it. An exposure can't be refused."""
        if request.happened:
            return None
        own = request.kind in OWN_KINDS
        refused = None if own else self._recent.refusal(request, now_ns)
        if refused is None and (refused := self._forwarded.refusal(request, now_ns)) is not None and not own:
            self._recent.refuse(request, now_ns, refused)
        return refused

    def _note_refusal(self, request: CaptureRequest, now_ns: int, reason: Finding) -> None:
        """Its other messages are refused as well, and not counted."""
        if request.kind not in OWN_KINDS:
            self._recent.refuse(request, now_ns, reason)
        self._forwarded.refuse(request, now_ns, reason)

    def _follow_autopilot(self, request: CaptureRequest, now_ns: int, *, new: bool) -> None:
        """Where the autopilot runs the interval as well: it sets the pace, and its `new` request is the next shot."""
        interval = self._interval
        if interval is None or not interval.command.broadcast or not request.autopilot:
            return
        if interval.interval_ns < 2 * FORWARDED_NS:
            return
        interval.driven = interval.driven or not new
        if not interval.driven:
            return
        if new:
            expected_ns = interval.due_ns - FORWARDED_NS
            if abs(now_ns - expected_ns) > FORWARDED_NS:
                return  # a trigger of the autopilot's own
            interval.took()
        if interval.left == 0:
            self._interval = None
        interval.due_ns = now_ns + interval.interval_ns + FORWARDED_NS

    def _refuse(self, request: CaptureRequest, reason: Finding) -> ShotDecision:
        self._refused += 1
        asked = replace(reason.with_facts(request=request.kind), subject=Subject("source", request.source))
        for one in self._refusals.refused(asked):
            self._sink.refused(one)
        return ShotDecision("refused", reason=reason)

    def _why_not(self, *, happened: bool) -> Finding | None:
        if self._stopped:
            return finding(Code.SERVICE_STOPPING, Subject("service"))
        if happened:
            return None
        if not self.fires:
            return CANNOT_FIRE
        if len(self._pending) >= self._capacity:
            return finding(Code.CAMERA_SHOTS_WAITING, Subject("camera"), pending=len(self._pending))
        return self._sink.obstacle()

    def _run(self) -> None:
        while not self._stopped:
            self._wake.clear()
            self.settle_refusals()
            try:
                wait_s = self.serve()
            except Exception as error:  # noqa: BLE001  # noting or firing failed: the interval goes on
                report(log, "interval", error)
                wait_s = _AGAIN_S
            self.clock.wait(self._wake, min(wait_s, _SETTLE_S))
