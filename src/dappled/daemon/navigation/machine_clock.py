"""Whether this machine's own time of day can be believed when a flight begins."""

from __future__ import annotations

import ctypes
from collections.abc import Callable
from pathlib import Path

from dappled.drivers.utc_choice import RELEASED_NS

_TIMEX_BYTES = 512  # more than any kernel's struct timex


def machine_knows_utc(utc_ns: int, *, synchronised: Callable[[], bool] | None = None, root: Path = Path("/")) -> bool:
    """Whether the machine's time of day can be believed: it was set, and is kept by the network, by a hardware clock
    that runs while the machine is off, or by a host.

    A single-board computer without these shows the time of its last shutdown. A systemd service with `ProtectClock=`
    may not ask the kernel, so systemd-timesyncd's mark counts as well.
    """
    if utc_ns < RELEASED_NS:
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


def utc_known(setting: str, utc_ns: int) -> bool:
    """Whether UTC is known by the setting `record.utc`: system, autopilot (only once it reports UTC), or auto."""
    return setting == "system" or (setting == "auto" and machine_knows_utc(utc_ns))
