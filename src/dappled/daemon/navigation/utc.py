"""Decide whether this machine's UTC can be believed, and learn it from the autopilot's satellites where it can't.

Stamps already written stay as they are; the correction is recorded beside them.
"""

from __future__ import annotations

import ctypes
import logging
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Protocol

log = logging.getLogger(__name__)
FLOOR_NS = 1_735_689_600 * 10**9  # 2025: a clock that shows less has never been set
_BETTER = 2
_AGREES_NS = 10**9  # clocks that differ by less are not reported
_TIMEX_BYTES = 512  # more than any kernel's struct timex


@dataclass(frozen=True, slots=True)
class UtcCorrection:
    """What to add to this machine's UTC to get the autopilot's (from its satellites), ± 1 σ."""

    correction_ns: int
    sigma_ns: int
    source: str


class UtcNotes(Protocol):
    """Where a correction is recorded; see `flight.recording.Recording`."""

    def learn_utc(self, correction_ns: int, sigma_ns: int, source: str) -> None: ...


def system_knows(utc_ns: int, *, synchronised: Callable[[], bool] | None = None, root: Path = Path("/")) -> bool:
    """Whether the machine's time of day can be believed: it was set, and is kept by the network, by a hardware clock
    that runs while the machine is off, or by a host.

    A single-board computer without these shows the time of its last shutdown. A systemd service with `ProtectClock=`
    may not ask the kernel, so systemd-timesyncd's mark counts as well.
    """
    if utc_ns < FLOOR_NS:
        return False
    if (synchronised or kernel_synchronised)() or (root / "run/systemd/timesync/synchronized").exists():
        return True
    board = (root / "proc/device-tree/model").exists()
    return not board or any((root / "sys/class/rtc").glob("rtc*"))


def kernel_synchronised() -> bool:
    """Whether the kernel's clock is synchronised (adjtimex(2)); False where the kernel can't be asked."""
    try:
        adjtimex = ctypes.CDLL(None, use_errno=True).adjtimex
    except (OSError, AttributeError):
        return False
    timex = ctypes.create_string_buffer(_TIMEX_BYTES)  # modes = 0: only read
    return int(adjtimex(timex)) in range(5)  # 5 is TIME_ERROR: not synchronised; -1 an error


def known(setting: str, utc_ns: int) -> bool:
    """Whether UTC is known by the setting `record.utc`: system, autopilot (only once it reports UTC), or auto."""
    return setting == "system" or (setting == "auto" and system_knows(utc_ns))


class UtcLearner:
    """Records the autopilot's UTC once it is known, and again when it is twice as precise.

    Where the machine's own clock is believed nothing is recorded; `doubt` reports a difference.
    """

    def __init__(self, notes: UtcNotes, *, known: bool) -> None:
        self._known, self._notes = known, notes
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
        if self.learnt is None or found.sigma_ns * _BETTER <= self.learnt.sigma_ns:
            log.info("UTC is %+.3f s from this machine's, by %s", found.correction_ns / 1e9, found.source)
            self._notes.learn_utc(found.correction_ns, found.sigma_ns, found.source)
            self.learnt = found

    def doubt(self) -> str | None:
        """A sentence where the machine's clock is believed, and the autopilot's satellites say something else."""
        last = self._last
        if not self._known or last is None or abs(last.correction_ns) <= 3 * last.sigma_ns + _AGREES_NS:
            return None
        way = "slow" if last.correction_ns > 0 else "fast"
        off_s = abs(last.correction_ns) / 1e9
        return (
            f"this machine's clock is {off_s:.0f} s {way}, by the autopilot's satellites, and believed all the same: "
            'set it, or set record.utc = "autopilot"'
        )

    def utc_ns(self, utc_ns: int) -> int | None:
        """A stamp of this flight as UTC; None while that is not known."""
        if self.learnt is not None:
            return utc_ns + self.learnt.correction_ns
        return utc_ns if self._known else None
