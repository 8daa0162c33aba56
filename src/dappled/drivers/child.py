"""What a child process of the daemon asks of the kernel when it begins."""

from __future__ import annotations

import contextlib
import ctypes
import os
import signal
import sys

_PR_SET_PDEATHSIG = 1
NICENESS = -10


def die_with_parent(parent: int) -> None:
    """Ask the kernel to kill this process when the thread that started it ends, however it ends (prctl(2)).

    `parent` is the process id of the starter: where that has ended by now, this process exits.
    """
    ctypes.CDLL(None, use_errno=True).prctl(_PR_SET_PDEATHSIG, signal.SIGKILL)
    if os.getppid() != parent:
        sys.exit(0)  # it ended before we asked


def raise_priority(niceness: int = NICENESS) -> None:
    """Go before decoding and everybody else, where this user may (LimitNICE in the unit, or CAP_SYS_NICE)."""
    with contextlib.suppress(PermissionError):
        os.setpriority(os.PRIO_PROCESS, 0, niceness)
