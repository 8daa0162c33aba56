"""Does this machine know UTC? Where it doesn't, the autopilot's satellites tell it later; nothing is stamped anew."""

from __future__ import annotations

import ctypes
from collections.abc import Callable
from pathlib import Path

from dappled.daemon.navigation.telemetry import UtcCorrection

FLOOR_NS = 1_735_689_600 * 10**9  # 2025: a clock that shows less has never been set
_BETTER = 2
_AGREES_NS = 10**9  # what clocks may differ by before it is told
_TIMEX_BYTES = 512  # more than any kernel's struct timex


def system_knows(utc_ns: int, *, synchronised: Callable[[], bool] | None = None, root: Path = Path("/")) -> bool:
    """Whether the machine's time of day is to be believed: set at all; and kept by the network, by a clock of its own
    that runs while it is off, or by a host. A single-board computer without either shows when it was last switched off.
    A service may not ask the kernel (`ProtectClock=`): systemd-timesyncd's mark is looked for as well.
    """
    if utc_ns < FLOOR_NS:
        return False
    if (synchronised or kernel_synchronised)() or (root / "run/systemd/timesync/synchronized").exists():
        return True
    board = (root / "proc/device-tree/model").exists()
    return not board or any((root / "sys/class/rtc").glob("rtc*"))


def kernel_synchronised() -> bool:
    """Whether the kernel's clock is disciplined (adjtimex(2)): False where that can't be asked."""
    try:
        adjtimex = ctypes.CDLL(None, use_errno=True).adjtimex
    except (OSError, AttributeError):
        return False
    timex = ctypes.create_string_buffer(_TIMEX_BYTES)  # modes = 0: only read
    return int(adjtimex(timex)) in range(5)  # 5 is TIME_ERROR: not synchronised; -1 an error


def known(setting: str, utc_ns: int) -> bool:
    """As `record.utc` has it: system, autopilot (not known until it tells), or auto."""
    return setting == "system" or (setting == "auto" and system_knows(utc_ns))


class UtcLearner:
    """Notes the autopilot's word once there is one, and again when it is twice as sure.

    Where the machine's own clock is believed nothing is noted; that they differ is told.
    """

    def __init__(self, *, known: bool, note: Callable[[UtcCorrection], object]) -> None:
        self._known, self._note = known, note
        self.learnt: UtcCorrection | None = None
        self._last: UtcCorrection | None = None

    @property
    def known(self) -> bool:
        """Whether the stamps of this flight can be told as UTC."""
        return self._known or self.learnt is not None

    def look(self, found: UtcCorrection | None) -> None:
        """What telemetry says now. Raises DappledError when it can't be noted; the next look tries again."""
        self._last = found or self._last
        if self._known or found is None:
            return
        if self.learnt is None or found.sigma_ns * _BETTER <= self.learnt.sigma_ns:
            self._note(found)
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
