"""Say for which reasons the poses of the last minute are in doubt: steps of the clock, impossible messages, jumps."""

from __future__ import annotations

from collections.abc import Iterator

from dappled import findings
from dappled.daemon.navigation.vehicle_history import VehicleHistory

_SHOWN_NS = 60 * 10**9


def doubts(history: VehicleHistory, utc_ns: int) -> Iterator[str]:
    """A sentence for each thing that was in the telemetry up to a minute before an instant."""
    counts, time = history.counts, history.time
    step = time.last_step()
    if step is not None and step.step_ns is not None and utc_ns - step.since_ns <= _SHOWN_NS:
        if time.is_unsteady():
            yield "the autopilot's clock does not run steadily: poses are in doubt"
        else:
            yield f"the autopilot's clock stepped by {step.step_ns / 1e9:+.3f} s: poses next to that are in doubt"
    if (date := time.utc.doubt()) is not None:
        yield f"{findings.text(date)}: it is not used"
    if counts.impossible and utc_ns - counts.impossible_ns <= _SHOWN_NS:
        yield "the autopilot sends impossible positions, attitudes or times: they are not used"
    if counts.jumps and utc_ns - counts.jump_ns <= _SHOWN_NS:
        by_m = f"{counts.jump_m:.1f} m"
        yield f"the autopilot's position jumped by {by_m} against its velocity: poses next to that are in doubt"
