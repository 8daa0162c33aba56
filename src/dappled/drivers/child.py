"""What a child process of the daemon asks of the kernel when it begins."""

from __future__ import annotations

import contextlib
import ctypes
import os
import select
import signal
import sys
import threading

_PR_SET_PDEATHSIG = 1
NICENESS = -10


def die_with_parent(parent: int) -> None:
    """Ask the kernel to kill this process when the thread that started it ends, however it ends (prctl(2)).

    `parent` is the process id of the starter: where that has ended by now, this process exits.
    """
    ctypes.CDLL(None, use_errno=True).prctl(_PR_SET_PDEATHSIG, signal.SIGKILL)
    if os.getppid() != parent:
        sys.exit(0)  # it ended before we asked


def end_with_parent(parent: int) -> None:
    """End this process when the one that started it has ended, whichever of its threads did the starting.

    (`die_with_parent` goes by the thread, and a thread may end long before its process.)
    """
    try:
        watched = os.pidfd_open(parent)
    except OSError:
        sys.exit(0)  # it ended before we asked
    threading.Thread(target=_exit_after, args=[watched], name="parent", daemon=True).start()


def _exit_after(pidfd: int) -> None:
    poll = select.poll()
    poll.register(pidfd, select.POLLIN)
    poll.poll()
    os._exit(1)  # nobody is left to be told anything


def raise_priority(niceness: int = NICENESS) -> None:
    """Go before decoding and everybody else, where this user may (LimitNICE in the unit, or CAP_SYS_NICE)."""
    with contextlib.suppress(PermissionError):
        os.setpriority(os.PRIO_PROCESS, 0, niceness)
