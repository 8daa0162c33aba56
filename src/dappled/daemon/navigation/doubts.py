"""Say for which reasons the poses of the last minute are in doubt: steps of the clock, impossible messages, jumps."""

from __future__ import annotations

from collections.abc import Iterator

from dappled.daemon.navigation.vehicle_history import VehicleHistory
from dappled.findings import Code, Finding, Subject, finding

_SHOWN_NS = 60 * 10**9


_AUTOPILOT = Subject("autopilot")


def doubts(history: VehicleHistory, utc_ns: int) -> Iterator[Finding]:
    """What was in the telemetry up to a minute before an instant."""
    counts, time = history.counts, history.time
    step = time.last_step()
    if step is not None and step.step_ns is not None and utc_ns - step.since_ns <= _SHOWN_NS:
        if time.is_unsteady():
            yield finding(Code.CLOCK_UNSTEADY, _AUTOPILOT)
        else:
            yield finding(Code.CLOCK_STEPPED, _AUTOPILOT, steps=1, by_s=step.step_ns / 1e9)
    if (date := time.utc.doubt()) is not None:
        yield date
    if counts.impossible and utc_ns - counts.impossible_ns <= _SHOWN_NS:
        yield finding(Code.POSITION_IMPOSSIBLE, _AUTOPILOT)
    if counts.jumps and utc_ns - counts.jump_ns <= _SHOWN_NS:
        yield finding(Code.POSITION_JUMPED, _AUTOPILOT, by_m=counts.jump_m)
