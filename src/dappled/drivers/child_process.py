"""What a child process of the daemon asks of the kernel when it begins."""

from __future__ import annotations

import contextlib
import ctypes
import os
import resource
import select
import signal
import sys
import threading

_PR_SET_PDEATHSIG = 1
_REAL_TIME_US = 1_000_000
_RR_PRIORITY = 1
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


def raise_priority() -> None:
    """Go before decoding and everybody else, as far as this user may: in real time (LimitRTPRIO in the unit, or
    CAP_SYS_NICE), else by niceness (LimitNICE), else as everybody.

    Between two busy cores a niceness of -10 still waits for 10 to 50 ms now and then, real time for less than one. A
    process that never sleeps for a second is stopped by the kernel (RLIMIT_RTTIME), and so can't hold a core.
    """
    try:
        resource.setrlimit(resource.RLIMIT_RTTIME, (_REAL_TIME_US, _REAL_TIME_US))
        os.sched_setscheduler(0, os.SCHED_RR | os.SCHED_RESET_ON_FORK, os.sched_param(_RR_PRIORITY))
    except (PermissionError, ValueError):
        with contextlib.suppress(PermissionError):
            os.setpriority(os.PRIO_PROCESS, 0, NICENESS)
