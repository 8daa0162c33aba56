"""What an autopilot says of UTC (SYSTEM_TIME): which of its dates and offsets count."""

from __future__ import annotations

from dappled.drivers.utc_choice import RELEASED_NS, ROLLOVER_NS, Date, UtcBounds, rolled_over, rollovers
from dappled.findings import Finding, Subject

_SAME_NS = 50_000_000  # offsets further apart are a step: crystals drift by less between two messages
_AGREEING = 2  # messages that say a new offset before it counts


class AutopilotUtc:
    """UTC minus time since boot.

    The first possible offset counts at once. Another one counts once two messages in a row say it: a real-time clock
    before the first fix is given up for the satellites' time, a damaged message changes nothing.
    """

    def __init__(self) -> None:
        self.offset_ns: int | None = None
        self._rolled_ns: int | None = None  # the last date, where it seems 1024 weeks too early
        self._rival_ns, self._said = 0, 0

    def take(self, unix_ns: int, boot_ns: int, stamp_ns: int) -> bool:
        """Take a SYSTEM_TIME that arrived at `stamp_ns` by this machine's clock. False: its date is impossible."""
        date = UtcBounds.live((stamp_ns,)).judge(unix_ns)
        self._rolled_ns = unix_ns if date is Date.ROLLED_OVER else None
        if date in (Date.ROLLED_OVER, Date.IMPOSSIBLE):
            return date is Date.ROLLED_OVER
        offset_ns = (_later_ns(unix_ns) if date is Date.MENDED else unix_ns) - boot_ns
        if self.offset_ns is None or abs(offset_ns - self.offset_ns) <= _SAME_NS:
            self.offset_ns, self._said = offset_ns, 0
            return True
        self._said = self._said + 1 if self._said and abs(offset_ns - self._rival_ns) <= _SAME_NS else 1
        self._rival_ns = offset_ns
        if self._said >= _AGREEING:
            self.offset_ns, self._said = offset_ns, 0
        return True

    def doubt(self) -> Finding | None:
        """What is to be said of the last date."""
        early_ns = self._rolled_ns
        return None if early_ns is None else rolled_over(Subject("link"), early_ns, _later_ns(early_ns))


def _later_ns(unix_ns: int) -> int:
    return unix_ns + rollovers(unix_ns, RELEASED_NS) * ROLLOVER_NS
