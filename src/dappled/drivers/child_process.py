"""Start child processes, end them within a second, limit their restarts, and tie their lives to the parent's."""

from __future__ import annotations

import contextlib
import ctypes
import os
import resource
import select
import signal
import subprocess
import sys
import threading
from collections import deque

from dappled.drivers.process_channel import ProcessChannel

_PR_SET_PDEATHSIG = 1
_REAL_TIME_US = 1_000_000
_RR_PRIORITY = 1
NICENESS = -10
_DEAD_S = 0.5


# --- in the parent


def start_child(module: str, *arguments: str, quiet: bool = False) -> tuple[subprocess.Popen[bytes], ProcessChannel]:
    """Start `python -m module` with a channel to it; for processes that load libgphoto2.

    The child's arguments are the channel's descriptor, this process' id, and `arguments`. `quiet` discards what it
    writes to standard error. Raises OSError.
    """
    channel, other = ProcessChannel.pair()
    with other:
        try:
            process = subprocess.Popen(
                [sys.executable, "-m", module, str(other.fileno()), str(os.getpid()), *arguments],
                pass_fds=(other.fileno(),),
                stdin=subprocess.DEVNULL,
                stderr=subprocess.DEVNULL if quiet else None,
                # libgphoto2 keeps settings (capture target, ...) under HOME and would let one run change the next.
                env={**os.environ, "HOME": "/nonexistent"},
            )
        except OSError:
            channel.close()
            raise
    return process, channel


def end_child(process: subprocess.Popen[bytes], patience_s: float = 0.2) -> None:
    """Wait `patience_s` for a process to end by itself, then kill it.

    A process that the kernel holds in a USB call dies later; this waits half a second for it, not longer.
    """
    with contextlib.suppress(subprocess.TimeoutExpired):
        process.wait(patience_s)
        return
    process.kill()
    with contextlib.suppress(subprocess.TimeoutExpired):  # as above
        process.wait(_DEAD_S)


class RestartBudget:
    """Allow at most `limit` starts in any `window_s`. Not thread-safe: one owner."""

    def __init__(self, limit: int, window_s: float) -> None:
        self._limit = limit
        self._window_ns = round(window_s * 1e9)
        self._spent_ns: deque[int] = deque()

    def wait_ns(self, now_ns: int) -> int:
        """Return how long until the next start is allowed; 0: now."""
        while self._spent_ns and now_ns - self._spent_ns[0] >= self._window_ns:
            self._spent_ns.popleft()
        if len(self._spent_ns) < self._limit:
            return 0
        return self._spent_ns[0] + self._window_ns - now_ns

    def spend(self, now_ns: int) -> None:
        """Count a start."""
        self._spent_ns.append(now_ns)


# --- in the child


def die_with_parent(parent: int) -> None:
    """Ask the kernel to kill this process when the thread that started it ends, however it ends (prctl(2)).

    `parent` is the process id of the starter. If the starter has already ended, exit.
    """
    ctypes.CDLL(None, use_errno=True).prctl(_PR_SET_PDEATHSIG, signal.SIGKILL)
    if os.getppid() != parent:
        sys.exit(0)  # it ended before the call above


def end_with_parent(parent: int) -> None:
    """End this process when the process that started it has ended, whichever of its threads started it.

    (`die_with_parent` goes by the thread, and a thread may end long before its process.)
    """
    try:
        watched = os.pidfd_open(parent)
    except OSError:
        sys.exit(0)  # it has already ended
    threading.Thread(target=_exit_after, args=[watched], name="parent", daemon=True).start()


def _exit_after(pidfd: int) -> None:
    poll = select.poll()
    poll.register(pidfd, select.POLLIN)
    poll.poll()
    os._exit(1)  # without the parent there is nothing to clean up or report


def raise_priority() -> None:
    """Run before decoding and all other processes, as far as this user may: in real time (LimitRTPRIO in the unit, or
    CAP_SYS_NICE), else with a lower niceness (LimitNICE), else unchanged.

    On two busy cores a niceness of -10 still waits 10 to 50 ms now and then, real time less than 1 ms. The kernel stops
    a real-time process that runs for a second without sleeping (RLIMIT_RTTIME), so it can't hold a core.
    """
    try:
        resource.setrlimit(resource.RLIMIT_RTTIME, (_REAL_TIME_US, _REAL_TIME_US))
        os.sched_setscheduler(0, os.SCHED_RR | os.SCHED_RESET_ON_FORK, os.sched_param(_RR_PRIORITY))
    except (PermissionError, ValueError):
        with contextlib.suppress(PermissionError):
            os.setpriority(os.PRIO_PROCESS, 0, NICENESS)
