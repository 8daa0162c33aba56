"""Start child processes, exchange messages with them, end them, limit their restarts, and end them with the parent.

Messages are JSON in packets, with file descriptors beside them. The socket is an AF_UNIX SOCK_SEQPACKET pair: the
kernel keeps message boundaries and passes descriptors, so a file moves between the processes without a copy. Nothing is
ever unpickled.

The kernel closes a descriptor that the receiver has no room for. So a message is first looked at (MSG_PEEK, which
passes copies of its descriptors) and stays in the socket until all of them could be had.
"""

from __future__ import annotations

import contextlib
import ctypes
import json
import os
import resource
import select
import signal
import socket
import struct
import subprocess
import sys
import time
from collections import deque
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any

from dappled.clock import Clock, SystemClock
from dappled.drivers.python_command import python_module
from dappled.workers import Loop, renice

_MESSAGE_BYTES = 131072  # below net.core.wmem_default, 212992, which bounds a packet
_FDS = 4
_SPARE = 8  # more than it takes to write a received file to disk, or to map it
_SHORTAGE_S = 10.0
_AGAIN_S = 0.05
_INT = struct.Struct("i")
_PR_SET_PDEATHSIG = 1
_REAL_TIME_US = 1_000_000
_RR_PRIORITY = 1
NICENESS = -10
DECODER_GOES, VIEWERS_GO = 500, 800  # of 1000: looking before decoding, decoding before recording
_DEAD_S = 2.0


# --- messages


class ChannelError(Exception):
    """The other process is gone, takes no messages, or sent something that is not a message."""


class MessageSizeError(ChannelError):
    """A message is longer than a message may be. It was not sent, and the channel goes on."""


@dataclass(frozen=True, slots=True)
class ChannelMessage:
    """A JSON object and the descriptors that came with it, which the receiver closes.

    `lost` is a sentence where it came with descriptors and this process could not receive them; `fds` is empty then.
    """

    body: Mapping[str, Any]
    fds: tuple[int, ...] = ()
    lost: str = ""


class ProcessChannel:
    """One end of the pair. Messages may be sent from any thread; one thread receives.

    A message whose descriptors this process has no room for waits in the socket, and those behind it too: for 10 s from
    the beginning of the shortage, after which each is received without its descriptors. `starved`: one waits now.
    """

    def __init__(self, sock: socket.socket, clock: Clock | None = None) -> None:
        self.starved = False
        self._socket = sock
        self._clock = clock or SystemClock()
        self._short_since_ns: int | None = None
        sock.setblocking(False)

    @classmethod
    def pair(cls) -> tuple[ProcessChannel, socket.socket]:
        """Make a channel, and the socket of its other end for a child process."""
        here, there = socket.socketpair(socket.AF_UNIX, socket.SOCK_SEQPACKET)
        return cls(here), there

    def send(self, body: Mapping[str, Any], fds: tuple[int, ...] = (), timeout_s: float = 0.0) -> None:
        """Send one message, waiting at most `timeout_s` for room. Raises ChannelError, MessageSizeError."""
        raw = json.dumps(body).encode()
        if len(raw) > _MESSAGE_BYTES:
            raise MessageSizeError(f"a message of {len(raw)} bytes is longer than a message may be ({_MESSAGE_BYTES})")
        try:
            if timeout_s:
                _wait(self._socket, select.POLLOUT, timeout_s)
            if fds:
                socket.send_fds(self._socket, [raw], list(fds))
            else:
                self._socket.send(raw)
        except BlockingIOError as error:
            raise ChannelError("the other process takes no more messages") from error
        except (OSError, ValueError) as error:  # ValueError: closed here
            raise ChannelError(f"the other process is gone ({error})") from error

    def receive(self, timeout_s: float) -> ChannelMessage | None:
        """Return the next message, or None when there was none for that long, or none that could be received whole.
        Raises ChannelError when the other end is closed."""
        until_ns = self._clock.monotonic_ns() + round(timeout_s * 1e9)
        try:
            while _wait(self._socket, select.POLLIN, timeout_s):
                message = self._take()
                left_s = (until_ns - self._clock.monotonic_ns()) / 1e9
                if message is not None or left_s <= 0:
                    return message
                time.sleep(min(left_s, _AGAIN_S))
        except BlockingIOError:
            return None
        except (OSError, ValueError) as error:
            raise ChannelError(f"the other process is gone ({error})") from error
        return None

    def _take(self) -> ChannelMessage | None:
        """Take the first message from the socket; None where it waits for descriptors."""
        raw, fds, flags = _peeked(self._socket)
        whole = not flags & socket.MSG_CTRUNC and (not fds or _can_open(_SPARE))
        if not whole:
            _close(fds)
            fds = ()
            now_ns = self._clock.monotonic_ns()
            self._short_since_ns = self._short_since_ns or now_ns
            self.starved = now_ns - self._short_since_ns < _SHORTAGE_S * 1e9
            if self.starved:
                return None
        elif fds:
            self._short_since_ns = None
        self.starved = False
        self._socket.recv(1)  # drops the whole packet; its own descriptors are closed, the copies stay
        try:
            return ChannelMessage(_parsed(raw, flags), fds, "" if whole else _shortage())
        except ChannelError:
            _close(fds)
            raise

    def close(self) -> None:
        """Close this end."""
        self._socket.close()


def _wait(sock: socket.socket, event: int, timeout_s: float) -> bool:
    poll = select.poll()  # unlike select(2) it knows descriptors above 1023
    poll.register(sock, event)
    return bool(poll.poll(timeout_s * 1e3))


def _peeked(sock: socket.socket) -> tuple[bytes, tuple[int, ...], int]:
    """Look at the first packet: bytes, copies of its descriptors, flags."""
    raw, ancillary, flags, _ = sock.recvmsg(
        _MESSAGE_BYTES, socket.CMSG_LEN(_FDS * _INT.size), socket.MSG_CMSG_CLOEXEC | socket.MSG_PEEK
    )
    fds = tuple(
        fd
        for level, kind, data in ancillary
        if (level, kind) == (socket.SOL_SOCKET, socket.SCM_RIGHTS)
        for (fd,) in _INT.iter_unpack(data[: len(data) - len(data) % _INT.size])
    )
    return raw, fds, flags


def _close(fds: Iterable[int]) -> None:
    for fd in fds:
        os.close(fd)


def _can_open(count: int) -> bool:
    """Whether this process may have so many descriptors more."""
    opened: list[int] = []
    try:
        for _ in range(count):
            opened.append(os.open(os.devnull, os.O_RDONLY | os.O_CLOEXEC))
    except OSError:
        return False
    finally:
        _close(opened)
    return True


def _shortage() -> str:
    limit, _ = resource.getrlimit(resource.RLIMIT_NOFILE)
    return (
        f"dappled has run out of file descriptors (its limit is {limit}): raise LimitNOFILE, or close what holds them"
    )


def _parsed(raw: bytes, flags: int) -> dict[str, Any]:
    if not raw:
        raise ChannelError("the other process has ended")
    if flags & socket.MSG_TRUNC:
        raise ChannelError("a message was longer than the limit")
    try:
        body = json.loads(raw)
    except ValueError as error:
        raise ChannelError(f"a message was not JSON: {error}") from error
    if not isinstance(body, dict):
        raise ChannelError(f"a message must be an object, not {type(body).__name__}")
    return body


# --- in the parent


def start_child(
    module: str,
    *arguments: str,
    descriptors: Sequence[int] = (),
    environment: Mapping[str, str] | None = None,
    quiet: bool = False,
    goes_first: int | None = None,
    niceness: int = 0,
) -> tuple[subprocess.Popen[bytes], ProcessChannel]:
    """Start `python -m module` with a channel to it.

    The child's arguments are the channel's descriptor, this process' id, and `arguments`. It inherits `descriptors`,
    and `environment` in addition to this process' own. `quiet` discards what it writes to standard error.
    From its first import on, others run before it by `niceness`, and with `goes_first` the kernel, when it is short of
    memory, ends it before those with a lower score (proc(5), oom_score_adj), where the system allows it.
    Raises OSError.
    """
    channel, other = ProcessChannel.pair()
    with other:
        try:
            process = subprocess.Popen(
                python_module(module, str(other.fileno()), str(os.getpid()), *arguments),
                pass_fds=(other.fileno(), *descriptors),
                stdin=subprocess.DEVNULL,
                process_group=0,  # the terminal's ^C is the daemon's to act on, also while this one loads
                stderr=subprocess.DEVNULL if quiet else None,
                env={**os.environ, **(environment or {})},
            )
        except OSError:
            channel.close()
            raise
    with contextlib.suppress(OSError):  # it has ended already
        renice(niceness, process.pid)
    if goes_first is not None:
        with contextlib.suppress(OSError):
            Path(f"/proc/{process.pid}/oom_score_adj").write_text(str(goes_first), encoding="ascii")
    return process, channel


def end_child(process: subprocess.Popen[bytes], patience_s: float = 0.2) -> None:
    """Wait `patience_s` for a process to end by itself, then kill it.

    A process that the kernel holds in a USB call dies later; this waits two seconds for it, not longer.
    """
    with contextlib.suppress(subprocess.TimeoutExpired):
        process.wait(patience_s)
        return
    process.kill()
    with contextlib.suppress(subprocess.TimeoutExpired):  # as above
        process.wait(_DEAD_S)


def how_ended(code: int | None) -> str:
    """How a process ended, by its `returncode`, in words."""
    if code is None:
        return "the kernel holds it"
    if code >= 0:
        return f"exit status {code}"
    if code == -signal.SIGXCPU:
        return f"killed: it used real-time CPU for {_REAL_TIME_US / 1e6:g} s without a pause"
    return f"killed: {signal.strsignal(-code) or f'signal {-code}'}"


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
    Loop("parent", partial(_exit_after, watched)).start()


def _exit_after(pidfd: int) -> None:
    poll = select.poll()
    poll.register(pidfd, select.POLLIN)
    poll.poll()
    os._exit(1)  # without the parent there is nothing to clean up or report


def raise_priority() -> None:
    """Run before decoding and all other processes, as far as this user may: in real time (LimitRTPRIO in the unit, or
    CAP_SYS_NICE), else with a lower niceness (LimitNICE), else unchanged.

    On two busy cores a niceness of -10 still waits 10 to 50 ms now and then, real time less than 1 ms. The kernel stops
    a real-time process that runs for a second without sleeping (RLIMIT_RTTIME), so it can't hold a core: with SIGXCPU,
    which tells why (`how_ended`); the hard limit's SIGKILL would not.
    """
    try:
        resource.setrlimit(resource.RLIMIT_RTTIME, (_REAL_TIME_US, 2 * _REAL_TIME_US))
        _in_real_time()
    except (PermissionError, ValueError):
        with contextlib.suppress(PermissionError):
            os.setpriority(os.PRIO_PROCESS, 0, NICENESS)


def _in_real_time() -> None:
    os.sched_setscheduler(0, os.SCHED_RR | os.SCHED_RESET_ON_FORK, os.sched_param(_RR_PRIORITY))


@contextlib.contextmanager
def usual_priority() -> Iterator[None]:
    """Leave real time, where this process is in it, for what may compute longer than that allows."""
    real_time = os.sched_getscheduler(0) & ~os.SCHED_RESET_ON_FORK == os.SCHED_RR
    if real_time:
        os.sched_setscheduler(0, os.SCHED_OTHER | os.SCHED_RESET_ON_FORK, os.sched_param(0))
    try:
        yield
    finally:
        if real_time:
            _in_real_time()
