"""Say for which reasons poses are in doubt: steps of the clock, impossible messages, jumps.

Each stands until a minute of telemetry has come without another: while nothing is heard, nothing is over. A jump stands
until there is evidence that it is over as well.
"""

from __future__ import annotations

from collections.abc import Iterator

from dappled.daemon.navigation.vehicle_history import VehicleHistory
from dappled.findings import Code, Finding, Subject, finding

_CLEAR_NS = 60 * 10**9


_AUTOPILOT = Subject("autopilot")


def doubts(history: VehicleHistory) -> Iterator[Finding]:
    """What was in the last minute of the telemetry that was heard."""
    counts, time = history.counts, history.time
    heard_ns, placed_ns = time.heard_ns, history.placed_ns
    step = time.last_step()
    if step is not None and step.step_ns is not None and heard_ns - step.since_ns <= _CLEAR_NS:
        if time.is_unsteady() and (rate := history.rate()) is not None:
            yield finding(Code.CLOCK_NOT_REAL_TIME, _AUTOPILOT, rate=rate)
        elif time.is_unsteady():
            yield finding(Code.CLOCK_UNSTEADY, _AUTOPILOT)
        else:
            yield finding(Code.CLOCK_STEPPED, _AUTOPILOT, steps=1, by_s=step.step_ns / 1e9)
    if (date := time.utc.doubt()) is not None:
        yield date
    if counts.impossible and heard_ns - counts.impossible_ns <= _CLEAR_NS:
        yield finding(Code.POSITION_IMPOSSIBLE, _AUTOPILOT)
    if history.displaced or (counts.jumps and placed_ns - counts.jump_ns <= _CLEAR_NS):
        yield finding(Code.POSITION_JUMPED, _AUTOPILOT, by_m=counts.jump_m)
